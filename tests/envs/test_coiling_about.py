"""Two tasks in one scene: nothing but the instruction tells them apart, and what does one does not do the other."""

from __future__ import annotations

import math

import pytest
import torch

from torchdlo.envs import PAIRED_TASKS, TASKS, find
from torchdlo.envs.core import episode
from torchdlo.envs.core.task import TaskState
from torchdlo.physics import tree

LEFT, RIGHT = find("coiling_left"), find("coiling_right")


def helix(side: float) -> TaskState:
    """A rope whose first end has gone round the cone by 1.2 turns; the rest lies along +x."""
    state = LEFT.start(1)[2]
    angle = side * torch.linspace(2.4 * math.pi, 0, 60)
    line = torch.stack([0.08 * angle.cos(), 0.08 * angle.sin(), torch.full_like(angle, 0.15)], -1)
    rods = tree.replace(state.rods, pos=line[None])
    return TaskState(tree.replace(state, rods=rods), None, None, {})


def test_both_start_alike() -> None:
    a, b = (task.start(1)[2].rods.pos for task in (LEFT, RIGHT))
    assert torch.equal(a, b) and LEFT.arms == RIGHT.arms
    # The rope lies on a line through the axis of the cone, so either way about is as far.
    assert not a[..., 1].any() and not PAIRED_TASKS.keys() & TASKS.keys()


def test_what_does_one_does_not_do_the_other() -> None:
    for side, done, other in ((1.0, LEFT, RIGHT), (-1.0, RIGHT, LEFT)):
        seen = helix(side)
        assert bool(done.success(seen)) and not bool(other.success(seen))
        assert float(done.rewards(seen)["turned"]) == 1 and float(other.rewards(seen)["turned"]) == -1


def test_their_demonstrations_mirror_each_other() -> None:
    mirror = torch.tensor([1.0, -1.0, 1.0] * 2, dtype=torch.float64)
    assert torch.allclose(LEFT.demonstration()[:, :3], RIGHT.demonstration()[:, :3] * mirror[:3], atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("task", [LEFT, RIGHT], ids=lambda task: task.name)
def test_demonstrations_succeed_from_starts_that_vary(task) -> None:
    pytest.importorskip("pytorch_kinematics", reason="arms need the extra robots")
    made = episode.prepare(task, 4, generator=torch.Generator().manual_seed(2), variation=True, execution="recorded")
    with torch.no_grad():
        went = episode.play(task, task.demonstration(made.start.state).float(), episode=made)
    assert went.success.all() and not went.failed.any()
