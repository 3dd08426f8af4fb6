"""Films of recordings and runs: test data, through the independent rasteriser of `vision.film`."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from torchdlo.errors import InputError
from torchdlo.sysid.recordings.recording import Recording, Trial, check_new_folder
from torchdlo.untrusted import read_json
from torchdlo.vision.camera import Camera, check_starts, save_cameras
from torchdlo.vision.film import Film, FilmLook, check_inside, off_camera
from torchdlo.vision.film import film as film_rope
from torchdlo.vision.segment import save_masks
from torchdlo.vision.video_file import check_sides, write_video

__all__ = ["centre_line", "film_recording", "film_run"]

Callback = Callable[[str, int, int, str], None]

_VERTICES = 121
"""Of the ropes that are drawn."""


def centre_line(trial: Trial, length: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the rope's axis through the markers of a trial, (F, V, 3) [m], and places along it (V,) [m].

    Markers that were not seen follow their neighbours in time.
    """
    from scipy.interpolate import CubicSpline

    markers = trial.markers.copy()
    for m in range(markers.shape[1]):
        known = np.isfinite(markers[:, m, 0])
        for c in range(3):
            markers[:, m, c] = np.interp(trial.time, trial.time[known], trial.markers[known, m, c])
    at = trial.marker_arclength
    place = np.union1d(np.linspace(at[0], min(length, at[-1]), _VERTICES), at)
    return CubicSpline(at, markers, axis=1)(place), place


def film_recording(
    recording: Recording,
    cameras: Sequence[Camera],
    out: Path,
    look: FilmLook,
    *,
    radius: float | None = None,
    masks: bool = False,
    off: float = 0.0,
    begun_off: float = 0.0,
    trials: int | None = None,
    seconds: float | None = None,
    quality: int = 18,
    callback: Callback | None = None,
) -> list[str]:
    """Write a recording whose trials have grippers and films; return sentences on what was made.

    Args:
        recording: with markers.
        cameras: that film.
        out: new folder.
        look: what films look like.
        radius: of the rope [m], where the recording does not know it.
        masks: write masks in the place of pictures.
        off: how far the cameras that are written down are off, see `vision.film.off_camera`.
        begun_off: by up to how many frames each film begins earlier or later than is written down.
        trials: most trials of each split.
        seconds: most seconds of each trial.
        quality: of H.264, from 0 (lossless) to 51.
        callback: told (stage, films done, in all, message).
    """
    if recording.filmed:
        raise InputError(f"{recording.path}: expected a recording with markers, found one with films.")
    wide = recording.radius if radius is None else radius
    if wide is None:
        raise InputError(
            f"{recording.path / 'rope.json'}: radius: expected it to draw the rope, found none; give --radius."
        )
    report = callback or (lambda *_: None)
    _check_sides(cameras, masks)
    check_starts(cameras, [t.name for t in recording.trials("all")])
    chosen = [*recording.train[:trials], *recording.test[:trials]]
    chosen = [t if seconds is None else _cut(t, seconds) for t in chosen]
    rng = np.random.default_rng(look.seed)
    given = [off_camera(c, rng, degrees=off, zoom=0.01 * off, metres=0.01 * off) if off else c for c in cameras]
    given = [_later(c, off * (g.start - c.start), g, chosen) for g, c in zip(given, cameras, strict=True)]
    begun = np.random.default_rng([look.seed, 1])
    said, done = [], 0

    def fill(folder: Path) -> None:
        nonlocal done
        rope = read_json(recording.path / "rope.json", "length, mass and so on of a rope")
        rope |= {"radius": wide, "color": {"rgb": list(look.color)}, "rest_positions": None, "marker_mass": None}
        rope |= {"mass": recording.mass + _markers_mass(recording, chosen[0]), "marker_noise_std": None}
        (folder / "rope.json").write_text(json.dumps({k: v for k, v in rope.items() if v is not None or k in _KEPT}))
        save_cameras(given, folder / "cameras.json")
        for k, trial in enumerate(chosen):
            line, place = centre_line(trial, recording.length)
            held = _held(trial, place)
            arrays: dict[str, Any] = {"time": trial.time, "markers": trial.markers[:, trial.gripped]}
            arrays |= {"marker_arclength": trial.marker_arclength[trial.gripped], "gripped": np.ones(held[1], bool)}
            if trial.gripper_quaternion is not None:
                number = np.cumsum(trial.gripped) - 1
                arrays |= {"gripper_quaternion": trial.gripper_quaternion}
                arrays |= {"gripper_marker": number[np.asarray(trial.gripper_marker)]}
            np.savez_compressed(folder / f"{trial.name}.npz", **arrays)
            for j, camera in enumerate(cameras):
                check_inside(camera, line)
                own = replace(look, seed=look.seed + 1000 * k + j)
                start = camera.starts.get(trial.name, camera.start) + begun_off * begun.uniform(-1, 1) / camera.fps
                seen = film_rope(replace(camera, start=start), trial.time, line, wide, own, held=held[0])
                _write(seen, folder / f"{trial.name}.{camera.name}", camera, masks, quality)
                done += 1
                report("filming", done, len(chosen) * len(cameras), trial.name)
                bad = zip(np.flatnonzero(seen.wrong), seen.kinds, strict=True)
                wrong = f", wrong: {', '.join(f'{f} ({kind})' for f, kind in bad)}"
                said.append(f"{trial.name}, camera {camera.name}: {len(seen.time)} frames{wrong if seen.kinds else ''}")

    _new_folder(out, fill)
    return [*said, f"recording: {out}"]


