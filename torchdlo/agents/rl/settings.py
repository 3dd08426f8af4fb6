"""Settings of training by task and algorithm: the published ones as they are, ours for the hybrid."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from torchdlo.errors import InputError

__all__ = [
    "ALGORITHMS",
    "EPISODES",
    "EXPECTED",
    "LARGEST_SEED",
    "PUBLISHED",
    "TrainingSettings",
    "changed",
    "check_belonging",
    "training_preset",
]

ALGORITHMS = ("ppo", "sac", "shac", "sapo", "hybrid")
"""Names of all ways to train."""
LARGEST_SEED = 699_999_999
"""Of training. What is added to it stays below the seeds of judgements, so that these are from starts of their own."""
EPISODES = {"gathering": 8_000, "lifting": 10_000, "unknotting": 10_000}
"""Published budgets that differ from 20 000 episodes."""

PUBLISHED = {
    "coiling": {"ppo": (9.40, 0.67), "sac": (8.28, 0.0), "shac": (11.55, 0.93), "sapo": (11.57, 1.0)},
    "gathering": {"ppo": (39.76, 0.0), "sac": (40.76, 0.0), "shac": (40.48, 0.0), "sapo": (40.29, 0.0)},
    "lifting": {"ppo": (247.38, 0.0), "sac": (250.29, 0.0), "shac": (214.24, 0.0), "sapo": (204.54, 0.0)},
    "separation": {"ppo": (114.31, 1.0), "sac": (134.71, 1.0), "shac": (96.29, 1.0), "sapo": (105.27, 1.0)},
    "slingshot": {"ppo": (6.90, 0.0), "sac": (7.23, 0.33), "shac": (6.90, 0.0), "sapo": (6.90, 0.0)},
    "unknotting": {"ppo": (3.29, 0.0), "sac": (2.95, 0.0), "shac": (45.88, 0.73), "sapo": (46.30, 0.80)},
    "wiring_post": {"ppo": (62.17, 0.67), "sac": (62.07, 0.0), "shac": (36.42, 0.0), "sapo": (36.13, 0.0)},
    "wrapping": {"ppo": (131.08, 0.0), "sac": (161.85, 0.0), "shac": (129.90, 0.0), "sapo": (144.36, 0.0)},
}
"""Published returns, mean of three seeds, and shares of successes, from the one start."""


@dataclass(frozen=True)
class TrainingSettings:
    """How to train. What does not belong to an algorithm has no effect there."""

    algorithm: str = "ppo"
    episodes: int = 20_000
    """Budget."""
    minutes: float = 60.0
    """Budget of the clock; what comes first ends it."""
    seed: int = 0
    count: int = 100
    """Episodes that are played at once."""
    hidden: tuple[int, ...] = (256, 128, 64)
    """Layers of the policy."""
    critic: tuple[int, ...] = (256, 256)
    """Layers of the critics."""
    activation: str = "elu"
    layer_norm: bool = False
    sigma: float = 0.3
    """First deviation of actions, in units of the greatest way of a tool."""
    rate: float = 5e-4
    """Step of the policy."""
    critic_rate: float = 5e-4
    """Step of the critics."""
    gamma: float = 0.99
    lmbda: float = 0.95
    clip_norm: float = 0.5
    """Greatest norm of a gradient."""
    batch: int = 2048
    """Actions of which a step of PPO and SAC is made."""
    passes: int = 5
    """How often PPO goes over what it played."""
    clip: float = 0.2
    """By how much PPO lets the density of an action change."""
    entropy: float = 5e-3
    """What PPO pays for entropy."""
    replay: int = 200_000
    """Actions that SAC remembers."""
    updates: int = 1
    """Steps of SAC for each action of the batch."""
    warm: int = 5
    """Batches of episodes that SAC plays at random first."""
    polyak: float = 0.995
    """Share that target networks keep in each step."""
    window: int = 20
    """Actions through which SHAC and SAPO send gradients."""
    critic_passes: int = 16
    """How often their critics go over a window."""
    parts: int = 4
    """Minibatches of these passes."""
    entropy_rate: float = 5e-3
    """Step of SAPO's temperature."""
    temperature: float = 0.002
    """What SAPO pays for entropy at first. An action of a success earns 0.1 and one of doing nothing 0.01: much more
    would hide what is earned for hundreds of windows."""
    tame: float = 10.0
    """Greatest norm of a scene's gradient with respect to one action, times the size of the batch and the window; 0:
    none is cut. Contact makes a few that dwarf all others."""
    bonus: float = 0.0
    """What success earns beside the reward, where the sum of an episode's rewards is about 10."""
    barrier: float = 0.0
    """What an action costs after which a rope is stretched as far as its task allows, growing from half of that on; an
    episode that fails pays it for each action that is left. In units of `bonus`."""
    auxiliary: float = 0.0
    """What share of what a task's auxiliary loss has fallen by since the start is paid after every action."""
    saturation: float = 0.0
    """What SHAC and SAPO pay for the square of what means exceed 1.5 by before the hyperbolic tangent; actions are nine
    tenths of the greatest there, and far beyond no gradient leads back."""
    ends: float = 1.0
    """What share of what the end lacks to success is subtracted from the return."""
    fidelity: str = "published"
    """Fidelity of training; results are judged at the published one."""
    variation: bool = True
    """Whether starts vary."""
    device: str = "cpu"
    """Where episodes are played and networks learn: "cpu" or "cuda", the first GPU that CUDA_VISIBLE_DEVICES leaves."""
    collectors: int = 0
    """Processes of a Ray cluster that play for PPO and SAC; 0: this one plays."""
    interval: float = 60.0
    """Seconds between checkpoints at most, as far as iterations allow."""

    def __post_init__(self) -> None:
        def need(ok: bool, name: str, expected: str) -> None:
            if not ok:
                raise InputError(f"{name} is {getattr(self, name)!r}; expected {expected}.")

        for name, (expected, good) in EXPECTED.items():
            need(good(getattr(self, name)), name, expected)
        need(self.episodes >= self.count, "episodes", f"at least {self.count}, which are played at once")
        alone = self.algorithm in ("ppo", "sac") or not self.collectors
        need(alone, "collectors", f"0, as {self.algorithm} needs gradients; ppo and sac can have them")
        even = not self.count % max(1, self.collectors)
        need(even, "collectors", f"a number that divides the {self.count} episodes that are played at once")
        here = self.device == "cpu" or self.algorithm != "hybrid"
        need(here, "device", "cpu, as stages of hybrid run there; ppo, sac, shac and sapo can have a GPU")
        need(self.device == "cpu" or not self.collectors, "device", "cpu, as collectors play there")
        for name in ("barrier", "auxiliary"):
            plain = self.algorithm != "hybrid" or not getattr(self, name)
            need(plain, name, "0, as stages of hybrid know none; ppo, sac, shac and sapo can have one")
        stages = {"fidelity": "published", "variation": True, "ends": 1.0} if self.algorithm == "hybrid" else {}
        for name, own in stages.items():
            said = f"{own}, as stages of hybrid have their own; ppo, sac, shac and sapo can have another"
            need(getattr(self, name) == own, name, said)
        graded = self.algorithm in ("shac", "sapo") or not self.saturation
        need(graded, "saturation", f"0, as {self.algorithm} does not go down the gradient of returns; shac and sapo do")


