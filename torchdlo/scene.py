"""Scenes: ropes with effects, and the one function that moves them.

Four kinds of data are never mixed: `Scene` (static), `Params` (what one may learn), `State` (what evolves) and
`Control` (what one commands).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from torchdlo.physics import build, rod, rotation, tree
from torchdlo.physics.build import Rope
from torchdlo.physics.effect import Effect, Values
from torchdlo.physics.integrate import INTEGRATORS, TWISTS, Settings, Targets, settle_twist, substep
from torchdlo.physics.replay import rollout
from torchdlo.physics.rod import RodParams, RodState
from torchdlo.physics.topology import Topology


@tree.struct
class Params:
    """Numbers that stay the same along a rollout."""

    rods: RodParams
    effects: dict[str, dict[str, Tensor]]
    """Numbers of each effect by its name and theirs, shape (..., 1, C)."""


@tree.struct
class State:
    """What evolves."""

    rods: RodState
    time: Tensor
    """Time since the start [s], shape (..., 1, 1)."""


@tree.struct
class Control:
    """What held parts are told to do, at the end of a step."""

    pos: Tensor
    """Positions of the held vertices [m], shape (..., H, 3)."""
    director: Tensor
    """First material directors of the held edges [1], shape (..., G, 3)."""


@dataclass(frozen=True)
class Scene:
    """The static side of a simulation; hashable, without tensors."""

    topology: Topology
    effects: tuple[Effect, ...]
    dt: float = 1e-3
    """One step [s]."""
    substeps: int = 5
    """Substeps per step."""
    integrator: str = "explicit"
    """"explicit", or "implicit" for stiff cables at steps of 1-10 ms; see `physics.integrate`."""
    twist: str = "none"
    """"none", "dynamic" or "quasistatic"."""
    constrained: bool = True
    """Whether edge lengths are solved for; False leaves them to a `Stretch` effect."""
    held_vertices: tuple[int, ...] = ()
    held_edges: tuple[int, ...] = ()
    newton: int = 3
    """Newton steps for edge lengths per substep."""
    gamma: float = 0.3
    """Share of dt^2 times stiffness that counts as inertia in implicit steps."""
    ahead: float = 0.0
    """Share of a substep by which implicit steps look ahead: it damps fast modes and makes the step first order."""

    def __post_init__(self) -> None:
        def need(ok: bool, sentence: str) -> None:
            if not ok:
                raise ValueError(f"scene: {sentence}")

        need(self.integrator in INTEGRATORS, f"integrator is {self.integrator!r}; expected one of {INTEGRATORS}")
        need(self.twist in TWISTS, f"twist is {self.twist!r}; expected one of {TWISTS}")
        need(math.isfinite(self.dt) and self.dt > 0, f"dt is {self.dt}; expected a positive number of seconds")
        need(
            isinstance(self.substeps, int) and self.substeps >= 1,
            f"substeps is {self.substeps}; expected a whole number from 1 up",
        )
        need(self.newton >= 1, f"newton is {self.newton}; expected at least 1 step")
        need(self.gamma >= 0.25, f"gamma is {self.gamma}; below 0.25 implicit steps are not stable")
        need(0 <= self.ahead <= 1, f"ahead is {self.ahead}; expected a share of a substep, 0 to 1")
        size = self.topology.size
        for name, slots in (("held_vertices", self.held_vertices), ("held_edges", self.held_edges)):
            wrong = [s for s in slots if not 0 <= s < size]
            need(not wrong, f"{name} names {wrong}; the scene has slots 0 to {size - 1}")
            need(len(set(slots)) == len(slots), f"{name} {list(slots)} names a slot twice")
        seams = [s for s in self.held_edges if not self.topology.edge_mask()[s]]
        need(not seams, f"held_edges names {seams}, the gap between the ends of an open rope")
        need(
            not self.held_edges or self.twist != "none",
            "held_edges prescribe twist, but twist is 'none'; choose 'quasistatic' or 'dynamic'",
        )
        names = [e.name for e in self.effects]
        twice = {n for n in names if names.count(n) > 1}
        need(not twice, f"effects {sorted(twice)} are listed twice")
        need(
            self.integrator == "explicit" or self.constrained,
            "implicit steps solve for edge lengths; keep constrained=True and give the rope its stretch stiffness",
        )
        if self.integrator == "implicit":
            loops = [n for n, c in zip(self.topology.counts, self.topology.closed, strict=True) if c and n < 5]
            need(not loops, f"a closed rope has {loops[:1]} vertices; implicit steps need at least 5")
        need(
            self.twist != "quasistatic" or any(n == "twist" for n in names),
            "quasistatic twist needs the Twist effect; add it, or set twist='none'",
        )

    @property
    def settings(self) -> Settings:
        """What a substep needs to know."""
        return Settings(
            self.topology,
            self.effects,
            self.dt / self.substeps,
            self.integrator,
            self.twist,
            self.constrained,
            self.held_vertices,
            self.held_edges,
            self.newton,
            self.gamma,
            self.ahead,
        )


def default_values(effect: Effect | type[Effect], like: Tensor) -> Values:
    """Return an effect's declared defaults as (1, C) tensors."""
    return {
        name: like.new_tensor([p.default if isinstance(p.default, tuple) else (p.default,)])
        for name, p in effect.params.items()
    }


