"""What searches begin with."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
import torch

from tests.agents.problems import Plain, judged
from torchdlo.agents.trajopt.proposals import circular_proposals, drag_proposals
from torchdlo.agents.trajopt.search import SearchSettings, optimize
from torchdlo.agents.trajopt.task_problem import task_problem

pytestmark = pytest.mark.quick


@dataclass(frozen=True)
class Orbit(Plain):
    """A point that is to go once round an axis, within 15 cm of it; the return is by how much it turns there."""

    name: str = "orbit"
    horizon: int = 100
    width: int = 3
    group: int = 3
    limit: float = 0.01
    touch: tuple[tuple[float, float, float], ...] = ((0.3, 0.4, 0.0),)
    tools: tuple[tuple[float, float, float], ...] = ()
    axis: tuple[float, float] = (0.3, 0.4)

    def evaluate(self, actions):
        """Turns, in whole ones."""
        arm = actions.cumsum(1)[..., :2] - actions.new_tensor(self.axis)
        a, b = arm[:, :-1], arm[:, 1:]
        turn = torch.atan2(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0], (a * b).sum(-1)) / (2 * torch.pi)
        turns = torch.where(a.norm(dim=-1) < 0.15, turn, 0.0).sum(-1).abs()
        return judged(turns, turns > 1)


def test_rounds_go_straight_to_a_circle_about_a_thing_and_on_along_it():
    orbit = Orbit(touch=((0.3, 0.4, 0.1),))
    plan = SearchSettings(method="hybrid", episodes=40, population=20, hold=1).plan(orbit)
    encoding = plan.encoding(1)
    points = circular_proposals(plan, encoding, torch.Generator().manual_seed(0), 40)
    path = encoding.decode(points).cumsum(1)
    assert points.shape == (40, encoding.size) and path.diff(dim=1).norm(dim=-1).max() <= 0.01
    # Those that are fast enough end on a circle of 2 to 20 cm about its axis, at an even height up to 20 cm above it.
    end = path[:, -10:]
    level = torch.arange(40) % 4 != 3
    apart = (end[..., :2] - torch.tensor(orbit.axis)).norm(dim=-1)
    reached = level & (apart.std(1) < 1e-5)
    assert reached.sum() > 20 and (apart[reached] > 0.0199).all() and (apart[reached] < 0.2001).all()
    height = end[reached][..., 2]
    assert height.std(1).max() < 1e-6 and height.min() > 0.1 - 1e-5 and height.max() < 0.3 + 1e-5
    assert end[~level][..., 2].std(1).median() > 1e-3
    # Before that, they go straight.
    leg = path[:, :20]
    assert (leg - leg[:, -1:] * torch.arange(1, 21)[:, None] / 20).abs().max() < 1e-6


def test_drags_go_straight_over_a_thing_and_tools_draw_nearer():
    aim, tools = torch.tensor([0.3, 0.4, 0.0]), torch.tensor([[-0.3, 0.0, 0.0], [0.2, 0.1, 0.0], [0.1, -0.1, 0.0]])
    pulled = Orbit(width=9, touch=(tuple(aim.tolist()),), tools=tuple(map(tuple, tools.tolist())))
    plan = SearchSettings(method="hybrid", episodes=60, population=60, hold=10).plan(pulled)
    encoding = plan.encoding(10, 0.2)
    points = drag_proposals(plan, encoding, torch.Generator().manual_seed(0), 60)
    actions = encoding.decode(points).unflatten(-1, (3, 3))
    path = actions.cumsum(1)
    assert actions.norm(dim=-1).max() <= 0.01
    # Tools are cut to their limit one by one; those that are not stay in line with each other and with the thing.
    slow = actions.norm(dim=-1).amax((1, 2)) < 0.0099
    assert slow.sum() > 20
    middle = path[slow].mean(2)
    assert torch.linalg.cross(middle, aim.double().expand_as(middle)).abs().max() < 1e-9
    assert (middle @ aim.double()).min() >= 0
    share = (path[slow] - middle.unsqueeze(2)) / tools.where(tools != 0, torch.nan).double()
    share = -share.nanmean((-2, -1))
    # Nearer with every action, to no less than nothing; from hardly at all to nearly all of the way.
    assert (share.diff(dim=1) >= -1e-9).all() and share[:, -1].max() < 1
    assert share[:, -1].min() < 0.2 and share[:, -1].max() > 0.8


@pytest.mark.parametrize("kind", [circular_proposals, drag_proposals])
def test_rounds_and_drags_need_something_to_touch(kind):
    plan = SearchSettings(method="hybrid", episodes=40, population=20).plan(Orbit(touch=()))
    with pytest.raises(ValueError, match="nothing to touch"):
        kind(plan, plan.encoding(10), torch.Generator(), 3)


@pytest.mark.parametrize("touch", [(), ((0.3, 0.4, 0.0),)])
def test_a_hybrid_goes_round_what_it_is_told_of(touch):
    settings = [SearchSettings(method="hybrid", episodes=40, population=40, seed=seed) for seed in range(4)]
    done = [bool(optimize(Orbit(touch=touch), s).outcome.success) for s in settings]
    assert done == [bool(touch)] * 4


def test_tasks_say_where_their_bodies_and_matter_are_but_not_where_the_floor_is():
    assert task_problem("unknotting").touch == ()
    (cone,) = task_problem("coiling").touch
    assert cone == pytest.approx((0.58, -0.265, 0.063))
    lifting, gathering = task_problem("lifting").touch, task_problem("gathering").touch
    assert len(lifting) == 2 and len(gathering) == 3
    assert task_problem("coiling").tools == ((0.0, 0.0, 0.0),)
    left, right = task_problem("gathering").tools
    assert left == pytest.approx((-0.42, 0.0, 0.0)) and right == pytest.approx((0.42, 0.0, 0.0))
    # The middle of the ball is given last.
    assert gathering[-1] == pytest.approx((0.25 - 0.29, 0.02 - 0.1, 0.07 - 0.012), abs=2e-3)
