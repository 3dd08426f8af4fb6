"""Pictures and videos: surfaces have the shape that the physics has, and what moves is seen to move."""

from __future__ import annotations

import ctypes.util
import io
import math
import os
import sys

import numpy as np
import pytest
import torch

from torchdlo.coupling.bodies import shape_sdf
from torchdlo.errors import InputError
from torchdlo.report.render import run_surfaces
from torchdlo.scene_files import (
    Attachment,
    BodySpec,
    GridSpec,
    HangingMass,
    Keyframe,
    ParticleBlockSpec,
    RopeSpec,
    SceneDescription,
)
from torchdlo.scene_files.run import run

SIZES = {
    "sphere": (0.3,),
    "box": (0.1, 0.2, 0.3),
    "capsule": (0.1, 0.3),
    "cylinder": (0.2, 0.1),
    "cone": (0.2, 0.5),
    "torus": (0.3, 0.1),
    "ring": (0.3, 0.05, 4.0),
}


def enclosed(corners: np.ndarray, faces: np.ndarray) -> tuple[float, np.ndarray]:
    """Volume and centre of what triangles enclose, by the divergence theorem; negative if they look inwards."""
    a, b, c = (corners[faces[:, k]] for k in range(3))
    parts = (a * np.cross(b, c)).sum(1) / 6
    return float(parts.sum()), ((a + b + c) / 4 * parts[:, None]).sum(0) / parts.sum()


@pytest.mark.parametrize("shape", SIZES)
def test_surfaces_enclose_the_volume_of_the_solid_about_its_centre_of_mass(shape):
    size = np.ones(3)
    size[: len(SIZES[shape])] = SIZES[shape]
    volume, centre = enclosed(*run_surfaces._solid(shape, size, 1.0))
    wanted = float(shape_sdf.bulk(shape, torch.as_tensor(size))[0])
    # A polygon of n corners in a circle lacks 1 - sin(2 pi / n) n / (2 pi) of its area. Rings have 16 corners round the
    # tube, other shapes 24 along an arc at least.
    corners = 16 if shape == "ring" else 24
    lacking = 0.0 if shape == "box" else 2 * (1 - math.sin(2 * math.pi / corners) * corners / (2 * math.pi))
    assert wanted * (1 - lacking) - 1e-12 <= volume <= wanted * (1 + 1e-9)
    # What lacks of a ring lies along its arc, not only at its ends.
    assert np.abs(centre).max() < (lacking * 0.3 if shape == "ring" else 1e-9)


def scene(**fields) -> SceneDescription:
    rope = RopeSpec(((0.0, 0.0, 0.5), (0.4, 0.0, 0.5)), vertices=9, radius=0.01, mass=0.03, bend=1e-3)
    plain = {"ropes": (rope,), "effects": {"bend": {}}, "duration": 0.02, "camera_direction": (0.0, -1.0, 0.0)}
    return SceneDescription(**plain | fields)


def test_tubes_lie_round_their_ropes_and_are_closed():
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    ring = tuple(map(tuple, np.stack([0.2 * np.cos(angle), 0.2 * np.sin(angle), 0 * angle], 1).tolist()))
    frames = run(scene(ropes=(scene().ropes[0], RopeSpec(ring, closed=True, radius=0.01, mass=0.01, bend=1e-3))))
    straight, round_ = run_surfaces.pieces(frames)
    corners = straight.at(frames, 0)
    rings = corners[:-2]
    assert np.abs(np.hypot(rings[:, 1], rings[:, 2] - 0.5) - 0.01).max() < 1e-9
    area = 8 * math.sin(math.pi / 8) * 0.01**2  # of a polygon of 16 corners
    assert enclosed(corners, straight.faces)[0] == pytest.approx(area * 0.4, rel=1e-6)
    # Pappus: area times the way of its middle. A cubic spline through 24 points of a circle is off by h^4.
    assert enclosed(round_.at(frames, 0), round_.faces)[0] == pytest.approx(
        area * 2 * math.pi * 0.2, rel=(math.pi / 12) ** 4
    )


