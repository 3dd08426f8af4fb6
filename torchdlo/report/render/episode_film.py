"""An episode of a task as the frames of a run, with its arms, for pictures, videos and the browser."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchdlo.coupling.common import step_diagnostics
from torchdlo.coupling.robot import robot_kinematics as robots
from torchdlo.envs import Task
from torchdlo.envs.core import episode
from torchdlo.errors import InputError
from torchdlo.physics import tree
from torchdlo.scene import Params, Scene
from torchdlo.scene_files.run import Frames, appearance

__all__ = ["film", "outcome_of", "stills"]

_STEEP = 0.9
"""Gradient at which the camera looks down."""
_ASIDE = np.radians(25)
"""By how much it is beside the direction in which arms reach."""


class _Stopped(Exception):
    """The callback ended an episode."""


def film(
    task: Task,
    actions: Tensor,
    *,
    made: episode.Episode | None = None,
    arms: bool = True,
    callback: Callable[[str, int, int, str], None] | None = None,
    **choices: Any,
) -> tuple[Frames, episode.EpisodeResult | None]:
    """Play an episode; return a frame of its start and after every action, and what it came to.

    A `KeyboardInterrupt` that `callback` raises ends it; the frames so far are returned, and None for what it came to.

    Args:
        task: the task.
        actions: of one episode, shape (T, A).
        made: what `episode.prepare` returned for one scene; made if not given.
        arms: whether the arms are seen.
        callback: told (stage, actions done, actions in all, message) after each.
        choices: of `episode.prepare`.
    """
    made = made or episode.prepare(task, 1, like=actions, **choices)

    def told(done: int, total: int) -> None:
        try:
            if callback is not None:
                callback("play", done, total, task.name)
        except KeyboardInterrupt:
            raise _Stopped from None

    seen, went = [_seen(made.start)], None

    def keep(world: episode.EpisodeState) -> dict[str, Tensor]:
        seen.append(_seen(world))
        return {}

    with torch.no_grad(), contextlib.suppress(_Stopped):
        went = episode.play(task, actions[None], episode=made, keep=keep, callback=told)
    return _frames(task, made, seen, arms=arms, interrupted=went is None), went


def stills(made: episode.Episode, worlds: Sequence[episode.EpisodeState], *, arms: bool = True) -> Frames:
    """Return moments of an episode of one scene as frames."""
    return _frames(made.task, made, [_seen(world) for world in worlds], arms=arms)


def _frames(
    task: Task, made: episode.Episode, seen: list[dict[str, Tensor]], *, arms: bool, interrupted: bool = False
) -> Frames:
    kept = {name: torch.cat([frame[name] for frame in seen]) for name in seen[0]}
    joints = kept.pop("joints")
    looks: dict[str, Any] = appearance(made.scene, made.params, surfaces(made.scene, made.params))
    moving: dict[str, Any] = {name: value.numpy() for name, value in kept.items()}
    if arms:
        shapes, pos, quat = _links(task, joints)
        moving["body_pos"] = np.concatenate([moving["body_pos"], pos], 1)
        moving["body_quat"] = np.concatenate([moving["body_quat"], quat], 1)
        looks = looks | {name: np.concatenate([looks[name], value]) for name, value in shapes.items()}
    return Frames(**moving, **looks, camera_direction=_look(task, made.start), interrupted=interrupted)


def _look(task: Task, start: episode.EpisodeState) -> np.ndarray:
    """Return the direction to a camera that faces the arms, so that they do not stand before what they do."""
    way = start.tool.pos[0, :, :2].double().numpy() - np.array(task.arms.base)[:, :2]
    ahead = way.mean(0)
    if np.linalg.norm(ahead) < 0.5 * np.linalg.norm(way, axis=1).mean():
        # They reach from two sides: look from the third.
        side = np.array([way[0, 1], -way[0, 0]])
        ahead = side if side @ ahead >= 0 else -side
    x, y = ahead / np.linalg.norm(ahead)
    cos, sin = np.cos(_ASIDE), np.sin(_ASIDE)
    return np.array([cos * x - sin * y, sin * x + cos * y, _STEEP])


def outcome_of(went: episode.EpisodeResult | None) -> dict[str, Any]:
    """Return what an episode of one scene came to, as plain data; None stands for one that was interrupted."""
    if went is None:
        return dict.fromkeys(("return", "success", "failed", "missed", "rewards")) | {"interrupted": True}
    return {
        "return": float(went.returns[0]),
        "success": bool(went.success[0]),
        "failed": bool(went.failed[0]),
        "missed": step_diagnostics.explain_diagnostics(went.world.state.diagnostics),
        "rewards": went.rewards[:, 0].tolist(),
        "interrupted": False,
    }


def _seen(world: episode.EpisodeState) -> dict[str, Tensor]:
    """Return what moves, by the names of `Frames`, and the joints of the arms."""
    state, batch = world.state, len(world.failed)
    none = state.rods.pos.new_zeros(batch, 0, 4)
    return {
        "time": state.time.expand(batch, 1, 1)[:, 0, 0],
        "pos": state.rods.pos,
        "twist": state.rods.twist.expand(batch, *state.rods.twist.shape[-2:])[..., 0],
        "force": state.reaction.force,
        "body_pos": state.bodies.pos if state.bodies else none[..., :3],
        "body_quat": state.bodies.quat if state.bodies else none,
        "material_points": state.material_points.pos.to(torch.float32) if state.material_points else none[..., :3],
        "joints": world.joints,
    }


def _links(task: Task, joints: Tensor) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]:
    """Return shapes of the links of all arms, and where they are, (F, K, 3) and (F, K, 4); joints are (F, R, J)."""
    robot = robots.panda()
    at = robots.body_targets(robot, joints)
    pos = at.pos + joints.new_tensor(task.arms.base)[:, None]
    size = np.zeros((len(robot.shapes), 3))
    for row, shape in zip(size, robot.shapes, strict=True):
        row[: len(shape.size)] = shape.size
    many = joints.shape[1]
    shapes = {
        "body_shape": np.tile([s.kind for s in robot.shapes], many),
        "body_size": np.tile(size, (many, 1)),
        "body_motion": np.repeat("robot", many * len(size)),
    }
    return shapes, pos.flatten(1, 2).numpy(), at.quat.flatten(1, 2).numpy()


def surfaces(scene: Scene, params: Params) -> dict[int, tuple[Tensor, Tensor]]:
    """Return triangles where the distance to bodies that are sampled on grids is zero, by the number of the body."""
    found: dict[int, tuple[Tensor, Tensor]] = {}
    for k, body in enumerate(scene.bodies):
        if body.shape != "mesh":
            continue
        counts = [n + 1 for n in body.cells]
        nodes = counts[0] * counts[1] * counts[2]
        solid = tree.part(params.bodies)
        grid = solid.grid.reshape(-1, *solid.grid.shape[-2:])[0, k, :nodes]
        half = solid.size.reshape(-1, len(scene.bodies), 3)[0, k].double().numpy()
        image = _renderer().ImageData(dimensions=counts, spacing=2 * half / body.cells, origin=-half)
        # Along x first, here along z first.
        image["distance"] = grid.reshape(counts).double().numpy().flatten(order="F")
        # Its triangles look to where values grow less: inwards.
        mesh = image.contour([0.0], scalars="distance")
        found[k] = (
            torch.as_tensor(np.array(mesh.points, float)),
            torch.as_tensor(np.array(mesh.regular_faces[:, ::-1], int)),
        )
    return found


def _renderer() -> Any:
    try:
        import pyvista
    except ImportError:
        raise InputError(
            "bodies of this task need the package pyvista; install it with pip install 'torchdlo[view]'."
        ) from None
    return pyvista
