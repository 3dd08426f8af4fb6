"""Running tasks: from actions to joints, from joints to the ends that are held, and what an episode earned.

Everything is a function of tensors, scenes of a batch first; nothing here knows of TensorDict. Actions move the target
of each tool from the pose that was reached last, inverse kinematics says where the joints go, and in the frames of an
action the tool moves evenly from pose to pose with what it holds. Links of arms pass through ropes and bodies.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from torchdlo import scene as scenes
from torchdlo import work_budget
from torchdlo.coupling.bodies.dynamics import turn_by
from torchdlo.coupling.common.pose import Pose
from torchdlo.coupling.robot import attachment as grasp
from torchdlo.coupling.robot.attachment import Grasp, Hands
from torchdlo.envs.core.divergence import broken_lengths, inside_bodies
from torchdlo.envs.core.frames import guarded, run, slipped
from torchdlo.envs.core.reach import FOLLOW, reachable, solve_reach, standing
from torchdlo.envs.core.stages import repeated
from torchdlo.envs.core.task import Task, TaskState, combined, succeeded
from torchdlo.envs.observations.state import observe, scene_positions
from torchdlo.errors import InputError
from torchdlo.physics import tree
from torchdlo.physics.execution import Execution
from torchdlo.physics.linalg.numerics import safe_norm
from torchdlo.physics.linalg.rotation import multiply
from torchdlo.scene import Control, Params, Scene, State

__all__ = [
    "ControlStep",
    "Episode",
    "EpisodeResult",
    "EpisodeState",
    "act",
    "begin",
    "control_step",
    "follow",
    "normalized_score",
    "observe",
    "play",
    "prepare",
    "prepare_at",
    "reachable",
    "scene_positions",
    "successes",
    "terminal_costs",
]


@tree.struct
class EpisodeState:
    """A running episode: scenes and the arms in them."""

    state: State
    joints: Tensor
    """Joints of the arms [rad or m], shape (B, R, J)."""
    target: Pose
    """Pose to which the next action is added: the last target, or what was reached of it; (B, R, 3) and (B, R, 4)."""
    tool: Pose
    """Where the tools are, (B, R, 3) and (B, R, 4)."""
    grasp: Grasp
    notes: dict[str, Tensor]
    """What the task remembers, shapes (B, ...)."""
    failed: Tensor
    """Whether the episode has failed [-], bool, shape (B,)."""
    count: Tensor
    """Actions done [1], whole, shape (B,)."""

    def seen(self, hands: int) -> TaskState:
        """Return what a task judges."""
        return TaskState(self.state, self.tool, self.grasp.closed.unflatten(-2, (hands, -1)).amax(-2), self.notes)


@tree.struct
class ControlStep:
    """What an action led to."""

    world: EpisodeState
    reward: Tensor
    """What it earned, 0 in episodes that had failed before [1], shape (B,)."""
    loss: Tensor
    """What gradients should descend: minus the reward, and `Task.auxiliary_loss` [1], shape (B,)."""
    terms: dict[str, Tensor]
    """Terms of the reward by name [1], shape (B,) each."""


@tree.struct
class EpisodeResult:
    """What episodes came to."""

    returns: Tensor
    """Sums of rewards [1], shape (B,)."""
    loss: Tensor
    """What gradients should descend: minus the return, and what the task adds to it [1], shape (B,).

    That of an episode that failed has terms from before it did only, and may be small: mask it by `failed`.
    """
    terminal_cost: Tensor
    """What the loss has for how far the end is from success, see `Task.terminal_cost` [1], shape (B,)."""
    success: Tensor
    """Which episodes reached the goal [-], bool, shape (B,)."""
    failed: Tensor
    """Which failed; they earn nothing from then on, see `Task.forfeits` [-], bool, shape (B,)."""
    rewards: Tensor
    """Rewards of the actions [1], shape (T, B)."""
    terms: dict[str, Tensor]
    """Terms of the reward by name [1], shape (T, B) each."""
    world: EpisodeState
    """The end."""
    path: dict[str, Tensor] = field(default_factory=dict)
    """What `keep` returned after every action, (T, ...) each."""


LEAST = "least"
"""Note of the least that an action earned so far, at most 0, see `Task.forfeits`."""
_FEW = 10
"""Actions of episodes that are not worth recording their steps."""
_SCENE_BYTES = 1e5
"""What the state of a scene takes at least [bytes]."""


@dataclass(frozen=True, eq=False)
class Episode:
    """A task with its scene, made for a batch; the parts that stay the same."""

    task: Task
    scene: Scene
    params: Params
    step: Callable[[Params, State, Control], State]
    """What advances the scene by a frame."""
    hands: Hands
    start: EpisodeState
    segment: int | None = None
    """Frames that gradients run again at once, None to keep all of them, see `physics.execution.replay`."""


def hands_of(task: Task, scene: Scene) -> Hands:
    """Return which grips of the task's hands hold what; what no hand ever holds is fixed."""
    plan = task.schedule
    fixed = len(scene.prescribed_vertices) - len(plan.held)
    return Hands(task.arms.count * plan.room, (*plan.tools, *[-1] * fixed))


