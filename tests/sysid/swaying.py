"""Recordings of a rope that keeps its length, made of formulas: a curve whose direction is known in place and time."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from torchdlo.sysid.recordings.recording import Recording, Trial

LENGTH = 0.9
NOISE = 3e-4
PLACES = np.concatenate([[0.0, 0.03], np.linspace(0.1, LENGTH, 13)])
"""Of the markers; the first two are held."""


def sway(name: str, seed: int, *, both: bool = False, frames: int = 250, step: float = 0.01) -> Trial:
    """A rope that hangs from a gripper and sways in all directions; `both`: its other end is held too."""
    rng = np.random.default_rng(seed)
    time, fine = np.arange(frames) * step, np.linspace(0, LENGTH, 1351)
    # Two angles of the rope's direction, waves that run down it.
    angles = []
    for size in (0.5, 0.3):
        rate, phase = rng.uniform(4, 7), rng.uniform(0, 2 * np.pi)
        growth = 0.3 + fine / LENGTH
        angles.append(size * growth * np.sin(rate * time[:, None] + phase - 2.5 * fine))
    along = np.stack([np.sin(angles[0]), np.cos(angles[0]) * np.sin(angles[1])], -1)
    along = np.concatenate([along, -np.cos(angles[0])[..., None] * np.cos(angles[1])[..., None]], -1)
    middle = 0.5 * (along[:, 1:] + along[:, :-1]) * np.diff(fine)[:, None]
    curve = np.concatenate([np.zeros((frames, 1, 3)), np.cumsum(middle, 1)], 1)
    base = 0.05 * np.stack([np.sin(3 * time), np.cos(4 * time), 0 * time], -1) + np.array([0.0, 0.0, 1.2])
    markers = base[:, None] + np.stack([curve[:, np.abs(fine - s).argmin()] for s in PLACES], 1)
    gripped = np.arange(len(PLACES)) < 2
    if both:
        gripped = gripped | (np.arange(len(PLACES)) >= len(PLACES) - 2)
    markers += NOISE * rng.normal(size=markers.shape) * ~gripped[:, None]
    return Trial(name, time, markers, PLACES, gripped, None, None, np.zeros(frames, bool))


def recording(path: Path, *, both: bool = False, frames: int = 250) -> Recording:
    """Three train and two test trials."""
    names = ("train_0", "train_1", "train_2", "test_0", "test_1")
    trials = tuple(sway(name, k, both=both, frames=frames) for k, name in enumerate(names))
    gravity = np.array([0.0, 0.0, -9.81])
    return Recording(path, LENGTH, 0.005, 0.05, gravity, None, NOISE, None, None, False, "", trials[:3], trials[3:])
