"""What a diagnosis found, in words and as plain objects for JSON files."""

from __future__ import annotations

import dataclasses
from typing import Any

from torchdlo.physics.effects import EFFECTS
from torchdlo.sysid.diagnosis.effect_equations import law, separating
from torchdlo.sysid.diagnosis.residual_analysis import localise
from torchdlo.sysid.diagnosis.verdict import Diagnosis
from torchdlo.sysid.estimation import levenberg_marquardt
from torchdlo.sysid.estimation.result import dump, versions
from torchdlo.sysid.estimation.result_cache import digest
from torchdlo.sysid.model import model_file
from torchdlo.sysid.recordings.recording import Recording

__all__ = ["absorbed", "confidence", "findings", "findings_json", "model_json", "summary"]


def findings(result: Diagnosis, recording: Recording) -> dict[str, Any]:
    """Return the findings as plain objects."""
    numbers = _numbers(result)
    effects = [
        {
            "name": name,
            "kind": EFFECTS[name].kind,
            "law": law(name),
            "parameters": {k.split(".", 1)[1]: v for k, v in numbers.items() if k.startswith(f"{name}.")},
            "share_of_gap": result.shares[name],
            "indistinguishable_from": result.ties[name],
            "separating_experiments": {other: separating(name, other) for other in result.ties[name]},
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
        "recording_sha256": digest({f.name: getattr(recording, f.name) for f in dataclasses.fields(recording)[1:]}),
        "verdict": result.verdict,
        "effects": effects,
        "confidence": confidence(result),
        "gap": _gap(result, recording),
        "candidates": candidates,
        "baseline": {k: v for k, v in numbers.items() if "." not in k},
        "cameras": {k: v for k, v in numbers.items() if k.startswith("camera_")},
        "absorbed_by_calibration": absorbed(result),
        "data_issues": [dataclasses.asdict(fault) for fault in result.data_issues],
        "options": result.options,
        "model": "model.json",
        "notes": result.notes,
        "seconds": result.seconds,
        "versions": versions(),
    }


def _numbers(result: Diagnosis) -> dict[str, dict[str, Any]]:
    """Return the fitted numbers with their ranges."""
    space, point = result.final.space, result.final.point
    rows = zip(
        space.names,
        space.to_values(point.raw),
        *levenberg_marquardt.interval(point, space, result.drifts),
        space.params,
        strict=True,
    )
    return {
        name: {"value": float(v), "low": float(min(a, b)), "high": float(max(a, b)), "unit": p.unit}
        for name, v, a, b, p in rows
    }


def _gap(result: Diagnosis, recording: Recording) -> dict[str, Any]:
    """Return the gap on the test trials and the floor."""
    floor, trials = result.floor, zip(recording.test, result.before, result.after, strict=True)
    return {
        "test_rmse_before_m": result.gaps[0],
        "test_rmse_after_m": result.gaps[1],
        "noise_floor_m": floor.total,
        "floor_parts_m": {"marker_noise": floor.noise, "step": floor.step, "grid": floor.grid},
        "per_trial": [{"name": t.name, "before_m": float(b), "after_m": float(a)} for t, b, a in trials],
    }


def absorbed(result: Diagnosis) -> list[dict[str, Any]]:
    """Return the baseline's numbers without and with the effects; `change` is how far off the first ones were."""
    before = dict(
        zip(result.baseline.space.names, result.baseline.space.to_values(result.baseline.point.raw), strict=True)
    )
    return [
        {
            "name": name,
            "before": float(before[name]),
            "after": n["value"],
            "change": float(before[name] / n["value"] - 1),
            "unit": n["unit"],
        }
        for name, n in _numbers(result).items()
        if name in before and "." not in name and n["value"]
    ]


def confidence(result: Diagnosis) -> dict[str, Any] | None:
    """Return how much speaks for the names, in one word, and what speaks against them; None without names."""
    if not result.effects:
        return None
    doubts = []
    worse = int((result.after >= result.before).sum())
    if worse:
        doubts.append(f"{worse} of {len(result.after)} test trials did not get better")
    ties = sorted({t for name in result.effects for t in result.ties[name]})
    if ties:
        doubts.append(f"{_listed(ties)} would do as well")
    open_ended = [name for name in result.effects if _may_be_off(name, _numbers(result))]
    if open_ended:
        doubts.append(f"the range of {_listed(open_ended)} reaches the value at which it does nothing")
    if len(result.after) < 2:
        doubts.append("there is one test trial only")
    if len(result.final.point.trial_costs) < 3:
        doubts.append("there are fewer than three train trials")
    return {"word": ("high", "moderate")[len(doubts)] if len(doubts) < 2 else "low", "doubts": doubts}


def _may_be_off(name: str, numbers: dict[str, dict[str, Any]]) -> bool:
    """Return whether the ranges of all numbers that switch an effect hold their off values."""
    held = []
    for key, n in numbers.items():
        effect, _, number = key.partition(".")
        off = EFFECTS[name].params[number.split(".")[0]].off if effect == name else None
        if off is not None:
            held.append(n["low"] <= off <= n["high"])
    return bool(held) and all(held)


def findings_json(result: Diagnosis, recording: Recording) -> str:
    """Return the findings as JSON text."""
    if recording.filmed:
        return dump({"generator": "torchdlo diagnose"} | findings(result, recording))
    where = localise(recording, result.predictions, result.floor)
    place = {
        "before": where.words,
        "after": where.rest,
        "share_explained_by": {a.name: [a.share_before, a.share_after] for a in where.against},
        "share_made_of": {k: [v, where.parts_after[k]] for k, v in where.parts_before.items()},
    }
    return dump({"generator": "torchdlo diagnose"} | findings(result, recording) | {"localisation": place})


def model_json(result: Diagnosis) -> str:
    """Return the model with the effects as JSON text."""
    return dump({"generator": "torchdlo diagnose"} | model_file.content(result.model, result.final.values))


def summary(result: Diagnosis, recording: Recording) -> str:
    """Return the verdict in words."""
    before, after, floor = (1e3 * x for x in (*result.gaps, result.floor.total))
    failed, count = int((~result.compared).sum()), len(result.before)
    left_out = f" Left out are {failed} of {count} such trials, which a simulation fails on." if failed else ""
    if result.verdict == "none":
        return (
            "Nothing is missing that these data could show: the calibrated baseline is "
            f"{before:.1f} mm off on trials that were not used, and {floor:.1f} mm is the floor of noise and grid."
            f"{left_out}"
        )
    if result.verdict == "unknown":
        return (
            "Something is missing that no effect of the library explains: the calibrated baseline is "
            f"{before:.1f} mm off on trials that were not used, {before / floor:.1f} times the floor of noise and grid "
            f"({floor:.1f} mm).{left_out}"
        )
    numbers = _numbers(result)
    named = " and ".join(_named(name, numbers, result.ties[name]) for name in result.effects)
    # The squares add up: noise is in both.
    excess = before**2 - (1e3 * result.floor.noise) ** 2
    share = f", {(before**2 - after**2) / excess:.0%} of what is above the noise closed" if excess > 0 else ""
    said = f"Missing: {named}. Gap on trials that were not used: {before:.1f} → {after:.1f} mm"
    said += f" (floor {floor:.1f} mm){share}.{left_out}"
    if result.verdict == "partial":
        said += " A part remains that no effect of the library explains."
    sure = confidence(result)
    return said + f" Confidence: {sure['word']}" + (f" ({'; '.join(sure['doubts'])})." if sure["doubts"] else ".")


def _named(name: str, numbers: dict[str, dict[str, Any]], ties: list[str]) -> str:
    own = {k.split(".", 1)[1]: n for k, n in numbers.items() if k.startswith(f"{name}.")}
    told = ", ".join(
        f"{key} {n['value']:.3g} [{n['low']:.3g}, {n['high']:.3g}]{'' if n['unit'] == '1' else ' ' + n['unit']}"
        for key, n in own.items()
    )
    other = f", not to be told from {_listed(ties)}" if ties else ""
    return f"{name.replace('_', ' ')}{f' ({told})' if told else ''}{other}"


def _listed(names: list[str]) -> str:
    return " or ".join(n.replace("_", " ") for n in names)