def make(
    ropes: Sequence[Rope],
    effects: Sequence[Effect],
    values: dict[str, dict[str, float | Sequence[float] | Tensor]] | None = None,
    *,
    check: bool = True,
    **choices,
) -> tuple[Scene, Params, State]:
    """Build a scene with its parameters and its initial state.

    Args:
        ropes: the ropes.
        effects: what acts on them.
        values: numbers of effects that differ from their defaults, e.g. {"damping": {"rate": 0.6}}.
        check: whether to refuse what could not be stepped: laws that do not fit the ropes, ropes far from their length,
            unstable substeps. Scenes whose loads are only evaluated may be anything.
        choices: fields of `Scene`.
    """
    topology, rods, state = build.assemble(ropes)
    scene = Scene(topology, tuple(effects), **choices)
    numbers = {e.name: default_values(e, state.pos) for e in effects}
    for effect, given in (values or {}).items():
        if effect not in numbers:
            raise ValueError(
                f"scene: values are given for {effect!r}, which is not among its effects {sorted(numbers)}"
            )
        for name, value in given.items():
            if name not in numbers[effect]:
                raise ValueError(f"scene: {effect} has no number {name!r}; it has {sorted(numbers[effect])}")
            wanted = numbers[effect][name].shape[-1]
            number = value.to(state.pos) if isinstance(value, Tensor) else state.pos.new_tensor(value).reshape(1, -1)
            number = number.reshape(1, 1) if number.dim() == 0 else number
            if number.shape[-1] != wanted:
                raise ValueError(f"scene: {effect}.{name} has {number.shape[-1]} components; expected {wanted}")
            if not bool(torch.isfinite(number).all()):
                raise ValueError(f"scene: {effect}.{name} is {number.flatten().tolist()[:3]}; expected finite numbers")
            numbers[effect][name] = number
    params = Params(rods, numbers)
    if check:
        _check_laws(scene, params, state)
        check_step(scene, params)
    first = State(state, state.pos.new_zeros((*state.pos.shape[:-2], 1, 1)))
    if scene.twist == "quasistatic":
        held = hold(scene, first)
        altered = rods
        for e in scene.effects:
            altered = e.alter(topology, altered, numbers.get(e.name, {}))
        settled = settle_twist(scene.settings, altered, numbers, state, Targets(held.pos, held.director), 30)
        first = tree.replace(first, rods=tree.replace(settled, twist_rate=torch.zeros_like(settled.twist)))
    return scene, params, first


def _check_laws(scene: Scene, params: Params, state: RodState) -> None:
    """Raise a `ValueError` where the rods have what no effect of the scene acts on."""
    rest, material = params.rods.rest, params.rods.material
    kinds = {type(e).__name__ for e in scene.effects}
    if "Bend" in kinds:
        if material.bend.shape[-1] == 2:
            raise ValueError("scene: a rope has bend2, which Bend leaves out; use BendFrame")
        if bool((rest.curvature != 0).any()):
            raise ValueError(
                "scene: a rope is curved at rest, which Bend leaves out; use BendFrame, or rest='straight'"
            )
        frames = kinds & {"BendingPlasticity", "RestCurvature"}
        if frames:
            raise ValueError(
                f"scene: {sorted(frames)[0]} changes the natural curvature, which Bend leaves out; use BendFrame"
            )
    if not scene.constrained and "Stretch" not in kinds and bool(torch.isfinite(material.stretch).any()):
        raise ValueError("scene: stretch is given, but lengths are not constrained and no Stretch effect acts; add it")
    if "Stretch" in kinds and not bool(torch.isfinite(material.stretch).all()):
        raise ValueError(
            "scene: stretch is infinite, which no force can be; give EA [N], or keep constrained=True without Stretch"
        )
    if scene.constrained:
        length = rod.edge_vectors(scene.topology, state.pos.detach(), rest.edge_mask).norm(dim=-1, keepdim=True)
        strain = ((length / rest.length.detach() - 1) * rest.edge_mask).abs().max()
        if float(strain) > 0.1:
            raise ValueError(
                f"scene: a rope is placed with edges {float(strain):.0%} off their length in its rest shape; place it "
                "at its length, or use constrained=False with a Stretch effect"
            )


