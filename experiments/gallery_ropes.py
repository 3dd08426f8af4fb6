"""Scenes of the gallery with ropes, robots and bodies."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from gallery_parts import HUGE, Claims, circle, closest, linking, loop, rope_of

if TYPE_CHECKING:
    from torchdlo.scene_files import SceneDescription
    from torchdlo.scene_files.run import Frames


def knot(quick: bool) -> SceneDescription:
    """An overhand knot whose ends are pulled apart; the curve is the long trefoil of Shastri 1992."""
    import numpy as np

    from torchdlo.scene_files import Attachment, Keyframe, RopeSpec, SceneDescription

    t = np.linspace(-2.15, 2.15, 2001)
    x = 0.02 * np.stack([t**3 - 3 * t, t**4 - 4 * t**2, 0.35 * (t**5 - 10 * t)], 1)
    ends = [x[0] - x[1], x[-1] - x[-2]]
    u = np.linspace(0, 0.06, 200)[1:, None]
    x = np.concatenate(
        [x[0] + ends[0] / np.linalg.norm(ends[0]) * u[::-1], x, x[-1] + ends[1] / np.linalg.norm(ends[1]) * u]
    )
    # Its ends lie on a line that is turned to x.
    axis = (x[-1] - x[0]) / np.linalg.norm(x[-1] - x[0])
    side = np.cross(axis, [0.0, 0.0, 1.0])
    side /= np.linalg.norm(side)
    x = (x - x.mean(0)) @ np.stack([axis, side, np.cross(axis, side)], 1)
    rope = RopeSpec(
        tuple(map(tuple, x.tolist())), vertices=61 if quick else 81, radius=3e-3, density=1000.0, bend=1.26e-4
    )
    far = 0.16
    return SceneDescription(
        ropes=(rope,),
        effects={"bend": {}, "damping": {"rate": 8.0}, "rod_contact": {"mu_s": 0.2, "mu_k": 0.2, "burst": 2.0}},
        attachments=tuple(
            Attachment((end,), keyframes=(Keyframe(0.6, move=(sign * far, 0, 0)),)) for end, sign in ((0, -1), (-1, 1))
        ),
        duration=0.7,
        substeps=4,
        camera_direction=(0.15, -1.0, 0.5),
    )


def knot_claims(frames: Frames, d: SceneDescription) -> Claims:
    """Strands touch and do not pass through each other, and the knot takes up length."""
    import numpy as np

    first, last = frames.pos[0], frames.pos[-1]
    length = float(np.linalg.norm(np.diff(first, axis=0), axis=1).sum())
    taken = [length - float(np.linalg.norm(x[-1] - x[0])) for x in (first, last)]
    near = [closest(x, x, apart=6) / 6e-3 for x in frames.pos]
    return {
        "least distance of strands over the diameter": (min(near), 0.9, HUGE),
        "the same at the end": (near[-1], 0.9, 1.1),
        "length in the knot at the end over that at the start": (taken[1] / taken[0], 0.05, 0.6),
        "length in the knot at the end over the diameter": (taken[1] / 6e-3, 4.0, HUGE),
    }


def chain(quick: bool) -> SceneDescription:
    """Two linked loops; the upper one is held at one place, the lower one falls into it."""
    from torchdlo.scene_files import Attachment, RopeSpec, SceneDescription

    count = 20 if quick else 28
    given = {"radius": 3e-3, "density": 2000.0, "bend": 5e-4, "closed": True, "rest": "as_placed"}
    upper = circle(count, 0.05, (0.0, 0.0, 0.0), "xz", math.pi / 2)
    lower = circle(count, 0.05, (0.0, 0.0, -0.07), "yz", math.pi / 2)
    return SceneDescription(
        ropes=(RopeSpec(upper, **given), RopeSpec(lower, **given)),
        effects={"gravity": {}, "bend_frame": {}, "damping": {"rate": 2.0}, "rod_contact": {"mu_s": 0.2, "mu_k": 0.2}},
        attachments=(Attachment((0,)),),
        duration=0.6,
        substeps=8,
        camera_direction=(0.9, -1.0, 0.3),
    )


def chain_claims(frames: Frames, d: SceneDescription) -> Claims:
    """They stay linked, never pass through each other, and the holder bears the weight of both."""
    import numpy as np

    pairs = [(rope_of(frames, 0, k), rope_of(frames, 1, k)) for k in range(len(frames.time))]
    links = [abs(linking(a, b)) for a, b in pairs]
    near = [closest(loop(a), loop(b)) / 6e-3 for a, b in pairs]
    length = sum(float(np.linalg.norm(np.diff(loop(x), axis=0), axis=1).sum()) for x in pairs[0])
    weight = length * math.pi * 9e-6 * 2000.0 * 9.81
    late = frames.time > 0.4
    return {
        "least linking number": (min(links), 0.999, 1.001),
        "greatest linking number": (max(links), 0.999, 1.001),
        "least distance over the diameter": (min(near), 0.9, HUGE),
        "the same at the end": (near[-1], 0.9, 1.1),
        "force of the hold over the weight, mean": (float(frames.force[late, 0, 2].mean()) / weight, 0.7, 1.3),
    }


def plug(quick: bool) -> SceneDescription:
    """A cable that is held at its top, a plug welded to its end, and a ball on a thread that is jointed to the plug."""
    from torchdlo.scene_files import Attachment, BodySpec, JointSpec, RopeSpec, SceneDescription

    count = 9 if quick else 15
    cable = RopeSpec(((0, 0, 0), (0.24, 0, -0.07)), vertices=count, radius=4e-3, mass=0.01, bend=2e-3)
    thread = RopeSpec(((0.2976, 0, -0.0868), (0.37, 0, -0.108)), vertices=6, radius=1.5e-3, mass=5e-4, bend=1e-6)
    # Its axis lies along the cable.
    half = 0.5 * math.atan2(0.24, 0.07)
    return SceneDescription(
        ropes=(cable, thread),
        effects={"gravity": {}, "bend": {}, "damping": {"rate": 2.5}},
        bodies=(
            BodySpec(
                "cylinder", (0.014, 0.03), (0.2688, 0, -0.0784), (math.cos(half), 0, -math.sin(half), 0), mass=0.05,
                damping=2.5,
            ),
            BodySpec("sphere", (0.012,), (0.3815, 0, -0.1114), mass=0.02, damping=2.5),
        ),
        attachments=(Attachment((0,)),),
        joints=(JointSpec(body=0), JointSpec(1, 0, body=0, kind="ball"), JointSpec(1, body=1, kind="ball")),
        duration=2.0,
        dt=4e-3,
        substeps=1,
        integrator="implicit",
        camera_direction=(0.2, -1.0, 0.2),
    )  # fmt: skip


def plug_claims(frames: Frames, d: SceneDescription) -> Claims:
    """At the end the joints bear what hangs on them, and the cable leaves the plug along its axis all the time."""
    import numpy as np

    late = frames.time > 1.2
    weights = [9.81 * m for m in (0.0705, 0.0205, 0.02)]
    borne = [-float(frames.joint_force[late, k, 2].mean()) for k in range(3)]
    end = rope_of(frames, 0)[-1] - rope_of(frames, 0)[-2]
    w, x, y, z = frames.body_quat[-1, 0]
    axis = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
    off = math.acos(min(1.0, abs(float(end @ axis)) / float(np.linalg.norm(end))))
    return {
        "force of the weld over the weight below": (borne[0] / weights[0], 0.98, 1.02),
        "force of the joint of the thread, the same": (-borne[1] / weights[1], 0.98, 1.02),
        "force of the joint of the ball, the same": (borne[2] / weights[2], 0.98, 1.02),
        "angle between cable and plug [rad]": (off, 0.0, 1e-6),
    }


def gripper(quick: bool) -> SceneDescription:
    """An arm reaches down, grips a rope on a table, and lifts it."""
    from torchdlo.scene_files import Attachment, Keyframe, RobotSpec, RopeSpec, SceneDescription

    count = 31 if quick else 41
    middle = count // 2
    arm = RobotSpec(
        base=(-0.5, 0.0, 0.0),
        joints=(0.0, 0.2, 0.0, -2.2, 0.0, 2.4, -0.785, 0.007),
        pos=(0.0, 0.0, 0.16),
        # Its pads are across the rope.
        quat=(0.0, math.sqrt(0.5), math.sqrt(0.5), 0.0),
        keyframes=(
            Keyframe(0.6, move=(0, 0, -0.154)),
            Keyframe(0.8, move=(0, 0, -0.154)),
            Keyframe(2.0, move=(0, 0, 0.06)),
        ),
    )
    return SceneDescription(
        ropes=(RopeSpec(((0.0, -0.35, 0.006), (0.0, 0.35, 0.006)), vertices=count, radius=6e-3, mass=0.08, bend=2e-3),),
        effects={
            "gravity": {},
            "bend": {},
            "damping": {"rate": 2.0},
            "table": {"height": 0.0},
            "table_friction": {"mu": 0.4, "height": 0.0},
        },
        robots=(arm,),
        attachments=(Attachment((middle - 1, middle, middle + 1), robot=0, close=0.7),),
        duration=2.2,
        dt=2e-3,
        substeps=1,
        integrator="implicit",
        camera_direction=(0.9, -0.75, 0.45),
    )


def gripper_claims(frames: Frames, d: SceneDescription) -> Claims:
    """The middle goes up with the tool, the ends stay on the table, and the tool bears what is off the table.

    Without stiffness it bears all of that. A stiff beam that is flat in the tool and leaves the table without moment
    presses there with a third of it (E I y'''' = -w; y' = 0 in the tool, y = y' = y'' = 0 at the table).
    """
    import numpy as np

    last = frames.pos[-1]
    middle, radius = len(last) // 2, frames.radius[0]
    free = frames.pos[frames.time < 0.7, :, 2]
    lifted = int(np.sum(last[:, 2] > 1.1 * radius))
    share = float(frames.force[-1, :, 2].sum()) / (d.ropes[0].mass * 9.81 * lifted / len(last))
    # On each side up to one vertex may be counted wrongly.
    slack = 2 / lifted
    return {
        "height of the middle at the end [m]": (float(last[middle, 2]), 0.219, 0.221),
        "height of the ends at the end over the radius": (float(max(last[0, 2], last[-1, 2])) / radius, 0.9, 1.1),
        "greatest height before the grip over the radius": (float(free.max()) / radius, 0.9, 1.01),
        "force of the tool over the weight of what is off the table": (share, 2 / 3 - slack, 1 + slack),
    }


def pulley(quick: bool) -> SceneDescription:
    """A smooth rope over a smooth pulley, with 40 g on one side and 60 g on the other."""
    from torchdlo.scene_files import BodySpec, HangingMass, RopeSpec, SceneDescription

    radius, r, side, count = 0.05, 3e-3, 0.2, 48 if quick else 56
    edge = (2 * side + math.pi * (radius + r)) / count
    # Chords of the arc touch the pulley in their middles.
    wide = radius + r + edge**2 / (8 * (radius + r))
    angles = [math.pi * k / 64 for k in range(65)]
    top = [(-wide * math.cos(a), 0.0, wide * math.sin(a)) for a in angles]
    points = ((-wide, 0.0, -side), *top, (wide, 0.0, -side))
    weights = (HangingMass(0, 0.04), HangingMass(-1, 0.06))
    half = math.sqrt(0.5)
    return SceneDescription(
        ropes=(RopeSpec(points, vertices=count, radius=r, mass=0.02, bend=1e-4, hanging_masses=weights),),
        effects={"gravity": {}, "bend": {}, "rod_body": {}},
        bodies=(BodySpec("cylinder", (radius, 0.03), quat=(half, half, 0.0, 0.0), motion="fixed", mu_s=0.0, mu_k=0.0),),
        duration=0.3,
        substeps=4,
        camera_direction=(0.35, -1.0, 0.15),
    )


def pulley_claims(frames: Frames, d: SceneDescription) -> Claims:
    """The heavier side sinks as Atwood's machine does, with the weight of the rope.

    M x'' = g (m2 - m1 + 2 l x), l the rope's mass per length: x = (m2 - m1) / (2 l) (cosh(k t) - 1), k^2 = 2 l g / M.
    """
    import numpy as np

    heavy, light = frames.pos[:, -1, 2], frames.pos[:, 0, 2]
    line = 0.02 / float(np.linalg.norm(np.diff(frames.pos[0], axis=0), axis=1).sum())
    k = math.sqrt(2 * line * 9.81 / 0.12)
    wanted = 0.02 / (2 * line) * (math.cosh(k * frames.time[-1]) - 1)
    fell, rose = float(heavy[0] - heavy[-1]), float(light[-1] - light[0])
    distance = np.hypot(frames.pos[..., 0], frames.pos[..., 2]).min()
    return {
        "way of the two sides, their mean, over that of Atwood's machine": (0.5 * (fell + rose) / wanted, 0.95, 1.05),
        "way of the lighter side over that of the heavier one": (rose / fell, 0.95, 1.05),
        "least distance from the axis over both radii": (float(distance) / 0.053, 0.98, HUGE),
    }


def wire(quick: bool) -> SceneDescription:
    """A wire is bent over a post by its ends and let go: it springs back a little, and keeps the rest."""
    from torchdlo.scene_files import Attachment, BodySpec, Keyframe, RopeSpec, SceneDescription

    half, length, round_ = math.sqrt(0.5), 0.15, 0.0222

    def end(angle: float, slack: float) -> tuple[float, float]:
        """Where a wire ends that lies on the post up to an angle from its top, and is straight from there."""
        s = length - round_ * angle - slack
        return round_ * math.sin(angle) + s * math.cos(angle), round_ * math.cos(angle) - s * math.sin(angle)

    # It starts bent a little: a straight line between two holds cannot give way.
    bow = [math.radians(a) for a in range(-10, 11, 2)]
    x, z = end(bow[-1], 0.0)
    line = ((-x, 0.0, z), *((round_ * math.sin(a), 0.0, round_ * math.cos(a)) for a in bow), (x, 0.0, z))
    goals = [(0.05 * k, *end(math.radians(10.0 + 5.0 * k), 1e-3)) for k in range(1, 11)]
    way, other = (tuple(Keyframe(t, move=(sign * (x - u), 0.0, w - z)) for t, u, w in goals) for sign in (1, -1))
    return SceneDescription(
        ropes=(RopeSpec(line, vertices=31 if quick else 41, radius=2e-3, mass=0.02, bend=5e-4),),
        effects={
            "gravity": {},
            "bend_frame": {},
            "damping": {"rate": 10.0},
            "bending_plasticity": {"yield_curvature": 8.0, "rate": 200.0, "hardening": 0.05},
            "rod_body": {},
        },
        bodies=(BodySpec("cylinder", (0.02, 0.03), quat=(half, half, 0.0, 0.0), motion="fixed"),),
        attachments=(
            Attachment((0,), keyframes=way, path="linear", release=0.6),
            Attachment((-1,), keyframes=other, path="linear", release=0.6),
        ),
        duration=1.0,
        substeps=6,
        camera_direction=(0.35, -1.0, 0.3),
    )


def bent_by(x: Any) -> float:
    """Angle between the first and the last tenth of a line [deg]."""
    n = max(1, len(x) // 10)
    a, b = x[n] - x[0], x[-1] - x[-1 - n]
    return math.degrees(math.acos(float(a @ b) / math.sqrt(float(a @ a) * float(b @ b))))


def wire_claims(frames: Frames, d: SceneDescription) -> Claims:
    """Springback takes the elastic part of the bend, and no more."""
    angle = [bent_by(x) for x in frames.pos]
    held = max(angle[k] for k in range(len(angle)) if frames.time[k] <= 0.6)
    return {
        "bend while it is held [deg]": (held, 60.0, 180.0),
        "bend that it keeps over that": (angle[-1] / held, 0.3, 0.98),
        "change in the last tenth of a second [deg]": (abs(angle[-1] - angle[-11]), 0.0, 3.0),
    }


def band(quick: bool) -> SceneDescription:
    """A rubber band round three posts that move apart."""
    from torchdlo.scene_files import BodySpec, Keyframe, RopeSpec, SceneDescription

    post, r, start = 0.012, 2e-3, 0.03
    corners = circle(3, start, (0.0, 0.0, 0.0), turn=math.pi / 2)
    bodies = tuple(
        BodySpec(
            "cylinder",
            (post, 0.03),
            pos=at,
            motion="kinematic",
            mu_s=0.05,
            mu_k=0.05,
            keyframes=(Keyframe(0.5, move=(at[0], at[1], 0.0)),),
        )
        for at in corners
    )
    ring = circle(24, start + post + r + 1e-3, (0.0, 0.0, 0.0))
    return SceneDescription(
        ropes=(
            RopeSpec(ring, vertices=36 if quick else 48, radius=r, density=1000.0, bend=1e-6, stretch=3.0, closed=True),
        ),
        effects={"bend": {}, "damping": {"rate": 10.0}, "rod_body": {}},
        bodies=bodies,
        duration=0.7,
        substeps=4,
        camera_direction=(0.3, -0.8, 1.0),
    )


def band_claims(frames: Frames, d: SceneDescription) -> Claims:
    """It lies along the shortest line round the posts: three sides and one turn, as long as that."""
    import numpy as np

    last, first = loop(frames.pos[-1]), loop(frames.pos[0])
    length, rest = (float(np.linalg.norm(np.diff(x, axis=0), axis=1).sum()) for x in (last, first))
    posts = frames.body_pos[-1]
    wanted = 3 * math.dist(posts[0], posts[1]) + 2 * math.pi * 0.014
    gap = [float(np.linalg.norm(frames.pos[-1, :, :2] - p[:2], axis=1).min()) for p in posts]
    return {
        "length over that of the shortest line": (length / wanted, 0.97, 1.03),
        "length over that at rest": (length / rest, 1.15, 2.0),
        "nearest vertex to a post's axis over both radii": (min(gap) / 0.014, 0.97, HUGE),
        "farthest post from its nearest vertex over both radii": (max(gap) / 0.014, 0.97, 1.1),
    }
