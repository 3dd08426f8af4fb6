"""Several rods in one scene, batches of scenes, storage, and compiled steps."""

from __future__ import annotations

import pytest
import torch
from helpers import F64, circle, effects, rand, run, straight, vec, wild

from torchdlo.physics import tree
from torchdlo.scene import Control, Rope, make, rollout, stationary_control, step, stepper

GIVEN = {"mass": 0.1, "bend": 1e-3, "twist": 1e-3, "stretch": 200.0, "radius": 0.02}
KINDS = {
    "explicit": ({"integrator": "explicit", "dt": 2e-3, "substeps": 2}, ["bend", "gravity", "damping"]),
    "implicit": ({"integrator": "implicit", "dt": 2e-3, "substeps": 1}, ["bend", "gravity", "damping"]),
    "explicit dynamic": (
        {"integrator": "explicit", "dt": 1e-3, "substeps": 1, "twist": "dynamic"},
        ["bend_frame", "twist", "gravity"],
    ),
    "implicit quasistatic": (
        {"integrator": "implicit", "dt": 2e-3, "substeps": 1, "twist": "quasistatic"},
        ["bend_frame", "twist", "gravity"],
    ),
}


def shapes(batch: tuple[int, ...] = ()) -> list[Rope]:
    """Open, closed, open; of different size, material and speed."""
    ring = circle(6, 0.2) + vec(0, 1, 0) + 0.02 * wild(6, 2, batch=batch)
    line = wild(7, 1, batch=batch, rough=0.04)
    bow = wild(5, 3, batch=batch, rough=0.04) + vec(0, 2, 0)
    return [
        Rope(line, **GIVEN),
        Rope(ring, closed=True, velocities=0.3 * wild(6, 5), **GIVEN | {"mass": 0.2}),
        Rope(bow, bend2=3e-3, **GIVEN | {"twist": 2e-3}),
    ]


def picked(ropes, kind):
    return [tree_free(r) if kind in ("explicit", "implicit") else r for r in ropes]


def tree_free(rope: Rope) -> Rope:
    """The same rope with one bending stiffness."""
    return Rope(
        rope.positions,
        closed=rope.closed,
        velocities=rope.velocities,
        **{**GIVEN, "mass": rope.mass, "bend": rope.bend},
    )


@pytest.mark.parametrize("kind", KINDS)
def test_ropes_in_one_scene_move_as_each_alone(kind):
    choices, names = KINDS[kind]
    ropes = picked(shapes(), kind)
    spun = choices.get("twist") == "quasistatic"  # else a free rod may spin as a whole
    scene, params, state = make(
        ropes, effects(*names), prescribed_vertices=(0, 8), prescribed_edges=(0, 7, 13) if spun else (), **choices
    )
    together, _ = run(scene, params, state, 60)
    start = 0
    for index, rope in enumerate(ropes):
        n = len(rope.positions)
        held = {0: (0,), 1: (1,), 2: ()}[index]
        alone, p, s = make(
            [rope], effects(*names), prescribed_vertices=held, prescribed_edges=(0,) if spun else (), **choices
        )
        s, _ = run(alone, p, s, 60)
        for field in ("pos", "vel", "twist"):
            a, b = getattr(together.rods, field)[start : start + n], getattr(s.rods, field)
            assert float((a - b).abs().max()) < 1e-10 * max(1.0, float(b.abs().max())), (index, field)
        start += n


@pytest.mark.parametrize("kind", KINDS)
def test_batches_move_as_each_scene_alone(kind):
    # Batch axes (2, 2); materials differ from scene to scene.
    choices, names = KINDS[kind]
    ropes = picked(shapes((2, 2)), kind)
    spun = choices.get("twist") == "quasistatic"
    scene, params, state = make(
        ropes, effects(*names), prescribed_vertices=(0,), prescribed_edges=(0, 7, 13) if spun else (), **choices
    )
    scale = rand(2, 2, 1, 1, seed=4, low=0.5, high=1.5)
    material = params.rods.material
    params = tree.replace(
        params, rods=tree.replace(params.rods, material=tree.replace(material, bend=material.bend * scale))
    )
    many, _ = run(scene, params, state, 40)
    for i in range(2):
        for j in range(2):

            def one(x, i=i, j=j):
                return x[i, j] if x.dim() == 4 else x

            single, _ = run(scene, tree.map(one, params), tree.map(one, state), 40)
            for a, b in zip(tree.leaves(many), tree.leaves(single), strict=True):
                size = max([1.0, *b.abs().flatten().tolist()])
                assert bool(((one(a) - b).abs() < 1e-10 * size).all())


