"""Rigid bodies: what they are, where they are, and how they move without contact.

Velocities live half a substep before poses, as those of the rods do (Stoermer-Verlet), so that an impulse between a
rod and a body changes both by the same amount of momentum. Free bodies turn as in `physics.linalg.free_rotation`. All
poses are of the centre of mass and of the principal axes; quaternions are (w, x, y, z), body to world.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from torchdlo.coupling.bodies import shape_sdf
from torchdlo.field_docs import with_field_docs
from torchdlo.physics import tree
from torchdlo.physics.effects.base import ContactForces
from torchdlo.physics.linalg.free_rotation import spin_freely
from torchdlo.physics.linalg.numerics import safe_norm
from torchdlo.physics.linalg.rotation import multiply
from torchdlo.physics.linalg.vector_components import axes, local, world

MOTIONS = ("free", "fixed", "kinematic")
"""How a body can move: by forces, not at all, or as `Control` says."""

Number = float | Sequence[float] | Tensor


@dataclass(frozen=True)
class Body:
    """The static side of a rigid body."""

    shape: str
    """A name of `shapes.SIZES`."""
    motion: str = "free"
    """One of `MOTIONS`."""
    name: str = ""
    """What it is called in messages."""
    cells: tuple[int, ...] = ()
    """For a mesh: cells of its grid in x, y and z."""
    balls: int = 0
    """For a mesh: how many balls stand for it in contact with other bodies."""


@tree.struct
class BodyParams:
    """Numbers of the bodies that one may learn. Mass and inertia do not follow the size: see `shapes.bulk`."""

    mass: Tensor
    """Mass [kg], shape (..., K, 1)."""
    inertia: Tensor
    """Principal moments of inertia [kg m^2], shape (..., K, 3)."""
    size: Tensor
    """Size as in `shapes.SIZES`, ones where a shape has fewer numbers [m or rad], shape (..., K, 3)."""
    mu_s: Tensor
    """Coefficient of static friction [1], shape (..., K, 1)."""
    mu_k: Tensor
    """Coefficient of sliding friction [1], shape (..., K, 1)."""
    restitution: Tensor
    """Speed of parting over speed of approach [1], shape (..., K, 1)."""
    damping: Tensor
    """Rate at which the velocities of a free body decay [1/s], shape (..., K, 1)."""
    grid: Tensor
    """Distances of meshes at the corners of their grids, z fastest, zeros behind the end [m], shape (..., K, n)."""
    balls: Tensor
    """Centres and radii of the balls of meshes, one after the other, zeros behind the end [m], shape (..., K, 4 P)."""


@tree.struct
class BodyState:
    """Where bodies are and how they move."""

    pos: Tensor
    """Centres of mass [m], shape (..., K, 3)."""
    quat: Tensor
    """Orientations, unit quaternions [1], shape (..., K, 4)."""
    vel: Tensor
    """Velocities half a substep before `pos` (at the start: with it) [m/s], shape (..., K, 3)."""
    omega: Tensor
    """Angular velocities in the world, of that time's angular momentum [rad/s], shape (..., K, 3)."""


@tree.struct
class BodyTargets:
    """Where kinematic bodies are at the end of a step, in their order."""

    pos: Tensor
    """Positions [m], shape (..., L, 3)."""
    quat: Tensor
    """Orientations, unit quaternions [1], shape (..., L, 4)."""


