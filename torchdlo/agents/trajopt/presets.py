"""Settings of trajectory optimisation by task: those that were published for the tasks, and ours for the hybrid."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from torchdlo.agents.trajopt.search import SearchSettings

__all__ = ["PUBLISHED", "search_preset"]

EPISODES = {"gathering": 8_000, "lifting": 10_000, "unknotting": 10_000}
"""Budgets that differ from 20 000 episodes."""
SIGMA = {"gathering": 0.005, "lifting": 0.005, "letter_art": 0.005}
"""First spreads of CMA-ES that differ from 0.05 m."""
RATE = {"gathering": 1e-4, "lifting": 1e-4, "unknotting": 1e-4}
"""First steps of Adam that differ from 1 mm."""
HOLD = {"coiling": 5}
"""Actions per way-point of hybrids that differ from 10: ways of 10 cm are chords too long for a small circle."""
SPREAD = {"lifting": 0.02}
"""First spreads of hybrids, if not the one that follows from `HOLD` [m]: hands that go far from a good way tear it."""
SURROGATE_SHARE = {"gathering": 0.9}
"""Shares of iterations in which hybrids play the task's surrogate task, if not 0."""
POPULATION = {"cmaes": 400, "gd": 16, "hybrid": 100}
"""Most trajectories per iteration. One start of gradient descent is published; more of them use up the same budget.
Gradients need iterations more than numbers."""
_ITERATIONS = 50
"""Iterations that a small budget allows all the same, as long as populations have so many trajectories as below."""
_FEWEST = {"cmaes": 20, "gd": 4, "hybrid": 12}
"""The fewest by method: descents go far in many small steps, and hybrids need 12 for one line beside their search."""

PUBLISHED = {
    "coiling": {"gd": (11.59, 1.0), "cmaes": (11.73, 1.0)},
    "gathering": {"gd": (39.84, 0.0), "cmaes": (47.84, 1.0)},
    "lifting": {"gd": (255.55, 0.0), "cmaes": (335.59, 0.87)},
    "separation": {"gd": (115.52, 1.0), "cmaes": (84.86, 1.0)},
    "slingshot": {"gd": (6.90, 0.0), "cmaes": (11.07, 0.93)},
    "unknotting": {"gd": (3.44, 0.0), "cmaes": (57.21, 0.93)},
    "wiring_post": {"gd": (36.40, 0.0), "cmaes": (64.31, 0.93)},
    "wrapping": {"gd": (139.98, 0.0), "cmaes": (162.68, 0.27)},
}
"""Published returns, largest within the budget, mean of three seeds, and shares of successes; budgets are those of
`search_preset`."""


def search_preset(task: str, method: str, **given: Any) -> SearchSettings:
    """Return the settings for a task and a method; what is given and not None wins."""
    episodes = given.get("episodes") or EPISODES.get(task, 20_000)
    copies = given["robust"].copies if given.get("robust") else 1
    found = SearchSettings(
        method=method,
        episodes=episodes,
        population=min(POPULATION.get(method, 400), max(_FEWEST.get(method, 20), episodes // (copies * _ITERATIONS))),
        sigma=SIGMA.get(task, 0.05),
        rate=RATE.get(task, 1e-3),
    )
    if method == "hybrid":
        # Tools that go together, or down a gradient, do not need the small steps that keep them from tearing a rope:
        # the first spread is the one that follows from `hold`, most often.
        found = replace(found, hold=HOLD.get(task), sigma=SPREAD.get(task))
        if not given.get("robust"):
            found = replace(found, surrogate_share=SURROGATE_SHARE.get(task, 0.0))
    return replace(found, **{name: value for name, value in given.items() if value is not None})
