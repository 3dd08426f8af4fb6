"""One substep of the rods: kick by the loads, drift, keep lengths, carry the frames.

Both integrators are Stoermer-Verlet in positions (velocities live half a substep earlier), so second order in the
substep and free of numerical damping. "explicit" divides forces by masses. "implicit" divides by masses plus
dt^2/4 or more of the bending stiffness of a straight chain: with a constant inertia M + g dt^2 K the frequency w of
a mode becomes w / sqrt(1 + g dt^2 w^2), which is below the stability limit 2/dt for every g >= 1/4; g = 1/4 is the
trapezoidal rule. Two choices are first order: finite stretch of edges whose length is solved for (tension follows the
strain at the end of the substep, which damps axial waves), and `numerical_damping` above zero.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchdlo.physics import tree
from torchdlo.physics.constraints.contact_penalty import Pairs, Touch, untouched
from torchdlo.physics.constraints.edge_lengths import Inertia, Lengths, LengthSystem, balance, project, solve_slots
from torchdlo.physics.constraints.joint_points import JointForces, JointPoints, project_joined
from torchdlo.physics.effects import base as effect
from torchdlo.physics.effects.base import ContactForces, Effect, PredictedMotion, Values
from torchdlo.physics.integrators import contact_step
from torchdlo.physics.integrators.observed_contact import told
from torchdlo.physics.kernels import lanes
from torchdlo.physics.linalg import rotation
from torchdlo.physics.linalg.numerics import normalize, wrap
from torchdlo.physics.rod import kinematics as rod
from torchdlo.physics.rod.kinematics import RodParams, RodState, View
from torchdlo.physics.rod.prescribed import Reaction, Targets, put
from torchdlo.physics.rod.prescribed import free as free_slots
from torchdlo.physics.rod.topology import Topology, following

INTEGRATORS = ("explicit", "implicit")
CONTACTS = ("sweeps", "coupled")
TWISTS = ("none", "dynamic", "quasistatic")


@dataclass(frozen=True)
class Settings:
    """How the rods are stepped; all static."""

    topology: Topology
    effects: tuple[Effect, ...]
    dt: float
    """Substep [s]."""
    integrator: str = "explicit"
    twist: str = "dynamic"
    """"dynamic" (edges have rotational inertia), "quasistatic" (twist is in balance at all times) or "none"."""
    constrained: bool = True
    """Whether edge lengths are solved for (inextensible, or stiff) instead of left to forces."""
    prescribed_vertices: tuple[int, ...] = ()
    prescribed_edges: tuple[int, ...] = ()
    """Edges whose material frame is prescribed."""
    constraint_iterations: int = 3
    """Newton steps for lengths; in "implicit" at most."""
    twist_iterations: int = 4
    """Newton steps for quasistatic twist."""
    implicit_weight: float = 0.5
    """In "implicit", share of dt^2 times stiffness that counts as inertia, and of a substep's turn by which tensions
    follow their edges. Tension T of an edge of length l that turns by a works (1 - 2 gamma) T l (1 - cos a): nothing at
    1/2, whatever T does from step to step."""
    numerical_damping: float = 0.0
    """In "implicit", stiff forces are taken this share of a substep ahead: damps fast modes, first order if not 0."""
    joint_edges: tuple[int, ...] = ()
    """Edges of which joints carry both ends."""
    joint_frames: tuple[int, ...] = ()
    """Edges whose material frames joints carry."""
    contact: str = "sweeps"
    """In "explicit", whether contact is found by "sweeps", then lengths, or both "coupled", as in "implicit"."""

    @property
    def coupled(self) -> bool:
        """Whether contact and lengths are found in one solve, and tensions follow their edges within a substep."""
        return self.integrator == "implicit" or (self.contact == "coupled" and any(e.engages for e in self.effects))

    @property
    def frames(self) -> bool:
        """Whether material frames are needed."""
        return self.twist != "none" or any(e.frames for e in self.effects)


def _placed(settings: Settings, targets: Targets, pos: Tensor) -> Tensor:
    """Return positions with held vertices where they are told to be, shape (..., V, 3)."""
    return put(targets.pos, settings.prescribed_vertices, targets.attachment_weight.get("vertices"), pos)


def with_joints(settings: Settings, targets: Targets, director: Tensor) -> tuple[Settings, Targets]:
    """Return both with the frames that joints carry among those that are prescribed.

    Args:
        settings: static choices.
        targets: where held parts are.
        director: first material directors of the edges that joints carry [1], shape (..., W, 3).
    """
    if not settings.joint_frames:
        return settings, targets
    edges, weight = settings.prescribed_edges + settings.joint_frames, dict(targets.attachment_weight)
    batch = torch.broadcast_shapes(director.shape[:-2], targets.director.shape[:-2])
    both = torch.cat([x.expand(*batch, *x.shape[-2:]) for x in (targets.director, director)], -2)
    if "edges" in weight:
        firm = weight["edges"].new_ones(*weight["edges"].shape[:-2], len(settings.joint_frames), 1)
        weight["edges"] = torch.cat([weight["edges"], firm], -2)
    return dataclasses.replace(settings, prescribed_edges=edges), Targets(targets.pos, both, weight)


def substep(
    settings: Settings,
    params: RodParams,
    values: dict[str, Values],
    state: RodState,
    targets: Targets,
    first: Tensor,
    predict_free_motion: Callable[[Tensor | float], Any] | None = None,
    material_points: Callable[[Tensor | float], Any] | None = None,
    joints: Any = None,
) -> tuple[RodState, Reaction, tuple[Any, Any, ContactForces]]:
    """Advance the rods by one substep.

    Args:
        settings: static choices.
        params: rest shape and material, before effects alter them.
        values: numbers of the effects, by effect and name.
        state: the rods now.
        targets: where held parts are at the end.
        first: 1 in the very first substep, when velocities stand at the same time as positions, else 0;
            shape (..., 1, 1).
        predict_free_motion: where rigid bodies would go under an acceleration (..., 1, 3) [m/s^2]; None in a scene
            without.
        material_points: where matter would go; likewise.
        joints: what is joined, see `coupling.rod_body.joints.Joining`; None in a scene without.

    Returns:
        The rods, what held them, and where bodies and matter would go with what is exerted on them.
    """
    topology, dt = settings.topology, settings.dt
    params = effect.altered_params(settings.effects, topology, params, values)
    now = rod.view(topology, params, state, dt)
    loads = effect.total_loads(settings.effects, now, values)
    kick = _kick(settings, now, loads, first, targets)
    falling = loads.get("acceleration", 0.0)
    body: Any = None if predict_free_motion is None else predict_free_motion(falling)
    particles = None if material_points is None else material_points(falling)
    twist = None if joints is None else joints.twist(now, loads)
    others = body if twist is None else body.pushed(twist), particles, joints
    pos, tension, push, contact = _answered(settings, now, loads, values, kick, targets, others)
    contact = contact if twist is None else contact.plus(twist)
    held = list(settings.prescribed_vertices)
    force = (kick.vertex * (pos - kick.drift) / kick.scale - push)[..., held, :]
    fields: dict[str, Any] = {"pos": pos, "tension": tension}
    half = torch.exp(-0.5 * dt * loads["rate"]) if "rate" in loads else 1.0
    fields["vel"] = (pos - state.pos) / dt * half
    for each in settings.effects:
        change = each.plastic_flow(now, values.get(each.name, {}))
        if change is not None:
            fields["plastic"] = fields.get("plastic", state.plastic) + change
    remembering = [e for e in settings.effects if e.memory]
    if remembering:
        fields["memory"] = {e.name: e.update_memory(now, values.get(e.name, {})) for e in remembering}
    if settings.frames:
        fields["director"], fields["ref_twist"] = rod.advance_frames(topology, params, now, pos)
    moved = tree.replace(state, **fields)
    held_edges = len(settings.prescribed_edges)
    if joints is not None:
        settings, targets = with_joints(settings, targets, contact.joints.director)
    couple = force.new_zeros(*force.shape[:-2], held_edges, 1)
    if settings.twist == "dynamic":
        moved, couple = _turn(settings, now, loads, moved, targets, first)
    if settings.twist == "quasistatic":
        moved, couple = settle_twist(settings, params, values, moved, targets)
    if joints is not None:
        does = tree.replace(contact.joints, couple=couple[..., held_edges:, :])
        couple, contact = couple[..., :held_edges, :], tree.replace(contact, joints=does)
    return moved, Reaction(force, couple), (body, particles, contact)


def _force(now: View, loads: Values) -> Tensor:
    """Return the force on the vertices [N], shape (..., V, 3)."""
    force = torch.zeros_like(now.state.pos)
    if "gradient" in loads:
        pull = loads["gradient"] * now.params.rest.edge_mask
        force = pull - now.prev(pull)
    if "force" in loads:
        force = force + loads["force"]
    if "acceleration" in loads:
        force = force + now.params.material.mass * loads["acceleration"]
    return force


@dataclass(frozen=True)
class _Kick:
    """What moves the vertices in a substep, but for tension and reactions."""

    force: Tensor
    """Force [N], shape (..., V, 3)."""
    drift: Tensor
    """Positions without any force [m], shape (..., V, 3)."""
    scale: Tensor
    """What turns force into mass times displacement [s^2], shape (..., 1, 1)."""
    vertex: Tensor
    """Mass along the axes [kg], shape (..., V, 3)."""
    free: Tensor
    """1 for free vertices, 1 less the grip for held ones [1], shape (V, 1) or (..., V, 1)."""


def _kick(settings: Settings, now: View, loads: Values, first: Tensor, targets: Targets) -> _Kick:
    dt, state, material = settings.dt, now.state, now.params.material
    # v' = d (d v + s dt F / m), d half of the uniform decay, s a half in the first substep.
    half = torch.exp(-0.5 * dt * loads["rate"]) if "rate" in loads else 1.0
    vertex = material.mass.expand_as(state.pos)
    if "drag" in loads:
        vertex = vertex + dt * loads["drag"]
    return _Kick(
        _force(now, loads),
        state.pos + dt * half * state.vel,
        dt * dt * half * (1 - 0.5 * first),
        vertex,
        free_slots(
            settings.prescribed_vertices, targets.attachment_weight.get("vertices"), state.pos, settings.topology.size
        ),
    )


def _answered(
    settings: Settings,
    now: View,
    loads: Values,
    values: dict[str, Values],
    kick: _Kick,
    targets: Targets,
    others: tuple[Any, Any, Any],
) -> tuple[Tensor, Tensor, Tensor, ContactForces]:
    """Return what `_translate` does where effects answer to the motion, and what they exert.

    The motion is foreseen with the last tension, then found. Each effect answers to what the others exert. `others`
    are where bodies and matter would go, and what is joined, None each where there is none.

    Ropes that press a body against another one are solved twice: with what bodies exert on each other under their
    weight, then with how that answers to what the ropes exert. Else the body would give way by the fall of a step, and
    would be thrown back if the rope is the heavier one.
    """
    bodies, material_points, joints = others
    engaged = [e for e in settings.effects if e.engages and settings.coupled]
    reacting = [e for e in settings.effects if e.is_contact and e not in engaged]
    none = kick.force.new_zeros(1, 3)
    total = ContactForces(none, none, none)
    if not reacting and not engaged and joints is None:
        return *_translate(settings, now, loads, kick, targets, now.state.tension), total
    firm, tension = kick.vertex, now.state.tension
    if settings.integrator == "implicit" and "stiffness" in loads:
        firm = firm + settings.implicit_weight * settings.dt**2 * loads["stiffness"]
    mobility = (kick.scale / firm).expand_as(firm)
    answer = mobility * kick.free
    pull = tension * now.params.rest.edge_mask * now.tangent
    force, solved = kick.force + pull - now.prev(pull), "in the solve"
    pushes: dict[str, ContactForces] = {}
    if joints is not None:
        tied = joints.points(now.state.pos, bodies)
        force = force + tied.pulls(tied.force)
        pushes[solved] = ContactForces(none, *joints.spread(tied.wrench(tied.force)))
    aimed = _placed(settings, targets, kick.drift + answer * force)
    for _ in range(max([1, *[e.rounds for e in reacting]])):
        for e in reacting:
            motion = PredictedMotion(aimed - now.state.pos, mobility, answer, bodies, material_points)
            for other in (push for name, push in pushes.items() if name != e.name):
                change = motion.change + answer * other.force
                there = bodies and motion.bodies.pushed(other)
                motion = PredictedMotion(change, mobility, answer, there, material_points)
            found = e.solve_contact(now, motion, values[e.name])
            pushes[e.name] = found if isinstance(found, ContactForces) else ContactForces(found, none, none)
        total = ContactForces(none, none, none)
        total = functools.reduce(ContactForces.plus, (p for name, p in pushes.items() if name != solved), total)
        pushed = dataclasses.replace(kick, force=kick.force + total.force)
        if engaged or joints is not None:
            change = aimed - now.state.pos + answer * total.force
            there = bodies.pushed(total) if bodies and reacting else bodies
            seen = PredictedMotion(change, mobility, answer, there, material_points)

            def solve(motion: PredictedMotion, kick: _Kick, tension: Tensor) -> tuple[Any, ...]:
                touch = [e.engage(now, motion, values[e.name]) for e in engaged]
                joined = None if joints is None else (joints, joints.points(now.state.pos, motion.bodies))
                return _translate(settings, now, loads, kick, targets, tension, touch, joined)

            solution = solve(seen, pushed, tension)
            for e in [e for e in reacting if bodies and e.backs(bodies)]:
                rest = [p for name, p in pushes.items() if name not in (e.name, solved)]
                free = functools.reduce(lambda b, p: b.pushed(p), rest, bodies)
                solution = solve(dataclasses.replace(seen, bodies=e.backed(free, solution[3])), pushed, tension)
                pushes[e.name] = e.backing(free.pushed(solution[3]))
            pos, tension, held, pushes[solved] = solution
            total = functools.reduce(ContactForces.plus, pushes.values())
        else:
            pos, tension, held = _translate(settings, now, loads, pushed, targets, tension)
        aimed = pos - answer * total.force
    told(pushes, solved)
    return pos, tension, held, total


def yield_shares(coupled: bool) -> tuple[float, float]:
    """Return `most` and `least` of `edge_lengths.Lengths` [1], where tensions follow their edges or not."""
    return (1e4, 10.0) if coupled else (0.25, 0.25)


def _translate(
    settings: Settings,
    now: View,
    loads: Values,
    kick: _Kick,
    targets: Targets,
    tension: Tensor,
    touch: Sequence[Touch | Pairs] = (),
    joined: tuple[Any, JointPoints] | None = None,
) -> tuple[Any, ...]:
    """Return positions after the substep, tensions, whose first guess is given, and the force with them [N].

    With points and pairs of edges that may touch, or points that are joined, also return what these exert.
    """
    topology, dt, state = settings.topology, settings.dt, now.state
    rest, material, free = now.params.rest, now.params.material, kick.free
    fixed = (1 - free) * (1 - following(topology, free)) >= 1
    active = rest.edge_mask * (1 - fixed.to(free.dtype))
    if settings.joint_edges:
        active = active * active.new_tensor([[float(k not in settings.joint_edges)] for k in range(topology.size)])
    lightest = torch.minimum(material.mass, following(topology, material.mass)).detach()
    lengths = Lengths(
        topology,
        rest.length,
        rest.length / material.stretch,
        active,
        rest.edge_mask,
        dt * dt / lightest,
        *yield_shares(settings.coupled),
    )
    if settings.integrator == "implicit" or touch:
        if not settings.constrained:
            lengths = dataclasses.replace(lengths, active=0 * lengths.active)
        moved = _placed(settings, targets, kick.drift)
        return _balance(settings, now, loads, lengths, kick, moved, tension, (touch, joined))
    answer = kick.scale / kick.vertex * free
    moved = _placed(settings, targets, kick.drift + kick.scale / kick.vertex * kick.force)
    if joined is not None:
        return _joined(settings, lengths, kick, moved, answer, now, joined)
    if not settings.constrained:
        return moved, state.tension, kick.force
    pos, tension = project(lengths, moved, answer, now.tangent, tension, settings.constraint_iterations - 1)
    pull = tension * now.tangent
    return pos, tension, kick.force + pull - now.prev(pull)


def _joined(
    settings: Settings,
    lengths: Lengths,
    kick: _Kick,
    moved: Tensor,
    answer: Tensor,
    now: View,
    joined: tuple[Any, JointPoints],
) -> tuple[Any, ...]:
    """Return what `_translate` does for an explicit substep with joints."""
    joints, points = joined
    steps, dt, tension = settings.constraint_iterations - 1, settings.dt, now.state.tension
    if not settings.constrained:
        lengths = dataclasses.replace(lengths, active=0 * lengths.active)
    pos, found = project_joined(lengths, moved, answer, now.tangent, tension, points, steps, dt)
    pull = found.tension * now.tangent
    force = kick.force + pull - now.prev(pull) + points.pulls(found.force)
    none, does = force.new_zeros(1, 3), JointForces(found.force, points.directors(found.moved, dt))
    body_force, body_torque = joints.spread(points.wrench(found.force))
    push = ContactForces(none, body_force, body_torque, joints=does)
    return pos, found.tension if settings.constrained else tension, force, push


def _balance(
    settings: Settings,
    now: View,
    loads: Values,
    lengths: Lengths,
    kick: _Kick,
    moved: Tensor,
    tension: Tensor,
    others: tuple[Sequence[Touch | Pairs], tuple[Any, JointPoints] | None],
) -> tuple[Any, ...]:
    """Return what `_translate` does where tensions follow their edges; arguments as in `constrain.balance`."""
    topology, dt, rest, vertex = settings.topology, settings.dt, now.params.rest, kick.vertex
    damping = settings.numerical_damping
    if settings.integrator == "explicit":  # nothing but lengths and contact is solved for
        loads, damping = {}, 0.0
    if "stiffness" in loads:
        vertex = vertex + settings.implicit_weight * dt * dt * loads["stiffness"]
    # Stiff forces are taken at x + ahead dt v; `share` is their answer to the change of v.
    share, lead = settings.implicit_weight + 0.5 * damping, damping * dt * now.state.vel
    stiff = loads.get("hinge_stiffness", torch.zeros_like(now.length)) * rest.hinge_mask
    hinge = share * dt * dt * stiff
    if "hinge_drag" in loads:
        hinge = hinge + 0.5 * dt * loads["hinge_drag"]
    inertia = Inertia(vertex, hinge, rest.length, rest.edge_mask, loads.get("turning_inertia"))
    force = kick.force - tree.replace(inertia, hinge=stiff).bending(topology, lead)
    ahead = (now.next(lead) - lead) / rest.length
    scale = kick.scale.expand_as(now.length[..., :1, :])
    if inertia.turning is not None:  # held vertices do not move freely either
        force = force - inertia.swing(topology, (1 - kick.free) * (moved - kick.drift)) / scale
    touch, joined = others
    if touch or joined is not None:
        tied = None if joined is None else joined[1]
        empty = (now.state.pos,) if joined is None else (now.state.pos, joined[1].resist, joined[0].place)
        pairs = next((x for x in touch if isinstance(x, Pairs)), None)
        points = next((x for x in touch if isinstance(x, Touch)), None) or untouched(*empty)
        system = LengthSystem(lengths, inertia, moved, kick.free, force, scale, now.tangent, ahead, share)
        touching = contact_step.Touching(system, points, now.state.pos, pairs, dt, tied)
        pos, tension, whole, exerted, wrench, left, found, turned = contact_step.solve_contact_step(touching, tension)
        does = () if tied is None else JointForces(found, tied.directors(turned, dt))
        return pos, tension, whole, ContactForces(exerted, *points.spread(wrench), unsolved=left, joints=does)
    return balance(
        lengths,
        inertia,
        moved,
        kick.free,
        force,
        scale,
        now.tangent,
        ahead,
        tension,
        share,
        settings.constraint_iterations - 1,
    )


def _twist_matrix(now: View, loads: Values) -> tuple[Tensor, Tensor]:
    """Return the diagonal and the coupling to the next edge of the twists' second derivatives, (..., V, 1) each."""
    hessian = loads["twist_hessian"]
    return hessian[..., 2:] + now.next(hessian[..., :1]), now.next(hessian[..., 1:2])


