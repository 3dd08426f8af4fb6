"""Whether recorded data can be trusted: labels, jumps, frames, the clock, spacing, the camera, mass and length.

A fault of the data would be named as a missing effect of the rope. What would make any result wrong is refused; what
concerns some frames or markers is taken out and said. What a file may not look like at all, `checks` refuses before.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from torchdlo.errors import InputError
from torchdlo.sysid.diagnosis.error_floor import marker_noise as noise_of
from torchdlo.sysid.diagnosis.error_floor import noise_ratio
from torchdlo.sysid.recordings.marker_spacing import spacing_faults
from torchdlo.sysid.recordings.recording import Recording, Trial

__all__ = ["DataIssue", "check"]

_DENSITY = (20.0, 23_000.0)
"""Of a rope, over its whole cross-section [kg/m^3]: light foam and osmium."""

_GRAVITY = 40.0
"""Acceleration of gravity that is not in m/s^2 any more."""

_SMALLEST = 4e-3
"""Jumps below this are left in [m]: a robust fit takes them."""

_OTHER = 0.4
"""Share of frames that repeat the one before from which it is said that every other one does."""

_FEWEST = 5
"""Frames with a free marker below which a trial tells nothing."""

_NOISY = 10.0
"""Times the noise that neighbouring frames show from which a given one must be in another unit."""

_SHARPEST = 100.0
"""Change of acceleration from frame to frame that a rope may show when it is jerked taut [m/s^2]."""

_WAVE = 0.25
"""Share of a marker's step that the markers beside it take as well where both follow a wave in the rope."""

_FADES = 0.5
"""Time after which a rope has forgotten that a few frames are missing [s]."""


@dataclass(frozen=True)
class DataIssue:
    """One thing that is wrong with the data."""

    trial: str
    """Name of the trial, empty if it is about all."""
    kind: str
    """swap, jump, stall, clock, camera, cut, drift, length, place, unseen."""
    message: str
    """What was found, and what was done about it."""


def check(recording: Recording) -> tuple[Recording, list[DataIssue]]:
    """Return the recording without what cannot be trusted, and what that was.

    Raises:
        InputError: No result could be right with these data.
    """
    _check_rope(recording)
    recording, faults = _judgeable(recording)
    _check_noise(recording)
    trials = (*recording.train, *recording.test)
    _check_clocks(recording, trials)
    noise, mended = noise_of(recording), {}
    for trial in trials:
        mended[trial.name], found = _mend(trial, noise)
        faults += found
        left = mended[trial.name].markers[~mended[trial.name].suspect][:, ~trial.gripped]
        if found and np.isfinite(left).all(-1).any(-1).sum() < 10:
            raise InputError(
                f"{recording.path / trial.name}.npz: {found[0].message}; too little is left of this trial: "
                "leave it out."
            )
    clean = replace(
        recording,
        train=tuple(mended[t.name] for t in recording.train),
        test=tuple(mended[t.name] for t in recording.test),
    )
    faults += [DataIssue(*f) for f in spacing_faults(clean, noise)]
    usual = float(np.median([t.time[-1] for t in trials]))
    for t in trials:
        if t.time[-1] < 0.5 * usual:
            faults.append(
                DataIssue(t.name, "cut", f"it lasts {t.time[-1]:.2f} s, the others {usual:.2f} s: was it cut?")
            )
    return clean, faults


def _check_rope(recording: Recording) -> None:
    """Refuse a mass, a radius or a gravity in another unit."""
    file = recording.path / "rope.json"
    size = float(np.linalg.norm(recording.gravity))
    if size > _GRAVITY:
        raise InputError(f"{file}: gravity: expected m/s^2, found {size:g}; divide by {100 if size < 2000 else 1000}.")
    if recording.radius is None:
        return
    density = recording.mass / (np.pi * recording.radius**2 * recording.length)
    if not _DENSITY[0] <= density <= _DENSITY[1]:
        hint = "mass looks like grams" if 1 < density / 1e3 / _DENSITY[0] and density > 1e5 else "one of them is wrong"
        raise InputError(
            f"{file}: mass, radius and length: together they make {density:.3g} kg/m^3, expected {_DENSITY[0]:g} to "
            f"{_DENSITY[1]:g}; {hint} (kg and m are expected)."
        )