def test_the_camera_is_fitted_to_what_moves_and_not_to_large_bodies_that_stand():
    bodies = (
        BodySpec("box", (5.0, 5.0, 0.1), pos=(0.0, 0.0, -0.1), motion="fixed"),
        BodySpec(
            "sphere",
            (0.05,),
            pos=(0.9, 0.0, 0.5),
            motion="kinematic",
            keyframes=(Keyframe(0.02, move=(0.1, 0.0, 0.0)),),
        ),
    )
    low, high = run_surfaces.bounds(run(scene(bodies=bodies)))
    assert low[0] == pytest.approx(0.0, abs=1e-6) and high[0] == pytest.approx(1.05, abs=1e-6)


@pytest.fixture(scope="module")
def drawing():
    pytest.importorskip("pyvista", reason="pictures need the extra view")
    if not any(map(ctypes.util.find_library, ("EGL", "OSMesa"))) and not os.environ.get("DISPLAY"):
        pytest.skip("pictures need libEGL, libOSMesa or a display")
    from torchdlo.report.render import picture as render

    return render


def drawn(image: np.ndarray) -> np.ndarray:
    """Which pixels are not of the grey background, shape (H, W)."""
    return image.max(-1).astype(int) - image.min(-1) > 60


def test_a_picture_shows_each_part_where_it_is(drawing):
    bodies = (
        BodySpec(
            "sphere",
            (0.05,),
            pos=(0.2, 0.0, 0.2),
            motion="kinematic",
            keyframes=(Keyframe(0.02, move=(0.2, 0.0, 0.0)),),
        ),
    )
    material_points = (ParticleBlockSpec("liquid", (0.04,), 0.01, "ball", (0.0, 0.0, 0.0)),)
    box = GridSpec((-0.2, -0.2, -0.2), (0.2, 0.2, 0.2), 0.02)
    frames = run(
        scene(
            bodies=bodies,
            material_points=material_points,
            box=box,
            attachments=(Attachment((0, -1)),),
            effects={"bend": {}},
        )
    )
    with drawing.Picture(frames, size=(320, 240)) as picture:
        first, last = picture.image(0), picture.image(len(frames.time) - 1)
        again = picture.image(0)
    assert first.shape == (240, 320, 3) and np.array_equal(first, again)
    red, blue = (first[..., k].astype(int) for k in (0, 2))
    rope, water = red - blue > 60, blue - red > 60
    # Straight ahead, x is to the right and z up: the rope, 0.4 m wide, is above the water, which is at its left end.
    rows, columns = np.nonzero(rope)
    below, left = np.nonzero(water)
    assert rows.max() < below.min() and np.ptp(columns) > 3 * np.ptp(left) > 0
    assert abs(left.mean() - columns.min()) < 0.1 * np.ptp(columns)
    # Between frames only the ball moves, by half the length of the rope to the right.
    moved = np.abs(first.astype(int) - last).max(-1)[: 240 - 30] > 30
    assert moved.any() and np.nonzero(moved)[1].max() > columns.mean()


def test_a_rope_that_turns_is_lit_as_well_as_before(drawing):
    # Half a turn about z shows the same line again: with the shading of its other side it would be dark.
    turn = Attachment((0, 1), keyframes=(Keyframe(0.06, move=(0.4, 0.0, 0.0), turn=(0.0, 0.0, 3.1415926)),))
    rope = RopeSpec(((0.0, 0.0, 0.5), (0.4, 0.0, 0.5)), vertices=3, radius=0.02, mass=0.03, bend=1e-3)
    frames = run(
        scene(
            ropes=(rope,),
            attachments=(turn, Attachment((2,), keyframes=(Keyframe(0.06, move=(-0.4, 0.0, 0.0)),))),
            duration=0.06,
        )
    )
    with drawing.Picture(frames, size=(160, 120)) as picture:
        first, last = picture.image(0), picture.image(len(frames.time) - 1)
    light = [x[drawn(x)].mean() for x in (first, last)]
    assert drawn(last).sum() > 100 and abs(light[1] / light[0] - 1) < 0.1


