"""The loop around all trainers: budget, seeds, logs, checkpoints that a killed run goes on from bit by bit.

A checkpoint is written between batches of episodes: policy, critics, optimisers, normaliser, memory, both generators of
random numbers, the best policy so far and the log.
"""

from __future__ import annotations

import copy
import json
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Protocol

import torch
from torch.utils import _pytree as pytree

from torchdlo.agents.policies import Policy, load_policy, save_policy
from torchdlo.agents.policies.policy_files import is_finite
from torchdlo.agents.rl.episodes import Episodes
from torchdlo.agents.rl.rollout import Batch
from torchdlo.agents.rl.settings import TrainingSettings, changed
from torchdlo.agents.torch_records import load_checkpoint, save_checkpoint
from torchdlo.errors import InputError
from torchdlo.files import write_atomically

__all__ = ["Trained", "Trainer", "train"]

Callback = Callable[[str, int, int, str], None]
_CHECKPOINT = "checkpoint.pt"


class Trainer(Protocol):
    """An algorithm."""

    policy: Policy
    played: dict[str, torch.Tensor] | None
    """Numbers of the policy that began to play the last batch, with the normaliser that it saw through; None if random
    actions played it."""

    def iterate(self, episodes: Episodes) -> tuple[Batch, dict[str, float]]:
        """Play one batch of episodes and learn."""

    def parts(self) -> dict[str, Any]:
        """Return what has a `state_dict` and belongs into checkpoints."""


@dataclass(eq=False)
class Trained:
    """What training came to, so far."""

    policy: Policy
    """The best one by what its batch earned, success first."""
    best: tuple[float, float]
    """Share of successes and mean return of that batch; negative infinity if no policy has played one."""
    episodes: int = 0
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    """Of this process; what others play for it is not in."""
    rows: list[dict[str, Any]] = field(default_factory=list)
    """One entry per batch: episodes, seconds, return, success, failed, and what the algorithm says."""
    interrupted: bool = False


def train(
    trainer: Trainer,
    episodes: Episodes,
    settings: TrainingSettings,
    *,
    folder: Path | None = None,
    resume: bool = False,
    callback: Callback | None = None,
    stage: str = "train",
    notes: dict[str, Any] | None = None,
) -> Trained:
    """Train until the budget of episodes or of minutes is used up.

    A `KeyboardInterrupt` that `callback` raises ends it and keeps the best so far. All random numbers are those of
    torch's generator, which belongs to the run as long as it lasts and is given back as it was.

    Args:
        trainer: the algorithm with its policy.
        episodes: what it plays.
        settings: budget, seed and interval of checkpoints.
        folder: gets policy.pt (the best), checkpoint.pt, log.csv and, if there is the package, TensorBoard's files.
        resume: go on from the checkpoint.
        callback: told (stage, episodes done, all episodes, message) after every batch.
        stage: what to call it.
        notes: plain data to keep in policy.pt.
    """
    with torch.random.fork_rng(devices=gpus(usable_device(settings))):
        torch.manual_seed(settings.seed)
        done = Trained(copy.deepcopy(trainer.policy), (-math.inf, -math.inf))
        if resume:
            _restore(trainer, episodes, settings, done, folder)
        try:
            _loop(trainer, episodes, settings, done, folder, callback or (lambda *_: None), stage, notes or {})
        except KeyboardInterrupt:
            done.interrupted = True
        astray = not is_finite(trainer.policy)
        if not math.isfinite(done.best[1]) and not astray:
            # No policy has played a batch yet: the present one is as good as any.
            done.policy.load_state_dict(trainer.policy.state_dict())
        if folder is not None:
            if astray:
                _write_best(done, folder, notes or {})
            else:
                _write(trainer, episodes, settings, done, folder, notes or {})
    if astray:
        kept = "" if folder is None else f" {folder / 'policy.pt'} holds the best one until then."
        raise InputError(
            f"rate is {settings.rate:g}: weights of the policy are no longer finite after {done.episodes} episodes; "
            f"take smaller steps.{kept}"
        )
    return done


def usable_device(settings: TrainingSettings) -> torch.device:
    """Return where to train; refuse a GPU that is not there."""
    device = torch.device(settings.device)
    if device.type == "cuda" and not torch.cuda.is_available():
        raise InputError("device is 'cuda', but torch sees no GPU here; leave it out, or see `torchdlo doctor`.")
    return device


def gpus(device: torch.device) -> list[torch.device]:
    """Return the devices beside the CPU whose random numbers a run uses."""
    return [device] if device.type == "cuda" else []


def _loop(
    trainer: Trainer,
    episodes: Episodes,
    settings: TrainingSettings,
    done: Trained,
    folder: Path | None,
    callback: Callback,
    stage: str,
    notes: dict[str, Any],
) -> None:
    writer = _writer(folder)
    last = time.monotonic()
    while done.episodes + episodes.count <= settings.episodes and done.seconds < 60 * settings.minutes:
        began, busy = time.monotonic(), time.process_time()
        batch, told = trainer.iterate(episodes)
        done.episodes += episodes.count
        done.seconds += time.monotonic() - began
        done.cpu_seconds += time.process_time() - busy
        row = _row(done, episodes, batch) | told
        done.rows.append(row)
        mark = (row["success"], row["return"])
        # What is judged is the policy that played, not the one that has learned from it. Of algorithms that learn while
        # they play, it is the one that began.
        if trainer.played is not None and mark > done.best:
            done.best = mark
            done.policy.load_state_dict(trainer.played)
        if writer is not None:
            for name, value in row.items():
                writer.add_scalar(f"{stage}/{name}", value, done.episodes)
        if not is_finite(trainer.policy):
            break
        if folder is not None and time.monotonic() - last > settings.interval:
            _write(trainer, episodes, settings, done, folder, notes)
            last = time.monotonic()
        callback(stage, done.episodes, settings.episodes, _said(done, settings))
    if writer is not None:
        writer.close()