def _judgeable(recording: Recording) -> tuple[Recording, list[DataIssue]]:
    """Return the recording without trials that have nothing to judge by, and which these are."""
    if recording.filmed:
        return recording, []
    kept, faults = {}, []
    for split in ("train", "test"):
        trials = recording.trials(split)
        seen = [int((np.isfinite(t.markers[:, ~t.gripped]).all(-1).any(-1) & ~t.suspect).sum()) for t in trials]
        kept[split] = tuple(t for t, count in zip(trials, seen, strict=True) if count >= _FEWEST)
        lost = [(t, count) for t, count in zip(trials, seen, strict=True) if count < _FEWEST]
        if not kept[split]:
            raise InputError(
                f"{recording.path / lost[0][0].name}.npz: markers: expected free markers in at least {_FEWEST} frames "
                f"that are not suspect, found {lost[0][1]}, and no better {split} trial; nothing could be judged."
            )
        said = f"free markers are seen in fewer than {_FEWEST} frames that are not suspect: the trial is left out"
        faults += [DataIssue(t.name, "unseen", said) for t, _ in lost]
    return replace(recording, train=kept["train"], test=kept["test"]), faults


def _check_noise(recording: Recording) -> None:
    """Refuse a noise beside which nothing that markers do would count."""
    given, ratio = recording.marker_noise_std, noise_ratio(recording)
    if given is not None and ratio > _NOISY:
        raise InputError(
            f"{recording.path / 'rope.json'}: marker_noise_std: expected metres, found {given:g}, {ratio:.0f} times "
            "what neighbouring frames show; is it in mm? Give null where it is not known."
        )


def _check_clocks(recording: Recording, trials: Sequence[Trial]) -> None:
    first = trials[0]
    step = first.time[1] - first.time[0]
    for t in trials[1:]:
        own = t.time[1] - t.time[0]
        if abs(own - step) > 1e-3 * step:
            raise InputError(
                f"{recording.path / t.name}.npz: time: expected frames every {1e3 * step:.4g} ms as in "
                f"{first.name}.npz, found every {1e3 * own:.4g} ms; is the clock of one of them scaled? "
                "Else interpolate to one rate."
            )


def _mend(trial: Trial, noise: float) -> tuple[Trial, list[DataIssue]]:
    """Return a trial without frames and markers that cannot be trusted, and why."""
    markers, suspect, faults = trial.markers.copy(), trial.suspect.copy(), []
    stalled = _stalls(trial, noise)
    if stalled.any():
        suspect |= stalled
        every = " (every other frame: was it filled up to twice its rate?)" if stalled[1:].mean() > _OTHER else ""
        faults.append(DataIssue(trial.name, "stall", f"{_frames(stalled)} repeat the frame before: left out{every}"))
    seen = np.where(suspect[:, None, None], np.nan, markers)
    steps, frame = _steps(seen), trial.time[1] - trial.time[0]
    size = np.linalg.norm(steps, axis=-1)
    events = _events(size, noise, frame)
    for f in _common(size, noise):
        fault = None if suspect[f] else _all_at_once(trial, seen, steps, f)
        if fault is not None:
            faults.append(fault)
            last = f + round(_FADES / frame) if fault.kind == "clock" else len(suspect)
            suspect[f:last] = True
            events[f - 1 : max(last, f + 2)] = False
    wrong, said = _labels(trial, seen, events, size)
    markers[wrong] = np.nan
    return replace(trial, markers=markers, suspect=suspect), faults + said


def _stalls(trial: Trial, noise: float) -> np.ndarray:
    """Return frames in which nothing at all has changed although markers are noisy and move, (F,) bool."""
    free = trial.markers[:, ~trial.gripped]
    same = np.zeros(len(free), bool)
    same[1:] = [np.array_equal(a, b, equal_nan=True) for a, b in zip(free[1:], free[:-1], strict=True)]
    change = np.linalg.norm(np.diff(free, axis=0), axis=-1)
    # Where half the frames repeat others, the median of all changes is 0.
    changed = change[np.isfinite(change) & (change > 0)]
    moving = noise > 1e-7 and len(changed) > 0 and np.median(changed) > 0.5 * noise
    return same & moving & ~trial.suspect & np.isfinite(free).any((1, 2))


def _steps(x: np.ndarray) -> np.ndarray:
    """Return by how much markers stepped into each frame beyond their smooth motion [m], shape (F, M, 3).

    It is the change less the mean of the changes before and after: -1/2 times the third difference.
    """
    out = np.full(x.shape, np.nan)
    change = np.diff(x, axis=0)
    out[2:-1] = change[1:-1] - 0.5 * (change[:-2] + change[2:])
    return out


