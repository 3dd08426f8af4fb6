"""What a recording says of itself that can hardly be: units, the order of quaternions, which way is down.

Each is a sentence for a person, no refusal: there are strange ropes.
"""

from __future__ import annotations

import numpy as np

from torchdlo.sysid.diagnosis.error_floor import noise_ratio
from torchdlo.sysid.recordings.recording import Recording, Trial
from torchdlo.sysid.recordings.wrench import force_doubts

__all__ = ["doubts"]

_HEAVY = 10.0
"""Mass of a metre of rope from which it must be in another unit [kg/m]."""

_DENSE = 25_000.0
"""Density from which mass or radius must be in another unit [kg/m^3]."""

_LONG = 100.0
"""Length from which it must be in another unit [m]."""

_SHORT_OF = 0.2
"""Share of the length that markers span at least."""

_SAG = 0.03
"""Share of the length by which a rope has to hang down to show where down is."""

_ASKEW = 0.5
"""Cosine between gravity, or an axis, and what shows it, below which they disagree (60 degrees)."""

_NOISY = 3.0
"""Times the noise that neighbouring frames show from which a given one is doubted."""

_GRAVITY = (8.0, 11.0)
"""Size of gravity on earth [m/s^2], roughly."""


def doubts(recording: Recording) -> list[str]:
    """Return what can hardly be, a sentence each with what to look at; none for most recordings."""
    trials = recording.trials("all")
    found = [*_weight(recording), *_length(recording, trials), *_down(recording, trials), *_axes(trials)]
    return [*found, *_noise(recording), *_copies(recording), *force_doubts(recording)]


def _weight(recording: Recording) -> list[str]:
    line = recording.mass / recording.length
    volume = None if not recording.radius else np.pi * recording.radius**2 * recording.length
    if line > _HEAVY:
        dense = "" if volume is None else f" ({recording.mass / volume:.3g} kg/m^3)"
        return [f"mass: {recording.mass:g} kg are {line:.3g} kg a metre{dense}; is it in grams?"]
    if volume is not None and recording.radius and recording.mass / volume > _DENSE:
        return [
            f"mass: {recording.mass:g} kg and a radius of {1e3 * recording.radius:g} mm make "
            f"{recording.mass / volume:.3g} kg/m^3, heavier than any metal; is the radius right, and the mass in kg?"
        ]
    return []


def _noise(recording: Recording) -> list[str]:
    ratio, given = noise_ratio(recording), recording.marker_noise_std or 0.0
    if ratio <= _NOISY:
        return []
    return [
        f"marker_noise_std: it is {1e3 * given:.3g} mm, {ratio:.0f} times what neighbouring "
        "frames show; is it in metres? Nothing smaller is named."
    ]


def _copies(recording: Recording) -> list[str]:
    """Find test trials that are train trials, or stretches of them."""
    return [
        f"{test.name}: its markers are those of {train.name}; a test trial that was fitted to judges nothing."
        for test in recording.test
        for train in recording.train
        if not recording.filmed and _overlap(train, test)
    ]


def _overlap(a: Trial, b: Trial) -> bool:
    """Return whether the free markers of the shorter trial are found in the longer one, from any frame on."""
    short, long = sorted((t.markers[:, ~t.gripped] for t in (a, b)), key=len)
    if short.shape[1:] != long.shape[1:]:
        return False
    room = len(long) - len(short) + 1
    middle = len(short) // 2
    at = np.flatnonzero((long[middle : middle + room] == short[middle]).any((1, 2)))
    return any(np.isfinite(short).any() and np.array_equal(long[k : k + len(short)], short, equal_nan=True) for k in at)


def _length(recording: Recording, trials: tuple[Trial, ...]) -> list[str]:
    span = float(trials[0].marker_arclength[-1] - trials[0].marker_arclength[0])
    if recording.length > _LONG:
        return [f"length: {recording.length:g} m is a long rope; are length, markers and radius in millimetres?"]
    if span < _SHORT_OF * recording.length and len(trials[0].marker_arclength) > 2:
        return [
            f"length: markers span {span:g} m of a rope of {recording.length:g} m; is the length in the unit of the "
            "markers?"
        ]
    return []


