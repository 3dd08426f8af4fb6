"""A search that was stopped or killed ends as if it had never stopped, and only the same search goes on."""

from __future__ import annotations

import io
import json
import os
import resource
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from tests.agents.problems import Push, signature
from torchdlo.agents.trajopt.problem import Evaluation
from torchdlo.agents.trajopt.search import METHODS, Robust, SearchResult, SearchSettings, optimize
from torchdlo.agents.trajopt.search_journal import _code, program_hash, remove_journal
from torchdlo.agents.trajopt.search_result import result_json, trajectory_json
from torchdlo.errors import InputError

SETTINGS = SearchSettings(episodes=96, population=8, hold=5, chunk=5)
REPOSITORY = Path(__file__).resolve().parents[2]


def files(found: SearchResult, settings: SearchSettings) -> tuple[str, dict]:
    """What is written about a search, without the time it took."""
    result = json.loads(result_json(found, Push(), settings))
    del result["seconds"]
    return trajectory_json(found, Push()), result


class Stopping(Push):
    """A problem that breaks after a number of batches, as a process that is killed."""

    def __init__(self, after: int) -> None:
        super().__init__()
        object.__setattr__(self, "left", [after])

    def evaluate(self, actions: Tensor) -> Evaluation:
        self.left[0] -= 1
        if self.left[0] < 0:
            raise MemoryError
        return super().evaluate(actions)


@pytest.mark.parametrize("method", METHODS)
def test_a_killed_search_ends_as_one_that_was_not(method: str, tmp_path: Path) -> None:
    settings = replace(SETTINGS, method=method)
    whole = optimize(Push(), settings)
    for after in (3, 4, 9):
        with pytest.raises(MemoryError):
            optimize(Stopping(after), settings, journal=tmp_path / "j", resume=after > 3)
    found = optimize(Push(), settings, journal=tmp_path / "j", resume=True)
    assert files(found, settings) == files(whole, settings)
    remove_journal(tmp_path / "j")
    assert not (tmp_path / "j").exists()


def test_what_is_written_is_not_played_again(tmp_path: Path) -> None:
    played = []

    class Counting(Push):
        def evaluate(self, actions: Tensor) -> Evaluation:
            played.append(len(actions))
            return super().evaluate(actions)

    with pytest.raises(MemoryError):
        optimize(Stopping(7), SETTINGS, journal=tmp_path / "j")
    optimize(Counting(), SETTINGS, journal=tmp_path / "j", resume=True)
    # 12 iterations of 5 and 3 trajectories, less seven batches; then the best alone.
    assert played == [3, *[5, 3] * 8, 1]


def test_ctrl_c_keeps_the_best_and_resume_goes_on(tmp_path: Path) -> None:
    whole = optimize(Push(), SETTINGS)

    def stop(stage: str, done: int, total: int, message: str) -> None:
        assert stage == "optimize" and total == 96 and message.startswith("best ")
        if done >= 37:
            raise KeyboardInterrupt

    found = optimize(Push(), SETTINGS, journal=tmp_path / "j", callback=stop)
    assert found.interrupted and found.search_return == whole.curve[3]["best"]
    assert found.curve == whole.curve[:4]
    assert files(optimize(Push(), SETTINGS, journal=tmp_path / "j", resume=True), SETTINGS) == files(whole, SETTINGS)


def test_ctrl_c_before_the_first_iteration_is_passed_on(tmp_path: Path) -> None:
    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        optimize(Push(), SETTINGS, journal=tmp_path / "j", callback=stop)
    assert (tmp_path / "j" / "000000.pt").is_file(), "the batch that was played is kept"


def test_a_robust_search_goes_on_as_well(tmp_path: Path) -> None:
    settings = replace(SETTINGS, method="hybrid", robust=Robust(copies=2, finalists=2, trials=4))
    whole = optimize(Push(), settings)

    def stop(stage: str, done: int, total: int, message: str) -> None:
        if done > 50:
            raise KeyboardInterrupt

    optimize(Push(), settings, journal=tmp_path / "j", callback=stop)
    found = optimize(Push(), settings, journal=tmp_path / "j", resume=True)
    assert files(found, settings) == files(whole, settings)


PROGRAM = """
import sys, time
from pathlib import Path
from tests.agents.problems import Push
from tests.agents.test_resume import SETTINGS
from torchdlo.agents.trajopt.search import optimize

class Slow(Push):
    def evaluate(self, actions):
        time.sleep(0.05)
        return super().evaluate(actions)

optimize(Slow(), SETTINGS, journal=Path(sys.argv[1]))
"""


def test_a_process_that_is_killed_leaves_what_can_be_resumed(tmp_path: Path) -> None:
    journal = tmp_path / "j"
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY), "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen([sys.executable, "-c", PROGRAM, str(journal)], env=environment)
    until = time.monotonic() + 600
    while not (journal / "000004.pt").exists():
        assert process.poll() is None and time.monotonic() < until
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    found = optimize(Push(), SETTINGS, journal=journal, resume=True)
    assert signature(found.actions) == signature(optimize(Push(), SETTINGS).actions)


