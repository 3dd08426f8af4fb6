"""Training the chunk policy from an exported data set, through its own reader."""

from __future__ import annotations

import copy
import math
import shutil
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchdlo.agents.data.reading import DataSet, open_set
from torchdlo.agents.policies import language
from torchdlo.agents.policies.chunk_policy import ChunkPolicy, NetworkShape, save_policy
from torchdlo.agents.torch_records import load_checkpoint, save_checkpoint
from torchdlo.agents.trajopt.search_journal import code_versions
from torchdlo.errors import InputError
from torchdlo.journal import locked, sweep

__all__ = ["Training", "train_chunk_policy"]

IMAGES = "observation.images."
LEAST = 1e-3
"""Least scale of states and targets: what hardly varies is not blown up."""
TELL = 10
"""Steps after which the loss is told again."""
FINEST = 0.02
"""Least spread of targets of a task by which its errors are measured [m]."""


@dataclass(frozen=True)
class Training:
    """How to train."""

    epochs: int = 40
    batch: int = 64
    rate: float = 1e-3
    """Largest learning rate."""
    decay: float = 1e-2
    """Weight decay."""
    average: float = 0.995
    """How much of the averaged weights a step keeps; these are what is saved."""
    chunk: int = 20
    """Actions that the policy looks ahead."""
    width: int = 128
    """Numbers of a token of the network."""
    proprioception: bool = False
    """Whether it is told where its arms are, see `chunk_policy`."""
    recolor: float = 0.2
    """Most that each of the colours of a picture is made lighter or darker [1]."""
    seed: int = 0
    device: str = "cpu"
    language: str = "auto"
    """"minilm", "hashed", or the better one that is installed."""

    def __post_init__(self) -> None:
        if min(self.epochs, self.batch, self.chunk) < 1 or not 0 < self.rate < 1:
            raise InputError(
                "training: epochs, batch and chunk are 1 or more, and the learning rate is between 0 and 1."
            )


@dataclass(frozen=True, eq=False)
class _Frames:
    """A set in memory, its pictures in a file that is mapped."""

    state: Tensor
    target: Tensor
    """Shape (N, 3 R)."""
    first: Tensor
    """Number of the first frame of each frame's episode, shape (N,)."""
    last: Tensor
    """Number of the last one, shape (N,)."""
    sentence: Tensor
    """Vectors of the instructions, shape (tasks, 384)."""
    told: Tensor
    """Instruction of each frame, shape (N,)."""
    weight: Tensor
    """Spread of all targets over that of the frame's task, shape (N, 3 R): errors count by what is much in a task."""
    pictures: dict[str, np.ndarray] | dict[str, Tensor]
    """Shape (N, 3, H, W), 8 bits."""

    def batch(self, at: Tensor, chunk: int) -> tuple[dict[str, Tensor], Tensor, Tensor, Tensor, Tensor]:
        """Return pictures, states, sentences, targets, and weights of their errors; after the end tools stay."""
        device = self.target.device
        here = at.to(device)
        ahead = torch.minimum(here[:, None] + torch.arange(chunk, device=device), self.last[here][:, None])
        shots = {
            name: x[here] if isinstance(x, Tensor) else torch.from_numpy(x[at.numpy()]).to(device)
            for name, x in self.pictures.items()
        }
        return shots, self.state[here], self.sentence[self.told[here]], self.target[ahead], self.weight[here]

    def on(self, device: torch.device, room: int) -> _Frames:
        """Return them on a device, with the pictures if they take no more than `room` there [bytes]."""
        names = [each.name for each in fields(self) if each.name != "pictures"]
        moved = {name: getattr(self, name).to(device) for name in names}
        fits = sum(x.nbytes for x in self.pictures.values()) <= room
        pictures = {name: torch.as_tensor(x).to(device) for name, x in self.pictures.items()} if fits else self.pictures
        return _Frames(**moved, pictures=pictures)


def _read(data: DataSet, encoder: str, folder: Path, callback: Callable[[str, int, int, str], None]) -> _Frames:
    if not data.cameras:
        raise InputError(f"{data.path}: has no pictures; the policy learns from what it sees.")
    columns, count = data.columns(), data.info["total_frames"]
    missing = {"observation.state", "torchdlo.target"} - columns.keys()
    if missing:
        raise InputError(
            f"{data.path}: has no column {', '.join(sorted(missing))}; make it with torchdlo dataset make."
        )
    first, last = np.zeros((2, count), np.int64)
    pictures: dict[str, np.ndarray] = {}
    for camera in data.cameras:
        height, width, _ = data.features[camera]["shape"]
        file = folder / f"{camera}.u8"
        pictures[camera.removeprefix(IMAGES)] = np.memmap(file, np.uint8, "w+", shape=(count, 3, height, width))
    for k, row in enumerate(data.episodes):
        start, end = row["dataset_from_index"], row["dataset_to_index"]
        first[start:end], last[start:end] = start, end - 1
        for camera in data.cameras:
            shots = np.stack(list(data.pictures(k, camera)))
            pictures[camera.removeprefix(IMAGES)][start:end] = shots.transpose(0, 3, 1, 2)
        callback("read", k + 1, len(data.episodes), "")
    target = columns["torchdlo.target"].reshape(count, -1, 7)[..., :3].reshape(count, -1)
    targets = torch.from_numpy(np.ascontiguousarray(target))
    return _Frames(
        torch.from_numpy(columns["observation.state"].copy()),
        targets,
        torch.from_numpy(first),
        torch.from_numpy(last),
        language.encode_sentences(data.tasks, encoder),
        torch.from_numpy(columns["task_index"].copy()),
        _weights(data, targets),
        pictures,
    )


