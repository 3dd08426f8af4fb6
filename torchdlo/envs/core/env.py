"""Tasks as TorchRL environments: the only place where physics meets TensorDict.

The environment keeps the state of its scenes itself; tensordicts hold actions, observations and rewards.
"""

from __future__ import annotations

import dataclasses
import multiprocessing
import os
from collections.abc import Mapping
from numbers import Integral
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from torchdlo import notices
from torchdlo.envs.core import episode as episodes
from torchdlo.envs.core.episode import ControlStep, Episode, EpisodeState
from torchdlo.envs.core.task import Task, combined, succeeded
from torchdlo.envs.observations.sensor import Sensor, sensor_of
from torchdlo.errors import InputError
from torchdlo.physics import tree
from torchdlo.physics.effects.parameter_name import ParameterName
from torchdlo.physics.execution import Execution
from torchdlo.scene import Params, Scene
from torchdlo.vision.look import Look, draw_look

__all__ = ["DloEnv"]

_MAIN = os.getpid()
"""The process that imported this; those that are forked off it have another number."""


class DloEnv(EnvBase):
    """A batch of scenes of one task. See `torchdlo.envs.make`."""

    task: Task
    gradients: bool
    variation: bool
    generator: torch.Generator
    episode: Episode
    world: EpisodeState
    moved: Tensor
    """How far things are off their places at the start [m], shape (num_envs, things, 3)."""
    first: Tensor
    """What was observed at the start, shape (num_envs, O)."""
    _like: Tensor
    _limit: Tensor
    _scale: Tensor | None
    _randomize: dict[str, float]
    _usual: Params
    _sensor: Sensor | None
    _looks: tuple[Look, ...]
    _look_generator: torch.Generator

    def __init__(
        self,
        task: Task,
        *,
        num_envs: int = 1,
        device: torch.device | str | None = None,
        dtype: torch.dtype = torch.float32,
        seed: int | None = None,
        gradients: bool = False,
        execution: Execution = "compiled",
        segment: int | None = 1,
        variation: bool = True,
        randomize: Mapping[str, float] | None = None,
        pixels: bool | Mapping[str, Any] = False,
        scaled_actions: bool = False,
    ) -> None:
        """Make the scenes; arguments as in `torchdlo.envs.make`."""
        _check_device(device)
        if not isinstance(num_envs, Integral) or isinstance(num_envs, bool) or num_envs < 1:
            raise InputError(
                f"num_envs: it is {num_envs!r}; expected how many scenes there are, a whole number from 1 on."
            )
        super().__init__(device=device or "cpu", batch_size=torch.Size([num_envs]))
        self.task, self.gradients, self.variation = task, gradients, variation
        self._like = torch.zeros((), dtype=dtype, device=self.device)
        self.generator = torch.Generator()
        self._randomize = dict(randomize or {})
        limit = torch.tensor(task.limit, device=self.device)
        self._limit = torch.ones_like(limit) if scaled_actions else limit
        self._scale = limit.to(dtype) if scaled_actions else None
        made = episodes.prepare(task, num_envs, like=self._like, execution=execution, segment=segment)
        _check(self._randomize, made.scene)
        self.episode, self.world, self._usual = made, made.start, made.params
        self._sensor = None if pixels is False else sensor_of(made, {} if pixels is True else pixels)
        self._looks, self._look_generator = (Look(),) * num_envs, torch.Generator()
        self.moved = task.moved(num_envs, like=self._like, variation=False)
        self.first = episodes.observe(made, made.start)
        self._make_specs()
        self.set_seed(seed)

    def _make_specs(self) -> None:
        shape, device = self.batch_size, self.device
        size = episodes.observe(self.episode, self.world).shape[-1]
        limit = self._limit.expand(*shape, -1)
        self.action_spec = Bounded(-limit, limit, (*shape, self.task.width), device=device, dtype=torch.float32)
        flag = Binary(1, (*shape, 1), device=device, dtype=torch.bool)
        names = self.task.rewards(self.world.seen(self.task.arms.count))
        # Say what is wrong before the first step.
        combined(self.task, names, len(self.world.failed))
        succeeded(self.task, self.world.seen(self.task.arms.count))
        one = Unbounded((*shape, 1), device=device, dtype=torch.float32)
        self.observation_spec = Composite(
            observation=Unbounded((*shape, size), device=device, dtype=torch.float32),
            progress=one.clone(),
            start=Unbounded((*shape, size), device=device, dtype=torch.float32),
            success=flag.clone(),
            terms=Composite({name: one.clone() for name in names}, shape=shape, device=device),
            **self._image_specs(),
            shape=shape,
            device=device,
        )
        self.reward_spec = one.clone()
        self.done_spec = Composite(
            done=flag.clone(), terminated=flag.clone(), truncated=flag.clone(), shape=shape, device=device
        )

    def _image_specs(self) -> dict[str, Composite]:
        if self._sensor is None:
            return {}
        found = {}
        for kind, (names, shape, dtype) in self._sensor.shapes().items():
            whole = (*self.batch_size, *shape)
            spec = Unbounded(whole, device=self.device, dtype=dtype)
            if dtype == torch.uint8:
                spec = Bounded(0, 255, whole, device=self.device, dtype=dtype)
            rows = {name: spec.clone() for name in names}
            found[kind] = Composite(rows, shape=self.batch_size, device=self.device) if names else spec
        return found

    def _set_seed(self, seed: int | None) -> None:
        # Without a seed, torch's own generator decides, so that torch.manual_seed holds here too.
        chosen = _drawn_seed() if seed is None else seed
        self.generator.manual_seed(chosen)
        # Looks have random numbers of their own: starts are the same with and without pictures.
        self._look_generator.manual_seed(chosen)

    def to(self, device: torch.device | str | int | torch.dtype) -> DloEnv:
        """Return the environment if it is on that device, or in that precision, already.

        Raises:
            InputError: It is not: steps are made for one of each.
        """
        if isinstance(device, torch.dtype):
            what, now, there = "dtype", self._like.dtype, device == self._like.dtype
        else:
            what, now, asked = "device", self.device, torch.device(device)
            there = (asked.type, asked.index or 0) == (now.type, now.index or 0)
        if not there:
            raise InputError(
                f"to: scenes were made with {what} {now} and cannot go to {device}; "
                f"give {what}= to `envs.make` instead."
            )
        return self

    def detach(self) -> None:
        """Cut the state from its gradient history, as one does between windows of a long episode."""
        self.world = tree.detach(self.world)

    def _told(self, terms: dict[str, Tensor]) -> dict[str, Any]:
        return {
            "observation": episodes.observe(self.episode, self.world),
            "start": self.first,
            "progress": (self.world.count / self.task.horizon).float().unsqueeze(-1),
            "success": episodes.successes(self.task, self.world).unsqueeze(-1),
            "terms": TensorDict({n: t.float().unsqueeze(-1) for n, t in terms.items()}, self.batch_size, self.device),
            **self._images(),
        }

    def _images(self) -> dict[str, Any]:
        if self._sensor is None:
            return {}
        found = self._sensor.observe(self.world, self._looks)
        return {
            kind: TensorDict({n: x.to(self.device) for n, x in value.items()}, self.batch_size, self.device)
            if isinstance(value, dict)
            else value.to(self.device)
            for kind, value in found.items()
        }

    def _reset(self, tensordict: TensorDictBase | None, **_: Any) -> TensorDict:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        again = torch.ones_like(self.world.failed) if mask is None else mask.reshape(self.batch_size)
        with torch.no_grad():
            self._draw(again)
            if self._sensor is not None and self._sensor.random:
                drawn = zip(self._looks, again.tolist(), strict=True)
                self._looks = tuple(draw_look(self._look_generator) if new else look for look, new in drawn)
        # Scenes that go on keep their gradient history.
        with torch.set_grad_enabled(self.gradients and torch.is_grad_enabled()):
            self.world = self._begun(again)
            now = episodes.observe(self.episode, self.world).detach()
            self.first = torch.where(again.unsqueeze(-1), now, self.first)
            terms = self.task.rewards(self.world.seen(self.task.arms.count))
            ended = torch.zeros(*self.batch_size, 1, dtype=torch.bool, device=self.device)
            flags = {name: ended.clone() for name in ("done", "terminated", "truncated")}
            return TensorDict({**self._told(terms), **flags}, self.batch_size, self.device)

    def _draw(self, again: Tensor) -> None:
        """Draw the numbers of effects that are randomised, for the scenes that begin again."""
        if self._randomize:
            drawn = drawn_effects(self._usual, self.episode.scene, self._randomize, self.generator, len(again))
            effects = tree.where(again, drawn, _wide(self.episode.params.effects, drawn))
            self.episode = dataclasses.replace(self.episode, params=tree.replace(self.episode.params, effects=effects))

    def _begun(self, again: Tensor) -> EpisodeState:
        """Return the worlds, new ones where episodes begin again."""
        # Scenes settle with their own numbers.
        if not self.variation and not (self._randomize and self.task.settle_steps):
            return self.episode.start if bool(again.all()) else tree.where(again, self.episode.start, self.world)
        choices: dict[str, Any] = {"like": self._like, "generator": self.generator, "variation": self.variation}
        rows = again.nonzero().squeeze(-1)
        # Steps are made for one size of the batch, so that settling takes all scenes.
        count = len(again) if self.task.settle_steps else len(rows)
        with torch.no_grad():
            moved = self.task.moved(count, **choices)
            fresh = episodes.begin(self.episode, episodes.laid_down(self.task, moved)[2])
        self.moved = self.moved.index_copy(0, rows, moved[rows] if self.task.settle_steps else moved)
        if bool(again.all()):
            return fresh
        if self.task.settle_steps:
            return tree.where(again, fresh, self.world)
        return tree.map(lambda old, new: old.index_copy(0, rows, new), self.world, fresh)

    def advance(self, action: Tensor) -> ControlStep:
        """Do actions (num_envs, A) of `action_spec` and return what they led to, without a tensordict."""
        with torch.set_grad_enabled(self.gradients and torch.is_grad_enabled()):
            action = action.to(self._like.dtype)
            action = action if self._scale is None else action.clamp(-1.0, 1.0) * self._scale
            last = self.world.count + 1 >= self.task.horizon
            step = episodes.control_step(self.episode, self.world, action, last)
        self.world = step.world
        _warn_of_nan(self.task, action, step.reward)
        return step

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        with torch.set_grad_enabled(self.gradients and torch.is_grad_enabled()):
            step = self.advance(tensordict.get("action"))
            failed, over = self.world.failed.unsqueeze(-1), (self.world.count >= self.task.horizon).unsqueeze(-1)
            flags = {"terminated": failed, "truncated": over, "done": failed | over}
            found = {**self._told(step.terms), "reward": step.reward.float().unsqueeze(-1), **flags}
            return TensorDict(found, self.batch_size, self.device)


