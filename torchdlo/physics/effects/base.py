"""What an effect is: a frozen class that declares its numbers once and turns a view of the rods into loads."""

from __future__ import annotations

import math
from abc import ABC
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import torch
from torch import Tensor

from torchdlo.physics import tree
from torchdlo.physics.effects.effect_spec import RopeEffectSpec
from torchdlo.physics.rod.kinematics import RodParams, View
from torchdlo.physics.rod.topology import Topology

if TYPE_CHECKING:
    from torchdlo.physics.constraints.contact_penalty import Pairs, Touch
    from torchdlo.physics.effects.measurement import Track

EffectKind = Literal["force", "material", "boundary", "measurement"]
KINDS: tuple[EffectKind, ...] = ("force", "material", "boundary", "measurement")
"""What an effect can be: a load from outside, a law of the rope, of how it is held, or of how it is measured."""

Values = dict[str, Tensor]
"""Numbers of one effect by name, each (..., 1, C): shared along the rod; or its history, or its loads."""

LOADS = {
    "force": "Force on vertices [N], shape (..., V, 3).",
    "acceleration": "Acceleration of all masses [m/s^2], shape (..., 1, 3).",
    "gradient": "Derivative of an energy by the edge vectors [N], shape (..., V, 3).",
    "torque": "Torque on edges about their axis [N m], shape (..., V, 1).",
    "rate": "Rate at which all velocities decay [1/s], shape (..., 1, 1).",
    "twist_decay": "Rate at which twist rates decay [1/s], shape (..., 1, 1).",
    "stiffness": "Stiffness of vertices along the axes, for implicit steps [N/m], shape (..., V, 3).",
    "drag": "Resistance of vertices along the axes, for implicit steps [N s/m], shape (..., V, 3).",
    "hinge_stiffness": "Bending moment per turning of an edge, for implicit steps [N m], shape (..., V, 1).",
    "hinge_drag": "The same per rate of turning, for implicit steps [N m s], shape (..., V, 1).",
    "edge_stiffness": "Transverse stiffness that a pulled edge has [N/m], for implicit steps, shape (..., V, 1).",
    "turning_inertia": "Inertia of edges against turning beside that of their ends' masses, over a squared length; "
    "explicit steps, which divide by masses, leave it out [kg], shape (..., V, 1).",
    "twist_hessian": "Second derivatives of an energy by the twists (before, before), (before, after), (after, after) "
    "of each hinge, without their part that may be negative [N m], shape (..., V, 3).",
    "twist_geometry": "That part of (before, before) and (after, after) [N m], shape (..., V, 2).",
    "twist_skew": "For moments without an energy: by how much the slope (before, after) is above (after, before), "
    "halved [N m], shape (..., V, 1).",
}
"""What an effect may return. Those "for implicit steps" say how the loads answer to motion; they change the step, not
the equations that it solves, and explicit steps leave them out unless they are drags."""


@dataclass(frozen=True)
class Param:
    """One number of an effect, declared once for simulation, identification, randomisation and diagnosis."""

    default: float | tuple[float, ...]
    """Value in a scene that says nothing else."""
    low: float
    """Least sensible value."""
    high: float
    """Greatest sensible value."""
    unit: str
    """SI unit, "1" if it has none."""
    scale: Literal["log", "linear", "reciprocal"]
    """How it is searched: by factors, by differences, or by differences of one over it (a stiffness of springs in
    series, whose off value is a huge one that stands for infinity)."""
    off: float | None
    """Value at which the effect does nothing, None if this number does not switch it."""
    doc: str
    """What it is, in one sentence."""
    periodic: bool = False
    """Whether its least and its greatest value mean the same, as those of an angle may."""
    most: float = math.inf
    """Greatest value that can be, as of a share."""

    def coordinate(self, value: Tensor) -> Tensor:
        """Return what `scale` searches in place of the value."""
        if self.scale == "linear":
            return value
        return value.log() if self.scale == "log" else 1 / value

    def value(self, coordinate: Tensor) -> Tensor:
        """Return the value at a coordinate."""
        if self.scale == "linear":
            return coordinate
        return coordinate.exp() if self.scale == "log" else 1 / coordinate

    @property
    def size(self) -> int:
        """How many components it has."""
        return len(self.default) if isinstance(self.default, tuple) else 1

    @property
    def scalar(self) -> float:
        """The default of a parameter that has one component."""
        if isinstance(self.default, tuple):
            raise ValueError(f"parameter: its default {self.default} has several components; look at `default`.")
        return self.default


_HELD = 0.1
"""Share of its mobility with which a held vertex counts in `PredictedMotion.give`."""


