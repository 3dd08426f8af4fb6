"""What a diagnosis found, in words and as plain objects for JSON files."""

from __future__ import annotations

from typing import Any

from torchdlo.sysid import fit, library
from torchdlo.sysid.diagnose import Diagnosis, rms
from torchdlo.sysid.judge import rope
from torchdlo.sysid.recording import Recording
from torchdlo.sysid.result import dump, versions

__all__ = ["findings", "findings_json", "kind", "model_json", "sentence", "separating"]

_SEPARATING = {
    frozenset(("wind", "tilted_gravity")): "add a known weight: a tilt turns with the weight, a flow does not",
    frozenset(("air_drag", "wind")): "repeat the motion in both directions: a flow favours one",
    frozenset(("air_drag", "bending_damping")): "pluck short waves, then swing the whole rope slowly: air brakes fast "
    "swings, inner damping short waves",
    frozenset(
        ("bending_damping", "internal_friction")
    ): "bend it slowly at two rates: friction does not depend on them",
    frozenset(("rest_curvature", "marker_offset")): "roll the rope by half a turn in its grippers",
    frozenset(("point_mass", "nonuniform_stiffness")): "bend it slowly, then swing it fast: masses are silent at rest",
    frozenset(("gripper_compliance", "nonuniform_stiffness")): "put markers on the grippers, or grip it elsewhere",
}
"""What would tell two effects apart."""


def findings(result: Diagnosis, recording: Recording) -> dict[str, Any]:
    """Return the findings as plain objects."""
    numbers = _numbers(result)
    effects = [
        {
            "name": name,
            "parameters": {k.split(".", 1)[1]: v for k, v in numbers.items() if k.startswith(f"{name}.")},
            "share_of_gap": result.shares[name],
            "indistinguishable_from": result.ties[name],
        }
        for name in result.effects
    ]
    candidates = [
        {"round": r + 1, "name": c.name, "score": c.score, "train_gain": c.gain}
        | {"heldout_gain": c.heldout_gain, "reason": c.reason}
        for r, each in enumerate(result.candidates)
        for c in each
    ]
    return {
        "recording": str(recording.path),
        "verdict": result.verdict,
        "effects": effects,
        "gap": _gap(result, recording),
        "candidates": candidates,
        "baseline": {k: v for k, v in numbers.items() if "." not in k},
        "model": "model.json",
        "notes": result.notes,
        "seconds": result.seconds,
        "versions": versions(),
    }


def _numbers(result: Diagnosis) -> dict[str, dict[str, Any]]:
    """Return the fitted numbers with their ranges."""
    space, point = result.final.space, result.final.point
    rows = zip(space.names, space.to_values(point.raw), *fit.interval(point, space), space.params, strict=True)
    return {
        name: {"value": float(v), "low": float(min(a, b)), "high": float(max(a, b)), "unit": p.unit}
        for name, v, a, b, p in rows
    }


def _gap(result: Diagnosis, recording: Recording) -> dict[str, Any]:
    """Return the gap on the test trials and the floor."""
    floor, trials = result.floor, zip(recording.test, result.before, result.after, strict=True)
    return {
        "test_rmse_before_m": rms(result.before),
        "test_rmse_after_m": rms(result.after),
        "noise_floor_m": floor.total,
        "floor_parts_m": {"marker_noise": floor.noise, "step": floor.step, "grid": floor.grid},
        "per_trial": [{"name": t.name, "before_m": float(b), "after_m": float(a)} for t, b, a in trials],
    }


def findings_json(result: Diagnosis, recording: Recording) -> str:
    """Return the findings as JSON text."""
    return dump({"generator": "torchdlo diagnose"} | findings(result, recording))


def model_json(result: Diagnosis, recording: Recording) -> str:
    """Return the model with the effects as JSON text."""
    numbers = dict(zip(result.model.parameters, map(float, result.final.values), strict=True))
    effects: dict[str, dict[str, float]] = {name: {} for name in result.final.effects}
    for key, value in numbers.items():
        if "." in key:
            effect, number = key.split(".", 1)
            effects[effect][number] = value
    content = {
        "generator": "torchdlo diagnose",
        "format": "torchdlo-model",
        "version": 1,
        "rope": rope(recording, "straight"),
        "mesh": {"arclength": result.model.arclength, "marker_vertex": result.model.marker_vertex},
        "parameters": {key: value for key, value in numbers.items() if "." not in key},
        "effects": effects,
        "step": result.model.step,
    }
    return dump(content)


def sentence(result: Diagnosis, recording: Recording) -> str:
    """Return the verdict in words."""
    found = findings(result, recording)
    before, after, floor = (1e3 * found["gap"][k] for k in ("test_rmse_before_m", "test_rmse_after_m", "noise_floor_m"))
    if result.verdict == "none":
        return (
            f"Nothing is missing that the data could show: the gap on test trials is {before:.1f} mm, "
            f"the floor {floor:.1f} mm."
        )
    if result.verdict == "unknown":
        return (
            "Something is missing, and no effect of the library explains it: the gap on test trials is "
            f"{before:.1f} mm, the floor {floor:.1f} mm."
        )
    named = " and ".join(_named(effect) for effect in found["effects"])
    rest = "" if result.verdict == "effects" else " A part of the gap remains that no effect of the library explains."
    return f"Missing: {named}; gap on test trials {before:.1f} -> {after:.1f} mm (floor {floor:.1f} mm).{rest}"


def _named(effect: dict[str, Any]) -> str:
    numbers = ", ".join(
        f"{key} {n['value']:.3g}" + ("" if n["unit"] == "1" else f" {n['unit']}")
        for key, n in effect["parameters"].items()
    )
    ties = effect["indistinguishable_from"]
    other = f", not to be told from {' or '.join(t.replace('_', ' ') for t in ties)}" if ties else ""
    return f"{effect['name'].replace('_', ' ')} ({numbers}){other}"


def separating(name: str, other: str) -> str:
    """Return the experiment that would tell two effects apart."""
    return _SEPARATING.get(frozenset((name, other)), "record motions of other speeds, amplitudes and directions")


def kind(name: str) -> str:
    """Return what an effect is: force, material, boundary or measurement."""
    return library.EFFECTS[name].kind
