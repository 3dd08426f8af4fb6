"""Motions of the grippers that a laboratory can do, within the workspace and the speeds of what it has recorded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import savgol_filter
from scipy.spatial.transform import Rotation

from torchdlo.errors import InputError
from torchdlo.sysid.model import initial_state as starts
from torchdlo.sysid.model.trial_batch import Start
from torchdlo.sysid.recordings.recording import Recording, Trial

__all__ = [
    "KINDS",
    "ExcitationMotion",
    "GripperLimits",
    "first_pose",
    "largest_amplitude",
    "make_rig",
    "motion_menu",
    "motion_trial",
    "nearby_motions",
]

KINDS = {
    "hold": "holds still",
    "swing": "swings sideways",
    "ladder": "swings sideways, wider and wider",
    "stop": "goes to and fro in strokes, with stops",
    "pump": "pumps up and down",
    "circle": "goes round in a circle",
    "against": "moves the clamps towards each other and back",
    "nod": "turns the clamps about a level axis, to and fro",
    "roll": "rolls the clamps about the rope",
}
"""What a motion does, in words."""

_LEAST = {"m": 5e-3, "rad": 0.05}
"""Smaller motions are not worth a trial."""

_ROLL_RATE = np.pi
"""Rate [rad/s] at which a wrist may roll where the recording shows none that is faster."""

_PAUSE = 0.3
"""Seconds at rest before a motion: the start is read off the first tenth of a second."""

_WINDOW = 0.1
"""Seconds over which measured motion is smoothed before speeds are read off it."""


@dataclass(frozen=True)
class ExcitationMotion:
    """One motion of all grippers."""

    kind: str
    """See `KINDS`."""
    frequency: float = 1.0
    """Turns, strokes or half turns of a roll per second [Hz]."""
    direction: float = 0.0
    """Level direction of the motion, in the rig [rad]."""
    heading: float = 0.0
    """By how much the whole rig is turned about the vertical [rad]."""
    share: float = 1.0
    """Amplitude, as a share of the largest that workspace and speeds allow."""
    pause: float = _PAUSE
    """Time at rest before [s]."""
    moving: float = 1e3
    """Time after which the motion dies out [s]."""
    mass: float = 0.0
    """Known mass that is hung on the rope [kg]."""


@dataclass(frozen=True, eq=False)
class GripperLimits:
    """Where the grippers start, and how far and how fast they may go."""

    trial: Trial
    """Trial whose start is taken: markers, their places, and clamps."""
    markers: np.ndarray
    """Where the markers are at the start, the grippers in the middle of their workspace [m], shape (M, 3)."""
    groups: tuple[np.ndarray, ...]
    """Gripped markers of each gripper."""
    still: bool
    """Whether the rope hangs at rest at the start."""
    reach: np.ndarray
    """How far the grippers may go to both sides along x, y, z [m], shape (3,)."""
    closer: float
    """By how much two grippers may come closer [m]."""
    speed: float
    """Largest speed of a gripper [m/s]."""
    acceleration: float
    """Largest acceleration of a gripper [m/s^2]."""
    angle: float
    """Largest turn of a clamp's direction [rad]."""
    turning: float
    """Largest rate at which a clamp turns [rad/s]."""


def make_rig(recording: Recording, scale: float = 1.0) -> GripperLimits:
    """Return what the grippers of a recording can do.

    Args:
        recording: what was measured.
        scale: by what factor motions may leave its workspace, and exceed its speeds.
    """
    trials = (*recording.train, *recording.test)
    calm = starts.calm(recording, recording.train)
    trial = recording.train[int(np.argmax(calm))]
    gripped = np.flatnonzero(trial.gripped)
    groups = tuple(np.split(gripped, np.flatnonzero(np.diff(gripped) > 1) + 1))
    centres = [np.stack([t.markers[:, g].mean(1) for g in groups], 1) for t in trials]
    if not all(np.isfinite(c).all() for c in centres):
        raise InputError(f"{recording.path}: gripped markers are not seen in all frames; their motion sets the limits.")
    middle = np.concatenate([c.mean(1) for c in centres])
    low, high = middle.min(0), middle.max(0)
    markers = starts.read_off([trial]).pos[0]
    at = _middle(markers, groups)
    shift, reach = 0.5 * (low + high) - at, 0.5 * (high - low)
    if recording.table_height is not None:
        # Lifted, or pressed down, a rope on a table would be another experiment.
        shift[2], reach[2] = 0.0, max(min(at[2] - low[2], high[2] - at[2]), 0.0)
    dt = float(trial.time[1] - trial.time[0])
    rates = [_rates(c, dt) for c in centres]
    turns = [_turns(t, g, dt) for t in trials for g in groups if len(g) > 1]
    apart = [np.linalg.norm(c[:, 0] - c[:, -1], axis=-1) for c in centres]
    first = float(np.linalg.norm(markers[groups[0]].mean(0) - markers[groups[-1]].mean(0)))
    return GripperLimits(
        trial,
        markers + shift,
        groups,
        bool(calm.any()),
        scale * reach,
        scale * max(first - min(float(a.min()) for a in apart), 0.0),
        scale * max(v for v, _ in rates),
        scale * max(a for _, a in rates),
        scale * max((a for a, _ in turns), default=0.0),
        max(scale * max((w for _, w in turns), default=0.0), _ROLL_RATE),
    )


