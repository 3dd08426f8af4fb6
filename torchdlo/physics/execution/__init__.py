"""How steps run: replayed for gradients, or traced."""

from __future__ import annotations

from typing import Literal, get_args

from torchdlo.errors import InputError

__all__ = ["EXECUTIONS", "Execution", "check_execution", "execution_named"]

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
    found = execution_named(given)
    if found is None:
        raise InputError(f"{where}: it is {given!r}; expected one of {', '.join(EXECUTIONS)}.")
    return found


def execution_named(given: object) -> Execution | None:
    """Return the way of running steps of this name, None if there is none."""
    return next((known for known in EXECUTIONS if known == given), None)
