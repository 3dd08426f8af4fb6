"""The problems of `learn_through_contact.py`, and how one is learned."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchdlo import scene, scene_files
from torchdlo.coupling import BodyMpmCoupling, RodBody
from torchdlo.coupling.bodies.dynamics import BodyTargets, turn_by
from torchdlo.coupling.mpm.rod_coupling_effect import TouchedParticles
from torchdlo.physics import tree
from torchdlo.physics.effects.base import ContactForces, PredictedMotion, Values
from torchdlo.physics.linalg.rotation import multiply
from torchdlo.physics.rod.kinematics import View
from torchdlo.scene_files import Attachment, BodySpec, GridSpec, Keyframe, ParticleBlockSpec, RopeSpec, SceneDescription

if TYPE_CHECKING:
    from torchdlo.scene_files.run import Frames

LENGTH = 0.1
"""Moves are learned in this unit [m], turns in radians, so that one rate fits both."""


@dataclass(frozen=True)
class CutRodBody(RodBody):
    """`RodBody` whose forces on bodies have no derivative."""

    def solve_contact(self, view: View, motion: PredictedMotion, values: Values) -> ContactForces:
        """Return what `RodBody` does."""
        push = super().solve_contact(view, motion, values)
        return ContactForces(push.force, push.body_force.detach(), push.body_torque.detach(), push.material_points)


@dataclass(frozen=True)
class CutBodyMatter(BodyMpmCoupling):
    """`BodyMpmCoupling` whose impulses on matter have no derivative."""

    def couple_bodies_to_particles(self, motion: Any, material_points: Any, push: ContactForces) -> ContactForces:
        """Return what `BodyMpmCoupling` does."""
        before = material_points.nodes if push.material_points == () else push.material_points.nodes
        push = super().couple_bodies_to_particles(motion, material_points, push)
        vel = before.vel + (push.material_points.nodes.vel - before.vel).detach()
        return dataclasses.replace(
            push, material_points=TouchedParticles(tree.replace(before, vel=vel), push.material_points.lost)
        )


CUT = {RodBody: CutRodBody, BodyMpmCoupling: CutBodyMatter}


SHAKE = 0.01
"""Random change of keys, in the units in which they are learned."""

WORSE = 1.5
"""Times the best loss so far at which descent has gone too far."""


@dataclass(frozen=True)
class Problem:
    """A scene whose keys are learned."""

    title: str
    scene: Callable[[], SceneDescription]
    """The scene with the first guess; keys of holds, then of kinematic bodies, are learned."""
    free: tuple[float, ...]
    """1 for what is learned of a key: three of its move, three of its turn."""
    loss: Callable[[scene.State], Tensor]
    """What is made small, of the last state [m^2]."""
    measure: str
    """What has to be below `limit`, in words."""
    value: Callable[[Frames], float]
    limit: float
    iterations: int = 20
    rate: float = 0.1
    """Rate of Adam at the start, in `LENGTH` or radians; it is halved whenever descent has gone too far."""


def movers(d: SceneDescription) -> list[Any]:
    """Return the parts whose keys are learned."""
    return [part for part in (*d.attachments, *d.bodies) if part.keyframes]


def first_keys(d: SceneDescription) -> Tensor:
    """Return what keys say, in the units in which it is learned, shape (parts, keys, 6)."""
    rows = [[(*k.move, *k.turn) for k in part.keyframes] for part in movers(d)]
    return torch.tensor(rows, dtype=torch.float64) / torch.tensor([LENGTH] * 3 + [1.0] * 3, dtype=torch.float64)


def described(problem: Problem, keys: Tensor) -> SceneDescription:
    """Return the problem's scene with other keys (parts, keys, 6)."""
    d = problem.scene()
    rows = iter((keys * keys.new_tensor([LENGTH] * 3 + [1.0] * 3)).tolist())

    def with_keys(part: Any) -> Any:
        made = (Keyframe(k.time, tuple(r[:3]), tuple(r[3:])) for k, r in zip(part.keyframes, next(rows), strict=True))
        return dataclasses.replace(part, keyframes=tuple(made))

    holds, bodies = (tuple(with_keys(x) if x.keyframes else x for x in parts) for parts in (d.attachments, d.bodies))
    return dataclasses.replace(d, attachments=holds, bodies=bodies)