def _prescribed(settings: Settings, params: RodParams, state: RodState, targets: Targets, angle: Tensor) -> Tensor:
    """Return twists with those of held edges set so that their first material director is the target."""
    if not settings.prescribed_edges:
        return angle
    e = rod.edge_vectors(settings.topology, state.pos, params.rest.edge_mask)
    slots = list(settings.prescribed_edges)
    tangent = normalize(e[..., slots, :])
    last = state.twist[..., slots, :]
    held = last + wrap(rotation.signed_angle(state.director[..., slots, :], targets.director, tangent) - last)
    return put(held, settings.prescribed_edges, targets.attachment_weight.get("edges"), angle)


def _turn(
    settings: Settings, now: View, loads: Values, moved: RodState, targets: Targets, first: Tensor
) -> tuple[RodState, Tensor]:
    """Advance twists by their rotational inertia; also return the couples [N m] on held edges, shape (..., G, 1)."""
    dt, state, rest, inertia = settings.dt, now.state, now.params.rest, now.params.material.inertia
    half = torch.exp(-0.5 * dt * loads["twist_decay"]) if "twist_decay" in loads else 1.0
    torque = loads.get("torque", torch.zeros_like(inertia)) * rest.edge_mask
    span = dt * (1 - 0.5 * first)
    kick = span * torque
    free = (
        free_slots(settings.prescribed_edges, targets.attachment_weight.get("edges"), state.pos, settings.topology.size)
        * rest.edge_mask
    )
    if settings.integrator == "implicit" and "twist_hessian" in loads:
        same, after = _twist_matrix(now, loads)
        same, after = settings.implicit_weight * dt * dt * same, settings.implicit_weight * dt * dt * after

        def newton(change: Tensor) -> Tensor:
            coupled = after * now.next(change) + now.prev(after * change)
            excess = (kick - same * change - coupled) * free - inertia * change
            return change + solve_slots(
                settings.topology, inertia + free * same, free * after, free * now.prev(after), excess
            )

        with torch.no_grad():
            start = newton(torch.zeros_like(kick))
        change = newton(start)
    else:
        change = kick / inertia * free
    rate = half * (half * state.twist_rate + change)
    angle = _prescribed(settings, now.params, moved, targets, state.twist + dt * rate * rest.edge_mask)
    rate = (angle - state.twist) / dt
    couple = inertia * (rate / half - half * state.twist_rate) / span - torque
    return tree.replace(moved, twist=angle, twist_rate=rate), couple[..., list(settings.prescribed_edges), :]


