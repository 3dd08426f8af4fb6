"""What a manipulation task is: a scene, arms that hold ropes, a reward, and when it has succeeded or failed.

A task is a frozen dataclass without tensors. `episode` runs it, `env` offers it to TorchRL.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor

from torchdlo import scene as scenes
from torchdlo.coupling import BodyContact, RodBody, RodContact, RodMpmCoupling
from torchdlo.coupling.bodies.dynamics import RigidBody
from torchdlo.coupling.common.pose import Pose
from torchdlo.envs.assets.arms import DOWN, Arms
from torchdlo.envs.assets.rope_material import RopeMaterial
from torchdlo.envs.core import curve_geometry
from torchdlo.envs.core.fidelity import PUBLISHED, Fidelity
from torchdlo.envs.core.stages import Schedule, Stage
from torchdlo.envs.core.waypoints import actions_through, resample_evenly
from torchdlo.envs.observations.cameras import TaskCamera
from torchdlo.errors import InputError
from torchdlo.field_docs import with_field_docs
from torchdlo.physics import tree
from torchdlo.physics.effects.base import Effect
from torchdlo.physics.effects.elastic import Bend, BendFrame, Stretch
from torchdlo.physics.effects.external import Damping, Gravity
from torchdlo.physics.effects.table import Table, TableFriction
from torchdlo.physics.rod.topology import Topology
from torchdlo.scene import Params, Rope, Scene, State

__all__ = [
    "DOWN",
    "RADIUS",
    "SPACING",
    "Arms",
    "Stage",
    "Task",
    "TaskState",
    "actions_through",
    "combined",
    "make",
    "raised",
    "resample_evenly",
    "settled",
    "straight",
]

RADIUS, SPACING = 0.01, 0.02
"""Radius of all ropes and distance of their vertices [m]."""


@tree.struct
class TaskState:
    """What rewards, success and failure are judged by, after an action."""

    state: State
    tool: Pose
    """Where the tools are: positions (B, R, 3) and orientations (B, R, 4)."""
    closed: Tensor
    """1 for hands that hold, 0 for those that are open or lost the rope [1], shape (B, R, 1)."""
    notes: dict[str, Tensor]
    """What the task remembers since the start, see `Task.note`; shapes (B, ...)."""

    @property
    def x(self) -> Tensor:
        """Positions of all vertices [m], shape (B, V, 3)."""
        return self.state.rods.pos


@with_field_docs
@dataclass(frozen=True)
class Task(ABC):
    """A task. Subclasses are final; what they leave as it is here is a rule of all tasks."""

    horizon: int = 100
    """Actions in an episode."""
    frame_skip: int = 20
    """Steps of the scene per action."""
    settle_steps: int = 0
    """Steps before the first action."""
    release: int = 0
    """Steps after the last action with open hands; the last reward is the one after them."""
    rope: RopeMaterial | None = None
    """What all ropes are made of, if not what the task says."""
    fidelity: Fidelity = PUBLISHED
    """How it is simulated; results are judged at the published fidelity."""
    grasps: tuple[int | None, ...] | None = None
    """What each hand holds until the end, slots on the vertex axis of the scene, if not what the task says; None for a
    hand that stays open."""

    name: ClassVar[str]
    """Its name in `envs.TASKS`."""
    arms: ClassVar[Arms]
    combine: ClassVar[Literal["sum", "product"]] = "sum"
    """How the terms of `rewards` make the one reward."""
    floor: ClassVar[float] = 0.03
    """Height below which tools are not led [m]."""
    max_translation: ClassVar[float] = 0.01
    """Greatest way of a tool in an action [m]."""
    max_rotation: ClassVar[float] = 0.1
    """Greatest turn of a tool in an action about each of its axes [degrees]."""
    stretch: ClassVar[float] = math.inf
    """Length of the rope between the hands over that at the start, above which an episode has failed [1]."""
    forfeits: ClassVar[bool] = True
    """Whether an episode that fails earns at once, for each action that is left, the least that one earned so far, if
    that is less than nothing: where rewards are negative, such as minus a distance, it would pay to fail early."""
    reset_noise: ClassVar[tuple[tuple[float, float], ...]] = ((0.0, 0.0),)
    """By how much each of the things that `build` can move is moved in x and in y at most [m]."""
    coarse: ClassVar[Fidelity] = Fidelity(substeps=2)
    """A cheaper fidelity that keeps what episodes earn, for training."""
    demonstration_noise: ClassVar[float] = 0.002
    """Disturbance of the hands that its scripted demonstration mostly copes with, standard deviation per axis [m]."""
    anchored: ClassVar[bool] = False
    """Whether scripted demonstrations lead to the same places wherever the rope starts, as what they lead to is
    fixed."""
    stages: ClassVar[tuple[Stage, ...]] = ()
    """What hands hold from which action on; if not given, they hold what they start at until the end."""
    counterpart: ClassVar[str] = ""
    """Name of a task that looks the same at the start, so that only the instruction tells which one is meant."""
    cameras: ClassVar[tuple[TaskCamera, ...]] = ()
    """Cameras beside or instead of the usual ones, "front" and "wrist_right" or "wrist_left" on each arm, see
    `observations.pixels.cameras_of`."""
    travel: ClassVar[int] = 10
    """Actions that a hand takes from what it held to what it holds in the next stage."""

    def __post_init__(self) -> None:
        for name, least in (("horizon", 1), ("frame_skip", 1), ("settle_steps", 0), ("release", 0)):
            value = getattr(self, name)
            if not isinstance(value, int) or isinstance(value, bool) or value < least:
                raise InputError(f"{name}: it is {value!r}; expected a whole number from {least} on.")
        if not isinstance(self.rope, RopeMaterial | None):
            raise InputError(
                f"rope: it is {self.rope!r}; expected a torchdlo.envs.Cable; "
                "torchdlo.scene_files.cable(path) makes one of a model file."
            )
        if not isinstance(self.fidelity, Fidelity):
            raise InputError(
                f"fidelity: it is {self.fidelity!r}; expected a torchdlo.envs.Fidelity, such as Fidelity(substeps=2)."
            )
        for frames in (self.frame_skip, self.settle_steps, self.release):
            self.fidelity.steps(frames)
        if self.grasps is not None:
            self._regrasp(self.grasps)

    def _regrasp(self, grasps: tuple[int | None, ...]) -> None:
        """Let hands hold other vertices than the task's own; those that stay open start where they do in the task."""
        own = type(self).arms
        slots = isinstance(grasps, tuple) and all(v is None or (type(v) is int and v >= 0) for v in grasps)
        held = [v for v in grasps if v is not None] if slots else []
        if not slots or len(grasps) != own.count or not held or len(set(held)) < len(held):
            raise InputError(
                f"grasps: they are {grasps!r}; expected a tuple with a vertex for each of {own.count} hands, all "
                "different, or None for a hand that stays open; one has to hold."
            )
        starts = tuple(v if g is None else g for g, v in zip(grasps, own.vertex, strict=True))
        object.__setattr__(self, "arms", dataclasses.replace(own, vertex=starts))
        object.__setattr__(self, "stages", (Stage(0, grasps),))

    @property
    def schedule(self) -> Schedule:
        """The stages of the task, one at least."""
        return _schedule(self.stages or (Stage(0, self.arms.vertex),), self.travel)

    @property
    def width(self) -> int:
        """Components of an action: ways of all tools (x, y, z in the world) [m], then their turns about x, y, z of the
        tool [degrees]."""
        return 6 * self.arms.count

    @property
    def limit(self) -> tuple[float, ...]:
        """Greatest magnitude of each component of an action."""
        return (self.max_translation,) * (3 * self.arms.count) + (self.max_rotation,) * (3 * self.arms.count)

    @abstractmethod
    def build(self, moved: Tensor) -> tuple[Scene, Params, State]:
        """Return the scene at its start, in the dtype and on the device of `moved`.

        Args:
            moved: how far the things of `reset_noise` are off their places [m], shape (B, things, 3).
        """

    @abstractmethod
    def rewards(self, seen: TaskState) -> dict[str, Tensor]:
        """Return the named terms of the reward of an action, shape (B,) each."""

    @abstractmethod
    def success(self, seen: TaskState) -> Tensor:
        """Return which episodes have reached the goal, judged at their end, bool, shape (B,)."""

    def auxiliary_loss(self, seen: TaskState) -> dict[str, Tensor]:
        """Return what the loss of an action has beside the reward's negative, shape (B,) each."""
        return {}

    def terminal_cost(self, seen: TaskState) -> Tensor:
        """Return how far the end of an episode is from success, 0 if it is reached [return], shape (B,).

        The loss has it after the last action, as the return need not be largest where the goal is reached.
        """
        return torch.zeros_like(seen.x[:, 0, 0])

    def note(self, seen: TaskState) -> dict[str, Tensor]:
        """Return what is to be remembered, asked at the start (without notes) and after every action."""
        return {}

    def failed(self, seen: TaskState) -> Tensor:
        """Return which episodes have failed for good, bool, shape (B,)."""
        return torch.zeros(seen.x.shape[0], dtype=torch.bool, device=seen.x.device)

    def measures(self, seen: TaskState) -> dict[str, Tensor]:
        """Return what expressions can name of this task beside its ropes, tools and bodies; shapes (B,) to (B, N, 3).

        Where a name is that of a body, such as "ring_0", this one counts.
        """
        return {}

    def measured(self) -> dict[str, str]:
        """Return what each of `measures` is, with its unit."""
        return {}

    def carried(self) -> Any:
        """Return the world, `episode.EpisodeState` of one scene, that episodes go on from; None if they begin anew."""
        return None

    def surrogate(self) -> Task | None:
        """Return a task that is much like this one and quicker to play, for searches to begin with, if there is one."""
        return None

    def waypoints(self) -> Sequence[Sequence[tuple[float, float, float]]]:
        """Return the path of a scripted demonstration: per point, how far each tool is from its start [m]."""
        return ()

    def stage_waypoints(self) -> Sequence[Sequence[Sequence[tuple[float, float, float]]]]:
        """Return `waypoints` stage by stage, in a stage from where the tools are when it begins."""
        return [self.waypoints()]

    def start(
        self, num: int, *, like: Tensor | None = None, generator: torch.Generator | None = None, variation: bool = False
    ) -> tuple[Scene, Params, State]:
        """Return the scene with `num` starts.

        Args:
            num: how many.
            like: a tensor of the dtype and device that it gets; float32 on the CPU if not given.
            generator: where random numbers come from.
            variation: whether starts differ from each other, by as much as `reset_noise` says.
        """
        return self.build(self.moved(num, like=like, generator=generator, variation=variation))

    def moved(
        self, num: int, *, like: Tensor | None = None, generator: torch.Generator | None = None, variation: bool = True
    ) -> Tensor:
        """Return how far the things of `reset_noise` are off their places [m], shape (num, things, 3); see `start`."""
        like = torch.zeros(()) if like is None else like
        moved = like.new_zeros(num, len(self.reset_noise), 3)
        if not variation:
            return moved
        random = torch.rand(num, len(self.reset_noise), 2, generator=generator, dtype=torch.float64)
        away = (2 * random - 1).to(like) * like.new_tensor(self.reset_noise)
        return torch.cat([away, moved[..., 2:]], -1)

    def demonstration(self, start: State | None = None) -> Tensor:
        """Return the actions that lead the tools along `stage_waypoints`, evenly, shape (horizon, width).

        Args:
            start: where scenes start, for actions of shape (B, horizon, width); all alike if not given.
        """
        off = (
            self._strays(start) if start is not None else [torch.zeros(self.arms.count, 3)] * len(self.schedule.stages)
        )
        stage_waypoints = self.stage_waypoints()
        if len(stage_waypoints) != len(off):
            raise InputError(f"{self.name}: its demonstration is one for its own grasps; leave other grasps out.")
        legs = zip(stage_waypoints, self.schedule.actions(self.horizon), off, strict=True)
        return torch.cat([actions_through(*leg, max_translation=self.max_translation) for leg in legs], -2)

    def _strays(self, start: State) -> list[Tensor]:
        """Return what each stage's way takes besides to lead to the same places from another start [m], (B, R, 3)."""
        scene, _, usual = self.start(1, like=start.rods.pos)
        moved, counts = usual.rods.pos - start.rods.pos, scene.topology.counts
        rope = [k for k, count in enumerate(counts) for _ in range(count)]
        found, led = [], set()
        for stage in self.schedule.stages:
            hands = list(zip(stage.vertex, self.arms.vertex, strict=True))
            # What has been led before is where it was led to.
            first = [[float(self.anchored and v is not None and rope[v] not in led)] for v in stage.vertex]
            found.append(moved[:, [h if v is None else v for v, h in hands]] * moved.new_tensor(first))
            led |= {rope[v] for v in stage.vertex if v is not None}
        return found

    def rest(self, seen: TaskState, topology: Topology) -> Tensor:
        """Return the lengths of rope between neighbouring hands on one rope [m], shape (B, n).

        There are none if `stretch` is infinite, and n = 0 if no rope has two hands.
        """
        if not math.isfinite(self.stretch):
            return seen.x[:, 0, :0]
        rope = [k for k, count in enumerate(topology.counts) for _ in range(count)]
        held = sorted(v for v in self.grasps or self.arms.vertex if v is not None)
        pairs = [(a, b) for a, b in itertools.pairwise(held) if rope[a] == rope[b]]
        lengths = [curve_geometry.length(seen.x[:, a : b + 1]) for a, b in pairs]
        return torch.stack(lengths, -1) if lengths else seen.x[:, 0, :0]


