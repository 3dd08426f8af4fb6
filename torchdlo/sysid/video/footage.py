"""Films of a recording as views: read, segmented, checked, and reduced to what observations need."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from torchdlo.errors import InputError
from torchdlo.sysid.estimation.observation import FilmView, own_clocks
from torchdlo.sysid.recordings.recording import Recording, Trial
from torchdlo.sysid.video.films import FILMS, FilmFile
from torchdlo.vision.camera import NEAR, lens, project
from torchdlo.vision.mask_health import check_masks
from torchdlo.vision.segment import Ranges, color_masks, load_film, load_ranges, ranges_of
from torchdlo.vision.spine import along, half_width, spine
from torchdlo.vision.video_file import film_rate

__all__ = ["RANGES", "masks_of", "views_of"]

RANGES = "segment.json"
"""File of a recording folder that says which colours belong to the rope."""

SHOWN = 3
"""Pictures of a film that reports show."""

_POINTS = 48
"""Points of a centre line."""

_PHOTO_POINTS = 192
"""Points of the centre line in a photograph."""

_STRETCHES = 14
"""Stretches of a rope, of which every other one is left out where there is one photograph only."""

_TOO_MUCH = 1.15
"""Times its length from which what is seen is more than one rope.

One showed 0.4 to 0.8 of it and two 0.7 to 1.6, when widths were read up to 1 px too large, and lengths too short."""

_OTHER_RATE = 0.02
"""Share by which the rate of a film is another one than `cameras.json` says: 29.97 is 30, 25 is not."""

_DRIFT = 0.25
"""Pictures by which films of one camera may come apart from a common rate by their ends."""

_FRAMES_OFF = 3
"""Pictures by which films may differ from the length of their trial: a clock may be off so much."""

_BESIDE, _APART = 0.15, 0.25
"""Distance in the picture between a gripper and the rope that is said, and from which a camera cannot be right, as
shares of the rope's length there. Of films that were made it was 0.1 at most: hands hide a part of the rope."""

_LOOKED_AT = 12
"""Pictures in which grippers are looked for."""

_FAR_MORE = 4.0
"""Times its length from which what is seen is not a second rope, but one that a wrong camera sees far too large."""

_LATE = 0.15
"""Share of a trial that may have passed when its first film begins."""

_STILL = 5e-4
"""Motion of a gripper between two pictures that shows [m]."""


def views_of(
    recording: Recording, trials: Sequence[Trial], callback: Callable[[str, int, int, str], None] | None = None
) -> tuple[list[FilmView], list[str]]:
    """Return what each camera saw of trials, and sentences on what was wrong with it.

    Raises:
        InputError: A film cannot be used.
    """
    report = callback or (lambda *_: None)
    names = [f.camera.name for f in trials[0].films]
    notes: list[str] = []
    views, done, total = [], 0, len(trials) * len(names)
    for k, name in enumerate(names):
        parts = []
        films = _timed(recording, [trial.films[k] for trial in trials])
        early = [_early(film) for film in films]
        begun = [f.camera.start + e / f.camera.fps for f, e in zip(films, early, strict=True)]
        for trial, film, before, start in zip(trials, films, early, begun, strict=True):
            own = replace(film, camera=replace(film.camera, start=start))
            parts.append(_reduced(recording, trial, own, before, notes))
            done += 1
            report("reading films", done, total, f"{trial.name}, camera {name}")
        frames = max(len(p[0]) for p in parts)

        def stack(which: int, fill: float, frames: int = frames, parts: list = parts) -> np.ndarray:
            return np.stack(
                [
                    np.pad(
                        p[which],
                        [(0, frames - len(p[which]))] + [(0, 0)] * (p[which].ndim - 1),
                        constant_values=fill,
                    )
                    for p in parts
                ]
            )

        lines = (stack(0, 0).astype(bool), stack(1, np.nan), stack(2, np.nan))
        wide = float(np.median([p[3] for p in parts]))
        packed, shown = tuple(p[4] for p in parts), tuple(p[5] for p in parts)
        camera = replace(films[0].camera, start=begun[0])
        clocks = own_clocks([trial.name for trial in trials]) if camera.starts else {}
        views.append(FilmView(camera, *lines, wide, packed, shown, late=np.array(begun) - begun[0], **clocks))
    _check_beginnings(trials, views)
    return views, notes


