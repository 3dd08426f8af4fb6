"""Ropes and cameras that the tests of vision share."""

from __future__ import annotations

import numpy as np

from torchdlo.vision.camera import Camera, looking_at


def hanging(vertices: int = 61, span: float = 0.5, sag: float = 0.3) -> np.ndarray:
    """A parabola between two points, shape (V, 3) [m]."""
    x = np.linspace(-0.5, 0.5, vertices)
    return np.stack([span * x, 0.1 * np.sin(5 * x), sag * (4 * x**2 - 1)], 1)


def front(**others) -> Camera:
    """A camera 1.2 m in front of it, with a lens that bends lines."""
    options = {"distortion": (-0.15, 0.05, 1e-3, -5e-4, 0.0), "focal": 650.0} | others
    return looking_at("a", [0.1, -1.2, 0.1], [0.0, 0.0, -0.15], **options)