def limits(scene: Scene, params: Params) -> dict[str, float]:
    """Return the largest stable substep [s] by the term that limits it.

    Bending waves reach w = 4/l^2 sqrt(EI/m'), stretching waves w = 2/l sqrt(EA/m'), twist waves w = 2 sqrt(GJ/(l I));
    Stoermer-Verlet is stable for w dt < 2. Implicit steps are limited by none of them.
    """
    if scene.integrator == "implicit":
        return {}
    rest, material = params.rods.rest, params.rods.material
    names = {e.name for e in scene.effects}
    real = (rest.edge_mask > 0).expand_as(rest.length)
    length = torch.where(real, rest.length, torch.inf)
    inner = (rest.hinge_mask > 0).expand_as(rest.length)
    mass = torch.where(inner, material.mass, torch.inf)
    found = {}
    if "bend" in names:
        bend = material.bend.amax(-1, keepdim=True)
        found["bending"] = 0.5 * (mass * length.square().clamp(max=1e6) * length / bend).amin().sqrt()
    if "stretch_force" in names and not scene.constrained:
        found["stretching"] = (mass * length / material.stretch).amin().sqrt()
    if "twist" in names and scene.twist == "dynamic":
        found["twisting"] = (torch.where(real, material.inertia, torch.inf) * length / material.twist).amin().sqrt()
    if "table" in names:
        found["table contact"] = 2 / params.effects["table"]["hardness"].max()
    return {name: float(value) for name, value in found.items()}


def check_step(scene: Scene, params: Params) -> None:
    """Raise a `ValueError` that names the limiting term if the substep is not stable."""
    dt = scene.dt / scene.substeps
    for term, bound in limits(scene, params).items():
        if not dt < bound:
            need = math.ceil(scene.dt / bound * 1.05)
            raise ValueError(
                f"scene: a substep of {dt:.3g} s (dt {scene.dt:g} s / {scene.substeps} substeps) is not stable: {term} "
                f"allows less than {bound:.3g} s. Use substeps={need} or more, or integrator='implicit'."
            )


def hold(scene: Scene, state: State) -> Control:
    """Return the control that keeps held parts where they are."""
    rods = state.rods
    e = rod.edge_vectors(scene.topology, rods.pos, rods.pos.new_tensor(scene.topology.edge_mask()).unsqueeze(-1))
    tangent = e / e.norm(dim=-1, keepdim=True)
    c, s = torch.cos(rods.twist), torch.sin(rods.twist)
    material = c * rods.director + s * torch.linalg.cross(tangent, rods.director)
    return Control(rods.pos[..., list(scene.held_vertices), :], material[..., list(scene.held_edges), :])


def advance(scene: Scene, params: Params, state: State, start: Control, control: Control, share: Tensor) -> State:
    """Advance a scene by one substep.

    Args:
        scene: static choices.
        params: constant numbers.
        state: the scene now.
        start: where held parts were when the step began.
        control: where held parts are at the end of the step.
        share: part of the step that is over after this substep, shape (1,).
    """
    settings = scene.settings
    director = rotation.turn_towards(start.director, control.director, share)
    targets = Targets(start.pos + share * (control.pos - start.pos), director)
    first = (state.time == 0).to(state.time.dtype)
    rods = substep(settings, params.rods, params.effects, state.rods, targets, first)
    return State(rods, state.time + settings.dt)


def step(scene: Scene, params: Params, state: State, control: Control, *, advance=advance) -> State:
    """Advance a scene by `scene.dt`; held parts move evenly to where `control` wants them.

    Args:
        scene: static choices.
        params: constant numbers.
        state: the scene now.
        control: where held parts are at the end.
        advance: what does a substep; `stepper` puts a compiled one here.
    """
    wanted = (len(scene.held_vertices), len(scene.held_edges))
    if (control.pos.shape[-2], control.director.shape[-2]) != wanted:
        given = (tuple(control.pos.shape), tuple(control.director.shape))
        raise ValueError(
            f"control: pos and director are {given}; expected (..., {wanted[0]}, 3) and (..., {wanted[1]}, 3)"
        )
    start = hold(scene, state)
    for k in range(scene.substeps):
        share = start.pos.new_full((1,), (k + 1) / scene.substeps)
        state = advance(scene, params, state, start, control, share)
    return state


def stepper(scene: Scene, *, compiled: bool = True):
    """Return `step` bound to a scene: a function of (params, state, control).

    Compiled steps take some ten seconds at the first call and are many times faster after it. Only a substep is
    compiled, so that the number of substeps does not matter. They need a C++ compiler on the CPU.
    """
    return partial(step, scene, advance=torch.compile(advance, fullgraph=True, dynamic=False) if compiled else advance)


def finite(state: State) -> Tensor:
    """Return which scenes are made of numbers only, bool, shape (...)."""
    ok = torch.isfinite(state.rods.pos).all(-1).all(-1)
    return ok & torch.isfinite(state.rods.vel).all(-1).all(-1)


__all__ = [
    "Control",
    "Params",
    "Rope",
    "Scene",
    "State",
    "check_step",
    "finite",
    "hold",
    "limits",
    "make",
    "rollout",
    "step",
    "stepper",
]
