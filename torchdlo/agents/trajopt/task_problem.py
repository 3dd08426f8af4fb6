"""Manipulation tasks as problems of trajectory optimisation: tools move, and keep their orientation."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchdlo.agents.trajopt.problem import Evaluation
from torchdlo.agents.trajopt.search_result import execution_of, read_trajectory
from torchdlo.coupling.common import step_diagnostics
from torchdlo.envs import PUBLISHED, Fidelity, RopeMaterial, find, with_fidelity
from torchdlo.envs.core import episode
from torchdlo.envs.core.subtask import SubTask, with_reward
from torchdlo.envs.core.task import Task
from torchdlo.errors import InputError
from torchdlo.physics import tree
from torchdlo.physics.execution import Execution
from torchdlo.reward_language import Reward, read_reward
from torchdlo.untrusted import Entry

__all__ = ["TaskProblem", "task_problem", "trajectory_problem"]


def task_problem(
    name: str,
    rope: RopeMaterial | None = None,
    *,
    grasps: Sequence[int | None] | None = None,
    reward: Reward | None = None,
    **choices: Any,
) -> TaskProblem:
    """Return the problem of a task by its name, with a rope of its own or a given one.

    Args:
        name: of the task.
        rope: see `torchdlo.envs.make`.
        grasps: see there.
        reward: what it is judged by, if not what the task says.
        choices: fields of `TaskProblem`.
    """
    task = find(name, rope, grasps)
    return TaskProblem(task if reward is None else with_reward(task, reward), **choices)


def trajectory_problem(path: Path, task: Task, rope: RopeMaterial | None = None) -> TaskProblem:
    """Return the problem in which a trajectory was found: with its grasps, reward, fidelity, precision and steps.

    Args:
        path: file that `torchdlo optimize` wrote; one without choices was found in the task as it is.
        task: the task that it names.
        rope: what ropes are made of, which a trajectory that was found for another rope than the task's needs.

    Raises:
        InputError: It needs a rope, goes on from another trajectory, or its choices are none.
    """
    found = read_trajectory(path)
    task = task if rope is None else replace(task, rope=rope)
    if "choices" not in found:
        return TaskProblem(task, execution=episode.quick_execution(task))
    choices = found["choices"]
    if "part" in choices:
        raise InputError(
            f"{path}: it is a part of a task, which goes on from where another part ended; give one that was searched "
            "from the task's start."
        )
    if choices.get("rope").value is not None and rope is None:
        raise InputError(f"{path}: it was found for its own rope; give that one, or another, with --rope-model.")
    if choices.get("grasps").value is not None:
        hands = choices["grasps"].items(100)
        task = replace(task, grasps=tuple(None if hand.value is None else hand.whole(0, 10**6) for hand in hands))
    if "fidelity" in choices:
        task = with_fidelity(task, _fidelity(choices["fidelity"]))
    if "reward" in choices:
        task = with_reward(task, read_reward(choices["reward"].value, f"{path}: choices.reward"))
    return TaskProblem(task, double=choices["double"].flag(), execution=execution_of(choices))


def _fidelity(said: Entry) -> Fidelity:
    step, substeps = said["step"].number(1e-3, 1.0, "s"), said["substeps"].whole(1, 1000)
    return Fidelity(step, substeps, said["integrator"].text(most=20))


@dataclass(frozen=True, eq=False)
class TaskProblem:
    """A task from its one start, without variation."""

    task: Task
    double: bool = False
    """Whether the physics runs in double precision."""
    execution: Execution = "compiled"
    """How steps run, see `torchdlo.scene.stepper`."""
    device: str = "cpu"
    _episodes: dict[int, episode.Episode] = field(default_factory=dict)
    """Prepared once per size of batch."""

    group = 3

    @property
    def name(self) -> str:
        """The task's name."""
        return self.task.name

    @property
    def horizon(self) -> int:
        """Actions of an episode."""
        return self.task.horizon

    @property
    def width(self) -> int:
        """Ways of all tools: three numbers each."""
        return 3 * self.task.arms.count

    @property
    def limit(self) -> float:
        """Greatest way of a tool in an action [m]."""
        return self.task.max_translation

    @property
    def touch(self) -> tuple[tuple[float, float, float], ...]:
        """Where solids and matter are, from the middle of the tools [m]; planes are everywhere."""
        return self._places[0]

    @property
    def tools(self) -> tuple[tuple[float, float, float], ...]:
        """Where tools are at the start, from the middle of them all [m]."""
        return self._places[1]

    @functools.cached_property
    def _places(self) -> tuple[tuple[tuple[float, float, float], ...], ...]:
        scene, _, state = self.task.start(1, like=torch.zeros((), dtype=torch.float64))
        things = [tree.part(state.bodies).pos[0, k] for k, body in enumerate(scene.bodies) if body.shape != "plane"]
        if state.material_points:
            things.append(state.material_points.pos[0].mean(0))
        tools = state.rods.pos[0, list(self.task.arms.vertex)]
        return tuple(tuple(tuple((p - tools.mean(0)).tolist()) for p in places) for places in (things, tools))

    @property
    def choices(self) -> dict[str, Any]:
        """What else results depend on."""
        rope = {} if self.task.rope is None else {"rope": asdict(self.task.rope)}
        grasps = {} if self.task.grasps is None else {"grasps": list(self.task.grasps)}
        part = self.task.identity if isinstance(self.task, SubTask) else {}
        # Files from before it could be chosen are of the published one, and do not name it.
        how = {} if self.task.fidelity == PUBLISHED else {"fidelity": self.task.fidelity.plain()}
        return {"double": self.double, "execution": self.execution, "device": self.device} | rope | grasps | part | how

    @property
    def like(self) -> Tensor:
        """A tensor of the dtype and on the device of the physics."""
        return torch.zeros((), dtype=torch.float64 if self.double else torch.float32, device=self.device)

    def prepared(self, count: int) -> episode.Episode:
        """Return the episode for a batch; gradients run five frames again at once."""
        if count not in self._episodes:
            self._episodes[count] = episode.prepare(
                self.task, count, like=self.like, execution=self.execution, segment=5
            )
        return self._episodes[count]

    def full(self, actions: Tensor) -> Tensor:
        """Return the task's actions, shape (P, T, 2 A): tools do not turn."""
        return torch.cat([actions, torch.zeros_like(actions)], -1).to(self.like)

    def evaluate(self, actions: Tensor) -> Evaluation:
        """Play actions from the one start."""
        went = episode.play(self.task, self.full(actions), episode=self.prepared(len(actions)))
        return _outcome(went)

    def surrogate(self) -> TaskProblem | None:
        """Return the problem of the task's surrogate task, if it has one."""
        found = self.task.surrogate()
        choices = (self.double, self.execution, self.device)
        return None if found is None else TaskProblem(found, *choices)

    def varied(self, copies: int, scale: float, seed: int) -> Varied:
        """Return the problem with `copies` starts that differ by `scale` times what the task calls its spread."""
        if not any(value for pair in self.task.reset_noise for value in pair):
            raise InputError(f"{self.name}: its start does not vary; leave out --robust.")
        return Varied(self, copies, scale, seed)

    def record(self, actions: Tensor) -> tuple[Evaluation, dict[str, Any]]:
        """Play one trajectory alone.

        Kept are joints and tools after every action, by arm, [rad or m] and [m], rewards, and what contact missed: ""
        if all is well.
        """
        went = episode.play(self.task, self.full(actions[None]), episode=self.prepared(1), keep=episode.scene_positions)
        kept: dict[str, Any] = {name: went.path[name][:, 0].tolist() for name in ("joints", "tool")}
        kept["rewards"] = went.rewards[:, 0].tolist()
        kept["missed"] = step_diagnostics.explain_diagnostics(went.world.state.diagnostics)
        finite = all(math.isfinite(value) for value in kept["rewards"])
        return _outcome(went), kept if finite else {}


