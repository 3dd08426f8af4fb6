"""Statistics of a set's columns over all of its frames: exact, and made once, as merged ones would not be."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

__all__ = ["QUANTILES", "channel_histogram", "column_statistics", "picture_statistics"]

QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}


def column_statistics(values: np.ndarray) -> dict[str, Any]:
    """Return statistics of a column, shape (N, D) or (N,), as lists of D numbers or of one."""
    x = values.reshape(len(values), -1).astype(np.float64)
    found = {"min": x.min(0), "max": x.max(0), "mean": x.mean(0), "std": x.std(0)}
    quantiles = np.quantile(x, list(QUANTILES.values()), axis=0)
    found |= dict(zip(QUANTILES, quantiles, strict=True))
    return {name: value.tolist() for name, value in found.items()} | {"count": [len(x)]}


def channel_histogram(frames: Iterable[np.ndarray]) -> np.ndarray:
    """Return how often each value is there, by channel, shape (3, 256)."""
    found = np.zeros((3, 256), np.int64)
    for image in frames:
        for channel in range(3):
            found[channel] += np.bincount(image[..., channel].ravel(), minlength=256)
    return found


def picture_statistics(counts: np.ndarray, frames: int) -> dict[str, Any]:
    """Return statistics of pictures, of values from 0 to 1, in shape (3, 1, 1), from how often each value is there."""
    value, total = np.arange(256) / 255, counts.sum(1)
    mean = counts @ value / total
    std = np.sqrt(np.maximum(counts @ value**2 / total - mean**2, 0))
    there = counts > 0
    found = {"min": value[there.argmax(1)], "max": value[255 - there[:, ::-1].argmax(1)], "mean": mean, "std": std}
    below = counts.cumsum(1)
    for name, share in QUANTILES.items():
        # The value of the pixel of that rank.
        rank = np.ceil(share * total)
        found[name] = value[(below >= np.maximum(rank, 1)[:, None]).argmax(1)]
    return {name: x.reshape(3, 1, 1).tolist() for name, x in found.items()} | {"count": [frames]}
