"""Tasks as Gymnasium environments: one scene, or a batch of them as a vector environment. Needs the extra `rl`.

Observations hold what a policy may see; success and the terms of the reward are in the info.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from tensordict import TensorDict

from torchdlo import envs
from torchdlo.envs.core.env import DloEnv
from torchdlo.envs.core.task import Task
from torchdlo.errors import InputError

__all__ = ["GymnasiumEnv", "GymnasiumVectorEnv", "register"]

_IMAGES = ("pixels", "masks", "depth", "points")
"""Observations of cameras; with them, observations are dictionaries."""

_REFUSED = ("num_envs", "gradients")
"""Options of `envs.make` that have no meaning here."""


def register() -> list[str]:
    """Register all tasks as "torchdlo/NAME-v0", for `gymnasium.make` and `gymnasium.make_vec`; return the names."""
    names = []
    for task in envs.TASKS | envs.PAIRED_TASKS:
        name = f"torchdlo/{task}-v0"
        names.append(name)
        if name not in gymnasium.registry:
            gymnasium.register(
                name,
                entry_point="torchdlo.envs.gymnasium_envs:GymnasiumEnv",
                vector_entry_point="torchdlo.envs.gymnasium_envs:GymnasiumVectorEnv",
                kwargs={"task": task},
            )
    return names


class GymnasiumEnv(gymnasium.Env):
    """One scene of a task. The observation is a vector, or a dictionary if there are pictures."""

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012  # declared like that by gymnasium

    def __init__(self, task: str | Task, *, scaled_actions: bool = True, render_mode: None = None, **options: Any):
        """Make the scene.

        Args:
            task: a name of `envs.TASKS`, or a task of your own.
            scaled_actions: whether actions are from -1 to 1; in metres and degrees if not.
            render_mode: None; there are no others.
            options: of `envs.make`.
        """
        self._batch = _made(task, 1, scaled_actions, render_mode, options)
        self.observation_space, self.action_space = _spaces(self._batch)
        self.render_mode = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode; see `gymnasium.Env.reset`."""
        super().reset(seed=seed)
        if seed is not None:
            self._batch.set_seed(seed)
        found = self._batch._reset(None)
        return _row(_observed(found)), _told(found)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Take an action; see `gymnasium.Env.step`."""
        found = _stepped(self._batch, np.asarray(action)[None])
        flags = (bool(found[name]) for name in ("terminated", "truncated"))
        return _row(_observed(found)), float(found["reward"]), *flags, _told(found)

    def close(self) -> None:
        """Let go of the scene."""
        self._batch.close()


class GymnasiumVectorEnv(VectorEnv):
    """A batch of scenes of a task. Episodes that ended begin anew in the next step, as Gymnasium has it by default."""

    metadata: dict[str, Any] = {"render_modes": [], "autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012

    def __init__(
        self,
        task: str | Task,
        *,
        num_envs: int = 1,
        scaled_actions: bool = True,
        render_mode: None = None,
        max_episode_steps: int | None = None,
        **options: Any,
    ) -> None:
        """Make the scenes; arguments as in `GymnasiumEnv`.

        Args:
            task: a name of `envs.TASKS`, or a task of your own.
            num_envs: scenes in the batch.
            scaled_actions: see `GymnasiumEnv`.
            render_mode: None.
            max_episode_steps: None, or the task's horizon: a task says itself how long its episodes are.
            options: of `envs.make`.
        """
        self._batch = _made(task, num_envs, scaled_actions, render_mode, options)
        if max_episode_steps not in (None, self._batch.task.horizon):
            raise InputError(
                f"max_episode_steps: it is {max_episode_steps!r}; episodes of this task have "
                f"{self._batch.task.horizon} actions: leave it out, or give a task with another `horizon`."
            )
        self.num_envs, self.render_mode = num_envs, None
        self.single_observation_space, self.single_action_space = _spaces(self._batch)
        self.observation_space, self.action_space = (
            batch_space(space, num_envs) for space in (self.single_observation_space, self.single_action_space)
        )
        self._over = np.zeros(num_envs, bool)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin episodes; see `gymnasium.vector.VectorEnv.reset`. Scenes share one stream of random numbers."""
        first = next((s for s in seed if s is not None), None) if isinstance(seed, list) else seed
        super().reset(seed=first)
        if first is not None:
            self._batch.set_seed(first)
        mask = (options or {}).get("reset_mask")
        again = np.ones(self.num_envs, bool) if mask is None else np.asarray(mask, bool)
        found = self._begun(again) if not again.all() else self._batch._reset(None)
        self._over = self._over & ~again
        return _observed(found), _many(_told_all(found))

    def step(self, actions: Any) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Take actions; see `gymnasium.vector.VectorEnv.step`."""
        actions, again = np.array(actions, np.float32), self._over
        # What is said to scenes that begin anew does not count.
        actions[again] = 0.0
        found = _stepped(self._batch, actions)
        reward, terminated, truncated = (
            found[name].squeeze(-1).cpu().numpy().copy() for name in ("reward", "terminated", "truncated")
        )
        if again.any():
            found = self._begun(again)
            reward[again], terminated[again], truncated[again] = 0.0, False, False
        self._over = terminated | truncated
        return _observed(found), reward.astype(np.float64), terminated, truncated, _many(_told_all(found))

    def _begun(self, again: np.ndarray) -> TensorDict:
        """Return what all scenes look like after some begin anew."""
        mask = torch.as_tensor(again, device=self._batch.device).unsqueeze(-1)
        return self._batch._reset(TensorDict({"_reset": mask}, self._batch.batch_size, self._batch.device))

    def close_extras(self, **_: Any) -> None:
        """Let go of the scenes."""
        self._batch.close()


def _made(
    task: str | Task, num_envs: int, scaled_actions: bool, render_mode: str | None, options: Mapping[str, Any]
) -> DloEnv:
    if render_mode is not None:
        raise InputError(f"render_mode: it is {render_mode!r}; expected None: give pixels=True for pictures.")
    wrong = [name for name in _REFUSED if name in options]
    if wrong:
        raise InputError(
            f"{wrong[0]}: Gymnasium has no such option; use `torchdlo.envs.make`, or make_vec for batches."
        )
    return envs.make(task, num_envs=num_envs, scaled_actions=scaled_actions, **options)


def _spaces(batch: DloEnv) -> tuple[spaces.Space, spaces.Box]:
    """Return the spaces of one scene."""
    action = batch.action_spec
    low, high = (x[0].cpu().numpy().astype(np.float32) for x in (action.space.low, action.space.high))
    size = batch.observation_spec["observation"].shape[-1]
    vector = spaces.Box(-np.inf, np.inf, (size,), np.float32)
    found: dict[str, spaces.Space] = {}
    for kind in _IMAGES:
        if kind in batch.observation_spec.keys():
            spec = batch.observation_spec[kind]
            found[kind] = (
                spaces.Dict({name: _image(spec[name]) for name in spec.keys()})
                if hasattr(spec, "keys")
                else _image(spec)
            )
    return (spaces.Dict({"observation": vector, **found}) if found else vector), spaces.Box(low, high)


def _image(spec: Any) -> spaces.Box:
    shape, kind = tuple(spec.shape[1:]), str(spec.dtype).removeprefix("torch.")
    if kind == "uint8":
        return spaces.Box(0, 255, shape, np.uint8)
    return spaces.Box(-np.inf, np.inf, shape, np.dtype(kind))


def _stepped(batch: DloEnv, actions: np.ndarray) -> TensorDict:
    given = torch.as_tensor(actions, dtype=torch.float32, device=batch.device)
    return batch._step(TensorDict({"action": given}, batch.batch_size, batch.device))


def _array(x: Any) -> Any:
    if isinstance(x, torch.Tensor):
        return x.detach().cpu().numpy().copy()
    return {name: _array(x[name]) for name in x.keys()}


def _observed(found: TensorDict) -> Any:
    """Return what all scenes look like, arrays with an axis of scenes."""
    images = {kind: _array(found[kind]) for kind in _IMAGES if kind in found.keys()}
    vector = _array(found["observation"])
    return {"observation": vector, **images} if images else vector


def _row(found: Any) -> Any:
    """Return what the only scene looks like."""
    return {name: _row(x) for name, x in found.items()} if isinstance(found, dict) else found[0]


def _told_all(found: TensorDict) -> dict[str, Any]:
    terms = {f"reward_{name}": _array(x)[:, 0] for name, x in found["terms"].items()}
    return {"success": _array(found["success"])[:, 0], "progress": _array(found["progress"])[:, 0], **terms}


def _told(found: TensorDict) -> dict[str, Any]:
    """Return the info of the only scene."""
    return {name: x[0].item() for name, x in _told_all(found).items()}


def _many(info: dict[str, np.ndarray]) -> dict[str, Any]:
    """Return an info of many scenes, with the masks that say which of them have it: all."""
    return info | {f"_{name}": np.ones(len(x), bool) for name, x in info.items()}
