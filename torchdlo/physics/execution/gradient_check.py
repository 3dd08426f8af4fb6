"""Whether derivatives are those of what is computed: reverse mode against differences along random directions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchdlo.physics import tree
from torchdlo.physics.linalg.numerics import added


@dataclass(frozen=True)
class GradientCheck:
    """What reverse mode and differences say about some directions."""

    adjoint: Tensor
    """Directional derivatives by reverse mode, in units of the result per unit of `direction` [-], shape (D,)."""
    differences: Tensor
    """The same by central differences, extrapolated from two spans [-], shape (D,)."""
    uncertainty: Tensor
    """By how much the two spans disagree, likewise: smaller errors than that cannot be seen [-], shape (D,)."""

    @property
    def error(self) -> float:
        """Greatest difference of the two, over the greatest derivative by differences [-]."""
        scale = self.differences.abs().max().clamp(min=torch.finfo(self.differences.dtype).tiny)
        return float((self.adjoint - self.differences).abs().max() / scale)

    def __str__(self) -> str:
        unsure = float(self.uncertainty.max() / self.differences.abs().max().clamp(min=1e-300))
        return (
            f"gradients differ from central differences by {self.error:.1e} of the greatest of {len(self.adjoint)} "
            f"directional derivatives; the differences are known to {unsure:.1e}"
        )


def check_gradients(
    function: Callable[[Any], Tensor],
    inputs: Any,
    *,
    directions: int = 3,
    span: float | None = None,
    generator: torch.Generator | None = None,
) -> GradientCheck:
    """Compare the gradient of a function with central differences of the same forward pass.

    Args:
        function: makes one number of a tree of tensors, e.g. the mean height of a rope after a rollout.
        inputs: that tree: a tensor, a tuple or dictionary of them, `Params`, ...; in float64, or the differences tell
            little. Every floating-point leaf is varied.
        directions: how many random directions to try; each leaf is varied in proportion to its greatest entry.
        span: how far to go, as a share of that; by default the cube root of the precision, where errors of rounding
            and of the differences are equal.
        generator: where random directions come from; by default, always the same ones.

    Returns:
        Both derivatives; `error` compares them.
    """
    if directions < 1:
        raise ValueError(f"check_gradients: directions is {directions}; give at least 1")
    leaves, build = tree.flatten(inputs)
    varied = [k for k, x in enumerate(leaves) if isinstance(x, Tensor) and x.is_floating_point() and x.numel()]
    if not varied:
        raise ValueError("check_gradients: inputs hold no floating-point tensor; give what to differentiate by")
    generator = generator or torch.Generator().manual_seed(0)
    given = {k: leaves[k].detach() for k in varied}
    like = given[varied[0]]

    def call(changed: dict[int, Tensor]) -> Tensor:
        result = function(build([changed.get(k, x) for k, x in enumerate(leaves)]))
        if not isinstance(result, Tensor) or result.numel() != 1:
            shape = tuple(result.shape) if isinstance(result, Tensor) else type(result).__name__
            raise ValueError(f"check_gradients: the function gives {shape}; expected one number, e.g. a mean")
        return result.reshape(())

    moving = {k: x.clone().requires_grad_() for k, x in given.items()}
    result = call(moving)
    found: tuple[Tensor | None, ...] = (None,) * len(moving)
    if result.requires_grad:
        found = torch.autograd.grad(result, list(moving.values()), allow_unused=True)
    gradients = {k: torch.zeros_like(given[k]) if g is None else g for k, g in zip(moving, found, strict=True)}
    span = span or torch.finfo(like.dtype).eps ** (1 / 3)
    rows = []
    for _ in range(directions):
        way = {k: _direction(x, generator) for k, x in given.items()}

        def gradient(h: float, way: dict[int, Tensor] = way) -> Tensor:
            with torch.no_grad():
                ends = [call({k: x + sign * h * way[k] for k, x in given.items()}) for sign in (1.0, -1.0)]
            return (ends[0] - ends[1]) / (2 * h)

        wide, narrow = gradient(2 * span), gradient(span)
        adjoint = added((gradients[k] * way[k]).sum() for k in way)
        rows.append(torch.stack([adjoint.to(like), (4 * narrow - wide) / 3, (wide - narrow).abs()]))
    return GradientCheck(*torch.stack(rows, -1).detach().unbind(0))


def _direction(x: Tensor, generator: torch.Generator) -> Tensor:
    finite = torch.where(torch.isfinite(x), x, 0.0)
    size = finite.abs().max()
    random = torch.randn(x.shape, generator=generator, dtype=torch.float64).to(x)
    return torch.where(torch.isfinite(x), random * torch.where(size > 0, size, 1.0), 0.0)
