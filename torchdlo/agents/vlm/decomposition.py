"""Long tasks in steps: a plan of a model, each step searched as a task of its own, and the plan updated by what came.

A model is asked once for a plan. A step says what hands hold, what earns, and when it is done; it becomes a task that
goes on from where the last one ended. After it, stills and values go back, and the model says what is left to do. The
task's own condition decides whether all is done, not the model. Without updates the first plan is carried out as it is.
"""

from __future__ import annotations

import functools
import hashlib
import json
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor

from torchdlo.agents.trajopt.problem import Evaluation
from torchdlo.agents.trajopt.search import NothingFoundError, SearchSettings, optimize
from torchdlo.agents.trajopt.search_journal import program_hash, remove_journal
from torchdlo.agents.trajopt.task_problem import TaskProblem
from torchdlo.agents.vlm.carried import Carried, Options, Result, WorldPainter
from torchdlo.agents.vlm.conversation import Conversation, Question, ShownPicture, plain_text
from torchdlo.agents.vlm.grasp_proposal import Places, check_grasps, places_of
from torchdlo.agents.vlm.plan_schema import step_models
from torchdlo.agents.vlm.plan_waypoints import lead_through_waypoints, places_of_tools
from torchdlo.agents.vlm.prompts import fill_prompt
from torchdlo.agents.vlm.scene_text import language_text, scene_text
from torchdlo.coupling.common import step_diagnostics
from torchdlo.envs import Task
from torchdlo.envs.core import episode, scene_names
from torchdlo.envs.core.subtask import SubTask, continue_from, opening, task_success
from torchdlo.errors import InputError
from torchdlo.files import write_atomically
from torchdlo.journal import read_json, write_json
from torchdlo.physics import tree
from torchdlo.reward_language import Reward, reward
from torchdlo.scene import State

__all__ = ["Carried", "Options", "Result", "WorldPainter", "carry_out"]


class _NotCarriedOut(Exception):
    """A step cannot be carried out; one sentence that the model is told."""


