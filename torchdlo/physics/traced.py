"""Steps without Python between their operations: recorded once for given shapes, then replayed.

Recording takes less than a second where compiling takes many, and makes steps of small batches two or three times as
fast as they are in eager mode. It is for simulations without gradients.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import torch

from torchdlo.physics import tree


def record(step: Callable[..., Any], *inputs: Any) -> Callable[..., Any]:
    """Return a function that does what `step` does to trees of tensors of the same shapes as `inputs`.

    Whatever `step` captures besides its arguments stays as it is now, and so does every choice that Python makes.
    """
    leaves, build = tree.flatten(inputs)
    rebuild: list[Callable[..., Any]] = []

    def run(*values: torch.Tensor) -> tuple[torch.Tensor, ...]:
        found, back = tree.flatten(step(*build(values)))
        rebuild.append(back)
        return tuple(found)

    with torch.no_grad(), warnings.catch_warnings():
        # Deprecated in favour of compiling, which takes too long here; and shapes are meant to be fixed.
        warnings.simplefilter("ignore", DeprecationWarning)
        warnings.simplefilter("ignore", torch.jit.TracerWarning)
        recorded = torch.jit.trace(run, tuple(leaves), check_trace=False)

    @torch.no_grad()
    def replayed(*trees: Any) -> Any:
        return rebuild[0](recorded(*tree.flatten(trees)[0]))

    return replayed
