"""What can be wrong with a rope that somebody describes, each in one sentence."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, SupportsFloat

import torch
from torch import Tensor

from torchdlo.physics import tree

if TYPE_CHECKING:
    from torchdlo.physics.effects.base import Effect
    from torchdlo.physics.rod.assembly import Rope
    from torchdlo.physics.rod.topology import Topology

_ZERO_ALLOWED = ("youngs", "shear", "bend", "bend2", "twist")
NUMBERS = ("radius", "mass", "density", "stretch", "rest_twist", *_ZERO_ALLOWED)
"""Fields of a rope that are numbers."""


def check_sequence(given: object, kind: type, what: str) -> None:
    """Raise a `ValueError` if something is not a sequence of things of a kind."""
    wanted = f"expected a list of {what}"
    if not isinstance(given, Sequence) or isinstance(given, str):
        raise ValueError(f"scene: {_called(given)} is given; {wanted}")
    for k, each in enumerate(given):
        if not isinstance(each, kind):
            raise ValueError(f"scene: {_called(each)} is at place {k} of a list; {wanted}")


def _called(given: object) -> str:
    return f"the class {given.__name__} (without brackets?)" if isinstance(given, type) else f"a {type(given).__name__}"


def check_rope(index: int, rope: Rope) -> None:
    """Raise a `ValueError` for what is wrong with one rope."""
    where = f"rope {index}"
    _positions(where, rope)
    if (rope.mass is None) == (rope.density is None):
        raise ValueError(f"{where}: give either mass [kg] or density [kg/m^3], exactly one of them")
    for one, other in (("youngs", "bend"), ("shear", "twist")):
        if getattr(rope, one) is not None and getattr(rope, other) is not None:
            raise ValueError(f"{where}: both {one} and {other} are given, but each sets the other; give one of them")
    for name in NUMBERS:
        if getattr(rope, name) is not None:
            _number(where, name, getattr(rope, name), rope.positions)
    if rope.velocities is not None:
        _vectors(where, "velocities", rope.velocities, rope.positions)
    if isinstance(rope.rest, Tensor):
        _vectors(where, "rest", rope.rest, rope.positions)
    elif rope.rest not in ("straight", "as_placed"):
        raise ValueError(f"{where}: rest is {rope.rest!r}; expected 'straight', 'as_placed' or vertex positions")
    for name, shape in (("director", rope.positions), ("rest_director", rope.rest)):
        if getattr(rope, name) is not None:
            _across(where, name, getattr(rope, name), shape if isinstance(shape, Tensor) else rope.positions)


def check_ropes(ropes: Sequence[Rope]) -> None:
    """Raise a `ValueError` for ropes that do not fit into one scene."""
    batches = [tuple(r.positions.shape[:-2]) for r in ropes]
    try:
        torch.broadcast_shapes(*batches)
    except RuntimeError:
        raise ValueError(f"ropes have batch shapes {batches}; expected equal ones, one per scene") from None


def _positions(where: str, rope: Rope) -> None:
    x = rope.positions
    if not isinstance(x, Tensor) or x.dim() < 2 or x.shape[-1] != 3 or not x.is_floating_point():
        given = tuple(x.shape) if isinstance(x, Tensor) else type(x).__name__
        raise ValueError(f"{where}: positions are {given}; expected a float tensor (..., n, 3) in metres")
    if x.dtype not in (torch.float32, torch.float64):
        raise ValueError(f"{where}: positions are {x.dtype}; expected torch.float32 or torch.float64")
    if x.shape[-2] < 3:
        raise ValueError(f"{where}: {x.shape[-2]} vertices given; a rope needs at least 3")
    x = x.detach()
    if not bool(torch.isfinite(x).all()):
        raise ValueError(f"{where}: positions contain NaN or infinity; every coordinate must be a number")
    short = _steps(x, rope.closed)
    if x.numel() and float(short.min()) < 1e-9:
        at = int((short < 1e-9).nonzero()[0, -1])
        raise ValueError(f"{where}: vertices {at} and {(at + 1) % x.shape[-2]} coincide; neighbours must be apart")


def _steps(x: Tensor, closed: bool) -> Tensor:
    steps = torch.roll(x, -1, -2) - x if closed else x[..., 1:, :] - x[..., :-1, :]
    return steps.norm(dim=-1)


def _across(where: str, name: str, value: Tensor, positions: Tensor) -> None:
    if not isinstance(value, Tensor) or value.shape[-1:] != (3,):
        given = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
        raise ValueError(f"{where}: {name} is {given}; expected a tensor (..., 3)")
    edge = positions[..., 1, :] - positions[..., 0, :]
    across = torch.linalg.cross(*torch.broadcast_tensors(edge, value.to(edge)), dim=-1).norm(dim=-1)
    if not bool((across > 1e-6 * edge.norm(dim=-1) * value.norm(dim=-1)).all()):
        raise ValueError(f"{where}: {name} points along the first edge; expected a direction across it")


def _number(where: str, name: str, value: float | Tensor, positions: Tensor) -> None:
    count, batch = positions.shape[-2], tuple(positions.shape[:-2])
    if isinstance(value, Tensor):
        shape = tuple(value.shape)
        per_vertex = shape[-1:] in ((1,), (count,))
        per_scene = bool(batch) and shape == batch[-len(shape) :]
        if shape and not per_vertex and not per_scene:
            raise ValueError(
                f"{where}: {name} is {shape}; expected one number, (..., {count}) along the rope, or {batch} per scene"
            )
        if per_vertex and per_scene and count > 1 and shape == (count,):
            raise ValueError(
                f"{where}: {name} is {shape}, along the rope or per scene? Give (1, {count}) or ({count}, 1)"
            )
        value = value.detach()
        least, most, finite = float(value.min()), float(value.max()), bool((value == value).all())
    else:
        if not isinstance(value, SupportsFloat):
            raise ValueError(f"{where}: {name} is {value!r}; expected a number or a tensor")
        least = most = float(value)
        finite = value == value
    if name == "rest_twist":
        ok, wanted = finite and abs(most) < float("inf") and abs(least) < float("inf"), "finite"
    else:
        limit = float("inf") if name == "stretch" else 1e300
        ok = finite and (least > 0 or (least == 0 and name in _ZERO_ALLOWED)) and most <= limit
        wanted = (
            "finite and at least 0"
            if name in _ZERO_ALLOWED
            else "positive"
            if name == "stretch"
            else "finite and positive"
        )
    if not ok:
        raise ValueError(f"{where}: {name} is {least if not least > 0 or not finite else most:g}; it must be {wanted}")


def _vectors(where: str, name: str, value: Tensor, positions: Tensor) -> None:
    if value.dim() < 2 or value.shape[-2:] != positions.shape[-2:]:
        wanted = tuple(positions.shape[-2:])
        raise ValueError(
            f"{where}: {name} is {tuple(value.shape)}; expected (..., {wanted[0]}, {wanted[1]}) as positions"
        )
    if not bool(torch.isfinite(value).all()):
        raise ValueError(f"{where}: {name} contains NaN or infinity; every component must be a number")


def check_solved_together(names: Sequence[str], topology: Topology) -> None:
    """Raise a `ValueError` if contact cannot be solved together with edge lengths.

    Args:
        names: of the effects.
        topology: of the ropes.
    """
    if {"rod_contact", "self_contact"} <= set(names):
        raise ValueError(
            "scene: effects have rod_contact and self_contact, which are not solved together; leave self_contact out, "
            "as rod_contact keeps ropes apart from themselves, too"
        )
    loops = [n for n, c in zip(topology.counts, topology.closed, strict=True) if c and n < 5]
    if loops:
        raise ValueError(f"scene: a closed rope has {loops[:1]} vertices; implicit and coupled steps need at least 5")


def with_contact(
    choices: dict[str, Any], effects: Sequence[Effect], topology: Topology, dtype: torch.dtype | None, bounces: bool
) -> dict[str, Any]:
    """Return choices of a scene with how explicit steps had best find contact, if that is "auto".

    "coupled" where ropes touch bodies, as sweeps are wrong about friction of taut ropes; not in single precision, where
    forces of one solve are rounding at substeps below 1 ms, nor where things rebound, as such contact brakes them
    before, nor where `check_solved_together` would refuse.

    Args:
        choices: fields of `Scene`.
        effects: what acts.
        topology: of the ropes.
        dtype: of all numbers, or None if there are material points, which need contact before their own.
        bounces: whether there is restitution.
    """
    if choices.get("contact") != "auto":
        return choices
    names = [e.name for e in effects]
    explicit = choices.get("integrator", "explicit") == "explicit" and choices.get("constrained", True)
    touch = "rod_body" in names and explicit and dtype == torch.float64 and not bounces
    if touch:
        try:
            check_solved_together(names, topology)
        except ValueError:
            touch = False
    return choices | {"contact": "coupled" if touch else "sweeps"}


def check_control_batch(known: object, own: Sequence[int], control: object) -> None:
    """Raise a `ValueError` if controls are of more scenes than what is controlled.

    Args:
        known: parameters and state, whose tensors are all (..., n, d).
        own: batch of the ropes.
        control: where held parts, grips and bodies go, likewise.
    """
    given = [tuple(x.shape[:-2]) for x in tree.leaves(control) if x.dim() < 2 or x.shape[-2]]
    if all(batch in ((), tuple(own)) for batch in given):
        return
    try:
        batch = torch.broadcast_shapes(*(x.shape[:-2] for x in tree.leaves(known)))
        fits = torch.broadcast_shapes(batch, *given) == batch
    except RuntimeError:
        fits = False
    if not fits:
        said = " and ".join(map(str, sorted(set(given))))
        raise ValueError(
            f"control: its poses are of batches {said}, the state is of {tuple(own)}; give the controls of one scene, "
            "or make the scene with as many ropes (..., n, 3)."
        )
