"""How steps run: replayed for gradients, or traced."""

from __future__ import annotations

from typing import Literal, get_args

from torchdlo.errors import InputError

__all__ = ["EXECUTIONS", "Execution", "check_execution"]

Execution = Literal["compiled", "recorded", "eager"]
"""Who runs the operations of a step.

compiled: `torch.compile`. Ten seconds to minutes at first, then many times faster, with and without gradients.
recorded: TorchScript's tracer and kernels. Seconds at first, then two to three times as fast without gradients; with
    them as eager.
eager: Python, at once.
"""

EXECUTIONS: tuple[Execution, ...] = get_args(Execution)


def check_execution(given: str, where: str = "execution") -> Execution:
    """Return the way of running steps that is meant."""
    for known in EXECUTIONS:
        if given == known:
            return known
    raise InputError(f"{where}: it is {given!r}; expected one of {', '.join(EXECUTIONS)}.")
