"""Manipulation tasks, run as functions of tensors (`episode.play`) or as TorchRL environments (`make`).

Importing this package needs torch only. Arms need the extra `robots`, `make` needs `rl` as well.
"""

from __future__ import annotations

import dataclasses
import importlib.util
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from torchdlo.envs.assets.rope_material import RopeMaterial
from torchdlo.envs.core.fidelity import PUBLISHED, Fidelity, parse_fidelity
from torchdlo.envs.core.task import Task
from torchdlo.envs.tasks.coiling import Coiling
from torchdlo.envs.tasks.coiling_about import CoilingLeft, CoilingRight
from torchdlo.envs.tasks.gathering import Gathering
from torchdlo.envs.tasks.letter_art import LetterArt
from torchdlo.envs.tasks.lifting import Lifting
from torchdlo.envs.tasks.separation import Separation
from torchdlo.envs.tasks.slingshot import Slingshot
from torchdlo.envs.tasks.unknotting import Unknotting
from torchdlo.envs.tasks.wiring_post import WiringPost
from torchdlo.envs.tasks.wiring_ring import WiringRing
from torchdlo.envs.tasks.wrapping import Wrapping
from torchdlo.errors import InputError
from torchdlo.physics.execution import Execution
from torchdlo.untrusted import one_line

if TYPE_CHECKING:
    from torchdlo.envs.core.env import DloEnv

TASKS: dict[str, type[Task]] = {
    "coiling": Coiling,
    "gathering": Gathering,
    "letter_art": LetterArt,
    "lifting": Lifting,
    "separation": Separation,
    "slingshot": Slingshot,
    "unknotting": Unknotting,
    "wiring_post": WiringPost,
    "wiring_ring": WiringRing,
    "wrapping": Wrapping,
}

PAIRED_TASKS: dict[str, type[Task]] = {"coiling_left": CoilingLeft, "coiling_right": CoilingRight}
"""Tasks beside the benchmark's that share a scene: only words tell which of them is meant."""

__all__ = [
    "PAIRED_TASKS",
    "PUBLISHED",
    "TASKS",
    "Fidelity",
    "RopeMaterial",
    "Task",
    "find",
    "find_stored",
    "list_tasks",
    "make",
    "parse_fidelity",
    "short_name",
    "with_fidelity",
]


def _own(name: str) -> type[Task]:
    """Return the class of a task of one's own, given as "FILE.py:CLASS"."""
    file, _, kind = name.rpartition(":")
    path = Path(file)
    if not path.is_file():
        raise InputError(f"{name}: there is no file {file}; expected FILE.py:CLASS with a task of your own.")
    module = f"torchdlo_task_{path.stem}_{abs(hash(str(path.resolve()))):x}"
    if module not in sys.modules:
        spec = importlib.util.spec_from_file_location(module, path)
        if spec is None or spec.loader is None:
            raise InputError(f"{name}: {file} is no Python file; expected FILE.py:CLASS with a task of your own.")
        made = importlib.util.module_from_spec(spec)
        sys.modules[module] = made  # dataclasses look their modules up
        try:
            spec.loader.exec_module(made)
        except BaseException:
            del sys.modules[module]
            raise
    found = getattr(sys.modules[module], kind, None)
    if not (isinstance(found, type) and issubclass(found, Task)):
        own = [k for k, v in vars(sys.modules[module]).items() if isinstance(v, type) and issubclass(v, Task)]
        others = ", ".join(k for k in own if k != "Task") or "none"
        raise InputError(f"{name}: {kind} is no task in {file}; tasks there: {others}.")
    return found


def short_name(name: str) -> str:
    """Return a task's name as folders have it: that of the class for "FILE.py:CLASS"."""
    return name.rpartition(":")[2]


def find(name: str, rope: RopeMaterial | None = None, grasps: Sequence[int | None] | None = None) -> Task:
    """Return a task by its name, or "FILE.py:CLASS" for one of your own.

    Args:
        name: of the task.
        rope: what its ropes are made of, if not what the task says.
        grasps: at which other vertices it is held.
    """
    known = TASKS | PAIRED_TASKS
    if name not in known and ":" not in name:
        raise InputError(
            f"there is no task {name!r}; expected one of {', '.join(sorted(known))}, or FILE.py:CLASS for your own."
        )
    task = (known[name] if name in known else _own(name))()
    task = task if rope is None else dataclasses.replace(task, rope=rope)
    return task if grasps is None else dataclasses.replace(task, grasps=tuple(grasps))


