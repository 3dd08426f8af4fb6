"""Training by name: from a task and an algorithm to what a run is made of, and the results as plain data."""

from __future__ import annotations

import functools
import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from torchdlo.agents.policies import Policy, load_policy
from torchdlo.agents.rl.episodes import Episodes, TaskEpisodes
from torchdlo.agents.rl.hybrid_stages import task_policy
from torchdlo.agents.rl.settings import TrainingSettings
from torchdlo.agents.rl.training import Trained, Trainer, gpus, usable_device
from torchdlo.envs import Task, with_fidelity
from torchdlo.errors import InputError
from torchdlo.physics.execution import Execution

__all__ = ["evaluation_summary", "load_policies", "prepare_training", "train_json", "train_result"]


def prepare_training(
    task: Task, settings: TrainingSettings, *, execution: Execution | None = None, address: str | None = None
) -> tuple[Trainer, Episodes]:
    """Return the trainer with a new policy, and its episodes, for an algorithm without stages.

    Args:
        task: the task.
        settings: how to train.
        execution: see `TaskEpisodes`.
        address: of a Ray cluster whose processes play, see `executors.make_executor`.
    """
    from torchdlo.agents.rl.ppo import Ppo
    from torchdlo.agents.rl.sac import Sac
    from torchdlo.agents.rl.shac import Sapo, Shac

    kinds = {"ppo": Ppo, "sac": Sac, "shac": Shac, "sapo": Sapo}
    if settings.algorithm not in kinds:
        raise InputError(f"algorithm is {settings.algorithm!r}; expected one of {', '.join(kinds)}.")
    task = with_fidelity(task, settings.fidelity)
    device = usable_device(settings)
    with torch.random.fork_rng(devices=gpus(device)):
        torch.manual_seed(settings.seed)
        soft = settings.algorithm in ("sac", "sapo")
        policy = task_policy(task, settings, state_sigma=soft, squash=settings.algorithm != "ppo").to(device)
        with device:  # critics and losses are made there
            trainer = kinds[settings.algorithm](policy, settings)
    make = functools.partial(
        TaskEpisodes,
        task,
        seed=settings.seed,
        variation=settings.variation,
        gradients=settings.algorithm in ("shac", "sapo"),
        execution=execution,
        ends=settings.ends,
        scale=_scale(task),
        bonus=settings.bonus,
        barrier=settings.barrier,
        auxiliary=settings.auxiliary,
        device=device,
    )
    if not settings.collectors:
        return trainer, make(settings.count)
    from torchdlo.agents.rl.collectors import RayEpisodes

    size = {"count": settings.count, "horizon": task.horizon, "workers": settings.collectors}
    return trainer, RayEpisodes(make, trainer.policy, **size, address=address or "auto")


_RETURNS = {
    "coiling": 12.0,
    "gathering": 50.0,
    "letter_art": 170.0,
    "lifting": 300.0,
    "separation": 100.0,
    "slingshot": 12.0,
    "unknotting": 50.0,
    "wiring_post": 60.0,
    "wiring_ring": 200.0,
    "wrapping": 160.0,
}
"""Orders of the returns of successful episodes; rewards are scaled so that they would be 10."""


def _scale(task: Task) -> float:
    return 10.0 / _RETURNS.get(task.name, 10.0)


def train_result(task: Task, settings: TrainingSettings, found: Trained) -> dict[str, Any]:
    """Return what training came to as plain data."""
    return {
        "generator": "torchdlo train",
        "task": task.name,
        "algorithm": settings.algorithm,
        "fidelity": with_fidelity(task, settings.fidelity).fidelity.text,
        "episodes": found.episodes,
        "seconds": round(found.seconds, 1),
        "cpu_seconds": round(found.cpu_seconds, 1),
        "best_batch": {"success": found.best[0], "return": found.best[1]} if math.isfinite(found.best[1]) else None,
        "interrupted": found.interrupted,
        "settings": asdict(settings),
        "torch": torch.__version__,
        "device": device_name(torch.device(settings.device)),
        "curve": found.rows,
    }


def train_json(result: dict[str, Any]) -> str:
    """Return what training came to as JSON."""
    return json.dumps(result, indent=1) + "\n"


def device_name(device: torch.device) -> str:
    """Return what a device is called: "cpu", or the GPU's name."""
    return torch.cuda.get_device_name(device) if device.type == "cuda" else device.type


def load_policies(paths: list[Path]) -> tuple[list[Policy], str]:
    """Return the policies of files or folders, and the name of their one task."""
    found = [load_policy(path) for path in paths]
    names = sorted({policy.spec.task for policy in found})
    if len(names) != 1 or not names[0]:
        raise InputError(f"policies: they are for {', '.join(names) or 'no task'}; expected policies of one task.")
    return found, names[0]


def evaluation_summary(results: dict[str, Any]) -> str:
    """Return an evaluation in one line per protocol."""
    lines = []
    for name in ("one", "varied", "disturbed"):
        if name in results:
            row = results[name]
            low, high = row["interval"]
            lines.append(
                f"{results['task']}, {name}: success {row['success']:.0%} of {row['episodes']} episodes (95 % interval "
                f"{low:.0%} to {high:.0%}), return {row['return']:.4g}, failed {row['failed']:.0%}"
            )
    return "\n".join(lines)