@dataclass(eq=False)
class _Run:
    """A run so far."""

    task: Task
    talk: Conversation
    options: Options
    look: WorldPainter | None
    folder: Path | None
    callback: Callable[[str, int, int, str], None]
    like: Tensor
    world: episode.EpisodeState | None = None
    made: episode.Episode | None = None
    holds: tuple[int | None, ...] = ()
    carried: list[Carried] = field(default_factory=list)
    plans: list[dict[str, Any]] = field(default_factory=list)
    done: bool = False
    updates: int = 0
    begun: float = field(default_factory=time.monotonic)
    _places: tuple[Any, Places] | None = None

    # -- asking ------------------------------------------------------------------------------------------------------

    @functools.cached_property
    def opening(self) -> State:
        """Where it begins."""
        return self.task.start(1, like=self.like, **self.start())[2]

    def places(self) -> Places:
        """Return the vertices as they are now."""
        if self._places is None or self._places[0] is not self.world:
            state = self.opening if self.world is None else self.world.state
            self._places = (self.world, places_of(self.task, state))
        return self._places[1]

    def ask(self, kind: str, left: Sequence[Any] = (), note: str = "") -> tuple[bool, list[Any]]:
        """Return whether the model says that all is done, and the steps that are left; a note ends what it is told."""
        self.callback("model", self.talk.calls, self.talk.budget.calls, f"asked for {kind}")
        plan, update = step_models(self.task.arms.count)
        places = self.places()
        seen = opening(self.task, self.opening)[1] if self.world is None else self.world.seen(self.task.arms.count)
        text = scene_text(places, seen, [c.plain() for c in self.carried], [_plain(s) for s in left])
        text = f"{text}\n{note}" if note else text
        question = Question(
            kind=kind,
            system=fill_prompt("system"),
            text=fill_prompt(kind, language=language_text(), scene=text),
            pictures=self.pictures(),
            answer=plan if kind == "plan" else update,
            facts=(places, scene_names.named_values(self.task, scene_names.layout(places.scene), seen)),
        )

        def check(answer: Any) -> Any:
            if kind == "update" and answer.complete == bool(answer.steps):
                raise InputError('say {"complete": true, "reason": ...}, or give the steps that are left, not both.')
            for number, step in enumerate(answer.steps):
                self.check_step(step, places if number == 0 else None)
            return answer

        answer = self.talk.ask(question, check)
        self.plans.append(answer.model_dump())
        return bool(getattr(answer, "complete", False)), list(answer.steps)

    def pictures(self) -> tuple[ShownPicture, ...]:
        """Return what is shown: the last step, and the scene as it is."""
        if self.look is None:
            return ()
        made, world = self.made, self.world
        if made is None or world is None:
            made = episode.prepare(self.task, 1, like=self.like, execution="eager", **self.start())
            world = made.start
        now = ShownPicture("the scene now, vertices with their numbers", self.look.now(made, world))
        return (*(self.carried[-1].pictures if self.carried else ()), now)

    def start(self) -> dict[str, Any]:
        """Return how starts are drawn."""
        seeded = torch.Generator().manual_seed(self.options.reset_seed or 0)
        return {"generator": seeded, "variation": self.options.reset_seed is not None}

    def check_step(self, step: Any, places: Places | None) -> None:
        """Refuse a step whose expressions, grasps or way-points cannot be; of later ones grasps are not known yet."""
        where = f"step {step.id}"
        try:
            part = _judged(step)
            SubTask(inner=self.task, reward=part)
            if places is not None:
                grasps = check_grasps(places, _grasps(step))
                lead_through_waypoints(step, places_of_tools(places, grasps, self.world, self.task), self.task)
        except InputError as error:
            raise InputError(f"{where}: {error}") from None

    # -- carrying out ------------------------------------------------------------------------------------------------

    def part_of(self, step: Any) -> SubTask:
        """Return the task of a step; before the first one, hands stand at what they hold."""
        try:
            grasps = check_grasps(self.places(), _grasps(step))
        except InputError as error:  # what can be held is known only now
            raise _NotCarriedOut(plain_text(str(error))) from None
        world, holds = self.world, self.holds
        if world is None:
            first = replace(self.task, grasps=grasps)
            made = episode.prepare(first, 1, like=self.like, execution="eager", **self.start())
            world, holds = made.start, grasps
        return continue_from(self.task, world, grasps, holds=holds, horizon=step.horizon, reward=_judged(step))

    def step(self, step: Any, number: int) -> None:
        """Search a step, play the best, and go on from its end if it did not fail."""
        begun = time.monotonic()
        content = _plain(step)
        self.callback(f"step {number}", 0, self.options.episodes, "way-points")
        try:
            part = self.part_of(step)
            problem = _Part(part, execution=self.options.execution)
            actions, episodes = self.search(step, problem, number)
        except _NotCarriedOut as error:
            self.carried.append(Carried(content, False, str(error), None, {}, 0, time.monotonic() - begun, False))
            return
        made = problem.prepared(1)
        went, worlds = problem.played(actions)
        failed, missed = bool(went.failed[0]), step_diagnostics.explain_diagnostics(went.world.state.diagnostics)
        if missed or not math.isfinite(float(went.returns[0])):
            failed = True
        why = missed or "the rope was torn, a hand was led where it may not go, or the scene broke" if failed else ""
        # Hands of tasks that release at the end are opened to look, and are still closed when it goes on.
        own = False
        if not failed:
            with torch.no_grad():
                own = bool(task_success(made, went.world, self.task)[0][0])
        pictures: tuple[ShownPicture, ...] = ()
        if self.look is not None:
            moments = [worlds[round(k)] for k in torch.linspace(0, len(worlds) - 1, min(8, len(worlds))).tolist()]
            pictures = (ShownPicture(f"step {step.id}, from its start to its end", self.look.stills(made, moments)),)
        terms = {name: float(x[-1, 0]) for name, x in went.terms.items()}
        found = Carried(
            content,
            bool(went.success[0]) and not failed,
            why,
            float(went.returns[0]) if math.isfinite(float(went.returns[0])) else None,
            {name: x for name, x in terms.items() if math.isfinite(x)},
            episodes,
            time.monotonic() - begun,
            own,
            actions,
            pictures,
        )
        self.carried.append(found)
        self.keep(number, found, part)
        if not failed:
            self.world, self.made, self.holds, self.done = went.world, made, _grasps(step), own

    def search(self, step: Any, problem: _Part, number: int) -> tuple[Tensor, int]:
        """Return the best trajectory (T, 3 R) and how many episodes it took; read if this was searched before."""
        part = problem.task
        kept = self.recall(number, part)
        if kept is not None:
            return kept
        options = self.options
        settings = SearchSettings(
            method=options.method,
            episodes=max(options.episodes, options.population),
            population=options.population,
            seed=options.seed,
            chunk=options.population,
        )
        first = self.led(step, problem)
        if options.enough:
            # Steps that only take hold of something are done by waiting.
            tried = torch.zeros(part.horizon, problem.width, dtype=torch.float64) if first is None else first
            went, _ = problem.played(tried)
            if bool((went.success & ~went.failed)[0]):
                return tried, 1

        def told(stage: str, done: int, total: int, message: str) -> None:
            self.callback(f"step {number}", done, total, message)

        settings.plan(problem)  # what is wrong with the options is not the step's fault
        begin = None if first is None else first[None]
        journal = self.journal(number, part)
        kept_in: dict[str, Any] = {
            "journal": journal,
            "resume": self.talk.resume and journal is not None and journal.is_dir(),
        }
        try:
            found = optimize(problem, settings, callback=told, first=begin, until_success=options.enough, **kept_in)
        except NothingFoundError as error:
            raise _NotCarriedOut(plain_text(str(error))) from None
        if found.interrupted:
            raise KeyboardInterrupt
        return found.actions, found.episodes

    def led(self, step: Any, problem: _Part) -> Tensor | None:
        """Return the trajectory (T, 3 R) through the way-points of a step, None if it has none."""
        if step.waypoints is None or not any(step.waypoints.model_dump().values()):
            return None

        def ways(tools: Tensor) -> Tensor:
            return cast(Tensor, lead_through_waypoints(step, tools, self.task, cut=True))

        return problem.travelled(ways)

    def file(self, number: int) -> Path | None:
        """Return where a step is kept."""
        return None if self.folder is None else self.folder / "steps" / f"{number:02d}.json"

    def journal(self, number: int, part: SubTask) -> Path | None:
        """Return where the search of a step is kept until it is over."""
        file = self.file(number)
        if file is None:
            return None
        digest = hashlib.sha256((self.key(part) + program_hash(part.name)).encode()).hexdigest()
        return file.with_name(f"{number:02d}-{digest[:16]}")

    def key(self, part: SubTask) -> str:
        """Return a hash of all that the search of a step depends on."""
        content = {"part": part.identity, "options": asdict(self.options), "grasps": part.grasps}
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()

    def keep(self, number: int, found: Carried, part: SubTask) -> None:
        """Write down a step that was carried out."""
        file = self.file(number)
        if file is None or found.actions is None or self.folder is None:
            return
        for picture in found.pictures:
            write_atomically(self.folder / "pictures" / f"{picture.digest[:16]}.png", picture.png)
        content = {"generator": "torchdlo plan", "key": self.key(part), **found.plain()}
        write_json(file, content | {"actions": found.actions.tolist()}, indent=None)
        journal = self.journal(number, part)
        if journal is not None and journal.is_dir():
            remove_journal(journal)

    def recall(self, number: int, part: SubTask) -> tuple[Tensor, int] | None:
        """Return what was found for a step in a run that goes on."""
        file = self.file(number)
        if file is None or not self.talk.resume or not file.is_file():
            return None
        content = read_json(file)
        if content is None:
            return None
        try:
            actions = torch.tensor(content["actions"], dtype=torch.float64)
            fits = content["key"] == self.key(part) and actions.shape == (part.horizon, 3 * part.arms.count)
            return (actions, int(content["episodes"])) if fits else None
        except (ValueError, KeyError, TypeError):
            return None


