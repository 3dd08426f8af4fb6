"""Training a policy that sees from scenes whose pictures other processes draw meanwhile, each with a look of its own.

`torchdlo learn` sees a demonstration with the one look that it was recorded with. Here demonstrations are kept as
scenes (`demonstration_scenes`), and every picture has colours, lights and cameras drawn anew. A picture is the same
whoever draws it: a group of them has random numbers of its own, and an epoch learns from the first so many, which it
waits for.
"""

from __future__ import annotations

import functools
import multiprocessing
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from torchdlo.agents.data import sentences
from torchdlo.agents.data.demonstration_scenes import CAMERAS, SceneDemonstrations, load_scenes
from torchdlo.agents.policies import language
from torchdlo.agents.policies.chunk_frames import LEAST, Shown
from torchdlo.agents.policies.chunk_policy import ChunkPolicy, load_policy
from torchdlo.agents.policies.chunk_training import Callback, ChunkRun, Training, chosen_encoder, run_training
from torchdlo.envs import find
from torchdlo.errors import InputError
from torchdlo.journal import locked, sweep

__all__ = ["ScenePictures", "SceneTraining", "train_on_scenes"]

FORGIVES = {"separation": 0.10, "slingshot": 0.03, "coiling_left": 0.05, "coiling_right": 0.05}
"""Distance by which errors of a task are measured [m]; else `USUAL`."""
USUAL = 0.08
GROUP = 6
"""Pictures that are drawn at once, all of one task."""
FOLLOWED = 8
"""Targets that are followed before the policy looks again; by these it is judged."""
JUDGED = 120
"""Pictures of each task that the policy is judged by."""
FIRST = 6
"""First actions of demonstrations of which half of the pictures are where words alone tell what to do."""
SHAKE = 0.01
"""By how much sentences are disturbed [1]."""
AHEAD = 1.25
"""How much faster pictures get ready than epochs go by: the last ones are learned from for a while, too."""


