"""How well the boundary of a mask is met, and which of its parts are wide."""

from __future__ import annotations

import numpy as np

__all__ = ["boundary_f", "wide_parts"]


def boundary_f(found: np.ndarray, true: np.ndarray) -> float:
    """Return the boundary F-measure of a mask (H, W) against another one, with a tolerance of one pixel [1].

    Harmonic mean of the shares of either boundary that are within a pixel of the other one (Csurka et al. 2013,
    doi:10.5244/C.27.32). Unlike the intersection over union it does not fall with the width of what is seen.
    """
    import cv2

    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    edges = [mask.astype(np.uint8) - cv2.erode(mask.astype(np.uint8), cross) for mask in (found, true)]
    shares = [
        float((edge * cv2.dilate(other, cross)).sum() / max(edge.sum(), 1)) for edge, other in (edges, edges[::-1])
    ]
    return 2 * shares[0] * shares[1] / max(sum(shares), 1e-12)


def wide_parts(area: np.ndarray, width: int, more: int = 0) -> np.ndarray:
    """Return the parts of an area (H, W) bool that are as wide as `width` [px], grown by `more` pixels."""
    import cv2

    disc, ring = (cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (n, n)) for n in (width, 2 * more + 1))
    return np.asarray(cv2.dilate(cv2.morphologyEx(area.astype(np.uint8), cv2.MORPH_OPEN, disc), ring) > 0)
