"""The commands that search: what they refuse before the work begins, and what they keep when they are stopped."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.report.fake_diagnosis import fake_diagnosis
from tests.sysid.swaying import recording as swaying
from tests.test_cli import run
from torchdlo.sysid.diagnosis import effect_search
from torchdlo.sysid.model.rope_model import RopeModel
from torchdlo.sysid.recordings.data_quality import DataIssue
from torchdlo.sysid.recordings.recording import save_recording


@pytest.fixture
def work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder to work in, with a recording."""
    save_recording(swaying(Path("rope"), frames=60), tmp_path / "rope")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_diagnose_writes_findings_model_and_page(
    work: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: dict[str, object] = {}

    def fake(recording: object, **options: object) -> effect_search.Diagnosis:
        asked.update(options)
        options["journal"].mkdir(parents=True)
        model = RopeModel(recording, vertices=21, effects=("air_drag",))
        return fake_diagnosis(
            recording, model=model, data_issues=[DataIssue("train_1", "swap", "markers 3 and 4 are swapped")]
        )

    monkeypatch.setattr(effect_search, "diagnose", fake)
    assert run("diagnose", "rope", "--seed", 3) == 0
    out = work / "runs" / "diagnose" / "rope"
    assert sorted(p.name for p in out.iterdir()) == ["findings.json", "model.json", "report.html"]
    said = capsys.readouterr().out
    assert said.startswith("Missing: air drag") and "data: train_1: markers 3 and 4 are swapped" in said
    assert asked["seed"] == 3 and asked["resume"] is False and asked["journal"] == Path("runs/diagnose/rope/journal")
    # The model starts the next search.
    assert run("diagnose", "rope", "--model", out / "model.json", "--out", "next", "--json") == 0
    assert asked["given"].effects == ("air_drag",)
    assert json.loads(capsys.readouterr().out)["verdict"] == "effects"


def test_a_stopped_search_says_how_to_go_on(
    work: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stopped(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(effect_search, "diagnose", stopped)
    assert run("diagnose", "rope", "--out", "a") == 130
    assert "interrupted; there was no verdict yet, and nothing was written" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--resume",), "runs/diagnose/rope/journal: expected the journal of a search to resume, found none"),
        (("--model", "none.json"), "none.json: expected a model file, found none"),
        (("--model", "rope/rope.json"), "rope/rope.json: expected a model file"),
        (("--budget", "huge"), "budget is 'huge'; expected one of fast, full"),
    ],
)
def test_diagnose_refuses_before_it_begins(
    work: Path, capsys: pytest.CaptureFixture[str], options: tuple[str, ...], said: str
) -> None:
    assert run("diagnose", "rope", *options) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and said in error and error.count("\n") == 1


def test_calibrate_takes_a_model_file(work: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (work / "model.json").write_text('{"format": "torchdlo-model", "version": 99}')
    assert run("calibrate", "rope", "--model", "model.json") == 2
    assert "model.json: version: expected 3, found 99" in capsys.readouterr().err