def _drawn_seed() -> int:
    """Return a seed out of torch's generator; in other processes than the main one, of the system's as well.

    Processes that were forked have the generator of their parent, those that were spawned have one that is not seeded:
    their environments would all begin alike.
    """
    drawn = int(torch.randint(2**31, (), device="cpu"))
    if multiprocessing.parent_process() is None and os.getpid() == _MAIN:
        return drawn
    return drawn ^ (int.from_bytes(os.urandom(4), "little") >> 1)


def _check_device(device: torch.device | str | None) -> None:
    """Refuse a device that this machine lacks."""
    try:
        kind = torch.device(device or "cpu").type
    except RuntimeError:
        raise InputError(f"device: it is {device!r}; expected cpu, cuda or cuda:NUMBER.") from None
    if kind == "cuda" and not torch.cuda.is_available():
        raise InputError(f"device: it is {device}, but torch sees no GPU here; leave it out, or see `torchdlo doctor`.")


def _warn_of_nan(task: Task, action: Tensor, reward: Tensor) -> None:
    """Say once that actions or rewards are not finite, as nothing else would."""
    if bool(torch.isfinite(action).all() & torch.isfinite(reward).all()):
        return
    if not bool(torch.isfinite(action).all()):
        notices.once("nan actions", f"{task.name}: an action is not finite: its scene has failed; check the policy.")
    elif not bool(torch.isfinite(reward).all()):
        notices.once(
            f"nan rewards of {task.name}",
            f"{task.name}: a reward is not finite although its scene is; check the task's `rewards`.",
        )