def _middle(markers: np.ndarray, groups: Sequence[np.ndarray]) -> np.ndarray:
    """Return the mean of the centres of the grippers [m], shape (3,)."""
    return np.mean([markers[g].mean(0) for g in groups], 0)


def _smooth(x: np.ndarray, dt: float, order: int) -> np.ndarray:
    """Return smoothed values (F, ...) or a derivative of them (Savitzky and Golay 1964, doi:10.1021/ac60214a047)."""
    window = min(2 * round(0.5 * _WINDOW / dt) + 1, (len(x) - 1) // 2 * 2 + 1)
    return savgol_filter(x, max(window, 5), 3, deriv=order, delta=dt, axis=0)


def _rates(centre: np.ndarray, dt: float) -> tuple[float, float]:
    """Return the largest speed [m/s] and acceleration [m/s^2] of grippers (F, G, 3), but for single frames."""
    size = [np.linalg.norm(_smooth(centre, dt, k), axis=-1) for k in (1, 2)]
    return float(np.percentile(size[0], 99)), float(np.percentile(size[1], 99))


def _turns(trial: Trial, group: np.ndarray, dt: float) -> tuple[float, float]:
    """Return how far a clamp turns from its first direction [rad], and how fast [rad/s]."""
    chord = _smooth(trial.markers[:, group[-1]] - trial.markers[:, group[0]], dt, 0)
    axis = chord / np.linalg.norm(chord, axis=-1, keepdims=True)
    angle = np.arccos(np.clip(axis @ axis[0], -1, 1))
    rate = np.linalg.norm(np.gradient(axis, dt, axis=0), axis=-1)
    return float(np.percentile(angle, 99)), float(np.percentile(rate, 99))


def motion_menu(rig: GripperLimits, seconds: float, gravity: float, mass: float = 0.0) -> list[ExcitationMotion]:
    """Return motions that are worth a try, those that limits leave too small left out.

    Args:
        rig: the grippers.
        seconds: how long a trial lasts.
        gravity: its size [m/s^2].
        mass: known mass that may be hung on the rope [kg], 0 for none.
    """
    length = float(np.ptp(rig.trial.marker_arclength))
    slow = 1 / (seconds - _PAUSE)
    # About where a hanging chain swings by itself: its lowest frequency is 1.2 sqrt(g / L) (Bernoulli 1738).
    swinging = 1.2 / (2 * np.pi) * np.sqrt(max(gravity, 1.0) / length)
    # Where the limits of speed and of acceleration meet.
    fast = float(np.clip(rig.acceleration / (2 * np.pi * max(rig.speed, 1e-6)), swinging, 4.0))
    quarter, half = 0.5 * np.pi, np.pi
    found = [ExcitationMotion("hold", heading=h) for h in (0.0, quarter, half)]
    found += [ExcitationMotion("swing", f, d) for f in (slow, swinging, fast) for d in (0.0, quarter)]
    found += [ExcitationMotion("swing", swinging, 0.0, h) for h in (quarter, half)]
    found += [ExcitationMotion("ladder", swinging, d) for d in (0.0, quarter)]
    found += [ExcitationMotion("stop", fast, d) for d in (0.0, quarter)]
    found += [ExcitationMotion("pump", f) for f in (swinging, fast)]
    found += [ExcitationMotion("circle", f) for f in (slow, swinging)]
    found += [ExcitationMotion("against", f) for f in (slow, swinging)] if len(rig.groups) == 2 else []
    found += [ExcitationMotion("nod", f) for f in (slow, swinging, fast)]
    if rig.trial.gripper_quaternion is not None:
        # Measured rotations only: else nobody knows how the rope lies in the clamp.
        # The peak of `_rise` is 15/8 of its mean rate.
        found += [ExcitationMotion("roll", min(rig.turning / (1.876 * np.pi), 1.0), heading=h) for h in (0.0, quarter)]
    if mass:
        found += [replace(g, mass=mass) for g in found if g.kind in ("hold", "swing") and g.heading == 0.0]
    return [g for g in found if g.kind == "hold" or _worth(*largest_amplitude(rig, g, seconds))]


def _worth(amplitude: float, unit: str) -> bool:
    return amplitude >= _LEAST[unit]


def _rise(x: np.ndarray) -> np.ndarray:
    """Return a step from 0 to 1 of least jerk (Flash and Hogan 1985, doi:10.1523/JNEUROSCI.05-07-01688.1985)."""
    x = np.clip(x, 0, 1)
    return x**3 * (10 - 15 * x + 6 * x**2)


def _profile(gesture: ExcitationMotion, time: np.ndarray) -> tuple[np.ndarray, str]:
    """Return the motion of amplitude 1 and its channel.

    Channels are "level" and "up", shape (F, 2) along and across and (F, 1), and "apart", "nod" and "roll", (F, 1).
    """
    f, tau = gesture.frequency, np.clip(time - gesture.pause, 0, None)
    swell = _rise(f * tau) * _rise(f * (gesture.moving + 1 / f - tau))
    wave, zero = swell * np.sin(2 * np.pi * f * tau), np.zeros_like(tau)
    if gesture.kind == "hold":
        return np.stack([zero, zero], -1), "level"
    if gesture.kind == "swing":
        return np.stack([wave, zero], -1), "level"
    if gesture.kind == "ladder":
        third = min(gesture.moving, time[-1] - gesture.pause) / 3
        steps = (1 + _rise(f * (tau - third)) + _rise(f * (tau - 2 * third))) / 3
        return np.stack([steps * wave, zero], -1), "level"
    if gesture.kind == "stop":
        count = int(min(gesture.moving, time[-1]) * f) + 1
        strokes = sum((-1) ** k * _rise(2 * f * (tau - k / f)) for k in range(count))
        return np.stack([strokes, zero], -1), "level"
    if gesture.kind == "circle":
        return np.stack([wave, swell * np.cos(2 * np.pi * f * tau)], -1), "level"
    channel = {"pump": "up", "against": "apart", "nod": "nod", "roll": "roll"}[gesture.kind]
    single = {
        "against": 0.5 * swell * (1 - np.cos(2 * np.pi * f * tau)),
        "roll": _rise(f * tau),
    }.get(gesture.kind, wave)
    return single[:, None], channel


def _axes(gesture: ExcitationMotion, channel: str) -> np.ndarray:
    """Return the directions of a channel's columns in the rig, shape (C, 3)."""
    c, s = np.cos(gesture.direction), np.sin(gesture.direction)
    return np.array([[c, s, 0.0], [-s, c, 0.0]]) if channel == "level" else np.array([[0.0, 0.0, 1.0]])


def largest_amplitude(rig: GripperLimits, gesture: ExcitationMotion, seconds: float) -> tuple[float, str]:
    """Return the amplitude of a motion and its unit, "m" or "rad": as large as all limits allow, times its share."""
    time = np.linspace(0, seconds, 4 * round(seconds / (rig.trial.time[1] - rig.trial.time[0])) + 1)
    unit, channel = _profile(gesture, time)
    path = unit @ _axes(gesture, channel) if channel in ("level", "up") else unit
    first = np.gradient(path, time, axis=0)
    most = [np.linalg.norm(x, axis=-1).max() for x in (path, first, np.gradient(first, time, axis=0))]
    if channel in ("nod", "roll"):
        limits = [(np.pi if channel == "roll" else rig.angle, most[0]), (rig.turning, most[1])]
    elif channel == "apart":
        # Each of the two goes half of the way.
        limits = [(rig.closer, most[0]), (2 * rig.speed, most[1]), (2 * rig.acceleration, most[2])]
    else:
        limits = [*zip(rig.reach, np.abs(path).max(0), strict=True), (rig.speed, most[1]), (rig.acceleration, most[2])]
    amplitude = min((limit / size for limit, size in limits if size > 1e-9), default=0.0)
    return gesture.share * float(amplitude), "rad" if channel in ("nod", "roll") else "m"


def motion_trial(rig: GripperLimits, gesture: ExcitationMotion, seconds: float, name: str) -> Trial:
    """Return the motion as a trial; where the free markers will be is not known, NaN."""
    trial = rig.trial
    dt = float(trial.time[1] - trial.time[0])
    time = dt * np.arange(round(seconds / dt) + 1)
    unit, channel = _profile(gesture, time)
    amount = largest_amplitude(rig, gesture, seconds)[0] * unit
    markers = np.full((len(time), *rig.markers.shape), np.nan)
    markers[:, trial.gripped] = rig.markers[trial.gripped]
    if channel in ("level", "up"):
        markers += (amount @ _axes(gesture, channel))[:, None]
    quaternion = trial.gripper_quaternion
    turned = None if quaternion is None else np.repeat(quaternion[:1], len(time), 0)
    ends = [rig.markers[g].mean(0) for g in rig.groups]
    for k, group in enumerate(rig.groups):
        if channel == "apart":
            towards = ends[1 - k] - ends[k]
            markers[:, group] += 0.5 * amount[:, None] * towards / np.linalg.norm(towards)
        if channel in ("nod", "roll") and len(group) > 1:
            turn = _clamp_turn(rig, group, gesture, channel, amount)
            for m in group:
                markers[:, m] = ends[k] + turn.apply(rig.markers[m] - ends[k])
            if turned is None or trial.gripper_marker is None:
                continue
            for c in np.flatnonzero(np.isin(trial.gripper_marker, group)):
                turned[:, c] = (turn * Rotation.from_quat(turned[:, c], scalar_first=True)).as_quat(scalar_first=True)
    rig_turn = Rotation.from_rotvec([0.0, 0.0, gesture.heading])
    if turned is not None:
        for clamp in range(turned.shape[1]):
            around = rig_turn * Rotation.from_quat(turned[:, clamp], scalar_first=True)
            turned[:, clamp] = around.as_quat(scalar_first=True)
    return Trial(
        name,
        time,
        _about(rig, rig_turn, markers),
        trial.marker_arclength,
        trial.gripped,
        turned,
        trial.gripper_marker,
        np.zeros(len(time), bool),
    )


def _clamp_turn(
    rig: GripperLimits, group: np.ndarray, gesture: ExcitationMotion, channel: str, amount: np.ndarray
) -> Rotation:
    """Return how a clamp is turned at each frame."""
    axis = rig.markers[group[-1]] - rig.markers[group[0]]
    if channel == "nod":
        level = np.cross([0.0, 0.0, 1.0], axis)
        steep = np.linalg.norm(level) < 0.05 * np.linalg.norm(axis)
        axis = np.array([-np.sin(gesture.direction), np.cos(gesture.direction), 0.0]) if steep else level
    return Rotation.from_rotvec(amount * axis / np.linalg.norm(axis))


def _about(rig: GripperLimits, turn: Rotation, points: np.ndarray) -> np.ndarray:
    """Turn points (..., 3) about the vertical through the middle of the grippers."""
    pivot = _middle(rig.markers, rig.groups)
    return pivot + turn.apply((points - pivot).reshape(-1, 3)).reshape(points.shape)


def first_pose(rig: GripperLimits, gestures: Sequence[ExcitationMotion]) -> Start:
    """Return where the rope is when motions begin, before it comes to rest."""
    turns = [Rotation.from_rotvec([0.0, 0.0, g.heading]) for g in gestures]
    pos = np.stack([_about(rig, turn, rig.markers) for turn in turns])
    return Start(pos, np.zeros_like(pos), np.full(len(pos), rig.still))


def nearby_motions(
    gesture: ExcitationMotion, rng: np.random.Generator, count: int, wide: float, seconds: float
) -> list[ExcitationMotion]:
    """Return motions like a given one, with other amplitude, frequency, direction and timing.

    Args:
        gesture: the one.
        rng: for the differences.
        count: how many.
        wide: how different: 1 for a factor of about two in frequency.
        seconds: how long a trial lasts.
    """
    found = []
    for f, d, a, p, m in wide * rng.normal(size=(count, 5)):
        pause = float(np.clip(gesture.pause + 0.3 * p, _PAUSE, 0.5 * seconds))
        moving = min(gesture.moving, seconds - pause) * float(np.exp(0.4 * m))
        found.append(
            replace(
                gesture,
                frequency=float(np.clip(gesture.frequency * np.exp(0.5 * f), 0.5 / seconds, 5.0)),
                direction=gesture.direction + 0.6 * d,
                share=float(np.clip(gesture.share * np.exp(0.3 * a), 0.3, 1.0)),
                pause=pause,
                moving=float(np.clip(moving, 0.2 * seconds, seconds)),
            )
        )
    return found
