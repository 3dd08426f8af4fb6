"""Students: policies that see clouds of points learn what a policy that sees the state would do (DAgger).

The student plays, and its teacher, who knows where every vertex is, says what it would have done. What the student sees
of rope and fixtures has noise of depth, and the camera stands elsewhere in each episode.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchdlo.agents.policies import Policy
from torchdlo.agents.policies.cloud_policy import CloudPolicy, CloudSpec
from torchdlo.agents.policies.policy_files import save_policy
from torchdlo.agents.rl.episodes import TaskEpisodes
from torchdlo.agents.rl.evaluate import UNSEEN, wilson_interval
from torchdlo.agents.rl.rollout import episode_progress, policy_features
from torchdlo.agents.rl.settings import EXPECTED, changed
from torchdlo.agents.torch_records import load_checkpoint, save_checkpoint, tensors_hash
from torchdlo.envs import PUBLISHED, Task, with_fidelity
from torchdlo.errors import InputError
from torchdlo.files import write_atomically
from torchdlo.physics import tree
from torchdlo.vision.camera import Lens
from torchdlo.vision.point_cloud import POINTS, point_cloud, scene_cloud

if TYPE_CHECKING:
    from torchdlo.vision.renderer import Pinhole

__all__ = ["CONDITIONS", "DepthCamera", "Student", "cloud_spec", "judge_student", "teach"]

Callback = Callable[[str, int, int, str], None]


@dataclass(frozen=True)
class DepthCamera:
    """What a depth camera is like, and how differently it may stand."""

    size: int = 128
    """Height and width of its pictures [px]."""
    count: int = POINTS
    """Points of a cloud."""
    noise: float = 0.002
    """Deviation of depths [m]."""
    shift: float = 0.03
    """How far its place is off along each axis at most [m]; it is known where it is."""
    error: float = 0.0
    """Deviation of where it is believed to be along each axis [m]."""


CONDITIONS = {
    "usual": DepthCamera(),
    "no noise": DepthCamera(noise=0.0, shift=0.0),
    "noise x 2": DepthCamera(noise=0.004),
    "camera 10 cm off": DepthCamera(shift=0.1),
    "camera believed 5 mm off": DepthCamera(error=0.005),
}
"""Cameras with which students are judged."""


@dataclass(frozen=True)
class Student:
    """How to teach."""

    rounds: int = 2
    """Rounds of DAgger after the first, in cheap steps."""
    final: int = 1
    """Rounds at the published fidelity."""
    count: int = 64
    """Episodes of a round."""
    noise: float = 0.001
    """Deviation of what is added to actions [m]."""
    updates: int = 1000
    """Steps of learning after each round; twice as many after the last one."""
    batch: int = 256
    subset: int = 96
    """Points of a cloud that a step of learning looks at."""
    rate: float = 1e-3
    seed: int = 0
    camera: DepthCamera = field(default_factory=DepthCamera)

    def __post_init__(self) -> None:
        expected, good = EXPECTED["seed"]
        if not good(self.seed):
            raise InputError(f"seed is {self.seed!r}; expected {expected}.")


class _Eyes:
    """The cameras of a batch of episodes: in front of the arms, each a little off its place."""

    def __init__(
        self, episodes: TaskEpisodes, camera: DepthCamera, generator: torch.Generator, *, fixtures: bool = False
    ) -> None:
        from torchdlo.envs.observations.pixels import cameras_of
        from torchdlo.vision.renderer import Pinhole, intrinsics, looking_at

        front = cameras_of(episodes.env.episode)[0]
        self.camera, self.generator, size = camera, generator, (camera.size, camera.size)
        offs = camera.shift * (2 * torch.rand(episodes.count, 3, generator=generator, dtype=torch.float64) - 1)
        eyes = (offs + torch.tensor(front.eye, dtype=torch.float64)).tolist()
        views = [looking_at(tuple(eye), front.target, size=size, opening=front.opening) for eye in eyes]
        matrix = intrinsics(size, front.opening).double().expand(len(views), 3, 3)
        rotation = torch.stack([v.rotation for v in views]).double()
        translation = torch.stack([v.translation for v in views]).double()
        self.lens = Lens(matrix, matrix.new_zeros(len(views), 5), rotation, translation)
        self.off = camera.error * torch.randn(episodes.count, 1, 3, generator=generator, dtype=torch.float64)
        self.fixtures = fixture_depths(episodes, Pinhole(matrix, rotation, translation), size) if fixtures else None
        """Depths at which pixels show fixtures [m], (N, H, W): neither they nor cameras move in an episode."""

    def see(self, episodes: TaskEpisodes) -> Tensor:
        """Return clouds [m], shape (N, P, 3), with fixtures (N, P, 4), see `CloudPolicy.forward`."""
        x, size = torch.nan_to_num(episodes.env.world.state.rods.pos.double()), (self.camera.size,) * 2
        choices: dict[str, Any] = {"count": self.camera.count, "noise": self.camera.noise, "generator": self.generator}
        # Where the camera is believed to be moves all points with it.
        if self.fixtures is None:
            return (point_cloud(self.lens, x, size, **choices)[0] + self.off).float()
        points, fixed = scene_cloud(self.lens, x, self.fixtures, **choices)
        return torch.cat([points + self.off, fixed[..., None]], -1).float()


def fixture_depths(episodes: TaskEpisodes, view: Pinhole, size: tuple[int, int]) -> Tensor:
    """Return the depths at which cameras (N,) see bodies that are fixed [m], infinite elsewhere, shape (N, H, W)."""
    from torchdlo.vision.renderer import BODY, RenderModel, render
    from torchdlo.vision.scene_geometry import model_of, placement_of

    made, state = episodes.env.episode, episodes.env.world.state
    fixed = {BODY + k for k, body in enumerate(made.scene.bodies) if body.motion == "fixed"}
    pieces = tuple(p for p in model_of(made.scene, made.params).pieces if p.id in fixed)
    placement = placement_of(state)
    placement = replace(placement, ropes=placement.ropes[:, :0], particles=placement.particles[:, :0])
    parts = ("intrinsics", "rotation", "translation")
    each = replace(view, **{n: getattr(view, n)[:, None] for n in parts})
    asked: dict[str, Any] = {"samples": 1, "shadow": 0, "rgb": False, "depth": True, "ids": True}
    seen = render(RenderModel(pieces), placement, each, (size[1], size[0]), **asked)
    depth, ids = (tree.part(x)[:, 0] for x in (seen.depth, seen.ids))
    return torch.where(ids >= BODY, depth, torch.inf).double()


def cloud_spec(task: Task) -> CloudSpec:
    """Return what a policy of clouds for a task is."""
    from torchdlo.envs.core import episode

    made = episode.prepare(task, 1, execution="eager")
    start = made.start
    center = tuple(start.state.rods.pos[0].mean(0).tolist())
    tools = tuple(tuple(p) for p in start.tool.pos[0].tolist())
    fixtures = any(body.motion == "fixed" and body.shape != "plane" for body in made.scene.bodies)
    return CloudSpec(center, tools, task=task.name, reach=task.max_translation, fixtures=fixtures)


@dataclass(eq=False)
class _Memory:
    """What a student learns from."""

    cloud: list[Tensor] = field(default_factory=list)
    rest: list[Tensor] = field(default_factory=list)
    """Tools now and at the start, the episode's share, and the teacher's action."""


@torch.no_grad()
def _play(
    student: CloudPolicy,
    teacher: Policy | None,
    episodes: TaskEpisodes,
    eyes: _Eyes,
    *,
    driven: bool = False,
    noise: float = 0.0,
    memory: _Memory | None = None,
    told: Callable[[int], None] = lambda _: None,
) -> tuple[Tensor, Tensor]:
    """Play a batch from where it begins; return which episodes succeeded and which failed, bool (N,)."""
    env, reach = episodes.env, episodes.task.max_translation
    seen, start = episodes.first, env.world.tool.pos.float()
    alive = torch.ones(episodes.count, dtype=torch.bool)
    for k in range(episodes.horizon):
        cloud, tool, share = eyes.see(episodes), env.world.tool.pos.float(), episode_progress(episodes, k, seen)
        done = student(cloud, tool, start, share)
        if teacher is not None and memory is not None:
            right = teacher.mean(policy_features(teacher, episodes, k, seen))
            memory.cloud.append(cloud[alive].half())
            memory.rest.append(torch.cat([tool.flatten(1), start.flatten(1), share, right], -1)[alive])
            done = right if driven else done
        random = torch.randn(done.shape, generator=eyes.generator) * (noise / reach)
        step = episodes.step(student.command(done + random))
        seen, alive = torch.nan_to_num(step.observation), ~step.failed
        told(k + 1)
    return step.success & ~step.failed, step.failed


def _fit(student: CloudPolicy, memory: _Memory, plan: Student, updates: int) -> float:
    """Let a student do what its teacher said; return the last mean squared error."""
    cloud, rest, arms = torch.cat(memory.cloud), torch.cat(memory.rest), len(student.spec.tools)
    tool, start, share, right = rest.split([3 * arms, 3 * arms, 1, 3 * arms], -1)
    optimizer = torch.optim.Adam(student.parameters(), lr=plan.rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, updates)
    error = 0.0
    for k in range(updates):
        rows = torch.randint(len(cloud), (min(plan.batch, len(cloud)),))
        some = torch.randint(cloud.shape[1], (plan.subset,))
        places = (x[rows].unflatten(-1, (arms, 3)) for x in (tool, start))
        loss = (student(cloud[rows][:, some].float(), *places, share[rows]) - right[rows]).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        error += (float(loss.detach()) - error) / min(1 + k, 100)
    return error


def _teacher_hash(teacher: Any) -> str:
    """Return what tells a policy from others, "" of one that has no numbers."""
    state = teacher.state_dict() if hasattr(teacher, "state_dict") else {}
    return tensors_hash(*state.values()) if state else ""


def _check_same(part: Path, kept: dict[str, Any], now: dict[str, Any]) -> None:
    """Refuse what belongs to another task, teacher or plan; those of 0.1 did not say."""
    was = json.loads(kept.get("belongs", "{}"))
    other = changed(was, {"task": now["task"]}) + changed(was.get("plan", {}), now["plan"])
    other += ["clouds without fixtures"] if now["fixtures"] and not was.get("fixtures") else []
    other += ["another teacher"] if changed(was, {"teacher": now["teacher"]}) else []
    if other:
        said = f"it belongs to a run with {', '.join(other)}; give the same, or leave out --resume"
        raise InputError(f"{part}: {said}.")


def teach(
    task: Task,
    teacher: Policy,
    *,
    folder: Path,
    plan: Student | None = None,
    resume: bool = False,
    callback: Callback | None = None,
) -> tuple[CloudPolicy, dict[str, Any]]:
    """Return a student of a policy that sees the state, and how it went; writes policy.pt and student.json.

    Args:
        task: in the published fidelity.
        teacher: its policy.
        folder: gets the files, and student.part while it is not finished.
        plan: how to teach.
        resume: go on after the last round that is there.
        callback: told (stage, rounds done, all, message).
    """
    plan, told, began = plan or Student(), callback or (lambda *_: None), time.process_time()
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(plan.seed)
        student, memory, log = CloudPolicy(cloud_spec(task)), _Memory(), []
        part, spent = folder / "student.part", 0.0
        belongs: dict[str, Any] = {"plan": asdict(plan), "teacher": _teacher_hash(teacher), "task": task.name}
        belongs |= {"fixtures": student.spec.fixtures}
        kept = load_checkpoint(part) if resume else None
        if kept is not None:
            _check_same(part, kept, belongs)
            student.load_state_dict(kept["student"])
            memory, log, spent = _Memory([kept["cloud"]], [kept["rest"]]), kept["log"], kept["cpu_seconds"]
        rounds = ["coarse"] * (1 + plan.rounds) + ["published"] * plan.final
        for k, how in enumerate(rounds):
            if k < len(log):
                continue
            # Each round has random numbers of its own, so that it can be begun again.
            torch.manual_seed(plan.seed + 7919 * (1 + k))
            rng = torch.Generator().manual_seed(plan.seed + 104_729 * (1 + k))
            fine = with_fidelity(task, "coarse" if how == "coarse" else PUBLISHED)
            episodes = TaskEpisodes(fine, plan.count, seed=plan.seed + 21 + k)
            episodes.reset()
            eyes = _Eyes(episodes, plan.camera, rng, fixtures=student.spec.fixtures)
            choices: dict[str, Any] = {"driven": k == 0, "noise": plan.noise, "memory": memory}
            good, failed = _play(student, teacher, episodes, eyes, **choices)
            error = _fit(student, memory, plan, plan.updates * (2 if k + 1 == len(rounds) else 1))
            shares = {"success": float(good.float().mean()), "failed": float(failed.float().mean())}
            log.append({"round": k, "fidelity": fine.fidelity.text, **shares, "error": error})
            cpu = round(spent + time.process_time() - began, 1)
            content = {"student": student.state_dict(), "cloud": torch.cat(memory.cloud)}
            folder.mkdir(parents=True, exist_ok=True)
            content |= {"rest": torch.cat(memory.rest), "log": log, "cpu_seconds": cpu}
            save_checkpoint(part, content | {"belongs": json.dumps(belongs)})
            told("student", k + 1, len(rounds), f"success {shares['success']:.0%} in the round, error {error:.2g}")
        spent = round(spent + time.process_time() - began, 1)
    notes = {"plan": asdict(plan), "episodes": len(rounds) * plan.count, "cpu_seconds": spent, "log": log}
    save_policy(student, folder / "policy.pt", {"algorithm": "student", "episodes": notes["episodes"]})
    write_atomically(folder / "student.json", json.dumps({"generator": "torchdlo train", **notes}, indent=1) + "\n")
    part.unlink(missing_ok=True)
    return student, notes


def judge_student(
    student: CloudPolicy,
    task: Task,
    *,
    starts: int = 15,
    seed: int = 0,
    conditions: tuple[str, ...] = tuple(CONDITIONS),
    callback: Callback | None = None,
) -> dict[str, Any]:
    """Return how often a student succeeds from unseen starts at the published fidelity, by cameras, as plain data.

    Args:
        student: the policy.
        task: its task.
        starts: of each condition, the same ones for all.
        seed: of starts and cameras, as in `evaluate`.
        conditions: names of `CONDITIONS`.
        callback: told (stage, actions done, all, message).
    """
    fine, found = with_fidelity(task, PUBLISHED), {}
    drawn = task.moved(starts, generator=torch.Generator().manual_seed(UNSEEN + 1000 * seed))
    for n, name in enumerate(conditions):
        episodes = TaskEpisodes(fine, starts)
        episodes.begin(drawn)
        random = torch.Generator().manual_seed(UNSEEN + 1000 * seed + 1)
        eyes = _Eyes(episodes, CONDITIONS[name], random, fixtures=student.spec.fixtures)

        def told(k: int, before: int = n * fine.horizon, name: str = name) -> None:
            if callback is not None:
                callback("evaluate", before + k, len(conditions) * fine.horizon, name)

        good, failed = _play(student, None, episodes, eyes, told=told)
        found[name] = {
            "camera": asdict(CONDITIONS[name]),
            "episodes": starts,
            "success": float(good.float().mean()),
            "interval": list(wilson_interval(int(good.sum()), starts)),
            "return": float(episodes.returns.mean()) if math.isfinite(float(episodes.returns.mean())) else None,
            "failed": float(failed.float().mean()),
        }
    about = {"task": task.name, "fidelity": PUBLISHED.text, "starts": starts, "reset_seed": seed, "policies": 1}
    return about | {"conditions": found}