def _begin(task: Task, scene: Scene, state: State, hands: Hands) -> EpisodeState:
    """Return the world before the first action: tools stand at what they hold, or where they were left."""
    x, before = state.rods.pos, task.carried()
    if before is not None:
        return _continued(task, scene, state, hands, before)
    pos = x[:, list(task.arms.vertex)]
    quat = x.new_tensor(task.arms.quats)
    target = Pose(pos, (quat / quat.norm(dim=-1, keepdim=True)).expand(*pos.shape[:-1], 4))
    found = standing(task, target)
    if not bool(found.converged.all()):
        far = found.missing.reshape(-1, 2).amax(0)
        raise InputError(
            f"{task.name}: an arm cannot reach the vertex that it is to hold, by {1e3 * far[0]:.0f} mm and "
            f"{math.degrees(far[1]):.1f} degrees; place its base or the rope nearer to each other."
        )
    failed = torch.zeros(x.shape[0], dtype=torch.bool, device=x.device)
    plan, none = task.schedule, torch.zeros_like(failed, dtype=torch.long)
    closed = plan.closed(none, target, x)
    held = grasp.close_hands(scene, hands, scenes.stationary_control(scene, state), repeated(target, plan.room), closed)
    world = EpisodeState(state, found.joints, target, target, held, {}, failed, none)
    seen = world.seen(task.arms.count)
    rest, least = task.rest(seen, scene.topology), x.new_zeros(len(x))
    return tree.replace(world, notes={"rest": rest, LEAST: least, **task.note(seen)})


def _continued(task: Task, scene: Scene, state: State, hands: Hands, before: EpisodeState) -> EpisodeState:
    """Return the world that goes on from one of a single scene: hands that hold on are welded anew as they are."""
    x, plan = state.rods.pos, task.schedule
    count = len(x)
    joints, target, tool, failed = tree.map(
        lambda t: t.expand(count, *t.shape[1:]).to(x) if t.is_floating_point() else t.expand(count, *t.shape[1:]),
        (before.joints, before.target, before.tool, before.failed),
    )
    none = torch.zeros_like(failed, dtype=torch.long)
    closed = plan.closed(none, tool, x)
    held = grasp.close_hands(scene, hands, scenes.stationary_control(scene, state), repeated(tool, plan.room), closed)
    notes = {name: t.expand(count, *t.shape[1:]) for name, t in before.notes.items()}
    notes[LEAST] = x.new_zeros(count)
    return EpisodeState(state, joints, target, tool, held, notes, failed, none)


def begin(episode: Episode, state: State) -> EpisodeState:
    """Return the world of an episode whose scenes start in a state, shape (B, ...)."""
    return _settled(episode, _begin(episode.task, episode.scene, state, episode.hands))


def _settled(episode: Episode, world: EpisodeState) -> EpisodeState:
    """Return the world after the frames before the first action."""
    count = episode.task.settle_steps
    if not count:
        return world
    state = run(episode, world, world.tool, world.grasp, episode.task.fidelity.steps(count))
    return tree.replace(world, state=state)


def quick_execution(task: Task) -> Execution:
    """Return how steps of a task run best that are to begin within seconds: recorded, unless there are few of them."""
    return "recorded" if task.horizon > _FEW else "eager"


