"""What the model of a rope leaves out, and how unsure that makes its numbers: where clamps hold, and shear."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline

from torchdlo.sysid.model.rope_model import RopeModel

CLAMP_SPREAD = 0.8
"""Twice the standard deviation of the place where a clamp begins to hold, by the radius of the rope."""

_SHEAR = 10 / 12
"""Bending over shearing stiffness of a round rope of one incompressible material, by the square of its radius:
(7 + 6 nu) / 12, Cowper 1966, doi:10.1115/1.3625046."""


def radius_of_clamps(model: RopeModel, radius: float | None) -> float:
    """Return a radius of the rope over the distance of the markers of clamps; 0 if there are none, or it is unknown."""
    gaps = [float(np.ptp(model.mesh.marker_arclength[run[-2:] if run[0] == 0 else run[:2]])) for run in model.mesh.runs]
    return radius / float(np.mean(gaps)) if gaps and radius else 0.0


def shear_share(markers: np.ndarray, arclength: np.ndarray, radius: float) -> float:
    """Return by how much shear lowers the bending stiffness that a round rope of one material shows [1].

    Args:
        markers: places of the markers [m], shape (B, F, M, 3).
        arclength: where along the rope they are [m], shape (M,).
        radius: of the rope [m].
    """
    ran = markers[np.isfinite(markers).all((1, 2, 3))]
    if not len(ran) or len(arclength) < 4:
        return 0.0
    # What moves tells the stiffness.
    spline = CubicSpline(arclength, ran - ran.mean(1, keepdims=True), axis=2)
    at = np.linspace(arclength[0], arclength[-1], 8 * len(arclength))[1:-1]
    bending, change = (float((spline(at, order) ** 2).sum()) for order in (2, 3))
    return min(_SHEAR * radius**2 * change / max(bending, 1e-300), 1.0)
