"""Problems to search: some with a known optimum, one with a contact that gradients do not see from afar, one rope."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchdlo import scene
from torchdlo.agents.trajopt.problem import Evaluation
from torchdlo.physics import tree
from torchdlo.physics.effects.elastic import Bend
from torchdlo.physics.effects.external import Damping, Gravity
from torchdlo.physics.effects.table import Table, TableFriction
from torchdlo.physics.linalg import numerics


def judged(returns: Tensor, success: Tensor) -> Evaluation:
    """An outcome whose loss is the negative return."""
    return Evaluation(returns, -returns, 0 * returns, success, ~torch.isfinite(returns))


class Plain:
    """What the problems share."""

    choices: ClassVar[dict[str, Any]] = {}
    touch: ClassVar[tuple[tuple[float, float, float], ...]] = ()
    tools: ClassVar[tuple[tuple[float, float, float], ...]] = ()

    def surrogate(self) -> Any:
        """There is none."""

    def varied(self, copies: int, scale: float, seed: int) -> Varied:
        """The same problem with its target moved."""
        return Varied(self, copies, scale, seed)

    def record(self, actions: Tensor) -> tuple[Evaluation, dict[str, Any]]:
        """How it went; nothing besides."""
        return self.evaluate(actions[None]), {"end": actions.sum(0).tolist()}


@dataclass(frozen=True)
class Varied(Plain):
    """A problem with its start shifted by up to 2 cm."""

    inner: Any
    copies: int
    scale: float
    seed: int

    def evaluate(self, actions: Tensor) -> Evaluation:
        """Means over the copies."""
        rng = torch.Generator().manual_seed(self.seed)
        outcomes = []
        for _ in range(self.copies):
            shift = 0.02 * self.scale * (2 * torch.rand(3, generator=rng, dtype=torch.float64) - 1)
            outcomes.append(
                replace(self.inner, start=tuple((torch.tensor(self.inner.start) + shift).tolist())).evaluate(actions)
            )
        names = ("returns", "loss", "terminal_cost")
        means = (torch.stack([getattr(o, n) for o in outcomes]).mean(0) for n in names)
        return Evaluation(
            *means,
            torch.stack([o.success for o in outcomes]).all(0),
            torch.stack([o.failed for o in outcomes]).any(0),
        )


@dataclass(frozen=True)
class Reach(Plain):
    """A point that is to follow a path: the sum of squared distances to way-points that can be reached exactly."""

    name: str = "reach"
    horizon: int = 20
    width: int = 3
    group: int = 3
    limit: float = 0.01
    start: tuple[float, float, float] = (0.0, 0.0, 0.0)
    goal: tuple[float, float, float] = (0.06, -0.08, 0.05)

    def evaluate(self, actions: Tensor) -> Evaluation:
        """The optimum is 0: the straight path to the goal, half a centimetre and more below what the limit allows."""
        path = actions.new_tensor(self.start) + actions.cumsum(1)
        share = torch.linspace(0, 1, self.horizon + 1, dtype=actions.dtype)[1:, None]
        wanted = share * actions.new_tensor(self.goal)
        returns = -100 * (path - wanted).square().sum((1, 2))
        return judged(returns, (path[:, -1] - wanted[-1]).norm(dim=-1) < 0.01)


@dataclass(frozen=True)
class Peaks(Plain):
    """A tip that earns most on a peak of 8 mm, which a start 2 cm off misses, and nearly as much on one of 6 cm."""

    name: str = "peaks"
    horizon: int = 4
    width: int = 3
    group: int = 3
    limit: float = 0.02
    start: tuple[float, float, float] = (0.0, 0.0, 0.0)
    narrow: tuple[float, float, float] = (0.03, 0.0, 0.0)
    broad: tuple[float, float, float] = (-0.03, 0.0, 0.0)

    def evaluate(self, actions: Tensor) -> Evaluation:
        """One at the narrow peak, 0.8 at the broad one."""
        tip = actions.new_tensor(self.start) + actions.sum(1)
        away = [(tip - actions.new_tensor(p)).square().sum(-1) for p in (self.narrow, self.broad)]
        returns = torch.maximum((-away[0] / 0.008**2).exp(), 0.8 * (-away[1] / 0.06**2).exp())
        return judged(returns, away[0] < 0.01**2)


@dataclass(frozen=True)
class Push(Plain):
    """A finger that may push a disc to a goal: nothing changes before it touches, so that gradients are zero at
    first."""

    name: str = "push"
    horizon: int = 30
    width: int = 3
    group: int = 3
    limit: float = 0.01
    start: tuple[float, float, float] = (0.0, 0.0, 0.0)
    disc: tuple[float, float] = (0.1, 0.03)
    goal: tuple[float, float] = (0.14, 0.12)
    reach: float = 0.03
    """Distance at which finger and disc touch [m]."""

    def evaluate(self, actions: Tensor) -> Evaluation:
        """The disc goes where it is pushed; the return is the mean closeness to the goal, 1 at most."""
        tips = actions.new_tensor(self.start)[:2] + actions[..., :2].cumsum(1)
        disc = actions.new_tensor(self.disc).expand(len(actions), 2)
        far = (disc - actions.new_tensor(self.goal)).norm(dim=-1)
        returns = actions.new_zeros(len(actions))
        for tip in tips.unbind(1):
            gap = disc - tip
            length = numerics.safe_norm(gap)
            disc = disc + (self.reach - length).clamp(min=0) * numerics.normalize(gap)
            left = numerics.safe_norm(disc - actions.new_tensor(self.goal))[:, 0]
            returns = returns + (1 - left / far) / self.horizon
        return judged(returns, left < 0.01)


@dataclass(frozen=True)
class SurrogateRound(Push):
    """The same with a disc that is a little smaller than that of its surrogate task, and a note of what was played."""

    name: str = "surrogate_share"
    reach: float = 0.028
    played: list[str] = field(default_factory=list, compare=False)

    def evaluate(self, actions: Tensor) -> Evaluation:
        """Note that it was played."""
        self.played.append("earnest")
        return super().evaluate(actions)

    def surrogate(self) -> Any:
        """The plain one, with its disc of the usual size."""
        return _Rehearsal(played=self.played)


@dataclass(frozen=True)
class _Rehearsal(Push):
    played: list[str] = field(default_factory=list, compare=False)

    def evaluate(self, actions: Tensor) -> Evaluation:
        """Note that it was played."""
        self.played.append("surrogate")
        return super().evaluate(actions)


@dataclass(frozen=True)
class Drag(Plain):
    """A rope of ten vertices on a rough table, one end dragged: to lie in a hook after the last action."""

    name: str = "drag"
    horizon: int = 6
    width: int = 3
    group: int = 3
    limit: float = 0.03
    start: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def evaluate(self, actions: Tensor) -> Evaluation:
        """The loss is the mean squared distance of the vertices to the goal [m2]."""
        line = torch.zeros(10, 3, dtype=torch.float64)
        line[:, 0], line[:, 2] = 0.02 * torch.arange(10), 0.005
        line = (line + torch.tensor(self.start, dtype=torch.float64)).expand(len(actions), 10, 3)
        rope = scene.Rope(line, radius=0.005, density=1000.0, bend=1e-5)
        effects = [Gravity(), Bend(), Damping(), Table(), TableFriction()]
        numbers = {"damping": {"rate": 10.0}}
        world, params, state = scene.make(
            [rope], effects, numbers, dt=2e-2, substeps=4, integrator="implicit", prescribed_vertices=(0,)
        )
        control = scene.stationary_control(world, state)
        paths = control.pos[:, None] + (actions * actions.new_tensor([1.0, 1.0, 0.0])).cumsum(1)[:, :, None]
        controls = tree.map(lambda c: c.expand(self.horizon, *c.shape), control)
        controls = tree.replace(controls, pos=paths.transpose(0, 1))
        last, _ = scene.rollout(scene.stepper(world, execution="eager"), params, state, controls, keep=lambda s: s.time)
        angle = torch.linspace(0, 3.0, 10, dtype=torch.float64)
        goal = 0.06 * torch.stack([1 - angle.cos(), angle.sin(), 0 * angle], -1) + torch.tensor([0.0, 0.05, 0.0])
        loss = (last.rods.pos - goal)[..., :2].square().sum(-1).mean(-1)
        return Evaluation(-loss, loss, 0 * loss, loss < 0.02**2, ~scene.finite(last))


def signature(actions: Tensor) -> str:
    """A hash of every bit of a trajectory."""
    return hashlib.sha256(actions.contiguous().numpy().tobytes()).hexdigest()