_Check = tuple[str, Callable[[Any], bool]]


def _number(expected: str, good: Callable[[float], bool]) -> _Check:
    return expected, lambda x: isinstance(x, int | float) and not isinstance(x, bool) and good(x)


def _whole(least: int, expected: str = "", most: float = math.inf) -> _Check:
    said = expected or f"a whole number from {least} on"
    return said, lambda x: isinstance(x, int) and not isinstance(x, bool) and least <= x <= most


def _one_of(names: tuple[Any, ...], expected: str = "") -> _Check:
    said = expected or f"one of {', '.join(map(str, names))}"
    return said, lambda x: isinstance(x, type(names[0])) and x in names


_POSITIVE = _number("a finite number above 0", lambda x: 0 < x < math.inf)
_NOT_NEGATIVE = _number("a finite number, not below 0", lambda x: 0 <= x < math.inf)
_LAYERS: _Check = (
    "the sizes of layers, such as [64, 64]",
    lambda x: isinstance(x, list | tuple) and all(_whole(1)[1](size) for size in x),
)

EXPECTED: dict[str, _Check] = {
    "algorithm": _one_of(ALGORITHMS),
    "episodes": _whole(1),
    "minutes": _number("a number above 0", lambda x: x > 0),
    "seed": _whole(
        0, f"a whole number from 0 to {LARGEST_SEED}, as seeds beyond are those of judgements", LARGEST_SEED
    ),
    "count": _whole(1, "at least 1 episode at once"),
    "hidden": _LAYERS,
    "critic": _LAYERS,
    "activation": _one_of(("tanh", "relu", "elu", "silu")),
    "layer_norm": _one_of((True, False), "true or false"),
    "sigma": _POSITIVE,
    "rate": _POSITIVE,
    "critic_rate": _POSITIVE,
    "gamma": _number("a discount above 0, at most 1", lambda x: 0 < x <= 1),
    "lmbda": _number("a number from 0 to 1", lambda x: 0 <= x <= 1),
    "clip_norm": _POSITIVE,
    "batch": _whole(1),
    "passes": _whole(1),
    "clip": _POSITIVE,
    "entropy": _NOT_NEGATIVE,
    "replay": _whole(1),
    "updates": _whole(1),
    "warm": _whole(1, "at least 1 batch, from which features are normalised"),
    "polyak": _number("a number from 0 on, below 1", lambda x: 0 <= x < 1),
    "window": _whole(1, "at least 1 action, a whole number"),
    "critic_passes": _whole(1),
    "parts": _whole(1),
    "entropy_rate": _NOT_NEGATIVE,
    "temperature": _POSITIVE,
    "tame": _NOT_NEGATIVE,
    "bonus": _NOT_NEGATIVE,
    "barrier": _NOT_NEGATIVE,
    "auxiliary": _NOT_NEGATIVE,
    "saturation": _NOT_NEGATIVE,
    "ends": _NOT_NEGATIVE,
    "fidelity": ("a name, or such as 1ms/2", lambda x: isinstance(x, str)),
    "variation": _one_of((True, False), "true or false"),
    "device": _one_of(("cpu", "cuda"), "cpu or cuda; CUDA_VISIBLE_DEVICES chooses among several GPUs"),
    "collectors": _whole(0),
    "interval": _NOT_NEGATIVE,
}
"""What each setting may be, in words and as a check."""


