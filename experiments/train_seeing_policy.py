"""Train one policy that sees on several tasks, from pictures of which each has a look of its own.

    python experiments/train_seeing_policy.py --device cuda --out runs/seeing/policy.pt
    torchdlo evaluate runs/seeing/policy.pt --protocol varied --protocol paraphrased --protocol blanked

`torchdlo learn` sees a demonstration with the one look that it was recorded with. Here scripted demonstrations
are kept as scenes, not as pictures, and other processes draw them while the network learns, with colours, lights and
cameras drawn anew for every picture. Demonstrations that were played stay in --scenes, and are not played again.
"""

from __future__ import annotations

import copy
import math
import multiprocessing
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import numpy as np
import torch
from options import Parser, count
from torch import Tensor
from torch.nn.functional import normalize

from torchdlo.agents.data import sentences
from torchdlo.agents.data.demonstrators import scripted_demonstrator
from torchdlo.agents.data.painting import TaskPainter
from torchdlo.agents.data.record import Noise, draw_starts, play_batch, scene_in_time
from torchdlo.agents.distributed import make_executor
from torchdlo.agents.policies import language
from torchdlo.agents.policies.chunk_policy import ChunkPolicy, NetworkShape, save_policy
from torchdlo.agents.trajopt.search_journal import code_versions
from torchdlo.envs import Task, find, with_fidelity
from torchdlo.envs.core import episode
from torchdlo.envs.observations.pixels import camera_rig, placed
from torchdlo.files import replace_atomically
from torchdlo.journal import locked
from torchdlo.vision import renderer
from torchdlo.vision.look import draw_look

TASKS = ("coiling", "separation", "slingshot", "wiring_post")
CAMERAS = ("front", "wrist_right", "wrist_left")
BATCH = 16
"""Demonstrations that are played at once."""
SLOW = Noise(memory=0.97)
"""Every third batch has noise that stays for long, half as large again: it shows how to get back from far off."""
FORGIVES = {"separation": 0.10, "slingshot": 0.03}
"""Distance by which errors of a task are measured [m]; else `USUAL`."""
USUAL = 0.08
HELD_OUT = 6
"""Demonstrations of each task that are not learned from."""
JUDGED = 120
"""Pictures of each task that the policy is judged by."""
GROUP = 6
"""Pictures that are drawn at once."""
DONE = 8
"""Targets that are followed before the policy looks again; by these it is judged."""


def options(given: Sequence[str] | None = None) -> Any:
    """Read the options."""
    parser = Parser(__file__, description=__doc__)
    parser.add_argument("--tasks", default=",".join(TASKS), help="names, with commas")
    parser.add_argument("--scenes", default="runs/seeing/scenes", help="folder of the demonstrations")
    parser.add_argument("--batches", type=count, default=7, help=f"of {BATCH} demonstrations of each task")
    parser.add_argument("--fidelity", default="coarse", help="of the demonstrations: published or coarse")
    parser.add_argument("--workers", type=int, default=max(1, (os.cpu_count() or 1) - 2), help="that play and draw")
    parser.add_argument("--threads", type=count, default=1, help="that learn on the processor")
    parser.add_argument("--pictures", type=count, default=150_000, help="in all; each has as many views as cameras")
    parser.add_argument("--size", type=count, default=96, help="of pictures [px]")
    parser.add_argument("--steps", type=count, default=4000, help="of learning")
    parser.add_argument("--batch", type=count, default=768, help="pictures of a step")
    parser.add_argument("--rate", type=float, default=1e-3, help="largest learning rate")
    parser.add_argument("--chunk", type=count, default=20, help="actions that the policy looks ahead")
    parser.add_argument("--width", type=count, default=192, help="numbers of a token")
    parser.add_argument("--seed", type=int, default=0, help="of everything")
    parser.add_argument("--device", default="cpu", choices=("cpu", "cuda"), help="where to learn")
    parser.add_argument("--language", default=language.default_encoder(), help="minilm or hashed")
    parser.add_argument("--out", default="runs/seeing/policy.pt", help="file of the policy; empty: only play")
    return parser.parse_args(given)


def prepared(task: Task, size: int) -> episode.Episode:
    """Return episodes of a task."""
    return episode.prepare(task, size, compiled=False, recorded=task.horizon > 10)