def _check_beginnings(trials: Sequence[Trial], views: Sequence[FilmView]) -> None:
    """Refuse films that all begin long after their trial: how it began cannot be seen."""
    for b, trial in enumerate(trials):
        first = min(float(v.time[b, 0]) for v in views)
        if first > max(_LATE * float(trial.time[-1]), 1.0 / views[0].camera.fps):
            raise InputError(
                f"{trial.films[0].path}: expected a film from the beginning of {trial.name}.npz on, found one that "
                f"begins after {first:.3g} of its {trial.time[-1]:.3g} s; cut the trial, or mend start in cameras.json."
            )


def masks_of(recording: Recording, film: FilmFile) -> tuple[np.ndarray, np.ndarray | None, float | None]:
    """Return the masks of a film, (F, H, W) bool, its pictures if they have colours, and its frame rate if known."""
    found, fps = load_film(film.path)
    size = (film.camera.height, film.camera.width)
    if found.shape[1:3] != size:
        raise InputError(
            f"{film.path}: expected pictures of {size[1]} x {size[0]} pixels as camera {film.camera.name} has, found "
            f"{found.shape[2]} x {found.shape[1]}."
        )
    if found.dtype == bool:
        return found, None, fps
    return color_masks(found, _ranges(recording, film.path)), found, fps


def _timed(recording: Recording, films: Sequence[FilmFile]) -> list[FilmFile]:
    """Return films of one camera with the rate that all of its films have, those of other trials too.

    `cameras.json` has the rate of the film of a board, or a round number: 29.97 and 30 part by half a picture in 17 s.
    """
    name = films[0].camera.name
    every = [f.path for t in recording.train + recording.test for f in t.films if f.camera.name == name and not t.still]
    found = {path: film_rate(path) for path in dict.fromkeys(every) if path.suffix.lower() in FILMS and path.is_file()}
    said, stated = films[0].camera.fps, films[0].rate_stated
    for path, (fps, _) in found.items():
        if stated and abs(fps / said - 1) > _OTHER_RATE:
            raise InputError(f"{path}: expected {said:g} pictures per second as cameras.json says, found {fps:.4g}.")
    if not found:
        if every and not stated:
            raise InputError(
                f"{films[0].path}: expected fps of camera {name} in cameras.json, found none; masks and folders of "
                "pictures do not say when they were taken."
            )
        return list(films)
    usual = float(np.median([fps for fps, _ in found.values()]))
    # To rounding it is the one that is written down, by which ends of windows are told.
    usual = said if abs(usual / said - 1) < 1e-6 else usual
    for path, (fps, count) in found.items():
        if count * abs(fps / usual - 1) > _DRIFT:
            raise InputError(
                f"{path}: expected {usual:.5g} pictures per second as other films of camera {name} have, found "
                f"{fps:.5g}; film all with the same settings."
            )
    return [replace(f, camera=replace(f.camera, fps=usual)) for f in films]


def _ranges(recording: Recording, film: Path) -> Ranges:
    own = recording.path / RANGES
    if own.is_file():
        return load_ranges(own)
    if recording.color is None:
        raise InputError(
            f"{film}: expected the rope's colour, found neither {RANGES} nor color in rope.json; set it with torchdlo "
            f"segment {film} --out {own}."
        )
    try:
        return ranges_of(recording.color)
    except InputError as error:
        raise InputError(f"{recording.path / 'rope.json'}: {error}") from None


