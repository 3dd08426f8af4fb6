"""Several searches of one problem that share their batches, as one of many episodes costs little more than one of few.

Every search runs in a thread of its own and waits for what it asked for; the one that calls `evaluate_batched` plays.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from queue import SimpleQueue
from typing import Any

import torch
from torch import Tensor

from torchdlo.agents.trajopt.problem import Evaluation, Problem
from torchdlo.errors import InputError
from torchdlo.physics import tree

__all__ = ["evaluate_batched"]


def evaluate_batched(
    problem: Problem,
    searches: Sequence[Callable[[Problem], Any]],
    room: int,
    pulse: Callable[[], None] = lambda: None,
    *,
    with_gradient: int | None = None,
) -> list[Any]:
    """Run searches at the same time, and play what they ask for in batches.

    Args:
        problem: what to solve.
        searches: each is called with the problem that it is to search.
        room: episodes of a batch; short ones are filled up, as steps are compiled for every size.
        pulse: called after every batch; a `KeyboardInterrupt` that it raises ends all searches that ask for more.
        with_gradient: episodes of a batch with gradients; as many as without if not given.

    Returns:
        What the searches returned, in order.

    Raises:
        BaseException: what the first search that failed raised, when all have ended.
    """
    rooms = {False: room, True: room if with_gradient is None else with_gradient}
    desk: SimpleQueue[_Wish | None] = SimpleQueue()
    stand_in = problem.surrogate()
    over: BaseException | None = None
    with ThreadPoolExecutor(max(1, len(searches))) as pool:
        running = [pool.submit(search, _Port(problem, stand_in, desk)) for search in searches]
        for each in running:
            each.add_done_callback(lambda _: desk.put(None))
        live, waiting = len(running), []
        while live:
            try:
                wish = desk.get()
                if wish is None:
                    live -= 1
                else:
                    waiting.append(wish)
                if len(waiting) < max(1, live):
                    continue
                if over is None:
                    for one in filter(None, (problem, stand_in)):
                        _play(one, [wish for wish in waiting if wish.problem is one], rooms)
                    pulse()
            except BaseException as error:  # threads that wait have to hear of it, whatever it is
                over = error
            if len(waiting) >= live:
                for wish in waiting:
                    if not wish.answer.done():
                        wish.answer.set_exception(over)
                waiting = []
    return [each.result() for each in running]


@dataclass(frozen=True, eq=False)
class _Wish:
    """What a search asks for."""

    problem: Problem
    actions: Tensor
    """Shape (P, T, A), or (T, A) for a trajectory that is to be recorded alone."""
    answer: Future[Any] = field(default_factory=Future)


class _Port:
    """A problem as one search sees it."""

    def __init__(self, problem: Problem, stand_in: Problem | None, desk: SimpleQueue[_Wish | None]) -> None:
        self.name, self.choices = problem.name, problem.choices
        self.horizon, self.width, self.group = problem.horizon, problem.width, problem.group
        self.limit, self.touch, self.tools = problem.limit, problem.touch, problem.tools
        self._problem, self._stand_in, self._desk = problem, stand_in, desk

    def _ask(self, actions: Tensor) -> Any:
        wish = _Wish(self._problem, actions)
        self._desk.put(wish)
        return wish.answer.result()

    def evaluate(self, actions: Tensor) -> Evaluation:
        """Wait until the actions are played with those of the other searches."""
        went, gradient = self._ask(actions)
        return went if gradient is None else replace(went, loss=_Known.apply(actions, gradient, went.loss))

    def record(self, actions: Tensor) -> tuple[Evaluation, dict[str, Any]]:
        """Wait until the trajectory is played alone."""
        return self._ask(actions)

    def surrogate(self) -> _Port | None:
        """Return the surrogate task, which is shared as well."""
        return None if self._stand_in is None else _Port(self._stand_in, None, self._desk)

    def varied(self, copies: int, scale: float, seed: int) -> Problem:
        """Refuse: worlds differ from search to search."""
        raise InputError(f"{self.name}: robust searches do not share batches; run them one by one.")


class _Known(torch.autograd.Function):
    """Losses whose gradients are known."""

    @staticmethod
    def forward(ctx: Any, actions: Tensor, gradient: Tensor, loss: Tensor) -> Tensor:
        """Return the losses, shape (P,)."""
        ctx.save_for_backward(gradient)
        return loss.clone()

    @staticmethod
    def backward(ctx: Any, pull: Tensor) -> tuple[Tensor, None, None]:
        """Return the gradients, shape (P, T, A)."""
        return pull[:, None, None] * ctx.saved_tensors[0], None, None


def _play(problem: Problem, wishes: Sequence[_Wish], rooms: Mapping[bool, int]) -> None:
    """Answer wishes: trajectories that are to be recorded one by one, all others in batches without or with
    gradients."""
    for wish in wishes:
        if wish.actions.dim() == 2:
            with torch.no_grad():
                wish.answer.set_result(problem.record(wish.actions))
    for with_gradient, room in rooms.items():
        alike = [wish for wish in wishes if wish.actions.dim() == 3 and wish.actions.requires_grad == with_gradient]
        if not alike:
            continue
        actions, sizes = torch.cat([wish.actions.detach() for wish in alike]), [len(wish.actions) for wish in alike]
        parts = [_batch(problem, part, room, with_gradient) for part in actions.split(room)]
        columns = [torch.cat(column).split(sizes) for column in zip(*parts, strict=True)]
        for wish, (*outcome, gradient) in zip(alike, zip(*columns, strict=True), strict=True):
            wish.answer.set_result((Evaluation(*outcome), gradient if with_gradient else None))


def _batch(problem: Problem, actions: Tensor, room: int, with_gradient: bool) -> tuple[Tensor, ...]:
    """Return the parts of the outcome and the gradients of a batch that is filled up with its first trajectory."""
    count = len(actions)
    x = torch.cat([actions, actions[:1].expand(room - count, -1, -1)]).requires_grad_(with_gradient)
    with torch.set_grad_enabled(with_gradient):
        went = problem.evaluate(x)
        gradient = torch.zeros_like(x)
        if with_gradient:
            (gradient,) = torch.autograd.grad(went.loss.sum(), x, allow_unused=True, materialize_grads=True)
    return tuple(part.detach()[:count] for part in (*tree.leaves(went), gradient))