def controls(d: SceneDescription, made: scene_files.Simulation, keys: Tensor) -> scene.Control:
    """Return the controls of all steps, as `describe` makes them, with derivatives by keys (parts, keys, 6).

    Holds do not turn; all or none of them move.
    """
    plain = made.plan.controls
    time = torch.arange(1, len(plain.pos) + 1, dtype=keys.dtype) * d.dt
    at = keys.new_tensor([0.0, *(k.time for k in movers(d)[0].keyframes)])
    rows = torch.cat([torch.zeros_like(keys[:, :1]), keys], 1) * keys.new_tensor([LENGTH] * 3 + [1.0] * 3)
    last = (torch.searchsorted(at, time, right=True) - 1).clamp(max=len(at) - 2)
    s = ((time - at[last]) / (at[last + 1] - at[last])).clamp(0, 1)[:, None]
    moved = rows[:, last] + s**3 * (10 - 15 * s + 6 * s**2) * (rows[:, last + 1] - rows[:, last])
    still = scene.stationary_control(made.scene, made.state)
    owner = [k for k, h in enumerate(d.attachments) for _ in h.vertices if h.keyframes]
    pos = still.pos + moved[owner, :, :3].transpose(0, 1) if owner else plain.pos
    body = moved[sum(bool(h.keyframes) for h in d.attachments) :].transpose(0, 1)
    targets = BodyTargets(still.bodies.pos + body[..., :3], multiply(turn_by(body[..., 3:]), still.bodies.quat))
    return tree.replace(plain, pos=pos, bodies=targets)


@dataclass(frozen=True)
class Learned:
    """What came out."""

    losses: list[float]
    """At the start and after every step [m^2]."""
    gradient: float
    """Size of the gradient at the start."""
    keys: Tensor
    """The best keys, shape (parts, keys, 6)."""


def learn(
    problem: Problem,
    *,
    cut: bool,
    iterations: int,
    seed: int = 0,
    compiled: bool = False,
    callback: Callable[[int, int, str], None] | None = None,
) -> Learned:
    """Learn a problem's keys by Adam.

    Args:
        problem: the problem.
        cut: whether the forces on what has to be moved have no derivative.
        iterations: steps of Adam.
        seed: of the random change of the first guess, by a hundredth of the unit.
        compiled: whether to compile the steps.
        callback: told (steps done, in all, message) after every step.
    """
    d = problem.scene()
    made = scene_files.assemble(d)
    world = made.scene
    if cut:
        effects = tuple(CUT[type(e)](**vars(e)) if type(e) in CUT else e for e in world.effects)
        world = tree.replace(world, effects=effects)
    step, free = (
        scene.stepper(world, execution="compiled" if compiled else "eager"),
        torch.tensor(problem.free, dtype=torch.float64),
    )
    run = partial(scene.rollout, step, made.params, made.state, segment=10, keep=lambda s: s.time)
    random = torch.Generator().manual_seed(seed)

    def loss_of(keys: Tensor) -> Tensor:
        return problem.loss(run(controls(d, made, keys))[0])

    def shaken(keys: Tensor) -> Tensor:
        return keys + free * SHAKE * torch.randn(keys.shape, generator=random, dtype=keys.dtype)

    def tell(done: int, loss: float) -> None:
        if callback:
            callback(done, iterations, f"loss {loss:.3g}")

    return descend(loss_of, shaken(first_keys(d)), free, problem.rate, iterations, shaken, tell)


