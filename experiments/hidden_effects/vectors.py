"""Vectors and rotations as arrays with the components first: vectors (3, ...), quaternions (4, ...) as (w, x, y, z)."""

from __future__ import annotations

import numpy as np

Array = np.ndarray


def cross(a: Array, b: Array) -> Array:
    """Return a x b."""
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]
    return out


def dot(a: Array, b: Array) -> Array:
    """Return a.b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def norm(a: Array, least: float = 1e-30) -> Array:
    """Return |a|, at least `least`."""
    return np.sqrt(np.maximum(dot(a, a), least * least))


def rotate(q: Array, v: Array) -> Array:
    """Return the vectors turned by quaternions."""
    t = 2.0 * cross(q[1:], v)
    return v + q[0] * t + cross(q[1:], t)


def back(q: Array, v: Array) -> Array:
    """Return the vectors turned by the inverse quaternions."""
    t = 2.0 * cross(q[1:], v)
    return v - q[0] * t + cross(q[1:], t)


def conjugate(q: Array) -> Array:
    """Return the inverse of unit quaternions."""
    return np.concatenate([q[:1], -q[1:]])


def multiply(p: Array, q: Array) -> Array:
    """Return the product: first q, then p."""
    out = np.empty(np.broadcast_shapes(p.shape, q.shape))
    out[0] = p[0] * q[0] - dot(p[1:], q[1:])
    out[1:] = p[0] * q[1:] + q[0] * p[1:] + cross(p[1:], q[1:])
    return out


def exponential(v: Array) -> Array:
    """Return the quaternions of rotation vectors [rad]."""
    half = 0.5 * norm(v)
    return np.concatenate([np.cos(half)[None], 0.5 * np.sinc(half / np.pi) * v])


def logarithm(q: Array) -> Array:
    """Return the rotation vectors [rad] of quaternions, at most half a turn."""
    q = np.where(q[:1] < 0, -q, q)
    sine = norm(q[1:])
    scale = np.where(sine < 1e-9, 2.0, 2.0 * np.arctan2(sine, q[0]) / sine)
    return scale * q[1:]


def halfway(p: Array, q: Array) -> Array:
    """Return the rotations in the middle between two that are less than half a turn apart."""
    mean = p + q
    return mean / np.sqrt((mean * mean).sum(0))
