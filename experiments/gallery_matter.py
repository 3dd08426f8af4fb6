"""Scenes of the gallery with ropes and matter."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from gallery_parts import HUGE, Claims, circle

if TYPE_CHECKING:
    from torchdlo.scene_files import SceneDescription
    from torchdlo.scene_files.run import Frames


def net(quick: bool) -> SceneDescription:
    """Crossed ropes, held at their ends, catch an elastic ball."""
    from torchdlo.scene_files import Attachment, GridSpec, ParticleBlockSpec, RopeSpec, SceneDescription

    count, half, r = 15 if quick else 19, 0.12, 4e-3
    places = (-0.045, -0.015, 0.015, 0.045)
    given = {"vertices": count, "radius": r, "density": 1100.0, "bend": 2e-5, "stretch": 60.0}
    ropes = [RopeSpec(((-half, y, 0.0), (half, y, 0.0)), **given) for y in places]
    ropes += [RopeSpec(((x, -half, 2.2 * r), (x, half, 2.2 * r)), **given) for x in places]
    ball = ParticleBlockSpec(
        "elastic",
        (0.04,),
        0.008 if quick else 0.0065,
        "ball",
        (0.0, 0.0, 0.07),
        (0.0, 0.0, -1.0),
        {"youngs": 3e4, "density": 600.0},
    )
    low, high = (-0.13, -0.13, -0.12), (0.13, 0.13, 0.16)
    return SceneDescription(
        ropes=tuple(ropes),
        effects={
            "gravity": {},
            "bend": {},
            "damping": {"rate": 4.0},
            "rod_contact": {"mu_s": 0.3, "mu_k": 0.3},
            "rod_mpm_coupling": {},
        },
        attachments=tuple(Attachment((0, -1), rope=k) for k in range(len(ropes))),
        material_points=(ball,),
        box=GridSpec(low, high, 0.01, ("open",) * 6, window=(16, 16, 16)),
        duration=0.25,
        substeps=5,
        precision="float32",
        camera_direction=(0.6, -1.0, 0.45),
    )


def net_claims(frames: Frames, d: SceneDescription) -> Claims:
    """The ball is stopped, stays above the net in its middle, and keeps its shape."""
    import numpy as np

    centre = frames.material_points.mean(1)
    size = [float(np.ptp(frames.material_points[k], axis=0).max()) / 0.08 for k in (0, -1)]
    speed = np.gradient(centre[:, 2], frames.time)
    return {
        "lowest height of the ball's middle [m]": (float(centre[:, 2].min()), -0.06, 0.06),
        "greatest speed upwards after the catch over that of the fall": (float(speed.max()), 0.0, 1.0),
        "distance from the middle [m]": (float(np.linalg.norm(centre[-1, :2])), 0.0, 0.015),
        "size at the end over that at the start": (size[1] / size[0], 0.8, 1.25),
    }


def pour(quick: bool) -> SceneDescription:
    """A floating ring on which more water is poured."""
    from torchdlo.scene_files import GridSpec, ParticleBlockSpec, RopeSpec, SceneDescription

    step = 0.008 if quick else 0.006
    water = {"bulk": 2e4, "viscosity": 0.05}
    pool = ParticleBlockSpec("liquid", (0.1, 0.1, 0.025), step, "box", (0.0, 0.0, 0.025), parameters=water)
    jet = ParticleBlockSpec("liquid", (0.02, 0.02, 0.03), step, "box", (0.0, 0.0, 0.125), (0.0, 0.0, -0.5), water)
    ring = circle(32, 0.05, (0.0, 0.0, 0.058))
    return SceneDescription(
        ropes=(RopeSpec(ring, vertices=24, radius=6e-3, density=400.0, bend=1e-3, closed=True, rest="as_placed"),),
        effects={"gravity": {}, "bend_frame": {}, "damping": {"rate": 1.0}, "rod_mpm_coupling": {}},
        material_points=(pool, jet),
        box=GridSpec((-0.1, -0.1, 0.0), (0.1, 0.1, 0.1875), 0.0125),
        duration=0.5,
        substeps=3,
        precision="float32",
        camera_direction=(0.5, -1.0, 0.6),
    )


def pour_claims(frames: Frames, d: SceneDescription) -> Claims:
    """The ring floats all the time, stays level within reason, and the water stays in its box."""
    import numpy as np

    height = frames.pos[:, :, 2].mean(1)
    surface = float(np.percentile(frames.material_points[-1, :, 2], 98))
    late = frames.time > 0.35
    return {
        "lowest mean height of the ring [m]": (float(height.min()), 0.04, HUGE),
        "ring above the surface at the end [m]": (float(height[-1]) - surface, -0.01, 0.03),
        "tilt at the end [m]": (float(np.ptp(frames.pos[late, :, 2].mean(0))), 0.0, 0.03),
        "share of the water inside the box": (
            float((np.abs(frames.material_points[-1, :, :2]) <= 0.101).all(-1).mean()),
            0.999,
            1.0,
        ),
    }


def sand(quick: bool) -> SceneDescription:
    """Sand falls on a slack rope: some stays on it for a moment, most runs off and heaps up below."""
    from torchdlo.scene_files import Attachment, GridSpec, ParticleBlockSpec, RopeSpec, SceneDescription

    count = 20 if quick else 25
    line = tuple((-0.13 + 0.26 * k / 24, 0.0, 0.1 - 0.025 * math.sin(math.pi * k / 24)) for k in range(25))
    heap = ParticleBlockSpec(
        "sand",
        (0.045, 0.02, 0.03),
        0.0065 if quick else 0.005,
        "box",
        (0.0, 0.0, 0.14),
        parameters={"youngs": 3e4, "density": 1600.0},
    )
    return SceneDescription(
        ropes=(RopeSpec(line, vertices=count, radius=6e-3, density=1000.0, bend=1e-4),),
        effects={"gravity": {}, "bend": {}, "damping": {"rate": 2.0}, "rod_mpm_coupling": {"mu": 0.5}},
        attachments=(Attachment((0, -1)),),
        material_points=(heap,),
        box=GridSpec((-0.14, -0.07, 0.0), (0.14, 0.07, 0.18), 0.01),
        duration=0.4,
        substeps=3,
        precision="float32",
        camera_direction=(0.4, -1.0, 0.35),
    )


def sand_claims(frames: Frames, d: SceneDescription) -> Claims:
    """It pushes the rope down, runs off on both sides, and heaps up on the ground without going through it."""
    import numpy as np

    middle = frames.pos[:, frames.pos.shape[1] // 2, 2]
    last = frames.material_points[-1]
    return {
        "sag of the rope by the sand [m]": (float(middle[0] - middle.min()), 0.001, 0.1),
        "share of the sand below the rope at the end": (float((last[:, 2] < 0.05).mean()), 0.6, 1.0),
        "sand on the one side over that on the other": (
            float((last[:, 1] > 0).sum() / max(1, (last[:, 1] < 0).sum())),
            0.8,
            1.25,
        ),
        "lowest grain [m]": (float(last[:, 2].min()), -0.005, HUGE),
        "height of the heap [m]": (float(np.percentile(last[:, 2], 50)), 0.002, 0.05),
    }
