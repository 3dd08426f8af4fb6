"""The loop: seeds, resuming bit by bit, what is left after Ctrl-C and after kill -9."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch

pytest.importorskip("torchrl")

from springs import pusher, springs

from torchdlo.agents.policies import load_policy
from torchdlo.agents.rl.ppo import Ppo
from torchdlo.agents.rl.sac import Sac
from torchdlo.agents.rl.settings import training_preset
from torchdlo.agents.rl.shac import Sapo, Shac
from torchdlo.agents.rl.training import Trained, train
from torchdlo.agents.torch_records import load_checkpoint, save_checkpoint
from torchdlo.errors import InputError

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")

KINDS = {"ppo": Ppo, "sac": Sac, "shac": Shac, "sapo": Sapo}
SMALL = {"count": 8, "batch": 64, "warm": 1, "replay": 1000, "passes": 2, "critic_passes": 2, "window": 10}


def run(name: str, batches: int, folder: Path | None = None, **choices) -> Trained:
    choices = dict(choices)
    kept = {k: choices.pop(k) for k in ("resume", "callback", "task") if k in choices}
    torch.manual_seed(11)
    settings = training_preset("", name, hidden=(16,), critic=(16,), episodes=8 * batches, **(SMALL | choices))
    policy = pusher(hidden=(16,), state_sigma=name in ("sac", "sapo"))
    policy.spec = replace(policy.spec, task=kept.pop("task", ""))
    return train(KINDS[name](policy, settings), springs(8), settings, folder=folder, **kept)


def bits(found: Trained) -> list:
    rows = [{k: v for k, v in row.items() if k != "seconds"} for row in found.rows]
    return [rows, found.best, {k: v.tolist() for k, v in found.policy.state_dict().items()}]


@pytest.mark.parametrize("name", KINDS)
def test_the_same_seed_gives_the_same_bits_and_another_does_not(name: str):
    assert bits(run(name, 3)) == bits(run(name, 3))
    assert bits(run(name, 3)) != bits(run(name, 3, seed=1))


def test_random_actions_of_the_warm_up_are_no_merit_of_a_policy():
    found = run("sac", 1)
    assert found.best == (-math.inf, -math.inf) and found.policy.normaliser.count > 0
    found = run("sac", 3, warm=2)
    assert found.best == (found.rows[2]["success"], found.rows[2]["return"])


@pytest.mark.parametrize("name", ["shac", "sapo"])
def test_the_best_policy_sees_through_the_normaliser_with_which_it_played(name: str):
    assert run(name, 1).policy.normaliser.count > 0


@pytest.mark.parametrize("name", KINDS)
def test_a_run_that_was_resumed_ends_as_if_never_stopped(name: str, tmp_path: Path):
    run(name, 2, tmp_path)
    assert bits(run(name, 5, tmp_path, resume=True)) == bits(run(name, 5))


@pytest.mark.parametrize("name", KINDS)
def test_weights_that_go_astray_end_a_run_and_do_not_replace_what_is_kept(name: str, tmp_path: Path, monkeypatch):
    run(name, 2, tmp_path)
    kept = (tmp_path / "checkpoint.pt").read_bytes()
    plain = KINDS[name].iterate

    def astray(self, episodes):
        found = plain(self, episodes)
        with torch.no_grad():
            next(iter(self.policy.parameters())).fill_(math.nan)
        return found

    monkeypatch.setattr(KINDS[name], "iterate", astray)
    with pytest.raises(InputError, match=r"rate is .*: weights of the policy are no longer finite after 24 episodes"):
        run(name, 9, tmp_path, resume=True, interval=0.0)
    assert (tmp_path / "checkpoint.pt").read_bytes() == kept
    assert all(bool(x.isfinite().all()) for x in load_policy(tmp_path).state_dict().values())


def test_training_leaves_torchs_generator_as_it_was():
    torch.manual_seed(1)
    before = torch.get_rng_state()
    settings = training_preset("", "ppo", hidden=(16,), critic=(16,), episodes=8, **SMALL)
    trainer = Ppo(pusher(hidden=(16,)), settings)
    torch.set_rng_state(before)
    train(trainer, springs(8), settings)
    assert torch.equal(torch.get_rng_state(), before)


def test_ctrl_c_keeps_the_best(tmp_path: Path):
    def stop(stage: str, done: int, total: int, message: str) -> None:
        if done >= 16:
            raise KeyboardInterrupt

    found = run("ppo", 100, tmp_path, callback=stop)
    assert found.interrupted
    assert found.episodes == 16
    kept = load_policy(tmp_path / "policy.pt")
    assert all(torch.equal(a, b) for a, b in zip(kept.parameters(), found.policy.parameters(), strict=True))
    log = (tmp_path / "log.csv").read_text().splitlines()
    assert len(log) == 3
    assert log[0].startswith("episodes,seconds,return,success,failed")


def test_other_settings_are_refused_by_what_differs(tmp_path: Path):
    run("ppo", 1, tmp_path)
    with pytest.raises(InputError, match=r"clip 0.2 \(now 0.1\)"):
        run("ppo", 2, tmp_path, resume=True, clip=0.1)
    with pytest.raises(InputError, match="found none"):
        run("ppo", 2, tmp_path / "other", resume=True)


@pytest.mark.parametrize("old", [False, True])
def test_a_run_of_another_task_is_refused(old: bool, tmp_path: Path):
    run("ppo", 1, tmp_path, task="left")
    file = tmp_path / "checkpoint.pt"
    if old:
        content = load_checkpoint(file)
        save_checkpoint(file, {k: v for k, v in content.items() if k != "policy"})
    with pytest.raises(InputError, match=r"of the task left \(now right\); give the same, or leave out --resume"):
        run("ppo", 2, tmp_path, task="right", resume=True)
    wider = pusher(hidden=(16, 16))
    wider.spec = replace(wider.spec, task="left")
    settings = training_preset("", "ppo", hidden=(16,), critic=(16,), episodes=16, **SMALL)
    with pytest.raises(InputError, match="of a policy of other hidden"):
        train(Ppo(wider, settings), springs(8), settings, folder=tmp_path, resume=True)
    assert run("ppo", 2, tmp_path, task="left", resume=True).episodes == 16


def test_minutes_are_a_budget_too():
    assert run("ppo", 1000, minutes=1e-9).episodes == 8


def test_a_killed_run_loses_one_interval_at_most(tmp_path: Path):
    here = Path(__file__)
    code = (
        f"import sys; sys.path[:0] = [{str(here.parent)!r}]\n"
        "import torch; torch.set_num_threads(1)\n"
        "import pathlib, test_training as t\n"
        f"t.run('ppo', 100000, pathlib.Path({str(tmp_path)!r}), interval=0.0)\n"
    )
    process = subprocess.Popen([sys.executable, "-W", "ignore", "-c", code], env=os.environ | {"OMP_NUM_THREADS": "1"})
    checkpoint, end = tmp_path / "checkpoint.pt", time.monotonic() + 600
    while not checkpoint.exists() and time.monotonic() < end:
        time.sleep(0.05)
    time.sleep(0.5)
    process.send_signal(signal.SIGKILL)
    process.wait()
    done = load_checkpoint(checkpoint)["episodes"]
    assert done >= 8
    batches = done // 8 + 2
    assert bits(run("ppo", batches, tmp_path, resume=True, interval=0.0)) == bits(run("ppo", batches, interval=0.0))


def test_interval_and_budget_may_change_on_resuming(tmp_path: Path):
    run("ppo", 1, tmp_path)
    assert run("ppo", 2, tmp_path, resume=True, interval=5.0).episodes == 16
