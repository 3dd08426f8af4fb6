"""Pictures against closed forms, against the same in array operations, and against themselves."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from drawn import at, ball, drawn, from_aside, mixed, only, seen, table

from torchdlo.errors import InputError
from torchdlo.vision import renderer
from torchdlo.vision.look import Look, Paint, draw_look
from torchdlo.vision.renderer import ARM, BODY, NOTHING, PARTICLES, ROPE, TABLE, Images, Placement, looking_at, render

SIZE = (160, 120)
SHARP = Look(key_direction=(0.0, 0.0, 1.0), softness=0.0, table=Paint((0.8, 0.8, 0.8)))


def random_look(seed: int) -> Look:
    return draw_look(torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("samples", [1, 4])
def test_a_ball_covers_the_area_of_its_cone(samples: int):
    # Lines that touch a ball of radius r at distance d make an angle with tangent r / sqrt(d^2 - r^2).
    view = seen(looking_at((1.0, 0.0, 0.0), (0.0, 0.0, 0.0), size=SIZE))
    ids = drawn(only(ball()), at((0.0, 0.0, 0.0)), view, SIZE, samples=samples).ids
    radius = float(view.intrinsics[0, 0, 0]) * 0.1 / math.sqrt(1 - 0.1**2)
    # Pixels on the rim are counted or not: about as many as its square root are off.
    assert float((ids == BODY).sum()) == pytest.approx(math.pi * radius**2, rel=0.02)


def test_depths_of_a_slanted_plane_are_exact():
    view = from_aside(SIZE)
    found = drawn(only(table()), at(), view, SIZE, samples=4)
    y, x = torch.meshgrid(torch.arange(SIZE[1]).double(), torch.arange(SIZE[0]).double(), indexing="ij")
    k, r, t = view.intrinsics[0], view.rotation[0], view.translation[0]
    ray = torch.stack([(x - k[0, 2]) / k[0, 0], (y - k[1, 2]) / k[1, 1], torch.ones_like(x)], -1)
    # The height of depth * ray is zero in the world: eye_z + depth * (R^T ray)_z = 0.
    expected = -(-r.T @ t)[2] / (ray @ r)[..., 2]
    inside = (found.ids[0, 0] == TABLE) & (expected > 0)
    # Where the edge of the table crosses a pixel, samples of the table are not in the pixel's middle.
    inner = -torch.nn.functional.max_pool2d(-inside[None].float(), 3, 1, 1)[0] > 0
    assert inner.sum() > 3000
    torch.testing.assert_close(found.depth[0, 0][inner].double(), expected[inner], rtol=2e-5, atol=0)


@pytest.mark.parametrize("samples", [1, 4])
def test_a_rope_is_as_wide_as_it_is(samples: int):
    line = np.stack([np.linspace(-0.3, 0.3, 31), np.zeros(31), np.zeros(31)], -1)
    view = seen(looking_at((0.0, 0.0, 0.5), (0.0, 0.0, 0.0), size=(200, 200)))
    ids = drawn(only(ropes=[line]), at(ropes=[line]), view, (200, 200), samples=samples).ids[0, 0]
    # The middle column of pixels, 19.8 px wide. A tube of 16 corners is up to 1 % thinner.
    wide = 2 * float(view.intrinsics[0, 0, 0]) * 0.01 / math.sqrt(0.5**2 - 0.01**2)
    both = (ids[:, 20:180] == ROPE).float().sum(0 if float(view.rotation[0, 0, 0].abs()) > 0.5 else 1)
    assert float(both.mean()) == pytest.approx(wide, abs=0.6)


def test_masks_tell_things_apart():
    model, placement = mixed()
    ids = drawn(model, placement, from_aside(SIZE), SIZE).ids
    wanted = {NOTHING, TABLE, ROPE, ROPE + 1, BODY, BODY + 1, ARM, PARTICLES, PARTICLES + 1}
    assert set(ids.unique().tolist()) == wanted
    # Seen from above, each is where it was put.
    above = seen(looking_at((0.0, 0.0, 2.0), (0.0, 0.0, 0.0), size=SIZE))
    ids = drawn(model, placement, above, SIZE).ids[0, 0]
    for number, place in ((BODY, (0.2, -0.1, 0.06)), (BODY + 1, (-0.2, 0.2, 0.06)), (ARM, (0.3, 0.2, 0.2))):
        x, y, z = (above.rotation[0] @ torch.tensor(place).double() + above.translation[0]).tolist()
        k = above.intrinsics[0]
        assert ids[round(float(k[1, 1] * y / z + k[1, 2])), round(float(k[0, 0] * x / z + k[0, 2]))] == number


def test_shadows_fall_where_the_light_is_kept_off():
    # Light from above and 45 degrees along x: the shadow of a ball at height 0.4 is about x = -0.4.
    look = Look(key_direction=(1.0, 0.0, 1.0), softness=0.0, table=Paint((0.8, 0.8, 0.8), gloss=0.0))
    view = seen(looking_at((0.0, 0.0, 3.0), (0.0, 0.0, 0.0), size=(241, 241)))
    rgb = drawn(only(table(), ball()), at((0.0, 0.0, 0.4)), view, (241, 241), looks=[look], shadow=1024).rgb[0, 0]

    def bright(x: float, y: float) -> float:
        px, py, pz = (view.rotation[0] @ torch.tensor([x, y, 0.0]).double() + view.translation[0]).tolist()
        f = float(view.intrinsics[0, 0, 0])
        return float(rgb[round(f * py / pz + 120), round(f * px / pz + 120)].float().mean())

    lit, dark = bright(0.6, 0.6), bright(-0.4, 0.0)
    assert dark < 0.75 * lit
    # Across the light it is as wide as the ball, along it sqrt(2) times as long.
    for x, y, inside in ((-0.4, 0.09, True), (-0.4, 0.115, False), (-0.4 - 0.13, 0, True), (-0.4 - 0.155, 0, False)):
        assert bright(x, y) == pytest.approx(dark if inside else lit, rel=0.03), (x, y)


def test_the_table_is_evenly_lit_where_there_is_no_shadow():
    # A surface that shaded itself would be striped.
    view = seen(looking_at((0.0, -1.5, 1.0), (0.0, 0.0, 0.0), size=SIZE))
    found = drawn(only(table(3.0), ball(shadow=True)), at((0.0, 0.0, 3.0)), view, SIZE, looks=[SHARP])
    flat = found.rgb[0, 0][80:].float()
    assert float(flat.amax() - flat.amin()) < 40
    assert float((flat[:, 1:] - flat[:, :-1]).abs().max()) <= 2


def test_penumbras_grow_with_the_size_of_the_light():
    view = seen(looking_at((0.0, 0.0, 3.0), (0.0, 0.0, 0.0), size=(241, 241)))
    between = []
    for softness in (0.0, 0.2):
        look = Look(key_direction=(1.0, 0.0, 1.0), softness=softness, table=Paint((0.8, 0.8, 0.8), gloss=0.0))
        rgb = drawn(only(table(), ball()), at((0.0, 0.0, 0.4)), view, (241, 241), looks=[look]).rgb[0, 0]
        # Along the row through the shadow, beside the ball.
        row = rgb[120, 20:100].float().mean(-1) if rgb[120, 73].sum() < 450 else rgb[120, 140:220].float().mean(-1)
        between.append(int(((row > 140) & (row < 184)).sum()))
    assert between[0] <= 2 and between[1] >= 6


def test_what_is_behind_the_camera_is_not_drawn():
    view = seen(looking_at((0.0, 0.0, 0.5), (1.0, 0.0, 0.5), size=SIZE))
    line = np.array([[-0.5, -0.1, 0.5], [-0.5, 0.1, 0.5]])
    found = drawn(
        only(ball(), ropes=[line], particles=1),
        at((-1.0, 0.0, 0.5), ropes=[line], particles=np.array([[-0.3, 0, 0.5]])),
        view,
        SIZE,
    )
    assert (found.ids == NOTHING).all() and found.depth.isinf().all()


def test_triangles_that_reach_behind_the_camera_are_cut():
    # A table below a level camera: the lower half is table to its last row, the upper half nothing.
    view = seen(looking_at((0.0, 0.0, 0.1), (1.0, 0.0, 0.1), size=SIZE, opening=1.2))
    found = drawn(only(table(50.0)), at(), view, SIZE)
    assert (found.ids[0, 0, 62:] == TABLE).all() and (found.ids[0, 0, :60] == NOTHING).all()
    row = SIZE[1] - 1
    expected = 0.1 * float(view.intrinsics[0, 1, 1]) / (row - 0.5 * (SIZE[1] - 1))
    torch.testing.assert_close(found.depth[0, 0, row], torch.full((SIZE[0],), expected), rtol=1e-4, atol=0)


def test_an_empty_scene_is_the_room():
    found = drawn(only(), at(), from_aside(SIZE), SIZE)
    assert (found.ids == NOTHING).all() and found.depth.isinf().all()
    assert found.rgb.float().std() > 0  # the floor and the wall
    assert drawn(only(), at(), from_aside(SIZE), SIZE, rgb=False).rgb is None


def alike(a: Images, b: Images) -> None:
    for name in ("rgb", "depth", "ids"):
        assert torch.equal(getattr(a, name), getattr(b, name)), name


def test_the_same_scene_makes_the_same_bytes_with_any_number_of_threads():
    model, placement = mixed()
    first = drawn(model, placement, from_aside(SIZE), SIZE, looks=[random_look(3)])
    alike(first, drawn(model, placement, from_aside(SIZE), SIZE, looks=[random_look(3)]))
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        both = Placement(*(torch.cat([x, x]) for x in vars(placement).values()))
        again = drawn(model, both, from_aside(SIZE), SIZE, looks=[random_look(3)])
    finally:
        torch.set_num_threads(before)
    for k in range(2):
        alike(first, Images(*(x[k : k + 1] for x in vars(again).values())))


def test_a_batch_is_drawn_as_a_loop_is():
    model, one = mixed()
    scenes = [Placement(one.pos + 0.03 * k, one.turn, one.ropes - 0.02 * k, one.particles) for k in range(3)]
    looks = [random_look(k) for k in range(3)]
    eyes = [looking_at((0.9, 0.4 * k, 0.7), (0.0, 0.0, 0.0), size=SIZE) for k in range(2)]
    view = renderer.Pinhole(
        *(torch.stack([getattr(e, n) for e in eyes]) for n in ("intrinsics", "rotation", "translation"))
    )
    whole = drawn(
        model,
        Placement(*(torch.cat(x) for x in zip(*(vars(s).values() for s in scenes), strict=True))),
        view,
        SIZE,
        looks=looks,
    )
    assert whole.rgb.shape == (3, 2, *SIZE[::-1], 3) and whole.ids.shape == whole.depth.shape == (3, 2, *SIZE[::-1])
    for b, (scene, look) in enumerate(zip(scenes, looks, strict=True)):
        for c, eye in enumerate(eyes):
            own = drawn(model, scene, seen(eye), SIZE, looks=[look])
            # Errors of cameras are drawn per camera of a scene.
            if c == 0:
                alike(own, Images(*(x[b : b + 1, c : c + 1] for x in vars(whole).values())))


@pytest.mark.parametrize("samples", [1, 4])
@pytest.mark.parametrize("seed", [None, 0, 1, 2, 3, 4, 5])
def test_compiled_and_array_operations_draw_the_same(monkeypatch: pytest.MonkeyPatch, samples: int, seed: int | None):
    size, choices = (
        (64, 48),
        {"samples": samples, "looks": [Look() if seed is None else random_look(seed)], "shadow": 128},
    )
    model, placement = mixed()
    view = (
        from_aside(size) if seed != 1 else seen(looking_at((0.05, 0.05, 0.1), (0.3, 0.2, 0.1), size=size, opening=1.6))
    )
    fast = drawn(model, placement, view, size, **choices)
    monkeypatch.setattr(renderer, "_library", lambda: None)
    slow = drawn(model, placement, view, size, **choices)
    # Rounding may decide differently about a sample that is just at an edge.
    off = (fast.rgb.int() - slow.rgb.int()).abs().amax(-1).float()
    assert (off > 3).float().mean() < 2e-3 and off.mean() < 0.05
    assert (fast.ids != slow.ids).float().mean() < 2e-3
    same = (fast.ids == slow.ids) & slow.depth.isfinite()
    assert ((fast.depth - slow.depth)[same].abs() < 1e-4 * slow.depth[same]).float().mean() > 0.998


def test_four_samples_smooth_edges():
    model, placement = only(ball()), at((0.0, 0.0, 0.0))
    view, look = (
        from_aside(SIZE),
        Look(bodies=(Paint((1.0, 1.0, 1.0), gloss=0.0),), wall=((0, 0, 0),) * 2, floor=(0, 0, 0)),
    )
    one, four, many = (
        drawn(model, placement, from_aside(size) if size != SIZE else view, size, samples=s, looks=[look])
        .rgb[0, 0]
        .float()
        .mean(-1)
        for size, s in ((SIZE, 1), (SIZE, 4), ((640, 480), 4))
    )
    # Light adds up, not what the screen shows.
    one, four, many = (x.pow(2.2) for x in (one, four, many))
    truth = torch.nn.functional.avg_pool2d(many[None], 4)[0]
    # A pixel is off by a quarter of what it shows on average with one sample, by an eighth with two rows of them.
    rim = (truth > 0) & (torch.nn.functional.max_pool2d(-truth[None], 3, 1, 1)[0] == 0)
    assert (four - truth)[rim].abs().mean() < 0.6 * (one - truth)[rim].abs().mean()


def test_coarse_tubes_cover_what_fine_ones_do():
    model, placement = mixed()
    view = seen(looking_at((2.0, 1.0, 1.2), (0.0, 0.0, 0.0), size=SIZE))
    fine, coarse = (drawn(model, placement, view, SIZE, detail=d) for d in (False, True))
    assert (fine.ids != coarse.ids).float().mean() < 5e-3
    assert (fine.rgb.float() - coarse.rgb.float()).abs().mean() < 0.3


@pytest.mark.parametrize(
    ("choices", "said"),
    [
        ({"samples": 3}, "expected 1 or 4"),
        ({"size": (0, 10)}, "pixels"),
        ({"looks": [Look()] * 2}, "2 looks for 1 scenes"),
        ({"ropes": torch.zeros(1, 3, 3)}, "give a placement that was made with the model"),
    ],
)
def test_bad_input_is_named(choices: dict, said: str):
    model, placement = mixed()
    if "ropes" in choices:
        placement = Placement(placement.pos, placement.turn, choices.pop("ropes"), placement.particles)
    size = choices.pop("size", SIZE)
    with pytest.raises(InputError, match=said):
        render(model, placement, from_aside(SIZE), size, **choices)
