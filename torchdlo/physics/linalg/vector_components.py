"""Turning vectors component by component."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from torchdlo.physics.linalg.numerics import added

Numbers = tuple[Tensor, ...]
"""Components of vectors, shape (..., 1) each. For compilers,
graphs of them are simple, and those of vector products are not."""


def axes(quat: Tensor) -> tuple[Numbers, Numbers, Numbers]:
    """Return where the axes of bodies point, i.e. the columns of the rotation matrix as `rotate` has it."""
    w, x, y, z = quat.split(1, -1)
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
        (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
        (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
    )


def local(columns: tuple[Numbers, Numbers, Numbers], vector: Numbers) -> list[Tensor]:
    """Return vectors of the world in the frames of bodies."""
    return [added(c * v for c, v in zip(column, vector, strict=True)) for column in columns]


def world(columns: tuple[Numbers, Numbers, Numbers], vector: Sequence[Tensor]) -> list[Tensor]:
    """Return vectors in the frames of bodies in the world."""
    return [added(column[i] * v for column, v in zip(columns, vector, strict=True)) for i in range(3)]