_PPO = ("ppo", "hybrid")
_GRADIENTS = ("shac", "sapo")
_BELONGS: dict[str, tuple[str, ...]] = {
    "batch": (*_PPO, "sac"),
    "passes": _PPO,
    "clip": _PPO,
    "entropy": _PPO,
    "lmbda": (*_PPO, *_GRADIENTS),
    "replay": ("sac",),
    "updates": ("sac",),
    "warm": ("sac",),
    "polyak": ("sac", *_GRADIENTS),
    "window": _GRADIENTS,
    "critic_passes": _GRADIENTS,
    "parts": _GRADIENTS,
    "tame": _GRADIENTS,
    "entropy_rate": ("sapo",),
    "temperature": ("sapo",),
}
"""Settings that some algorithms alone have; the hybrid's last stage is PPO."""

_ALGORITHM: dict[str, dict[str, Any]] = {
    "ppo": {},
    "sac": {"polyak": 0.995, "sigma": 0.5},
    "shac": {"rate": 2e-3, "polyak": 0.8, "barrier": 0.2},
    "sapo": {"rate": 2e-3, "activation": "silu", "layer_norm": True, "sigma": 0.3, "barrier": 0.2},
    # More than any plan takes; of Wiring post, 8 992.
    "hybrid": {"episodes": 10_000, "count": 128, "hidden": (256, 128, 64), "sigma": 0.15, "rate": 1e-4, "bonus": 5.0},
}
_MINUTES = {"gathering": 180.0}
"""Budgets of the clock of the hybrid where an hour is not enough."""
_ENDS = {"coiling": 0.1}
"""Shares of what ends lack to success where that is many times what an episode earns, for algorithms without stages."""


def changed(was: dict[str, Any], now: dict[str, Any], free: tuple[str, ...] = ()) -> list[str]:
    """Return what differs from what a file says, as "rate 0.1 (now 0.2)"; what it does not say is not compared."""
    return [
        f"{name} {was[name]} (now {value})"
        for name, value in _as_written(now).items()
        if name not in free and name in was and was[name] != value
    ]


def _as_written(value: Any) -> Any:
    """Return plain data as JSON has them: tuples are lists."""
    if isinstance(value, dict):
        return {name: _as_written(part) for name, part in value.items()}
    return [_as_written(part) for part in value] if isinstance(value, list | tuple) else value


def check_belonging(algorithm: str, given: Iterable[str]) -> None:
    """Refuse names of settings that an algorithm would pass over."""
    for name in given:
        if algorithm not in _BELONGS.get(name, (algorithm,)):
            said = f"it is a setting of {', '.join(_BELONGS[name])}, and {algorithm} has none; leave it out"
            raise InputError(f"{name}: {said}.")


def training_preset(task: str, algorithm: str, **given: Any) -> TrainingSettings:
    """Return the settings for a task and an algorithm; what is given and not None wins."""
    if algorithm not in ALGORITHMS:
        raise InputError(f"algorithm is {algorithm!r}; expected one of {', '.join(ALGORITHMS)}.")
    base: dict[str, Any] = {"algorithm": algorithm, "episodes": EPISODES.get(task, 20_000)} | _ALGORITHM[algorithm]
    if algorithm == "hybrid":
        base["minutes"] = _MINUTES.get(task, 60.0)
    else:
        base["ends"] = _ENDS.get(task, 1.0)
    wanted = {name: value for name, value in given.items() if value is not None}
    names = {f.name for f in dataclasses.fields(TrainingSettings)}
    other = sorted(set(wanted) - names)
    if other:
        raise InputError(f"settings: there is no {', '.join(other)}; expected some of {', '.join(sorted(names))}.")
    few = wanted.get("episodes", base["episodes"])
    if isinstance(few, int) and 1 <= few < base.get("count", 100):
        wanted.setdefault("count", few)
    return TrainingSettings(**(base | wanted))
