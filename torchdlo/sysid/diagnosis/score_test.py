"""Which effects could explain what a model gets wrong: doses of each, against the residual.

Every effect is added in small doses to the calibrated model, in one batch. What a dose changes, after the baseline's
own numbers have been allowed to take up what they can, is compared with what is left over (an efficient score: Rao
1948, doi:10.1017/S0305004100023987). The score is the share of the left-over that the best mixture of doses takes away.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import lsq_linear

from torchdlo.physics.effects import EFFECTS
from torchdlo.physics.effects.parameter_name import ParameterName
from torchdlo.sysid.diagnosis import effect_library
from torchdlo.sysid.diagnosis.effect_library import Perturbation
from torchdlo.sysid.estimation.jobs import Fitted, SimulationJob
from torchdlo.sysid.estimation.worker_pool import Pool
from torchdlo.sysid.model.rope_model import RopeModel
from torchdlo.sysid.model.trial_batch import Start

_KNEE = 2e-3
"""Residual from which it counts less [m]."""

_HORIZON = 0.6
"""Share of each trial that is compared: over longer times the answer to a dose is not linear any more."""

_ON_THE_WAY = (1.0, 0.5, 0.2)
"""Shares of the best mixture from which a fit may start: the answer to large doses is not linear."""

_PLACES = 3
"""How many of an effect's doses that exclude each other a fit may start from: the answer to a soft spot's place, to a
yield point or to the side from which wind blows has many optima."""

_MOST = 20.0
"""Most doses of an effect."""


@dataclass(frozen=True, eq=False)
class Score:
    """How well an effect fits to a residual."""

    name: str
    """The effect."""
    share: float
    """Share of the weighted squared residual that it takes away beyond what the baseline can."""
    dose: dict[str, float]
    """Its numbers where the best mixture of doses has them."""
    starts: tuple[tuple[dict[str, float], np.ndarray], ...]
    """Where a fit may start: its numbers and the coordinates of the baseline's, on the way to the best mixture."""
    sizes: dict[str, float]
    """What counts as much of each number, in the terms of its scale."""
    direction: np.ndarray
    """What it changes after the baseline took up its part, unit length, weighted residuals, shape (R,)."""
    probes: tuple[tuple[dict[str, float], float], ...] = ()
    """Its doses by themselves: numbers, and the gap that each leaves after the baseline took up its part [m]."""


def curvature_scale(markers: np.ndarray) -> float:
    """Return a large curvature of measured shapes (B, F, M, 3) [1/m]: the 95th percentile."""
    a, b = np.diff(markers, axis=2)[:, :, :-1], np.diff(markers, axis=2)[:, :, 1:]
    la, lb = (np.linalg.norm(x, axis=-1) for x in (a, b))
    with np.errstate(invalid="ignore", divide="ignore"):
        cosine = (a * b).sum(-1) / (la * lb)
        angle = np.arccos(np.clip(cosine, -1, 1)) / (0.5 * (la + lb))
    return float(max(np.nanpercentile(angle, 95), 0.5))


