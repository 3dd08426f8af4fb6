"""The files of an optimisation: what it found, and the trajectory that can be played again."""

from __future__ import annotations

import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchdlo.agents.trajopt.problem import Evaluation, Problem
from torchdlo.agents.trajopt.search import SearchResult, SearchSettings
from torchdlo.agents.trajopt.search_journal import code_versions, program_hash
from torchdlo.errors import InputError
from torchdlo.physics.execution import EXECUTIONS, Execution, execution_named
from torchdlo.untrusted import Entry, one_line, read_entry

__all__ = [
    "check_scene",
    "execution_of",
    "load_actions",
    "plain_evaluation",
    "read_trajectory",
    "result_json",
    "search_summary",
    "trajectory_json",
    "upgrade_result",
]

_OLDER = {
    "searched": "search_return",
    "highest": "max_return",
    "solved_after": "episodes_to_success",
    "shortfall": "terminal_cost",
}
"""Entries of results and trajectories of version 0.1."""
_OLDER_CURVE = {"rehearsed": "surrogate", "without_slope": "without_gradient"}
"""Entries of their learning curves."""
_LARGEST = 1e6
"""Largest action of a trajectory [m, degrees]."""
_SETTINGS = {"rehearsed": "surrogate_share"}
"""Entries of their settings."""


def upgrade_result(content: dict[str, Any]) -> dict[str, Any]:
    """Return a result or a trajectory of version 0.1 by the names of today; others as they are."""
    found = {_OLDER.get(name, name): value for name, value in content.items()}
    if "settings" in found:
        found["settings"] = {_SETTINGS.get(name, name): value for name, value in found["settings"].items()}
    if "curve" in found:
        found["curve"] = [{_OLDER_CURVE.get(name, name): value for name, value in p.items()} for p in found["curve"]]
    return found


def plain_evaluation(outcome: Evaluation) -> dict[str, Any]:
    """Return how one trajectory went, as plain data; None for what is no number."""
    return {
        "return": _number(outcome.returns),
        "loss": _number(outcome.loss),
        "success": bool(outcome.success[0]),
        "failed": bool(outcome.failed[0]),
    }


def _number(x: Tensor) -> float | None:
    return float(x[0]) if math.isfinite(float(x[0])) else None


def search_summary(found: SearchResult, task: str) -> str:
    """Return what was found as one sentence."""
    went = plain_evaluation(found.outcome)
    value = "no finite number" if went["return"] is None else f"{went['return']:.4g}"
    how = "failed" if went["failed"] else "success" if went["success"] else "no success"
    stopped = "; stopped early" if found.interrupted else ""
    missed = f"; do not trust it: {found.kept['missed']}" if found.kept.get("missed") else ""
    return f"{task}: return {value} after {found.episodes} episodes, {how}{stopped}{missed}"


def result_json(found: SearchResult, problem: Problem, settings: SearchSettings) -> str:
    """Return what was found as JSON; `seconds` alone differs between equal searches."""
    content = {
        "generator": "torchdlo optimize",
        "task": problem.name,
        **plain_evaluation(found.outcome),
        "search_return": _finite(found.search_return),
        "missed": found.kept.get("missed", ""),
        "max_return": _finite(found.max_return),
        "episodes_to_success": next((p["episodes"] for p in found.curve if p["success"] > 0), None),
        "episodes": found.episodes,
        "seconds": round(found.seconds, 3),
        "interrupted": found.interrupted,
        "settings": asdict(settings) | problem.choices,
        "versions": code_versions(),
        "program": program_hash(problem.name),
        "curve": [{k: _finite(v) for k, v in point.items()} for point in found.curve],
    }
    return json.dumps(content, indent=1, allow_nan=False) + "\n"


def _finite(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def trajectory_json(found: SearchResult, problem: Problem) -> str:
    """Return the best trajectory as JSON. Numbers are written so that every bit of them comes back."""
    content = {
        "generator": "torchdlo optimize",
        "task": problem.name,
        "choices": problem.choices,
        **plain_evaluation(found.outcome),
        "actions": found.actions.tolist(),
        **found.kept,
    }
    return json.dumps(content, allow_nan=False) + "\n"


def execution_of(choices: Entry) -> Execution:
    """Return how steps of a search ran; files of 0.1 say it by two flags."""
    if "execution" in choices:
        said = choices["execution"]
        found = execution_named(said.value)
        if found is None:
            raise said.wrong(f"one of {', '.join(EXECUTIONS)}")
        return found
    if choices["compiled"].flag():
        return "compiled"
    return "recorded" if choices.get("recorded", False).flag() else "eager"


def read_trajectory(path: Path) -> Entry:
    """Return what a trajectory file says; its entries are checked where they are asked for."""
    found = read_entry(path, "a trajectory of torchdlo optimize")
    found["task"].text(most=1000)
    return found


def check_scene(path: Path) -> None:
    """Refuse a trajectory that was found in another scene than its task's own, where that one is to be played."""
    choices = read_trajectory(path).get("choices", {})
    other = [name for name in ("grasps", "rope", "part") if choices.get(name).value is not None]
    if other:
        said = {"grasps": "other grasps", "rope": "another rope", "part": "what another trajectory left"}
        raise InputError(
            f"{path}: it was found with {' and '.join(said[name] for name in other)}, and here is the task as it is; "
            "give one that was searched in that."
        )


def load_actions(path: Path, problem: Problem) -> Tensor:
    """Return the actions of a trajectory file, shape (T, A); they fit the problem."""
    content = read_trajectory(path)
    task = content["task"].text()
    actions = torch.tensor(content["actions"].numbers(None, None, most=_LARGEST), dtype=torch.float64)
    if task != problem.name or actions.shape != (problem.horizon, problem.width):
        raise InputError(
            f"{path}: expected {problem.horizon} actions of {problem.width} numbers for {problem.name}, found "
            f"{tuple(actions.shape)} for {one_line(task, 60)}; give the trajectory of this task."
        )
    return actions