@tree.struct
class PredictedMotion:
    """Where vertices would go in a substep."""

    change: Tensor
    """By how much they would move, with the tension of the last substep [m], shape (..., V, 3)."""
    mobility: Tensor
    """By how much a force moves a vertex along each axis if it is not held [m/N], shape (..., V, 3)."""
    answer: Tensor
    """The same, 0 if it is held [m/N], shape (..., V, 3)."""
    bodies: Any = None
    """Where rigid bodies would go, see `coupling.bodies.dynamics.PredictedBodyMotion`; None in a scene without."""
    material_points: Any = None
    """Where matter would go, see `coupling.mpm.rod_coupling_effect.PredictedParticles`; None in a scene without."""

    @property
    def give(self) -> Tensor:
        """By how much a force counts as moving a vertex where forces of contact are shared out [m/N], (..., V, 1).

        A point close to a held vertex can hardly be moved by the free end of its edge: all of an overlap would throw
        that end away. So held vertices count as heavy ones, though they stay where they are.
        """
        return torch.maximum(self.answer, _HELD * self.mobility).amax(-1, keepdim=True)


@tree.struct
class ContactForces:
    """What an effect exerts on rods and on rigid bodies."""

    force: Tensor
    """Force on vertices [N], shape (..., V or 1, 3)."""
    body_force: Tensor
    """Force on bodies [N], shape (..., K or 1, 3)."""
    body_torque: Tensor
    """Torque on bodies about their centres of mass [N m], shape (..., K or 1, 3)."""
    material_points: Any = ()
    """What is left of matter, see `coupling.mpm.rod_coupling_effect.TouchedParticles`; () if it is not touched."""
    unsolved: Any = ()
    """Share of the forces that an implicit substep left unbalanced [1], shape (..., 1, 1); () if none was looked at."""
    joints: Any = ()
    """What joints do, see `physics.constraints.joint_points.JointForces`; () if there are none."""

    def plus(self, other: ContactForces) -> ContactForces:
        """Return what both exert together; no more than one effect touches matter."""
        force, torque = self.force + other.force, self.body_torque + other.body_torque
        material_points = self.material_points if self.material_points != () else other.material_points
        unsolved = self.unsolved if self.unsolved != () else other.unsolved
        joints = self.joints if self.joints != () else other.joints
        return ContactForces(force, self.body_force + other.body_force, torque, material_points, unsolved, joints)


class Effect(ABC):
    """A force law, a law of the rods, of their grips or of their markers. Subclasses are frozen dataclasses and final.

    Effects that are combined add their loads; properties that several alter go from one to the next.
    """

    name: ClassVar[str]
    """Name in scenes, parameter trees and findings."""
    kind: ClassVar[EffectKind]
    """What it is, see `KINDS`."""
    equation: ClassVar[str] = ""
    """Its constitutive or other law as a formula to read, with the names of its numbers spelled out."""
    params: ClassVar[dict[str, Param]] = {}
    """Its numbers."""
    spec: ClassVar[RopeEffectSpec | None] = None
    """How a diagnosis looks for it; None if it does not."""
    frames: ClassVar[bool] = False
    """Whether it reads the material frames or exerts torques about the edges' axes."""
    frame_bending: ClassVar[bool] = False
    """Whether it changes what only `BendFrame` reads: natural curvature, or stiffness by direction."""
    is_quasistatic: ClassVar[bool] = False
    """Whether its torques take part in quasistatic twist."""
    memory: ClassVar[int] = 0
    """How many numbers per slot it remembers from substep to substep. They are 0 at the start."""
    is_contact: ClassVar[bool] = False
    """Whether it has `solve_contact`, and with it `broad_phase` and `capacity_overflow`."""
    engages: ClassVar[bool] = False
    """Whether it has `engage`, which takes the place of `solve_contact` in implicit steps."""
    rounds: int = 1
    """How often per substep it reacts, each time to the motion that the lengths of the edges leave."""
    last: ClassVar[bool] = False
    """Whether it alters or observes what the other effects have made, wherever it is listed."""

    def check(self, topology: Topology) -> None:
        """Raise a `ValueError` if its static choices do not fit the rods."""
        return

    def modify_material(self, topology: Topology, params: RodParams, values: Values) -> RodParams:
        """Return the rods' parameters as this effect changes them: rest shape, stiffness, mass."""
        return params

    def loads(self, view: View, values: Values) -> Values:
        """Return loads by name, see `LOADS`."""
        return {}

    def plastic_flow(self, view: View, values: Values) -> Tensor | None:
        """Return the change of `RodState.plastic` over the substep, shape (..., V, 2), if the effect causes one."""
        return None

    def update_memory(self, view: View, values: Values) -> Tensor:
        """Return what it remembers of the view, shape (..., V, memory); asked only if `memory` is not 0."""
        return view.state.memory[self.name]

    def observe(self, track: Track, values: Values) -> Tensor:
        """Return where markers are seen [m], shape (..., F, M, 3)."""
        return track.pos

    def broad_phase(self, view: View, carried: Tensor) -> Values:
        """Return what it looks up once per step and finds among its numbers in every substep of it.

        Args:
            view: the rods when the step begins; its dt is the whole step.
            carried: how far held vertices are moved in it [m], shape (..., H, 3).
        """
        return {}

    def capacity_overflow(self, pos: Tensor, values: Values) -> Tensor:
        """Return what the broad phase had no room for [1] and by how much it was outrun [m], shape (..., 1, 2)."""
        return pos.new_zeros(1, 2)

    def engage(self, view: View, motion: PredictedMotion, values: Values) -> Touch | Pairs:
        """Return the points on bodies, or the pairs of edges, that may touch in an implicit substep.

        Their forces are found with the lengths."""
        raise NotImplementedError

    def solve_contact(self, view: View, motion: PredictedMotion, values: Values) -> Tensor | ContactForces:
        """Return forces on vertices that answer to where they would go [N], shape (..., V, 3), or on bodies too."""
        return view.state.pos.new_zeros(1, 3)

    def backs(self, bodies: Any) -> bool:
        """Return whether it exerts on bodies alone, with `backing` and `backed`: implicit steps feel what is behind."""
        return False

    def backing(self, bodies: Any) -> ContactForces:
        """Return what it exerts on bodies that would go like that, a `PredictedBodyMotion`."""
        raise NotImplementedError

    def backed(self, bodies: Any, push: ContactForces) -> Any:
        """Return where bodies would go under what this effect exerts, and how it resists what moves them from there.

        Args:
            bodies: where they would go under what all others exert but `push`, a `PredictedBodyMotion`.
            push: what ropes exert, as far as it is known: that decides which contacts press and stick.
        """
        raise NotImplementedError


