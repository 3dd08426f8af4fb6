"""What one number of a model is called: in files and on the command line as text, elsewhere by its parts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TypeVar

__all__ = ["ParameterName", "values_of"]

T = TypeVar("T")


@dataclass(frozen=True)
class ParameterName:
    """Which number of a model is meant; as text `damping_rate`, `air_drag.c_d` or `wind.velocity.0`."""

    effect: str
    """The effect that has it, "" for a number of the plain model."""
    number: str
    """Its name there."""
    component: int | None = None
    """Which of its components, None where it has one only."""

    @classmethod
    def parse(cls, text: str) -> ParameterName:
        """Return the name that a text says."""
        effect, dot, rest = text.partition(".")
        if not dot:
            return cls("", text)
        number, _, last = rest.rpartition(".")
        return cls(effect, number, int(last)) if number and last.isdecimal() else cls(effect, rest)

    @property
    def key(self) -> str:
        """What it is called within its effect, with its component."""
        return self.number if self.component is None else f"{self.number}.{self.component}"

    @property
    def whole(self) -> ParameterName:
        """The vector that it is a component of, or itself."""
        return replace(self, component=None)

    def __str__(self) -> str:
        return f"{self.effect}.{self.key}" if self.effect else self.key


def values_of(effect: str, values: Mapping[str, T]) -> dict[str, T]:
    """Return what is said of the numbers of one effect, by `ParameterName.key`; `values` has texts of names."""
    names = {ParameterName.parse(text): value for text, value in values.items()}
    return {name.key: value for name, value in names.items() if name.effect == effect}