def test_ropes_of_different_batch_share_one():
    # One rope for all scenes beside one that differs from scene to scene.
    scene, _, state = make(
        [Rope(straight(5), mass=0.1), Rope(wild(6, 1, batch=(3,)), mass=0.1)], effects("gravity"), dt=1e-3
    )
    assert state.rods.pos.shape == (3, 11, 3)
    state, _ = run(
        scene,
        *make([Rope(straight(5), mass=0.1), Rope(wild(6, 1, batch=(3,)), mass=0.1)], effects("gravity"), dt=1e-3)[1:],
        2,
    )
    assert state.rods.pos.shape == (3, 11, 3)


def innermost(x: torch.Tensor) -> bool:
    """Whether the batch axis of (B, V, C) is the one with stride 1."""
    return x.dim() < 3 or x.shape[0] == 1 or x.stride(0) == 1


@pytest.mark.parametrize("kind", KINDS)
def test_state_stays_batch_innermost_through_steps(kind):
    choices, names = KINDS[kind]
    ropes = [Rope(wild(6, 1, batch=(8,), rough=0.04), **GIVEN)]
    scene, params, state = make(ropes, effects(*names), prescribed_vertices=(0,), **choices)
    assert all(innermost(x) for x in (state.rods.pos, state.rods.director, state.rods.ref_twist))
    control = stationary_control(scene, state)
    for _ in range(2):
        state = step(scene, params, state, control)
    wrong = [
        f
        for f in state.rods.__dataclass_fields__
        if f != "memory" and getattr(state.rods, f).shape[0] == 8 and not innermost(getattr(state.rods, f))
    ]
    wrong += [name for name, kept in state.rods.memory.items() if not innermost(kept)]
    assert not wrong, wrong


@pytest.mark.compile
@pytest.mark.slow
def test_compiled_steps_equal_eager_ones():
    # The same operations reordered: 1e-12 of the positions after three steps; the batch stays innermost.
    choices, names = KINDS["explicit"]
    ropes = [Rope(wild(5, 1, batch=(8,), rough=0.04), **{k: v for k, v in GIVEN.items() if k != "twist"})]
    scene, params, state = make(ropes, effects(*names[:2]), prescribed_vertices=(0,), **choices)
    control = stationary_control(scene, state)
    found = {}
    for execution in ("eager", "compiled"):
        advance = stepper(scene, execution=execution)
        s = state
        with torch.no_grad():
            for _ in range(3):
                s = advance(params, s, control)
        assert innermost(s.rods.pos) and innermost(s.rods.vel)
        found[execution] = s.rods.pos
    assert float((found["compiled"] - found["eager"]).abs().max()) < 1e-12


@pytest.mark.parametrize("kind", ["explicit", "implicit"])
def test_single_precision_follows_double(kind):
    # float32 in, float32 out; 20 steps agree to 1e-4 of the size.
    choices, names = KINDS[kind]
    found = {}
    for dtype in (torch.float32, F64):
        x = wild(6, 1, rough=0.04).to(dtype)
        scene, params, state = make([Rope(x, **GIVEN)], effects(*names), prescribed_vertices=(0,), **choices)
        assert all(leaf.dtype == dtype for leaf in tree.leaves((params, state)))
        state, _ = run(scene, params, state, 20)
        assert all(leaf.dtype == dtype for leaf in tree.leaves(state))
        found[dtype] = state.rods.pos.double()
    assert float((found[torch.float32] - found[F64]).abs().max()) < 1e-4


def test_shared_controls_drive_every_scene_of_a_batch():
    # A control without batch axes holds all scenes of a batch, frames included.
    ropes = [Rope(wild(6, 1, batch=(3,), rough=0.02), **GIVEN)]
    scene, params, state = make(
        ropes, effects("bend_frame", "twist"), prescribed_vertices=(0,), prescribed_edges=(0,), twist="dynamic", dt=1e-3
    )
    control = Control(vec(0, 0, 0)[None], vec(0, 0, 1)[None])
    state = step(scene, params, state, control)
    assert float(state.rods.pos[:, 0].abs().max()) == 0


def test_rollout_keeps_what_is_asked_for():
    scene, params, state = make([Rope(straight(5), mass=0.1)], effects("gravity"), dt=1e-3)
    controls = tree.map(lambda x: x.expand(4, *x.shape), stationary_control(scene, state))
    last, kept = rollout(lambda *a: step(scene, *a), params, state, controls, keep=lambda s: {"z": s.rods.pos[..., 2]})
    assert kept["z"].shape == (4, 5)
    assert torch.equal(kept["z"][-1], last.rods.pos[..., 2])
