"""Fidelity of a simulation: how long its steps are, in how many substeps, by which integrator.

Cheaper steps keep most of what an episode earns, and are a choice for training. Results are judged at `PUBLISHED`.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

from torchdlo.errors import InputError

__all__ = ["PUBLISHED", "Fidelity", "parse_fidelity"]

_INTEGRATORS = ("explicit", "implicit")
_FRAME = 1e-3
"""In what the lengths of actions are counted [s]."""


@dataclass(frozen=True)
class Fidelity:
    """How a task is simulated."""

    step: float = _FRAME
    """Length of a step [s]: a whole number of milliseconds, of which actions take a whole number."""
    substeps: int = 5
    """Substeps per step."""
    integrator: str = "explicit"
    """"explicit" or "implicit"."""

    def __post_init__(self) -> None:
        whole = isinstance(self.step, int | float) and self.step > 0 and math.isfinite(self.step)
        if not whole or abs(self.step / _FRAME - round(self.step / _FRAME)) > 1e-6 or round(self.step / _FRAME) < 1:
            raise InputError(f"fidelity: step is {self.step!r} s; expected a whole number of ms, such as 0.001.")
        if not isinstance(self.substeps, int) or isinstance(self.substeps, bool) or self.substeps < 1:
            raise InputError(f"fidelity: substeps is {self.substeps!r}; expected a whole number from 1 on.")
        if self.integrator not in _INTEGRATORS:
            raise InputError(f"fidelity: integrator is {self.integrator!r}; expected one of {', '.join(_INTEGRATORS)}.")

    def steps(self, frames: int) -> int:
        """Return how many steps take as long as so many frames of 1 ms."""
        each = round(self.step / _FRAME)
        if frames % each:
            raise InputError(
                f"fidelity: steps of {self.step:g} s do not divide {frames} ms of a task; choose a step that does."
            )
        return frames // each

    @property
    def text(self) -> str:
        """The same in a few signs, as `parse_fidelity` reads it."""
        return f"{1e3 * self.step:g}ms/{self.substeps}" + ("" if self.integrator == "explicit" else "/implicit")

    def plain(self) -> dict[str, Any]:
        """Return the same as plain data."""
        return asdict(self)


PUBLISHED = Fidelity()
"""The benchmark's: 1 ms in 5 explicit substeps."""


def parse_fidelity(text: str) -> Fidelity:
    """Return the fidelity that a text names: "published", or such as "1ms/2" or "2ms/1/implicit"."""
    if text == "published":
        return PUBLISHED
    try:
        step, substeps, *rest = text.split("/")
        if not step.endswith("ms") or len(rest) > 1:
            raise ValueError
        return Fidelity(1e-3 * float(step.removesuffix("ms")), int(substeps), *rest)
    except InputError:
        raise
    except ValueError:
        raise InputError(
            f"fidelity: it is {text!r}; expected published, or step and substeps such as 1ms/2 or 2ms/1/implicit."
        ) from None
