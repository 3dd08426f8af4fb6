"""What a budget of episodes or of minutes leaves of the hybrid's stages."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

pytest.importorskip("torchrl")
pytest.importorskip("cma")

from lead import Lead, found

from torchdlo import envs
from torchdlo.agents.policies import load_policy
from torchdlo.agents.rl.hybrid_stages import Hybrid, plan_of, train_hybrid
from torchdlo.agents.rl.settings import training_preset
from torchdlo.cli import app
from torchdlo.errors import InputError

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")

PLAN = Hybrid(
    generations=2, population=4, starts=2, rounds=1, count=8, updates=20, final=1, validation=4, tune_episodes=16
)
COMPARED = 2 * 2 * 2
GENERATION, PLAYOFF = 5 * 2, 2 * 8


def trained(folder: Path, **choices):
    told = []
    given = {k: choices.pop(k) for k in ("resume",) if k in choices}
    settings = training_preset("lead", "hybrid", hidden=(8,), critic=(8,), count=8, **choices)

    def tell(stage: str, done: int, total: int, message: str) -> None:
        told.append(f"{stage} {done}/{total}: {message}")

    file = found(folder)
    _, notes = train_hybrid(Lead(), [file], settings, folder=folder / "run", plan=PLAN, callback=tell, **given)
    return notes, told


def test_minutes_that_are_over_leave_one_comparison_and_one_round(tmp_path: Path):
    notes, told = trained(tmp_path, minutes=1e-9)
    assert [notes[name].get("ended") for name in ("robust", "clone", "tune")] == ["minutes"] * 3
    assert [notes[name]["episodes"] for name in ("robust", "clone", "tune")] == [COMPARED, PLAN.count, 0]
    ends = [line for line in told if line.endswith("the budget of minutes ends it")]
    assert [line.split(":")[0] for line in ends] == ["robust 0/2", "clone 1/3", "tune 0/16"]
    assert load_policy(tmp_path / "run").spec.task == "lead"
    # What is done is done; a larger budget goes on with the last stage.
    notes, _ = trained(tmp_path, minutes=60.0, resume=True)
    assert notes["clone"]["ended"] == "minutes"
    assert "ended" not in notes["tune"] and notes["tune"]["episodes"] >= PLAN.validation


def test_episodes_are_not_exceeded(tmp_path: Path):
    budget = COMPARED + GENERATION + PLAYOFF + PLAN.count
    notes, _ = trained(tmp_path, episodes=budget + 1)
    assert [row["generation"] for row in notes["robust"]["log"] if "generation" in row] == [0]
    assert [row["playoff"] for row in notes["robust"]["log"] if "playoff" in row] == ["before", "after"]
    assert sum(notes[name]["episodes"] for name in ("robust", "clone", "tune")) == budget
    with pytest.raises(InputError, match="episodes is 15; expected at least 16: 8 to compare paths and 8"):
        trained(tmp_path, episodes=15)


def test_no_budget_of_its_own_cuts_a_plan():
    for name in envs.TASKS:
        plan, chosen = plan_of(name), training_preset(name, "hybrid")
        robust = plan.starts * (2 * 2 * 3 + plan.generations * (1 + plan.population) + 2 * 4)
        tuned = plan.tune_episodes + plan.validation * max(1, math.ceil(plan.tune_episodes / chosen.count))
        assert robust + plan.count * (1 + plan.rounds + plan.final) + tuned <= chosen.episodes, name
        assert chosen.minutes == (180 if name == "gathering" else 60)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--fidelity", "coarse"], "fidelity is 'coarse'; expected published, as stages of hybrid have their own"),
        (["--no-variation"], "variation is False; expected True, as stages of hybrid have their own"),
        (["--set", "ends=0.5"], "ends is 0.5; expected 1.0, as stages of hybrid have their own"),
        (["--execution", "eager"], "--execution: stages of hybrid choose it themselves; leave it out"),
    ],
)
def test_what_its_stages_do_not_heed_is_refused(
    words: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    with pytest.raises(SystemExit) as done:
        app.main(["train", "coiling", *words, "--out", str(tmp_path / "x")])
    assert done.value.code == 2
    assert said in " ".join(capsys.readouterr().err.split())
