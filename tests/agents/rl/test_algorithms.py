"""All algorithms push a point on a spring to rest; those with gradients need fewer episodes."""

from __future__ import annotations

import pytest
import torch

pytest.importorskip("torchrl")

from springs import pusher, solved, springs

from torchdlo.agents.rl.ppo import Ppo
from torchdlo.agents.rl.sac import Sac
from torchdlo.agents.rl.settings import training_preset
from torchdlo.agents.rl.shac import Sapo, Shac
from torchdlo.agents.rl.training import train

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")

CHOICES = {
    "ppo": {"episodes": 64 * 30, "count": 64, "rate": 1e-3, "passes": 8, "batch": 512},
    "sac": {"episodes": 16 * 22, "count": 16, "batch": 256, "warm": 2, "rate": 1e-3, "critic_rate": 1e-3, "updates": 2},
    "shac": {"episodes": 16 * 18, "count": 16, "window": 10, "critic_passes": 8, "rate": 5e-3},
    "sapo": {"episodes": 16 * 18, "count": 16, "window": 10, "critic_passes": 8, "rate": 5e-3},
}
KINDS = {"ppo": Ppo, "sac": Sac, "shac": Shac, "sapo": Sapo}


@pytest.mark.parametrize("name", ["ppo", "shac", "sapo", pytest.param("sac", marks=pytest.mark.slow)])
def test_a_point_on_a_spring_is_pushed_to_rest(name: str):
    torch.manual_seed(0)
    settings = training_preset("", name, hidden=(32, 32), critic=(32, 32), replay=20_000, **CHOICES[name])
    policy = pusher(sigma=settings.sigma, state_sigma=name in ("sac", "sapo"))
    found = train(KINDS[name](policy, settings), springs(settings.count), settings)
    reached, nothing, feedback = solved(found.policy)
    # A linear feedback that was tuned by hand gains 5.4 over doing nothing.
    assert feedback - nothing > 5
    assert reached > nothing + 0.8 * (feedback - nothing)


def test_gradients_need_fewer_episodes():
    assert max(CHOICES[k]["episodes"] for k in ("shac", "sapo")) < min(CHOICES[k]["episodes"] for k in ("ppo", "sac"))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ppo", "sac"])
def test_torchrls_pendulum_is_swung_up(name: str):
    from torchrl_pendulum import pendulums, swinger, swung

    torch.manual_seed(0)
    choices = {
        "ppo": {"episodes": 64 * 120, "count": 64, "rate": 1e-3, "passes": 10, "batch": 1024, "gamma": 0.95},
        "sac": {"episodes": 8 * 30, "count": 8, "batch": 256, "warm": 2, "updates": 2, "rate": 1e-3, "gamma": 0.97},
    }
    settings = training_preset(
        "", name, hidden=(64, 64), critic=(64, 64), critic_rate=1e-3, replay=50_000, **choices[name]
    )
    policy = swinger(sigma=0.6, state_sigma=name == "sac")
    found = train(KINDS[name](policy, settings), pendulums(settings.count), settings)
    # Hanging down earns -pi^2 per action: about -1000 in 100 actions from random starts; upright earns 0.
    assert swung(found.policy) > -250