def _weights(data: DataSet, target: Tensor) -> Tensor:
    """Return the spread of all targets over that within each frame's task, 1 for arms that are not there."""
    about = data.provenance.get("episodes") or [{}] * len(data.episodes)
    rows: dict[str, list[Tensor]] = {}
    for row, own in zip(data.episodes, about, strict=True):
        at = torch.arange(row["dataset_from_index"], row["dataset_to_index"])
        rows.setdefault(own.get("task") or row["tasks"][0], []).append(at)
    found = torch.ones_like(target)
    for parts in rows.values():
        at = torch.cat(parts)
        spread = target[at].std(0, correction=0)
        share = target.std(0, correction=0) / spread.clamp(min=FINEST)
        found[at] = torch.where(spread < LEAST, 1.0, share.clamp(min=1.0))
    return found


def train_chunk_policy(
    path: Path,
    out: Path,
    training: Training | None = None,
    *,
    resume: bool = False,
    callback: Callable[[str, int, int, str], None] | None = None,
) -> dict[str, Any]:
    """Train a policy and write it to a file after every epoch; return how it went.

    Args:
        path: a data set of `torchdlo dataset make`.
        out: the policy's file; a checkpoint lies beside it until training is over.
        training: how to train.
        resume: go on from the checkpoint; with the same number of threads the policy comes out the same.
        callback: told (stage, done, in all, message); may raise KeyboardInterrupt.
    """
    training, told = training or Training(), callback or (lambda *_: None)
    data = open_set(path)
    encoder = language.default_encoder() if training.language == "auto" else training.language
    checkpoint = out.with_name(f"{out.stem}.checkpoint.pt")
    if resume and not checkpoint.is_file():
        raise InputError(f"{checkpoint}: there is no checkpoint to resume; leave out --resume.")
    begun = time.monotonic()
    with (
        locked(out.parent, f".{out.name}.lock"),
        tempfile.TemporaryDirectory(prefix=_swept(out), dir=out.parent) as folder,
    ):
        frames = _read(data, encoder, Path(folder), told)
        if (device := torch.device(training.device)).type == "cuda":
            frames = frames.on(device, torch.cuda.mem_get_info(device)[0] // 2)
        run = _Run(data, frames, training, encoder)
        if resume:
            run.load(checkpoint)
        while run.epoch < training.epochs:
            run.train(told)
            run.save(checkpoint)
            save_policy(out, run.averaged, run.about())
    checkpoint.unlink(missing_ok=True)
    return run.about() | {"seconds": round(time.monotonic() - begun, 1)}


def _swept(out: Path) -> str:
    """Remove what a run that was killed left half done; return how the name of the folder of pictures begins."""
    prefix = f".frames-{out.stem}-"
    for left in out.parent.glob(f"{prefix}*"):
        shutil.rmtree(left, ignore_errors=True)
    sweep(out.parent, out.name, f"{out.stem}.checkpoint.pt")
    return prefix


class _Run:
    """A training under way."""

    def __init__(self, data: DataSet, frames: _Frames, training: Training, encoder: str) -> None:
        self.data, self.frames, self.training, self.encoder = data, frames, training, encoder
        cameras = tuple(frames.pictures)
        shape = NetworkShape(
            arms=frames.target.shape[1] // 3,
            cameras=cameras,
            size=frames.pictures[cameras[0]].shape[-1],
            state=frames.state.shape[1] if training.proprioception else 0,
            chunk=training.chunk,
            width=training.width,
        )
        with torch.random.fork_rng(devices=()):
            torch.manual_seed(training.seed)
            self.policy = ChunkPolicy(shape).to(training.device)
        kept = {"target": frames.target} | ({"state": frames.state} if training.proprioception else {})
        for name, x in kept.items():
            getattr(self.policy, f"{name}_mean").copy_(x.mean(0))
            getattr(self.policy, f"{name}_std").copy_(x.std(0, correction=0).clamp(min=LEAST))
        self.averaged = copy.deepcopy(self.policy).eval()
        fused = torch.device(training.device).type == "cuda"
        self.optimizer = torch.optim.AdamW(
            self.policy.parameters(), training.rate, weight_decay=training.decay, fused=fused
        )
        self.epoch, self.curve = 0, list[float]()
        # An epoch has every episode as often as every other, short ones as long ones.
        longest = int((frames.last - frames.first).max()) + 1
        self.seen = longest * len(data.episodes)
        self.steps = -(-self.seen // training.batch)

    def train(self, told: Callable[[str, int, int, str], None]) -> None:
        """Go once through all episodes, in an order that the number of the epoch decides."""
        generator = torch.Generator().manual_seed(self.training.seed * 100_003 + self.epoch)
        order = self._order(generator)
        all_steps, said = self.steps * self.training.epochs, ""
        total = torch.zeros((), dtype=torch.float64, device=self.training.device)
        self.policy.train()
        for k, at in enumerate(order.split(self.training.batch)):
            done = self.epoch * self.steps + k
            for group in self.optimizer.param_groups:
                group["lr"] = self.training.rate * _schedule(done, all_steps)
            shots, state, sentence, target, weight = self.frames.batch(at, self.training.chunk)
            shots = {name: _recolored(x, self.training.recolor, generator) for name, x in shots.items()}
            wanted = (target - self.policy.target_mean) / self.policy.target_std
            loss = ((self.policy.scaled(shots, state, sentence) - wanted).abs() * weight[:, None]).mean()
            self.optimizer.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(self.policy.parameters(), 1.0)
            self.optimizer.step()
            self._average(min(self.training.average, (1 + done) / (10 + done)))
            total += loss.detach().double() * len(at)
            if k % TELL == 0:  # to read the loss waits for the device
                said = f"loss {float(total) / (len(at) * (k + 1)):.4f}"
            told("learn", done + 1, all_steps, said)
        self.epoch += 1
        self.curve.append(float(total) / len(order))

    def _order(self, generator: torch.Generator) -> Tensor:
        """Return the frames of an epoch: all of the longest episodes, those of shorter ones several times."""
        frames, found = self.frames, []
        longest = self.seen // len(self.data.episodes)
        for first in frames.first.unique().tolist():
            length = int(frames.last[first]) - first + 1
            rounds = [torch.randperm(length, generator=generator) for _ in range(-(-longest // length))]
            found.append(first + torch.cat(rounds)[:longest])
        order = torch.cat(found)
        return order[torch.randperm(len(order), generator=generator)]

    def _average(self, keep: float) -> None:
        with torch.no_grad():
            for mean, own in zip(self.averaged.parameters(), self.policy.parameters(), strict=True):
                mean.lerp_(own, 1 - keep)

    def about(self) -> dict[str, Any]:
        """Return what is to be known of the policy."""
        rows = self.data.provenance.get("episodes") or []
        return {
            "tasks": sorted({row["task"] for row in rows if row.get("task")}),
            "sentences": list(self.data.tasks),
            "language": self.encoder,
            "dataset": self.data.path.resolve().name,
            "episodes": len(self.data.episodes),
            "frames": len(self.frames.state),
            "parameters": sum(p.numel() for p in self.policy.parameters()),
            "training": asdict(self.training),
            "epochs": self.epoch,
            "loss": [round(x, 6) for x in self.curve],
            "versions": {name: str(value) for name, value in code_versions().items()},
        }

    def _same(self) -> dict[str, Any]:
        return {"training": asdict(self.training), "frames": len(self.frames.state), "language": self.encoder}

    def save(self, path: Path) -> None:
        """Write all that is needed to go on."""
        content = {
            "same": self._same(),
            "epoch": self.epoch,
            "curve": self.curve,
            "policy": self.policy.state_dict(),
            "averaged": self.averaged.state_dict(),
            "optimizer": self.optimizer.state_dict(),
        }
        save_checkpoint(path, content)

    def load(self, path: Path) -> None:
        """Go on from a checkpoint."""
        content = load_checkpoint(path)
        if content is None:
            raise InputError(f"{path}: the checkpoint is damaged; leave out --resume.")
        if content["same"] != self._same():
            raise InputError(f"{path}: it is of another data set or training; give the same, or leave out --resume.")
        self.epoch, self.curve = content["epoch"], content["curve"]
        for name in ("policy", "averaged", "optimizer"):
            getattr(self, name).load_state_dict(content[name])


def _recolored(pictures: Tensor, most: float, generator: torch.Generator) -> Tensor:
    """Return pictures (B, 3, H, W) with other colours and brightness; what is black stays black."""
    if not most:
        return pictures
    factor = 1 + most * (2 * torch.rand(len(pictures), 3, 1, 1, generator=generator) - 1)
    return (pictures * factor.to(pictures.device)).clamp(max=255)


def _schedule(done: int, total: int) -> float:
    """Return the share of the learning rate: up within a twentieth of the steps, then down as a cosine."""
    rise = max(1, total // 20)
    return min((done + 1) / rise, 0.5 * (1 + math.cos(math.pi * done / total)) + 0.01)