def descend(
    loss_of: Callable[[Tensor], Tensor],
    keys: Tensor,
    free: Tensor,
    rate: float,
    iterations: int,
    shaken: Callable[[Tensor], Tensor],
    tell: Callable[[int, float], None],
) -> Learned:
    """Follow the gradient of a loss by Adam, and go back where that leads too far.

    Args:
        loss_of: the loss.
        keys: where to begin.
        free: 1 for what is learned.
        rate: of Adam; it is halved whenever descent has gone too far.
        iterations: how many steps.
        shaken: changes keys a little.
        tell: told the number of steps and the loss after each.
    """
    losses, best, gradient = [], keys, 0.0
    for k in range(iterations + 1):
        if k == 0 or not keys.requires_grad:
            keys = keys.detach().clone().requires_grad_()
            optimiser = torch.optim.Adam([keys], lr=rate)
        loss = loss_of(keys)
        losses.append(float(loss.detach()))
        tell(k, losses[-1])
        if losses[-1] == min(losses):
            best = keys.detach().clone()
        if k == iterations:
            break
        if losses[-1] > WORSE * min(losses):
            # Where bodies begin or cease to touch, gradients change.
            keys, rate = best, 0.5 * rate
            continue
        (found,) = torch.autograd.grad(loss, keys, allow_unused=True)
        keys.grad = torch.zeros_like(keys) if found is None else free * found
        size = float(keys.grad.norm())
        gradient = size if k == 0 else gradient
        if size == 0:
            break  # Adam does not move without a gradient.
        if math.isfinite(size):
            optimiser.step()
        else:
            # Gradients grow without bounds where contact begins and ends many times: look beside.
            keys = shaken(best)
    return Learned(losses, gradient, best)


def measured(problem: Problem, frames: Frames) -> tuple[float, bool]:
    """Return what the problem measures of a run, and whether that solves it."""
    value = problem.value(frames)
    return value, value < problem.limit


def _slack(x: float, high: float, low: float) -> RopeSpec:
    """Return a soft rope between two hands; where it is taut, one that cannot stretch has gradients without bounds."""
    line = ((x, -0.12, high), (x, 0.0, low), (x, 0.12, high))
    return RopeSpec(line, 13, 0.006, density=900.0, bend=1e-4, stretch=5.0)


def _held(rope: RopeSpec, hands: tuple[Keyframe, ...], **others: Any) -> SceneDescription:
    """Return a scene of a soft rope whose ends both hands lead the same way."""
    effects = {name: {} for name in ("gravity", "bend", "stretch_force", "rod_body", "body_contact")}
    return SceneDescription(
        ropes=(rope,),
        effects=effects | {"damping": {"rate": 1.0}},
        attachments=(Attachment((0,), keyframes=hands), Attachment((-1,), keyframes=hands)),
        duration=0.4,
        dt=2e-3,
        substeps=1,
        constrained=False,
        **others,
    )


BALL_GOAL = (0.12, 0.03)


def push() -> SceneDescription:
    """A ball on the ground, and a slack rope between two hands behind it."""
    hands = tuple(Keyframe(t, (0.25 * t, 0.0, 0.0)) for t in (0.15, 0.3, 0.4))
    return _held(
        _slack(-0.05, 0.04, 0.012),
        hands,
        bodies=(
            BodySpec("sphere", (0.03,), (0.0, 0.0, 0.03), density=300.0, damping=1.0, name="ball"),
            BodySpec("plane", motion="fixed"),
        ),
        camera_direction=(0.35, -0.6, 0.7),
    )


def push_loss(state: scene.State) -> Tensor:
    """Squared distance of the ball from its goal [m^2]."""
    return (state.bodies.pos[0, :2] - state.bodies.pos.new_tensor(BALL_GOAL)).square().sum()


def push_value(frames: Frames) -> float:
    """Distance of the ball from its goal at the end [m]."""
    return float(((frames.body_pos[-1, 0, :2] - BALL_GOAL) ** 2).sum() ** 0.5)


RING_GOAL = (0.06, 0.05, 0.12)