def _sag(trial: Trial) -> np.ndarray:
    """Return how far free markers are from where they would be without weight [m], shape (frames, 3), frame by frame.

    That is the line between two grippers, or the one along which a clamp holds the rope, of which only what is across
    counts. Frames in which it is not known are left out.
    """
    held, free = np.flatnonzero(trial.gripped), np.flatnonzero(~trial.gripped)
    s, away = trial.marker_arclength, []
    for marker in free:
        left, right = held[held < marker], held[held > marker]
        here = trial.markers[:, marker][~trial.suspect]
        if len(left) and len(right):
            a, b = left[-1], right[0]
            near, share = trial.markers[~trial.suspect], (s[marker] - s[a]) / (s[b] - s[a])
            apart = here - near[:, a] - share * (near[:, b] - near[:, a])
        else:
            two = left[-2:] if len(left) else right[:2][::-1]
            if len(two) < 2:
                continue
            near = trial.markers[~trial.suspect][:, two]
            axis = near[:, 1] - near[:, 0]
            axis = axis / np.maximum(np.linalg.norm(axis, axis=-1, keepdims=True), 1e-9)
            apart = here - near[:, 1]
            apart = apart - (apart * axis).sum(-1, keepdims=True) * axis
        away.append(apart)
    if not away:
        return np.zeros((0, 3))
    every = np.stack(away, 1)
    seen = np.isfinite(every).all(-1)
    count = seen.sum(1)[:, None]
    total = np.where(seen[..., None], every, 0.0).sum(1)
    return (total / np.maximum(count, 1))[count[:, 0] > 0]


def _down(recording: Recording, trials: tuple[Trial, ...]) -> list[str]:
    """Compare gravity with where the rope hangs."""
    size = float(np.linalg.norm(recording.gravity))
    said = []
    if size > 0 and not _GRAVITY[0] < size < _GRAVITY[1]:
        said.append(f"gravity: it is {size:g} m/s^2; expected 9.8 on earth, in metres per square second.")
    # What lies on a table, or has a shape of its own, need not hang down.
    known = [trial for trial in trials if not trial.suspect.all() and (~trial.gripped).any()]
    if size == 0 or recording.table_height is not None or not known:
        return said
    frames = np.concatenate([_sag(trial) for trial in known])
    if not len(frames):
        return said
    sag = frames.mean(0)
    far, swings = float(np.linalg.norm(sag)), float(np.linalg.norm(frames.std(0)))
    # A rope that swings more than it hangs does not show where down is.
    if far < max(_SAG * recording.length, swings) or float(sag @ recording.gravity) > _ASKEW * far * size:
        return said
    axis = int(np.argmax(np.abs(sag)))
    name, hangs = "xyz"[axis], "-" if sag[axis] < 0 else "+"
    given = ", ".join(f"{g:g}" for g in recording.gravity)
    return [
        *said,
        f"gravity: it is [{given}], but the rope hangs towards {hangs}{name}; turn the markers (not gravity: "
        "effects take z for the vertical) so that it hangs along gravity.",
    ]


def _rotate(quaternion: np.ndarray) -> np.ndarray:
    """Return the x axis that quaternions (..., 4), (w, x, y, z), turn to, shape (..., 3)."""
    w, x, y, z = np.moveaxis(quaternion, -1, 0)
    return np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], -1)


def _axes(trials: tuple[Trial, ...]) -> list[str]:
    """Compare the x axes of clamps with their two markers."""
    given, other = [], []
    for trial in trials:
        if trial.gripper_quaternion is None or trial.gripper_marker is None:
            continue
        for clamp, marker in enumerate(trial.gripper_marker):
            beside = [m for m in (marker - 1, marker + 1) if 0 <= m < len(trial.gripped) and trial.gripped[m]]
            if not beside:
                continue
            a, b = sorted((int(marker), int(beside[0])))
            chord = trial.markers[:, b] - trial.markers[:, a]
            chord = chord / np.linalg.norm(chord, axis=-1, keepdims=True)
            quaternion = trial.gripper_quaternion[:, clamp]
            given.append(np.median((_rotate(quaternion) * chord).sum(-1)))
            other.append(np.median((_rotate(np.roll(quaternion, 1, -1)) * chord).sum(-1)))
    if not given or np.mean(given) > _ASKEW:
        return []
    if np.mean(other) > max(_ASKEW, np.mean(given) + 0.3):
        return [
            "gripper_quaternion: read as (x, y, z, w) they fit the markers; expected (w, x, y, z): roll them by one."
        ]
    angle = float(np.degrees(np.arccos(np.clip(np.mean(given), -1, 1))))
    return [
        f"gripper_quaternion: their x axes are {angle:.0f} degrees off the line through the markers of a clamp; "
        "expected them along the rope."
    ]
