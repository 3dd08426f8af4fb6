"""Policies: what they see, how they are written down, and that TorchRL can use them."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from torchdlo import envs
from torchdlo.agents.policies import (
    FeatureSpec,
    Normaliser,
    Policy,
    PolicySpec,
    load_policy,
    save_policy,
    task_features,
)
from torchdlo.agents.policies.features import Features
from torchdlo.envs.core import episode
from torchdlo.errors import InputError


def made(**choices) -> Policy:
    torch.manual_seed(0)
    return Policy(PolicySpec(FeatureSpec(5, waves=2), actions=3, **({"hidden": (16, 8)} | choices)))


def test_features_are_places_and_places_relative_to_tools():
    """Two points and a tool, far from where they usually are."""
    spec = FeatureSpec(9, (0, 3, 6), ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)), (2,))
    seen = torch.tensor([[1.0, 2, 3, 4, 5, 6, 7, 8, 9]])
    wanted = [1, 2, 3, 3, 5, 6, 7, 8, 8, -6, -6, -6, -3, -3, -3, 0, 0, 0]
    assert Features(spec)(seen, torch.zeros(1, 1)).tolist() == [wanted]
    assert spec.width == len(wanted)


def test_points_of_the_start_are_remembered():
    spec = FeatureSpec(6, (0, 3), ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)), memory=(1,))
    now, start = torch.zeros(1, 6), torch.tensor([[7.0, 7, 7, 4, 5, 6]])
    assert Features(spec)(now, torch.zeros(1, 1), start)[0, 6:].tolist() == [3, 4, 5]
    with pytest.raises(ValueError, match="remembers the start"):
        Features(spec)(now, torch.zeros(1, 1))


def test_observations_of_another_size_are_refused():
    """The points of both would be there in longer ones, and would be others."""
    spec = FeatureSpec(6, (0, 3), ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)), memory=(1,))
    same, share = torch.zeros(1, 6), torch.zeros(1, 1)
    for size in (9, 5):
        for seen in ((torch.zeros(1, size), share, same), (same, share, torch.zeros(1, size))):
            with pytest.raises(InputError, match=f"observations of 6 numbers, and these have {size}; make the env"):
                Features(spec)(*seen)


def test_the_share_of_the_episode_is_told_in_waves():
    spec = FeatureSpec(1, waves=2)
    seen = Features(spec)(torch.zeros(1, 1), torch.full((1, 1), 0.25))[0, 1:]
    root = math.sqrt(0.5)
    torch.testing.assert_close(seen, torch.tensor([0.25, root, 1.0, root, 0.0]), rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", ["wiring_post", "gathering", "slingshot", "lifting"])
def test_task_features_find_ropes_bodies_and_tools_without_velocities(name: str):
    task = envs.find(name)
    spec = task_features(task)
    made = episode.prepare(task, 1, execution="eager")
    start, seen = made.start, episode.observe(made, made.start)
    points = Features(spec)(seen, torch.zeros(1, 1), seen)
    # At the usual start, all points are where they usually are.
    count = 3 * len(spec.points)
    torch.testing.assert_close(points[0, :count], torch.zeros(count), rtol=0, atol=1e-6)
    tools = torch.tensor([spec.centers[k] for k in spec.tools])
    torch.testing.assert_close(tools, start.tool.pos[0].float(), rtol=0, atol=1e-6)
    # Points are three numbers each and do not overlap; velocities of the rope come after its positions.
    vertices = start.state.rods.pos.shape[1]
    assert not any(3 * vertices <= p < 6 * vertices for p in spec.points)


def test_the_normaliser_is_that_of_all_batches_together():
    torch.manual_seed(0)
    x = torch.randn(100, 4, dtype=torch.float64) * torch.tensor([1.0, 5, 0.1, 0]) + 3
    found = Normaliser(4)
    for part in x.split([1, 30, 69]):
        found.update(part)
    torch.testing.assert_close(found.mean, x.mean(0))
    torch.testing.assert_close((found.square / found.count).sqrt(), x.std(0, correction=0))
    # What never varies is not blown up: a millimetre more is a tenth of the least spread.
    late = found(x[:1] + torch.tensor([0, 0, 0, 1e-3]))
    assert float(late[0, 3]) == pytest.approx(0.1)


def test_what_is_not_finite_is_not_learned_from():
    found = Normaliser(1)
    found.update(torch.tensor([[1.0], [math.nan], [3.0]]))
    assert float(found.mean) == 2


@pytest.mark.parametrize("squash", [True, False])
@pytest.mark.parametrize("state_sigma", [True, False])
def test_densities_are_those_of_torchs_distributions(squash: bool, state_sigma: bool):
    policy = made(squash=squash, state_sigma=state_sigma).double()
    features = torch.randn(50, policy.spec.features.width, dtype=torch.float64)
    action, density = policy.draw(features)
    loc, sigma = policy(features)
    wanted = torch.distributions.Normal(loc, sigma)
    if squash:
        tanh = torch.distributions.transforms.TanhTransform()
        wanted = torch.distributions.TransformedDistribution(wanted, [tanh])
    torch.testing.assert_close(density, wanted.log_prob(action).sum(-1), rtol=1e-8, atol=1e-8)


def test_weights_that_are_not_finite_are_refused(tmp_path: Path):
    policy = made()
    with torch.no_grad():
        policy.net[0].weight[0, 0] = math.nan
    save_policy(policy, tmp_path / "policy.pt")
    with pytest.raises(InputError, match=r"policy.pt: its weights are not finite: training went astray"):
        load_policy(tmp_path / "policy.pt")


def test_a_policy_comes_back_from_its_file(tmp_path: Path):
    policy = made(task="coiling")
    policy.normaliser.update(torch.randn(10, policy.spec.features.width))
    save_policy(policy, tmp_path / "policy.pt", {"episodes": 3})
    again, notes = load_policy(tmp_path, notes=True)
    assert (again.spec, notes) == (policy.spec, {"episodes": 3})
    x, p = torch.randn(4, 5), torch.rand(4, 1)
    assert torch.equal(again.act(x, p), policy.act(x, p))


def test_files_with_code_are_refused(tmp_path: Path):
    torch.save({"generator": "torchdlo train", "spec": print}, tmp_path / "policy.pt")
    with pytest.raises(InputError, match="expected a policy"):
        load_policy(tmp_path / "policy.pt")
    (tmp_path / "text.pt").write_text("no policy")
    with pytest.raises(InputError, match="expected a policy"):
        load_policy(tmp_path / "text.pt")
    with pytest.raises(InputError, match="found none"):
        load_policy(tmp_path / "none.pt")


def test_commands_are_ways_in_metres_and_no_turns():
    policy = made()
    policy = Policy(replace(policy.spec, reach=0.01, turns=3))
    command = policy.command(torch.tensor([[1.0, -0.5, 0.0]]))
    torch.testing.assert_close(command, torch.tensor([[0.01, -0.005, 0, 0, 0, 0]]))


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")
def test_a_policy_acts_in_torchrls_rollouts():
    pytest.importorskip("torchrl")
    from small import small
    from torchrl.envs.utils import ExplorationType, set_exploration_type

    from torchdlo.agents.policies import policy_module

    task = small("wiring_post", 3)
    spec = PolicySpec(task_features(task), 3, hidden=(8,), task="wiring_post", reach=0.01, turns=3)
    policy = Policy(spec)
    env = envs.make(task, num_envs=2, execution="eager", variation=False)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        found = env.rollout(3, policy_module(policy))
    first = found[:, 0]
    seen_first = first["observation"], first["progress"], first["start"]
    wanted = policy.act(*seen_first)
    torch.testing.assert_close(first["action"], wanted)
    torch.testing.assert_close(found["progress"][0, :, 0], torch.tensor([0, 1 / 3, 2 / 3]))
    # Where actions are shares of the greatest ways, the same way is done.
    shares = envs.make(task, num_envs=2, execution="eager", variation=False, scaled_actions=True)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        same = shares.rollout(3, policy_module(policy, scaled=True))
    torch.testing.assert_close(same["action"][:, 0], policy.act(*seen_first, scaled=True))
    torch.testing.assert_close(same["action"][..., :3], found["action"][..., :3] / 0.01)
    torch.testing.assert_close(same["next", "observation"], found["next", "observation"], rtol=0, atol=1e-5)
    with set_exploration_type(ExplorationType.RANDOM):
        torch.manual_seed(0)
        assert (env.rollout(1, policy_module(policy))["action"][:, 0] - wanted).abs().max() > 0
