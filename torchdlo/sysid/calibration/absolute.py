"""Mass and stiffness by themselves, from forces at the grippers.

Markers tell stiffness only over mass: with prescribed grippers, a rope twice as heavy and twice as stiff moves alike.
Forces at the grippers tell both. Each reading counts by what is left of it: a force is worth as many metres as what
the calibrated model leaves of forces, its noise at least, is of what it leaves of markers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from torchdlo.physics import tree
from torchdlo.sysid.diagnosis.error_floor import marker_noise
from torchdlo.sysid.estimation import levenberg_marquardt
from torchdlo.sysid.estimation.levenberg_marquardt import ParameterSpace, Point
from torchdlo.sysid.model.grip_wrench import ForceWorth, Grip, grips, measured_wrench, packed
from torchdlo.sysid.model.rope_model import RopeModel
from torchdlo.sysid.model.trial_batch import Start, TrialBatch
from torchdlo.sysid.recordings.recording import Recording, Trial
from torchdlo.sysid.recordings.wrench import ForceSensor

__all__ = ["Absolute", "ForceReadings", "fit_absolute", "mass_note", "readings", "weighed"]

_LEAST_NOISE = 1e-4
"""Noise of markers that is assumed at least [m]."""

_STEPS = 30
"""Steps of reweighting to a least sum of deviations."""

_WITH_MASS = ("bending_stiffness", "twisting_stiffness", "mass")
"""Numbers of a rope that moves alike if all of them grow by the same factor."""


@dataclass(frozen=True, eq=False)
class ForceReadings:
    """Forces of some trials as readings beside the markers."""

    grips: tuple[Grip, ...]
    """The grippers."""
    target: np.ndarray
    """Markers, forces and torques as measured, in metres, NaN where not, shape (B, F, R, 3)."""
    metres: ForceWorth
    """What a newton and a newton metre are worth [m/N, m/(N m)]; None: torques do not count."""
    count: int
    """Markers."""
    noise: float
    """Noise of all of them in metres."""

    def pack(self, markers: np.ndarray, wrench: np.ndarray) -> np.ndarray:
        """Return readings (..., R, 3) of markers (..., M, 3) and forces and torques (..., W, 6)."""
        return packed(markers, wrench, self.metres)

    def forces(self, packed: np.ndarray) -> np.ndarray:
        """Return the part of readings (..., R, 3) that are forces and torques."""
        return packed[..., self.count :, :]

    def scaled(self, sims: np.ndarray, share: float, free: np.ndarray) -> ForceReadings:
        """Return the same readings, in which forces and torques count by what is left of them.

        Args:
            sims: readings of the calibrated model, shape (B, F, R, 3).
            share: by which its forces are to be multiplied.
            free: which markers are not held, shape (M,) bool.
        """
        forces, wrenches = self.forces(self.target), len(self.grips)
        left = np.abs(forces - share * self.forces(sims))
        markers = _usual(np.abs(self.target - sims)[..., : self.count, :][..., free, :])
        factors = [max(markers, _LEAST_NOISE) / max(_usual(left[..., :wrenches, :]), self.noise)]
        if self.metres[1] is not None:
            factors.append(max(markers, _LEAST_NOISE) / max(_usual(left[..., wrenches:, :]), self.noise))
        # A factor above one would make more of a reading than its noise allows.
        factors = [min(f, 1.0) for f in factors]
        target = self.target.copy()
        target[..., self.count :, :] *= np.repeat(factors, wrenches)[:, None]
        worth = [None if m is None else float(m * f) for m, f in zip(self.metres, (*factors, 1.0), strict=False)]
        return replace(self, target=target, metres=(worth[0] or 0.0, worth[1]))


@dataclass(frozen=True, eq=False)
class Absolute:
    """What forces add to a calibration."""

    values: np.ndarray
    """Numbers in the order of the model's, shape (K,)."""
    space: ParameterSpace
    """Those that were fitted, with the mass."""
    point: Point
    """Where they stand."""
    drifts: np.ndarray | None
    """Standard deviations of the coordinates that all trials have in common, shape (E, K), None if not known."""


def readings(model: RopeModel, trials: Sequence[Trial], motion: TrialBatch) -> ForceReadings:
    """Return the forces of trials as readings; trials without any count by their markers."""
    recording = model.recording
    sensor: ForceSensor = tree.part(recording.wrench)
    found = grips(model.mesh, next(t for t in trials if t.wrench is not None))
    noise = max(marker_noise(recording), _LEAST_NOISE)
    torque = None if sensor.torque_noise_std is None else noise / sensor.torque_noise_std
    made = ForceReadings(found, motion.markers, (noise / sensor.force_noise_std, torque), model.count, noise)
    wrench = measured_wrench(trials, sensor, motion.markers.shape[1], len(found))
    return replace(made, target=made.pack(motion.markers, wrench))