def prepare(
    task: Task,
    num: int,
    *,
    like: Tensor | None = None,
    generator: torch.Generator | None = None,
    variation: bool = False,
    execution: Execution = "compiled",
    segment: int | None = None,
) -> Episode:
    """Return an episode of a task for a batch.

    Args:
        task: the task.
        num: scenes in the batch.
        like: a tensor of the dtype and device that they get; float32 on the CPU if not given.
        generator: where random numbers come from.
        variation: whether starts differ.
        execution: how steps run, see `scene.stepper`.
        segment: frames that gradients run again at once; None keeps all of them in memory.
    """
    if like is None or like.device.type == "cpu":
        work_budget.check(task.name, f"{num} scenes at once", memory=_SCENE_BYTES * num, cure="use fewer at once")
    moved = task.moved(num, like=like, generator=generator, variation=variation)
    return prepare_at(task, moved, execution=execution, segment=segment)


def prepare_at(task: Task, moved: Tensor, *, execution: Execution = "compiled", segment: int | None = None) -> Episode:
    """Return an episode whose things are that far off their places at the start [m], shape (B, things, 3).

    Args:
        task: the task.
        moved: see `Task.build`.
        execution: see `prepare`.
        segment: see `prepare`.
    """
    scene, params, state = laid_down(task, moved)
    hands = hands_of(task, scene)
    step = scenes.stepper(scene, execution=execution)
    world = _begin(task, scene, state, hands)
    episode = Episode(task, scene, params, step, hands, world, segment)
    return episode if not task.settle_steps else replace(episode, start=_settled(episode, world))


def laid_down(task: Task, moved: Tensor) -> tuple[Scene, Params, State]:
    """Return what `Task.build` does, made on the CPU, where thousands of small operations take least time."""
    if moved.device.type == "cpu":
        return task.build(moved)
    scene, params, state = task.build(moved.cpu())
    return scene, tree.to(params, moved.device), tree.to(state, moved.device)


def limit_action(task: Task, action: Tensor) -> tuple[Tensor, Tensor]:
    """Return the ways [m] and turns [rad] of the tools that an action (B, A) asks for, (B, R, 3) each.

    Ways that are too long keep their direction.
    """
    if action.shape[-1] != task.width:
        raise ValueError(
            f"{task.name}: actions have {action.shape[-1]} components; expected {task.width}: ways of "
            f"{task.arms.count} tools in x, y, z [m], then their turns about x, y, z [degrees]"
        )
    way, turn = action.unflatten(-1, (2, task.arms.count, 3)).unbind(-3)
    far = safe_norm(way)
    way = way * torch.where(far > task.max_translation, task.max_translation / torch.where(far > 0, far, 1.0), 1.0)
    return way, torch.deg2rad(turn.clamp(-task.max_rotation, task.max_rotation))


def _aim(task: Task, world: EpisodeState, action: Tensor) -> Pose:
    """Return the poses that an action asks the tools to take."""
    way, turn = limit_action(task, action)
    pos = world.target.pos + way
    # A tool that starts lower is not lifted by the rule, but may not go down.
    least = world.target.pos[..., 2:].detach().clamp(max=task.floor)
    height = torch.where(pos[..., 2:] >= least, pos[..., 2:], least)
    quat = multiply(world.target.quat, turn_by(turn))
    return Pose(torch.cat([pos[..., :2], height], -1), quat / quat.square().sum(-1, keepdim=True).sqrt())


def follow(task: Task, world: EpisodeState, action: Tensor) -> tuple[Pose, Tensor]:
    """Return the poses that an action asks the tools to take, and joints that bring them there, shape (B, R, J)."""
    aim = _aim(task, world, action)
    return aim, solve_reach(task, aim, world.joints, FOLLOW).joints