@dataclass(frozen=True, eq=False)
class _Part(TaskProblem):
    """The problem of a step, which remembers what it played alone."""

    task: SubTask
    _alone: dict[bytes, tuple[episode.EpisodeResult, list[episode.EpisodeState]]] = field(default_factory=dict)

    def played(self, actions: Tensor) -> tuple[episode.EpisodeResult, list[episode.EpisodeState]]:
        """Return how a trajectory (T, 3 R) went alone, and the world after each of its actions."""
        key = _bytes(actions)
        if key not in self._alone:
            self._alone[key] = self._from(self.prepared(1), actions)
        return self._alone[key]

    def travelled(self, ways: Callable[[Tensor], Tensor]) -> Tensor:
        """Return what leads hands from where they are when they have taken hold, and play it.

        Args:
            ways: returns actions (T, 3 R) for the places of the tools (R, 3): ropes move while hands travel.
        """
        made, count = self.prepared(1), cast(SubTask, self.task).travels
        if not count:
            return ways(made.start.tool.pos[0])
        idle = torch.zeros(count, self.width, dtype=torch.float64)
        before, worlds = self._from(made, idle)
        rest = ways(before.world.tool.pos[0])
        after, more = self._from(replace(made, start=before.world), rest)
        actions = torch.cat([idle, rest])
        went = tree.replace(after, returns=before.returns + after.returns)
        self._alone[_bytes(actions)] = (went, worlds + more)
        return actions

    def _from(self, made: episode.Episode, actions: Tensor) -> tuple[episode.EpisodeResult, list[episode.EpisodeState]]:
        """Return how actions (T, 3 R) went, and the world after each of them."""
        worlds: list[episode.EpisodeState] = []

        def keep(world: episode.EpisodeState) -> dict[str, Tensor]:
            worlds.append(world)
            return {}

        with torch.no_grad():
            return episode.play(self.task, self.full(actions[None]), episode=made, keep=keep), worlds

    def record(self, actions: Tensor) -> tuple[Evaluation, dict[str, Any]]:
        """Play one trajectory alone; nothing more is kept of it here."""
        went, _ = self.played(actions)
        return Evaluation(went.returns, went.loss, went.terminal_cost, went.success, went.failed), {}