def score_effects(
    pool: Pool, base: Fitted, names: Sequence[str], start: Start, report: Callable[[int, int], None]
) -> list[Score]:
    """Return the scores of effects, best first.

    Args:
        pool: the simulations.
        base: the calibrated model.
        names: effects to try.
        start: where the train trials begin.
        report: called with the number of groups done and in all.
    """
    recording, model = pool.recording, pool.local.model(base.effects)
    measured = pool.local.measured(model, "train")
    known = dict(zip(model.parameters, base.values, strict=True))
    curved = curvature_scale(measured[:, :: max(1, measured.shape[1] // 50), : model.count])
    doses = {n: effect_library.perturbations(n, recording, model.mesh, curved, known) for n in names}
    groups, nudge = groups_of(names, doses), base.space.nudges()
    jobs = [_job(pool, base, group, doses) for group in groups]
    jobs.append(SimulationJob(base.effects, _nudged(model, base, nudge)))
    frames = min(max(10, int(_HORIZON * measured.shape[1])), measured.shape[1])
    jobs = [replace(job, start=start, frames=frames) for job in jobs]
    sims_of: dict[int, np.ndarray] = {}
    report(0, len(jobs))
    for k, sims in pool.simulate(jobs):
        sims_of[k] = sims
        report(len(sims_of), len(jobs))
    free = np.setdiff1d(np.arange(measured.shape[2]), model.gripped)

    def pick(x: np.ndarray) -> np.ndarray:
        return x[..., :frames, free, :].reshape(*x.shape[:-4], -1)

    own = sims_of[len(groups)]
    residual = pick(measured) - pick(own[0])
    good = np.isfinite(residual) & np.isfinite(pick(own)).all(0)
    trust: np.ndarray | float = 1.0
    if start.frame_weights is not None:
        trust = pick(np.broadcast_to(start.frame_weights[..., None, None], measured.shape))
    size = np.nan_to_num(trust * residual)
    weight = np.where(good, trust / (size**2 + _KNEE**2) ** 0.25, 0.0)
    residual = np.nan_to_num(residual) * weight
    jacobian = np.stack([np.nan_to_num(pick(sim - own[0])) * weight for sim in own[1:]], 1)
    q, r = np.linalg.qr(jacobian / nudge)
    # Limits are said of markers.
    places = pick(np.broadcast_to((np.arange(measured.shape[2]) < model.count)[:, None], measured.shape))
    whole = float(np.linalg.norm(weight[places])) + 1e-30
    left = residual - q @ (q.T @ residual)
    scores: list[Score] = []
    for group, sims in zip(groups, (sims_of[k] for k in range(len(groups))), strict=True):
        row = 1
        for name in group:
            rows = range(row, row + len(doses[name]))
            row += len(rows)
            change = np.stack([np.nan_to_num(pick(sims[k] - sims[0])) * weight for k in rows], 1)
            absorbed = q.T @ change
            best, *others = _mixtures(doses[name], change - q @ absorbed, left)
            starts = []
            for found in (best, *others[: _PLACES - 1]):
                # The baseline's numbers go back where they would be if they did not have to make up for the effect.
                back = np.linalg.lstsq(r, absorbed @ found.amounts, rcond=1e-6)[0]
                for share in _ON_THE_WAY:
                    raw = base.point.raw - np.clip(share * back, -1.0, 1.0)
                    starts.append((_mixture(name, doses[name], share * found.amounts), raw))
            changes, sizes = (change - q @ absorbed)[places] / whole, _sizes(name, doses[name])
            probes = _probes(doses[name], changes, [pick(sims[k])[good] for k in rows])
            scores.append(Score(name, best.share, starts[0][0], tuple(starts), sizes, best.direction, probes))
    return sorted(scores, key=lambda s: -s.share)


def _probes(
    doses: Sequence[Perturbation], changes: np.ndarray, simulated: Sequence[np.ndarray]
) -> tuple[tuple[dict[str, float], float], ...]:
    """Return by how much each dose changes (N, K) [m]; not a number where it failed: of that nothing is known."""
    shown = np.where([np.isfinite(x).all() for x in simulated], np.linalg.norm(changes, axis=0), np.nan)
    return tuple((dict(d.values), float(x)) for d, x in zip(doses, shown, strict=True))


def _nudged(model: RopeModel, base: Fitted, nudge: np.ndarray) -> np.ndarray:
    """Return the baseline's parameter set and one more for each of its numbers, moved a little."""
    rows = np.repeat(base.values[None], len(nudge) + 1, 0)
    for k, name in enumerate(base.space.names):
        raw = base.point.raw + nudge * (np.arange(len(nudge)) == k)
        rows[k + 1, model.parameters.index(name)] = base.space.to_values(raw)[k]
    return rows


def groups_of(names: Sequence[str], doses: dict[str, list[Perturbation]]) -> list[list[str]]:
    """Return effects that are simulated together: a scene of many effects is slow, one scene per effect wasteful."""
    groups: list[list[str]] = []
    for name in sorted(names, key=lambda n: -len(doses[n])):
        fitting = [g for g in groups if len(g) < 4 and sum(len(doses[n]) for n in g) + len(doses[name]) <= 12]
        # One that is a case of another is the same law.
        fitting = [g for g in fitting if not any(_same_law(name, other) for other in g)]
        if fitting:
            min(fitting, key=lambda g: sum(len(doses[n]) for n in g)).append(name)
        else:
            groups.append([name])
    return groups


def _same_law(name: str, other: str) -> bool:
    return effect_library.special_case(name)[0] == other or effect_library.special_case(other)[0] == name


def _job(pool: Pool, base: Fitted, group: Sequence[str], doses: dict[str, list[Perturbation]]) -> SimulationJob:
    effects = (*base.effects, *group)
    model = pool.local.model(effects)
    first = model.guess()
    first[: len(base.values)] = base.values
    rows = [first]
    for name in group:
        for probe in doses[name]:
            row = first.copy()
            for key, value in probe.values.items():
                row[model.parameters.index(key)] = value
            rows.append(row)
    return SimulationJob(effects, np.stack(rows))


@dataclass(frozen=True, eq=False)
class _Mixture:
    """How doses of one effect explain a residual best."""

    share: float
    amounts: np.ndarray
    """Of each dose, shape (J,)."""
    direction: np.ndarray


def _mixtures(doses: list[Perturbation], answers: np.ndarray, left: np.ndarray) -> list[_Mixture]:
    """Return the mixtures of doses, whose answers have shape (R, J), that explain a residual; best first.

    Doses that exclude each other are taken one at a time.
    """
    whole = float(left @ left) + 1e-30
    scale = np.linalg.norm(answers, axis=0) + 1e-30
    low = np.array([-_MOST if d.signed else 0.0 for d in doses])
    found = []
    for rows in [list(range(len(doses)))] if _additive(doses) else [[k] for k in range(len(doses))]:
        a = answers[:, rows] / scale[rows]
        bounds = (low[rows] * scale[rows] - 1e-9, _MOST * scale[rows] + 1e-9)
        amount = lsq_linear(a, left, bounds=bounds).x
        share = 1 - float(np.sum((left - a @ amount) ** 2)) / whole
        amounts = np.zeros(len(doses))
        amounts[rows] = amount / scale[rows]
        direction = a @ amount
        found.append(_Mixture(max(share, 0.0), amounts, direction / (np.linalg.norm(direction) + 1e-30)))
    return sorted(found, key=lambda m: -m.share)


def _additive(doses: list[Perturbation]) -> bool:
    """Return whether doses are of different numbers, so that they may be mixed."""
    keys = [tuple(d.values) for d in doses]
    return len(keys) > 1 and all(len(k) == 1 for k in keys) and len(set(keys)) == len(keys)


def _mixture(name: str, doses: list[Perturbation], amounts: np.ndarray) -> dict[str, float]:
    """Return numbers for amounts of doses, kept within reason."""
    found: dict[str, float] = {}
    additive = _additive(doses)
    for dose, raw in zip(doses, amounts, strict=True):
        if raw == 0.0 and not additive:
            continue
        amount = float(np.clip(raw, -8, 8))
        least = 0.05
        amount = amount if abs(amount) > least else (least if amount >= 0 else -least)
        for key, value in dose.values.items():
            number = ParameterName.parse(key).number
            scale = EFFECTS[name].params[number].scale
            if number not in effect_library.spec(name).strength:
                found[key] = value
            elif scale == "reciprocal":
                found[key] = value / amount
            elif scale == "log":
                found[key] = float(np.exp(np.clip(amount * np.log(value), -1.5, 1.5)))
            else:
                found[key] = value * amount
    return found


def _sizes(name: str, doses: list[Perturbation]) -> dict[str, float]:
    """Return what counts as much of each number: the dose of strengths, a share of the range of places."""
    sizes: dict[str, float] = {}
    for key, value in ((key, value) for dose in doses for key, value in dose.values.items()):
        number = ParameterName.parse(key).number
        param = EFFECTS[name].params[number]
        if number in effect_library.spec(name).places:
            sizes[key] = 0.2 * max(dose.values.get(key, 0.0) for dose in doses)
        elif param.periodic:
            sizes[key] = 0.2
        else:
            sizes[key] = 1 / value if param.scale == "reciprocal" else abs(value) or 1.0
    return sizes