@dataclass(frozen=True)
class PredictedBodyMotion:
    """Where bodies are, and where they would go in a substep without contact."""

    bodies: tuple[Body, ...]
    params: BodyParams
    state: BodyState
    dt: float
    """Substep [s]."""
    change: Tensor
    """By how much they would move [m], shape (..., K, 3)."""
    turn: Tensor
    """By how much they would turn, as a rotation vector in the world [rad], shape (..., K, 3)."""
    mobility: Tensor
    """By how much a force moves them, 0 if they are not free [m/N], shape (..., K, 1)."""
    inverse_inertia: Tensor
    """By how much a torque turns them about their principal axes, 0 if not free [rad/(N m)], shape (..., K, 3)."""
    hold: Tensor | None = None
    """How what stands behind free bodies resists their motion from there [N/m, N m/rad], shape (..., F, 6, 6)."""

    def turned(self, torque: Tensor) -> Tensor:
        """Return by how much torques in the world turn the bodies [rad], shape (..., K, 3)."""
        if all(b.motion != "free" for b in self.bodies):
            return torch.zeros_like(torque)
        columns = axes(self.state.quat)
        inside = local(columns, torque.split(1, -1))
        return torch.cat(
            world(columns, [a * t for a, t in zip(self.inverse_inertia.split(1, -1), inside, strict=True)]), -1
        )

    def pushed(self, push: ContactForces) -> PredictedBodyMotion:
        """Return the motion under what contact exerts as well."""
        return dataclasses.replace(
            self,
            change=self.change + self.mobility * push.body_force,
            turn=self.turn + self.turned(push.body_torque),
        )

    def only(self, part: Sequence[int]) -> PredictedBodyMotion:
        """Return the motion of some of the bodies, by their numbers."""

        def cut(x: Tensor) -> Tensor:
            return torch.stack([x[..., k, :] for k in part], -2)

        names = ("params", "state", "change", "turn", "mobility", "inverse_inertia")
        parts = {name: tree.map(cut, getattr(self, name)) for name in names}
        return dataclasses.replace(self, bodies=tuple(self.bodies[k] for k in part), **parts)


@with_field_docs
@dataclass(frozen=True, eq=False)
class RigidBody:
    """One rigid body, as a person describes it. Numbers are floats, or tensors (...,) per scene."""

    shape: str
    """"plane", "sphere", "box", "capsule", "cylinder", "cone", "torus", "ring" or "mesh"; see `shapes.SIZES`."""
    size: Number = ()
    """Its size, a number or several as in `shapes.SIZES` [m or rad], shape (..., n)."""
    pos: Number = (0.0, 0.0, 0.0)
    """Centre of mass at the start [m], shape (..., 3)."""
    quat: Number = (1.0, 0.0, 0.0, 0.0)
    """Orientation of its principal axes at the start, (w, x, y, z) [1], shape (..., 4)."""
    vel: Number = (0.0, 0.0, 0.0)
    """Velocity at the start [m/s], shape (..., 3)."""
    omega: Number = (0.0, 0.0, 0.0)
    """Angular velocity at the start, in the world [rad/s], shape (..., 3)."""
    motion: Literal["free", "fixed", "kinematic"] = "free"
    """Whether it moves by forces, not at all, or as `Control.bodies` says."""
    density: float | Tensor | None = None
    """Density of a free body [kg/m^3]; or give `mass`."""
    mass: float | Tensor | None = None
    """Mass of a free body [kg]."""
    inertia: Number | None = None
    """Principal moments of inertia in place of those of a uniform solid [kg m^2], shape (..., 3)."""
    mu_s: float | Tensor = 0.3
    """Coefficient of static friction [1]."""
    mu_k: float | Tensor = 0.3
    """Coefficient of sliding friction [1]."""
    restitution: float | Tensor = 0.0
    """Speed of parting over speed of approach [1]."""
    damping: float | Tensor = 0.0
    """Rate at which its velocities decay [1/s]."""
    name: str = ""
    """What messages call it; "sphere 0" and the like if not given."""
    grid: Tensor | None = None
    """For a mesh: distances at the corners of a grid that is centred on the origin [m], shape (..., nx, ny, nz)."""
    balls: Tensor | None = None
    """For a mesh: centres and radii of balls within it that touch its surface [m], shape (..., P, 4)."""


def conjugate(quat: Tensor) -> Tensor:
    """Return the inverse of unit quaternions, shape (..., 4)."""
    return torch.cat([quat[..., :1], -quat[..., 1:]], -1)