@dataclass(frozen=True)
class SceneTraining:
    """What is drawn and learned from."""

    folder: Path
    """Of the scenes."""
    tasks: tuple[str, ...]
    shares: tuple[float, ...] = ()
    """How often each task is drawn; all as often if not given."""
    fidelity: str = "coarse"
    batches: int = 7
    """Files of each task that are read at most."""
    held_out: int = 6
    """Demonstrations of each task that are not learned from."""
    pictures: int = 150_000
    """In all; each has as many views as cameras."""
    size: int = 96
    """Of the pictures [px]."""
    seen: int = 64_000
    """Pictures of an epoch."""
    workers: int = 1
    """Processes that draw."""
    arms: int = 1
    """Arms for which there is room at least."""

    def __post_init__(self) -> None:
        if self.shares and len(self.shares) != len(self.tasks):
            raise InputError(f"shares: there are {len(self.shares)}; expected one for each of {len(self.tasks)} tasks.")
        if min(self.pictures, self.size, self.seen, self.workers) < 1:
            raise InputError("scenes: pictures, their size, those of an epoch and workers are 1 or more.")

    def demonstrations(self, seed: int) -> list[SceneDemonstrations]:
        """Return the demonstrations of all tasks."""
        load = functools.partial(
            load_scenes,
            self.folder,
            size=self.size,
            batches=self.batches,
            seed=seed,
            held_out=self.held_out,
            fidelity=self.fidelity,
        )
        return [load(name) for name in self.tasks]

    @property
    def groups(self) -> int:
        """Groups of pictures."""
        return -(-self.pictures // GROUP)


@dataclass(frozen=True, eq=False)
class _Album:
    """Pictures in files that are mapped."""

    pictures: np.ndarray
    """Shape (groups, GROUP, C, 3, S, S), 8 bits."""
    labels: np.ndarray
    """Task, demonstration and action of each, shape (groups, GROUP, 3)."""
    done: np.ndarray
    """Whether a group is ready, shape (groups,)."""

    @staticmethod
    def open(folder: Path, about: SceneTraining) -> _Album:
        """Return the album in a folder."""
        parts = []
        for name, kind, shape in (
            ("pictures", np.uint8, (GROUP, len(CAMERAS), 3, about.size, about.size)),
            ("labels", np.int64, (GROUP, 3)),
            ("done", np.uint8, ()),
        ):
            file = folder / name
            parts.append(np.memmap(file, kind, "r+" if file.exists() else "w+", shape=(about.groups, *shape)))
        return _Album(*parts)


def paint_group(tasks: Sequence[SceneDemonstrations], shares: Sequence[float], key: Sequence[int], size: int) -> Any:
    """Return pictures (GROUP, C, 3, S, S) and labels (GROUP, 3) that the key decides."""
    rng = np.random.default_rng(list(key))
    weight = np.array(shares or [1.0] * len(tasks))
    k = int(rng.choice(len(tasks), p=weight / weight.sum()))
    demos, length = tasks[k].target.shape[:2]
    which, when = rng.integers(0, demos - tasks[k].held_out, GROUP), rng.integers(0, length, GROUP)
    if find(tasks[k].name).counterpart:
        when = np.where(rng.random(GROUP) < 0.5, rng.integers(0, min(FIRST, length), GROUP), when)
    drawn = tasks[k].drawn(which, when, rng.integers(0, 1 << 60, GROUP).tolist(), size)
    return drawn, np.stack([np.full(GROUP, k), which, when], 1)


def _paint(folder: Path, about: SceneTraining, seed: int, own: int) -> None:
    """Draw every so many group of an album."""
    parent = os.getppid()
    torch.set_num_threads(1)
    tasks, album = about.demonstrations(seed), _Album.open(folder, about)
    for g in range(own, about.groups, about.workers):
        album.pictures[g], album.labels[g] = paint_group(tasks, about.shares, (seed, g), about.size)
        album.done[g] = 1  # after its pictures
        if os.getppid() != parent:
            return


@contextmanager
def _painters(folder: Path, about: SceneTraining, seed: int) -> Iterator[Sequence[BaseProcess]]:
    """Let processes draw while the block runs."""
    # Forked ones would share a GPU that was begun with.
    context = multiprocessing.get_context("spawn")
    numbers = range(about.workers)
    running = [context.Process(target=_paint, args=(folder, about, seed, w), daemon=True) for w in numbers]
    for process in running:
        process.start()
    try:
        yield running
    finally:
        for process in running:
            process.terminate()
        for process in running:
            process.join()


class ScenePictures:
    """Pictures that are being drawn, and what belongs to them: a `chunk_training.Source`."""

    cameras: tuple[str, ...] = CAMERAS

    def __init__(
        self, tasks: Sequence[SceneDemonstrations], about: SceneTraining, training: Training, album: _Album
    ) -> None:
        """Lay out what is to be said of pictures.

        Args:
            tasks: the demonstrations.
            about: what is drawn.
            training: how to train.
            album: where the pictures get ready.
        """
        self.tasks, self.scenes, self.training, self.album = tasks, about, training, album
        self.seen, self.size, self.arms = (
            about.seen,
            about.size,
            max(about.arms, *(task.target.shape[2] for task in tasks)),
        )
        self.encoder, self.device = chosen_encoder(training), torch.device(training.device)
        self.alive: Callable[[], None] = lambda: None
        longest, chunk = max(task.target.shape[1] for task in tasks), training.chunk
        target = torch.zeros(len(tasks), max(len(t.target) for t in tasks), longest + chunk, self.arms, 3)
        for k, task in enumerate(tasks):
            demos, length, own = task.target.shape[:3]
            target[k, :demos, :length, :own] = torch.from_numpy(task.target)
            target[k, :demos, length:, :own] = torch.from_numpy(task.target[:, -1:])  # after the end tools stay
        self._rows = [
            target[k, : len(t.target), : t.target.shape[1]].flatten(2).flatten(0, 1) for k, t in enumerate(tasks)
        ]
        forgives = torch.tensor([FORGIVES.get(task.name, USUAL) for task in tasks])
        there = torch.stack([(x != 0).any(0) for x in self._rows])
        self.target, self.scale = target.flatten(3).to(self.device), (there * forgives[:, None]).to(self.device)
        self.sentences = self._vectors(sentences.training_instructions)
        self.unknown_sentences = self._vectors(sentences.heldout_instructions)
        self._judged: tuple[Tensor, Tensor] | None = None

    def _vectors(self, of: Callable[[str], Sequence[str]]) -> Tensor:
        """Return vectors of sentences, shape (tasks, n, 384); where there are less than n they come again."""
        said = [language.encode_sentences(of(task.name), self.encoder) for task in self.tasks]
        most = torch.arange(max(map(len, said)))
        return torch.stack([x[most % len(x)] for x in said]).to(self.device)

    def statistics(self) -> dict[str, tuple[Tensor, Tensor]]:
        """Return mean and deviation of targets, all tasks alike."""
        means = torch.stack([x.mean(0) for x in self._rows])
        squares = torch.stack([(x**2).mean(0) for x in self._rows]).mean(0)
        std = (squares - means.mean(0) ** 2).clamp(min=0).sqrt().clamp(min=LEAST)
        return {"target": (means.mean(0), std)}

    def order(self, epoch: int, generator: torch.Generator) -> Tensor:
        """Wait for the pictures of an epoch, and return numbers of some, as often as there are."""
        groups = self.scenes.groups
        until = min(groups, -(-int(AHEAD * groups * (epoch + 1)) // self.training.epochs))
        until = max(1, until)
        while not self.album.done[:until].all():
            self.alive()
            time.sleep(0.1)
        return torch.randint(until * GROUP, (self.seen,), generator=generator)

    def batch(self, at: Tensor, chunk: int, generator: torch.Generator) -> Shown:
        """Return pictures, what was told, and where tools go."""
        pictures, labels = (
            torch.from_numpy(x.reshape(-1, *x.shape[2:])[at.numpy()]).to(self.device)
            for x in (self.album.pictures, self.album.labels)
        )
        return self._shown(pictures, labels, self._words(labels[:, 0], generator))

    def _shown(self, pictures: Tensor, labels: Tensor, words: Tensor) -> Shown:
        task, which, when = labels.unbind(1)
        ahead = when[:, None] + torch.arange(self.training.chunk, device=self.device)
        shots = {name: pictures[:, k] for k, name in enumerate(CAMERAS)}
        wanted = self.target[task[:, None], which[:, None], ahead]
        return Shown(shots, words.new_zeros(len(words), 0), words, wanted, self.scale[task])

    def _words(self, task: Tensor, generator: torch.Generator) -> Tensor:
        """Return half of the time one sentence of the task, else one between several, and always a little beside."""
        said = self.sentences[task]
        random = functools.partial(torch.rand, generator=generator)
        mix = random(*said.shape[:2]).to(self.device) ** 4
        alone = random(len(task), 1).to(self.device) < 0.5
        mix = torch.where(alone, (mix == mix.amax(1, keepdim=True)).float(), mix)
        found = normalize((mix[..., None] * said).sum(1), dim=-1)
        return normalize(found + SHAKE * torch.randn(found.shape, generator=generator).to(self.device), dim=-1)

    def held_out(self) -> tuple[Tensor, Tensor]:
        """Return pictures of demonstrations that are not learned from, where a policy looks, and their labels."""
        if self._judged is None:
            rng, pictures, labels = np.random.default_rng([self.training.seed, 1 << 20]), [], []
            for k, task in enumerate(self.tasks):
                demos, length = task.target.shape[:2]
                which = rng.integers(demos - task.held_out, demos, JUDGED)
                when = FOLLOWED * rng.integers(0, -(-length // FOLLOWED), JUDGED)
                pictures.append(
                    torch.from_numpy(task.drawn(which, when, rng.integers(0, 1 << 60, JUDGED).tolist(), self.size))
                )
                labels.append(torch.from_numpy(np.stack([np.full(JUDGED, k), which, when], 1)))
            self._judged = torch.cat(pictures).to(self.device), torch.cat(labels).to(self.device)
        return self._judged

    def judged(self, policy: ChunkPolicy) -> dict[str, Any]:
        """Return by task by how much the targets that would be followed are off [mm], also with unknown sentences."""
        if not self.scenes.held_out:
            return {}
        pictures, labels = self.held_out()
        found: dict[str, Any] = {}
        for what, said in (("held_out_mm", self.sentences), ("unknown_sentences_mm", self.unknown_sentences)):
            off = []
            for part in torch.arange(len(labels), device=self.device).split(256):
                task = labels[part, 0]
                shown = self._shown(pictures[part], labels[part], said[task, part % said.shape[1]])
                with torch.no_grad():
                    ahead = policy(shown.shots, shown.state, shown.sentence)
                wanted = shown.target.unflatten(-1, (-1, 3))
                off.append((ahead - wanted)[:, :FOLLOWED, 0].norm(dim=-1).mean(1))
            each = torch.cat(off)
            found[what] = {
                task.name: round(1000 * float(each[labels[:, 0] == k].mean()), 2) for k, task in enumerate(self.tasks)
            }
        return found

    def about(self) -> dict[str, Any]:
        """Return what is to be known of it."""
        names = [task.name for task in self.tasks]
        return {
            "tasks": names,
            "sentences": [text for name in names for text in sentences.training_instructions(name)],
            "language": self.encoder,
            "episodes": sum(len(task.target) - task.held_out for task in self.tasks),
            "scenes": {k: v for k, v in asdict(self.scenes).items() if k not in ("folder", "workers")},
        }


def train_on_scenes(
    scenes: SceneTraining,
    out: Path,
    training: Training,
    *,
    start: Path | None = None,
    resume: bool = False,
    small: bool = False,
    callback: Callback | None = None,
) -> dict[str, Any]:
    """Train while others draw, and write the policy to a file after every epoch; return how it went.

    Args:
        scenes: what is drawn and learned from.
        out: the policy's file; a checkpoint lies beside it until training is over.
        training: how to train.
        start: a policy of the same network, whose weights to begin with.
        resume: go on from the checkpoint; pictures are drawn again, and the policy comes out the same.
        small: whether to round weights, see `save_policy`.
        callback: told (stage, done, in all, message); may raise KeyboardInterrupt.
    """
    checkpoint, told = out.with_name(f"{out.stem}.checkpoint.pt"), callback or (lambda *_: None)
    if resume and not checkpoint.is_file():
        raise InputError(f"{checkpoint}: there is no checkpoint to resume; leave out --resume.")
    if start is not None:
        scenes = replace(scenes, arms=max(scenes.arms, load_policy(start)[0].shape.arms))
    tasks, prefix = scenes.demonstrations(training.seed), f".pictures-{out.stem}-"
    out.parent.mkdir(parents=True, exist_ok=True)
    begun = time.monotonic()
    with locked(out.parent, f".{out.name}.lock"):
        for left in out.parent.glob(f"{prefix}*"):
            shutil.rmtree(left, ignore_errors=True)  # of a run that was killed
        sweep(out.parent, out.name, checkpoint.name)
        with tempfile.TemporaryDirectory(prefix=prefix, dir=out.parent) as folder:
            source = ScenePictures(tasks, scenes, training, _Album.open(Path(folder), scenes))
            with _painters(Path(folder), scenes, training.seed) as running:
                source.alive = functools.partial(_check, running)
                run = ChunkRun(source, training, start)
                run_training(run, out, checkpoint if resume else None, told, small=small)
    return run.about() | {"seconds": round(time.monotonic() - begun, 1)}


def _check(running: Sequence[BaseProcess]) -> None:
    if any(process.exitcode for process in running):
        raise InputError("scenes: a process that draws has ended; what it said stands above.")
