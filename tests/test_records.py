"""What long commands write down is whole or not there, belongs to one process at a time, and outlives its end."""

from __future__ import annotations

import errno
import json
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from torchdlo.agents.torch_records import load_checkpoint, packed, save_checkpoint, unpacked
from torchdlo.cli import ending
from torchdlo.errors import InputError
from torchdlo.journal import MARK, Journal, at_work, locked, pack, read_json, read_record, sweep, unpack, write_json

MARKED = {"generator": "torchdlo test", "options": {"seed": 0}, "program": "abc"}


def journal(path: Path, *, resume: bool = False, mark: dict[str, Any] = MARKED) -> Journal:
    def other(found: dict[str, Any]) -> str:
        return "" if found.get("options") == mark["options"] else "it is another one; leave out --resume."

    return Journal(path, mark, suffix=".rec", other=other, resume=resume, old=(b"PK",))


def flips(content: bytes) -> list[bytes]:
    """The content with one bit of each byte flipped, and cut at some places."""
    bits = np.random.default_rng(0).integers(0, 8, len(content))
    found = [content[:k] + bytes([content[k] ^ (1 << int(bits[k]))]) + content[k + 1 :] for k in range(len(content))]
    return [*found, *(content[:k] for k in range(0, len(content), 7)), content + b"x", bytes(len(content)), b""]


def test_records_are_whole_or_not_there() -> None:
    content = os.urandom(200)
    record = pack(content, "key")
    assert unpack(record, "key") == content and unpack(record, "other") is None and unpack(record) is None
    for spoilt in flips(record):
        assert unpack(spoilt, "key", old=(b"PK",)) is None
    assert unpack(b"PK old", "key", old=(b"PK",)) == b"PK old" and unpack(b"PK old", "key") is None


def test_plain_data_are_whole_or_not_there(tmp_path: Path) -> None:
    content = {"a": [1.5, float("inf"), 1e-300], "b": {"c": "text", "d": None}, "generator": "torchdlo"}
    file = tmp_path / "a.json"
    write_json(file, content)
    assert read_json(file) == content
    for spoilt in flips(file.read_bytes()):
        file.write_bytes(spoilt)
        found = read_json(file)
        # What is flipped in the name of the hash alone leaves the content as it was.
        assert found is None or {k: v for k, v in found.items() if k in content} == content, spoilt
    file.write_text(json.dumps(content))
    assert read_json(file) == content, "earlier versions wrote no hash"
    for other in ("[1]", "null", "[" * 100_000, '{"a": 1' + "0" * 5000 + "}"):
        file.write_text(other)
        assert read_json(file) is None
    os.mkfifo(tmp_path / "pipe")
    assert read_json(tmp_path / "pipe") is None and read_record(tmp_path) is None


