"""The centre line of a mask, exact distance fields, and distances between curves in pictures.

Thinning is Zhang and Suen's (1984, doi:10.1145/357994.358023) by table look-up; the pixels that are left are moved to
the centroid of the mask around them.
"""

from __future__ import annotations

import functools

import numpy as np
import torch
from torch import Tensor

__all__ = ["along", "curve_vectors", "distance_field", "half_width", "sample_field", "spine", "thin"]


@functools.cache
def _tables() -> tuple[np.ndarray, np.ndarray]:
    """Return which pixels the two halves of a pass remove, by the code of their eight neighbours; (256,) uint8 each."""
    tables = np.zeros((2, 256), np.uint8)
    for code in range(256):
        p = [(code >> k) & 1 for k in range(8)]  # north, north-east, ... clockwise
        changes = sum(p[k] == 0 and p[(k + 1) % 8] == 1 for k in range(8))
        if not 2 <= sum(p) <= 6 or changes != 1:
            continue
        n, e, s, w = p[0], p[2], p[4], p[6]
        tables[0, code] = 255 * (n * e * s == 0 and e * s * w == 0)
        tables[1, code] = 255 * (n * e * w == 0 and n * s * w == 0)
    return tables[0], tables[1]


_CODE = np.array([[128, 1, 2], [64, 0, 4], [32, 16, 8]], np.float32)


def thin(mask: np.ndarray) -> np.ndarray:
    """Return the skeleton of a mask, both (H, W) bool."""
    import cv2

    left = np.pad(mask, 1).astype(np.uint8)
    while True:
        removed = 0
        for table in _tables():
            code = cv2.filter2D(left, cv2.CV_8U, _CODE, borderType=cv2.BORDER_CONSTANT)
            gone = np.asarray(cv2.LUT(code, table), np.uint8) & (left * 255)
            removed += cv2.countNonZero(gone)
            left[gone > 0] = 0
        if not removed:
            return left[1:-1, 1:-1].astype(bool)


def _cut(mask: np.ndarray) -> tuple[np.ndarray, int, int]:
    """Return the part of a mask (H, W) that is not empty, and its first column and row."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    part = mask[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    return np.ascontiguousarray(part), int(columns[0]), int(rows[0])


def _reach(mask: np.ndarray) -> int:
    """Return how far around a pixel [px] one has to look to see the mask's whole width."""
    import cv2

    inside = cv2.distanceTransform(np.pad(mask, 1).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    # Distances from the edge are even from 0 to the half width: their mean is half of that. Up to 1 px too large.
    return int(np.ceil(2 * inside[inside > 0].mean() - 0.5)) + 1


def _sums(part: np.ndarray, far: int) -> np.ndarray:
    """Return the sums of an array (H, W) over squares that reach so far [px] around each pixel."""
    import cv2

    return cv2.boxFilter(part, -1, (2 * far + 1, 2 * far + 1), normalize=False, borderType=cv2.BORDER_CONSTANT)


def _angles(mask: np.ndarray, far: int) -> np.ndarray:
    """Return the directions [rad] of what a mask (H, W) shows within so far [px] around each pixel."""
    y, x = np.mgrid[: mask.shape[0], : mask.shape[1]].astype(np.float64)
    white = mask.astype(np.float64)
    mass = np.maximum(_sums(white, far), 1.0)
    mx, my = _sums(white * x, far) / mass, _sums(white * y, far) / mass
    xx = _sums(white * x**2, far) / mass - mx**2
    yy = _sums(white * y**2, far) / mass - my**2
    xy = _sums(white * x * y, far) / mass - mx * my
    return 0.5 * np.arctan2(2 * xy, xx - yy)


def half_width(mask: np.ndarray) -> float:
    """Return the usual half width of what a mask (H, W) shows [px], 0 where it shows nothing.

    It is half of the area over the length. A line that is `a` off level meets cos(a) columns and sin(a) rows per pixel
    of its length, and a run of the mask begins in each of them: the sum of cos over runs in columns and of sin over
    runs in rows is the length.
    """
    import cv2

    if not mask.any():
        return 0.0
    cut, _, _ = _cut(mask)
    angle = _angles(cut, _reach(cut))
    # Runs do not begin anew after holes and gaps of one pixel.
    whole = cv2.morphologyEx(np.pad(cut, 2).astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8)) > 0
    inner = np.s_[2:-2, 2:-2]
    above, left = (whole & ~np.roll(whole, 1, axis) for axis in (0, 1))
    length = np.abs(np.cos(angle))[above[inner]].sum() + np.abs(np.sin(angle))[left[inner]].sum()
    return float(0.5 * cut.sum() / max(float(length), 1.0))