def play(job: tuple[str, str, int, Path]) -> int:
    """Play a batch of scripted demonstrations with noise, keep the scenes of those that succeed, and count them."""
    name, fidelity, number, folder = job
    task = with_fidelity(find(name), fidelity)
    made = prepared(task, BATCH)
    rig = camera_rig(made)
    noise = Noise(task.demonstration_noise)
    if number % 3 == 2:
        noise = Noise(1.5 * task.demonstration_noise, memory=SLOW.memory)
    starts = draw_starts(task, "scenes", range(BATCH * number, BATCH * (number + 1)))
    with torch.no_grad():
        steps = play_batch(made, starts, scripted_demonstrator(task), noise, None)[0]
    rows: dict[str, list[Tensor]] = {
        k: [] for k in ("pos", "turn", "ropes", "particles", "rotation", "shift", "target")
    }
    for k in steps[-1].success.nonzero()[:, 0].tolist():
        world = scene_in_time([step.before for step in steps], k)
        things, view = placed(rig, world.state, world.joints)
        found = (things.pos, things.turn, things.ropes, things.particles, view.rotation, view.translation)
        target = torch.stack([step.target[k, :, :3] for step in steps])
        for own, x in zip(rows.values(), (*found, target), strict=True):
            own.append(x.float())
    with replace_atomically(folder / f"{name}-{number:04d}.npz") as file, open(file, "wb") as stream:
        np.savez(stream, **{key: torch.stack(x).numpy() for key, x in rows.items() if x})
    return len(rows["target"])


@dataclass(frozen=True, eq=False)
class Demonstrations:
    """What there is to be seen in demonstrations of a task, and where tools were led; those held out come last."""

    model: renderer.RenderModel
    cameras: tuple[str, ...]
    intrinsics: Tensor
    """Of the cameras [px], shape (C, 3, 3)."""
    moving: dict[str, np.ndarray]
    """See `renderer.Placement` and `renderer.Pinhole`, shape (D, T, ...)."""

    @property
    def target(self) -> np.ndarray:
        """Where tools were led [m], shape (D, T, R, 3)."""
        return self.moving["target"]

    def drawn(self, which: np.ndarray, when: np.ndarray, looks: Sequence[int], size: int) -> np.ndarray:
        """Return pictures of all of `CAMERAS` in 8 bits, shape (B, C, 3, size, size); black where there is none.

        Args:
            which: numbers of demonstrations, shape (B,).
            when: numbers of actions, shape (B,).
            looks: seeds of the looks.
            size: of the pictures [px].
        """
        own, painter = {k: torch.from_numpy(x[which, when]) for k, x in self.moving.items()}, TaskPainter()
        things = renderer.Placement(own["pos"], own["turn"], own["ropes"], own["particles"])
        view = renderer.Pinhole(self.intrinsics.expand(len(which), -1, 3, 3), own["rotation"], own["shift"])
        drawn = [draw_look(torch.Generator().manual_seed(int(x)), strength=painter.jitter) for x in looks]
        quality = {"samples": painter.samples, "shadow": painter.shadow}
        seen = renderer.render(self.model, things, view, (size, size), looks=drawn, **quality).rgb
        found = np.zeros((len(which), len(CAMERAS), 3, size, size), np.uint8)
        found[:, [CAMERAS.index(name) for name in self.cameras]] = seen.movedim(-1, 2).numpy()
        return found


def demonstrations(name: str, given: Any) -> Demonstrations:
    """Return the demonstrations of a task that were played."""
    rig = camera_rig(prepared(with_fidelity(find(name), given.fidelity), 1), size=given.size)
    parts = []
    for file in sorted(Path(given.scenes).glob(f"{name}-[0-9]*.npz"))[: given.batches]:
        with np.load(file, allow_pickle=False) as content:
            parts.append({key: content[key] for key in content.files})
    parts = [part for part in parts if part]
    total = sum(len(part["target"]) for part in parts)
    if total <= HELD_OUT:
        sys.exit(f"{name}: {total} demonstrations succeeded, and {HELD_OUT} are held out; give more --batches.")
    order = np.random.default_rng(given.seed).permutation(total)
    moving = {key: np.concatenate([part[key] for part in parts])[order] for key in parts[0]}
    return Demonstrations(rig.model, tuple(camera.name for camera in rig.cameras), rig.own.intrinsics, moving)


