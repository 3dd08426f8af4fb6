"""Episodes in batches, all of the same length and in step: what every trainer here plays.

An episode that fails goes on without earning, so that batches stay in step; what comes after is not learned from. The
end of the time is an end: the share of the episode that is over is part of what policies see, so that there is nothing
to bootstrap there.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Protocol

import torch
from torch import Tensor

from torchdlo.agents.rl.disturbances import drawn_params
from torchdlo.envs import Task
from torchdlo.envs.core.episode import EpisodeState
from torchdlo.errors import InputError
from torchdlo.physics.execution import Execution

__all__ = ["EnvEpisodes", "Episodes", "TaskEpisodes", "Transition"]


@dataclass(frozen=True, eq=False)
class Transition:
    """What an action led to."""

    observation: Tensor
    """Shape (N, O)."""
    reward: Tensor
    """Shape (N,); 0 for episodes that failed."""
    failed: Tensor
    """Whether episodes have failed, bool, shape (N,)."""
    success: Tensor
    """Whether the goal is reached now, bool, shape (N,)."""


class Episodes(Protocol):
    """A batch of episodes that are played in step."""

    count: int
    """Episodes in the batch, N."""
    horizon: int
    """Actions of an episode, T."""
    generator: torch.Generator
    """Where starts come from."""
    first: Tensor
    """What was seen at the start, shape (N, O)."""

    def reset(self) -> Tensor:
        """Begin anew; return observations (N, O)."""

    def step(self, action: Tensor) -> Transition:
        """Do actions (N, A) of the environment."""

    def detach(self) -> None:
        """Cut the history of gradients."""

    def close(self) -> None:
        """End what was begun for them."""


class EnvEpisodes:
    """Episodes of any TorchRL environment with one axis of the batch, of which `keys` are seen."""

    def __init__(self, env: Any, horizon: int, keys: tuple[str, ...] = ("observation",)) -> None:
        """Wrap an environment, which keeps its random numbers in `env.generator`."""
        self.env, self.horizon, self.keys = env, horizon, keys
        self.count = env.batch_size[0]
        self.generator: torch.Generator = env.generator
        self._td: Any = None
        self._failed = torch.zeros(self.count, dtype=torch.bool, device=env.device)

    def _seen(self, td: Any) -> Tensor:
        return torch.cat([td.get(key).reshape(self.count, -1) for key in self.keys], -1)

    def reset(self) -> Tensor:
        """Begin anew; return observations (N, O)."""
        self._td = self.env.reset()
        self._failed = torch.zeros(self.count, dtype=torch.bool, device=self.env.device)
        self.first = self._seen(self._td).detach()
        return self.first

    def step(self, action: Tensor) -> Transition:
        """Do actions (N, A)."""
        from torchrl.envs.utils import step_mdp

        td = self.env.step(self._td.set("action", action))
        after = td.get("next")
        self._td = step_mdp(td)
        before = self._failed
        self._failed = before | after.get("terminated").reshape(self.count)
        reward = torch.where(before, 0.0, after.get("reward").reshape(self.count))
        success = after.get("success", None)
        success = torch.zeros_like(before) if success is None else success.reshape(self.count)
        return Transition(self._seen(after), reward, self._failed, success)

    def detach(self) -> None:
        """Cut the history of gradients."""
        self._td = self._td.detach()
        if hasattr(self.env, "detach"):
            self.env.detach()

    def close(self) -> None:
        """Do nothing: the environment is whose it was."""


class TaskEpisodes:
    """Episodes of a task."""

    def __init__(
        self,
        task: Task,
        count: int,
        *,
        seed: int = 0,
        variation: bool = True,
        gradients: bool = False,
        execution: Execution | None = None,
        dtype: torch.dtype = torch.float32,
        ends: float = 1.0,
        scale: float = 1.0,
        bonus: float = 0.0,
        barrier: float = 0.0,
        auxiliary: float = 0.0,
        randomize: dict[str, float] | None = None,
        disturbed: float = 0.0,
        device: torch.device | str = "cpu",
    ) -> None:
        """Make the scenes.

        Args:
            task: the task, in the fidelity in which it is to be played.
            count: episodes in the batch.
            seed: of the starts.
            variation: whether starts differ.
            gradients: whether rewards carry gradients to actions.
            execution: how steps run; if not given, compiled on a GPU, and on the CPU eager with gradients and else as
                `quick_execution` says.
            dtype: of the physics.
            ends: what share of what an end lacks to success is subtracted from the last reward. An episode that fails
                pays at once for the worst moment so far, the start among them.
            scale: what rewards are multiplied by.
            bonus: what success earns at the end, after scaling.
            barrier: what an action costs, after scaling, after which a rope is stretched as far as the task allows; it
                grows from half of that on as the square. An episode that fails pays it for each action that is left.
            auxiliary: what share of what `Task.auxiliary_loss` has fallen by since the start is added to each reward,
                before scaling. Counted from the start, values stay near 0. An episode that fails pays for each action
                that is left as much as for the worst so far.
            randomize: see `torchdlo.envs.make`.
            disturbed: by how much friction and stiffness of ropes differ from scene to scene, as shares of their own;
                drawn at every reset.
            device: where they are played.
        """
        from torchdlo.envs.core.env import DloEnv
        from torchdlo.envs.core.episode import quick_execution

        gpu = torch.device(device).type == "cuda"
        quick: Execution = "compiled" if gpu else ("eager" if gradients else quick_execution(task))
        self.env = DloEnv(
            task,
            num_envs=count,
            device=device,
            dtype=dtype,
            seed=seed,
            gradients=gradients,
            execution=execution or quick,
            # Recorded steps of a GPU differentiate the last frame alone without running it once more.
            segment=1 if gpu else 5,
            variation=variation,
            randomize=randomize,
        )
        self.task, self.count, self.horizon = task, count, task.horizon
        self.generator = self.env.generator
        self.ends, self.scale, self.bonus, self.barrier = ends, scale, bonus, barrier
        self.auxiliary, self._first_loss = auxiliary, torch.zeros(count, dtype=dtype, device=device)
        self._least, self._most = torch.zeros_like(self._first_loss), torch.zeros_like(self._first_loss)
        if disturbed and randomize:
            raise InputError("randomize and disturbed: both draw friction anew; give one of them.")
        self.disturbed, self._usual = disturbed, self.env.episode.params
        self.random: Tensor | None = None
        """What decided the friction and the stiffness of each scene, (N, 2); None where they are the usual ones."""
        self._over = 0
        self.returns = torch.zeros(count, device=device)
        """What the task itself pays, without the rest."""

    def reset(self) -> Tensor:
        """Begin anew; return observations (N, O)."""
        self._over = 0
        self.returns = torch.zeros_like(self.returns)
        if self.disturbed:
            self.disturb(torch.rand(self.count, 2, generator=self.generator))
        elif self.random is not None:
            self.random = None
            self.env.episode = replace(self.env.episode, params=self._usual)
        self.first = self.env.reset()["observation"].detach()
        self._measure_start()
        return self.first

    @torch.no_grad()
    def _measure_start(self) -> None:
        """Note what later costs are compared with."""
        from torchdlo.envs.core import episode

        self._first_loss = self._auxiliary_loss(self.env.world)
        self._least, self._most = torch.zeros_like(self._first_loss), torch.zeros_like(self._first_loss)
        if self.ends:
            self._note_costs(episode.terminal_costs(self.task, self.env.world))

    def disturb(self, random: Tensor) -> None:
        """Give each scene a friction and a stiffness of its own, which numbers (N, 2) between 0 and 1 decide."""
        env = self.env
        self.random = random
        params = drawn_params(self._usual, self.disturbed, env.episode.scene, self.task, random)
        env.episode = replace(env.episode, params=params)

    def begin(self, moved: Tensor) -> Tensor:
        """Begin anew with things that far off their places [m], shape (N, things, 3); return observations (N, O)."""
        from torchdlo.envs.core import episode

        self.reset()
        env = self.env
        with torch.no_grad():
            moved = moved.to(self.returns.device)
            env.world, env.moved = episode.begin(env.episode, episode.laid_down(self.task, moved)[2]), moved
            self.first = episode.observe(env.episode, env.world)
        self._measure_start()
        return self.first

    def step(self, action: Tensor) -> Transition:
        """Do actions (N, 6 R) in metres and degrees."""
        from torchdlo.envs.core import episode

        before = self.env.world.failed
        step, env = self.env.advance(action), self.env
        self._over += 1
        plain, world = step.reward.float(), step.world
        self.returns = self.returns + plain.detach()
        reward, success = self.scale * plain, episode.successes(self.task, world)
        if self._over == self.horizon:
            reward = reward + self.bonus * success
        if self.ends:
            reward = reward - self.ends * self.scale * self._lacking(before).float()
        # Failing must not cost less than what would have been left to pay.
        left = (1 + self.horizon - self._over) * (world.failed & ~before)
        if self.auxiliary:
            fallen = torch.where(world.failed, 0.0, self._first_loss - self._auxiliary_loss(world))
            self._least = torch.minimum(self._least, fallen.detach())
            fallen = fallen + left * self._least
            reward = reward + self.auxiliary * self.scale * fallen.float()
        if self.barrier:
            reward = reward - self.barrier * torch.where(world.failed, left, self._tension(world)).float()
        return Transition(episode.observe(env.episode, world), reward, world.failed, success)

    def _lacking(self, before: Tensor) -> Tensor:
        """Return what episodes lack to success that end with the last action, 0 in others, (N,).

        Those that fail lack as much as in the worst moment so far: else failing were better than not succeeding.
        """
        from torchdlo.envs.core import episode

        world, last = self.env.world, self._over == self.horizon
        with torch.set_grad_enabled(last and torch.is_grad_enabled()):
            now = episode.terminal_costs(self.task, world)
        self._note_costs(now.detach())
        fell = torch.where(world.failed & ~before, self._most, 0.0)
        return now + fell if last else fell

    def _note_costs(self, now: Tensor) -> None:
        self._most = torch.where(torch.isfinite(now), torch.maximum(self._most, now), self._most)

    def _auxiliary_loss(self, world: EpisodeState) -> Tensor:
        """Return the sum of the task's terms, (N,)."""
        terms = self.task.auxiliary_loss(world.seen(self.task.arms.count)) if self.auxiliary else {}
        if self.auxiliary and not terms:
            raise InputError(f"auxiliary: {self.task.name} declares no auxiliary loss; leave it at 0.")
        return sum(terms.values(), torch.zeros_like(self._first_loss))

    def _tension(self, world: EpisodeState) -> Tensor:
        """Return how near ropes are to tearing: 0 up to half of the stretch that is allowed, 1 at all of it, (N,)."""
        seen = world.seen(self.task.arms.count)
        now = self.task.rest(seen, self.env.episode.scene.topology)
        used = (now / seen.notes["rest"] - 1) / (self.task.stretch - 1)
        # The tightest of them, as one that tears ends the episode; none of no ropes between hands.
        return torch.nn.functional.pad((2 * used - 1).clamp(min=0), (1, 0)).amax(-1).square()

    def detach(self) -> None:
        """Cut the history of gradients."""
        self.env.detach()

    def close(self) -> None:
        """Do nothing."""
