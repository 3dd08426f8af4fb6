"""Gradients of SHAC's actor: through the simulation, the policy's input and the critic."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

pytest.importorskip("torchrl")

from springs import move, pusher, springs

from torchdlo.agents.policies import Policy, PolicySpec
from torchdlo.agents.policies.features import FeatureSpec
from torchdlo.agents.rl.rollout import episode_progress, policy_features
from torchdlo.agents.rl.settings import training_preset
from torchdlo.agents.rl.shac import Sapo, Shac, Window, _look_first, actor_loss, saturation_loss

F64 = torch.float64


def trainer(kind=Shac, **choices):
    torch.manual_seed(3)
    settings = training_preset("", "shac", **({"count": 4, "episodes": 400, "window": 6, "tame": 0.0} | choices))
    policy = pusher(state_sigma=kind is Sapo).double()
    return kind(policy, settings), springs(4, 1, F64)


def played(made: Shac, episodes, seed: int = 5) -> Window:
    episodes.generator.manual_seed(7)
    seen = episodes.reset()
    torch.manual_seed(seed)
    return made.play(episodes, seen, 0, torch.zeros(4, dtype=torch.bool))[0]


def loss_of(made: Shac, episodes, seed: int = 5) -> torch.Tensor:
    window = played(made, episodes, seed)
    value = made.bootstrap(window.features[-1])
    return actor_loss(window, value, gamma=made.settings.gamma, temperature=made.temperature)


@pytest.mark.parametrize("kind", [Shac, Sapo])
def test_the_gradient_is_that_of_central_differences(kind):
    made, episodes = trainer(kind)
    made.critic.double()
    made.target.double()
    if kind is Sapo:
        made.log_temperature.data.fill_(-1.0)
    grads = torch.autograd.grad(loss_of(made, episodes), list(made.policy.parameters()), allow_unused=True)
    rng = torch.Generator().manual_seed(0)
    for p, g in zip(made.policy.parameters(), grads, strict=True):
        away = torch.randn(p.shape, generator=rng, dtype=F64)
        values = []
        for sign in (1, -1):
            with torch.no_grad():
                p.add_(sign * 1e-5 * away)
                values.append(float(loss_of(made, episodes)))
                p.sub_(sign * 1e-5 * away)
        numeric = (values[0] - values[1]) / 2e-5
        assert float((g * away).sum()) == pytest.approx(numeric, rel=1e-4, abs=1e-9)


def test_the_gradient_is_that_of_a_loop_by_hand():
    made, episodes = trainer()
    made.critic.double()
    made.target.double()
    params = list(made.policy.parameters())
    found = torch.autograd.grad(loss_of(made, episodes), params)
    episodes.generator.manual_seed(7)
    x, v = (2 * torch.rand(4, 2, generator=episodes.generator, dtype=F64) - 1).unbind(-1)
    torch.manual_seed(5)
    policy, total = made.policy, 0.0
    for k in range(6):
        seen = torch.stack([x, v], -1)
        loc, sigma = policy(policy.features(seen, episode_progress(episodes, k, seen)))
        u = (loc + sigma * torch.randn_like(loc)).tanh()[:, 0]
        x, v = move(x, v, u)
        total = total - made.settings.gamma**k * (x.square() + 0.1 * v.square())
    seen = torch.stack([x, v], -1)
    after = made.target[0](policy.features(seen, episode_progress(episodes, 6, seen)))[:, 0]
    loss = -(total + made.settings.gamma**6 * after).sum() / (6 * 4)
    for a, b in zip(found, torch.autograd.grad(loss, params), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-10, atol=1e-12)


def test_wild_scenes_are_tamed_before_scenes_are_averaged():
    """A gradient with respect to an action is no longer than `tame` / (window times batch)."""
    made, episodes = trainer(tame=1e-3)
    made.critic.double()
    made.target.double()
    plain, other = trainer()
    plain.critic.load_state_dict(made.critic.state_dict())
    plain.policy.load_state_dict(made.policy.state_dict())
    plain.target.double()
    params = list(made.policy.parameters())
    small = torch.autograd.grad(loss_of(made, episodes), params)
    large = torch.autograd.grad(loss_of(plain, other), list(plain.policy.parameters()))
    assert sum(g.square().sum() for g in small) < 0.01 * sum(g.square().sum() for g in large)
    assert float(torch.stack(made.lost).max()) > 0 == float(torch.stack(plain.lost).max())


def test_entropy_is_worth_less_than_what_actions_earn_at_first():
    """An entropy of a unit per action earns less than an action of a success, a hundredth of a scaled return of 10."""
    made, _ = trainer(Sapo)
    assert float(made.temperature) == pytest.approx(0.002)
    made, _ = trainer(Sapo, temperature=0.5)
    assert float(made.temperature) == pytest.approx(0.5)


def test_the_temperature_goes_by_actions_of_episodes_that_have_not_failed():
    made, episodes = trainer(Sapo)
    window = played(made, episodes)
    density = window.log_prob.detach().clone()
    density[:, 0], density[1:, 1] = 1.5, -50.0  # the second scene fails in its first action
    density[0, 1] = 0.5
    failed = torch.zeros_like(window.failed)
    failed[:, 1] = True
    begun = torch.tensor([True, True, False, False])
    failed[:, 2:] = True
    dead = replace(window, log_prob=density, failed=failed, begun=begun)
    steps = len(density)
    before = made.log_temperature.detach().clone()
    told = made._heat(dead)
    assert float(told["entropy"]) == pytest.approx(-(1.5 * steps + 0.5) / (steps + 1))
    after = made.log_temperature.detach().clone()
    assert after > before  # the entropy that is wanted is -0.5
    # Nothing is left to go by.
    assert "entropy" not in made._heat(replace(dead, failed=torch.ones_like(failed), begun=~torch.ones_like(begun)))
    assert made.log_temperature == after


def test_the_first_batch_sees_how_far_the_episode_is():
    episodes = springs(4, 1, F64)
    policy = Policy(PolicySpec(FeatureSpec(2, waves=6), actions=1, hidden=(8,))).double()
    seen = episodes.reset()
    _look_first(policy, episodes, seen)
    assert float(policy.normaliser.count) == pytest.approx(4)
    ends = range(episodes.horizon + 1)
    x = torch.stack([policy.normaliser(policy_features(policy, episodes, k, seen)) for k in ends])
    assert float(x.abs().max()) < 5
    # The share of the episode itself has mean 0 and spread 1, all its values being equally often.
    torch.testing.assert_close(x[..., 2].mean(), torch.zeros((), dtype=F64), rtol=0, atol=1e-9)
    torch.testing.assert_close(x[..., 2].square().mean(), torch.ones((), dtype=F64), rtol=1e-9, atol=0)
    # What does not depend on time is as the starts alone have it.
    torch.testing.assert_close(policy.normaliser.mean[:2], seen.mean(0))
    torch.testing.assert_close(policy.normaliser.square[:2] / 4, seen.var(0, unbiased=False))


def test_means_that_saturate_are_led_back_where_no_reward_does():
    made, episodes = trainer(saturation=1.0)
    policy = made.policy
    with torch.no_grad():
        policy.net[-1].bias.fill_(5.0)
    window = played(made, episodes)
    with torch.no_grad():
        loc, _ = policy(window.features[:-1])
    assert float(loc.min()) > 4
    loss = saturation_loss(policy, window)
    assert loss.item() == pytest.approx(float((loc - 1.5).square().mean()), rel=1e-12)
    actor = actor_loss(window, torch.zeros(4, dtype=F64), gamma=0.99)
    bias = policy.net[-1].bias
    (weak,) = torch.autograd.grad(actor, bias, retain_graph=True)
    (strong,) = torch.autograd.grad(loss, bias)
    assert float(strong.min()) == pytest.approx(float(2 * (loc - 1.5).mean()), rel=1e-12)
    assert float(strong.abs().max()) > 100 * float(weak.abs().max())


def test_means_within_bounds_and_episodes_that_failed_pay_nothing_for_saturation():
    made, episodes = trainer(saturation=1.0)
    window = played(made, episodes)
    assert saturation_loss(made.policy, window).item() == 0
    with torch.no_grad():
        made.policy.net[-1].bias.fill_(5.0)
    whole = saturation_loss(made.policy, window).item()
    gone = torch.tensor([False, True, False, True])
    half = replace(window, begun=~gone, failed=gone.expand_as(window.failed))
    assert 0.3 * whole < saturation_loss(made.policy, half).item() < 0.7 * whole