def act(episode: Episode, world: EpisodeState, action: Tensor) -> EpisodeState:
    """Return the world after an action, shape (B, A) in metres and degrees; see `Task.width`.

    Scenes that are no longer finite stay as they were and have failed. Nothing has a gradient through an action in
    which a scene broke.
    """
    task, lost = episode.task, list[Tensor]()
    before, action = guarded((world, action), len(world.failed), lost)
    aim, held = _aim(task, before, action), before.grasp
    if len(task.schedule.stages) > 1:
        aim, held = _staged(episode, before, aim)
    found = solve_reach(task, aim, before.joints, FOLLOW)
    state = run(episode, before, found.pose, held, task.fidelity.steps(task.frame_skip))
    held = tree.replace(held, closed=slipped(episode, state, found.pose, held.closed))
    after = EpisodeState(state, found.joints, found.handed, found.pose, held, world.notes, world.failed, world.count)
    return tree.replace(_judged(episode, world, after, lost), count=world.count + 1)


def _staged(episode: Episode, world: EpisodeState, aim: Pose) -> tuple[Pose, Grasp]:
    """Return where tools are to go and what they hold in an action: hands open, travel and close as stages say."""
    plan, x = episode.task.schedule, world.state.rods.pos
    closed = plan.closed(world.count, world.tool, x, world.grasp.closed)
    now = scenes.stationary_control(episode.scene, world.state)
    held = grasp.close_hands(episode.scene, episode.hands, now, repeated(world.tool, plan.room), closed, world.grasp)
    return plan.steer(world.count, world.target, aim, x), held


def _judged(episode: Episode, before: EpisodeState, after: EpisodeState, lost: list[Tensor]) -> EpisodeState:
    """Return the new world with its notes and failures, and the old one where the new one is not finite.

    `lost` gets which scenes broke, shape (B,).
    """
    task, good = episode.task, scenes.finite(after.state)
    after = tree.where(good, after, before)
    notes = task.note(after.seen(task.arms.count))
    after = tree.replace(after, notes={"rest": before.notes["rest"], LEAST: before.notes[LEAST], **notes})
    seen = after.seen(task.arms.count)
    torn = (task.rest(seen, episode.scene.topology) > task.stretch * seen.notes["rest"]).any(-1)
    stuck = (inside_bodies(episode.scene, episode.params, after.state, after.tool.pos) & (seen.closed[..., 0] > 0)).any(
        -1
    )
    lost.append(~good | broken_lengths(episode.scene, episode.params, after.state))
    return tree.replace(after, failed=before.failed | lost[0] | torn | stuck | task.failed(seen))


def finish(episode: Episode, world: EpisodeState) -> EpisodeState:
    """Return the world after the hands have opened at the end, for tasks that ask for it."""
    task = episode.task
    if not task.release:
        return world
    lost: list[Tensor] = []
    before = guarded(world, len(world.failed), lost)
    held = tree.replace(before.grasp, closed=torch.zeros_like(world.grasp.closed))
    state = run(episode, before, before.tool, held, task.fidelity.steps(task.release))
    return _judged(episode, world, tree.replace(before, state=state, grasp=held, notes=world.notes), lost)


def control_step(episode: Episode, world: EpisodeState, action: Tensor, last: Tensor | bool) -> ControlStep:
    """Return what an action (B, A) leads to: the one step that environments, searches and films play.

    Args:
        episode: the scenes.
        world: before the action.
        action: in metres and degrees, see `Task.width`.
        last: whether the episode ends with it, of each scene (B,) or of all: hands then open where a task asks for it.
    """
    before, world = world, act(episode, world, action)
    if last is True:
        world = finish(episode, world)
    elif isinstance(last, Tensor) and episode.task.release and bool(last.any()):
        world = tree.where(last, finish(episode, world), world)
    return _earned(episode, before, world)


def _earned(episode: Episode, before: EpisodeState, world: EpisodeState) -> ControlStep:
    """Return what an action came to, with what an episode forfeits that failed in it."""
    earned, reward, loss, terms = episode_reward(episode, world)
    if not episode.task.forfeits:
        return ControlStep(world, reward, loss, terms)
    gone = earned.detach().nan_to_num()
    least = torch.minimum(world.notes[LEAST], gone.to(world.notes[LEAST]))
    left = (1 + episode.task.horizon - world.count).clamp(min=1)
    now = world.failed & ~before.failed
    reward, loss = torch.where(now, least * left, reward), torch.where(now, -least * left, loss)
    return ControlStep(tree.replace(world, notes=world.notes | {LEAST: least}), reward, loss, terms)


