"""Whether the arrays of a trial can be a rope in motion: clock, places, units, clamps."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from torchdlo.errors import InputError

__all__ = ["check_clamps", "check_markers", "check_time", "check_wrench"]

_EVEN = 0.01
"""Largest deviation of a time step from the median step, as a share of it."""
_LONGEST_STEP = 0.5
"""Longest time step [s]; a longer one must be in another unit."""
_MILLIMETRES = 20.0
"""A rope cannot reach further than its length; this many times further is another unit."""
_STRETCH = 1.5
"""Neighbouring markers may be this many times further apart than along the rope."""
_STALK = 0.01
"""Room for markers that sit beside the axis [m]."""
_COINCIDE = 1e-7
"""Distance below which two markers are one [m]."""


def check_time(path: Path, time: np.ndarray) -> None:
    """Times [s] must start at 0 and rise in even steps."""
    if abs(time[0]) > 1e-9:
        raise InputError(f"{path}: time: expected to start at 0 s, found {time[0]:g}; subtract the first time.")
    if len(time) == 1:
        return
    steps = np.diff(time)
    if (steps <= 0).any():
        frame = int(np.argmax(steps <= 0)) + 1
        raise InputError(
            f"{path}: time: expected strictly increasing times, found {time[frame]:g} s after "
            f"{time[frame - 1]:g} s at frame {frame}."
        )
    step = float(np.median(steps))
    if step > _LONGEST_STEP:
        raise InputError(
            f"{path}: time: expected seconds, found steps of {step:g}, which looks like milliseconds; divide by 1000."
        )
    uneven = np.abs(steps - step) > _EVEN * step
    if uneven.any():
        frame = int(np.argmax(uneven)) + 1
        raise InputError(
            f"{path}: time: expected even steps of {step:g} s, found {steps[frame - 1]:g} s before "
            f"frame {frame}; interpolate the markers to even steps."
        )


def check_markers(
    path: Path, arrays: dict[str, np.ndarray], suspect: np.ndarray, length: float, *, filmed: bool = False
) -> None:
    """Places along the rope and positions [m] must fit each other and the rope's length [m]."""
    markers, arclength, gripped = arrays["markers"], arrays["marker_arclength"], arrays["gripped"]
    _check_arclength(path, arclength, length)
    if not gripped.any():
        raise InputError(
            f"{path}: gripped: expected at least one marker held by a gripper, found none; "
            "without one nothing moves the rope."
        )
    if filmed and not gripped.all():
        raise InputError(
            f"{path}: gripped: expected markers at the grippers only beside films, found {int((~gripped).sum())} free."
        )
    if gripped.all() and not filmed:
        raise InputError(f"{path}: gripped: expected at least one free marker, found all {len(gripped)} gripped.")
    _check_seen(path, markers, gripped)
    _check_extent(path, markers, length)
    _check_spacing(path, markers, arclength, suspect)