def _wide(effects: dict[str, dict[str, Tensor]], like: dict[str, dict[str, Tensor]]) -> dict[str, dict[str, Tensor]]:
    """Return numbers in the shapes that drawn ones have."""
    return tree.map(lambda x, y: x.expand(y.shape), effects, like)


def _declared(scene: Scene, name: str) -> Any:
    asked = ParameterName.parse(name)
    params = {e.name: e.params for e in scene.effects}.get(asked.effect, {})
    return params.get(asked.key)


def _check(shares: Mapping[str, float], scene: Scene) -> None:
    known = sorted(f"{e.name}.{number}" for e in scene.effects for number in e.params)
    for name, share in shares.items():
        if _declared(scene, name) is None:
            raise ValueError(f"randomize: there is no number {name!r} in this task; it has {', '.join(known)}")
        if not 0 <= share <= 1:
            raise ValueError(f"randomize: {name} is {share}; expected a share of its declared range, 0 to 1")


def drawn_effects(
    params: Params, scene: Scene, shares: Mapping[str, float], generator: torch.Generator, count: int
) -> dict[str, dict[str, Tensor]]:
    """Return numbers of effects, those that are named drawn anew for each scene, shape (count, 1, C).

    A number is drawn evenly, on the scale on which it is declared, from an interval about its value: that share of the
    whole declared range, cut off at the range's ends. Static friction `mu_s` is raised to sliding friction `mu_k` where
    it would be less.
    """
    found = {
        effect: {name: x.expand(count, 1, x.shape[-1]) for name, x in v.items()} for effect, v in params.effects.items()
    }
    for name, share in shares.items():
        which, param = ParameterName.parse(name), _declared(scene, name)
        value = found[which.effect][which.number]
        ends = [param.coordinate(value.new_tensor(float(end))) for end in (param.low, param.high)]
        low, high = min(ends), max(ends)
        random = torch.rand(value.shape, generator=generator, dtype=torch.float64).to(value)
        at = param.coordinate(value) + share * (high - low) * (random - 0.5)
        found[which.effect][which.number] = param.value(torch.minimum(torch.maximum(at, low), high))
    for effect in {ParameterName.parse(name).effect for name in shares}:
        if {"mu_s", "mu_k"} <= found[effect].keys():
            found[effect]["mu_s"] = torch.maximum(found[effect]["mu_s"], found[effect]["mu_k"])
    return found
