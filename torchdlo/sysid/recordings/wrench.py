"""Force and torque at the grippers, as measured: in one frame, and whether they can be those of the rope."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from torchdlo.errors import InputError
from torchdlo.physics.linalg import rotation

if TYPE_CHECKING:
    from torchdlo.sysid.recordings.recording import Recording, Trial

__all__ = ["FRAMES", "ForceSensor", "check_forces", "force_doubts", "world_wrench"]

FRAMES = ("world", "gripper")
"""Frames in which forces may be given."""

_WRONG = np.radians(45.0)
"""Angle between the mean force and the weight from which frame or sign must be wrong."""

_OFF = 0.25
"""Share by which the force that carries the rope may differ from its weight."""

_DRIFTS = 4.0
"""Standard errors from which a drift is one."""


@dataclass(frozen=True)
class ForceSensor:
    """How forces at the grippers were measured."""

    frame: str
    """`world`, or `gripper`: the clamp's own axes."""
    force_noise_std: float
    """Standard deviation of the noise per component [N]."""
    torque_noise_std: float | None = None
    """The same of torques [N m]; None if torques are not to be used."""
    force_bias_std: float = 0.0
    """How far off a force may be all the time [N]."""


def world_wrench(trial: Trial, sensor: ForceSensor) -> np.ndarray:
    """Return force [N] and torque about the gripper's marker [N m] on the rope in the world frame, shape (F, W, 6)."""
    if trial.wrench is None or trial.wrench_marker is None:
        raise ValueError(f"{trial.name}: expected a trial with forces.")
    if sensor.frame == "world":
        return trial.wrench
    return np.stack([_turned(trial, k) for k in range(len(trial.wrench_marker))], 1)


def _turned(trial: Trial, k: int) -> np.ndarray:
    """Return what gripper k measured in its own frame in that of the world, shape (F, 6)."""
    if trial.wrench is None or trial.wrench_marker is None:
        raise ValueError(f"{trial.name}: expected a trial with forces.")
    quat = _orientation(trial, int(trial.wrench_marker[k]))
    if quat is None:
        raise ValueError(f"{trial.name}: expected gripper_quaternion for forces in the gripper's frame.")
    parts = (trial.wrench[:, k, :3], trial.wrench[:, k, 3:])
    turned = [rotation.rotate(torch.as_tensor(quat), torch.as_tensor(x)).numpy() for x in parts]
    return np.concatenate(turned, -1)


def _orientation(trial: Trial, marker: int) -> np.ndarray | None:
    """Return the orientation of the clamp whose marker it is, shape (F, 4), None if it was not measured."""
    if trial.gripper_quaternion is None or trial.gripper_marker is None:
        return None
    found = np.flatnonzero(trial.gripper_marker == marker)
    return trial.gripper_quaternion[:, int(found[0])] if len(found) else None


def _all_grips(trial: Trial) -> bool:
    """Return whether the forces of all grippers were measured."""
    gripped = np.flatnonzero(trial.gripped)
    runs = len(np.split(gripped, np.flatnonzero(np.diff(gripped) > 1) + 1))
    return trial.wrench_marker is not None and len(trial.wrench_marker) == runs


def _mass(recording: Recording) -> float:
    """Return the mass of the rope with its markers [kg]."""
    return recording.mass + (recording.marker_mass or 0.0) * len(recording.train[0].marker_arclength)


def _displaced(recording: Recording) -> float:
    """Return the mass of the liquid that the rope displaces [kg]."""
    if recording.fluid_density is None or recording.radius is None:
        return 0.0
    return recording.fluid_density * np.pi * recording.radius**2 * recording.length


def check_forces(recording: Recording) -> None:
    """Refuse forces that cannot be those of the rope: of the wrong sign or in another frame.

    Grippers carry the weight of a rope that nothing else touches, on average over a motion that comes to nothing.

    Raises:
        InputError: They are not.
    """
    sensor, trials = recording.wrench, _weighed(recording)
    if sensor is None or not trials:
        return
    weight = (_displaced(recording) - _mass(recording)) * np.asarray(recording.gravity)
    if np.linalg.norm(weight) == 0:
        return
    mean = _mean([world_wrench(t, sensor) for t in trials])
    if _angle(mean, weight) < _WRONG:
        return
    where = f"{recording.path / trials[0].name}.npz: wrench"
    if _angle(-mean, weight) < _WRONG:
        raise InputError(
            f"{where}: expected what grippers exert on the rope, found what carries {_newton(-mean, weight)} N of its "
            "weight when turned round; multiply it by -1."
        )
    other = FRAMES[1 - FRAMES.index(sensor.frame)]
    oriented = all(_orientation(t, int(m)) is not None for t in trials for m in t.wrench_marker)  # type: ignore[union-attr]  # weighed
    if other == "world" or oriented:
        again = _mean([world_wrench(t, ForceSensor(other, sensor.force_noise_std)) for t in trials])
        if _angle(again, weight) < _WRONG:
            raise InputError(
                f"{where}: expected forces in the {sensor.frame} frame, as rope.json says, found ones that carry the "
                f"rope if they are in the {other} frame; set wrench.frame to {other}."
            )
    off = np.degrees(_angle(mean, weight))
    raise InputError(
        f"{where}: expected forces that carry the rope, found a mean force {off:.0f} degrees off the vertical; "
        "is the sensor's own load taken off, and its frame right?"
    )