def weighed(
    model: RopeModel, trials: Sequence[Trial], motion: TrialBatch, start: Start, values: dict[str, float]
) -> tuple[ForceReadings, np.ndarray]:
    """Return the forces of trials as readings, and first numbers (K,) of a model with a mass: as heavy as they say.

    Args:
        model: with the mass as a number.
        trials: B trials.
        motion: theirs.
        start: where they begin.
        values: numbers that the markers told.
    """
    known, first = readings(model, trials, motion), model.guess()
    for name, value in values.items():
        first[model.parameters.index(name)] = value
    begun = known.pack(*model.with_forces(motion, start, first[None], known.grips))[0]
    share = _heavier(known, begun)
    for name in _WITH_MASS:
        first[model.parameters.index(name)] *= share
    return known.scaled(begun, share, ~trials[0].gripped), first


def fit_absolute(
    recording: Recording,
    trials: Sequence[Trial],
    options: dict[str, Any],
    effects: Sequence[str],
    fitted: tuple[np.ndarray, ParameterSpace, np.ndarray | None],
    start: Start,
    iterations: int,
    report: Callable[[int, int, str], None],
) -> tuple[RopeModel, Absolute]:
    """Fit the numbers of a calibrated model again, with the mass as one of them.

    Args:
        recording: the rope.
        trials: train trials.
        options: of the model.
        effects: likewise.
        fitted: its values by the order of its numbers, which were fitted, and their drifts.
        start: where the trials begin.
        iterations: most iterations.
        report: called with steps done, steps in all, and a word on how it goes.
    """
    values, space, drifts = fitted
    model = RopeModel(recording, effects=effects, **(options | {"forces": True}))
    motion = model.motion(trials)
    plain = RopeModel(recording, effects=effects, **options).parameters
    report(0, iterations + 2, "")
    known, first = weighed(model, trials, motion, start, dict(zip(plain, values, strict=True)))
    report(1, iterations + 2, f"{first[model.parameters.index('mass')]:.3g} kg")
    sizes = (*space.units, 1.0) if space.sizes else None
    whole = ParameterSpace((*space.names, "mass"), (*space.params, model.params[model.parameters.index("mass")]), sizes)
    columns = [model.parameters.index(name) for name in whole.names]

    def simulate(some: np.ndarray) -> np.ndarray:
        rows = np.repeat(first[None], len(some), 0)
        rows[:, columns] = some
        return known.pack(*model.with_forces(motion, start, rows, known.grips))

    extent = levenberg_marquardt.extent(motion.markers)
    raws = whole.clip(whole.to_raw(first[columns]))[None]
    points = levenberg_marquardt.evaluate(simulate, known.target, whole, raws, extent)
    climbing = levenberg_marquardt.improve_points(
        simulate, known.target, whole, points, iterations=iterations, whole=extent
    )
    for done, points in enumerate(climbing):
        report(done + 2, iterations + 2, f"{float(whole.to_values(points[0].raw)[-1]):.3g} kg")
    report(iterations + 2, iterations + 2, "")
    found = first.copy()
    found[columns] = whole.to_values(points[0].raw)
    mass = float(found[model.parameters.index("mass")])
    return model, Absolute(found, whole, points[0], _drifts(drifts, whole, recording, mass))


def mass_note(told: float, said: float) -> str:
    """Return a sentence on the mass that forces told [kg], and that of rope.json."""
    return (
        f"Forces at the grippers say that the rope has {1e3 * told:.4g} g, rope.json {1e3 * said:.4g} g; "
        "stiffnesses go with the first."
    )


def _usual(deviations: np.ndarray) -> float:
    """Return the standard deviation of normal deviations with the same median as these sizes."""
    return 1.4826 * float(np.nanmedian(deviations))


def _heavier(known: ForceReadings, sims: np.ndarray) -> float:
    """Return by which factor measured forces are larger than simulated ones (B, F, R, 3): a first guess.

    With the least sum of deviations: forces of a rope that is jerked taut are large and hardly told.
    """
    measured, simulated = known.forces(known.target), known.forces(sims)
    good = np.isfinite(measured) & np.isfinite(simulated)
    y, x, share = measured[good], simulated[good], 1.0
    for _ in range(_STEPS):
        weight = 1 / np.maximum(np.abs(y - share * x), known.noise)
        share = float((weight * x * y).sum() / max(float((weight * x * x).sum()), 1e-30))
    return float(np.clip(share, 0.05, 20.0))


def _drifts(before: np.ndarray | None, space: ParameterSpace, recording: Recording, mass: float) -> np.ndarray | None:
    """Return what all trials get wrong alike: as before, and a bias of the forces, which scales mass and stiffness."""
    count, sensor = len(space.names), tree.part(recording.wrench)
    if before is None and not sensor.force_bias_std:
        return None
    rows = np.zeros((0, count)) if before is None else np.pad(before, ((0, 0), (0, 1)))
    weight = mass * float(np.linalg.norm(recording.gravity))
    scale = np.array([float(name in _WITH_MASS) for name in space.names])
    return np.concatenate([rows, sensor.force_bias_std / max(weight, 1e-9) * scale[None]])