def turn_by(vector: Tensor) -> Tensor:
    """Return the unit quaternion (..., 4) of a rotation vector (..., 3) [rad]."""
    half = 0.5 * safe_norm(vector)
    small = half < 1e-4
    share = torch.where(small, 0.5 - half.square() / 12, 0.5 * torch.sin(half) / torch.where(small, 1.0, half))
    return torch.cat([torch.cos(half), share * vector], -1)


def turn_between(start: Tensor, end: Tensor) -> Tensor:
    """Return the rotation vector in the world that leads from one unit quaternion to another the short way [rad]."""
    whole = multiply(end, conjugate(start))
    whole = torch.where(whole[..., :1] < 0, -whole, whole)
    sine = safe_norm(whole[..., 1:])
    small = sine < 1e-4
    # 2 asin(x) / x = 2 + x^2 / 3 + ...
    angle = 2 * torch.atan2(sine, whole[..., :1])
    return torch.where(small, 2 + sine.square() / 3, angle / torch.where(small, 1.0, sine)) * whole[..., 1:]


def _is(bodies: tuple[Body, ...], motion: str, like: Tensor) -> Tensor:
    """Return 1 for bodies that move like that, else 0, shape (K, 1)."""
    return like.new_tensor([[float(b.motion == motion)] for b in bodies])


def _kinematic(bodies: tuple[Body, ...]) -> list[int]:
    return [k for k, b in enumerate(bodies) if b.motion == "kinematic"]


def stationary_control(bodies: tuple[Body, ...], state: BodyState) -> BodyTargets:
    """Return the targets that keep kinematic bodies where they are."""
    slots = _kinematic(bodies)
    return BodyTargets(tree.take_vertices(state.pos, slots), tree.take_vertices(state.quat, slots))


def check_targets(bodies: tuple[Body, ...], targets: BodyTargets | tuple[()]) -> None:
    """Raise a `ValueError` if there is not one target for each kinematic body."""
    count = len(_kinematic(bodies))
    given = tuple(targets.pos.shape) if isinstance(targets, BodyTargets) else ()
    if bool(bodies) != bool(given) or (given and given[-2] != count):
        raise ValueError(
            f"control: bodies is {given or 'empty'}; expected poses of {count} kinematic bodies, as scene.hold gives "
            "them, or () in a scene without bodies"
        )


def between(start: BodyTargets, end: BodyTargets, share: Tensor) -> BodyTargets:
    """Return targets at a share of the way from one to the other, even in time."""
    turn = turn_between(start.quat, end.quat)
    return BodyTargets(start.pos + share * (end.pos - start.pos), multiply(turn_by(share * turn), start.quat))


def _spread(bodies: tuple[Body, ...], targets: Tensor, otherwise: Tensor) -> Tensor:
    """Return `otherwise` (..., K, C) with targets (..., L, C) put at the kinematic bodies."""
    slots = _kinematic(bodies)
    if not slots:
        return otherwise
    batch = torch.broadcast_shapes(targets.shape[:-2], otherwise.shape[:-2])
    targets, otherwise = (x.expand(*batch, *x.shape[-2:]) for x in (targets, otherwise))
    rows = [targets if b.motion == "kinematic" else otherwise for b in bodies]
    place = [slots.index(k) if b.motion == "kinematic" else k for k, b in enumerate(bodies)]
    return torch.cat([row[..., k : k + 1, :] for row, k in zip(rows, place, strict=True)], -2)


