"""Learning agents and trajectory optimisation."""

from __future__ import annotations

from typing import TYPE_CHECKING

from torchdlo import lazy

if TYPE_CHECKING:
    from torchdlo.agents.trajopt.presets import search_preset
    from torchdlo.agents.trajopt.problem import Problem
    from torchdlo.agents.trajopt.search import SearchResult, SearchSettings, optimize

__getattr__, __dir__ = lazy.attach(
    __name__,
    {
        "SearchResult": "torchdlo.agents.trajopt.search",
        "Problem": "torchdlo.agents.trajopt.problem",
        "SearchSettings": "torchdlo.agents.trajopt.search",
        "optimize": "torchdlo.agents.trajopt.search",
        "search_preset": "torchdlo.agents.trajopt.presets",
    },
)

__all__ = ["Problem", "SearchResult", "SearchSettings", "optimize", "search_preset"]
