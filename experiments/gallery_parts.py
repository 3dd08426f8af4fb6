"""What the scenes of the gallery share: what a scene is, and what is measured in several of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torchdlo.scene_files import SceneDescription
    from torchdlo.scene_files.run import Frames

Claims = dict[str, tuple[float, float, float]]
"""What has to happen: the measured value, and the least and the greatest that it may be."""
HUGE = 1e9


@dataclass(frozen=True)
class Show:
    """A scene of the gallery."""

    title: str
    scene: Callable[[bool], SceneDescription]
    """The scene; True asks for a coarse one."""
    claims: Callable[[Frames, SceneDescription], Claims]
    frame_stride: int = 10
    moments: tuple[float, ...] | None = None
    """Moments in the picture [s]; start, middle and end if not given."""


def circle(count: int, radius: float, centre: Sequence[float], across: str = "xy", turn: float = 0.0) -> tuple:
    """Points of a circle in a plane of two axes."""
    found = []
    for k in range(count):
        angle = 2 * math.pi * k / count + turn
        point = list(centre)
        point["xyz".index(across[0])] += radius * math.cos(angle)
        point["xyz".index(across[1])] += radius * math.sin(angle)
        found.append(tuple(point))
    return tuple(found)


def rope_of(frames: Frames, number: int, k: int = -1) -> Any:
    """Vertices of a rope at a frame."""
    return frames.pos[k, frames.rope == number]


def closest(a: Any, b: Any, apart: int = 0) -> float:
    """Least distance of two finely drawn lines; of one line to itself, of places more than `apart` points away."""
    import numpy as np

    def fine(x: Any) -> Any:
        at = np.linspace(0, len(x) - 1, 8 * (len(x) - 1) + 1)
        return np.stack([np.interp(at, np.arange(len(x)), c) for c in x.T], 1)

    d = np.linalg.norm(fine(a)[:, None] - fine(b)[None], axis=-1)
    if apart:
        i, j = np.indices(d.shape)
        d[abs(i - j) <= 8 * apart] = math.inf
    return float(d.min())


def loop(x: Any) -> Any:
    """A closed line that ends where it begins."""
    import numpy as np

    return np.concatenate([x, x[:1]])


def linking(a: Any, b: Any) -> float:
    """Linking number of two closed lines, from the solid angles of pairs of edges (Klenin, Langowski 2000)."""
    import numpy as np

    a, b = loop(a), loop(b)
    p, q = (a[:-1, None], a[1:, None]), (b[None, :-1], b[None, 1:])
    r13, r14, r23, r24 = (q[j] - p[i] for i in (0, 1) for j in (0, 1))
    faces = [np.cross(u, v) for u, v in ((r13, r14), (r14, r24), (r24, r23), (r23, r13))]
    n = [f / np.maximum(np.linalg.norm(f, axis=-1, keepdims=True), 1e-300) for f in faces]
    solid = sum(np.arcsin(np.clip((n[k] * n[(k + 1) % 4]).sum(-1), -1, 1)) for k in range(4))
    sign = np.sign((np.cross(q[1] - q[0], p[1] - p[0]) * r13).sum(-1))
    return float((solid * sign).sum() / (4 * math.pi))
