"""Policies out of trajectories: experts, clones, stages that go on, and the judgement."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

pytest.importorskip("torchrl")
pytest.importorskip("cma")

from lead import Lead, found

from torchdlo import envs
from torchdlo.agents.policies import load_policy
from torchdlo.agents.rl import hybrid_stages as stages
from torchdlo.agents.rl.episodes import TaskEpisodes
from torchdlo.agents.rl.evaluate import evaluate_policies, judge_policies, wilson_interval
from torchdlo.agents.rl.expert import Expert, _spread, candidate_experts, follow_experts, improve_expert
from torchdlo.agents.rl.hybrid_stages import Hybrid, train_hybrid
from torchdlo.agents.rl.rollout import collect_episodes
from torchdlo.agents.rl.settings import training_preset
from torchdlo.agents.rl.spending import Spending
from torchdlo.agents.torch_records import load_checkpoint, save_checkpoint
from torchdlo.cli import app
from torchdlo.errors import InputError
from torchdlo.journal import read_json, write_json

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")

PLAN = Hybrid(
    generations=2, population=4, starts=4, rounds=1, count=16, updates=200, final=1, validation=8, tune_episodes=32
)


def settings(**choices):
    return training_preset("lead", "hybrid", hidden=(32,), critic=(32,), count=16, **choices)


def test_an_expert_follows_a_path_that_moves_with_the_start():
    path, gain = torch.zeros(2, 1, 3), torch.zeros(2, 1, 3, 1, 2)
    path[:, 0, 0], gain[1, 0, 1, 0, 0] = torch.tensor([0.1, 0.2]), 2.0
    expert = Expert(path, gain)
    moved = torch.tensor([[[0.03, 0.0, 0.0]]])
    # The second place is (0.2, 2 * 0.03, 0); the tool is 4 mm beside it, ways are 1 cm at most.
    tool = torch.tensor([[[0.2, 0.056, 0.0]]])
    torch.testing.assert_close(expert.act(1, moved, tool, 0.01), torch.tensor([[0.0, 0.4, 0.0]]))
    torch.testing.assert_close(expert.act(0, moved, torch.zeros(1, 1, 3), 0.01), torch.tensor([[1.0, 0.0, 0.0]]))


def test_changes_of_a_path_begin_with_nothing_and_are_linear_between_knots():
    knots = torch.tensor([[1.0], [3.0]])
    torch.testing.assert_close(_spread(knots, 4), torch.tensor([[0.5], [1.0], [2.0], [3.0]]))


def test_following_a_path_in_the_world_succeeds_where_replaying_it_does_not(tmp_path: Path):
    experts = candidate_experts(Lead(), [found(tmp_path)])
    assert [e.source for e in experts] == ["lead, same places", "lead, moved along"]
    scores = follow_experts(experts, TaskEpisodes(Lead(), 32), noise=0.0, generator=torch.Generator().manual_seed(0))
    # Ropes are up to 10 mm off, 4 mm count as success.
    assert scores[0].success == 1
    assert scores[1].success < 0.7


@pytest.mark.parametrize("disturbed", [0.0, 0.3])
def test_a_search_for_a_robust_path_is_repeatable_and_goes_on(tmp_path: Path, disturbed: float):
    experts = candidate_experts(Lead(), [found(tmp_path)])
    choices = {"seed": 0, "starts": 4, "population": 4, "generations": 2, "enough": 2.0, "disturbed": disturbed}
    first, log, played = improve_expert(Lead(), experts, **choices)
    # Both candidates from 8 starts, two generations of 5 from 4, and the last comparison of 2 from 16.
    assert played == 2 * 8 + 2 * 5 * 4 + 2 * 16
    journal = tmp_path / "robust.json"

    def stop(stage: str, done: int, *_) -> None:
        if done == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        improve_expert(Lead(), experts, **choices, journal=journal, callback=stop)
    assert len(json.loads(journal.read_text())["rows"]) == 2
    kept = read_json(journal)
    write_json(journal, kept | {"spent": kept["spent"] | {"cpu_seconds": 1000.0}}, indent=None)
    spending = Spending()
    again, told, count = improve_expert(Lead(), experts, **choices, journal=journal, spending=spending)
    assert spending.played == played and spending.mark().cpu_seconds > 1000
    assert torch.equal(first.path, again.path) and torch.equal(first.gain, again.gain)
    assert (told, count) == (log, played)


def elsewhere(file: Path, name: str, off: float) -> Path:
    """The same trajectory with tools that are so much higher at the end [m]."""
    content = json.loads(file.read_text())
    for k, places in enumerate(content["tool"]):
        places[0][2] += off * (k + 1) / len(content["tool"])
    (file.parents[1] / name).mkdir()
    other = file.parents[1] / name / "trajectory.json"
    other.write_text(json.dumps(content))
    return other


def searched(files: list[Path], folder: Path, **choices) -> dict:
    """What the first stage alone notes."""
    plan = replace(PLAN, generations=1)
    _, notes = train_hybrid(Lead(), files, settings(), folder=folder, plan=plan, stages=("robust",), **choices)
    return {k: v for k, v in notes["robust"].items() if k in ("episodes", "log")}


def test_a_journal_of_scores_belongs_to_its_trajectories(tmp_path: Path):
    first = found(tmp_path)
    second, third = elsewhere(first, "second", 0.01), elsewhere(first, "third", 0.02)
    other = searched([first], tmp_path / "run")
    again = searched([second], tmp_path / "run")
    assert again == searched([second], tmp_path / "fresh")
    assert again["log"][0]["returns"] != other["log"][0]["returns"]
    # Two where there was one, also with what a search that was killed has left.
    (tmp_path / "run" / "expert.json").unlink()
    (tmp_path / "run" / "stages.json").unlink()
    both = searched([second, third], tmp_path / "run", resume=True)
    assert len([row for row in both["log"] if "source" in row]) == 4
    # Before, journals did not say whose scores they are.
    journal = tmp_path / "run" / "robust.json"
    content = json.loads(journal.read_text())
    journal.write_text(json.dumps(content | {"choices": content["choices"][:7]}))
    (tmp_path / "run" / "expert.json").unlink()
    (tmp_path / "run" / "stages.json").unlink()
    assert searched([second, third], tmp_path / "run", resume=True) == both


def test_a_run_that_is_not_resumed_begins_afresh(tmp_path: Path):
    plan, folder = replace(PLAN, generations=0, updates=20), tmp_path / "run"
    train_hybrid(Lead(), [found(tmp_path)], settings(), folder=folder, plan=plan, stages=("clone",))

    def stop(stage: str, *_) -> None:
        if stage == "robust":
            raise KeyboardInterrupt

    with pytest.raises(InputError, match="no trajectory that succeeds"):
        train_hybrid(Lead(), [], settings(), folder=folder, plan=plan)
    assert (folder / "clone.pt").is_file() and (folder / "expert.json").is_file()
    with pytest.raises(KeyboardInterrupt):
        train_hybrid(Lead(), [found(tmp_path)], settings(), folder=folder, plan=plan, callback=stop)
    # Going on must not take what the first run has made.
    left = {file.name for file in folder.iterdir()}
    assert "policy.pt" in left and not left & {"expert.json", "clone.pt", "clone.part"}
    assert not {"robust", "clone"} & set(json.loads((folder / "stages.json").read_text()))


def test_going_on_with_something_else_is_refused_by_what_differs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    plan, folder, first = replace(PLAN, generations=0, updates=20), tmp_path / "run", found(tmp_path)
    choices = {"folder": folder, "plan": plan, "stages": ("clone",), "resume": True}
    train_hybrid(Lead(), [first], settings(), **choices)
    before = {file.name: file.read_bytes() for file in folder.iterdir()}
    other = elsewhere(first, "other", 0.01)
    for files, chosen, changes, said in (
        ([first], settings(seed=5), {}, r"seed 0 \(now 5\)"),
        ([first], settings(rate=0.1), {}, r"rate 0.0001 \(now 0.1\)"),
        ([first], settings(), {"plan": replace(plan, noise=0.5)}, r"noise 0.001 \(now 0.5\)"),
        ([other], settings(), {}, "other trajectories"),
        ([], settings(), {"expert": folder / "expert.json"}, "another expert"),
    ):
        with pytest.raises(InputError, match=f"stages.json: it belongs to a run with {said}; give the same"):
            train_hybrid(Lead(), files, chosen, **choices | changes)
    assert {file.name: file.read_bytes() for file in folder.iterdir()} == before
    # Budgets may change, and trajectories need not be given again; files of 0.1 do not say which they were.
    notes = json.loads((folder / "stages.json").read_text())
    kept = {k: v for k, v in notes.items() if k not in ("experts", "given", "task", "sha256")}
    (folder / "stages.json").write_text(json.dumps(kept))
    train_hybrid(Lead(), [], settings(minutes=5.0, episodes=999), **choices)
    # Nor which stages are left: what was left out is run, and only once.
    whole = choices | {"stages": ("clone", "tune")}
    policy, notes = train_hybrid(Lead(), [other], settings(), **whole)
    assert notes["tune"]["log"]
    monkeypatch.setattr(stages, "Ppo", None)
    again, told = train_hybrid(Lead(), [other], settings(), **whole)
    assert told["tune"] == json.loads(json.dumps(notes["tune"]))
    for name, value in policy.state_dict().items():
        assert torch.equal(value, again.state_dict()[name]), name


def test_ctrl_c_ends_the_search_of_a_trajectory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys):
    from torchdlo.agents.trajopt import search

    monkeypatch.setitem(envs.TASKS, "lead", Lead)
    won = SimpleNamespace(success=torch.tensor([True]))
    monkeypatch.setattr(search, "optimize", lambda *_, **__: SimpleNamespace(interrupted=True, outcome=won))
    with pytest.raises(SystemExit) as done:
        app.main(["train", "lead", "--out", str(tmp_path / "x")])
    assert done.value.code == 130
    said = capsys.readouterr().err
    assert "interrupted; what was searched is kept in" in said and "go on with: torchdlo train lead" in said
    assert not (tmp_path / "x" / "search" / "trajectory.json").exists()


@pytest.mark.parametrize("won", [True, False])
def test_a_search_keeps_to_the_budget_of_the_clock_and_counts(won: bool, tmp_path: Path, monkeypatch, capsys):
    from torchdlo.agents.trajopt import search, search_result

    monkeypatch.setitem(envs.TASKS, "lead", Lead)

    def late(*_, callback, **__):
        with pytest.raises(KeyboardInterrupt):
            callback("search", 100, 1200, "")
        outcome = SimpleNamespace(success=torch.tensor([won]))
        return SimpleNamespace(interrupted=True, outcome=outcome, episodes=100, seconds=7.0)

    monkeypatch.setattr(search, "optimize", late)
    monkeypatch.setattr(search_result, "result_json", lambda *_: "{}")
    monkeypatch.setattr(search_result, "trajectory_json", lambda *_: found(tmp_path).read_text())
    monkeypatch.setattr(stages, "plan_of", lambda _: PLAN)
    with pytest.raises(SystemExit) as done:
        app.main(["train", "lead", "--out", str(tmp_path / "x"), "--minutes", "1e-9", "--count", "8", "--json"])
    told = capsys.readouterr()
    if won:
        notes = json.loads(told.out)
        assert (notes["search"]["episodes"], notes["search"]["seconds"]) == (100, 7.0)
        assert notes["robust"]["ended"] == "minutes" and len(notes["clone"]["log"]) == 1
        assert "<td>search</td>" in (tmp_path / "x" / "report.html").read_text()
    else:
        assert done.value.code == 2 and "no trajectory that succeeds within 1e-09 minutes" in told.err


def test_an_earlier_search_is_taken_if_its_seed_was_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys):
    from torchdlo.agents.trajopt import search

    monkeypatch.setitem(envs.TASKS, "lead", Lead)
    searches: list[int] = []

    def stop(problem, settings, **_):
        searches.append(settings.seed)
        return SimpleNamespace(interrupted=True, outcome=SimpleNamespace(success=torch.tensor([True])))

    monkeypatch.setattr(search, "optimize", stop)
    notes = {"task": "lead", "plan": {}, "settings": {}}
    monkeypatch.setattr(stages, "train_hybrid", lambda *_, **__: (None, notes))
    folder = tmp_path / "search"
    folder.mkdir()
    (folder / "trajectory.json").write_text("{}")
    (folder / "result.json").write_text(json.dumps({"settings": {"seed": 3}, "episodes": 9, "seconds": 2.5}))
    for seed, code in ((3, (0, None)), (4, (130,))):
        with pytest.raises(SystemExit) as done:
            app.main(["train", "lead", "--out", str(tmp_path), "--seed", str(seed)])
        assert done.value.code in code
        assert ("which was searched before" in capsys.readouterr().err) == (seed == 3)
    assert searches == [4]
    (folder / "result.json").write_text('{"settings": {"se')
    with pytest.raises(SystemExit) as done:
        app.main(["train", "lead", "--out", str(tmp_path), "--seed", "3"])
    said = capsys.readouterr().err
    assert done.value.code == 2 and "result.json: expected a result of a search" in said


def test_the_first_stage_alone_makes_no_policy_and_its_path_is_kept_where_it_is_left_out(tmp_path: Path):
    file, folder = found(tmp_path), tmp_path / "run"
    told: list[str] = []
    with pytest.raises(InputError, match="stages: none is left"):
        train_hybrid(Lead(), [file], settings(), folder=folder, plan=PLAN, stages=())
    train_hybrid(Lead(), [file], settings(), folder=folder, plan=PLAN, stages=("robust",))
    path = (folder / "expert.json").read_bytes()
    assert not (folder / "policy.pt").exists()
    choices = {"folder": folder, "plan": PLAN, "callback": lambda *said: told.append(said[3])}
    train_hybrid(Lead(), [file], settings(), stages=("clone",), **choices)
    assert (folder / "expert.json").read_bytes() == path and (folder / "policy.pt").is_file()
    assert any("the path is taken from" in said for said in told)


def test_ctrl_c_in_the_last_stage_leaves_the_clone_as_the_policy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def stop(stage: str, *_) -> None:
        if stage == "tune":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_hybrid(Lead(), [found(tmp_path)], settings(), folder=tmp_path / "run", plan=PLAN, callback=stop)
    clone, policy = (load_policy(tmp_path / "run" / name) for name in ("clone.pt", "policy.pt"))
    assert all(torch.equal(a, b) for a, b in zip(clone.parameters(), policy.parameters(), strict=True))
    # A tuned one stays where going on with it is stopped.
    run = {"folder": tmp_path / "run", "plan": PLAN, "resume": True}
    train_hybrid(Lead(), [found(tmp_path)], settings(), **run)
    (tmp_path / "run" / "policy.pt").write_bytes(b"tuned")
    monkeypatch.setattr(stages, "_tune", lambda *_: stop("tune"))
    with pytest.raises(KeyboardInterrupt):
        train_hybrid(Lead(), [found(tmp_path)], settings(), **run)
    assert (tmp_path / "run" / "policy.pt").read_bytes() == b"tuned"


class Vain(Lead):
    """Nothing succeeds here."""

    def success(self, seen):
        return torch.zeros_like(super().success(seen))


class Double(Lead):
    """Has a surrogate."""

    def surrogate(self):
        return Vain(fidelity=self.fidelity)


def test_a_path_is_searched_in_the_surrogate_and_compared_in_the_task_itself(tmp_path: Path):
    file = found(tmp_path)
    _, notes = train_hybrid(Double(), [file], settings(), folder=tmp_path, plan=PLAN, stages=("robust", "clone"))
    log = notes["robust"]["log"]
    searched, compared = [row for row in log if "playoff" not in row], [row for row in log if "playoff" in row]
    assert all(row["success"] == 0 for row in searched) and len(searched) == 2 + PLAN.generations
    assert [row["playoff"] for row in compared] == ["before", "after"] and compared[0]["success"] > 0.5
    assert notes["robust"]["episodes"] == 2 * 8 + 2 * 5 * 4 + 2 * 16


def test_a_clone_does_what_its_expert_does(tmp_path: Path):
    policy, notes = train_hybrid(Lead(), [found(tmp_path)], settings(), folder=tmp_path, plan=PLAN)
    assert notes["clone"]["episodes"] == 3 * 16
    assert [row["fidelity"] for row in notes["clone"]["log"]] == ["1ms/2", "1ms/2", "1ms/5"]
    result, plays = evaluate_policies([policy], Lead(), protocols=("one", "varied"))
    assert result["varied"]["success"] >= 0.9 and result["one"]["success"] == 1
    assert plays["varied"]["actions"].shape == (1, 15, 6, 6)
    # All starts of the first protocol are alike, those of the second are not.
    assert float(plays["one"]["moved"].abs().max()) == 0 < float(plays["varied"]["moved"].std())


def slow(folder: Path, names: tuple[str, ...]) -> None:
    """Let what is there of stages have taken 1000 s."""
    time = {"seconds": 1000.0, "cpu_seconds": 1000.0}
    notes = read_json(folder / "stages.json")
    for name in names:
        if name in notes:
            notes[name] |= time
    write_json(folder / "stages.json", notes)
    if (folder / "clone.part").is_file():
        content = load_checkpoint(folder / "clone.part")
        save_checkpoint(folder / "clone.part", content | {"spent": content["spent"] | time})


@pytest.mark.parametrize("disturbed", [0.0, 0.3])
def test_stages_that_are_done_are_not_run_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, disturbed: float):
    plan = replace(PLAN, disturbed=disturbed)
    undisturbed, whole = train_hybrid(Lead(), [found(tmp_path)], settings(), folder=tmp_path / "a", plan=plan)
    told = []

    def stop(stage: str, done: int, *_) -> None:
        told.append((stage, done))
        if (stage, done) == ("clone", 2):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_hybrid(Lead(), [found(tmp_path)], settings(), folder=tmp_path / "b", plan=plan, callback=stop)
    monkeypatch.setattr(stages, "improve_expert", None)
    if not disturbed:
        slow(tmp_path / "b", ("robust", "clone"))
    policy, notes = train_hybrid(Lead(), [], settings(), folder=tmp_path / "b", plan=plan, resume=True)
    for name in stages.STAGES:
        assert notes[name]["episodes"] == whole[name]["episodes"], name
    if not disturbed:
        # The time of the process that was stopped belongs to it.
        assert notes["robust"]["cpu_seconds"] == notes["robust"]["seconds"] == 1000
        assert min(notes["clone"]["cpu_seconds"], notes["clone"]["seconds"]) >= 1000
    for name, value in policy.state_dict().items():
        assert torch.equal(value, undisturbed.state_dict()[name]), name


def test_each_stage_can_be_left_out(tmp_path: Path):
    file = found(tmp_path)
    _, notes = train_hybrid(Lead(), [file], settings(), folder=tmp_path, plan=PLAN, stages=("clone",))
    assert "tune" not in notes and "generation" not in notes["robust"]["log"][-1]
    # Also where an earlier run has left its clone.
    (tmp_path / "expert.json").unlink()
    _, again = train_hybrid(Lead(), [file], settings(), folder=tmp_path, plan=PLAN, stages=("clone",))
    assert again["clone"]["log"] == notes["clone"]["log"]
    with pytest.raises(InputError, match="there is no search"):
        train_hybrid(Lead(), [file], settings(), folder=tmp_path, plan=PLAN, stages=("search",))


def test_tuning_keeps_the_best(tmp_path: Path):
    """A policy that knows nothing is not made worse, whatever PPO does in two batches."""
    policy, notes = train_hybrid(
        Lead(), [found(tmp_path)], settings(), folder=tmp_path, plan=PLAN, stages=("robust", "tune")
    )
    rows = notes["tune"]["log"]
    assert len(rows) == 3
    assert tuple(rows[-1]["best"]) == max((row["success"], row["return"]) for row in rows)
    assert policy.spec.task == "lead"


def test_judgements_are_at_the_published_fidelity_and_repeatable(tmp_path: Path):
    policy, _ = train_hybrid(Lead(), [found(tmp_path)], settings(), folder=tmp_path, plan=PLAN, stages=("clone",))
    rough = envs.with_fidelity(Lead(), "1ms/2")
    other = stages.task_policy(Lead(), settings(seed=1), squash=False)
    first, second = (judge_policies([policy, other], task, starts=4)["varied"] for task in (Lead(), rough))
    assert torch.equal(first["returns"], second["returns"])
    # Both have the same starts, and each does in one batch with the other what it does alone.
    assert torch.equal(first["moved"][0], first["moved"][1])
    assert not torch.equal(first["actions"][0], first["actions"][1])
    alone = judge_policies([policy], Lead(), starts=4, protocols=("varied",))["varied"]
    torch.testing.assert_close(alone["returns"][0], first["returns"][0], rtol=0, atol=1e-3)
    disturbed = judge_policies([policy], Lead(), starts=4, protocols=("disturbed",))["disturbed"]
    assert not torch.equal(alone["actions"], disturbed["actions"])
    # Training starts are not those of the judgement.
    train = TaskEpisodes(Lead(), 4, seed=0)
    collect_episodes(policy, train, random=False)
    assert not torch.equal(alone["moved"][0], train.env.moved)


def test_a_task_says_what_noise_it_takes_and_what_is_given_wins():
    assert stages.plan_of("slingshot").noise == 1e-4 < stages.plan_of("wrapping").noise == Hybrid().noise
    assert stages.plan_of("slingshot", noise=0.002, count=None) == Hybrid(
        noise=0.002, search_noise=2e-4, search_sigma=5e-4
    )
    with pytest.raises(InputError, match="there is no speed"):
        stages.plan_of("coiling", speed=1)


def test_another_seed_judges_from_other_starts():
    policy = stages.task_policy(Lead(), settings(), squash=False)
    first, again, other = (judge_policies([policy], Lead(), starts=3, seed=k)["varied"]["moved"] for k in (0, 0, 1))
    assert torch.equal(first, again) and not torch.equal(first, other)


def test_the_interval_of_a_share_is_wilsons():
    # 8 of 10: 0.490 to 0.943.
    assert wilson_interval(8, 10) == pytest.approx((0.4902, 0.9433), abs=1e-3)
    assert wilson_interval(0, 10)[0] == 0


def test_commands_train_and_judge(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    monkeypatch.setitem(envs.TASKS, "lead", Lead)

    def run(*words: str) -> str:
        with pytest.raises(SystemExit) as done:
            app.main(list(words))
        assert done.value.code in (0, None), capsys.readouterr().err
        return capsys.readouterr().out

    out = tmp_path / "ppo"
    small = ["--count", "8", "--set", "hidden=[16]", "--set", "critic=[16]", "--set", "passes=1"]
    words = ["train", "lead", "--algo", "ppo", "--out", str(out), *small]
    result = json.loads(run(*words, "--episodes", "16", "--fidelity", "coarse", "--json"))
    assert (result["episodes"], result["fidelity"], len(result["curve"])) == (16, "1ms/2", 2)
    assert (out / "curve.png").read_bytes().startswith(b"\x89PNG")
    assert "16 episodes" in (out / "report.html").read_text()
    run(*words, "--episodes", "24", "--fidelity", "coarse", "--resume")
    assert len((out / "log.csv").read_text().splitlines()) == 4
    assert load_policy(out).spec.task == "lead"
    result = json.loads(run("evaluate", str(out), str(out), "--starts", "4", "--json"))
    assert (result["policies"], result["varied"]["episodes"], result["fidelity"]) == (2, 8, "1ms/5")
    assert json.loads((out / "evaluation.json").read_text()) == result
    monkeypatch.setattr(stages, "plan_of", lambda _: PLAN)
    words = ["train", "lead", "--out", str(tmp_path / "hybrid"), "--trajectory", str(found(tmp_path)), *small]
    notes = json.loads(run(*words, "--without", "tune", "--json"))
    assert "clone" in notes and "tune" not in notes
    page = (tmp_path / "hybrid" / "report.html").read_text()
    assert "<td>clone</td>" in page and "<td>tune</td>" not in page
    for wrong, said in (
        (["train", "lead", "--algo", "ppo", "--set", "rate"], "expected NAME=VALUE"),
        (["train", "lead", "--algo", "ppo", "--set", "speed=1"], "there is no speed"),
        (["train", "lead", "--algo", "trpo"], "algorithm is 'trpo'"),
        (["train", "lead", "--without", "search"], "--without search"),
        (["train", "lead", "--algo", "ppo", "--set", "window=3"], "window: it is a setting of shac, sapo"),
        (["train", "lead", "--algo", "sac", "--set", "warm=0"], "warm is 0; expected at least 1 batch"),
        (["train", "coiling", "--trajectory", str(found(tmp_path))], "it is a trajectory of lead with 6 actions"),
        (["evaluate", str(out), "--protocol", "blind"], "--protocol blind"),
    ):
        with pytest.raises(SystemExit) as done:
            app.main([*wrong, *([] if "--out" in wrong or wrong[0] == "evaluate" else ["--out", str(tmp_path / "x")])])
        assert done.value.code == 2
        assert said in capsys.readouterr().err


@pytest.mark.parametrize("name", ["shac", "sac"])
def test_other_algorithms_play_tasks(name: str):
    from torchdlo.agents.rl.results import prepare_training
    from torchdlo.agents.rl.training import train

    choices = {"hidden": (16,), "critic": (16,), "count": 4, "episodes": 8, "window": 3, "warm": 1, "batch": 8}
    chosen = training_preset("lead", name, critic_passes=1, **choices)
    trainer, played = prepare_training(Lead(), chosen)
    before = {k: v.clone() for k, v in trainer.policy.named_parameters()}
    found = train(trainer, played, chosen)
    assert found.episodes == 8
    assert all(torch.isfinite(p).all() for p in trainer.policy.parameters())
    assert any((before[k] != v).any() for k, v in trainer.policy.named_parameters())