def test_stills_stand_side_by_side(drawing):
    from matplotlib import image

    frames = run(
        scene(
            ropes=(
                RopeSpec(
                    scene().ropes[0].points, vertices=5, mass=0.03, bend=1e-3, hanging_masses=(HangingMass(-1, 0.1),)
                ),
            )
        )
    )
    content = drawing.stills_png(frames, [0.0, 0.02], size=(160, 120))
    assert content[:4] == b"\x89PNG" and b"torchdlo" in content[:4096]
    assert image.imread(io.BytesIO(content)).shape[:2] == (120, 320)


def test_a_video_has_a_picture_for_every_thirtieth_of_a_second(drawing, tmp_path):
    av = pytest.importorskip("av", reason="videos need the extra view")
    from torchdlo.report.render import video_writer

    frames = run(scene(effects={"gravity": {}, "bend": {}}, attachments=(Attachment((0,)),), duration=0.1))
    seen = []
    path = tmp_path / "motion.mp4"
    video_writer.write_video(frames, path, speed=0.5, size=(160, 120), callback=lambda *a: seen.append(a))
    with av.open(str(path)) as file:
        images = [x.to_ndarray(format="rgb24") for x in file.decode(video=0)]
    # 0.1 s at half speed: pictures at 0, 1/30, ..., 6/30 s.
    assert len(images) == 7 and images[0].shape == (120, 160, 3)
    assert [a[:3] for a in seen] == [("video", k + 1, 7) for k in range(7)]
    # The rope falls: its free end, to the right, is lower in the last picture.
    ends = [np.nonzero(drawn(x)[:100])[0].max() for x in (images[0], images[-1])]
    assert ends[1] > ends[0] + 5
    video_writer.check_video(path)
    path.write_bytes(b"\x00\x00\x00\x20ftypisom of somebody else")
    with pytest.raises(InputError, match="was not written by torchdlo"):
        video_writer.check_video(path)


def test_a_video_that_is_stopped_leaves_nothing(drawing, tmp_path):
    pytest.importorskip("av", reason="videos need the extra view")
    from torchdlo.report.render import video_writer

    def stop(*_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        video_writer.write_video(run(scene()), tmp_path / "motion.mp4", size=(160, 120), callback=stop)
    assert not list(tmp_path.iterdir())
    with pytest.raises(InputError, match="speed: expected a number above 0"):
        video_writer.write_video(run(scene()), tmp_path / "motion.mp4", speed=0.0)


@pytest.mark.parametrize(("name", "what"), [("pyvista", "pictures"), ("av", "videos"), ("viser", "viewer")])
def test_a_missing_package_is_named(name, what, monkeypatch, tmp_path):
    from torchdlo.report.render import picture as render
    from torchdlo.report.render import video_writer
    from torchdlo.report.viewer import server as view

    monkeypatch.setitem(sys.modules, name, None)
    calls = {
        "pyvista": render.check_renderer,
        "av": lambda: video_writer.check_video(tmp_path / "a"),
        "viser": view._check_viser,
    }
    with pytest.raises(InputError, match=rf"{what}.* needs? the package {name}; install it with .*torchdlo\[view\]"):
        calls[name]()


def test_a_machine_that_cannot_draw_is_told_what_to_install(drawing, monkeypatch):
    monkeypatch.setattr(ctypes.util, "find_library", lambda name: None)
    monkeypatch.delenv("DISPLAY", raising=False)
    with pytest.raises(InputError, match=r"libEGL or libOSMesa, .* apt install"):
        drawing.check_renderer()