def hook() -> SceneDescription:
    """A ring that stands on the ground, and a slack rope between two hands that is led through it."""
    hands = tuple(Keyframe(t, (0.0, 0.0, 0.2 * t)) for t in (0.15, 0.3, 0.4))
    return _held(
        _slack(0.0, 0.055, 0.04),
        hands,
        bodies=(
            BodySpec(
                "torus", (0.035, 0.008), (0.0, 0.0, 0.043), (0.5**0.5, 0.5**0.5, 0.0, 0.0), density=400.0, damping=1.0
            ),
            BodySpec("plane", motion="fixed"),
        ),
        camera_direction=(0.8, -0.6, 0.35),
    )


def hook_loss(state: scene.State) -> Tensor:
    """Squared distance of the ring from its goal [m^2]."""
    return (state.bodies.pos[0] - state.bodies.pos.new_tensor(RING_GOAL)).square().sum()


def hook_value(frames: Frames) -> float:
    """Distance of the ring from its goal at the end [m]."""
    return float(((frames.body_pos[-1, 0] - RING_GOAL) ** 2).sum() ** 0.5)


TARGET, HALF = (0.16, 0.01), 0.04


def pour() -> SceneDescription:
    """Sand on a plate between two smooth walls, above the ground; a rope marks the far end of the target."""
    across = 0.025
    keys = tuple(Keyframe(t, (0.0, 0.0, 0.0), (0.0, 2.0 * t, 0.0)) for t in (0.15, 0.3, 0.4))
    numbers = {"youngs": 5e3, "density": 1000.0}
    heap = ParticleBlockSpec(
        "sand", (0.03, across / 2, 0.0125), 0.00625, "box", (0.0, across / 2, 0.131), parameters=numbers
    )
    return SceneDescription(
        ropes=(
            RopeSpec(
                ((TARGET[0] + HALF, 0.0, 0.004), (TARGET[0] + HALF, across, 0.004)), 3, 0.004, density=900.0, bend=1e-5
            ),
        ),
        effects={"gravity": {}, "body_mpm_coupling": {"room": 300}},
        bodies=(
            BodySpec("box", (0.05, 0.05, 0.0125), (0.0, across / 2, 0.1), motion="kinematic", keyframes=keys, mu_k=0.1),
        ),
        attachments=(Attachment((0, 1, 2)),),
        material_points=(heap,),
        box=GridSpec(
            (-0.15, 0.0, 0.0), (0.35, across, 0.225), 0.0125, ("separate",) * 2 + ("slip",) * 2 + ("separate",) * 2
        ),
        duration=0.5,
        dt=2e-3,
        substeps=1,
        camera_direction=(0.1, -1.0, 0.25),
    )


def pour_loss(state: scene.State) -> Tensor:
    """Mean square distance of the sand from its target [m^2]."""
    return (state.material_points.pos[:, [0, 2]] - state.material_points.pos.new_tensor(TARGET)).square().sum(-1).mean()


def pour_value(frames: Frames) -> float:
    """Share of the sand that is not on its target at the end [1]."""
    x, z = frames.material_points[-1, :, 0], frames.material_points[-1, :, 2]
    return float(1 - ((abs(x - TARGET[0]) < HALF) & (z < 0.05)).mean())


PROBLEMS = {
    "push": Problem(
        "a rope pushes a ball to a goal",
        push,
        (1, 1, 0, 0, 0, 0),
        push_loss,
        "distance from the goal [m]",
        push_value,
        0.015,
    ),
    "hook": Problem(
        "a rope carries a ring to a goal",
        hook,
        (1, 1, 1, 0, 0, 0),
        hook_loss,
        "distance from the goal [m]",
        hook_value,
        0.015,
    ),
    "pour": Problem(
        "a plate pours sand on a target",
        pour,
        (1, 0, 1, 0, 1, 0),
        pour_loss,
        "share off the target [1]",
        pour_value,
        0.3,
        iterations=12,
        rate=0.05,
    ),
}
