"""What a diagnosis found, in words and as plain objects for JSON files."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from torchdlo.physics import tree
from torchdlo.physics.effects import EFFECTS
from torchdlo.physics.effects.parameter_name import values_of
from torchdlo.sysid.diagnosis.detection_limit import HIDDEN
from torchdlo.sysid.diagnosis.effect_library import effect_equation, separating_experiment
from torchdlo.sysid.diagnosis.error_floor import gap_rms, trial_gaps
from torchdlo.sysid.diagnosis.plausibility import implausible, not_told
from torchdlo.sysid.diagnosis.residual_analysis import localise
from torchdlo.sysid.diagnosis.significance import RATE, Agreement
from torchdlo.sysid.diagnosis.verdict import Diagnosis
from torchdlo.sysid.estimation import levenberg_marquardt
from torchdlo.sysid.estimation.result import result_json, versions
from torchdlo.sysid.estimation.result_cache import digest
from torchdlo.sysid.model import model_file
from torchdlo.sysid.recordings.metrics import mean_absolute_error
from torchdlo.sysid.recordings.recording import Recording

__all__ = [
    "absorbed",
    "confidence",
    "findings",
    "findings_json",
    "limits_text",
    "mean_absolute_errors",
    "model_json",
    "summary",
]


def findings(result: Diagnosis, recording: Recording) -> dict[str, Any]:
    """Return the findings as plain objects."""
    numbers, rates = _numbers(result), result.false_discovery_rates
    effects = [
        {
            "name": name,
            "kind": EFFECTS[name].kind,
            "law": effect_equation(name),
            "parameters": values_of(name, numbers),
            "share_of_gap": result.shares[name],
            "test": _test(result.tests[name], rates[name], result.looked_at) if name in result.tests else None,
            "indistinguishable_from": result.ties[name],
            "separating_experiments": {other: separating_experiment(name, other) for other in result.ties[name]},
        }
        for name in result.effects
    ]
    candidates = [
        {"round": r + 1, "name": c.name, "score": c.score, "train_gain": c.gain}
        | {"heldout_gain": c.heldout_gain, "reason": c.reason, "p_value": c.test and c.test.p}
        for r, each in enumerate(result.candidates)
        for c in each
    ]
    return {
        "recording": str(recording.path),
        "recording_sha256": digest({f.name: getattr(recording, f.name) for f in dataclasses.fields(recording)[1:]}),
        "verdict": result.verdict,
        "effects": effects,
        "confidence": confidence(result),
        "best_candidate": _leading(result),
        "gap": _gap(result, recording),
        "forces": _forces(result, recording),
        "detection_limits": [
            dataclasses.asdict(limit) | {"note": HIDDEN if limit.easiest is None else None} for limit in result.limits
        ],
        "second_view": result.second_view,
        "misleading_trials": [dataclasses.asdict(trial) for trial in result.misleading],
        "candidates": candidates,
        "baseline": values_of("", numbers),
        "cameras": {k: v for k, v in numbers.items() if k.startswith("camera_")},
        "absorbed_by_calibration": absorbed(result),
        "data_issues": [dataclasses.asdict(fault) for fault in result.data_issues],
        "options": result.options,
        "model": "model.json",
        "notes": result.notes,
        "seconds": result.seconds,
        "versions": versions(),
    }


def _test(test: Agreement, rate: float, looked_at: int) -> dict[str, Any]:
    """Return whether what an effect explains on the test trials could be chance."""
    return {
        "method": f"sign flips of {test.units} {test.unit}s of the test trials, which had no part in choosing",
        "p_value": test.p,
        "candidates_looked_at": looked_at,
        "false_discovery_rate": rate,
        "p_value_over_trials": None if np.isnan(test.p_trials) else test.p_trials,
        "dose_by_trial": [None if np.isnan(dose) else float(dose) for dose in test.doses],
    }


def _leading(result: Diagnosis) -> dict[str, Any] | None:
    """Return what comes closest where a gap is left that nothing named explains."""
    best = result.leading
    if best is None:
        return None
    return {
        "name": best.name,
        "parameters": best.numbers,
        "train_gain": best.gain,
        "heldout_gain": best.heldout_gain,
        "against": best.against,
        "p_value": best.test.p,
    }


def _numbers(result: Diagnosis) -> dict[str, dict[str, Any]]:
    """Return the fitted numbers with their ranges; the value is None where the range is all that can be."""
    space, point = result.final.space, result.final.point
    rows = zip(
        space.names,
        space.to_values(point.raw),
        *levenberg_marquardt.interval(point, space, result.drifts),
        space.params,
        strict=True,
    )
    unknown = {key for name in result.effects for key in not_told(result.final, name, result.drifts)}
    return {
        name: {"value": None if name in unknown else float(v), "low": float(a), "high": float(b), "unit": p.unit}
        for name, v, a, b, p in rows
    }


def _gap(result: Diagnosis, recording: Recording) -> dict[str, Any]:
    """Return the gap on the test trials and the floor."""
    floor, trials = result.floor, zip(recording.test, result.before, result.after, strict=True)
    if recording.filmed:
        # Films have no markers but those at the grippers, which are given; noise is that of centre lines.
        return {
            "test_rmse_before_m": result.gaps[0],
            "test_rmse_after_m": result.gaps[1],
            "noise_floor_m": floor.total,
            "floor_parts_m": {"marker_noise": floor.noise, "step": floor.step, "grid": floor.grid},
            "per_trial": [{"name": t.name, "before_m": float(b), "after_m": float(a)} for t, b, a in trials],
        }
    maes = {when: _by_trial(result, recording, when) for when in ("before", "after")}
    return {
        "test_rmse_before_m": result.gaps[0],
        "test_rmse_after_m": result.gaps[1],
        **{f"test_mae_{when}_m": mae for when, mae in mean_absolute_errors(result, recording).items()},
        **{f"train_rmse_{when}_m": _train_gap(result, recording, when) for when in maes},
        "noise_floor_m": floor.total,
        "floor_parts_m": {"marker_noise": floor.noise, "step": floor.step, "grid": floor.grid},
        "per_trial": [
            {"name": t.name, "before_m": float(b), "after_m": float(a)}
            | {f"mae_{when}_m": maes[when][t.name] for when in maes}
            for t, b, a in trials
        ],
    }


def _forces(result: Diagnosis, recording: Recording) -> dict[str, Any] | None:
    """Return how far forces at the grippers are off on the test trials; None where none count."""
    if result.forces is None:
        return None
    sensor, said = tree.part(recording.wrench), dict(zip(("before", "after"), result.forces, strict=True))
    return {
        **{f"test_force_rmse_{when}_n": each.force for when, each in said.items()},
        **{f"test_torque_rmse_{when}_nm": each.torque for when, each in said.items()},
        "force_noise_n": sensor.force_noise_std,
        "torque_noise_nm": sensor.torque_noise_std,
    }


def _force_text(result: Diagnosis, recording: Recording) -> str:
    """Return likewise a sentence, nothing where none count."""
    if result.forces is None:
        return ""
    before, after = result.forces
    sensor = tree.part(recording.wrench)
    change = f"{before.force:.3g}" if after.force == before.force else f"{before.force:.3g} → {after.force:.3g}"
    said = f" Force at the grippers: {change} N off (noise {sensor.force_noise_std:.2g} N)"
    if before.torque is None or after.torque is None:
        return f"{said}."
    change = f"{before.torque:.3g}" if after.torque == before.torque else f"{before.torque:.3g} → {after.torque:.3g}"
    return f"{said}, torque {change} N m (noise {sensor.torque_noise_std:.2g} N m)."


def _train_gap(result: Diagnosis, recording: Recording, when: str) -> float:
    """Return the root mean square gap of the train trials [m]."""
    return gap_rms(trial_gaps([result.predictions[when][t.name] for t in recording.train], recording.train))


def mean_absolute_errors(result: Diagnosis, recording: Recording) -> dict[str, float]:
    """Return the mean absolute error per coordinate [m] "before" and "after", over the test trials that are compared.

    It is the measure of the literature: gripped markers and suspect frames count, see
    `torchdlo.sysid.recordings.metrics`.
    """
    names = [t.name for t, kept in zip(recording.test, result.compared, strict=True) if kept]
    found = {when: _by_trial(result, recording, when) for when in ("before", "after")}
    return {when: float(np.mean([of_trial[name] for name in names])) for when, of_trial in found.items()}


def _by_trial(result: Diagnosis, recording: Recording, when: str) -> dict[str, float]:
    return {t.name: mean_absolute_error(result.predictions[when][t.name], t) for t in recording.test}


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
        for name, n in values_of("", _numbers(result)).items()
        if name in before and n["value"]
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
    doubts += [
        f"{name.replace('_', ' ')} {why}"
        for name in result.effects
        if (why := implausible(result.final, name, result.drifts)) is not None
    ]
    rates = result.false_discovery_rates
    if chance := [name for name in result.effects if rates.get(name, 0.0) > RATE]:
        doubts.append(f"the test trials are too few to exclude that {_listed(chance)} is chance")
    elif len(result.after) < 2:
        doubts.append("there is one test trial only")
    if len(result.final.point.trial_costs) < 3:
        doubts.append("there are fewer than three train trials")
    return {"word": ("high", "moderate")[len(doubts)] if len(doubts) < 2 else "low", "doubts": doubts}


def findings_json(result: Diagnosis, recording: Recording) -> str:
    """Return the findings as JSON text."""
    if recording.filmed:
        return result_json({"generator": "torchdlo diagnose"} | findings(result, recording))
    where = localise(recording, result.predictions, result.floor)
    place = {
        "before": where.words,
        "after": where.rest,
        "share_explained_by": {a.name: [a.share_before, a.share_after] for a in where.against},
        "share_made_of": {k: [v, where.parts_after[k]] for k, v in where.parts_before.items()},
    }
    return result_json({"generator": "torchdlo diagnose"} | findings(result, recording) | {"localisation": place})


def model_json(result: Diagnosis) -> str:
    """Return the model with the effects as JSON text."""
    return result_json({"generator": "torchdlo diagnose"} | model_file.content(result.model, result.final.values))


def summary(result: Diagnosis, recording: Recording) -> str:
    """Return the verdict in words."""
    before, after, floor = (1e3 * x for x in (*result.gaps, result.floor.total))
    failed, count = int((~result.compared).sum()), len(result.before)
    left_out = f" Left out are {failed} of {count} such trials, which a simulation fails on." if failed else ""
    error, errors = "", ""
    if not recording.filmed:
        mae = mean_absolute_errors(result, recording)
        error = f" Mean absolute error per coordinate: {1e3 * mae['before']:.2f} mm."
        errors = f" Mean absolute error per coordinate: {1e3 * mae['before']:.2f} → {1e3 * mae['after']:.2f} mm."
        error, errors = (text + _force_text(result, recording) for text in (error, errors))
    if result.verdict == "none":
        return (
            "Nothing is missing that these data could show: the calibrated baseline is "
            f"{before:.1f} mm off on trials that were not used, and {floor:.1f} mm is the floor of noise and grid."
            f"{left_out}{error}"
        )
    if result.verdict == "unknown" and before <= floor:
        return (
            f"Whether something is missing is not known: the calibrated baseline is {before:.1f} mm off on trials that "
            f"were not used, and finer simulations differ from it by {floor:.1f} mm.{left_out}{error}{_best(result)}"
        )
    if result.verdict == "unknown":
        return (
            "Something is missing that no effect of the library explains: the calibrated baseline is "
            f"{before:.1f} mm off on trials that were not used, {before / floor:.1f} times the floor of noise and grid "
            f"({floor:.1f} mm).{left_out}{error}{_best(result)}"
        )
    numbers = _numbers(result)
    named = " and ".join(_named(name, numbers, result.ties[name]) for name in result.effects)
    # The squares add up: noise is in both.
    excess = before**2 - (1e3 * result.floor.noise) ** 2
    share = f", {(before**2 - after**2) / excess:.0%} of what is above the noise closed" if excess > 0 else ""
    said = f"Missing: {named}. Gap on trials that were not used: {before:.1f} → {after:.1f} mm"
    said += f" (floor {floor:.1f} mm){share}.{left_out}"
    said += errors
    said += "".join(f" {_tested(name, result)}" for name in result.tests)
    if result.verdict == "partial":
        said += f" A part remains that no effect of the library explains.{_best(result)}"
    sure = confidence(result)
    if sure is None:
        return said
    return said + f" Confidence: {sure['word']}" + (f" ({'; '.join(sure['doubts'])})." if sure["doubts"] else ".")


def limits_text(result: Diagnosis) -> str:
    """Return in a sentence how large effects would have to be to be named; nothing where that is not known."""
    seen, hidden = [], []
    for limit in result.limits:
        name, unit = limit.name.replace("_", " "), "" if limit.unit == "1" else f" {limit.unit}"
        if limit.easiest is None:
            hidden.append(name)
            continue
        least = f"{limit.easiest:.2g}"
        if limit.hardest is None:
            seen.append(f"{name} ({limit.number} {least}{unit} at best, elsewhere it cannot be seen)")
            continue
        ends = sorted({least, f"{limit.hardest:.2g}"}, key=float)
        seen.append(f"{name} ({limit.number} {' to '.join(ends)}{unit})")
    said = [f"Would be named from this size on, by place or direction: {', '.join(seen)}."] if seen else []
    never = f"What {HIDDEN}, as it would have to be larger than it can be: {', '.join(hidden)}."
    return " ".join([*said, *([never] if hidden else [])])


def _tested(name: str, result: Diagnosis) -> str:
    """Return whether what an effect explains on the test trials could be chance, in a sentence."""
    test, rate = result.tests[name], result.false_discovery_rates[name]
    doses = (
        "" if np.isnan(test.p_trials) else f"; an F test of the doses that trials ask for gives p {test.p_trials:.2g}"
    )
    return (
        f"Chance explains as much of the test trials as {name.replace('_', ' ')} with p {test.p:.2g} (sign flips of "
        f"{test.units} {test.unit}s), at a false discovery rate of {rate:.2g} with all {result.looked_at} candidates "
        f"that were looked at{doses}."
    )


def _best(result: Diagnosis) -> str:
    """Return what comes closest to explaining what is left, in a sentence; nothing where nothing comes close."""
    best = result.leading
    if best is None:
        return ""
    told = ", ".join(f"{key} {value:.3g}" for key, value in best.numbers.items())
    return (
        f" The best candidate is {best.name.replace('_', ' ')} ({told}), which closes {best.heldout_gain:.0%} of the "
        f"gap above noise on the test trials and {max(best.gain, 0.0):.0%} on the train trials; it is not named "
        f"because it {best.against} (p {best.test.p:.2g})."
    )


def _named(name: str, numbers: dict[str, dict[str, Any]], ties: list[str]) -> str:
    own = values_of(name, numbers)
    told = ", ".join(
        f"{key} not told"
        if n["value"] is None
        else f"{key} {n['value']:.3g} [{n['low']:.3g}, {n['high']:.3g}]{'' if n['unit'] == '1' else ' ' + n['unit']}"
        for key, n in own.items()
    )
    other = f", not to be told from {_listed(ties)}" if ties else ""
    return f"{name.replace('_', ' ')}{f' ({told})' if told else ''}{other}"


def _listed(names: list[str]) -> str:
    return " or ".join(n.replace("_", " ") for n in names)