def test_checkpoints_are_whole_or_not_there(tmp_path: Path) -> None:
    content = {"points": torch.arange(3.0), "log": [{"a": 1}]}
    save_checkpoint(tmp_path / "a.pt", content)
    found = load_checkpoint(tmp_path / "a.pt")
    assert found is not None and torch.equal(found["points"], content["points"]) and found["log"] == content["log"]
    record = (tmp_path / "a.pt").read_bytes()
    for spoilt in flips(record)[:: max(1, len(record) // 300)]:
        (tmp_path / "b.pt").write_bytes(spoilt)
        assert load_checkpoint(tmp_path / "b.pt") is None
    # Without a hash it is the archive that knows what is whole, as far as it does.
    plain = packed(content)
    (tmp_path / "old.pt").write_bytes(plain)
    assert load_checkpoint(tmp_path / "old.pt") is not None
    for spoilt in flips(plain)[:: max(1, len(plain) // 300)]:
        found = unpacked(spoilt)
        assert found is None or isinstance(found, dict)


def test_a_journal_goes_on_with_any_byte_of_its_mark_spoilt(tmp_path: Path) -> None:
    path = tmp_path / "j"
    first = journal(path)
    first.write("000", b"content")
    first.close()
    whole = (path / MARK).read_bytes()
    for spoilt in flips(whole):
        (path / MARK).write_bytes(spoilt)
        again = journal(path, resume=True)
        assert again.read("000") == b"content", spoilt
        again.close()
        mark = read_json(path / MARK)
        assert mark is not None and mark.items() >= MARKED.items()
    # Of another search nothing is taken.
    (path / MARK).write_bytes(whole[:9])
    with pytest.raises(InputError, match="damaged, or belongs to other work"):
        journal(path, resume=True, mark=MARKED | {"options": {"seed": 1}})
    journal(path, mark=MARKED | {"options": {"seed": 1}}).close()
    assert not list(path.glob("*.rec"))


def test_a_journal_that_was_killed_at_its_beginning_can_be_used(tmp_path: Path) -> None:
    for names in ((".0123abcd-journal.json",), (".torchdlo.lock",), (".0123abcd-000.rec", ".torchdlo.lock", MARK)):
        path = tmp_path / str(len(names) + len(names[0]))
        path.mkdir()
        for name in names:
            (path / name).write_bytes(b"")
        with pytest.raises(InputError, match="leave out --resume"):
            journal(path, resume=True, mark=MARKED | {"generator": "torchdlo other"} if MARK not in names else MARKED)
            raise InputError("an empty mark is replaced; leave out --resume")
        journal(path).close()
        assert sorted(p.name for p in path.iterdir()) == [MARK]


def test_folders_of_others_are_left_alone(tmp_path: Path) -> None:
    for name, content in (("thesis.txt", b"years"), ("a.rec", b"mine"), (MARK, b'{"mine": 1}'), (MARK, b"mine")):
        path = tmp_path / f"{len(content)}-{name}"
        path.mkdir()
        (path / name).write_bytes(content)
        for resume in (True, False):
            with pytest.raises(InputError, match="found something else; choose another --out"):
                journal(path, resume=resume)
        assert [(p.name, p.read_bytes()) for p in path.iterdir()] == [(name, content)]


HOLDER = """
import sys, time
from pathlib import Path
from torchdlo.journal import locked
with locked(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(600)
"""


def test_a_folder_has_one_process_which_is_named_and_a_killed_one_has_it_no_more(tmp_path: Path) -> None:
    folder = tmp_path / "new" / "out"
    env = os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])}
    holder = subprocess.Popen([sys.executable, "-c", HOLDER, str(folder)], stdout=subprocess.PIPE, env=env)
    try:
        assert holder.stdout is not None and holder.stdout.readline() == b"held\n"
        with pytest.raises(InputError, match=rf"out: process {holder.pid} \(.*\) is at work here; wait for it"):
            locked(folder).__enter__()
    finally:
        holder.send_signal(signal.SIGKILL)
        holder.wait()
    with locked(folder):
        assert (folder / ".torchdlo.lock").exists()
    assert not any(folder.iterdir())
    with locked(tmp_path / "a" / "b"):
        pass
    assert not (tmp_path / "a").exists(), "a folder that was made for nothing goes again"


def test_strays_are_swept_and_nothing_else(tmp_path: Path) -> None:
    names = [".0123abcd-model.json", ".0123abcd-other.json", ".hidden", "model.json", ".0123abcx-model.json"]
    for name in names:
        (tmp_path / name).write_text("x")
    with at_work(tmp_path, "model.json"):
        pass
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(names[1:])
    sweep(tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(names[2:])


# How commands end

STOPPED = """
import os, signal, sys
from torchdlo.cli import app, ending, scenes
from torchdlo.cli.progress import deferred_interrupt

def work(*_, **__):
    how, signum = sys.argv[2], getattr(signal, sys.argv[1])
    if how == "nobody looks":
        os.kill(os.getpid(), signum)
    with deferred_interrupt(lambda *_: None) as callback:
        os.kill(os.getpid(), signum)
        try:
            callback("a", 1, 2, "")
        except KeyboardInterrupt:
            raise ending.stopped("the best so far is kept", resume=True) from None

app.app.registered_commands.clear()
app.app.command("optimize")(lambda: work())
app.app.command("other")(lambda: None)
app.main(["optimize"])
"""


@pytest.mark.parametrize(("name", "code", "word"), [("SIGINT", 130, "interrupted"), ("SIGTERM", 143, "terminated")])
@pytest.mark.parametrize("how", ["nobody looks", "in time"])
def test_commands_that_are_stopped_say_so_once(name: str, code: int, word: str, how: str) -> None:
    env = os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])}
    done = subprocess.run([sys.executable, "-c", STOPPED, name, how], capture_output=True, text=True, env=env)
    assert done.returncode == code, done.stderr
    last = done.stderr.splitlines()[-1]
    kept = "nothing more was written" if how == "nobody looks" else "the best so far is kept"
    assert last.startswith(f"{word}; {kept}") and "Traceback" not in done.stderr
    assert how == "nobody looks" or last.endswith("go on with: torchdlo optimize --resume")


def test_what_to_type_to_go_on(capsys: pytest.CaptureFixture[str]) -> None:
    def said(*words: str) -> str:
        with pytest.raises(SystemExit) as end, ending.caught(list(words)):
            raise ending.stopped("kept", resume=True)
        assert end.value.code == 130
        return capsys.readouterr().err.strip()

    assert said("train", "a b").endswith("go on with: torchdlo train 'a b' --resume")
    assert said("train", "a", "--resume").endswith("go on with: torchdlo train a --resume")
    assert said("sweep", "train", "a", "--", "--x").endswith("go on with: torchdlo sweep train a --resume -- --x")
    assert "\x1b" not in said("train", "\x1b[31m")


def test_a_full_disk_says_how_to_go_on() -> None:
    with ending.caught(["diagnose", "rope"]):
        said = ending.failed(OSError(errno.ENOSPC, "No space left on device", "a/b"))
    assert said.startswith("a/b: No space left on device; what was written before is kept, make room")
    assert said.endswith("go on with: torchdlo diagnose rope --resume")


@pytest.mark.parametrize("full", [True, False])
def test_a_writer_in_the_background_is_quiet_about_a_full_disk(full: bool, capsys: pytest.CaptureFixture[str]) -> None:
    def write() -> None:
        raise OSError(errno.ENOSPC if full else errno.EPERM, "no")

    with ending.caught(["train", "separation"]):
        thread = threading.Thread(target=write)
        thread.start()
        thread.join()
    assert ("Traceback" in capsys.readouterr().err) is not full