def _reduced(
    recording: Recording, trial: Trial, film: FilmFile, early: int, notes: list[str]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float, np.ndarray, dict[int, np.ndarray]]:
    """Return good frames, centre lines with tangents, half width, packed masks and some pictures of a film.

    The camera's `start` is when the picture after the first `early` ones was taken, which are left out.
    """
    nearest = _nearest(trial, film)
    masks, pictures, own_rate = masks_of(recording, film)
    if trial.still:
        return _photographed(trial, film, masks, pictures, notes)
    rows = slice(early, early + _lasting(trial, film, len(masks) - early))
    _check_length(trial, film, len(masks) - early, notes, refuse=own_rate is None)
    masks, pictures = masks[rows], None if pictures is None else pictures[rows]
    count = len(masks)
    time = film.camera.start + np.arange(count) / film.camera.fps
    held = trial.markers[:, trial.gripped]
    flat = held.reshape(len(held), -1)
    where = np.stack([np.interp(time, trial.time, column) for column in flat.T], 1)
    moving = np.zeros(count, bool)
    moving[1:] = np.abs(np.diff(where, axis=0)).max(1) > _STILL
    _check_grips(recording, trial, film, masks, where.reshape(count, -1, 3), notes)
    good, issues = check_masks(masks, str(film.path), pictures=pictures, moving=moving)
    notes += [f"{trial.name}, camera {film.camera.name}: {i.text}." for i in issues]
    suspect = np.interp(time, trial.time, trial.suspect.astype(float)) > 0
    good &= ~suspect
    none = (np.full((_POINTS, 2), np.nan),) * 2
    lines = [spine(m, _POINTS) if ok else none for m, ok in zip(masks, good, strict=True)]
    places, tangents = (np.stack(part) for part in zip(*lines, strict=True))
    wide = float(np.median([half_width(m) for m in masks[good][::10]]))
    _check_amount(recording, film, float(np.median(masks[good].sum((1, 2)))) / max(2 * wide, 1.0), nearest)
    some = np.flatnonzero(good)[np.linspace(0, good.sum() - 1, SHOWN + 1).round().astype(int)[1:]]
    return good, places, tangents, wide, np.packbits(masks.reshape(count, -1), axis=1), _shown(masks, pictures, some)


def _early(film: FilmFile) -> int:
    """Return how many pictures of a film are from before its trial."""
    return max(0, math.floor(-0.75 - film.camera.start * film.camera.fps) + 1)


def _lasting(trial: Trial, film: FilmFile, count: int) -> int:
    """Return how many pictures of a film, of which `count` are left, are of the trial; refuse too few."""
    lasts, start, fps = trial.time[-1], film.camera.start, film.camera.fps
    inside = int((start + np.arange(max(count, 0)) / fps < lasts + 0.25 / fps).sum())
    if inside < 5:
        raise InputError(
            f"{film.path}: expected pictures of the {lasts:g} s of {trial.name}.npz, found {inside} in that time; "
            "check start in cameras.json."
        )
    expected = (lasts - max(start, 0.0)) * fps
    if inside < 0.6 * expected:
        raise InputError(
            f"{film.path}: expected about {expected:.0f} pictures for the {lasts:g} s of {trial.name}.npz, found "
            f"{inside}; were pictures dropped, or is fps in cameras.json wrong?"
        )
    return inside


def _check_length(trial: Trial, film: FilmFile, count: int, notes: list[str], *, refuse: bool) -> None:
    """Say of films that they last longer than their trial or less, and refuse longer masks, which have no times."""
    fps, lasts = film.camera.fps, trial.time[-1] - film.camera.start
    expected = int(lasts * fps + 0.25) + 1
    if count > expected + _FRAMES_OFF and not refuse:
        notes.append(
            f"{trial.name}, camera {film.camera.name}: {count} pictures for {lasts:.3g} s, which have {expected} at "
            f"{fps:g} per second: those after the trial do not count; check start if the camera stopped with it."
        )
    elif count > expected + _FRAMES_OFF:
        raise InputError(
            f"{film.path}: expected {expected} pictures for the {trial.time[-1]:g} s of {trial.name}.npz at {fps:g} "
            f"per second, found {count}; set fps and start in cameras.json, or leave out what is after the trial."
        )
    if count < expected - _FRAMES_OFF:
        notes.append(
            f"{trial.name}, camera {film.camera.name}: {count} pictures for {lasts:.3g} s, which have {expected} at "
            f"{fps:g} per second: check fps if the camera did not stop early."
        )


def _nearest(trial: Trial, film: FilmFile) -> float:
    """Return how near grippers come to a camera [m]; refuse one that they are behind."""
    held = trial.markers[:, trial.gripped].reshape(-1, 3)
    depth = held @ np.array(film.camera.rotation)[2] + film.camera.translation[2]
    nearest = float(depth.min())
    if nearest < NEAR:
        raise InputError(
            f"{film.path}: expected the grippers in front of camera {film.camera.name}, found them behind it; rotation "
            "and translation in cameras.json take points of the world to the camera (x right, y down, z forward)."
        )
    return nearest


