"""Running a described scene from its start to its end, and the file that keeps what happened."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from torchdlo import describe
from torchdlo import scene as scenes
from torchdlo.files import replacing
from torchdlo.physics import tree

__all__ = ["Frames", "run", "save_frames"]


@dataclass(frozen=True, eq=False)
class Frames:
    """What happened, F moments of it."""

    time: np.ndarray
    """Moments [s], shape (F,)."""
    pos: np.ndarray
    """Vertex positions [m], shape (F, V, 3)."""
    twist: np.ndarray
    """Twist of edges against their reference frames [rad], shape (F, V)."""
    force: np.ndarray
    """Forces that holds exert on held vertices [N], shape (F, H, 3)."""
    body_pos: np.ndarray
    """Positions of bodies [m], shape (F, K, 3)."""
    body_quat: np.ndarray
    """Orientations of bodies (w, x, y, z) [1], shape (F, K, 4)."""
    rope: np.ndarray
    """Number of the rope that each vertex belongs to, shape (V,)."""
    interrupted: bool = False
    """Whether it was stopped before its end."""
    problem: str = ""
    """What went wrong, "" if nothing did; frames end before it."""


def _seen(state: scenes.State) -> list[np.ndarray]:
    rods, none = state.rods, state.rods.pos.new_zeros(0, 4)
    bodies = (state.bodies.pos, state.bodies.quat) if state.bodies else (none[:, :3], none)
    found = (state.time[0, 0], rods.pos, rods.twist[:, 0], state.reaction.force, *bodies)
    return [x.cpu().numpy().copy() for x in found]


def run(
    description: describe.Description,
    *,
    every: int = 10,
    compiled: bool = False,
    callback: Callable[[str, int, int, str], None] | None = None,
) -> Frames:
    """Run a scene and keep a frame of its start and after every `every` steps.

    A `KeyboardInterrupt` that `callback` raises ends the run, as does a state that is not sound; frames so far are
    returned.

    Args:
        description: the scene.
        every: steps per frame.
        compiled: whether to compile the step, worth it for long runs.
        callback: told (stage, steps done, steps in all, message) after every frame.
    """
    scene, params, state, controls = describe.build(description)
    step = scenes.stepper(scene, compiled=compiled)
    total = round(description.duration / description.dt)
    kept, interrupted, problem = [_seen(state)], False, ""
    with torch.no_grad():
        for k in range(total):
            state = step(params, state, tree.map(lambda c, k=k: c[k], controls))
            if (k + 1) % every and k + 1 < total:
                continue
            try:
                scenes.check_state(state)
            except RuntimeError as error:
                problem = f"after {float(state.time):g} s: {error}"
                break
            kept.append(_seen(state))
            try:
                if callback is not None:
                    callback("simulate", k + 1, total, f"{float(state.time):.3g} s")
            except KeyboardInterrupt:
                interrupted = True
                break
    counts = scene.topology.counts
    return Frames(
        *(np.stack(parts) for parts in zip(*kept, strict=True)),
        rope=np.repeat(np.arange(len(counts)), counts),
        interrupted=interrupted,
        problem=problem,
    )


def save_frames(frames: Frames, description: describe.Description, path: Path) -> None:
    """Write frames as .npz, with the scene itself as JSON text in "torchdlo_scene"."""
    arrays = {name: value for name, value in vars(frames).items() if isinstance(value, np.ndarray)}
    with replacing(path) as temporary:
        np.savez_compressed(temporary, torchdlo_scene=np.array(describe.text(description)), **arrays)