def _common(size: np.ndarray, noise: float) -> np.ndarray:
    """Return frames into which markers step, taken together, beyond noise and regular motion."""
    known = np.isfinite(size).sum(1) >= 3
    if not known.any():
        return np.array([], int)
    whole = np.zeros(len(size))
    whole[known] = np.sqrt(np.nanmean(size[known] ** 2, axis=1))
    # White noise gives steps of sqrt(15) its size.
    usual = max(4 * np.median(whole[known]), 2 * np.percentile(whole[known], 95))
    bound = max(2.5 * np.sqrt(15) * noise, 0.5 * _SMALLEST, usual)
    return np.flatnonzero((whole > bound) & (whole >= np.maximum(np.roll(whole, 1), np.roll(whole, -1))))


def _events(size: np.ndarray, noise: float, frame: float) -> np.ndarray:
    """Return where a step stands out of the noise and of the quickest regular motion, (F, M) bool."""
    usual = np.array([np.nanmedian(c) if np.isfinite(c).any() else 0.0 for c in size.T])
    high = np.array([np.nanpercentile(c, 90) if np.isfinite(c).any() else 0.0 for c in size.T])
    # White noise gives steps of sqrt(5) its size per axis; quick motion comes in stretches, faults in single frames.
    least = max(8 * np.sqrt(5) * noise, _SMALLEST, _SHARPEST * frame**2)
    bound = np.maximum(least, np.maximum(12 * usual, 4 * high))
    known = np.nan_to_num(size)
    near = np.maximum(np.roll(known, 1, 0), np.roll(known, -1, 0))
    # A step of 1 shows as -1/2, 1, -1/2: its sides are not events of their own.
    return (known > bound) & (known >= 0.8 * near)


def _all_at_once(trial: Trial, x: np.ndarray, steps: np.ndarray, f: int) -> DataIssue | None:
    """Return what happened when all markers stepped together, None if they did not do so as a whole."""
    good = np.isfinite(steps[f]).all(-1)
    place, step = x[f - 1][good], steps[f][good]
    whole = float((step**2).sum())
    beside = [float((step * np.nan_to_num(steps[k][good])).sum()) for k in (f - 1, f + 1) if 2 <= k < len(x) - 1]
    # Positions that step show as -1/2, 1, -1/2; accelerations that do show as 1 alone, and may.
    if not beside or 2 * np.mean(beside) > -0.5 * whole:
        return None
    # A small rigid motion: a shift and a turn.
    arm = place - place.mean(0)
    columns = [np.tile(e, (len(arm), 1)) for e in np.eye(3)] + [np.cross(e, arm) for e in np.eye(3)]
    a = np.stack([c.ravel() for c in columns], 1)
    rest = step.ravel() - a @ np.linalg.lstsq(a, step.ravel(), rcond=None)[0]
    rigid = 1 - float(rest @ rest) / whole
    # The mean of what markers move per frame before and after it; three frames cannot be seen at an end.
    usual = [0.5 * (x[k] - x[k - 2])[good] for k in (f - 1, f + 2) if 2 <= k < len(x)]
    usual = np.nan_to_num(np.mean(usual, 0))
    count = float((step * usual).sum() / ((usual**2).sum() + 1e-30))
    along = 1 - float(((step - count * usual) ** 2).sum()) / whole
    when = f"at {trial.time[f]:.2f} s (frame {f})"
    if along > 0.85 and count > 0.6 and along > rigid - 0.1:
        lost = "a frame is" if round(count) <= 1 else f"about {round(count)} frames are"
        return DataIssue(trial.name, "clock", f"{lost} missing {when}: the {_FADES:g} s after it are left out")
    after = "what comes after is left out"
    held = np.linalg.norm(step[trial.gripped[good]], axis=-1)
    if rigid > 0.85 and held.min(initial=np.inf) > 0.3 * np.sqrt(whole / len(step)):
        size = 1e3 * float(np.sqrt(whole / len(step)))
        said = (
            f"all markers, held ones too, step by {size:.0f} mm at once {when}, as if the camera had slipped: {after}"
        )
        return DataIssue(trial.name, "camera", said)
    return None


