"""What there is to see in a simulated scene, and where: ropes, bodies, particles, tables, and arms by their joints."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from torchdlo.coupling.bodies.dynamics import Body
from torchdlo.coupling.common.pose import Pose
from torchdlo.coupling.robot import robot_kinematics as robots
from torchdlo.coupling.robot.robot_kinematics import Robot
from torchdlo.physics import tree
from torchdlo.scene import Params, Scene, State
from torchdlo.vision.arm_surfaces import link_surfaces
from torchdlo.vision.renderer import ARM, BODY, TABLE, Piece, Placement, RenderModel
from torchdlo.vision.surfaces import Surface, isosurface, plate, solid

__all__ = ["arm_frame", "matrices", "model_of", "placement_of"]

THICK = 0.04
"""How thick table tops are [m]."""


def model_of(
    scene: Scene,
    params: Params,
    *,
    arms: Sequence[Robot] = (),
    low: tuple[float, float] = (-0.8, -0.8),
    high: tuple[float, float] = (0.8, 0.8),
    spacing: float = 0.015,
) -> RenderModel:
    """Return what there is to see in a scene; of a batch, what its first scene has.

    Frames are the world, the bodies, then the links of all arms.

    Args:
        scene: the scene.
        params: its parameters.
        arms: robots that stand in it, apart from its bodies.
        low: the corner of tables and planes with the least x and y [m].
        high: the other corner [m].
        spacing: how far corners of the shells of arms are apart [m].
    """
    pieces, top = [], math.inf
    for name, value in params.effects.items():
        if name == "table":
            top = float(value["height"].reshape(-1)[0])
            pieces.append(Piece(plate(low, high, top, THICK), TABLE, "table", shadow=False))
    size = (
        tree.part(params.bodies).size.reshape(-1, len(scene.bodies), 3)[0].double().cpu().numpy()
        if scene.bodies
        else ()
    )
    for k, body in enumerate(scene.bodies):
        if body.shape == "plane":
            pieces.append(Piece(plate(low, high, 0.0, THICK), TABLE, "table", frame=1 + k, shadow=False))
            continue
        surface = _sampled(body, params, k, size[k]) if body.shape == "mesh" else solid(body.shape, size[k])
        pieces.append(Piece(surface, BODY + k, "bodies", number=k, frame=1 + k))
    start = 1 + len(scene.bodies)
    for number, robot in enumerate(arms):
        for part in link_surfaces(robot, spacing):
            frame = start + robot.links.index(part.link)
            pieces.append(Piece(part.surface, ARM + number, f"{part.part}s", frame=frame))
        start += len(robot.links)
    counts, closed = scene.topology.counts, tuple(bool(c) for c in scene.topology.closed)
    radius = params.rods.material.radius
    edges = radius.reshape(-1, *radius.shape[-2:])[0, :, 0].double().cpu().numpy()
    groups = scene.material_points.groups if scene.material_points else ()
    return RenderModel(
        tuple(pieces),
        counts,
        closed,
        _at_vertices(np.broadcast_to(edges, sum(counts)), counts, closed),
        np.full(sum(g.count for g in groups), 0.0) if not groups else _ball_radii(scene, params),
        np.repeat(np.arange(len(groups)), [g.count for g in groups]),
    )


def _sampled(body: Body, params: Params, k: int, half: np.ndarray) -> Surface:
    """Return the surface of a body from its grid of distances."""
    counts = [n + 1 for n in body.cells]
    solid = tree.part(params.bodies)
    grid = solid.grid.reshape(-1, *solid.grid.shape[-2:])[0, k, : math.prod(counts)]
    values = grid.reshape(counts).double().cpu().numpy()
    return isosurface(values, -half, 2 * half / np.array(body.cells))


def _at_vertices(edges: np.ndarray, counts: Sequence[int], closed: Sequence[bool]) -> np.ndarray:
    """Return radii at vertices from those of the edges after them."""
    found, start = np.array(edges, float), 0
    for count, loop in zip(counts, closed, strict=True):
        own = np.array(edges[start : start + count], float)
        if not loop and count > 1:
            own[-1] = own[-2]
        before = np.roll(own, 1)
        if not loop:
            before[0] = own[0]
        found[start : start + count] = 0.5 * (own + before)
        start += count
    return found


def _ball_radii(scene: Scene, params: Params) -> np.ndarray:
    """Return radii of balls of the particles' volumes [m], larger so that they close."""
    own = tree.part(params.material_points).volume
    volume = own.reshape(-1, own.shape[-2])[0].double().cpu().numpy()
    return 0.62 * 1.6 * np.cbrt(volume)


def arm_frame(scene: Scene, arms: Sequence[Robot], arm: int, link: str) -> int:
    """Return the number of the frame of a link."""
    before = sum(len(r.links) for r in arms[:arm])
    return 1 + len(scene.bodies) + before + arms[arm].links.index(link)


def placement_of(
    state: State, *, arms: Sequence[Robot] = (), joints: Tensor | None = None, bases: Tensor | None = None
) -> Placement:
    """Return where everything is.

    Args:
        state: the state of a batch of scenes.
        arms: the robots of `model_of`.
        joints: their joint positions [rad or m], shape (B, R, J).
        bases: by how much each robot is moved from where it says that it stands [m], shape (R, 3).
    """
    x = state.rods.pos
    x = x.reshape(-1, *x.shape[-2:])
    none = x.new_zeros(len(x), 0, 3)
    pos, quat = [x.new_zeros(len(x), 1, 3)], [x.new_tensor([1.0, 0.0, 0.0, 0.0]).expand(len(x), 1, 4)]
    if state.bodies:
        pos.append(state.bodies.pos.expand(len(x), *state.bodies.pos.shape[-2:]))
        quat.append(state.bodies.quat.expand(len(x), *state.bodies.quat.shape[-2:]))
    for k, robot in enumerate(arms):
        links: Pose = robots.poses(robot, tree.part(joints)[:, k].to(x))
        pos.append(links.pos + (0.0 if bases is None else bases[k].to(x)))
        quat.append(links.quat)
    at = torch.cat(pos, 1)
    return Placement(
        at,
        matrices(torch.cat(quat, 1)),
        x,
        state.material_points.pos.expand(len(x), -1, -1) if state.material_points else none,
    )


def matrices(quat: Tensor) -> Tensor:
    """Return the rotation matrices of quaternions (w, x, y, z), shapes (..., 4) to (..., 3, 3)."""
    w, x, y, z = quat.unbind(-1)
    rows = [
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)
