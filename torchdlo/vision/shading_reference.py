"""How surfaces are painted and lit, in array operations, as `renderer.cpp` does it."""

from __future__ import annotations

from typing import Any

import numpy as np

__all__ = ["background_light", "dot", "encoded", "mix", "smooth", "surface_colors", "surface_light", "unit"]

PLAIN, WOOD, SPECKLED, CHECKED, WOVEN, TWISTED = range(6)

Array = np.ndarray


def dot(a: Array, b: Array) -> Array:
    """Return products of vectors, shape (...)."""
    return (a * b).sum(-1)


def unit(a: Array) -> Array:
    """Return vectors of length 1 along vectors; along z for those of length 0."""
    size = dot(a, a)[..., None]
    up = np.array([0, 0, 1], np.float32)
    return np.where(size > 1e-30, a / np.sqrt(np.where(size > 1e-30, size, 1)), up).astype(np.float32)


def mix(a: Array, b: Array, share: Array) -> Array:
    """Return what is a share of the way from one to another."""
    return a + np.asarray(share, np.float32)[..., None] * (b - a)


def smooth(x: Array) -> Array:
    """Return a step with level ends from 0 at 0 to 1 at 1."""
    x = np.clip(x, 0, 1)
    return x * x * (3 - 2 * x)


def _hashed(x: Array, y: Array, seed: Array) -> Array:
    with np.errstate(over="ignore"):
        x, y = x.astype(np.int64).astype(np.uint32), y.astype(np.int64).astype(np.uint32)
        h = x * np.uint32(0x8DA6B343) ^ y * np.uint32(0xD8163841) ^ seed.astype(np.uint32) * np.uint32(0xCB1AB31F)
        h ^= h >> np.uint32(13)
        h *= np.uint32(0x5BD1E995)
        h ^= h >> np.uint32(15)
        h *= np.uint32(0x27D4EB2D)
        h ^= h >> np.uint32(13)
    return ((h >> np.uint32(8)) * (1 / 16777216)).astype(np.float32)


def _noise(x: Array, y: Array, seed: Array) -> Array:
    i, j = np.floor(x), np.floor(y)
    s, t = smooth(x - i), smooth(y - j)
    a, b, c, d = (_hashed(i + k % 2, j + k // 2, seed) for k in range(4))
    return (1 - t) * ((1 - s) * a + s * b) + t * ((1 - s) * c + s * d)


def _wave(x: Array) -> Array:
    f = x - np.floor(x)
    return smooth(np.where(f < 0.5, 2 * f, 2 - 2 * f))


def surface_colors(m: Array, p: Array, uv: Array, blur: Array) -> Array:
    """Return colours before light falls on them; materials (n, 12), points (n, 3)."""
    one, two, kind, scale = m[:, :3], m[:, 3:6], m[:, 7].astype(int), m[:, 8]
    sharp, seed = np.clip(1.5 - blur * scale, 0, 1), m[:, 11].astype(np.int64)
    x, y = (m[:, 9] * p[:, 0] + m[:, 10] * p[:, 1]) * scale, (m[:, 9] * p[:, 1] - m[:, 10] * p[:, 0]) * scale
    board = np.floor(y)
    off = _hashed(board, np.full_like(board, 7), seed)
    grain = _noise(0.6 * x + 9 * off, 9 * (y - board) + 37 * off, seed)
    fine = _noise(3 * x + 5 * off, 40 * (y - board), seed + 1)
    edge = np.minimum(y - board, board + 1 - y)
    wood = 0.2 + 0.35 * off + 0.3 * grain + 0.25 * sharp * fine + sharp * 0.35 * np.clip(1 - edge / 0.025, 0, 1)
    finest = sharp * _noise(11 * x, 11 * y, seed + 2) + (1 - sharp) * 0.5
    speckled = 0.5 * _noise(x, y, seed) + 0.3 * _noise(3.1 * x, 3.1 * y, seed + 1) + 0.2 * finest
    checked = (1 - sharp) * 0.5 + sharp * ((np.floor(x) + np.floor(y)).astype(int) & 1)
    woven = 0.5 + sharp * (0.5 * (_wave(x) + _wave(y)) - 0.5) * 0.7 + 0.4 * (_noise(0.13 * x, 0.13 * y, seed) - 0.5)
    share = np.select([kind == k for k in (WOOD, SPECKLED, CHECKED, WOVEN)], [wood, speckled, checked, woven], 0.0)
    found = mix(one, two, np.clip(share, 0, 1))
    strands = mix(one, two, _wave(uv[:, 0] * m[:, 9] + uv[:, 1] * scale))
    twisted = mix(mix(one, two, np.full(len(m), 0.35)), strands, np.clip(1.3 - 0.7 * blur * scale, 0, 1))
    return np.where((kind == TWISTED)[:, None], twisted, found)


def surface_light(light: Array, shadow: Any, p: Array, n: Array, to_eye: Array, color: Array, gloss: Array) -> Array:
    """Return the light that surfaces send to the eye, shape (n, 3)."""
    off = dot(n, to_eye)[:, None]
    n = np.where(off < 0, unit(n - 1.02 * off * to_eye), n)
    to_key, key, to_fill, fill = unit(light[:3]), light[3:6], unit(light[6:9]), light[9:12]
    facing = dot(n, to_key)
    open_ = np.ones(len(p)) if shadow is None else shadow.lit(p, n, facing, float(light[28]))
    direct = np.where(facing > 0, facing * open_, 0)[:, None]
    aside = np.maximum(0, 0.75 * dot(n, to_fill) + 0.25)[:, None]
    around = mix(light[15:18], light[12:15], 0.5 + 0.5 * n[:, 2])
    shine = np.maximum(0, dot(n, unit(to_key + to_eye)))[:, None] ** 32
    rim = (1 - np.maximum(0, dot(n, to_eye)))[:, None] ** 4
    bright = direct / np.maximum(facing, 0.2)[:, None] * shine * key + 0.3 * rim * light[12:15]
    return color * (direct * key + aside * fill + around) + gloss[:, None] * bright


def background_light(light: Array, eye: Array, ray: Array) -> Array:
    """Return what is seen where nothing is: the floor of the room, and a wall that goes over into it."""
    wall = mix(light[21:24], light[18:21], smooth(0.5 + 1.2 * ray[:, 2]))
    down = (ray[:, 2] < -1e-4) & (eye[2] > light[27])
    away = (light[27] - eye[2]) / np.where(down, ray[:, 2], 1)
    flat = np.hypot(ray[:, 0], ray[:, 1]) * away
    return np.where(down[:, None], mix(light[24:27], wall, smooth(flat / light[29])), wall)


def encoded(x: Array) -> Array:
    """Return light as a screen shows it, 8 bits."""
    x = np.minimum(np.floor(np.maximum(x, 0) * 2048 + 0.5), 4096) / 4096 * 2
    x = np.minimum(1, x * (1 + 0.15 * x) / (1 + 0.72 * x))
    y = np.where(x > 0.0031308, 1.055 * x ** (1 / 2.4) - 0.055, 12.92 * x)
    return np.clip(255 * y + 0.5, 0, 255).astype(np.uint8)