def _in_order(effects: Iterable[Effect]) -> list[Effect]:
    effects = list(effects)
    return [e for e in effects if not e.last] + [e for e in effects if e.last]


def default_values(effect: Effect | type[Effect], like: Tensor) -> Values:
    """Return an effect's declared defaults as (1, C) tensors."""
    return {
        name: like.new_tensor([p.default if isinstance(p.default, tuple) else (p.default,)])
        for name, p in effect.params.items()
    }


def parameters_of(
    effects: Iterable[Effect], values: dict[str, dict[str, float | Sequence[float] | Tensor]], like: Tensor
) -> dict[str, Values]:
    """Return the numbers of effects by their names: the given ones, and defaults for those that are not given.

    Args:
        effects: the effects.
        values: numbers that differ from their defaults.
        like: a tensor of the dtype and device that they get.
    """
    declared = {e.name: e for e in effects}
    numbers = {name: default_values(e, like) for name, e in declared.items()}
    for effect, given in values.items():
        if effect not in numbers:
            raise ValueError(
                f"scene: values are given for {effect!r}, which is not among its effects {sorted(numbers)}"
            )
        for name, value in given.items():
            if name not in numbers[effect]:
                raise ValueError(f"scene: {effect} has no number {name!r}; it has {sorted(numbers[effect])}")
            wanted = numbers[effect][name].shape[-1]
            number = value.to(like) if isinstance(value, Tensor) else like.new_tensor(value).reshape(1, -1)
            number = number.reshape(1, 1) if number.dim() == 0 else number
            if number.shape[-1] != wanted:
                raise ValueError(f"scene: {effect}.{name} has {number.shape[-1]} components; expected {wanted}")
            if number.dim() > 1 and number.shape[-2] != 1:
                raise ValueError(
                    f"scene: {effect}.{name} is {tuple(number.shape)}; expected (..., 1, {wanted}), one per scene: "
                    "the axis before the last counts vertices, along which it is shared"
                )
            if not bool(torch.isfinite(number).all()):
                raise ValueError(f"scene: {effect}.{name} is {number.flatten().tolist()[:3]}; expected finite numbers")
            if declared[effect].params[name].low >= 0 and bool((number < 0).any()):
                raise ValueError(f"scene: {effect}.{name} is {float(number.min()):g}; expected no negative number")
            most = declared[effect].params[name].most
            if bool((number > most).any()):
                raise ValueError(f"scene: {effect}.{name} is {float(number.max()):g}; expected at most {most:g}")
            numbers[effect][name] = number
    return numbers


def altered_params(
    effects: Iterable[Effect], topology: Topology, params: RodParams, values: dict[str, Values]
) -> RodParams:
    """Return the rods' parameters as all effects together change them."""
    for effect in _in_order(effects):
        params = effect.modify_material(topology, params, values.get(effect.name, {}))
    return params


def observed_markers(effects: Iterable[Effect], track: Track, values: dict[str, Values]) -> Tensor:
    """Return where markers are seen under all effects together [m], shape (..., F, M, 3)."""
    for effect in _in_order(effects):
        track = tree.replace(track, pos=effect.observe(track, values.get(effect.name, {})))
    return track.pos


def total_loads(effects: Iterable[Effect], view: View, params: dict[str, Values]) -> Values:
    """Return the sum of the loads of several effects."""
    loads: Values = {}
    for effect in effects:
        for name, load in effect.loads(view, params.get(effect.name, {})).items():
            loads[name] = loads[name] + load if name in loads else load
    return loads