def _said(done: Trained, settings: TrainingSettings) -> str:
    row = done.rows[-1]
    share = max(done.episodes / settings.episodes, done.seconds / (60 * settings.minutes))
    left = done.seconds * (1 / share - 1) if share > 0 else math.inf
    return f"return {row['return']:.4g}, success {row['success']:.0%}, {max(0.0, left) / 60:.0f} min left"


def _row(done: Trained, episodes: Episodes, batch: Batch) -> dict[str, Any]:
    returns = getattr(episodes, "returns", None)
    plain = batch.reward.sum(0) if returns is None else returns
    return {
        "episodes": done.episodes,
        "seconds": round(done.seconds, 3),
        "return": float(plain.mean()),
        "success": float(batch.success.float().mean()),
        "failed": float(batch.failed[-1].float().mean()),
    }


def _writer(folder: Path | None) -> Any:
    if folder is None:
        return None
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        return None
    return SummaryWriter(str(folder / "tensorboard"))


def log_csv(rows: list[dict[str, Any]]) -> str:
    """Return a log as text with commas; what an entry does not have is empty."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    lines = [",".join(str(row.get(name, "")) for name in names) for row in rows]
    return "\n".join([",".join(names), *lines]) + "\n"


def _write(
    trainer: Trainer, episodes: Episodes, settings: TrainingSettings, done: Trained, folder: Path, notes: dict[str, Any]
) -> None:
    content = {
        "generator": "torchdlo train",
        "settings": json.dumps(asdict(settings), sort_keys=True),
        "policy": json.dumps(trainer.policy.spec.plain(), sort_keys=True),
        "parts": {name: part.state_dict() for name, part in trainer.parts().items()},
        "torch": torch.get_rng_state(),
        "cuda": [torch.cuda.get_rng_state(device) for device in gpus(torch.device(settings.device))],
        "starts": episodes.generator.get_state(),
        "best": {"policy": done.policy.state_dict(), "mark": done.best},
        "episodes": done.episodes,
        "seconds": done.seconds,
        "cpu_seconds": done.cpu_seconds,
        "rows": done.rows,
    }
    # Files of a GPU's run are read where there is none.
    save_checkpoint(folder / _CHECKPOINT, pytree.tree_map_only(torch.Tensor, torch.Tensor.cpu, content))
    _write_best(done, folder, notes)


def _write_best(done: Trained, folder: Path, notes: dict[str, Any]) -> None:
    write_atomically(folder / "log.csv", log_csv(done.rows))
    save_policy(
        done.policy, folder / "policy.pt", notes | {"episodes": done.episodes, "seconds": round(done.seconds, 1)}
    )


def _check_policy(policy: Policy, content: dict[str, Any], path: Path) -> None:
    """Refuse a checkpoint of another task, or of a policy that sees or does something else."""
    kept = path.with_name("policy.pt")
    if "policy" in content:
        was = json.loads(content["policy"])
    elif kept.is_file():  # checkpoints did not say before
        was = json.loads(json.dumps(load_policy(kept).spec.plain()))
    else:
        return
    now = json.loads(json.dumps(policy.spec.plain()))
    # Places are found by simulation, and so to rounding; their number is that of the points.
    for spec in (was, now):
        spec["features"].pop("centers", None)
    if was["task"] != now["task"]:
        said = f"the task {was['task']} (now {now['task']})"
    elif other := [name for name in now if was.get(name, now[name]) != now[name]]:
        said = f"a policy of other {', '.join(other)}"
    else:
        return
    raise InputError(f"{path}: it belongs to a run of {said}; give the same, or leave out --resume.")


def _restore(
    trainer: Trainer, episodes: Episodes, settings: TrainingSettings, done: Trained, folder: Path | None
) -> None:
    path = None if folder is None else folder / _CHECKPOINT
    if path is None or not path.is_file():
        raise InputError(f"{path}: expected the checkpoint of a run to resume, found none; leave out --resume.")
    content = load_checkpoint(path)
    if content is None:
        raise InputError(f"{path}: the checkpoint is damaged; leave out --resume.")
    _check_policy(trainer.policy, content, path)
    first = {"device": "cpu", "barrier": 0.0, "auxiliary": 0.0, "saturation": 0.0}
    was = first | json.loads(content["settings"])  # those of 0.1 did not say
    # How long to go on may change, and a temperature goes on from where it was.
    other = changed(was, asdict(settings), ("episodes", "minutes", "interval", "temperature"))
    if other:
        raise InputError(f"{path}: it belongs to a run with {', '.join(other)}; give the same, or leave out --resume.")
    for name, part in trainer.parts().items():
        part.load_state_dict(content["parts"][name])
    torch.set_rng_state(content["torch"])
    for device, state in zip(gpus(torch.device(settings.device)), content.get("cuda", ()), strict=True):
        torch.cuda.set_rng_state(state, device)
    episodes.generator.set_state(content["starts"])
    done.policy.load_state_dict(content["best"]["policy"])
    done.best = tuple(content["best"]["mark"])
    done.episodes, done.seconds, done.rows = content["episodes"], content["seconds"], content["rows"]
    done.cpu_seconds = content.get("cpu_seconds", 0.0)