def spine(mask: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return points of the centre line of a mask and its unit tangents there, evenly spread.

    Args:
        mask: what a picture shows of a rope, shape (H, W) bool.
        count: how many points, S.

    Returns:
        Places [px], (S, 2), and tangents [1], (S, 2); NaN where the line is too short for so many.
    """
    places, tangents = (np.full((count, 2), np.nan) for _ in range(2))
    if not mask.any():
        return places, tangents
    cut, x0, y0 = _cut(mask)
    y, x = np.nonzero(thin(cut))
    if len(y) > count:
        # One pixel per cell of a grid, then evenly among those.
        cell = max(1.0, 0.9 * len(y) / count)
        _, first = np.unique((y // cell).astype(int) * 100_000 + (x // cell).astype(int), return_index=True)
        first = first[np.linspace(0, len(first) - 1, min(count, len(first))).round().astype(int)]
        y, x = y[first], x[first]
    reach = _reach(cut)
    grid_y, grid_x = np.mgrid[: cut.shape[0], : cut.shape[1]].astype(np.float64)
    white = cut.astype(np.float64)
    mass = np.maximum(_sums(white, reach), 1.0)
    near = np.stack([_sums(white * grid_x, reach) / mass, _sums(white * grid_y, reach) / mass], -1)[y, x]
    angle = _angles(cut, 2 * reach)[y, x]
    places[: len(y)] = near + np.array([x0, y0])
    tangents[: len(y)] = np.stack([np.cos(angle), np.sin(angle)], 1)
    return places, tangents


def along(places: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Return how far points of a centre line are along it from where it begins [px], shape (S,).

    They are joined by a minimum spanning tree, whose branches are short where the line is one.

    Args:
        places: shape (S, 2) [px].
        start: the point (2,) that it begins nearest to [px].
    """
    from scipy.sparse.csgraph import minimum_spanning_tree, shortest_path
    from scipy.spatial.distance import cdist

    gap = cdist(places, places)
    tree = minimum_spanning_tree(np.maximum(gap, 1e-9))
    first = int(np.linalg.norm(places - start, axis=1).argmin())
    return np.asarray(shortest_path(tree, directed=False, indices=first))


def distance_field(mask: np.ndarray) -> np.ndarray:
    """Return the exact distance of every pixel from a mask (H, W) [px], 0 on it; far away where it is empty."""
    import cv2

    if not mask.any():
        return np.full(mask.shape, float(np.hypot(*mask.shape)), np.float32)
    return cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)


def sample_field(field: Tensor, pixel: Tensor) -> Tensor:
    """Return the values of fields (N, H, W) at places (N, P, 2) [px], bilinear; those next to it beyond the edge."""
    height, width = field.shape[-2:]
    size = pixel.new_tensor([width - 1, height - 1])
    grid = (2 * pixel / size - 1)[:, None]
    fields = field[:, None].to(pixel)
    return torch.nn.functional.grid_sample(fields, grid, "bilinear", "border", align_corners=True)[:, 0, 0]


def curve_vectors(curve: Tensor, places: Tensor) -> tuple[Tensor, Tensor]:
    """Return the vectors from places to the nearest points of a polyline, and where those are along it.

    Args:
        curve: vertices [px], shape (..., V, 2).
        places: shape (..., S, 2) [px].

    Returns:
        Vectors [px], (..., S, 2), and places along the curve in edges [1], (..., S).
    """
    a, d = curve[..., :-1, :], curve[..., 1:, :] - curve[..., :-1, :]
    off = places[..., :, None, :] - a[..., None, :, :]
    t = (off * d[..., None, :, :]).sum(-1) / d.square().sum(-1).clamp(min=1e-18)[..., None, :]
    t = t.clamp(0.0, 1.0)
    vector = t[..., None] * d[..., None, :, :] - off
    best = vector.square().sum(-1).nan_to_num(torch.inf).argmin(-1, keepdim=True)
    found = torch.gather(vector, -2, best[..., None].expand(*best.shape, 2))[..., 0, :]
    return found, (best + torch.gather(t, -1, best))[..., 0]