def _check_grips(
    recording: Recording, trial: Trial, film: FilmFile, masks: np.ndarray, held: np.ndarray, notes: list[str]
) -> None:
    """Refuse a camera that sees the rope far from where it has the grippers, which are at (F, K, 3) [m]."""
    seen = np.flatnonzero(masks.any((1, 2)))
    if not len(seen):
        return
    rows = seen[np.unique(np.linspace(0, len(seen) - 1, _LOOKED_AT).round().astype(int))]
    pixel, depth = (x[0].numpy() for x in project(lens([film.camera]), torch.as_tensor(held[rows])[None]))
    away = np.full(pixel.shape[:2], np.nan)
    high, wide = masks.shape[1:]
    for k, row in enumerate(rows):
        inside = ((pixel[k] >= -0.5) & (pixel[k] <= [wide - 0.5, high - 0.5])).all(1)
        cut = masks[row][[0, -1]].any() or masks[row][:, [0, -1]].any()
        # Of a rope that leaves the picture grippers may be anywhere out of it.
        counts = inside if cut else np.ones(len(inside), bool)
        rope = np.argwhere(masks[row])[:, ::-1]
        away[k, counts] = np.linalg.norm(pixel[k, counts, None] - rope, axis=-1).min(1)
    usual = [np.median(column[np.isfinite(column)]) for column in away.T if np.isfinite(column).any()]
    if not usual:
        return
    far = float(np.max(usual))
    share = far * float(np.median(depth)) / (0.5 * (film.camera.fx + film.camera.fy) * recording.length)
    found = f"the rope {far:.0f} px from where camera {film.camera.name} has a gripper"
    if share > _APART:
        raise InputError(
            f"{film.path}: expected the rope at the grippers of {trial.name}.npz, found {found}; check rotation, "
            "translation [m] and fx of the camera, and whether this film is of this trial."
        )
    if share > _BESIDE:
        notes.append(f"{trial.name}: found {found}: check the camera, unless something hides the rope there.")


def _check_amount(recording: Recording, film: FilmFile, pixels: float, nearest: float) -> None:
    """Refuse masks that hold far more than one rope, whose centre lines have so many pixels in the usual picture."""
    seen = pixels * nearest / (0.5 * (film.camera.fx + film.camera.fy))
    if seen > _FAR_MORE * recording.length:
        raise InputError(
            f"{film.path}: expected a rope of {recording.length:.3g} m, found {seen:.2g} m of it as camera "
            f"{film.camera.name} sees it; check that translation in cameras.json is in m, and fx in pixels."
        )
    if seen > _TOO_MUCH * recording.length:
        raise InputError(
            f"{film.path}: expected a rope of {recording.length:.3g} m, found {seen:.2g} m of it in the masks: two "
            "ropes, or something else of its colour, are in view; take it away, or set ranges with torchdlo segment."
        )


def _shown(masks: np.ndarray, pictures: np.ndarray | None, some: Sequence[int]) -> dict[int, np.ndarray]:
    """Return grey pictures of some frames."""
    grey = {int(k): 255 - 160 * masks[k] if pictures is None else pictures[k].mean(-1) for k in some}
    return {k: picture.astype(np.uint8) for k, picture in grey.items()}


def _photographed(
    trial: Trial, film: FilmFile, masks: np.ndarray, pictures: np.ndarray | None, notes: list[str]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float, np.ndarray, dict[int, np.ndarray]]:
    """Return what `_reduced` does of a photograph of a rope at rest, without the stretches that do not count."""
    if len(masks) != 1:
        raise InputError(f"{film.path}: expected one picture of a rope at rest, found {len(masks)}.")
    good, issues = check_masks(masks, str(film.path), pictures=pictures)
    notes += [f"{trial.name}, camera {film.camera.name}: {i.text}." for i in issues]
    places, tangents = (x[None] for x in spine(masks[0], _PHOTO_POINTS))
    known = np.isfinite(places[0]).all(1)
    if known.sum() < 2 * _STRETCHES:
        raise InputError(
            f"{film.path}: expected a mask with the centre line of a rope, found one of {int(masks.sum())} pixels; set "
            "the rope's colour with torchdlo segment, or hang a sheet of another colour behind it."
        )
    if trial.stretches != "all":
        held = torch.as_tensor(trial.markers[0, trial.gripped][None])
        start = project(lens([film.camera]), held)[0][0, 0].numpy()
        far = along(places[0, known], start)
        number = np.minimum((far / far.max() * _STRETCHES).astype(int), _STRETCHES - 1)
        places[0, np.flatnonzero(known)[number % 2 == (trial.stretches == "even")]] = np.nan
    wide = half_width(masks[0])
    return good, places, tangents, wide, np.packbits(masks.reshape(1, -1), axis=1), _shown(masks, pictures, [0])
