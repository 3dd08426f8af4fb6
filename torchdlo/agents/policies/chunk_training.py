"""Training the chunk policy: from an exported data set, through its own reader, or from scenes drawn anew."""

from __future__ import annotations

import copy
import math
import shutil
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor

from torchdlo.agents.data.reading import open_set
from torchdlo.agents.policies import language
from torchdlo.agents.policies.chunk_frames import Shown, read_frames
from torchdlo.agents.policies.chunk_policy import ChunkPolicy, NetworkShape, load_policy, save_policy
from torchdlo.agents.torch_records import load_checkpoint, save_checkpoint
from torchdlo.agents.trajopt.search_journal import code_versions
from torchdlo.errors import InputError
from torchdlo.journal import locked, sweep

__all__ = ["ChunkRun", "Source", "Training", "chosen_encoder", "run_training", "swept", "train_chunk_policy"]

Callback = Callable[[str, int, int, str], None]
TELL = 10
"""Steps after which the loss is told again."""
LATER = 0.3
"""What a target counts that is not followed before the policy looks again, see `Training.followed`."""


@dataclass(frozen=True)
class Training:
    """How to train."""

    epochs: int = 40
    batch: int = 64
    rate: float = 1e-3
    """Largest learning rate."""
    word_rate: float = 1.0
    """Times by which that of what reads sentences is larger: where sentences differ little, it has far to go."""
    decay: float = 1e-2
    """Weight decay of matrices."""
    average: float = 0.995
    """How much of the averaged weights a step keeps; these are what is saved."""
    chunk: int = 20
    """Actions that the policy looks ahead."""
    followed: int = 0
    """Targets that count in full, the later ones less; 0: all count the same."""
    width: int = 128
    """Numbers of a token of the network."""
    channels: tuple[int, ...] = (32, 64, 96)
    """Of its convolutions."""
    tokens: int = 2
    """Tokens that a picture becomes."""
    layers: int = 2
    """Of the transformer."""
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

    def like(self, shape: NetworkShape) -> Training:
        """Return the same for a network of this shape."""
        kept = {name: getattr(shape, name) for name in ("chunk", "width", "channels", "tokens", "layers")}
        return replace(self, **kept, proprioception=bool(shape.state))


class Source(Protocol):
    """What is learned from."""

    @property
    def seen(self) -> int:
        """Pictures of an epoch."""

    @property
    def arms(self) -> int:
        """Arms of the widest task."""

    @property
    def size(self) -> int:
        """Width of pictures [px]."""

    @property
    def cameras(self) -> tuple[str, ...]:
        """Their names."""

    def statistics(self) -> dict[str, tuple[Tensor, Tensor]]:
        """Return means and deviations of targets, and of states if there are any."""

    def order(self, epoch: int, generator: torch.Generator) -> Tensor:
        """Return the numbers of the pictures of an epoch, shape (seen,)."""

    def batch(self, at: Tensor, chunk: int, generator: torch.Generator) -> Shown:
        """Return pictures with these numbers, and what belongs to them."""

    def judged(self, policy: ChunkPolicy) -> dict[str, Any]:
        """Return how a policy does where it does not learn, as plain data."""

    def about(self) -> dict[str, Any]:
        """Return what is to be known of it, as plain data; what is the same is the same source."""


def chosen_encoder(training: Training) -> str:
    """Return how sentences become vectors."""
    return language.default_encoder() if training.language == "auto" else training.language


