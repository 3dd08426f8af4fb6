"""How well the boundary of a mask is met, and where that is more than a matter of boundaries."""

from __future__ import annotations

import numpy as np

__all__ = ["boundary_f", "wide_areas"]


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


def wide_areas(mask: np.ndarray, least: int) -> np.ndarray:
    """Return the parts of a mask (H, W) that are at least so wide [px], and two pixels around them, (H, W) bool."""
    import cv2

    kernel, more = (cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (n, n)) for n in (least, 5))
    return np.asarray(cv2.dilate(cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, kernel), more) > 0)