def _bytes(actions: Tensor) -> bytes:
    return actions.double().contiguous().numpy().tobytes()


def _plain(step: Any) -> dict[str, Any]:
    return step.model_dump()


def _grasps(step: Any) -> tuple[int | None, ...]:
    return tuple(step.grasps.model_dump().values())


def _judged(step: Any) -> Reward:
    return reward(step.reward, step.success, "reward")


def carry_out(
    task: Task,
    talk: Conversation,
    options: Options,
    *,
    look: WorldPainter | None = None,
    folder: Path | None = None,
    callback: Callable[[str, int, int, str], None] = lambda *_: None,
    unfinished: Callable[[Result], None] = lambda _: None,
) -> Result:
    """Plan a task and carry the plan out.

    Args:
        task: the task.
        talk: the conversation with the model.
        options: how.
        look: what draws pictures for the model and the report; none are shown if not given.
        folder: where steps are kept, so that a run can go on.
        callback: told (stage, episodes done, episodes in all, message).
        unfinished: told what there is of a run that an exception ends.
    """
    run = _Run(task, talk, options, look, folder, callback, torch.zeros((), dtype=torch.float32))
    try:
        return _result(run, _ended(run))
    except (InputError, KeyboardInterrupt) as error:
        why = plain_text(str(error).rstrip(".")) or "it was stopped"
        unfinished(_result(run, f"not finished: {why}"))
        raise


def _ended(run: _Run) -> str:
    """Carry out steps and ask after each what is left; return why this ended."""
    options = run.options
    _, left = run.ask("plan")
    fruitless = 0
    while True:
        if not left:
            return "the plan was carried out, and the task is not done"
        run.step(left.pop(0), len(run.carried) + 1)
        last = run.carried[-1]
        if run.done:
            return "the task is done"
        if sum(not c.failed for c in run.carried) >= options.steps:
            return f"{options.steps} steps were carried out, and the task is not done"
        if not options.update:
            if last.failed:
                return f"step {last.step['id']} failed: {last.failed}"
            continue
        fruitless = 0 if last.success else fruitless
        complete, note = True, ""
        while complete:
            if fruitless >= options.patience:
                return f"{options.patience} updates made no progress"
            complete, steps = run.ask("update", left, note)
            run.updates, fruitless = run.updates + 1, fruitless + 1
            left = left if complete else steps
            note = "You said that all is done, but the task's own condition does not hold."


def _result(run: _Run, ended: str) -> Result:
    """Return what came of a run."""
    talk = run.talk
    return Result(
        run.task.name,
        talk.model.source,
        run.done,
        ended,
        run.plans,
        run.carried,
        run.updates,
        talk.calls,
        talk.tokens,
        time.monotonic() - run.begun,
        run.world,
    )
