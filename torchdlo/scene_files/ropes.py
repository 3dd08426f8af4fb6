"""From what a scene file says of ropes to `scene.Rope`, what hangs and pulls on them, and how they are twisted."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from torchdlo import scene as scenes
from torchdlo.errors import InputError
from torchdlo.physics import tree
from torchdlo.physics.effects.point_forces import PointForce, PointForces
from torchdlo.physics.rod.kinematics import hinge_length
from torchdlo.scene_files.held_parts import numbered
from torchdlo.scene_files.rope_models import Modelled
from torchdlo.scene_files.schema import RopeSpec, SceneDescription

__all__ = ["hanging_masses", "pulling", "rope_of", "twisted"]

_OWN = ("points", "vertices", "model", "hanging_masses", "point_forces", "initial_twist")
"""Entries of a rope that are not fields of `scene.Rope`."""


def rope_of(rope: RopeSpec, k: int, dtype: torch.dtype, modelled: Modelled | None = None) -> scenes.Rope:
    """Return the rope that a scene file describes.

    Args:
        rope: what it says.
        k: number of the rope.
        dtype: type of its tensors.
        modelled: natural shape of the model that it has.
    """
    points = torch.tensor(rope.points, dtype=torch.float64).reshape(-1, 3)
    if rope.vertices is not None:
        points = _resampled(points, rope, rope.vertices)
    given = {n: v for n, v in vars(rope).items() if n not in _OWN and v is not None}
    for name, value in given.items():
        if isinstance(value, tuple):
            given[name] = _tensor(value, name, f"ropes[{k}].{name}", len(points)).to(dtype)
    if modelled is not None:
        given.setdefault("rest_curvature", modelled.curvature(len(points)).to(dtype))
        # The calibrated roll is measured from the normal that points up.
        level = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
        first = points[1] - points[0]
        steep = float(first[:2].norm()) < 1e-3 * float(first.norm())
        given.setdefault("director", (torch.tensor([1.0, 0.0, 0.0]) if steep else level).to(dtype))
    return scenes.Rope(points.to(dtype), **given)


def _tensor(value: tuple, name: str, place: str, count: int) -> Tensor:
    """Return a vector, or a list along the rope."""
    found = torch.tensor(value, dtype=torch.float64)
    if name in ("director", "rest_director"):
        return found
    for_all = ("velocities", "rest_curvature")
    if name in for_all and len(value) == 1:
        return found.expand(count, -1)
    if len(value) != count:
        one = "one for all vertices" if name in for_all else "positions" if name == "rest" else "one number"
        what = f"{one}, {count} of them," if name == "rest" else f"{one} or a list of {count},"
        raise InputError(f"{place}: expected {what} as the rope has {count} vertices, given {len(value)}.")
    return found


def _resampled(points: Tensor, rope: RopeSpec, vertices: int) -> Tensor:
    if len(points) < 2 or vertices < 3:
        raise InputError(f"rope: {len(points)} points and {vertices} vertices; expected at least 2 and 3.")
    line = torch.cat([points, points[:1]]) if rope.closed else points
    along = torch.cat([points.new_zeros(1), (line[1:] - line[:-1]).norm(dim=-1).cumsum(0)])
    count = vertices + rope.closed
    at = torch.linspace(0, 1, count, dtype=points.dtype)[:vertices] * along[-1]
    k = (torch.searchsorted(along, at, right=True) - 1).clamp(0, len(line) - 2)
    share = ((at - along[k]) / (along[k + 1] - along[k]).clamp(min=1e-30))[:, None]
    return line[k] + share * (line[k + 1] - line[k])


def hanging_masses(d: SceneDescription, counts: Sequence[int], like: Tensor) -> Tensor:
    """Return the masses that hang on vertices [kg], shape (V, 1); ropes have `counts` vertices."""
    found = like.new_zeros(sum(counts), 1)
    for k, rope in enumerate(d.ropes):
        for j, weight in enumerate(rope.hanging_masses):
            if weight.mass <= 0:
                raise InputError(f"ropes[{k}].hanging_masses[{j}].mass: expected more than 0, given {weight.mass:g}.")
            at = sum(counts[:k]) + numbered(weight.vertex, counts[k], f"ropes[{k}].hanging_masses[{j}].vertex")
            found[at] += weight.mass
    return found


def pulling(d: SceneDescription, counts: Sequence[int]) -> list[PointForces]:
    """Return the effect of all forces on vertices, none if there are none."""
    found = []
    for k, rope in enumerate(d.ropes):
        for j, pull in enumerate(rope.point_forces):
            here = f"ropes[{k}].point_forces[{j}]"
            if pull.since < 0:
                raise InputError(f"{here}.since: expected a time from 0 on, given {pull.since:g}.")
            until = math.inf if pull.until is None else pull.until
            if until < pull.since:
                raise InputError(f"{here}.until: expected a time from {pull.since:g} s on, given {until:g}.")
            at = sum(counts[:k]) + numbered(pull.vertex, counts[k], f"{here}.vertex")
            found.append(PointForce(at, pull.force, pull.since, until))
    return [PointForces(tuple(found))] if found else []


def twisted(d: SceneDescription, scene: scenes.Scene, params: scenes.Params, state: scenes.State) -> scenes.State:
    """Return the state with the twist that ropes have at the start."""
    topology, rest = scene.topology, params.rods.rest
    span = hinge_length(topology, rest) * rest.hinge_mask
    angle = torch.zeros_like(state.rods.twist)
    for k, (rope, start, count) in enumerate(zip(d.ropes, topology.starts, topology.counts, strict=True)):
        if rope.initial_twist is None:
            continue
        place = f"ropes[{k}].initial_twist"
        if rope.closed:
            raise InputError(f"{place}: a closed rope has none of its own; give rest_twist, of the opposite sign.")
        if d.twist == "none":
            raise InputError(f"{place}: twist is 'none', so that nothing twists; choose 'quasistatic' or 'dynamic'.")
        given = rope.initial_twist
        rate = _tensor(given if isinstance(given, tuple) else (given,) * count, "twist", place, count).to(angle)
        here = slice(start, start + count)
        turned = (rate[:, None] * span[..., here, :]).cumsum(-2)
        angle[..., here, :] = turned * rest.edge_mask[..., here, :]
    return tree.replace(state, rods=tree.replace(state.rods, twist=state.rods.twist + angle))