def force_doubts(recording: Recording) -> list[str]:
    """Return sentences on what can hardly be with the forces of a recording."""
    sensor, trials = recording.wrench, _weighed(recording)
    if sensor is None or not trials:
        return []
    found, said = [], _mass(recording)
    told = _told_mass(trials, recording, sensor)
    if abs(told / said - 1) > _OFF:
        found.append(
            f"wrench: the forces are those of a rope of {1e3 * told:.3g} g, rope.json says {1e3 * said:.3g} g with its "
            "markers: is the mass wrong, or is the weight of grippers or a bias not taken off?"
        )
    for trial in trials:
        slope, error = _drift(trial, recording, sensor)
        far = float(trial.time[-1]) * slope
        sure = (np.abs(slope) > _DRIFTS * error) & (np.abs(far) > 2 * sensor.force_noise_std)
        if sure.any():
            worst = int(np.where(sure, np.abs(far), 0.0).argmax())
            found.append(
                f"wrench: in {trial.name} the force drifts by {far[worst]:.2g} N along {'xyz'[worst]}, which the "
                "rope's motion does not explain: a bias that warms up?"
            )
    return found


def _weighed(recording: Recording) -> list[Trial]:
    """Return the train trials in which grippers with sensors carry all of the rope."""
    if recording.table_height is not None:
        return []
    return [t for t in recording.train if t.wrench is not None and _all_grips(t)]


def _mean(wrenches: Sequence[np.ndarray]) -> np.ndarray:
    """Return the mean total force [N], shape (3,)."""
    return np.mean([np.nanmean(w[..., :3].sum(1), 0) for w in wrenches], 0)


def _angle(force: np.ndarray, weight: np.ndarray) -> float:
    """Return the angle between two vectors [rad]; pi/2 where there is no force."""
    size = float(np.linalg.norm(force) * np.linalg.norm(weight))
    return float(np.arccos(np.clip(force @ weight / size, -1, 1))) if size else 0.5 * np.pi


def _newton(force: np.ndarray, weight: np.ndarray) -> str:
    return f"{force @ weight / np.linalg.norm(weight):.3g}"


def _acceleration(trial: Trial) -> tuple[np.ndarray, np.ndarray]:
    """Return the acceleration of the rope's centre of mass [m/s^2], shape (F, 3), and where it is known, (F,) bool."""
    from scipy.signal import savgol_filter

    step_along = np.diff(trial.marker_arclength)
    share = 0.5 * (np.append(step_along, 0.0) + np.append(0.0, step_along)) / step_along.sum()
    centre = (share[:, None] * trial.markers).sum(1)
    step = float(trial.time[1] - trial.time[0])
    window = min(2 * round(0.05 / step) + 1, (len(centre) - 1) // 2 * 2 - 1)
    good = np.isfinite(centre).all(1) & ~trial.suspect
    if window < 5 or good.sum() < window:
        return np.zeros_like(centre), np.zeros(len(centre), bool)
    smooth = np.stack([np.interp(trial.time, trial.time[good], x[good]) for x in centre.T], 1)
    return savgol_filter(smooth, window, 3, deriv=2, delta=step, axis=0), good


def _told_mass(trials: Sequence[Trial], recording: Recording, sensor: ForceSensor) -> float:
    """Return the mass that goes best with forces F = m (a - g), less what a liquid carries [kg]."""
    work, size = 0.0, 0.0
    for trial in trials:
        acceleration, known = _acceleration(trial)
        force = world_wrench(trial, sensor)[..., :3].sum(1) - _displaced(recording) * np.asarray(recording.gravity)
        known &= np.isfinite(force).all(1)
        pull = acceleration[known] - np.asarray(recording.gravity)
        work, size = work + float((force[known] * pull).sum()), size + float((pull**2).sum())
    return work / size if size else _mass(recording)


def _drift(trial: Trial, recording: Recording, sensor: ForceSensor) -> tuple[np.ndarray, np.ndarray]:
    """Return the drift of the total force [N/s] beyond mass times acceleration of the rope, and its standard error."""
    force = world_wrench(trial, sensor)[..., :3].sum(1)
    acceleration, good = _acceleration(trial)
    good &= np.isfinite(force).all(1)
    if good.sum() < 5:
        return np.zeros(3), np.ones(3)
    terms = np.stack([np.ones_like(trial.time), trial.time - trial.time.mean()], 1)[good]
    rest = (force - _mass(recording) * acceleration)[good]
    fit, *_ = np.linalg.lstsq(terms, rest, rcond=None)
    left = rest - terms @ fit
    # What is left is not white: a tenth of a second is one reading.
    count = max(good.sum() * float(trial.time[1] - trial.time[0]) / 0.1, 3.0)
    return fit[1], left.std(0) / np.sqrt(count) / max(float(terms[:, 1].std()), 1e-12)