def train_chunk_policy(
    path: Path,
    out: Path,
    training: Training | None = None,
    *,
    size: int = 0,
    start: Path | None = None,
    resume: bool = False,
    callback: Callback | None = None,
) -> dict[str, Any]:
    """Train a policy and write it to a file after every epoch; return how it went.

    Args:
        path: a data set of `torchdlo dataset make`.
        out: the policy's file; a checkpoint lies beside it until training is over.
        training: how to train.
        size: width of the pictures that it sees [px]; 0: as the set has them.
        start: a policy of the same network, whose weights to begin with.
        resume: go on from the checkpoint; with the same number of threads the policy comes out the same.
        callback: told (stage, done, in all, message); may raise KeyboardInterrupt.
    """
    training, told = training or Training(), callback or (lambda *_: None)
    data, encoder, begun = open_set(path), chosen_encoder(training), time.monotonic()
    checkpoint = _checkpoint(out, resume)
    with (
        locked(out.parent, f".{out.name}.lock"),
        tempfile.TemporaryDirectory(prefix=swept(out), dir=out.parent) as folder,
    ):
        frames = read_frames(data, encoder, Path(folder), told, size)
        if (device := torch.device(training.device)).type == "cuda":
            frames = frames.on(device, torch.cuda.mem_get_info(device)[0] // 2)
        run = ChunkRun(frames, training, start)
        run_training(run, out, checkpoint if resume else None, told)
    return run.about() | {"seconds": round(time.monotonic() - begun, 1)}


def _checkpoint(out: Path, resume: bool) -> Path:
    checkpoint = out.with_name(f"{out.stem}.checkpoint.pt")
    if resume and not checkpoint.is_file():
        raise InputError(f"{checkpoint}: there is no checkpoint to resume; leave out --resume.")
    return checkpoint


def run_training(run: ChunkRun, out: Path, resumed: Path | None, told: Callback, *, small: bool = False) -> None:
    """Train epoch by epoch, with a policy and a checkpoint written after each; the checkpoint goes at the end.

    Args:
        run: the training.
        out: the policy's file.
        resumed: the checkpoint to go on from.
        told: see `train_chunk_policy`.
        small: see `save_policy`.
    """
    checkpoint = out.with_name(f"{out.stem}.checkpoint.pt")
    if resumed is not None:
        run.load(resumed)
    while run.epoch < run.training.epochs:
        run.train(told)
        run.save(checkpoint)
        save_policy(out, run.averaged, run.about(), small=small)
    checkpoint.unlink(missing_ok=True)


def swept(out: Path) -> str:
    """Remove what a run that was killed left half done; return how the name of the folder of pictures begins."""
    prefix = f".frames-{out.stem}-"
    for left in out.parent.glob(f"{prefix}*"):
        shutil.rmtree(left, ignore_errors=True)
    sweep(out.parent, out.name, f"{out.stem}.checkpoint.pt")
    return prefix


class ChunkRun:
    """A training under way."""

    def __init__(self, source: Source, training: Training, start: Path | None = None) -> None:
        """Make a network, with weights drawn from the seed or those of a policy."""
        self.source, self.training = source, training
        kept = source.statistics()
        shape = NetworkShape(
            arms=source.arms,
            cameras=source.cameras,
            size=source.size,
            state=len(kept["state"][0]) if training.proprioception else 0,
            chunk=training.chunk,
            width=training.width,
            channels=training.channels,
            tokens=training.tokens,
            layers=training.layers,
        )
        with torch.random.fork_rng(devices=()):
            torch.manual_seed(training.seed)
            self.policy = ChunkPolicy(shape)
        for name in ("target", "state") if training.proprioception else ("target",):
            getattr(self.policy, f"{name}_mean").copy_(kept[name][0])
            getattr(self.policy, f"{name}_std").copy_(kept[name][1])
        if start is not None:
            self._begin_with(start)
        self.policy.to(training.device)
        self.averaged = copy.deepcopy(self.policy).eval()
        self.optimizer = _optimizer(self.policy, training)
        near = torch.ones(training.chunk)
        near[training.followed or training.chunk :] = LATER
        self.near = (near / near.mean())[:, None].to(training.device)
        self.epoch, self.curve, self.judged = 0, list[float](), list[dict[str, Any]]()
        self.steps = -(-source.seen // training.batch)

    def _begin_with(self, start: Path) -> None:
        policy, _ = load_policy(start)
        if policy.shape != self.policy.shape:
            there, here = asdict(policy.shape), asdict(self.policy.shape)
            other = [f"{k} {v} (now {here[k]})" for k, v in there.items() if v != here[k]]
            raise InputError(f"{start}: its network has {', '.join(other)}; begin with one that is alike.")
        self.policy.load_state_dict(policy.state_dict())

    def train(self, told: Callback) -> None:
        """Go once through all pictures of an epoch, in an order that its number decides."""
        generator = torch.Generator().manual_seed(self.training.seed * 100_003 + self.epoch)
        order = self.source.order(self.epoch, generator)
        all_steps, said = self.steps * self.training.epochs, ""
        total = torch.zeros((), dtype=torch.float64, device=self.training.device)
        self.policy.train()
        for k, at in enumerate(order.split(self.training.batch)):
            done = self.epoch * self.steps + k
            loss = self.step(self.source.batch(at, self.training.chunk, generator), done, generator)
            total += loss.double() * len(at)
            if k % TELL == 0:  # to read the loss waits for the device
                said = f"loss {float(total) / (len(at) * (k + 1)):.4f}"
            told("learn", done + 1, all_steps, said)
        self.epoch += 1
        self.curve.append(float(total) / len(order))
        self.judged.append(self.source.judged(self.averaged))

    def step(self, shown: Shown, done: int, generator: torch.Generator) -> Tensor:
        """Learn from a batch after so many others, and return the loss."""
        share = _schedule(done, self.steps * self.training.epochs)
        for group in self.optimizer.param_groups:
            group["lr"] = self.training.rate * group["times"] * share
        shots = {name: _recolored(x, self.training.recolor, generator) for name, x in shown.shots.items()}
        wanted = (shown.target - self.policy.target_mean) / self.policy.target_std
        weight = torch.where(shown.scale > 0, self.policy.target_std / shown.scale, 1.0)
        off = (self.policy.scaled(shots, shown.state, shown.sentence) - wanted).abs()
        loss = (off * weight[:, None] * self.near).mean()
        self.optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.policy.parameters(), 1.0)
        self.optimizer.step()
        keep = min(self.training.average, (1 + done) / (10 + done))
        with torch.no_grad():
            for mean, own in zip(self.averaged.parameters(), self.policy.parameters(), strict=True):
                mean.lerp_(own, 1 - keep)
        return loss.detach()

    def about(self) -> dict[str, Any]:
        """Return what is to be known of the policy."""
        judged = {"held_out": self.judged} if any(self.judged) else {}
        return self.source.about() | {
            "parameters": sum(p.numel() for p in self.policy.parameters()),
            "training": asdict(self.training),
            "epochs": self.epoch,
            "loss": [round(x, 6) for x in self.curve],
            **judged,
            "versions": {name: str(value) for name, value in code_versions().items()},
        }

    def _same(self) -> dict[str, Any]:
        return {"training": asdict(self.training), "source": self.source.about()}

    def save(self, path: Path) -> None:
        """Write all that is needed to go on."""
        content = {
            "same": self._same(),
            "epoch": self.epoch,
            "curve": self.curve,
            "judged": self.judged,
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
        self.epoch, self.curve, self.judged = content["epoch"], content["curve"], content["judged"]
        for name in ("policy", "averaged", "optimizer"):
            getattr(self, name).load_state_dict(content[name])


def _optimizer(policy: ChunkPolicy, training: Training) -> torch.optim.AdamW:
    """Return what moves the weights: only matrices decay, and what reads sentences may go faster."""
    groups: dict[tuple[bool, bool], list[Tensor]] = {}
    for name, x in policy.named_parameters():
        reads = name.startswith("sentence.") or ".films." in name
        groups.setdefault((reads, x.dim() > 1), []).append(x)
    rows = [
        {
            "params": own,
            "weight_decay": training.decay * matrix,
            "times": training.word_rate if reads else 1.0,
        }
        for (reads, matrix), own in groups.items()
    ]
    fused = torch.device(training.device).type == "cuda"
    return torch.optim.AdamW(rows, training.rate, betas=(0.9, 0.98), fused=fused)


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