@dataclass(frozen=True, eq=False)
class Album:
    """Pictures in files that are mapped; each painter has rows of its own."""

    pictures: np.ndarray
    """Shape (workers, room, C, 3, S, S), 8 bits."""
    labels: np.ndarray
    """Task, demonstration and action of each, shape (workers, room, 3)."""
    done: np.ndarray
    """Rows of each painter that are ready, shape (workers,)."""

    @staticmethod
    def open(folder: Path, workers: int, given: Any) -> Album:
        """Return the album in a folder."""
        room = -(-given.pictures // workers)
        parts = []
        for name, kind, shape in (
            ("pictures", np.uint8, (room, len(CAMERAS), 3, given.size, given.size)),
            ("labels", np.int64, (room, 3)),
            ("done", np.int64, ()),
        ):
            file = folder / name
            parts.append(np.memmap(file, kind, "r+" if file.exists() else "w+", shape=(workers, *shape)))
        return Album(*parts)


def paint(folder: Path, workers: int, own: int, given: Any) -> None:
    """Draw demonstrations that are learned from, with a look for every picture, until there is no more room."""
    parent = os.getppid()
    torch.set_num_threads(1)
    tasks, album = [demonstrations(name, given) for name in given.tasks.split(",")], Album.open(folder, workers, given)
    rng = np.random.default_rng([given.seed, own])
    room = album.labels.shape[1]
    for first in range(0, room, GROUP):
        last, k = min(first + GROUP, room), int(rng.integers(len(tasks)))
        demos, length = tasks[k].target.shape[:2]
        which, when = rng.integers(0, demos - HELD_OUT, last - first), rng.integers(0, length, last - first)
        album.pictures[own, first:last] = tasks[k].drawn(
            which, when, rng.integers(0, 1 << 60, last - first), given.size
        )
        album.labels[own, first:last] = np.stack([np.full(last - first, k), which, when], 1)
        album.done[own] = last  # after its pictures
        if os.getppid() != parent:
            return


@contextmanager
def painters(folder: Path, workers: int, given: Any) -> Iterator[list[BaseProcess]]:
    """Let processes draw while the block runs."""
    # Forked ones would share a GPU that was begun with.
    context = multiprocessing.get_context("spawn")
    running = [context.Process(target=paint, args=(folder, workers, w, given), daemon=True) for w in range(workers)]
    for process in running:
        process.start()
    try:
        yield running
    finally:
        for process in running:
            process.terminate()
        for process in running:
            process.join()


class Learner:
    """The network, what it learns from, and how."""

    def __init__(self, tasks: Sequence[Demonstrations], given: Any) -> None:
        """Make a network, with weights drawn from the seed."""
        names, self.given, device = given.tasks.split(","), given, torch.device(given.device)
        arms = max(task.target.shape[2] for task in tasks)
        longest = max(task.target.shape[1] for task in tasks)
        target = torch.zeros(len(tasks), max(len(t.target) for t in tasks), longest + given.chunk, arms, 3)
        for k, task in enumerate(tasks):
            demos, length, own = task.target.shape[:3]
            target[k, :demos, :length, :own] = torch.from_numpy(task.target)
            target[k, :demos, length:, :own] = torch.from_numpy(task.target[:, -1:])  # after the end tools stay
        rows = [target[k, : len(t.target), : t.target.shape[1]].flatten(2).flatten(0, 1) for k, t in enumerate(tasks)]
        means = torch.stack([x.mean(0) for x in rows])
        squares = torch.stack([(x**2).mean(0) for x in rows]).mean(0)
        std = (squares - means.mean(0) ** 2).clamp(min=0).sqrt().clamp(min=1e-3)
        forgives = torch.tensor([FORGIVES.get(name, USUAL) for name in names])
        there = torch.stack([(x != 0).any(0) for x in rows])
        self.target = target.flatten(3).to(device)
        self.weight = torch.where(there, std / forgives[:, None], 1.0).to(device)
        # What is not followed before it looks again counts less.
        near = torch.where(torch.arange(given.chunk) < DONE + 2, 1.0, 0.3)
        self.near = (near / near.mean()).to(device)
        said = [language.encode_sentences(sentences.training_instructions(name), given.language) for name in names]
        least = min(map(len, said))
        self.said = torch.stack([x[:least] for x in said]).to(device)
        shape = NetworkShape(arms, CAMERAS, given.size, 0, given.chunk, given.width, (48, 96, 128), tokens=3, layers=3)
        torch.manual_seed(given.seed)
        self.policy = ChunkPolicy(shape)
        self.policy.target_mean.copy_(means.mean(0))
        self.policy.target_std.copy_(std)
        self.policy.to(device)
        self.averaged = copy.deepcopy(self.policy).eval()
        kinds = [[p for p in self.policy.parameters() if (p.dim() > 1) is large] for large in (True, False)]
        groups = [{"params": own, "weight_decay": decay} for own, decay in zip(kinds, (0.02, 0.0), strict=True)]
        self.optimizer = torch.optim.AdamW(groups, given.rate, betas=(0.9, 0.98), fused=device.type == "cuda")
        self.generator = torch.Generator(device).manual_seed(given.seed)

    def step(self, number: int, pictures: Tensor, labels: Tensor) -> Tensor:
        """Learn from pictures (B, C, 3, S, S) of what labels (B, 3) say, and return the loss."""
        rise, share = min((number + 1) / 200, 1.0), number / self.given.steps
        for group in self.optimizer.param_groups:
            group["lr"] = self.given.rate * max(0.002, rise * 0.5 * (1 + math.cos(math.pi * share)))
        task, words = labels[:, 0], self._sentences(labels[:, 0])
        color = 1 + 0.15 * (2 * self._random(len(labels), len(CAMERAS), 3, 1, 1) - 1)
        found = self.policy.scaled(_shots((pictures * color).clamp(max=255)), words.new_zeros(len(words), 0), words)
        wanted = (self._wanted(labels) - self.policy.target_mean) / self.policy.target_std
        loss = ((found - wanted).abs() * self.weight[task][:, None] * self.near[:, None]).mean()
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.policy.parameters(), 1.0)
        self.optimizer.step()
        keep = min(0.999, (1 + number) / (10 + number))
        with torch.no_grad():
            for mean, own in zip(self.averaged.parameters(), self.policy.parameters(), strict=True):
                mean.lerp_(own, 1 - keep)
        return loss.detach()

    def errors(self, pictures: Tensor, labels: Tensor) -> list[float]:
        """Return by task the mean distance of the targets that would be followed [mm]."""
        off = []
        for part in torch.arange(len(labels), device=labels.device).split(256):
            own = labels[part]
            words = self.said[own[:, 0], 0]
            with torch.no_grad():
                found = self.averaged(_shots(pictures[part]), words.new_zeros(len(words), 0), words)
            wanted = self._wanted(own).unflatten(-1, (-1, 3))
            off.append((found - wanted)[:, :DONE, 0].norm(dim=-1).mean(1))
        all_off = torch.cat(off)
        return [1000 * float(all_off[labels[:, 0] == k].mean()) for k in range(len(self.said))]

    def _random(self, *size: int) -> Tensor:
        return torch.rand(*size, device=self.target.device, generator=self.generator)

    def _wanted(self, labels: Tensor) -> Tensor:
        task, which, when = labels.unbind(1)
        ahead = when[:, None] + torch.arange(self.given.chunk, device=labels.device)
        return self.target[task[:, None], which[:, None], ahead]

    def _sentences(self, task: Tensor) -> Tensor:
        """Return half of the time one sentence of the task, else one between several, and always a little beside."""
        said = self.said[task]
        mix = self._random(*said.shape[:2]) ** 4
        mix = torch.where(self._random(len(task), 1) < 0.5, (mix == mix.amax(1, keepdim=True)).float(), mix)
        found = normalize((mix[..., None] * said).sum(1), dim=-1)
        shake = torch.randn(found.shape, device=found.device, generator=self.generator)
        return normalize(found + 0.02 * shake, dim=-1)


