"""What a scene file says that no run could do: each is refused with its place."""

from __future__ import annotations

from torchdlo import notices
from torchdlo.errors import InputError
from torchdlo.scene_files.schema import SceneDescription

__all__ = ["check_duration", "check_joints", "check_keyframes"]


def check_duration(d: SceneDescription) -> None:
    """Refuse a run of no step, and say if the last step does not end with it."""
    if not d.dt > 0:
        return  # said where the scene is built
    steps = d.duration / d.dt
    if steps < 0.5:
        raise InputError(f"duration: {d.duration:g} s is less than half a step of {d.dt:g} s; take a shorter dt.")
    whole = max(1, round(steps))
    if abs(steps - whole) > 1e-6 * whole:
        notices.once(
            "duration",
            f"scene: its duration, {d.duration:g} s, is no whole number of steps of {d.dt:g} s; it runs for {whole} of "
            f"them, {whole * d.dt:g} s.",
        )


def check_keyframes(d: SceneDescription) -> None:
    """Refuse keyframes before the start, and of bodies that do not follow them."""
    moved = {
        "bodies": [b.keyframes for b in d.bodies],
        "attachments": [a.keyframes for a in d.attachments],
        "robots": [r.keyframes for r in d.robots],
    }
    for name, all_keys in moved.items():
        for k, keys in enumerate(all_keys):
            for j, key in enumerate(keys):
                if key.time < 0:
                    raise InputError(f"{name}[{k}].keyframes[{j}].time: expected a time from 0 on, given {key.time:g}.")
    for k, body in enumerate(d.bodies):
        if body.keyframes and body.motion != "kinematic":
            raise InputError(
                f"bodies[{k}].keyframes: only a kinematic body has keyframes, and this one is {body.motion}; give "
                '"motion": "kinematic", or leave them out.'
            )


def check_joints(d: SceneDescription) -> None:
    """Refuse joints of bodies or ropes that are not there."""
    ropes = f"0 to {len(d.ropes) - 1}"
    for k, joint in enumerate(d.joints):
        if joint.body is not None and not 0 <= joint.body < len(d.bodies):
            raise InputError(
                f"joints[{k}].body: expected the number of a body, 0 to {len(d.bodies) - 1}, given {joint.body}."
                if d.bodies
                else f"joints[{k}].body: there is no body in the scene."
            )
        for name, number in (("rope", joint.rope), ("other_rope", joint.other_rope)):
            if number is not None and not 0 <= number < len(d.ropes):
                raise InputError(f"joints[{k}].{name}: expected the number of a rope, {ropes}, given {number}.")