@dataclass(frozen=True, eq=False)
class Varied:
    """A task from several starts; every trajectory is played from all of them, and the means count."""

    inner: TaskProblem
    copies: int
    scale: float
    seed: int

    def evaluate(self, actions: Tensor) -> Evaluation:
        """Return means of return and loss; success means from all starts, failure from any."""
        task, like = self.inner.task, self.inner.like
        count = len(actions) * self.copies
        rng = torch.Generator().manual_seed(self.seed)
        draw = torch.rand(self.copies, len(task.reset_noise), 2, generator=rng, dtype=torch.float64)
        away = self.scale * (2 * draw - 1) * torch.tensor(task.reset_noise, dtype=torch.float64)
        moved = torch.cat([away, torch.zeros_like(away[..., :1])], -1).to(like).repeat(len(actions), 1, 1)
        _, params, state = task.build(moved)
        base = self.inner.prepared(count)
        base = replace(base, params=params, start=episode.begin(replace(base, params=params), state))
        went = episode.play(task, self.inner.full(actions).repeat_interleave(self.copies, 0), episode=base)
        each = tree.map(lambda x: x.reshape(len(actions), self.copies), _outcome(went))
        returns, loss, cost = (x.mean(-1) for x in (each.returns, each.loss, each.terminal_cost))
        return Evaluation(returns, loss, cost, each.success.all(-1), each.failed.any(-1))


def _outcome(went: episode.EpisodeResult) -> Evaluation:
    return Evaluation(went.returns, went.loss, went.terminal_cost, went.success, went.failed)