def _shots(pictures: Tensor) -> dict[str, Tensor]:
    return {name: pictures[:, k] for k, name in enumerate(CAMERAS)}


def held_out(tasks: Sequence[Demonstrations], given: Any) -> tuple[Tensor, Tensor]:
    """Return pictures of demonstrations that are not learned from, and their labels."""
    rng, pictures, labels = np.random.default_rng([given.seed, 1 << 20]), [], []
    for k, task in enumerate(tasks):
        demos, length = task.target.shape[:2]
        which = rng.integers(demos - HELD_OUT, demos, JUDGED)
        when = DONE * rng.integers(0, -(-length // DONE), JUDGED)  # where a policy looks
        pictures.append(torch.from_numpy(task.drawn(which, when, rng.integers(0, 1 << 60, JUDGED), given.size)))
        labels.append(torch.from_numpy(np.stack([np.full(JUDGED, k), which, when], 1)))
    return torch.cat(pictures).to(given.device), torch.cat(labels).to(given.device)


class Pool:
    """Pictures of an album where they are learned from; on a GPU they are copied as they get ready."""

    def __init__(self, album: Album, device: torch.device) -> None:
        """Make room for them."""
        self.album, self.seen = album, np.zeros_like(album.done)
        self.own = torch.from_numpy(album.pictures), torch.from_numpy(album.labels)
        if device.type != "cpu":
            self.own = tuple(torch.zeros_like(x, device=device) for x in self.own)
        self.usable = torch.zeros(0, dtype=torch.long, device=device)

    def refresh(self) -> None:
        """Take what has got ready since."""
        done, room = np.array(self.album.done), self.album.labels.shape[1]
        if self.usable.device.type != "cpu":
            for w, (first, last) in enumerate(zip(self.seen, done, strict=True)):
                for own, source in zip(self.own, (self.album.pictures, self.album.labels), strict=True):
                    own[w, first:last] = torch.from_numpy(source[w, first:last]).to(own.device)
        self.seen = done
        ready = np.concatenate([w * room + np.arange(n) for w, n in enumerate(done.tolist())])
        self.usable = torch.from_numpy(ready).to(self.usable.device)

    def batch(self, size: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Return pictures and labels of a batch."""
        usable = self.usable
        at = usable[torch.randint(len(usable), (size,), device=usable.device, generator=generator)]
        pictures, labels = (x.flatten(0, 1)[at] for x in self.own)
        return pictures, labels


def learned(tasks: Sequence[Demonstrations], given: Any, folder: Path) -> tuple[Learner, list[dict[str, Any]]]:
    """Train while others draw into a folder; return the network and how it went."""
    begun, workers, names = time.monotonic(), max(1, given.workers), given.tasks.split(",")
    album = Album.open(folder, workers, given)
    with painters(folder, workers, given) as running:
        judged, learner = held_out(tasks, given), Learner(tasks, given)
        pool, curve = Pool(album, torch.device(given.device)), []
        total, since, told, looked = torch.zeros((), device=given.device), 0, time.monotonic(), 0.0
        for number in range(given.steps):
            while len(pool.usable) < min(4 * given.batch, given.pictures) or time.monotonic() > looked + 2:
                if any(process.exitcode for process in running):
                    sys.exit("a process that draws has ended; what it said stands above.")
                pool.refresh()
                looked = time.monotonic()
                time.sleep(0.2 * (len(pool.usable) < given.batch))
            total += learner.step(number, *pool.batch(given.batch, learner.generator))
            since += 1
            if time.monotonic() > told + 10 or number == given.steps - 1:
                errors = {name: round(x, 2) for name, x in zip(names, learner.errors(*judged), strict=True)}
                row = {"seconds": round(time.monotonic() - begun), "step": number + 1, "pictures": len(pool.usable)}
                curve.append(row | {"loss": round(float(total) / since, 5), "held_out_mm": errors})
                print(curve[-1], flush=True)
                total.zero_()
                since, told = 0, time.monotonic()
    return learner, curve


def main(words: Sequence[str] | None = None) -> None:
    """Play what was not played yet, then learn."""
    given = options(words)
    torch.set_num_threads(given.threads)
    names, folder = given.tasks.split(","), Path(given.scenes)
    folder.mkdir(parents=True, exist_ok=True)
    jobs = [(name, given.fidelity, k, folder) for k in range(given.batches) for name in names]
    jobs = [job for job in jobs if not (folder / f"{job[0]}-{job[2]:04d}.npz").exists()]
    with make_executor(given.workers) as executor:
        for k, good in executor.map(play, jobs):
            print(f"{jobs[k][0]}: {good} of {BATCH}", flush=True)
    if not given.out:
        return
    out = Path(given.out)
    out.parent.mkdir(parents=True, exist_ok=True)
    tasks, prefix = [demonstrations(name, given) for name in names], f".pictures-{out.stem}-"
    with locked(out.parent, f".{out.name}.lock"):
        for left in out.parent.glob(f"{prefix}*"):
            shutil.rmtree(left, ignore_errors=True)  # of a run that was killed
        with tempfile.TemporaryDirectory(prefix=prefix, dir=out.parent) as album:
            learner, curve = learned(tasks, given, Path(album))
    about = {
        "tasks": names,
        "sentences": [text for name in names for text in sentences.training_instructions(name)],
        "language": given.language,
        "episodes": sum(len(task.target) - HELD_OUT for task in tasks),
        "parameters": sum(p.numel() for p in learner.policy.parameters()),
        "training": vars(given),
        "curve": curve,
        "versions": {name: str(value) for name, value in code_versions().items()},
    }
    save_policy(out, learner.averaged.cpu(), about, small=True)
    print(f"policy: {out}")


if __name__ == "__main__":
    main()
