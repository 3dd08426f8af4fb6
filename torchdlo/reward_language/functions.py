"""What expressions can call, and how numbers stay finite.

Every value is a tensor of shape (B or 1, N, C): a number of each scene has N = C = 1, a point C = 3, a rope is a list
of N points, and numbers along a rope are a list with C = 1. Conditions are bool. Magnitudes end at `LARGEST`, forward
and backward, so that no value and no gradient is ever infinite or not a number.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchdlo.errors import InputError
from torchdlo.physics.linalg import numerics

__all__ = ["FUNCTIONS", "LARGEST", "MOST", "Function", "bounded", "divide", "kind", "power", "together"]

LARGEST = 1e12
"""Greatest magnitude of a value and of a gradient."""
LEAST = 1e-6
"""Least magnitude of what is divided by; less counts as this much, with its sign."""
MOST = 4_000_000
"""Most numbers of a value."""


class _Bounded(torch.autograd.Function):
    """Cut values and gradients at `LARGEST`."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        """Return the values, cut."""
        ctx.save_for_backward(x.abs() <= LARGEST)
        return x.clamp(-LARGEST, LARGEST)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        """Return the gradient, cut, and 0 where the value was."""
        (within,) = ctx.saved_tensors
        return torch.where(within, gradient.clamp(-LARGEST, LARGEST), 0.0)


def bounded(x: Tensor) -> Tensor:
    """Return values that are finite, and whose gradients are."""
    if not x.is_floating_point():
        return x
    return _Bounded.apply(x) if x.requires_grad else x.clamp(-LARGEST, LARGEST)


def kind(x: Tensor) -> str:
    """Return what a value is, in words."""
    count, size = x.shape[-2:]
    one = "condition" if x.dtype == torch.bool else "point" if size == 3 else "number"
    return f"a {one}" if count == 1 else f"a list of {count} {one}s"


def together(a: Tensor, b: Tensor, where: str, *, scale: bool = False) -> None:
    """Refuse values that do not go together: lists of other lengths; points with numbers, unless one scales the other.

    Args:
        a: one value.
        b: the other.
        where: what is done with them.
        scale: whether a number may meet a point.
    """
    counts = {x.shape[-2] for x in (a, b)} - {1}
    if len(counts) > 1 or (a.shape[-1] != b.shape[-1] and not scale):
        raise InputError(f"{where} is given {kind(a)} and {kind(b)}; give it two of a kind, or one for each of a list.")
    check_size(tuple(map(max, a.shape, b.shape)), where)


def check_size(shape: tuple[int, ...], where: str) -> None:
    """Refuse what would be too large."""
    count = 1
    for size in shape:
        count *= size
    if count > MOST:
        raise InputError(f"{where} would make {count} numbers; expected {MOST} at most: use slices, or fewer scenes.")


def divide(a: Tensor, b: Tensor) -> Tensor:
    """Return a / b, with b no nearer to 0 than `LEAST`."""
    near = b.abs() < LEAST
    held = torch.where(b < 0, -LEAST, LEAST).to(b)
    return a / torch.where(near, held, b)


def root(x: Tensor) -> Tensor:
    """Return the square root, 0 with no gradient where x is not positive."""
    zero = x <= numerics.tiny(x) ** 2
    return torch.where(zero, 0.0, torch.where(zero, 1.0, x).sqrt())


def power(x: Tensor, exponent: float) -> Tensor:
    """Return x to the power of 2, 3, 4 or 0.5."""
    return root(x) if exponent == 0.5 else x ** int(exponent)


def _norm(x: Tensor) -> Tensor:
    return numerics.safe_norm(x)


def _log(x: Tensor) -> Tensor:
    return x.clamp(min=LEAST).log()


def _exp(x: Tensor) -> Tensor:
    return x.clamp(max=27.0).exp()


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return (a * b).sum(-1, keepdim=True)


def _dist(a: Tensor, b: Tensor) -> Tensor:
    return numerics.safe_norm(a - b)


def _where(condition: Tensor, a: Tensor, b: Tensor) -> Tensor:
    return torch.where(condition, a, b)


def _apart(a: Tensor, b: Tensor) -> Tensor:
    """Return distances (B, N, M) of two lists of points."""
    batch = max(len(a), len(b))
    check_size((batch, a.shape[-2], b.shape[-2], 3), "nearest")
    return numerics.safe_norm(a.unsqueeze(-2) - b.unsqueeze(-3)).squeeze(-1)


def _nearest(a: Tensor, b: Tensor) -> Tensor:
    """Return the distance of each point of b (M) to the nearest of a, shape (B, M, 1)."""
    return _apart(a, b).amin(-2).unsqueeze(-1)


def _closest(a: Tensor, b: Tensor) -> Tensor:
    """Return the point of a that is nearest to each point of b, shape (B, M, 3)."""
    which = _apart(a, b).argmin(-2).unsqueeze(-1)
    return torch.take_along_dim(a, which, -2)


def _point(x: Tensor, y: Tensor, z: Tensor) -> Tensor:
    return torch.cat(torch.broadcast_tensors(x, y, z), -1)


def _chamfer(a: Tensor, b: Tensor) -> Tensor:
    apart = _apart(a, b)
    return (apart.amin(-1).mean(-1) + apart.amin(-2).mean(-1)).reshape(-1, 1, 1)


@dataclass(frozen=True)
class Function:
    """A function of the language."""

    call: Callable[..., Tensor]
    takes: str
    """One letter per argument: N numbers, P points, C conditions, A numbers or points; single ones or lists."""
    doc: str


FUNCTIONS: dict[str, Function] = {
    "norm": Function(_norm, "P", "length of a vector [m]"),
    "dist": Function(_dist, "PP", "distance of two points [m], vertex by vertex for a rope"),
    "dot": Function(_dot, "PP", "scalar product"),
    "x": Function(lambda p: p[..., 0:1], "P", "first coordinate [m]"),
    "y": Function(lambda p: p[..., 1:2], "P", "second coordinate [m]"),
    "z": Function(lambda p: p[..., 2:3], "P", "height [m]"),
    "xy": Function(lambda p: p * p.new_tensor([1.0, 1.0, 0.0]), "P", "the point with its height set to 0"),
    "point": Function(_point, "NNN", "a point of three coordinates"),
    "nearest": Function(_nearest, "PP", "nearest(rope, p): distance of p to the nearest vertex of the rope [m]"),
    "closest": Function(_closest, "PP", "closest(rope, p): where the vertex nearest to p is"),
    "chamfer": Function(_chamfer, "PP", "mean nearest distances of two lists of points, from either side [m]"),
    "exp": Function(_exp, "N", "exponential, of arguments up to 27"),
    "log": Function(_log, "N", "natural logarithm, of arguments from 1e-6 on"),
    "sqrt": Function(root, "N", "square root, 0 of what is negative"),
    "tanh": Function(torch.tanh, "N", "hyperbolic tangent"),
    "sigmoid": Function(torch.sigmoid, "N", "1 / (1 + exp(-x))"),
    "abs": Function(torch.abs, "N", "magnitude"),
    "relu": Function(torch.relu, "N", "x where it is positive, else 0"),
    "sin": Function(torch.sin, "N", "sine of an angle [rad]"),
    "cos": Function(torch.cos, "N", "cosine of an angle [rad]"),
    "clamp": Function(lambda x, low, high: torch.minimum(torch.maximum(x, low), high), "NNN", "x from low to high"),
    "minimum": Function(torch.minimum, "NN", "the lesser of two, vertex by vertex"),
    "maximum": Function(torch.maximum, "NN", "the greater of two, vertex by vertex"),
    "where": Function(_where, "CAA", "where(condition, a, b)"),
    "mean": Function(lambda x: x.mean(-2, keepdim=True), "A", "mean along a rope"),
    "sum": Function(lambda x: x.sum(-2, keepdim=True), "A", "sum along a rope"),
    "min": Function(lambda x: x.amin(-2, keepdim=True), "N", "least along a rope"),
    "max": Function(lambda x: x.amax(-2, keepdim=True), "N", "greatest along a rope"),
    "any": Function(lambda c: c.any(-2, keepdim=True), "C", "whether a condition holds anywhere along a rope"),
    "all": Function(lambda c: c.all(-2, keepdim=True), "C", "whether it holds all along a rope"),
}
"""All that can be called."""
