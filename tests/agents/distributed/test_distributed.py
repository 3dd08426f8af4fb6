"""Work in processes: every item once, errors are raised, dead workers are replaced, nothing finished is lost."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import pytest

from torchdlo.agents.distributed import LocalProcesses, Serial, make_executor
from torchdlo.agents.distributed import sweep as sweeps
from torchdlo.agents.distributed.sweep import Job, Sweep, run_sweep
from torchdlo.cli import app
from torchdlo.errors import InputError


def square(x: int) -> int:
    """Fails for 13."""
    if x == 13:
        raise InputError("13 is not squared.")
    return x * x


def dies_once(path: str) -> str:
    """Kills its process the first time."""
    file = Path(path)
    if not file.exists():
        file.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return file.name


def test_every_item_is_done_once_here_and_in_processes() -> None:
    wanted = {k: k * k for k in range(7)}
    assert dict(Serial().map(square, range(7))) == wanted
    with LocalProcesses(2) as pool:
        assert dict(pool.map(square, range(7))) == wanted
        with pytest.raises(InputError, match="13 is not squared"):
            list(pool.map(square, [13]))


def test_items_of_a_worker_that_dies_are_done_again(tmp_path: Path) -> None:
    items = [str(tmp_path / name) for name in "abc"]
    with LocalProcesses(1) as pool:
        assert sorted(dict(pool.map(dies_once, items)).values()) == ["a", "b", "c"]


def test_workers_end_with_the_process_that_started_them(tmp_path: Path) -> None:
    program = textwrap.dedent(
        """
        import os, sys, time
        from pathlib import Path
        from torchdlo.agents.distributed import LocalProcesses

        def work(folder):
            Path(folder, f"pid-{os.getpid()}").touch()
            time.sleep(600)

        if __name__ == "__main__":
            with LocalProcesses(1) as pool:
                list(pool.map(work, [sys.argv[1]]))
        """
    )
    file = tmp_path / "program.py"
    file.write_text(program)
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[3])}
    process = subprocess.Popen([sys.executable, str(file), str(tmp_path)], env=environment)
    begun = time.monotonic()
    while not (found := list(tmp_path.glob("pid-*"))) and time.monotonic() < begun + 600:
        time.sleep(0.1)
    process.kill()
    process.wait()
    worker = int(found[0].name.partition("-")[2])
    while Path(f"/proc/{worker}").exists() and time.monotonic() < begun + 700:
        time.sleep(0.1)
    assert not Path(f"/proc/{worker}").exists()


def test_without_ray_an_address_is_refused_with_what_to_install() -> None:
    pytest.importorskip("torch")
    try:
        import ray  # noqa: F401
    except ImportError:
        with pytest.raises(InputError, match=r"--address needs ray; install it with pip install 'torchdlo\[ray\]'"):
            make_executor(address="auto")


def fake(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Jobs are small programs in the place of torchdlo; return the log of what they did."""
    log = tmp_path / "log"
    program = textwrap.dedent(
        f"""
        import sys
        from pathlib import Path
        words = sys.argv[1:]
        out = Path(words[words.index("--out") + 1])
        out.mkdir(parents=True, exist_ok=True)
        seed = words[words.index("--seed") + 1]
        with open({str(log)!r}, "a") as file:
            file.write(f"{{words[1]}}-{{seed}}{{' again' if '--resume' in words else ''}}\\n")
        bad = Path({str(tmp_path)!r}) / f"bad-{{words[1]}}-{{seed}}"
        if bad.exists():
            (out / "journal").mkdir(exist_ok=True)
            sys.exit("error: it did not work")
        (out / "result.json").write_text(seed)
        """
    )
    file = tmp_path / "program.py"
    file.write_text(program)

    def command(job: Job, folder: Path) -> list[str]:
        return [sys.executable, str(file), *real(job, folder)[3:]]

    real = sweeps._command
    monkeypatch.setattr(sweeps, "_command", command)
    return log


@pytest.mark.parametrize("away", [False, True])
def test_a_sweep_runs_all_jobs_and_goes_on_with_what_failed(monkeypatch, tmp_path: Path, away: bool) -> None:
    log, out = fake(monkeypatch, tmp_path), tmp_path / "out"
    (tmp_path / "bad-wrapping-1").touch()
    plan = Sweep("optimize", ("coiling", "wrapping"), (0, 1), ("--episodes", "5"))
    found = run_sweep(plan, out, Serial(), away=away)
    assert {name: row["done"] for name, row in found.items()} == {
        "coiling-0": True, "wrapping-0": True, "coiling-1": True, "wrapping-1": False,
    }  # fmt: skip
    assert found["wrapping-1"]["message"] == "error: it did not work"
    assert (out / "coiling-1/result.json").read_text() == "1"
    with pytest.raises(InputError, match="a sweep was begun there; --resume goes on with it"):
        run_sweep(plan, out, Serial())
    with pytest.raises(InputError, match="another sweep was begun there"):
        run_sweep(Sweep("optimize", ("coiling",), (0,)), out, Serial(), resume=True)
    (tmp_path / "bad-wrapping-1").unlink()
    found = run_sweep(plan, out, Serial(), away=away, resume=True)
    assert all(row["done"] for row in found.values()) and len(found) == 4
    # Only what had failed is run again, and from where it was if its folder is here.
    assert log.read_text().split("\n")[4:-1] == ["wrapping-1" if away else "wrapping-1 again"]


def test_a_sweep_that_was_stopped_loses_no_finished_job(monkeypatch, tmp_path: Path) -> None:
    log, out, plan = fake(monkeypatch, tmp_path), tmp_path / "out", Sweep("train", ("coiling",), (0, 1, 2))

    def stop(stage: str, done: int, total: int, message: str) -> None:
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_sweep(plan, out, Serial(), callback=stop)
    assert len(run_sweep(plan, out, Serial(), resume=True)) == 3
    assert log.read_text().split() == ["coiling-0", "coiling-1", "coiling-2"]


def test_wrong_sweeps_are_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cases = {
        ("fly", "coiling"): "expected one of optimize, train, diagnose, dataset, given 'fly'",
        ("optimize", "coiling", "--seeds", "a"): "expected numbers such as 0-4 or 0,3,7, given 'a'",
        ("optimize", "coiling", "--seeds", "1,1"): "each once",
        ("optimize", "coiling", "coiling"): "two of coiling, coiling have the same name",
        ("optimize", "coiling", "--", "--seed", "4"): "--seed belongs to the sweep",
    }
    for words, said in cases.items():
        front = [*words[:2], "--out", str(tmp_path / "out"), *words[2:]]
        with pytest.raises(SystemExit) as caught:
            app.main(["sweep", *front])
        error = capsys.readouterr().err
        assert caught.value.code == 2 and said in error and len(error.splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_jobs_are_commands_with_their_seeds() -> None:
    first, second = Sweep("dataset", ("coiling",), (0, 4), ("--size", "96")).jobs
    assert first.name == "coiling-0" and second.command[:4] == ("dataset", "make", "coiling", "--seed")
    assert second.command[4:] == ("4", "--workers", "1", "--size", "96")
    assert json.dumps(second.command)
