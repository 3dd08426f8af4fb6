"""What a policy that sees is trained from: frames of a data set. See `chunk_training.Source`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from torchdlo.agents.data.reading import DataSet
from torchdlo.agents.policies import language
from torchdlo.errors import InputError

__all__ = ["SetFrames", "Shown", "read_frames"]

IMAGES = "observation.images."
LEAST = 1e-3
"""Least scale of states and targets: what hardly varies is not blown up."""
FINEST = 0.02
"""Least spread of targets of a task by which its errors are measured [m]."""


@dataclass(frozen=True, eq=False)
class Shown:
    """What a batch shows, and what is to be said to it."""

    shots: dict[str, Tensor]
    """Pictures by camera, 8 bits, shape (B, 3, H, W)."""
    state: Tensor
    """Of all arms, shape (B, S)."""
    sentence: Tensor
    """Vectors of the instructions, shape (B, 384)."""
    target: Tensor
    """Where tools go [m], shape (B, chunk, 3 R)."""
    scale: Tensor
    """By what errors are measured [m], shape (B, 3 R); 0 for arms that are not there."""


@dataclass(frozen=True, eq=False)
class SetFrames:
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
    scale: Tensor
    """Spread of the targets of the frame's task [m], shape (N, 3 R): errors count by what is much in a task."""
    pictures: dict[str, np.ndarray] | dict[str, Tensor]
    """Shape (N, 3, H, W), 8 bits."""
    description: dict[str, Any]
    """What is to be known of the set."""

    @property
    def seen(self) -> int:
        """Frames of an epoch: it has every episode as often as every other, short ones as long ones."""
        return (int((self.last - self.first).max()) + 1) * len(self.first.unique())

    @property
    def arms(self) -> int:
        """Arms of the widest task."""
        return self.target.shape[1] // 3

    @property
    def size(self) -> int:
        """Width of pictures [px]."""
        pictures: list[Any] = list(self.pictures.values())
        return int(pictures[0].shape[-1])

    @property
    def cameras(self) -> tuple[str, ...]:
        """Their names."""
        return tuple(self.pictures)

    def statistics(self) -> dict[str, tuple[Tensor, Tensor]]:
        """Return means and deviations of states and targets."""
        kept = {"target": self.target, "state": self.state}
        return {name: (x.mean(0), x.std(0, correction=0).clamp(min=LEAST)) for name, x in kept.items()}

    def order(self, epoch: int, generator: torch.Generator) -> Tensor:
        """Return the frames of an epoch: all of the longest episodes, those of shorter ones several times."""
        found, firsts = [], self.first.unique().tolist()
        longest = self.seen // len(firsts)
        for first in firsts:
            length = int(self.last[first]) - first + 1
            rounds = [torch.randperm(length, generator=generator) for _ in range(-(-longest // length))]
            found.append(first + torch.cat(rounds)[:longest])
        order = torch.cat(found)
        return order[torch.randperm(len(order), generator=generator)]

    def batch(self, at: Tensor, chunk: int, generator: torch.Generator) -> Shown:
        """Return frames; after the end tools stay."""
        device = self.target.device
        here = at.to(device)
        ahead = torch.minimum(here[:, None] + torch.arange(chunk, device=device), self.last[here][:, None])
        shots = {
            name: x[here] if isinstance(x, Tensor) else torch.from_numpy(x[at.numpy()]).to(device)
            for name, x in self.pictures.items()
        }
        words = self.sentence[self.told[here]]
        return Shown(shots, self.state[here], words, self.target[ahead], self.scale[here])

    def judged(self, policy: Any) -> dict[str, Any]:
        """Return nothing: all frames are learned from."""
        return {}

    def about(self) -> dict[str, Any]:
        """Return what is to be known of it."""
        return self.description

    def on(self, device: torch.device, room: int) -> SetFrames:
        """Return them on a device, with the pictures if they take no more than `room` there [bytes]."""
        names = [each.name for each in fields(self) if each.name not in ("pictures", "description")]
        moved = {name: getattr(self, name).to(device) for name in names}
        fits = sum(x.nbytes for x in self.pictures.values()) <= room
        pictures = {name: torch.as_tensor(x).to(device) for name, x in self.pictures.items()} if fits else self.pictures
        return SetFrames(**moved, pictures=pictures, description=self.description)


def read_frames(
    data: DataSet, encoder: str, folder: Path, callback: Callable[[str, int, int, str], None], size: int = 0
) -> SetFrames:
    """Return the frames of a set; pictures are decoded into files in a folder.

    Args:
        data: the set.
        encoder: how sentences become vectors.
        folder: where the files go.
        callback: told (stage, done, in all, message).
        size: width and height to which pictures are made smaller [px]; 0: as they are.
    """
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
        if size > min(height, width):
            raise InputError(
                f"{data.path}: its pictures are {width} x {height} pixels; expected a size below, given {size}."
            )
        height, width = (size, size) if size else (height, width)
        file = folder / f"{camera}.u8"
        pictures[camera.removeprefix(IMAGES)] = np.memmap(file, np.uint8, "w+", shape=(count, 3, height, width))
    for k, row in enumerate(data.episodes):
        start, end = row["dataset_from_index"], row["dataset_to_index"]
        first[start:end], last[start:end] = start, end - 1
        for camera in data.cameras:
            kept = pictures[camera.removeprefix(IMAGES)]
            shots = torch.from_numpy(np.stack(list(data.pictures(k, camera))).transpose(0, 3, 1, 2))
            kept[start:end] = _smaller(shots, kept.shape[2]).numpy()
        callback("read", k + 1, len(data.episodes), "")
    target = columns["torchdlo.target"].reshape(count, -1, 7)[..., :3].reshape(count, -1)
    targets = torch.from_numpy(np.ascontiguousarray(target))
    return SetFrames(
        torch.from_numpy(columns["observation.state"].copy()),
        targets,
        torch.from_numpy(first),
        torch.from_numpy(last),
        language.encode_sentences(data.tasks, encoder),
        torch.from_numpy(columns["task_index"].copy()),
        _scales(data, targets),
        pictures,
        _about(data, encoder),
    )


def _smaller(shots: Tensor, size: int) -> Tensor:
    """Return pictures (N, 3, H, W), 8 bits, with another height and width: the mean of what a pixel covers."""
    if shots.shape[2] == size:
        return shots
    return interpolate(shots.float(), (size, size), mode="area").round().to(torch.uint8)


def _about(data: DataSet, encoder: str) -> dict[str, Any]:
    rows = data.provenance.get("episodes") or []
    return {
        "tasks": sorted({row["task"] for row in rows if row.get("task")}),
        "sentences": list(data.tasks),
        "language": encoder,
        "dataset": data.path.resolve().name,
        "episodes": len(data.episodes),
        "frames": data.info["total_frames"],
    }


def _scales(data: DataSet, target: Tensor) -> Tensor:
    """Return the spread of targets within each frame's task, at most that of all; 0 for arms that are not there."""
    about = data.provenance.get("episodes") or [{}] * len(data.episodes)
    rows: dict[str, list[Tensor]] = {}
    for row, own in zip(data.episodes, about, strict=True):
        at = torch.arange(row["dataset_from_index"], row["dataset_to_index"])
        rows.setdefault(own.get("task") or row["tasks"][0], []).append(at)
    found, whole = torch.zeros_like(target), target.std(0, correction=0).clamp(min=LEAST)
    for parts in rows.values():
        at = torch.cat(parts)
        spread = target[at].std(0, correction=0)
        found[at] = torch.where(spread < LEAST, 0.0, torch.minimum(spread.clamp(min=FINEST), whole))
    return found
