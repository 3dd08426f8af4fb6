"""Scenes: ropes with effects, and the one function that moves them.

Four kinds of data are never mixed: `Scene` (static), `Params` (what one may learn), `State` (what evolves) and
`Control` (what one commands).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial, reduce
from typing import Literal

import torch
from torch import Tensor
from torch.autograd import forward_ad

from torchdlo import notices
from torchdlo.coupling import scene_notices, start_overlaps
from torchdlo.coupling.bodies import dynamics as rigid
from torchdlo.coupling.bodies.contact_effect import BodyContact
from torchdlo.coupling.bodies.dynamics import Body, BodyParams, BodyState, BodyTargets, RigidBody, place_bodies
from torchdlo.coupling.common import step_diagnostics
from torchdlo.coupling.common.step_diagnostics import broad_phase
from torchdlo.coupling.mpm import body_coupling_effect, rod_coupling_effect
from torchdlo.coupling.mpm import substep as mpm
from torchdlo.coupling.mpm.particles import MpmDomain, ParticleParams, Particles, laid_out
from torchdlo.coupling.rod_body import joints as joined
from torchdlo.coupling.rod_body.joints import Joining, JointParams, Joints, JointState, RopeJoint
from torchdlo.field_docs import with_field_docs
from torchdlo.physics import tree
from torchdlo.physics.effects.base import ContactForces, Effect, altered_params, default_values, parameters_of
from torchdlo.physics.execution import Execution, check_execution, tracing
from torchdlo.physics.execution.compiled import Compiled, Kinds
from torchdlo.physics.execution.gradient_check import GradientCheck, check_gradients
from torchdlo.physics.execution.graphs import Graphs
from torchdlo.physics.execution.replay import alike, rollout
from torchdlo.physics.integrators import stability
from torchdlo.physics.integrators.rod_step import (
    CONTACTS,
    INTEGRATORS,
    TWISTS,
    Settings,
    settle_twist,
    substep,
    with_joints,
)
from torchdlo.physics.kernels import native
from torchdlo.physics.rod import assembly, validation
from torchdlo.physics.rod import kinematics as rod
from torchdlo.physics.rod.assembly import Rope
from torchdlo.physics.rod.kinematics import RodParams, RodState
from torchdlo.physics.rod.prescribed import Reaction, Targets, between, check_grip, unfelt
from torchdlo.physics.rod.topology import Topology


@with_field_docs
@tree.struct
class Params:
    """Numbers that stay the same along a rollout."""

    rods: RodParams
    effects: dict[str, dict[str, Tensor]]
    """Numbers of each effect by its name and theirs, shape (..., 1, C)."""
    bodies: BodyParams | tuple[()] = ()
    """Numbers of the rigid bodies, () if there are none."""
    material_points: ParticleParams | tuple[()] = ()
    """Numbers of the matter, () if there is none."""
    joints: JointParams | tuple[()] = ()
    """Where joints sit in bodies, () if there are none."""


@with_field_docs
@tree.struct
class State:
    """What evolves."""

    rods: RodState
    time: Tensor
    """Time since the start [s], shape (..., 1, 1)."""
    diagnostics: Tensor
    """What steps missed since the start, zeros if all is well: contacts without room [1], by how much vertices were
    faster than foreseen [m], by what share an edge was too short and too long [1], and what
    share of its forces a step with coupled contact left unbalanced [1], shape (..., 1, 5)."""
    reaction: Reaction
    """What holds exerted on the ropes in the last step, its mean."""
    bodies: BodyState | tuple[()] = ()
    """Poses and velocities of the rigid bodies, () if there are none."""
    material_points: Particles | tuple[()] = ()
    """Particles of the matter, () if there is none."""
    joints: JointState | tuple[()] = ()
    """What joints exerted in the last substep, () if there are none; see `joint_forces`."""


@with_field_docs
@tree.struct
class Control:
    """What held parts are told to do, at the end of a step."""

    pos: Tensor
    """Positions of the held vertices [m], shape (..., H, 3)."""
    director: Tensor
    """First material directors of the held edges [1], shape (..., G, 3)."""
    attachment_weight: dict[str, Tensor] = field(default_factory=dict)
    """How firmly the held "vertices" (..., H, 1) and "edges" (..., G, 1) are held during the step: 0 is let go, 1 is
    firm, between them the hold gives as if its parts were that much heavier; 1 for what is not said."""
    bodies: BodyTargets | tuple[()] = ()
    """Poses of the kinematic bodies, () if the scene has no bodies."""


_NEWTON = {"explicit": 3, "implicit": 8}
"""Newton steps for edge lengths, by integrator, where a scene says nothing."""


@with_field_docs
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
    """"explicit", or "implicit" for stiff cables at steps of 1-10 ms; see `physics.integrators.rod_step`."""
    twist: str = "none"
    """"none", "dynamic" or "quasistatic"."""
    constrained: bool = True
    """Whether edge lengths are solved for; False leaves them to a `Stretch` effect."""
    prescribed_vertices: tuple[int, ...] = ()
    prescribed_edges: tuple[int, ...] = ()
    constraint_iterations: int | None = None
    """Newton steps for edge lengths per substep: in explicit steps as many, 3 if None; in implicit ones at most, 8 if
    None, as each scene ends when it is solved. Explicit steps with coupled contact take what they need."""
    twist_iterations: int = 4
    """Newton steps for quasistatic twist per substep, where bending has a part in it; without, one is exact."""
    implicit_weight: float = 0.5
    """Share of dt^2 times stiffness that counts as inertia in implicit steps, and of a step's turn by which tensions
    follow their edges. At 0.5 tensions do no work; below, slack and loaded ropes may gain energy, and above pulled
    ropes are damped. 0.3 is more exact for calm, taut ropes at long steps; at least 0.5 where twist is dynamic."""
    numerical_damping: float = 0.0
    """Share of a substep by which implicit steps look ahead: it damps fast modes and makes the step first order."""
    bodies: tuple[Body, ...] = ()
    """Rigid bodies."""
    material_points: MpmDomain | None = None
    """Elastic, plastic, liquid or granular matter."""
    joints: Joints | None = None
    """What ropes are joined to, as `make` found it."""
    contact: Literal["sweeps", "coupled"] = "sweeps"
    """How explicit steps find contact of ropes: by "sweeps" before edge lengths, or "coupled" with them in one solve,
    as in implicit ones. Take the second for taut ropes over bodies; the first keeps angular momentum exactly."""

    def __post_init__(self) -> None:
        def need(ok: bool, sentence: str) -> None:
            if not ok:
                raise ValueError(f"scene: {sentence}")

        need(self.integrator in INTEGRATORS, f"integrator is {self.integrator!r}; expected one of {INTEGRATORS}")
        need(self.contact in CONTACTS, f"contact is {self.contact!r}; expected one of {CONTACTS}")
        need(self.twist in TWISTS, f"twist is {self.twist!r}; expected one of {TWISTS}")
        need(isinstance(self.dt, int | float) and 0 < self.dt < math.inf, f"dt is {self.dt!r}; give seconds above 0")
        need(self.substeps in range(1, 10**6), f"substeps is {self.substeps!r}; expected a whole number from 1 up")
        need(
            self.constraint_iterations is None or self.constraint_iterations >= 1,
            f"constraint_iterations is {self.constraint_iterations}; expected at least 1 step, or None",
        )
        need(
            self.integrator == "explicit" or (self.constraint_iterations or 1) <= _NEWTON["implicit"],
            f"constraint_iterations is {self.constraint_iterations}; implicit steps end when they are solved, and take "
            f"at most {_NEWTON['implicit']}: with more, straight ropes that are pressed along their line explode",
        )
        need(self.twist_iterations >= 1, f"twist_iterations is {self.twist_iterations}; expected at least 1 step")
        need(
            self.implicit_weight >= 0.25,
            f"implicit_weight is {self.implicit_weight}; expected at least 0.25, below which steps are unstable",
        )
        need(
            0 <= self.numerical_damping <= 1,
            f"numerical_damping is {self.numerical_damping}; expected a share of a substep, 0 to 1",
        )
        size = self.topology.size
        for name in ("prescribed_vertices", "prescribed_edges"):
            slots = tuple(map(int, getattr(self, name)))  # lists are welcome, but a scene is hashable
            object.__setattr__(self, name, slots)
            wrong = [s for s in slots if not 0 <= s < size]
            need(not wrong, f"{name} names {wrong}; the scene has slots 0 to {size - 1}")
            need(len(set(slots)) == len(slots), f"{name} {list(slots)} names a slot twice")
        seams = [s for s in self.prescribed_edges if not self.topology.edge_mask()[s]]
        need(not seams, f"prescribed_edges names {seams}, the gap between the ends of an open rope")
        free = not self.prescribed_edges or self.twist != "none"
        need(free, "prescribed_edges prescribe twist, but twist is 'none'; choose 'quasistatic' or 'dynamic'")
        names = [e.name for e in self.effects]
        twice = {n for n in names if names.count(n) > 1}
        need(not twice, f"effects {sorted(twice)} are listed twice")
        solved = self.integrator == "explicit" or self.constrained
        need(solved, "implicit steps solve for edge lengths; keep constrained=True and give ropes a stretch stiffness")
        need(
            bool(self.bodies) or not {"rod_body", "finger_pads", "body_mpm_coupling"} & set(names),
            "RodBody, BodyMpmCoupling or FingerPads needs bodies, but there are none; give make(..., bodies=[...])",
        )
        for effect in self.effects:
            if isinstance(effect, BodyContact):
                effect.check_pairs(self.bodies)
        if self.settings.coupled:
            validation.check_solved_together(names, self.topology)
        twisted = self.twist != "quasistatic" or "twist" in names
        need(twisted, "quasistatic twist needs the Twist effect; add it, or set twist='none'")

    @property
    def held(self) -> tuple[int, int]:
        """How many vertices and edges are held."""
        return len(self.prescribed_vertices), len(self.prescribed_edges)

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
            self.prescribed_vertices,
            self.prescribed_edges,
            self.constraint_iterations or _NEWTON[self.integrator],
            self.twist_iterations,
            # Twist and bending answer to each other only in the next step: that costs stability.
            max(self.implicit_weight, 0.5) if self.twist == "dynamic" else self.implicit_weight,
            self.numerical_damping,
            *(((), ()) if self.joints is None else (self.joints.edges, self.joints.frames)),
            self.contact,
        )


def make(
    ropes: Sequence[Rope],
    effects: Sequence[Effect],
    values: dict[str, dict[str, float | Sequence[float] | Tensor]] | None = None,
    *,
    bodies: Sequence[RigidBody] = (),
    material_points: tuple[MpmDomain, ParticleParams, Particles] | tuple[()] = (),
    joints: Sequence[RopeJoint] = (),
    check: bool = True,
    clamp: Literal["edge", "vertex"] = "edge",
    **choices,
) -> tuple[Scene, Params, State]:
    """Build a scene with its parameters and its initial state.

    Args:
        ropes: the ropes.
        effects: what acts on them.
        values: numbers of effects that differ from their defaults, e.g. {"damping": {"rate": 0.6}}.
        bodies: rigid bodies; `RodBody` among the effects makes ropes touch them.
        material_points: what `coupling.mpm.particles.assemble` returned; `RodMpmCoupling` and `BodyMpmCoupling` let
            ropes and bodies touch it.
        joints: points of ropes that are welded or ball-jointed to free bodies or other ropes.
        check: whether to refuse what could not be stepped: laws that do not fit the ropes, ropes far from their length,
            unstable substeps; and to move ropes that start inside of what they touch out of it. Scenes whose loads are
            only evaluated may be anything.
        clamp: where neighbouring `prescribed_vertices` clamp a rope: in the middle of the last edge between them, or at
            the last vertex; for what stays held, as the hinge there is stiffer by the length that is left out.
        choices: fields of `Scene`. `contact` may also be "auto": "coupled" where ropes touch bodies, if it can be.
    """
    validation.check_sequence(effects, Effect, "effects")
    if clamp not in ("edge", "vertex"):
        raise ValueError(f"scene: clamp is {clamp!r}; expected 'edge' or 'vertex'")
    topology, rods, state = assembly.assemble(ropes)
    if clamp == "vertex":
        rods = assembly.clamp_at_vertices(topology, rods, choices.get("prescribed_vertices", ()))
    kinds, solid, placed = place_bodies(bodies, state.pos) if bodies else ((), (), ())
    if bodies:
        batch = torch.broadcast_shapes(state.pos.shape[:-2], tree.part(placed).pos.shape[:-2])
        state, placed = tree.map(lambda x: tree.batch_innermost(x.expand(*batch, *x.shape[-2:])), (state, placed))
    medium, stuff, particles = material_points or (None, (), ())
    if material_points:
        whole = state, placed, tree.part(particles)
        state, placed, particles = rod_coupling_effect.expand_batches(*whole, stuff, solid, values)
    effects = rod_coupling_effect.fitted(effects, medium, rods)
    solids = (kinds, tree.part(solid), tree.part(placed)) if bodies else None
    tied: Joints | None = None
    sits: JointParams | tuple[()] = ()
    pulls: JointState | tuple[()] = ()
    if joints:
        validation.check_sequence(joints, RopeJoint, "joints")
        held, twisting = choices.get("prescribed_vertices", ()), choices.get("twist", "none") != "none"
        tied, sits, pulls = joined.place_joints(joints, topology, rods, state, solids, held=held, twisting=twisting)
        effects = joined.apart(effects, tied, topology, rods, state, solids)
    numbers = parameters_of(effects, values or {}, state.pos)
    bounces, dtype = scene_notices.rebounds(solid, numbers), None if material_points else state.pos.dtype
    choices = validation.with_contact(choices, effects, topology, dtype, bounces)
    scene = Scene(topology, effects, bodies=kinds, material_points=medium, joints=tied, **choices)
    blank = {e.name: state.pos.new_zeros(*state.pos.shape[:-1], e.memory) for e in effects if e.memory}
    state = tree.replace(state, memory=tree.map(tree.batch_innermost, blank))
    params = Params(rods, numbers, solid, tree.to(stuff, state.pos.dtype), sits)  # kernels read one type
    if check:
        stability.check_laws(scene.settings, rods, numbers, state)
        check_step(scene, params)
        scene_notices.mention(scene.settings, bool(scene.bodies), scene.joints is not None, bounces, state.pos)
        altered = altered_params(scene.effects, topology, rods, numbers)
        state, placed = start_overlaps.part(scene.settings, altered, numbers, state, solids, tied)
    zero = state.pos.new_zeros(*state.pos.shape[:-2], 1, 3)
    first = State(
        state,
        zero[..., :1],
        state.pos.new_zeros(*state.pos.shape[:-2], 1, step_diagnostics.WIDTH),
        unfelt(state.pos, *scene.held),
        placed,
        particles,
        pulls,
    )
    if scene.twist == "quasistatic":
        first = _settled(scene, params, first)
    # No two leaves share memory: steps are compiled for which of them do, and later states have none.
    return scene, params, tree.map(torch.clone, first)


def _settled(scene: Scene, params: Params, first: State) -> State:
    """Return a state whose twist is in balance."""
    held, settings, rods = stationary_control(scene, first), scene.settings, params.rods
    targets = Targets(held.pos, held.director)
    if scene.joints is not None and scene.joints.frames:
        carried = joined.directors_now(scene.joints, tree.part(params.joints), tree.part(first.bodies))
        settings, targets = with_joints(settings, targets, carried)
    changed = altered_params(scene.effects, scene.topology, rods, params.effects)
    settled, _ = settle_twist(settings, changed, params.effects, first.rods, targets, 30)
    return tree.replace(first, rods=tree.replace(settled, twist_rate=torch.zeros_like(settled.twist)))


def limits(scene: Scene, params: Params) -> dict[str, float]:
    """Return the largest stable substep [s] by the term that limits it; see `physics.integrators.stability`."""
    load = stability.NO_LOAD if scene.joints is None else scene.joints.load(params.bodies)
    return stability.limits(scene.settings, params.rods, params.effects, load)


def check_step(scene: Scene, params: Params) -> None:
    """Raise a `ValueError` that names the limiting term if the substep is not stable."""
    dt = scene.dt / scene.substeps
    if scene.material_points:
        mpm.check_step(scene.material_points, tree.part(params.material_points), dt)
    for term, bound in limits(scene, params).items():
        if not dt < bound:
            need = scene.dt / bound * 1.05 if bound > 0 else math.inf
            cures = [f"substeps={math.ceil(need)} or more"] if need < 10**6 else []
            cures += ["integrator='implicit'"] if scene.integrator == "explicit" else []
            raise ValueError(
                f"scene: a substep of {dt:.3g} s (dt {scene.dt:g} s / {scene.substeps} substeps) is not stable: {term} "
                f"allows less than {bound:.3g} s. Use {', or '.join(cures) or 'a lighter load'}."
            )


def stationary_control(scene: Scene, state: State) -> Control:
    """Return the control that keeps held parts and kinematic bodies where they are, with a firm grip."""
    pos = tree.take_vertices(state.rods.pos, scene.prescribed_vertices)
    director = rod.directors(scene.topology, state.rods, scene.prescribed_edges)
    bodies = rigid.stationary_control(scene.bodies, tree.part(state.bodies)) if scene.bodies else ()
    return Control(pos, director, bodies=bodies)


def advance(scene: Scene, params: Params, state: State, start: Control, control: Control, share: Tensor) -> State:
    """Advance a scene by one substep; arguments as of `substep_with_contact`."""
    return substep_with_contact(scene, params, state, start, control, share)[0]


def substep_with_contact(
    scene: Scene, params: Params, state: State, start: Control, control: Control, share: Tensor
) -> tuple[State, ContactForces]:
    """Advance a scene by one substep; return it with what contact exerted in it.

    Args:
        scene: static choices.
        params: constant numbers.
        state: the scene now.
        start: where held parts were when the step began.
        control: where held parts are at the end of the step.
        share: part of the step that is over after this substep, shape (1,).
    """
    settings = scene.settings
    targets = between(start, control, share if scene.substeps > 1 else None)
    first = (state.time == 0).to(state.time.dtype)
    predict_free_motion = poses = material_points = None
    if scene.bodies:
        solid, placed = tree.part(params.bodies), tree.part(state.bodies)
        poses = rigid.between(tree.part(start.bodies), tree.part(control.bodies), share)
        predict_free_motion = partial(
            rigid.predict_free_motion, scene.bodies, solid, placed, poses, first=first, dt=settings.dt
        )
    if scene.material_points:
        stuff = tree.part(params.material_points)
        material_points = rod_coupling_effect.predict_free_motion(
            scene.material_points, stuff, tree.part(state.material_points), first, settings.dt
        )
    joints = None
    if scene.joints is not None:
        at, last = tree.part(params.joints), tree.part(state.joints)
        joints = Joining(scene.joints, scene.bodies, at, last, settings.dt)
    others = predict_free_motion, material_points, joints
    rods, reaction, (body, pool, push) = substep(
        settings, params.rods, params.effects, state.rods, targets, first, *others
    )
    pulls = () if joints is None else JointState(push.joints.force, push.joints.couple)
    # Over the substeps of this step; a sum set to zero outside would have no gradient at first.
    later = share * scene.substeps > 1.5
    mean = tree.map(lambda old, now: torch.where(later, old, 0.0) + now / scene.substeps, state.reaction, reaction)
    missed = step_diagnostics.missed(scene, params, rods, state.diagnostics, push.unsolved)
    push = body_coupling_effect.couple_bodies_to_particles(scene.effects, body, pool, push)
    moved: BodyState | tuple[()] = rigid.advance_bodies(body, tree.part(poses), push) if scene.bodies else ()
    particles: Particles | tuple[()] = ()
    if scene.material_points:
        particles, missed = rod_coupling_effect.finish(scene.material_points, stuff, pool, push, settings.dt, missed)
    after = State(rods, state.time + settings.dt, missed, mean, moved, particles, pulls)
    return (laid_out(after) if torch.compiler.is_compiling() else after), push


def step(
    scene: Scene, params: Params, state: State, control: Control, *, advance=advance, broad_phase=broad_phase
) -> State:
    """Advance a scene by `scene.dt`; held parts move evenly to where `control` wants them.

    Args:
        scene: static choices.
        params: constant numbers.
        state: the scene now.
        control: where held parts are at the end.
        advance: what does a substep; `stepper` puts a compiled one here.
        broad_phase: what looks up once per step what effects need to know; likewise.
    """
    _check_given(scene, params, state, control)
    return _step(scene, params, state, control, advance, broad_phase)


def _check_given(scene: Scene, params: Params, state: State, control: Control) -> None:
    if not (isinstance(params, Params) and isinstance(state, State) and isinstance(control, Control)):
        kinds = ", ".join(type(x).__name__ for x in (params, state, control))
        raise TypeError(f"step: it is given {kinds}; expected Params, State, Control, in this order.")
    parts = control.pos, control.director
    if not all(isinstance(x, Tensor) for x in parts):
        kinds = ", ".join(type(x).__name__ for x in parts)
        raise TypeError(f"control: pos and director are {kinds}; expected tensors.")
    given, (h, g) = tuple(tuple(x.shape) for x in parts), scene.held
    if tuple(shape[-2:] for shape in given) != ((h, 3), (g, 3)):
        raise ValueError(f"control: pos and director are {given}; expected (..., {h}, 3) and (..., {g}, 3)")
    count, bodies = state.rods.pos.shape[-2], not isinstance(state.bodies, tuple)
    if count != scene.topology.size or bodies != bool(scene.bodies):
        said = f"{count} vertices and {'bodies' if bodies else 'no bodies'}"
        there = f"{scene.topology.size} and {'bodies' if scene.bodies else 'none'}"
        raise ValueError(f"state: it has {said}, the scene {there}; give a state that `make` or `step` made for it.")
    if forward_ad._current_level >= 0 and (scene.material_points or any(e.is_contact for e in scene.effects)):
        raise NotImplementedError("step: contact and material points have no forward mode; use reverse mode.")
    rigid.check_targets(scene.bodies, control.bodies)
    check_grip(control.attachment_weight, scene.held)
    validation.check_control_batch((params, state), state.rods.pos.shape[:-2], control)


def _step(scene: Scene, params: Params, state: State, control: Control, advance, broad_phase) -> State:
    def repeat(params: Params, state: State, fixed: tuple[Control, Control], shares: Sequence[Tensor]) -> State:
        for share in shares:
            state = advance(scene, params, state, *fixed, share)
        return state

    return _in_substeps(scene, params, state, control, repeat, partial(broad_phase, scene))


def _at_once(scene: Scene, params: Params, state: State, control: Control) -> State:
    return _step(scene, params, state, control, advance, broad_phase)


def _in_substeps(scene: Scene, params: Params, state: State, control: Control, repeat, broad_phase) -> State:
    start = stationary_control(scene, state)
    state = tree.replace(state, reaction=state.reaction.sized(state.rods.pos, *scene.held))
    if any(e.is_contact for e in scene.effects):
        params = broad_phase(params, state, start, control)
    shares = torch.arange(1, scene.substeps + 1, dtype=start.pos.dtype, device=start.pos.device) / scene.substeps
    return repeat(params, state, (start, control), shares.split(1))


def stepper(scene: Scene, *, execution: Execution = "compiled"):
    """Return `step` bound to a scene: a function of (params, state, control).

    Recorded steps take seconds at the first call, and then, without gradients, a fifth to a tenth of the time. Compiled
    ones take ten seconds to minutes at first, with and without gradients, and are many times faster then. A step of one
    substep is compiled as a whole; of more, the substep is, so that their number does not matter.
    On CUDA devices explicit ones are recorded as CUDA graphs at the third call with tensors of the same shapes.
    Compiled steps need a C++ compiler; without one they are not compiled, with one warning.
    """
    check_execution(execution)
    if execution != "compiled" or not native.prepare_torch_compile():
        return tracing.RecordedStep(partial(step, scene)) if execution == "recorded" else partial(step, scene)
    once = scene.substeps == 1 and not any(e.is_contact for e in scene.effects)

    def made(inline: bool) -> Compiled:
        # Neighbours are best read where they are used, but with gradients and of much matter copies pay.
        options = {"force_pointwise_cat": inline and scene.material_points is None}
        return Compiled(_at_once if once else advance, scene, options=options)

    ways = {True: made(False), False: made(True)}
    solved = scene.settings.coupled  # until it is: that is not to be foreseen
    look, kinds, graphs = Compiled(broad_phase, scene), Kinds(_prepared), Graphs()

    def run(params: Params, state: State, control: Control) -> State:
        if forward_ad._current_level >= 0:  # compiled code knows no dual numbers, and would drop their tangents
            return step(scene, params, state, control)
        _check_given(scene, params, state, control)
        notices.once(
            "compiling",
            "compiling the first step: seconds to minutes, once a process; execution='recorded' does without.",
        )
        with_gradient = torch.is_grad_enabled()
        part = ways[with_gradient]
        grip = control.attachment_weight
        with kinds((params, state, control), with_gradient, *grip) as (inputs, kind):

            def whole(params: Params, state: State, control: Control) -> State:
                if once:
                    return part(kind, params, state, control)
                return _in_substeps(scene, params, state, control, partial(part.repeat, kind), partial(look, kind))

            if solved or not state.rods.pos.is_cuda:
                return whole(*inputs)
            return graphs(whole, inputs, *grip)

    return run


def _prepared(inputs: tuple[Params, State, Control]) -> tuple[Params, State, Control]:
    params, state, control = inputs
    state = laid_out(state)
    # Compilers tell numbers that need a gradient from others, also where none is taken: replays run both ways.
    if not torch.is_grad_enabled():
        return tree.detach((params, state, control))
    names = ("rods", "reaction", "bodies", "material_points", "joints")
    moving = alike(tuple(getattr(state, name) for name in names), (params, control))
    fields = dict(zip(names, moving, strict=True)) | tree.detach({"time": state.time, "diagnostics": state.diagnostics})
    return params, tree.replace(state, **fields), control


def joint_forces(scene: Scene, state: State) -> tuple[Tensor, Tensor]:
    """Return what joints exert on their ropes in the last substep, in the order in which `make` was given them.

    Bodies, or the other rope, feel the opposite.

    Returns:
        Forces [N] and torques about the places of the joints [N m], shape (..., N, 3) each.
    """
    if scene.joints is None:
        raise ValueError("scene: it has no joints; give make(..., joints=[RopeJoint(body=0)])")
    return joined.reading(scene.joints, scene.topology, state.rods, tree.part(state.joints))


def finite(state: State) -> Tensor:
    """Return which scenes are made of numbers only, bool, shape (...)."""
    moving = (state.rods.pos, state.rods.vel, *tree.leaves((state.bodies, state.material_points, state.joints)))
    return reduce(torch.logical_and, (torch.isfinite(x).all(-1).all(-1) for x in moving))


def ok(state: State) -> Tensor:
    """Return which scenes are finite and missed nothing, bool, shape (...)."""
    return finite(state) & (state.diagnostics == 0).all(-1).all(-1)


def check_state(state: State) -> None:
    """Raise a `RuntimeError` that says what went wrong, if something did."""
    if not bool(ok(state).all()):
        said = step_diagnostics.explain_diagnostics(state.diagnostics) or "positions or velocities are not finite"
        raise RuntimeError(f"scene: {said}")


__all__ = [
    "Control",
    "GradientCheck",
    "Params",
    "RigidBody",
    "Rope",
    "RopeJoint",
    "Scene",
    "State",
    "check_gradients",
    "check_state",
    "check_step",
    "default_values",
    "finite",
    "joint_forces",
    "limits",
    "make",
    "ok",
    "rollout",
    "stationary_control",
    "step",
    "stepper",
]
