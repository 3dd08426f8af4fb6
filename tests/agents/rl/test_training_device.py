"""Training on another device: what is refused, what stays there, and files that are read without it."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import pytest
import torch

pytest.importorskip("torchrl")

from torchdlo.agents.policies import load_policy
from torchdlo.agents.rl.episodes import TaskEpisodes
from torchdlo.agents.rl.results import prepare_training, train_json, train_result
from torchdlo.agents.rl.settings import TrainingSettings, training_preset
from torchdlo.agents.rl.training import train
from torchdlo.agents.torch_records import load_checkpoint, save_checkpoint
from torchdlo.cli import main
from torchdlo.coupling.robot import ik_op
from torchdlo.envs import find
from torchdlo.envs.core import episode
from torchdlo.errors import InputError
from torchdlo.physics import tree

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning", "ignore::UserWarning")

needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
TINY = {"count": 2, "hidden": (8,), "critic": (8,), "window": 1, "warm": 1, "replay": 100}


@pytest.mark.parametrize(
    ("choices", "said"),
    [
        ({"device": "gpu"}, "device is 'gpu'; expected cpu or cuda"),
        ({"device": "cuda:1"}, "CUDA_VISIBLE_DEVICES chooses"),
        ({"device": "cuda", "algorithm": "hybrid"}, "ppo, sac, shac and sapo can have a GPU"),
        ({"device": "cuda", "collectors": 2}, "as collectors play there"),
    ],
)
def test_settings_say_which_devices_there_are(choices: dict, said: str):
    with pytest.raises(InputError, match=said):
        TrainingSettings(**choices)


def test_a_gpu_that_is_not_there_is_refused(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(InputError, match="device is 'cuda', but torch sees no GPU here"):
        prepare_training(find("wiring_post"), training_preset("wiring_post", "ppo", device="cuda"))


@pytest.mark.parametrize("algo", ["ppo", "hybrid"])
def test_the_command_refuses_it_in_a_sentence(monkeypatch, tmp_path: Path, capsys, algo: str):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr("sys.argv", ["torchdlo", "train", "wiring_post", "--algo", algo, "--device", "cuda"])
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    assert "device is 'cuda'" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["wiring_post", "separation"])
def test_what_an_action_makes_is_where_its_scenes_are(monkeypatch, name: str):
    """Tensors without numbers do not mix with others, so that one that is made on the CPU shows."""
    task = dataclasses.replace(find(name), frame_skip=1)
    made = episode.prepare(task, 2, execution="eager")
    params, world = tree.map(lambda x: x.to("meta"), (made.params, made.start))

    def solved(robot, give, turns, scales, search, given):
        batch, n = given[-1].shape
        assert all(x.is_meta for x in given)
        return tuple(give.new_zeros(batch, *rest) for rest in ((n,), (3,), (4,), (), (6, n), (n, 6)))

    monkeypatch.setattr(ik_op, "ready", lambda *_: True)
    monkeypatch.setattr(ik_op, "solve", solved)
    there = dataclasses.replace(made, params=params, start=world)
    step = episode.control_step(there, world, torch.zeros(2, task.width, device="meta"), False)
    assert all(x.is_meta for x in tree.leaves(step))
    assert episode.observe(there, step.world).is_meta
    assert episode.successes(task, step.world).is_meta
    assert episode.terminal_costs(task, step.world).is_meta


def short(algo: str, folder: Path, batches: int, resume: bool = False, device: str = "cpu"):
    """Train for some batches of two actions."""
    task = dataclasses.replace(find("wiring_post"), horizon=2, frame_skip=2)
    settings = training_preset("wiring_post", algo, **TINY | {"episodes": 2 * batches, "device": device})
    trainer, played = prepare_training(task, settings)
    found = train(trainer, played, settings, folder=folder, resume=resume)
    return found, train_json(train_result(task, settings, found))


def test_a_run_goes_on_where_it_was_trained_and_nowhere_else(monkeypatch, tmp_path: Path):
    found, said = short("ppo", tmp_path, 1)
    assert json.loads(said)["device"] == "cpu"
    content = load_checkpoint(tmp_path / "checkpoint.pt")
    assert content is not None
    older = json.loads(content["settings"])
    del older["device"]  # as checkpoints had it when there was no choice
    save_checkpoint(tmp_path / "checkpoint.pt", content | {"settings": json.dumps(older)})
    again, _ = short("ppo", tmp_path, 2, resume=True)
    assert (found.episodes, again.episodes) == (2, 4)
    save_checkpoint(tmp_path / "checkpoint.pt", content | {"settings": json.dumps(older | {"device": "cuda"})})
    with pytest.raises(InputError, match=r"device cuda \(now cpu\)"):
        short("ppo", tmp_path, 3, resume=True)


@needs_gpu
@pytest.mark.gpu
@pytest.mark.slow
@pytest.mark.parametrize("algo", ["ppo", "sac", "shac", "sapo"])
def test_a_gpus_run_leaves_files_for_the_cpu(algo: str, tmp_path: Path):
    straight, _ = short(algo, tmp_path / "straight", 2, device="cuda")
    short(algo, tmp_path, 1, device="cuda")
    resumed, _ = short(algo, tmp_path, 2, resume=True, device="cuda")
    assert len(resumed.rows) == len(straight.rows) == 2
    assert resumed.rows[-1]["return"] == pytest.approx(straight.rows[-1]["return"], abs=1e-4)
    for one, other in zip(resumed.policy.parameters(), straight.policy.parameters(), strict=True):
        torch.testing.assert_close(one, other, atol=1e-3, rtol=1e-3)
    content = load_checkpoint(tmp_path / "checkpoint.pt")
    assert content is not None
    assert not any(x.is_cuda for x in tree.leaves(content["parts"]) if isinstance(x, torch.Tensor))
    policy = load_policy(tmp_path)
    assert all(p.device.type == "cpu" for p in policy.parameters())


@needs_gpu
@pytest.mark.gpu
@pytest.mark.slow
@pytest.mark.parametrize("name", ["wiring_post", "separation", "lifting"])
def test_a_task_is_played_on_a_gpu_as_on_the_cpu(name: str):
    task = dataclasses.replace(find(name), frame_skip=2)
    played = [TaskEpisodes(task, 2, device=device, execution="eager") for device in ("cpu", "cuda")]
    begun = [each.reset() for each in played]
    torch.testing.assert_close(begun[1].cpu(), begun[0], atol=1e-5, rtol=0)
    action = 0.5 * torch.tensor(task.limit).expand(2, -1)
    steps = [each.step(action.to(device)) for each, device in zip(played, ("cpu", "cuda"), strict=True)]
    torch.testing.assert_close(steps[1].reward.cpu(), steps[0].reward, atol=1e-4, rtol=1e-4)
    at = 3 * 60  # positions; velocities are less alike
    torch.testing.assert_close(steps[1].observation[:, :at].cpu(), steps[0].observation[:, :at], atol=1e-4, rtol=0)