def _later(camera: Camera, seconds: float, place: Camera, trials: Sequence[Trial]) -> Camera:
    """Return a camera at the place of another one, all of whose films of trials begin later than its own."""
    starts = {t.name: camera.starts[t.name] + seconds for t in trials if t.name in camera.starts}
    return replace(place, start=camera.start + seconds, starts=starts)


_KEPT = ("length", "radius", "mass", "gravity", "table_height", "marker_noise_std")


def _markers_mass(recording: Recording, trial: Trial) -> float:
    """Return the mass of all markers [kg], which films do not know of: it counts as the rope's."""
    return (recording.marker_mass or 0.0) * trial.markers.shape[1]


def _cut(trial: Trial, seconds: float) -> Trial:
    count = int(np.searchsorted(trial.time, seconds + 1e-9))
    names = ("time", "markers", "suspect", "gripper_quaternion")
    parts = {n: getattr(trial, n)[:count] for n in names if getattr(trial, n) is not None}
    return replace(trial, **parts)


def _held(trial: Trial, place: np.ndarray) -> tuple[list[range], int]:
    """Return runs of places (V,) within grippers, and how many markers are gripped."""
    at = np.flatnonzero(trial.gripped)
    runs = np.split(at, np.flatnonzero(np.diff(at) > 1) + 1)
    ends = [(trial.marker_arclength[r[0]], trial.marker_arclength[r[-1]]) for r in runs]
    found = [np.flatnonzero((place >= a - 1e-9) & (place <= b + 1e-9)) for a, b in ends]
    return [range(f[0], f[-1] + 1) for f in found if len(f)], len(at)


def film_run(
    time: np.ndarray,
    pos: np.ndarray,
    rope: np.ndarray,
    radius: float,
    cameras: Sequence[Camera],
    out: Path,
    look: FilmLook,
    *,
    closed: bool = False,
    masks: bool = False,
    quality: int = 18,
    callback: Callback | None = None,
) -> list[str]:
    """Write films of the first rope of a run.

    Args:
        time: of its frames [s], shape (F,).
        pos: vertices [m], shape (F, V, 3).
        rope: number of the rope of each vertex, shape (V,).
        radius: of the rope [m].
        cameras: that film.
        out: new folder.
        look: what films look like.
        closed: whether that rope is a loop, whose last vertex is joined to its first.
        masks: write masks in the place of pictures.
        quality: of H.264, from 0 (lossless) to 51.
        callback: told (stage, films done, in all, message).
    """
    if len(time) < 4:
        raise InputError(f"expected a run of at least 4 frames to film, found {len(time)}.")
    report = callback or (lambda *_: None)
    _check_sides(cameras, masks)
    line, said = pos[:, rope == 0], []
    if closed:
        line = np.concatenate([line, line[:, :1]], 1)

    def fill(folder: Path) -> None:
        save_cameras([replace(c, starts={}) for c in cameras], folder / "cameras.json")
        for k, camera in enumerate(cameras):
            check_inside(camera, line)
            seen = film_rope(camera, time, line, radius, replace(look, seed=look.seed + k))
            file = _write(seen, folder / camera.name, camera, masks, quality)
            report("filming", k + 1, len(cameras), camera.name)
            said.append(f"camera {camera.name}: {len(seen.time)} frames, {out / file.name}")

    _new_folder(out, fill)
    return said


def _check_sides(cameras: Sequence[Camera], masks: bool) -> None:
    """Refuse before the work cameras whose pictures cannot be written."""
    for camera in () if masks else cameras:
        check_sides(f"camera {camera.name}", camera.width, camera.height)


def _write(seen: Film, stem: Path, camera: Camera, masks: bool, quality: int = 18) -> Path:
    file = stem.with_name(stem.name + (".npz" if masks else ".mp4"))
    if masks:
        save_masks(seen.masks, file)
    else:
        write_video(file, seen.pictures, camera.fps, quality=quality)
    return file


def _new_folder(path: Path, fill: Callable[[Path], None]) -> None:
    """Make a folder that appears complete or not at all."""
    check_new_folder(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(prefix=f".{path.name}-", dir=path.parent))
    try:
        temporary.chmod(0o755)
        fill(temporary)
        temporary.replace(path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