def stopped(journal: Path) -> None:
    with pytest.raises(MemoryError):
        optimize(Stopping(3), SETTINGS, journal=journal)


def refused(journal: Path, settings: SearchSettings = SETTINGS) -> str:
    with pytest.raises(InputError) as error:
        optimize(Push(), settings, journal=journal, resume=True)
    return str(error.value)


def test_only_the_same_search_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    journal = tmp_path / "j"
    assert "found none; leave out --resume" in refused(journal)
    stopped(journal)
    assert "a search with seed 0 (now 1)" in refused(journal, replace(SETTINGS, seed=1))
    assert "method cmaes (now gd), population 8 (now 4)" in refused(
        journal, replace(SETTINGS, method="gd", population=4)
    )
    with monkeypatch.context() as patch:
        patch.setattr("torchdlo.agents.trajopt.search_journal.program_hash", lambda _: "another")
        assert "another version of torchdlo" in refused(journal)


def test_results_depend_on_the_code_of_their_own_task_only() -> None:
    assert len({program_hash("coiling"), program_hash("wrapping"), program_hash("push")}) == 3 and program_hash(
        "push"
    ) == program_hash("reach")


def test_results_depend_on_what_runs_not_on_comments(tmp_path: Path) -> None:
    texts = ["x = 1\n", '"""Why."""\nx = 1  # one\n"""What."""\n', "x = 2\n", "x = '1'\n"]
    files = [tmp_path / f"{k}.py" for k in range(4)]
    for file, text in zip(files, texts, strict=True):
        file.write_text(text)
    first, commented, *others = map(_code, files)
    assert first == commented and len({first, *others}) == 3


def test_results_of_another_search_are_noticed(tmp_path: Path) -> None:
    journal = tmp_path / "j"
    stopped(journal)
    (journal / "000001.pt").write_bytes((journal / "000000.pt").read_bytes())
    assert "expected the results of batch 1 of this search" in refused(journal)


@pytest.mark.parametrize("damage", ["empty", "half", "zeros in it", "zeros at its beginning"])
def test_what_is_damaged_is_played_again(damage: str, tmp_path: Path) -> None:
    whole, journal = optimize(Push(), SETTINGS), tmp_path / "j"
    stopped(journal)
    file = journal / "000001.pt"
    written = file.read_bytes()
    record = torch.load(io.BytesIO(written[written.index(b"PK") :]))
    at = written.index(record["returns"].numpy().tobytes())
    spoilt = {
        "empty": b"",
        "half": written[: len(written) // 2],
        "zeros in it": written[:at] + bytes(8) + written[at + 8 :],
        "zeros at its beginning": bytes(64) + written[64:],
    }
    file.write_bytes(spoilt[damage])
    found = optimize(Push(), SETTINGS, journal=journal, resume=True)
    assert files(found, SETTINGS) == files(whole, SETTINGS)


def test_a_full_disk_is_named_and_what_was_written_is_kept(tmp_path: Path) -> None:
    whole, journal = optimize(Push(), SETTINGS), tmp_path / "j"
    stopped(journal)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
    try:
        with pytest.raises(OSError, match=r"000003\.pt"):
            optimize(Push(), SETTINGS, journal=journal, resume=True)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert files(optimize(Push(), SETTINGS, journal=journal, resume=True), SETTINGS) == files(whole, SETTINGS)


def test_two_searches_do_not_write_into_one_journal(tmp_path: Path) -> None:
    said = []

    def second(*_: object) -> None:
        if not said:
            with pytest.raises(InputError) as refusal:
                optimize(Push(), replace(SETTINGS, seed=1), journal=tmp_path / "j")
            said.append(str(refusal.value))

    whole = optimize(Push(), SETTINGS)
    found = optimize(Push(), SETTINGS, journal=tmp_path / "j", callback=second)
    (text,) = said
    assert text.startswith(f"{tmp_path / 'j'}: process {os.getpid()} (") and text.endswith("choose another --out.")
    assert files(found, SETTINGS) == files(whole, SETTINGS)


def test_folders_of_others_are_left_alone(tmp_path: Path) -> None:
    (tmp_path / "j").mkdir()
    (tmp_path / "j" / "thesis.txt").write_text("years of work")
    for resume in (True, False):
        with pytest.raises(InputError, match="choose another --out"):
            optimize(Push(), SETTINGS, journal=tmp_path / "j", resume=resume)
    assert (tmp_path / "j" / "thesis.txt").read_text() == "years of work"


def test_a_new_search_empties_the_journal_of_an_old_one(tmp_path: Path) -> None:
    stopped(tmp_path / "j")
    other = replace(SETTINGS, seed=5)
    found = optimize(Push(), other, journal=tmp_path / "j")
    assert signature(found.actions) == signature(optimize(Push(), other).actions)
