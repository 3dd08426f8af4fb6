"""Rewards of named expressions, and the file that holds one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchdlo.errors import InputError
from torchdlo.reward_language.expression import Expression, parse
from torchdlo.untrusted import read_json

__all__ = ["Reward", "load_reward", "read_reward", "reward"]

_TERMS = 12
"""Most terms of a reward."""
_FILE = 100_000
"""Most bytes of a file."""


@dataclass(frozen=True)
class Reward:
    """A reward, the sum of its terms, and a condition of success if there is one."""

    terms: tuple[tuple[str, Expression], ...]
    success: Expression | None = None

    def evaluate(self, scene: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return the terms by name, shape (B,) each; see `Expression.evaluate`."""
        like = next(iter(scene.values()))
        found = {name: term.evaluate(scene) for name, term in self.terms}
        return {name: x.to(like.dtype) if x.dtype == torch.bool else x for name, x in found.items()}

    def succeeded(self, scene: Mapping[str, Tensor]) -> Tensor | None:
        """Return where the condition of success holds, bool, shape (B,); None if there is no condition."""
        if self.success is None:
            return None
        found = self.success.evaluate(scene)
        if found.dtype != torch.bool:
            raise InputError(f"{self.success.label}: it gives a number; write a condition, such as z(ring_0) > 0.1.")
        return found

    def plain(self) -> dict[str, Any]:
        """Return the reward as plain data."""
        success = {} if self.success is None else {"success": self.success.text}
        return {"reward": {name: term.text for name, term in self.terms}} | success


def reward(terms: Mapping[str, str], success: str | None = None, where: str = "reward") -> Reward:
    """Return a reward of expressions.

    Args:
        terms: expressions by the names of the terms.
        success: a condition.
        where: where they are from, for what is said of them.
    """
    if not isinstance(terms, Mapping) or not 1 <= len(terms) <= _TERMS:
        raise InputError(f"{where}: expected 1 to {_TERMS} terms by name, as in {{'near': '-dist(tool_0, ring_0)'}}.")
    odd = [n for n in terms if not (isinstance(n, str) and n.isascii() and n.isidentifier() and len(n) <= 40)]
    if odd:
        raise InputError(f"{where}: {str(odd[0])[:40]!r} is no name of a term; use letters, digits and _.")
    read = tuple((name, parse(text, f"{where}, term {name}")) for name, text in terms.items())
    return Reward(read, None if success is None else parse(success, f"{where}, success"))


def load_reward(path: Path) -> Reward:
    """Return the reward of a file: {"reward": {name: expression}, "success": condition}, the latter if wanted."""
    content = read_json(path, 'a reward such as {"reward": {"near": "-dist(tool_0, ring_0)"}}', most=_FILE)
    return read_reward(content, str(path))


def read_reward(content: Any, where: str) -> Reward:
    """Return the reward that `Reward.plain` wrote.

    Args:
        content: the plain data, which may be anything.
        where: they are from, for what is said of them.
    """
    if not isinstance(content, dict) or "reward" not in content or content.keys() - {"reward", "success"}:
        raise InputError(f'{where}: expected an object with "reward" and, if wanted, "success", and nothing else.')
    return reward(content["reward"], content.get("success"), where)