@functools.cache
def _schedule(stages: tuple[Stage, ...], travel: int) -> Schedule:
    return Schedule(stages, travel)


def combined(task: Task, terms: dict[str, Tensor], count: int) -> Tensor:
    """Return the one reward that the terms of `count` scenes make, shape (B,)."""
    if not isinstance(terms, Mapping):
        kind = f"a tensor of shape {tuple(terms.shape)}" if isinstance(terms, Tensor) else repr(terms)
        raise InputError(
            f"{task.name}: rewards returned {kind}; expected a dictionary of named terms, such as "
            f"{{'distance': tensor of shape ({count},)}}."
        )
    found = {name: tuple(x.shape) if isinstance(x, Tensor) else x for name, x in terms.items()}
    wrong = {name: shape for name, shape in found.items() if shape != (count,)}
    if wrong or not terms:
        raise InputError(
            f"{task.name}: rewards returned {wrong}; expected one or more terms, each a tensor of shape ({count},), a "
            "number for each scene: keep the first axis, and sum or average over all others."
        )
    parts = torch.stack(list(terms.values()))
    return parts.sum(0) if task.combine == "sum" else parts.prod(0)


def succeeded(task: Task, seen: TaskState) -> Tensor:
    """Return which episodes have reached the goal, bool, shape (B,), as the task says."""
    found, count = task.success(seen), len(seen.x)
    if isinstance(found, Tensor) and found.dtype == torch.bool and found.shape == (count,):
        return found
    kind = f"a tensor of {found.dtype}, {tuple(found.shape)}" if isinstance(found, Tensor) else repr(found)
    raise InputError(
        f"{task.name}: success returned {kind}; expected a tensor of bool of shape ({count},): compare with a "
        "limit, and keep the first axis."
    )