def episode_reward(episode: Episode, world: EpisodeState) -> tuple[Tensor, Tensor, Tensor, dict[str, Tensor]]:
    """Return the sum of the terms of the last action's reward, the reward, its loss, and the terms, shape (B,) each.

    The reward is that sum, and 0 in episodes that have failed, as the loss is.
    """
    task, seen = episode.task, world.seen(episode.task.arms.count)
    terms = task.rewards(seen)
    earned = combined(task, terms, len(world.failed))
    loss = sum(task.auxiliary_loss(seen).values(), -earned)
    return earned, torch.where(world.failed, 0.0, earned), torch.where(world.failed, 0.0, loss), terms


def successes(task: Task, world: EpisodeState) -> Tensor:
    """Return which episodes are where they should be and have not failed, bool, shape (B,)."""
    return succeeded(task, world.seen(task.arms.count)) & ~world.failed


def terminal_costs(task: Task, world: EpisodeState) -> Tensor:
    """Return how far ends are from success, 0 in episodes that have failed, see `Task.terminal_cost` [1], (B,)."""
    return torch.where(world.failed, 0.0, task.terminal_cost(world.seen(task.arms.count)))


def play(
    task: Task,
    actions: Tensor,
    *,
    episode: Episode | None = None,
    keep: Callable[[EpisodeState], dict[str, Tensor]] = lambda _: {},
    callback: Callable[[int, int], None] | None = None,
    **choices: Any,
) -> EpisodeResult:
    """Return what actions earn, with gradients with respect to them.

    Args:
        task: the task.
        actions: shape (B, T, A), in metres and degrees; one sequence per scene, of any length.
        episode: what `prepare` returned for B scenes; made if not given.
        keep: what to keep of the world after every action, such as `scene_positions`.
        callback: told (actions done, actions in all) after each.
        choices: of `prepare`.
    """
    if actions.dim() != 3 or 0 in actions.shape:
        raise ValueError(f"{task.name}: actions are {tuple(actions.shape)}; expected (scenes, actions, {task.width})")
    if episode is not None and choices:
        raise InputError(
            f"{task.name}: {', '.join(choices)} beside an episode that is prepared already; give choices to `prepare`, "
            "or leave the episode out."
        )
    if episode is not None and episode.task is not task and episode.task != task:
        raise InputError(
            f"{task.name}: the episode is of {episode.task}; expected one of {task}: play it with `episode.task`, or "
            "prepare another."
        )
    episode = episode or prepare(task, len(actions), like=actions.detach(), **choices)
    world, count, rows, path = episode.start, actions.shape[1], [], []
    if len(world.joints) != len(actions):
        raise ValueError(f"{task.name}: {len(actions)} sequences for an episode of {len(world.joints)} scenes")
    for k in range(count):
        step = control_step(episode, world, actions[:, k], last=k + 1 == count)
        world = step.world
        rows.append((step.reward, step.loss, step.terms))
        path.append(keep(world))
        if callback is not None:
            callback(k + 1, count)
    rewards, losses, terms = tree.stack(rows)
    success, short = successes(task, world), task.terminal_cost(world.seen(task.arms.count))
    loss = losses.sum(0) + torch.where(world.failed, 0.0, short)
    return EpisodeResult(rewards.sum(0), loss, short, success, world.failed, rewards, terms, world, tree.stack(path))


def normalized_score(task: Task, returns: Tensor, **choices: Any) -> Tensor:
    """Return scores of episodes: 0 for doing nothing, 1 for the scripted demonstration of `Task.demonstration`, shape
    of `returns`.

    Both are played for it, which takes as long as an episode of two scenes.

    Args:
        task: the task.
        returns: returns of episodes from its one start, without variation.
        choices: of `prepare`.
    """
    way = task.demonstration().to(returns)
    if not bool((way != 0).any()):
        raise ValueError(f"{task.name}: has no scripted demonstration to compare with; give it `waypoints`")
    with torch.no_grad():
        idle, best = play(task, torch.stack([torch.zeros_like(way), way]), **choices).returns.to(returns)
    return (returns - idle) / (best - idle)