def _labels(trial: Trial, x: np.ndarray, events: np.ndarray, size: np.ndarray) -> tuple[np.ndarray, list[DataIssue]]:
    """Return where single markers are not where they belong, (F, M) bool, and what happened."""
    wrong, faults = np.zeros(x.shape[:2], bool), []
    swaps: dict[tuple[int, int], list[int]] = {}
    single = events & ~trial.gripped
    for f in np.flatnonzero(single.any(1)):
        who = np.flatnonzero(single[f])
        for i in who:
            for j in who[who > i]:
                if single[f, i] and single[f, j] and _exchanged(x, int(f), int(i), int(j), size):
                    swaps.setdefault((int(i), int(j)), []).append(int(f))
                    single[f, [i, j]] = False
    for pair, at in swaps.items():
        rows = _swapped(trial, x, pair, at)
        wrong[np.ix_(rows, np.array(pair))] = True
        faults.append(
            DataIssue(trial.name, "swap", f"markers {pair[0]} and {pair[1]} are swapped in {_frames(rows)}: left out")
        )
    single &= ~_moves_along(single, np.where(wrong, np.nan, size))
    jumped = []
    for m in np.flatnonzero(single.any(0)):
        rows = _away(np.flatnonzero(single[:, m]), len(x))
        wrong[rows, m] = True
        jumped.append(f"marker {m} in {_frames(rows)}")
    if jumped:
        shown = "; ".join(jumped[:4]) + (f" and {len(jumped) - 4} more" if len(jumped) > 4 else "")
        faults.append(DataIssue(trial.name, "jump", f"markers jump away and are left out there: {shown}"))
    return wrong, faults


def _moves_along(events: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Return which steps are a wave that runs through the rope, (F, M) bool: markers beside them step likewise.

    A whip moves a marker as far from frame to frame as a fault does, but never one marker alone.

    Args:
        events: steps that stand out, shape (F, M).
        size: of all steps [m], NaN where it is not known, shape (F, M).
    """
    found, known = np.zeros_like(events), np.nan_to_num(size)
    near = np.maximum(known, np.maximum(np.roll(known, 1, 0), np.roll(known, -1, 0)))
    for f in np.flatnonzero(events.any(1)):
        at = np.flatnonzero(events[f])
        for run in np.split(at, np.flatnonzero(np.diff(at) > 1) + 1):
            beside = [m for m in (run[0] - 1, run[-1] + 1) if 0 <= m < events.shape[1]]
            # A fault of one marker shows there not at all, a wave as much.
            found[f, run] = max(near[f, beside], default=0.0) > _WAVE * known[f, run].min()
    return found


def _exchanged(x: np.ndarray, f: int, i: int, j: int, size: np.ndarray) -> bool:
    """Return whether two markers step to each other's place."""
    crossed = x[f - 2 : f + 2, [i, j]].copy()
    crossed[2:] = crossed[2:, ::-1]
    left = np.linalg.norm(_steps(crossed)[2], axis=-1)
    return bool((left < 0.3 * size[f, [i, j]]).all())


def _swapped(trial: Trial, x: np.ndarray, pair: tuple[int, int], at: list[int]) -> np.ndarray:
    """Return the frames in which two markers are swapped, given when they change places, (F,) bool."""
    inside = np.cumsum(np.isin(np.arange(len(x)), at)) % 2 == 1

    def excess(rows: np.ndarray) -> float:
        apart = np.linalg.norm(np.diff(x[rows], axis=1), axis=-1) - np.diff(trial.marker_arclength)
        return float(np.nanmean(np.clip(apart, 0, None))) if np.isfinite(apart).any() else 0.0

    # Which of the two orders is right the rope's length says; where it says nothing, the one that lasts longer.
    a, b = excess(inside), excess(~inside)
    longer = inside.mean() > 0.5
    wrong = inside if a > 2 * b + 1e-4 else ~inside if b > 2 * a + 1e-4 else (~inside if longer else inside)
    return wrong


def _away(at: np.ndarray, frames: int) -> np.ndarray:
    """Return the frames between pairs of steps; a single step leaves its own frame only, (F,) bool."""
    rows = np.zeros(frames, bool)
    k = 0
    while k < len(at):
        back = at[k + 1] if k + 1 < len(at) and at[k + 1] - at[k] <= 50 else at[k] + 1
        rows[at[k] : back] = True
        k += 2 if back != at[k] + 1 or (k + 1 < len(at) and at[k + 1] == back) else 1
    return rows


def _frames(rows: np.ndarray) -> str:
    """Return frames in words."""
    at = np.flatnonzero(rows)
    runs = np.split(at, np.flatnonzero(np.diff(at) > 1) + 1)
    told = [str(r[0]) if len(r) == 1 else f"{r[0]} to {r[-1]}" for r in runs[:4]]
    more = f" and {len(runs) - 4} more stretches" if len(runs) > 4 else ""
    return f"frame{'s' if len(at) > 1 else ''} {', '.join(told)}{more}"