def predict_free_motion(
    bodies: tuple[Body, ...],
    params: BodyParams,
    state: BodyState,
    targets: BodyTargets,
    acceleration: Tensor | float,
    first: Tensor,
    dt: float,
) -> PredictedBodyMotion:
    """Return where bodies would go in a substep without contact.

    Args:
        bodies: static choices.
        params: their numbers.
        state: where they are.
        targets: where kinematic ones are at the end of the substep.
        acceleration: of free bodies [m/s^2], shape (..., 1, 3).
        first: 1 in the very first substep, else 0, shape (..., 1, 1).
        dt: substep [s].
    """
    half = torch.exp(-0.5 * dt * params.damping)
    free = _is(bodies, "free", state.pos)
    scale = free * dt * dt * half * (1 - 0.5 * first)
    change = free * dt * half * state.vel + scale * acceleration
    turn = free * dt * half * state.omega
    if _kinematic(bodies):
        change = _spread(bodies, targets.pos, state.pos + change) - state.pos
        turn = turn + _is(bodies, "kinematic", state.pos) * turn_between(
            state.quat, _spread(bodies, targets.quat, state.quat)
        )
    return PredictedBodyMotion(bodies, params, state, dt, change, turn, scale / params.mass, scale / params.inertia)


def advance_bodies(motion: PredictedBodyMotion, targets: BodyTargets, push: ContactForces) -> BodyState:
    """Advance bodies by a substep.

    Args:
        motion: what `predict_free_motion` returned.
        targets: where kinematic bodies are at the end of the substep.
        push: what contact exerts.
    """
    bodies, params, state, dt = motion.bodies, motion.params, motion.state, motion.dt
    half = torch.exp(-0.5 * dt * params.damping)
    free = _is(bodies, "free", state.pos)
    change = motion.change + motion.mobility * push.body_force
    omega = free * half * state.omega + motion.turned(push.body_torque) / dt
    quat = state.quat
    if any(b.motion == "free" for b in bodies):
        quat, omega = spin_freely(quat, params.inertia, omega, dt)
    pos = _spread(bodies, targets.pos, state.pos + change)
    quat = _spread(bodies, targets.quat, torch.where(free > 0, quat, state.quat))
    shared = 1 - free + free * half
    return BodyState(pos, quat, change / dt * shared, free * half * omega + (1 - free) * motion.turn / dt)


def place_bodies(solids: Sequence[RigidBody], like: Tensor) -> tuple[tuple[Body, ...], BodyParams, BodyState]:
    """Return the static side, the numbers and the state of bodies, of the dtype and device of `like`."""
    bodies, rows = [], []
    for k, solid in enumerate(solids):
        body, row = _described(solid, solid.name or f"{solid.shape} {k}", like)
        bodies.append(body)
        rows.append(row)
    names = [b.name for b in bodies]
    if len(set(names)) < len(names):
        raise ValueError(f"bodies: names {names} are not all different; rename one")
    for name in ("grid", "balls"):
        most = max(row[name].shape[-1] for row in rows)
        for row in rows:
            row[name] = torch.nn.functional.pad(row[name], (0, most - row[name].shape[-1]))
    packed = {}
    for name in rows[0]:
        batch = torch.broadcast_shapes(*(row[name].shape[:-1] for row in rows))
        packed[name] = tree.batch_innermost(torch.stack([r[name].expand(*batch, r[name].shape[-1]) for r in rows], -2))
    state = {name: packed.pop(name) for name in ("pos", "quat", "vel", "omega")}
    batch = torch.broadcast_shapes(*(x.shape[:-2] for x in state.values()))
    state = {name: tree.batch_innermost(x.expand(*batch, *x.shape[-2:]).clone()) for name, x in state.items()}
    return tuple(bodies), BodyParams(**packed), BodyState(**state)


def _of_a_solid(inertia: Tensor) -> bool:
    """Return whether no moment of inertia is more than the other two together."""
    most = inertia.amax(-1)
    return bool((2 * most - inertia.sum(-1) <= 1e-5 * most).all())


