"""The law of each effect as a formula to read, and the experiments that would tell effects apart.

The laws themselves, with their sources, stand in `torchdlo.physics.effects`.
"""

from __future__ import annotations

__all__ = ["LAWS", "MEANING", "effect_equation", "separating_experiment"]

LAWS = {
    "air_drag": "f = -½ rho c_d 2r |vₙ| vₙ per length; vₙ: velocity across the rope; rho = 1.2 kg/m³",
    "wind": "f = -½ rho c_d 2r |wₙ| wₙ per length; w = v - velocity of the air, wₙ: its part across the rope",
    "tilted_gravity": "g → R(angles) g",
    "bending_damping": "M = coefficient · dκ/dt",
    "rest_curvature": "M = B (κ - κ̄); κ̄: the two curvatures, fixed in the rope's material",
    "bending_plasticity": "dκ̄/dt = rate · (|κ - κ̄| - yield_curvature) along κ - κ̄, once that is positive",
    "internal_friction": "M = moment · z, dz = (dκ - |dκ| z) / kappa_c",
    "stiffening_bending": "M = B (κ + c κ³)",
    "nonuniform_stiffness": "B(s) = B (1 + slope (s/L - ½)) exp(factor · exp(-½ ((s/L - position) / width)²))",
    "anisotropic_bending": "B₁ = B √ratio, B₂ = B / √ratio; direction: angle of the stiff one in the rope's material",
    "point_mass": "rho(s) → rho(s) + mass · δ(s - position)",
    "stretch": "T = EA · strain",
    "table_friction": "f = -mu N v / √(|v|² + slip²) along the table",
    "gripper_compliance": "moment at a clamp = stiffness · turn of the rope in it",
    "time_delay": "marker(t) = rope(t - delay)",
    "marker_offset": "marker = axis + offset₀ d₁ + offset₁ d₂; d: directors of the rope's material",
    "link_chain": "rigid links of this length; joints turn about one axis after the other",
    "damping": "dv/dt = -rate · v",
}
"""By effect: its law. The letters are names of its numbers where they are spelled out."""

MEANING = {
    "force": "a force from outside",
    "material": "a law of the rope",
    "boundary": "a law of its grips",
    "measurement": "how it is measured, no force",
}
"""What the kinds of effects are."""

_SEPARATING = {
    (
        "wind",
        "tilted_gravity",
    ): "hang a known weight on the rope: what a tilt does grows with it, what air does shrinks",
    ("air_drag", "wind"): "repeat the motion in the opposite direction: a flow of air favours one",
    ("air_drag", "bending_damping"): "pluck short waves, then swing the whole rope slowly: air brakes what is fast, "
    "inner damping what bends quickly",
    ("air_drag", "internal_friction"): "let it swing freely from a large and from a small amplitude: air brakes the "
    "large one more, friction the small one",
    ("bending_damping", "internal_friction"): "bend it slowly at two speeds: friction does not depend on them",
    ("bending_damping", "time_delay"): "move a gripper in steps: a delay is the same at all speeds and places",
    ("bending_plasticity", "internal_friction"): "hold it bent for a minute and let go: plastic bends stay",
    ("bending_plasticity", "rest_curvature"): "measure its shape before and after a strong bend: only one of them "
    "changes",
    ("rest_curvature", "marker_offset"): "roll the rope by half a turn in its grippers and repeat",
    ("rest_curvature", "anisotropic_bending"): "hang it by one end at rest: natural curvature shows without motion",
    ("rest_curvature", "tilted_gravity"): "roll the rope by half a turn in its grippers: a tilt stays, curvature turns",
    ("rest_curvature", "gripper_compliance"): "grip it at another place: compliance moves with the gripper",
    ("point_mass", "nonuniform_stiffness"): "bend it slowly, then swing it fast: a mass shows in fast motion",
    ("gripper_compliance", "nonuniform_stiffness"): "grip it at another place: compliance moves with the gripper",
    ("gripper_compliance", "time_delay"): "hold the grippers still in two poses: a delay shows in motion only",
    ("stiffening_bending", "nonuniform_stiffness"): "repeat the motion with half its amplitude: stiffening disappears",
    (
        "stiffening_bending",
        "anisotropic_bending",
    ): "move it in one plane, and again after a quarter turn in its grippers",
    ("stretch", "marker_offset"): "pull it straight with two forces: only stretch moves the markers apart",
    ("time_delay", "air_drag"): "tap a gripper at the start and at the end: a delay is the same for both",
}
"""What would tell two effects apart."""


def effect_equation(name: str) -> str:
    """Return the law of an effect."""
    return LAWS.get(name, name.replace("_", " "))


def separating_experiment(name: str, other: str) -> str:
    """Return the experiment that would tell two effects apart."""
    for pair in ((name, other), (other, name)):
        if pair in _SEPARATING:
            return _SEPARATING[pair]
    return "record motions of other speeds, amplitudes and directions"
