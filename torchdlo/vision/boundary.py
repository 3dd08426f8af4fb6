"""How well the boundary of a mask is met."""

from __future__ import annotations

import numpy as np

__all__ = ["boundary_f"]


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
