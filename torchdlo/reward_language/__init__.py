"""A language of single expressions in which people and models write rewards and conditions of success.

An expression is read with `ast`, each of its nodes has to be on a list, and it is interpreted on batches of scenes with
gradients. It is never compiled, evaluated or executed by Python. See docs/reward_language.md.
"""

from __future__ import annotations

from torchdlo.reward_language.expression import Expression, parse
from torchdlo.reward_language.functions import FUNCTIONS, Function
from torchdlo.reward_language.terms import Reward, load_reward, read_reward, reward

__all__ = ["FUNCTIONS", "Expression", "Function", "Reward", "load_reward", "parse", "read_reward", "reward"]
