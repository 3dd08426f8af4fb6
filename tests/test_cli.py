"""The command line: what it writes, what it refuses, and how it can be stopped."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import types
from pathlib import Path

import numpy as np
import pytest

from tests.fake_calibration import FakeFit
from torchdlo.cli import app, identification
from torchdlo.cli.progress import deferred_interrupt
from torchdlo.files import replace_atomically

WRITTEN = ["calibration.json", "model.json", "report.html", "report.png"]


@pytest.fixture
def fit(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> FakeFit:
    """Replace the fit, and work in an empty folder."""
    fake = FakeFit()
    module = types.ModuleType("torchdlo.sysid.calibration.calibrate")
    module.calibrate = fake  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "torchdlo.sysid.calibration.calibrate", module)
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    return fake


def run(*arguments: object) -> int:
    """Exit code of a command line."""
    with pytest.raises(SystemExit) as caught:
        app.main([str(a) for a in arguments])
    return int(caught.value.code or 0)


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys\n"
        "from torchdlo import cli\n"
        "try:\n    cli.main(['calibrate', '--help'])\nexcept SystemExit:\n    pass\n"
        "heavy = {'torch', 'numpy', 'scipy', 'matplotlib', 'torchrl'} & set(sys.modules)\n"
        "sys.exit(f'imported {heavy}' if heavy else 0)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    assert "--starts" in done.stdout and "jq .test_mae_mm" in done.stdout


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("--version") == 0
    assert capsys.readouterr().out.startswith("torchdlo 0.")


def test_the_package_runs_as_a_module() -> None:
    done = subprocess.run([sys.executable, "-m", "torchdlo", "--version"], capture_output=True, text=True, timeout=600)
    assert done.returncode == 0 and done.stdout.startswith("torchdlo 0."), done.stderr


def test_check_describes_the_recording(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("check", folder) == 0
    said = capsys.readouterr().out
    assert f"{folder}: length 1 m, mass 50 g, radius 4 mm, rest shape given, table none" in said
    rows = {line[:22].strip(): line[22:].split() for line in said.splitlines()[1:]}
    assert rows["trials"] == ["2", "2"]
    assert rows["rate"] == ["100", "Hz", "100", "Hz"]
    assert rows["markers not seen"] == ["1.1%", "1.1%"]
    assert rows["suspect frames"] == ["5.0%", "5.0%"]


def test_calibrate_writes_model_and_report(folder: Path, fit: FakeFit, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("calibrate", folder) == 0
    out = Path("runs/calibrate/rope")
    assert sorted(p.name for p in out.iterdir()) == WRITTEN
    said = capsys.readouterr().out
    assert said.startswith("Calibrated on 2 trials; error on unseen trials ")
    assert "runs/calibrate/rope/report.html" in said
    assert json.loads((out / "model.json").read_text())["vertices"] == 31
    asked = {"seed": 0, "rest": "auto", "checkpoint": out / "checkpoint.json", "resume": False, "workers": None}
    assert fit.options == asked | {"method": "auto"}


def test_calibrate_prints_json_and_nothing_else(folder: Path, fit: FakeFit, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("calibrate", folder, "--json", "--seed", 7, "--out", "a/rope.json") == 0
    said = capsys.readouterr()
    result = json.loads(said.out)
    for key in ("test_mae_mm", "train_mae_mm", "before", "baselines", "parameters", "seconds"):
        assert key in result
    assert result["recording"] == str(folder) and result["seed"] == 7
    assert result["test_mae_mm"] < result["before"]["test_mae_mm"]
    assert set(result["baselines"]) == {"frozen_shape", "catenary"}
    # Infinity does not exist in JSON.
    stiffness = {"value": 5e-4, "low": 4e-4, "high": None, "unit": "N m^2"}
    assert result["parameters"] == {"bending_stiffness": stiffness}
    assert result == json.loads(Path("a/calibration.json").read_text())
    assert Path("a/rope.json").is_file()


def test_options_reach_the_fit(folder: Path, fit: FakeFit) -> None:
    run("calibrate", folder, "--starts", 5, "--iterations", 4, "--vertices", 21)
    assert {k: fit.options[k] for k in ("starts", "iterations", "vertices")} == {
        "starts": 5,
        "iterations": 4,
        "vertices": 21,
    }
    run("calibrate", folder, "--quick", "--starts", 3)
    assert fit.options["starts"] == 3
    assert fit.options["iterations"] == identification._QUICK["iterations"]


def test_out_may_be_a_folder(folder: Path, fit: FakeFit) -> None:
    Path("a").mkdir()
    assert run("calibrate", folder, "--out", "a") == 0
    assert run("calibrate", folder, "--out", "b/c") == 0
    assert sorted(os.listdir("a")) == sorted(os.listdir("b/c")) == WRITTEN


def test_own_files_are_overwritten(folder: Path, fit: FakeFit) -> None:
    assert run("calibrate", folder, "--out", "a") == 0
    assert run("calibrate", folder, "--out", "a", "--seed", 3) == 0
    assert json.loads(Path("a/calibration.json").read_text())["seed"] == 3
    assert sorted(os.listdir("a")) == WRITTEN


@pytest.mark.parametrize("name", WRITTEN)
def test_files_of_others_are_not_overwritten(
    name: str, folder: Path, fit: FakeFit, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("a").mkdir()
    Path("a", name).write_text('{"mine": true}')
    assert run("calibrate", folder, "--out", "a/model.json") == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert os.listdir("a") == [name] and Path("a", name).read_text() == '{"mine": true}'
    assert not fit.options


def test_unusable_out_is_refused_before_the_work(
    folder: Path, fit: FakeFit, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("file").touch()
    assert run("calibrate", folder, "--out", "file/model.json") == 2
    assert "is a file" in capsys.readouterr().err
    Path("a/report.html").mkdir(parents=True)
    assert run("calibrate", folder, "--out", "a/model.json") == 2
    assert "found a folder" in capsys.readouterr().err
    assert not fit.options


def test_resume_needs_a_checkpoint(folder: Path, fit: FakeFit, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("calibrate", folder, "--out", "a", "--resume") == 2
    assert "checkpoint.json" in capsys.readouterr().err and not Path("a").exists()
    Path("a").mkdir()
    Path("a/checkpoint.json").touch()
    assert run("calibrate", folder, "--out", "a", "--resume") == 0
    assert fit.options["resume"] and fit.options["checkpoint"] == Path("a/checkpoint.json")


def test_control_c_keeps_the_best(folder: Path, fit: FakeFit, capsys: pytest.CaptureFixture[str]) -> None:
    finished = []

    def interrupt(iteration: int) -> None:
        if iteration == 1:
            os.kill(os.getpid(), signal.SIGINT)
            finished.append(iteration)  # the running iteration is not torn apart

    fit.during = interrupt
    before = signal.getsignal(signal.SIGINT)
    assert run("calibrate", folder, "--out", "a", "--json") == 130
    said = capsys.readouterr()
    assert finished == [1]
    assert json.loads(said.out)["interrupted"] is True
    assert "stopping after this iteration" in said.err and "interrupted" in said.err
    assert sorted(os.listdir("a")) == WRITTEN
    assert signal.getsignal(signal.SIGINT) is before


def test_control_c_before_a_result_writes_nothing(
    folder: Path, fit: FakeFit, capsys: pytest.CaptureFixture[str]
) -> None:
    fit.keep_best = False
    fit.during = lambda iteration: os.kill(os.getpid(), signal.SIGINT)
    assert run("calibrate", folder, "--out", "a") == 130
    assert "nothing was written" in capsys.readouterr().err
    assert not Path("a").exists()


def test_second_control_c_stops_at_once(folder: Path, fit: FakeFit) -> None:
    after = []

    def interrupt(iteration: int) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGINT)
        after.append(iteration)

    fit.during, fit.keep_best = interrupt, False
    assert run("calibrate", folder, "--out", "a") == 130
    assert not after


def test_a_failed_fit_writes_nothing(folder: Path, fit: FakeFit) -> None:
    def fail(iteration: int) -> None:
        raise RuntimeError("broken")

    fit.during = fail
    with pytest.raises(RuntimeError, match="broken"):
        app.main(["calibrate", str(folder), "--out", "a"])
    assert not Path("a").exists()


def test_the_recording_is_not_touched(folder: Path, fit: FakeFit) -> None:
    before = {p: (p.stat().st_mtime_ns, p.read_bytes()) for p in folder.iterdir()}
    assert run("calibrate", folder, "--out", "a") == 0
    assert {p: (p.stat().st_mtime_ns, p.read_bytes()) for p in folder.iterdir()} == before


def test_a_blown_up_model_is_reported_as_such(folder: Path, fit: FakeFit, capsys: pytest.CaptureFixture[str]) -> None:
    broken = {name: np.full((40, 9, 3), np.nan) for name in ("train_0", "train_1", "test_0", "test_1")}
    fit.fields = {"test_mae_mm": float("nan"), "predictions": broken}
    assert run("calibrate", folder, "--out", "a") == 0
    said = capsys.readouterr().out
    assert "→ not finite" in said and "do not use this" in said
    assert json.loads(Path("a/calibration.json").read_text())["test_mae_mm"] is None


def test_one_interrupt_stops_a_search_once_and_lets_the_rest_report() -> None:
    told = []
    with deferred_interrupt(lambda *step: told.append(step)) as callback:
        signal.raise_signal(signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            callback("fitting", 1, 5, "")
        callback("judging", 1, 1, "")
    assert [stage for stage, *_ in told] == ["fitting", "judging"]


def test_a_full_disk_is_named_by_what_did_not_fit(tmp_path: Path) -> None:
    with (
        pytest.raises(OSError, match=r"No space left on device.*model\.json"),
        replace_atomically(tmp_path / "model.json"),
    ):
        raise OSError(28, "No space left on device")
    assert not list(tmp_path.iterdir())