def find_stored(name: str, where: object, own: str | None = None) -> Task:
    """Return the task that a file names. It is one of torchdlo's: files are data, and name no code that is to run.

    Args:
        name: of the task, as the file has it.
        where: the file, for what is said of it.
        own: who asks may know better where the task is, such as "FILE.py:CLASS"; its name has to be that of the file.

    Raises:
        InputError: The name is of no task here, or not that of `own`.
    """
    if own is not None:
        given = find(own)
        if name not in (given.name, own):
            raise InputError(
                f"{one_line(where)}: its task is {one_line(repr(name), 60)}; the task {own} has the name "
                f"{given.name!r}."
            )
        return given
    known = TASKS | PAIRED_TASKS
    if not isinstance(name, str) or name not in known:
        raise InputError(
            f"{one_line(where)}: its task is {one_line(repr(name), 60)}; expected one of {', '.join(sorted(known))}: "
            "what a file names is never run. Say where a task of your own is with --task FILE.py:CLASS."
        )
    return known[name]()


def with_fidelity(task: Task, how: Fidelity | str) -> Task:
    """Return a task in another fidelity; "coarse" is the task's cheaper one."""
    chosen = (task.coarse if how == "coarse" else parse_fidelity(how)) if isinstance(how, str) else how
    return dataclasses.replace(task, fidelity=chosen)


def list_tasks() -> list[dict[str, Any]]:
    """Return what every task is: name, what to do, arms, actions, and seconds per action."""
    return [
        {
            "name": name,
            "what": (kind.__doc__ or "").splitlines()[0],
            "arms": kind.arms.count,
            "actions": kind().horizon,
            "seconds": 1e-3 * kind().frame_skip,
        }
        for name, kind in TASKS.items()
    ]


def make(
    task: str | Task,
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
    rope: RopeMaterial | None = None,
    pixels: bool | Mapping[str, Any] = False,
    fidelity: Fidelity | str | None = None,
    grasps: Sequence[int | None] | None = None,
    scaled_actions: bool = False,
) -> DloEnv:
    """Return a task as a TorchRL environment.

    Args:
        task: a name of `TASKS`, or a task of your own.
        num_envs: scenes in the batch.
        device: where they live.
        dtype: precision of the physics; observations and rewards are in single precision.
        seed: of the starts and of what is randomised; None draws one from torch's generator (`torch.manual_seed`). In
            other processes than the main one, those of `ParallelEnv` too, None begins differently each time.
        gradients: whether rewards and observations carry gradients to actions.
        execution: how steps run: "compiled", minutes at first, then about three times as fast, with gradients too;
            "recorded", seconds at first, then as fast as compiled ones in batches of up to some dozens, without
            gradients; or "eager", at once.
        segment: frames that gradients run again at once; None keeps all of them in memory.
        variation: whether starts differ, by as much as `Task.reset_noise` says.
        randomize: numbers of effects that differ from scene to scene and are drawn at every reset, e.g.
            {"rod_contact.mu_k": 0.2}: a share of the range in which the number is declared, about its usual value.
        rope: what ropes are made of, if not what the task says: `torchdlo.scene_files.cable("model.json")` reads what
            `torchdlo calibrate` or `diagnose` found.
        pixels: whether observations have pictures, ("pixels", camera) uint8 (..., H, W, 3), or what else cameras give:
            {"size": 128, "cameras": ("front",), "samples": 4, "masks": True, "depth": True, "points": True,
            "looks": "random"}, see `observations.sensor`.
        fidelity: how the task is simulated, if not as it says: a `Fidelity`, "published", "coarse" (the task's cheaper
            one), or such as "1ms/2"; `env.task.fidelity` says which it is.
        grasps: what each hand holds until the end, slots on the vertex axis of the scene, if not what the task says;
            None for a hand that stays open. Stages of the task are left out.
        scaled_actions: whether actions are from -1 to 1, shares of `Task.limit`; in metres and degrees if not.
    """
    try:
        from torchdlo.envs.core.env import DloEnv
    except ImportError as error:
        raise InputError(
            f"environments need torchrl and tensordict ({error}); install them with pip install 'torchdlo[rl,robots]'."
        ) from None
    chosen = find(task) if isinstance(task, str) else task
    if not isinstance(chosen, Task):
        kind = f"the class {task.__name__}" if isinstance(task, type) else repr(task)
        mend = f"; write {task.__name__}()" if isinstance(task, type) and issubclass(task, Task) else ""
        raise InputError(f"task: it is {kind}; expected a name of `envs.TASKS` or an instance of a Task{mend}.")
    if rope is not None:
        chosen = dataclasses.replace(chosen, rope=rope)
    if fidelity is not None:
        chosen = with_fidelity(chosen, fidelity)
    if grasps is not None:
        chosen = dataclasses.replace(chosen, grasps=tuple(grasps))
    return DloEnv(
        chosen,
        num_envs=num_envs,
        device=device,
        dtype=dtype,
        seed=seed,
        gradients=gradients,
        execution=execution,
        segment=segment,
        variation=variation,
        randomize=randomize,
        pixels=pixels,
        scaled_actions=scaled_actions,
    )
