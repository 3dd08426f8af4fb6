"""Scripted demonstrations that are kept as scenes, not as pictures, and are drawn with a new look every time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchdlo.agents.data.demonstrators import scripted_demonstrator
from torchdlo.agents.data.painting import TaskPainter
from torchdlo.agents.data.record import Noise, draw_starts, play_batch, scene_in_time
from torchdlo.envs import Task, find, short_name, with_fidelity
from torchdlo.envs.core import episode
from torchdlo.envs.observations.pixels import camera_rig, placed
from torchdlo.errors import InputError
from torchdlo.files import replace_atomically
from torchdlo.physics import tree
from torchdlo.untrusted.array_file import read_arrays
from torchdlo.vision import renderer
from torchdlo.vision.look import draw_look

__all__ = ["BATCH", "CAMERAS", "SceneDemonstrations", "load_scenes", "play_scenes", "scene_file"]

CAMERAS = ("front", "wrist_right", "wrist_left")
BATCH = 16
"""Demonstrations that are played at once."""
SLOW = Noise(memory=0.97)
"""Every third batch has noise that stays for long, half as large again: it shows how to get back from far off."""
_KEPT = ("pos", "turn", "ropes", "particles", "rotation", "shift", "target")


def scene_file(folder: Path, name: str, number: int) -> Path:
    """Return the file of a batch of demonstrations."""
    return folder / f"{short_name(name)}-{number:04d}.npz"


def _prepared(task: Task, size: int) -> episode.Episode:
    return episode.prepare(task, size, execution=episode.quick_execution(task))


def play_scenes(job: tuple[str, str, int, Path]) -> int:
    """Play a batch of scripted demonstrations with noise, keep the scenes of those that succeed, and count them.

    Args:
        job: name of the task, fidelity, number of the batch, and folder.
    """
    name, fidelity, number, folder = job
    task = with_fidelity(find(name), fidelity)
    made = _prepared(task, BATCH)
    rig = camera_rig(made)
    noise = Noise(task.demonstration_noise)
    if number % 3 == 2:
        noise = Noise(1.5 * task.demonstration_noise, memory=SLOW.memory)
    starts = draw_starts(task, "scenes", range(BATCH * number, BATCH * (number + 1)))
    with torch.no_grad():
        steps = play_batch(made, starts, scripted_demonstrator(task), noise, None)[0]
    rows: dict[str, list[Tensor]] = {key: [] for key in _KEPT}
    for k in steps[-1].success.nonzero()[:, 0].tolist():
        world = scene_in_time([step.before for step in steps], k)
        things, view = placed(rig, world.state, world.joints)
        found = (things.pos, things.turn, things.ropes, things.particles, view.rotation, view.translation)
        target = torch.stack([step.target[k, :, :3] for step in steps])
        for own, x in zip(rows.values(), (*found, target), strict=True):
            own.append(x.float())
    with replace_atomically(scene_file(folder, name, number)) as file, open(file, "wb") as stream:
        kept: dict[str, Any] = {key: torch.stack(x).numpy() for key, x in rows.items() if x}
        np.savez(stream, **kept)
    return len(rows["target"])


@dataclass(frozen=True, eq=False)
class SceneDemonstrations:
    """What there is to be seen in demonstrations of a task, and where tools were led."""

    name: str
    model: renderer.RenderModel
    cameras: tuple[str, ...]
    intrinsics: Tensor
    """Of the cameras [px], shape (C, 3, 3)."""
    moving: dict[str, np.ndarray]
    """See `renderer.Placement` and `renderer.Pinhole`, shape (D, T, ...)."""
    held_out: int
    """Demonstrations that are not learned from; they come last."""

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
        quality: dict[str, Any] = {"samples": painter.samples, "shadow": painter.shadow}
        seen = renderer.render(self.model, things, view, (size, size), looks=drawn, **quality).rgb
        found = np.zeros((len(which), len(CAMERAS), 3, size, size), np.uint8)
        found[:, [CAMERAS.index(name) for name in self.cameras]] = tree.part(seen).movedim(-1, 2).numpy()
        return found


def load_scenes(
    folder: Path, name: str, *, size: int, batches: int, seed: int, held_out: int, fidelity: str = "coarse"
) -> SceneDemonstrations:
    """Return the demonstrations of a task that were played, in an order that the seed decides.

    Args:
        folder: where `play_scenes` kept them.
        name: of the task.
        size: of the pictures that are to be drawn [px].
        batches: most files to read.
        seed: of their order.
        held_out: how many are not to be learned from.
        fidelity: in which they were played.
    """
    rig = camera_rig(_prepared(with_fidelity(find(name), fidelity), 1), size=size)
    parts = []
    for file in sorted(folder.glob(f"{name}-[0-9]*.npz"))[:batches]:
        part = read_arrays(file, "scenes of demonstrations", names=_KEPT)
        if part:
            parts.append({key: part[key] for key in _KEPT})
    total = sum(len(part["target"]) for part in parts)
    if total <= held_out:
        raise InputError(
            f"{folder}: {total} demonstrations of {name} succeeded, and {held_out} are held out; play more of them."
        )
    order = np.random.default_rng(seed).permutation(total)
    moving = {key: np.concatenate([part[key] for part in parts])[order] for key in parts[0]}
    cameras = tuple(camera.name for camera in rig.cameras)
    return SceneDemonstrations(name, rig.model, cameras, rig.own.intrinsics, moving, held_out)