_SETTLED, _NEAR = 1e-12, 1e-4
"""Largest change of twists in a step of Newton's method that is none, and one near the balance [rad]."""


def settle_twist(
    settings: Settings,
    params: RodParams,
    values: dict[str, Values],
    state: RodState,
    targets: Targets,
    steps: int | None = None,
) -> tuple[RodState, Tensor]:
    """Return the state with twists at which no free edge feels a torque (Newton steps from the last ones).

    Also return the couples that hold the held edges [N m], shape (..., G, 1).

    Bergou 2008, section 4.2: twist waves are much faster than bending, so twist is taken to be in balance.
    """
    topology, patient = settings.topology, steps is not None
    # Given all the time there is, twists come to rest against what resists their rate, too.
    span = math.inf if patient else settings.dt
    effects = [e for e in settings.effects if e.is_quasistatic]
    if all(e.name == "twist" for e in effects):
        # Its torque is linear in the twists: one step is exact.
        steps = 1
    elif steps is None:
        # What depends on the path answers to the direction of a small change: Newton's method begins to converge later.
        steps = settings.twist_iterations + (2 if any(e.memory for e in effects) else 0)
    free = (
        free_slots(settings.prescribed_edges, targets.attachment_weight.get("edges"), state.pos, topology.size)
        * params.rest.edge_mask
    )

    def newton(angle: Tensor, exact: bool) -> tuple[Tensor, Tensor]:
        turning = tree.replace(state, twist=angle, twist_rate=(angle - state.twist) / span)
        here = rod.view(topology, params, turning, span)
        loads = effect.total_loads(effects, here, values)
        if lanes.ready(angle):
            none = angle.new_zeros(1, 1)
            bent = loads.get("twist_geometry", none.expand(1, 2))
            bent = bent if exact else bent.clamp(min=0.0)
            inputs = free, loads["twist_hessian"], loads["torque"], bent, loads.get("twist_skew", none)
            change, left = lanes.apply("settle", topology.name, inputs, (1, 1), "tridiagonal")
            return angle + change, -left[..., list(settings.prescribed_edges), :]
        with torch.no_grad():
            same, after = _twist_matrix(here, loads)
            if "twist_geometry" in loads:
                # Without its negative part the matrix leads to minima only; near one the exact matrix converges fast,
                # and in the last step it makes the derivative exact.
                bent = loads["twist_geometry"] if exact else loads["twist_geometry"].clamp(min=0.0)
                same = same + bent[..., 1:] + here.next(bent[..., :1])
            skew = loads.get("twist_skew", torch.zeros_like(after))
            # A tiny spring on every edge: a rod free at both ends may spin as a whole.
            same = same + 1e-9 * same.amax(-2, keepdim=True)
            onward, back = after + here.next(skew), here.prev(after) - skew
        torque = loads["torque"]
        change = solve_slots(topology, free * same + 1 - free, free * onward, free * back, torque * free)
        left = torque - same * change - onward * here.next(change) - back * here.prev(change)
        return angle + change, -left[..., list(settings.prescribed_edges), :]

    angle = _prescribed(settings, params, state, targets, state.twist)
    with torch.no_grad():
        start, change = angle, float("inf")
        for k in range(steps - 1):
            last, (start, _) = start, newton(start, k >= steps - 3 or change < _NEAR)
            if patient and (change := float((start - last).abs().max())) < _SETTLED:
                break
    start = torch.where(free > 0, start, angle)
    settled, couple = newton(start, True)
    return tree.replace(state, twist=settled, twist_rate=(settled - state.twist) / settings.dt), couple