def check_clamps(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Orientations of the clamps come with the marker of each clamp, and are unit quaternions."""
    names = ("gripper_quaternion", "gripper_marker")
    quaternion, marker = (arrays.get(name) for name in names)
    if quaternion is None and marker is None:
        return
    if quaternion is None or marker is None:
        absent, present = names if quaternion is None else names[::-1]
        raise InputError(f"{path}: {absent}: expected together with {present}, but missing.")
    n_frames, n_markers = arrays["markers"].shape[:2]
    if marker.ndim != 1 or marker.dtype.kind not in "iu" or not len(marker):
        raise InputError(
            f"{path}: gripper_marker: expected integers of shape (clamps,), "
            f"found {marker.dtype} of shape {marker.shape}."
        )
    if quaternion.shape != (n_frames, len(marker), 4):
        raise InputError(
            f"{path}: gripper_quaternion: expected shape ({n_frames}, {len(marker)}, 4), "
            f"(w, x, y, z) for each frame and clamp, found {quaternion.shape}."
        )
    for index in marker:
        if not 0 <= index < n_markers:
            raise InputError(f"{path}: gripper_marker: expected indices from 0 to {n_markers - 1}, found {index}.")
        if not arrays["gripped"][index]:
            raise InputError(f"{path}: gripper_marker: expected gripped markers, found {index}, which is free.")
    if len(np.unique(marker)) < len(marker):
        raise InputError(
            f"{path}: gripper_marker: expected a different marker for each clamp, found {marker.tolist()}."
        )
    norm = np.linalg.norm(quaternion, axis=-1)
    off = np.abs(norm - 1) > 1e-3
    if off.any():
        frame, clamp = np.argwhere(off)[0]
        raise InputError(
            f"{path}: gripper_quaternion: expected unit quaternions (w, x, y, z), found length "
            f"{norm[frame, clamp]:.4g} at frame {frame}, clamp {clamp}."
        )


def check_wrench(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Forces and torques come with a marker of each gripper that has a sensor."""
    names = ("wrench", "wrench_marker")
    wrench, marker = (arrays.get(name) for name in names)
    if wrench is None and marker is None:
        return
    if wrench is None or marker is None:
        absent, present = names if wrench is None else names[::-1]
        raise InputError(f"{path}: {absent}: expected together with {present}, but missing.")
    if marker.ndim != 1 or marker.dtype.kind not in "iu" or not len(marker):
        raise InputError(
            f"{path}: wrench_marker: expected integers of shape (grippers,), "
            f"found {marker.dtype} of shape {marker.shape}."
        )
    n_frames = len(arrays["markers"])
    if wrench.shape != (n_frames, len(marker), 6):
        raise InputError(
            f"{path}: wrench: expected shape ({n_frames}, {len(marker)}, 6), force [N] and torque [N m] for each frame "
            f"and gripper, found {wrench.shape}."
        )
    gripped = arrays["gripped"]
    for index in marker:
        if not 0 <= index < len(gripped) or not gripped[index]:
            raise InputError(f"{path}: wrench_marker: expected indices of gripped markers, found {index}.")
    held = np.flatnonzero(gripped)
    run = dict(zip(held, np.cumsum(np.diff(held, prepend=held[0]) > 1), strict=True))
    if len({run[index] for index in marker}) < len(marker):
        raise InputError(f"{path}: wrench_marker: expected one for each gripper, found two markers of the same one.")


def _check_arclength(path: Path, arclength: np.ndarray, length: float) -> None:
    if arclength[0] < 0:
        raise InputError(
            f"{path}: marker_arclength: expected metres from the first marker on, found {arclength[0]:g} for marker 0."
        )
    steps = np.diff(arclength)
    if (steps <= 0).any():
        index = int(np.argmax(steps <= 0)) + 1
        raise InputError(
            f"{path}: marker_arclength: expected values that increase from marker to marker, found "
            f"{arclength[index]:g} after {arclength[index - 1]:g} at marker {index}."
        )
    if arclength[-1] > length * (1 + 1e-3):
        beyond = int(np.argmax(arclength > length * (1 + 1e-3)))
        unit = ", which looks like millimetres" if arclength[-1] > _MILLIMETRES * length else ""
        raise InputError(
            f"{path}: marker_arclength: expected at most the rope's length of {length:g} m, "
            f"found {arclength[beyond]:g} for marker {beyond}{unit}."
        )


def _check_seen(path: Path, markers: np.ndarray, gripped: np.ndarray) -> None:
    missing = np.isnan(markers).any(-1)
    held = missing & gripped
    if held.any():
        frame, marker = np.argwhere(held)[0]
        raise InputError(
            f"{path}: markers: expected gripped markers to be seen in all frames, found NaN for "
            f"gripped marker {marker} at frame {frame} and in {int(held.sum())} places in all; "
            "interpolate the gripper's motion or cut the trial."
        )
    partly = missing & ~np.isnan(markers).all(-1)
    if partly.any():
        frame, marker = np.argwhere(partly)[0]
        raise InputError(
            f"{path}: markers: expected NaN in all three coordinates of a marker that is not seen, "
            f"found it in some only for marker {marker} at frame {frame}."
        )
    never = missing.all(0)
    if never.any():
        raise InputError(
            f"{path}: markers: expected each marker to be seen at least once, found marker "
            f"{int(np.argmax(never))} NaN in all {len(markers)} frames; remove the marker."
        )


def _check_extent(path: Path, markers: np.ndarray, length: float) -> None:
    extent = np.nanmax(np.nanmax(markers, axis=1) - np.nanmin(markers, axis=1), axis=-1)
    frame = int(np.argmax(extent))
    if extent[frame] > _MILLIMETRES * length:
        raise InputError(
            f"{path}: markers: expected metres, found markers {extent[frame]:g} apart at frame "
            f"{frame} for a rope of {length:g} m, which looks like millimetres; divide by 1000."
        )


def _check_spacing(path: Path, markers: np.ndarray, arclength: np.ndarray, suspect: np.ndarray) -> None:
    """Compare medians over time: single bad frames are a matter of data health, not of format."""
    trusted = markers[~suspect] if not suspect.all() else markers
    apart = np.linalg.norm(np.diff(trusted, axis=1), axis=-1)
    along = np.diff(arclength)
    for pair in range(len(along)):
        seen = apart[:, pair][~np.isnan(apart[:, pair])]
        if not len(seen):
            continue
        distance = float(np.median(seen))
        if distance < _COINCIDE:
            raise InputError(
                f"{path}: markers: expected neighbouring markers apart from each other, found "
                f"markers {pair} and {pair + 1} in the same place."
            )
        if distance > _STRETCH * along[pair] + _STALK:
            raise InputError(
                f"{path}: markers: expected markers {pair} and {pair + 1} at most "
                f"{along[pair]:g} m apart by marker_arclength, found {distance:g} m for most "
                "frames; check the order of the markers and the units."
            )
