"""Forces at the grippers in a diagnosis: the mass that they tell, what they count in fits, and how far models are off.

Once the markers have told the baseline's numbers, forces tell its mass, as in a calibration
(`torchdlo.sysid.calibration.absolute`), and stand as readings behind the markers in all simulations from then on: in
the screening and in the fits. Whether an effect is worth its name is judged by the markers alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from torchdlo.physics import tree
from torchdlo.physics.effects.base import Param
from torchdlo.physics.effects.parameter_name import ParameterName
from torchdlo.sysid.calibration.absolute import weighed
from torchdlo.sysid.diagnosis.workspace import Callback, Workspace
from torchdlo.sysid.estimation.jobs import FitJob, Fitted
from torchdlo.sysid.model.grip_wrench import measured_wrench, unpacked
from torchdlo.sysid.model.rope_model import RopeModel

__all__ = ["ForceErrors", "bias_drift", "force_errors", "simulated_forces", "take_forces", "told_mass"]

_LITTLE = 1e-4
"""Share of numbers by which they are moved for a derivative."""

_COEFFICIENTS = ("c_d", "across", "along")
"""Numbers without unit that tell a force."""


@dataclass(frozen=True)
class ForceErrors:
    """How far simulated forces at the grippers are off on the test trials, root mean square per component."""

    force: float
    """[N]."""
    torque: float | None
    """[N m]; None where torques do not count."""


def take_forces(bench: Workspace, base: Fitted, iterations: int, report: Callback) -> tuple[Workspace, Fitted]:
    """Return a workspace in whose fits forces count, and the baseline with the mass as one of its numbers.

    Both are as they were where no train trial has forces.

    Args:
        bench: the trials.
        base: what the markers told.
        iterations: most iterations.
        report: told how it goes.
    """
    recording, trials, start = bench.recording, bench.trials["train"], bench.starts["train"]
    if recording.wrench is None or all(t.wrench is None for t in trials):
        return bench, base
    stage, pool = "fitting forces", bench.pool
    report(stage, 0, 1, "")
    plain = pool.local.model(base.effects, base.options)
    model = RopeModel(recording, effects=base.effects, **(pool.local.options | dict(base.options) | {"forces": True}))
    numbers = dict(zip(plain.parameters, base.values, strict=True))
    known, first = weighed(model, trials, model.motion(trials), start, numbers)
    bench = bench.with_options(dict(base.options) | {"forces": True, "force_worth": known.metres})
    share = first[model.parameters.index("mass")] / model.mass
    bench = replace(bench, early=_heavier(bench.early, plain, share))
    free, sizes = (*base.space.names, "mass"), (*base.space.units, 1.0)
    (found,) = bench.fit([FitJob(base.effects, first[None], free, sizes, iterations, start)])
    report(stage, 1, 1, f"{float(found.values[model.parameters.index('mass')]):.3g} kg")
    return bench, found


def _heavier(early: np.ndarray, plain: RopeModel, share: float) -> np.ndarray:
    """Return numbers of the beginning of trials for a rope that is heavier by a factor."""
    if not len(early):
        return early
    scale = [share if name.endswith("_stiffness") else 1.0 for name in plain.parameters[: len(early)]]
    return early * scale


def simulated_forces(bench: Workspace, fitted: Fitted, split: str) -> np.ndarray | None:
    """Return simulated force [N] and torque [N m] at the grippers, shape (B, F, W, 6); None where they do not count."""
    model = bench.pool.local.model(fitted.effects, fitted.options)
    if model.force_worth is None:
        return None
    return unpacked(bench.readings(fitted, split), model.count, model.force_worth)


def force_errors(bench: Workspace, fitted: Fitted) -> ForceErrors | None:
    """Return how far a model's forces are off on the test trials; None where no test trial has forces that count."""
    simulated = simulated_forces(bench, fitted, "test")
    if simulated is None:
        return None
    sensor, trials = tree.part(bench.recording.wrench), bench.trials["test"]
    frames = max(simulated.shape[1], *(len(t.time) for t in trials))
    off = measured_wrench(trials, sensor, frames, simulated.shape[2])[:, : simulated.shape[1]] - simulated
    force, torque = (_size(part) for part in (off[..., :3], off[..., 3:]))
    return None if force is None else ForceErrors(force, torque)


def _size(errors: np.ndarray) -> float | None:
    return float(np.sqrt(np.nanmean(errors**2))) if np.isfinite(errors).any() else None


def bias_drift(bench: Workspace, fitted: Fitted) -> np.ndarray:
    """Return how far a bias of forces may move a fit's coordinates, standard deviations, shape (0 or 1, K).

    It scales the mass, and with it all that markers tell only in proportion to the mass.
    """
    mass, sensor = told_mass(bench, fitted), bench.recording.wrench
    if mass is None or sensor is None or not sensor.force_bias_std:
        return np.zeros((0, len(fitted.space.names)))
    share = sensor.force_bias_std / max(mass * float(np.linalg.norm(bench.recording.gravity)), 1e-9)
    grows = [_grows(name, param) for name, param in zip(fitted.space.names, fitted.space.params, strict=True)]
    values = fitted.space.to_values(fitted.point.raw)
    raws = [fitted.space.to_raw(values * np.where(grows, factor, 1.0)) for factor in (1 - _LITTLE, 1 + _LITTLE)]
    return share * (raws[1] - raws[0])[None] / (2 * _LITTLE)


def _grows(name: str, param: Param) -> bool:
    """Return whether a number is told in proportion to the mass: of forces, moments and masses."""
    return param.unit.startswith(("N", "kg")) or ParameterName.parse(name).number in _COEFFICIENTS


def told_mass(bench: Workspace, fitted: Fitted) -> float | None:
    """Return the mass that forces told [kg], None where none did."""
    names = bench.pool.local.model(fitted.effects, fitted.options).parameters
    return float(fitted.values[names.index("mass")]) if "mass" in names else None