def _described(solid: RigidBody, name: str, like: Tensor) -> tuple[Body, dict[str, Tensor]]:
    """Return the static side of a solid and its numbers, shape (..., C) each."""

    def need(ok: bool, sentence: str) -> None:
        if not ok:
            raise ValueError(f"body {name!r}: {sentence}")

    def number(what: str, value: Number, width: int, least: float | None = None) -> Tensor:
        try:
            x = value.to(like) if isinstance(value, Tensor) else like.new_tensor(value)
        except (TypeError, ValueError, RuntimeError):
            raise ValueError(f"body {name!r}: {what} is {value!r}; expected numbers") from None
        per_scene = isinstance(value, Tensor) and width == 1 and x.shape[-1:] != (1,)
        x = x.unsqueeze(-1) if x.dim() == 0 or per_scene else x
        need(x.dim() > 0 and x.shape[-1] == width, f"{what} has shape {tuple(x.shape)}; expected (..., {width})")
        need(bool(torch.isfinite(x).all()), f"{what} is {x.tolist()}; expected finite numbers")
        need(least is None or bool((x > least).all()), f"{what} is {x.tolist()}; expected more than {least}")
        return x

    need(solid.shape in shape_sdf.SIZES, f"shape is {solid.shape!r}; expected one of {sorted(shape_sdf.SIZES)}")
    need(solid.motion in MOTIONS, f"motion is {solid.motion!r}; expected one of {MOTIONS}")
    free, words = solid.motion == "free", shape_sdf.SIZES[solid.shape]
    need(not free or solid.shape != "plane", "a plane has no mass; make it 'fixed' or 'kinematic'")
    size = number(f"size ({', '.join(words)})", solid.size, len(words), 0.0) if words else like.new_zeros(0)
    if solid.shape in ("torus", "ring"):
        need(bool((size[..., 1] < size[..., 0]).all()), f"size is {size.tolist()}; the tube is thicker than the circle")
    if solid.shape == "ring":
        need(bool((size[..., 2] <= 2 * torch.pi).all()), f"its angle is {size[..., 2].tolist()}; at most a whole turn")
    size = torch.nn.functional.pad(size, (0, 3 - len(words)), value=1.0)
    need((solid.grid is not None) == (solid.shape == "mesh"), "a mesh, and nothing else, needs a grid")
    row = {"size": size, "grid": like.new_zeros(0) if solid.grid is None else solid.grid.to(like).flatten(-3)}
    row["balls"] = like.new_zeros(0) if solid.balls is None else solid.balls.to(like).flatten(-2)
    row["mass"], row["inertia"] = like.new_ones(1), like.new_ones(3)
    if free:
        need((solid.mass is None) != (solid.density is None), "give a free body either mass or density")
        whole = solid.inertia is not None and solid.mass is not None
        volume, moments = (size[..., :1], size) if whole else shape_sdf.bulk(solid.shape, size)
        heavy = solid.density if solid.mass is None else solid.mass
        given = number("density or mass", 0.0 if heavy is None else heavy, 1, 0.0)
        row["mass"] = given if solid.mass is not None else given * volume
        own = solid.inertia
        row["inertia"] = row["mass"] * moments if own is None else number("inertia", own, 3, 0.0)
        need(_of_a_solid(row["inertia"]), f"inertia is {row['inertia'].tolist()}; none of a solid exceeds both others")
    for what, least in (("mu_s", None), ("mu_k", None), ("restitution", None), ("damping", None)):
        row[what] = number(what, getattr(solid, what), 1, least)
        need(bool((row[what] >= 0).all()), f"{what} is {row[what].tolist()}; expected 0 or more")
    gains = f"restitution is {row['restitution'].tolist()}; expected at most 1, beyond which it gains speed"
    need(bool((row["restitution"] <= 1).all()), gains)
    for what, width in (("pos", 3), ("quat", 4), ("vel", 3), ("omega", 3)):
        row[what] = number(what, getattr(solid, what), width)
    length = safe_norm(row["quat"])
    need(bool((length > 0).all()), "its quaternion is zero; expected one of length 1")
    row["quat"] = row["quat"] / length
    still = not bool((row["vel"] != 0).any() or (row["omega"] != 0).any())
    need(free or still, f"a {solid.motion} body starts with a velocity; only free bodies may")
    cells = tuple(n - 1 for n in solid.grid.shape[-3:]) if solid.grid is not None else ()
    return Body(solid.shape, solid.motion, name, cells, 0 if solid.balls is None else solid.balls.shape[-2]), row
