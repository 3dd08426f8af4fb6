"""Pictures and masks made smaller and blurred, by OpenCV."""

from __future__ import annotations

import numpy as np

__all__ = ["blur", "quarter"]


def blur(pictures: np.ndarray, sigma: float) -> np.ndarray:
    """Return pictures (..., h, w) float32 blurred by a Gaussian [px]; 0 beyond the edges."""
    import cv2

    flat = pictures.reshape(-1, *pictures.shape[-2:])
    out = np.empty_like(flat)
    for k, picture in enumerate(flat):
        out[k] = cv2.GaussianBlur(picture, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)
    return out.reshape(pictures.shape)


def quarter(masks: np.ndarray) -> np.ndarray:
    """Return masks (F, H, W) at a quarter of their size, shares that are covered, float32; sides are multiples of 8."""
    import cv2

    frames, height, width = masks.shape
    size = (-(-width // 32) * 8, -(-height // 32) * 8)
    out = np.zeros((frames, size[1], size[0]), np.float32)
    padded = np.zeros((4 * size[1], 4 * size[0]), np.float32)
    for k, mask in enumerate(masks):
        padded[:height, :width] = mask
        out[k] = cv2.resize(padded, size, interpolation=cv2.INTER_AREA)
    return out