def straight(start: tuple[float, float, float], count: int, moved: Tensor) -> Tensor:
    """Return vertices of a rope along +x, shape (B, count, 3); `moved` is how far off it is, shape (B, 3)."""
    along = torch.arange(count, dtype=moved.dtype, device=moved.device) * SPACING
    line = torch.stack([along, 0 * along, 0 * along], -1) + moved.new_tensor(start)
    return line + moved.unsqueeze(-2)


def make(
    task: Task,
    ropes: Sequence[Rope],
    effects: Sequence[Effect] = (),
    values: dict[str, dict[str, float]] | None = None,
    *,
    solids: Sequence[RigidBody] = (),
    fixed: Sequence[int] = (),
    material_points: tuple = (),
    held: Sequence[int] | None = None,
    burst: float = 1.0,
) -> tuple[Scene, Params, State]:
    """Return a scene with what all tasks share: its fidelity, gravity, damping, friction, a floor at z = 0.

    A scene without a plane among its solids has a table as its floor, which is cheaper. Velocities decay by 30 1/s and
    ropes do not resist twisting: ropes with free ends that are held at points do not twist, and those of tasks have no
    inertia about their axis. A `rope` of the task takes the place of what ropes are made of and how fast they come to
    rest; its effects act beside the others.

    Args:
        task: the task.
        ropes: its ropes; those with a finite stiffness in stretch are elastic, else they are inextensible.
        effects: what acts on ropes beside elasticity, gravity, damping and contact.
        values: numbers that differ from those of all tasks.
        solids: its bodies.
        fixed: vertices that stay in their places, beside those that arms hold.
        material_points: its matter, as `coupling.mpm.particles.assemble` returns it.
        held: vertices that can be held at all, if others than those of the arms.
        burst: by how much vertices may speed up within a step, beside half their speed [m/s].
    """
    # Implicit steps solve for lengths, of elastic ropes with their stiffness.
    elastic = all(isinstance(r.stretch, Tensor) or math.isfinite(r.stretch) for r in ropes)
    elastic = elastic and task.fidelity.integrator == "explicit"
    floor = not any(s.shape == "plane" for s in solids)
    count = sum(r.positions.shape[-2] for r in ropes)
    beyond = [v for v in task.grasps or () if v is not None and v >= count]
    if beyond:
        raise InputError(f"grasps: {task.name} has vertices 0 to {count - 1}, and a hand is to hold {beyond[0]}.")
    room = 3 * count
    laws = [] if task.rope is None else task.rope.laws
    effects = [*(e for e in effects if e.name not in {o.name for o in laws}), *laws]
    acting: list[Effect] = [Gravity(), Damping(), RodContact(sweeps=5, room=room, burst=burst), *effects]
    if not any(e.name == "bend" for e in effects):
        framed = any(e.frame_bending for e in effects) or (task.rope is not None and task.rope.curvature)
        acting.append(BendFrame() if framed else Bend())
    numbers: dict[str, dict[str, float | Sequence[float] | Tensor]] = {
        "damping": {"rate": 30.0, "twist_rate": 20.0},
        "rod_contact": {"mu_s": 0.3, "mu_k": 0.25},
    }
    if elastic:
        acting.append(Stretch())
    if floor:
        acting += [Table(), TableFriction()]
        numbers["table_friction"] = {"mu": 0.3}
    if solids:
        acting.append(RodBody())
    if any(s.motion == "free" for s in solids):
        acting.append(BodyContact())
    if material_points:
        acting.append(RodMpmCoupling())
    for name, own in (values or {}).items():
        numbers[name] = {**numbers.get(name, {}), **own}
    if task.rope is not None:
        ropes = task.rope.pieces(ropes)
        for name, given in task.rope.values.items():
            numbers[name] = {**numbers.get(name, {}), **given}
    at = (*(task.schedule.held if held is None else held), *fixed)
    choices: dict[str, Any] = {"prescribed_vertices": at, "constrained": not elastic}
    choices |= {"dt": task.fidelity.step, "substeps": task.fidelity.substeps, "integrator": task.fidelity.integrator}
    try:
        return scenes.make(ropes, acting, numbers, bodies=solids, material_points=material_points, **choices)
    except ValueError as error:
        if task.fidelity != PUBLISHED:
            raise InputError(f"fidelity: {task.name} cannot be simulated by {task.fidelity.text}: {error}") from None
        if task.rope is None:
            raise
        raise InputError(f"rope: {task.name} steps by 0.2 ms and cannot take it: {error}") from None


def settled(made: tuple[Scene, Params, State], frames: int) -> Tensor:
    """Return where vertices of a single scene, shape (1, V, 3), are after some frames with nothing held."""
    scene, params, state = made
    control = scenes.stationary_control(scene, state)
    control = tree.replace(control, attachment_weight={"vertices": torch.zeros_like(control.pos[..., :1])})
    with torch.no_grad():
        for _ in range(frames):
            state = scenes.step(scene, params, state, control)
    scenes.check_state(state)
    return state.rods.pos[0].clone()


def raised(flat: Tensor, places: Tensor, width: float = 1.7) -> Tensor:
    """Return a curve that lies on the floor, shape (V, 3), and passes over others at places, counted in vertices.

    There it rises by a little more than the diameter, over about `width` vertices on either side.
    """
    index = torch.arange(len(flat), dtype=flat.dtype)[:, None]
    rise = torch.exp(-((index - places) / width).square()).sum(-1, keepdim=True)
    return resample_evenly(torch.cat([flat[:, :2], RADIUS * (1.05 + 2.6 * rise)], -1), len(flat))
