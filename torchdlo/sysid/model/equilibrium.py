"""Starts at rest: the balance of a rope whose grippers stand still, and how far a trial's start is from it."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import torch

from torchdlo import scene as scenes
from torchdlo.physics import tree
from torchdlo.sysid.model.cached_steps import recorded_step
from torchdlo.sysid.model.discretisation import Mesh

_SETTLING = 4.0
"""Time that a rope gets to come to rest where a trial starts [s]."""

_SETTLING_STEP = 0.1
"""One step meanwhile [s]: implicit steps this long are nearly steps of Newton's method for the balance."""

_LYING_STEP, _LYING = 0.005, 0.6
"""One step where a table carries the rope, off which long steps would bounce, and how long it takes to rest [s]."""

_SETTLING_RATE = 6.0
"""Damping rate meanwhile [1/s]: a rope of a metre swings at 4 rad/s."""

_SHAPES = 4
"""Smooth shapes by which a rope may be off its balance at the start."""


def come_to_rest(
    scene: scenes.Scene, params: scenes.Params, state: scenes.State, control: scenes.Control
) -> scenes.State:
    """Return the state in balance, with the grippers as they are at the start.

    Args:
        scene: the ropes.
        params: numbers of the scenes; their damping is raised meanwhile.
        state: where they are.
        control: where the grippers stay.
    """
    calm, calmed, count = resting_scene(scene, params)
    rest = tree.replace(state, rods=tree.replace(state.rods, vel=torch.zeros_like(state.rods.vel)))
    step = recorded_step(calm, calmed, rest, control)
    # Always as often: what small changes of numbers do to the balance is far below any speed that looks like rest.
    for _ in range(count):
        rest = step(calmed, rest, control)
    return stopped(rest, state)


def resting_scene(scene: scenes.Scene, params: scenes.Params) -> tuple[scenes.Scene, scenes.Params, int]:
    """Return the scene and its numbers while ropes come to rest, and how many steps that takes."""
    table = any(effect.name == "table" for effect in scene.effects)
    length, lasts = (_LYING_STEP, _LYING) if table else (_SETTLING_STEP, _SETTLING)
    calm = dataclasses.replace(scene, dt=length, substeps=1, numerical_damping=1.0)
    damping = dict(params.effects["damping"])
    damping["rate"] = torch.full_like(damping["rate"], _SETTLING_RATE)
    return calm, tree.replace(params, effects=params.effects | {"damping": damping}), math.ceil(lasts / length)


def stopped(rest: scenes.State, state: scenes.State) -> scenes.State:
    """Return a state that has come to rest, without what is left of its motion, at the time of another one."""
    zero = {name: torch.zeros_like(getattr(rest.rods, name)) for name in ("vel", "twist_rate")}
    return tree.replace(rest, rods=tree.replace(rest.rods, **zero), time=state.time)


def smooth_shapes(mesh: Mesh, free: np.ndarray) -> np.ndarray | None:
    """Return smooth shapes that vanish where the rope is held, at the vertices, shape (V, J).

    Args:
        mesh: the rope.
        free: markers that are not gripped.

    Returns:
        The shapes, orthonormal at the free markers; None where those are too few.
    """
    if len(free) < 2 * _SHAPES:
        return None
    x = mesh.arclength / mesh.arclength[-1]
    held, ends = x[list(mesh.held)], x[mesh.marker_vertex[free[[0, -1]]]]
    edge = np.ones_like(x)
    before, after = held[held < ends[0]], held[held > ends[1]]
    # A clamp keeps place and direction, a single gripped marker its place.
    for side, wall in ((before, before.max(initial=0.0)), (after, after.min(initial=1.0))):
        edge = edge * np.abs(x - wall) ** min(2, len(side))
    edge[list(mesh.held)] = 0.0
    shapes = edge[:, None] * np.vander(2 * x - 1, _SHAPES, increasing=True)
    return shapes @ np.linalg.inv(np.linalg.qr(shapes[mesh.marker_vertex[free]])[1])


def explain_gap(gap: np.ndarray, at: np.ndarray, dt: float, shapes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a displacement [m] and a velocity [m/s] of the vertices, (B, V, 3) each, that explain a gap best.

    Args:
        gap: measured minus simulated positions of markers, NaN where not seen [m], shape (B, F, M, 3).
        at: shapes at the markers, shape (M, J).
        dt: time between frames [s].
        shapes: shapes at the vertices, shape (V, J).
    """
    batch, frames, markers, _ = gap.shape
    time = np.arange(frames) * dt
    columns = np.concatenate([np.ones((frames, 1, 1)) * at, time[:, None, None] * at], -1).reshape(frames * markers, -1)
    found = np.zeros((batch, columns.shape[1], 3))
    for k, each in enumerate(gap.reshape(batch, -1, 3)):
        seen = np.isfinite(each).all(-1)
        if seen.sum() >= 2 * columns.shape[1]:
            found[k] = np.linalg.lstsq(columns[seen], each[seen], rcond=None)[0]
    shift, drift = np.split(found, 2, axis=1)
    return shapes @ shift, shapes @ drift
