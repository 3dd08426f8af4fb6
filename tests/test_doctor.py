"""What `torchdlo doctor` says of machines that have this and lack that, and the recording to try things with."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest

from torchdlo import cache
from torchdlo.cli import app, doctor
from torchdlo.physics.kernels import native
from torchdlo.sysid.recordings.recording import load_recording

pytestmark = pytest.mark.quick

ROOT = Path(__file__).parents[1]


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Kernels and pictures are looked at in one test only."""
    monkeypatch.setattr(native, "KERNELS", {"one": lambda: native.compiler()})
    monkeypatch.setattr(doctor, "_PICTURE", "")


@pytest.fixture
def lacking(monkeypatch: pytest.MonkeyPatch):
    """Return a function that takes packages away, or gives them another version."""
    requires = ["torch>=2.13,<2.14", "rich", 'kornia>=0.9,<0.10; extra == "video"', 'torchdlo[video]; extra == "all"']
    requires += ['av>=18; extra == "video"', 'pytest; extra == "dev"']

    def lack(**versions: str | None) -> None:
        known = {"torch": "2.13.0+cpu", "rich": "14", "kornia": "0.9.1", "av": "18.1", "pyvista": "1"} | versions

        def version(name: str) -> str:
            if known[name] is None:
                raise metadata.PackageNotFoundError(name)
            return known[name]

        monkeypatch.setattr(metadata, "version", version)
        monkeypatch.setattr(metadata, "requires", lambda name: requires)

    return lack


def found() -> dict[str, doctor.Check]:
    return {check.name: check for check in doctor.examine()}


def run(capsys, *words: str) -> tuple[int, str]:
    with pytest.raises(SystemExit) as ended:
        app.main(["doctor", *words])
    return int(ended.value.code or 0), capsys.readouterr().out


def test_all_is_well_where_all_is_there(lacking, capsys):
    lacking()
    code, told = run(capsys, "--json")
    content = json.loads(told)
    names = [check["name"] for check in content["checks"]]
    assert code == 0 and content["ok"] and len(set(names)) == len(names)
    assert {"python", "torch", "kernels", "gpu", "rendering", "video", "extra video"} <= set(names)
    assert not {"extra all", "extra dev"} & set(names)
    for check in content["checks"]:
        assert (check["status"] == "ok") == (not check["mend"])


def test_what_an_extra_lacks_is_named_with_what_installs_it(lacking):
    lacking(kornia=None)
    check = found()["extra video"]
    assert check.status == "missing" and "no kornia" in check.found and "av 18.1" in check.found
    assert check.mend == "pip install 'torchdlo[video]'" and not check.needed


def test_without_what_all_needs_it_fails_before_it_looks_further(lacking, capsys):
    lacking(rich=None)
    code, told = run(capsys)
    assert code == 1 and "missing rich" in " ".join(told.split()) and "pip install 'rich'" in told
    assert "kernels" not in told


def test_versions_that_were_not_tested_are_named_but_not_refused(lacking, capsys):
    lacking(torch="2.99.0")
    code, told = run(capsys)
    assert code == 0 and "torch 2.99.0 (tested: <2.14,>=2.13)" in told


def test_a_machine_without_compiler_is_well_but_slower(lacking, monkeypatch):
    lacking()
    monkeypatch.setattr(native, "compiler", lambda: None)
    checks = found()
    for name in ("compiler", "kernels", "compiled steps"):
        assert checks[name].status == "missing" and "compiler" in checks[name].mend and not checks[name].needed


def test_kernels_that_cannot_be_built_are_named(lacking, monkeypatch):
    lacking()
    monkeypatch.setattr(native, "KERNELS", {"one": lambda: None, "two": lambda: object()})
    monkeypatch.setattr(native, "compiler", lambda: native.Compiler(("g++",), ""))
    assert found()["kernels"].found == "not built or loaded: one"


def test_a_cache_that_is_not_private_is_named(lacking, monkeypatch, tmp_path):
    lacking()
    (tmp_path / "cache").mkdir()
    (tmp_path / "cache").chmod(0o777)
    monkeypatch.setenv("TORCHDLO_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(cache.tempfile, "gettempdir", lambda: str(tmp_path))
    check = found()["cache"]
    assert check.status == "broken" and "other users can write there" in check.mend


def test_pictures_that_crash_do_not_end_the_doctor(lacking, monkeypatch):
    lacking()
    monkeypatch.setattr(doctor, "_PICTURE", "import os, signal; os.kill(os.getpid(), signal.SIGSEGV)")
    check = found()["rendering"]
    assert check.status == "broken" and "apt install" in check.mend


@pytest.mark.slow
def test_the_real_machine_is_looked_at():
    words = [sys.executable, "-m", "torchdlo", "doctor", "--json"]
    done = subprocess.run(words, capture_output=True, text=True, env=os.environ | {"PYTHONPATH": str(ROOT)})
    content = json.loads(done.stdout)
    assert done.returncode == 0 and content["ok"], done.stdout
    kernels = next(check for check in content["checks"] if check["name"] == "kernels")
    if native.compiler() is not None:
        assert kernels["found"] == "16 built and loaded"


def test_films_of_the_sample_are_copied_as_well(tmp_path, capsys):
    folder = tmp_path / "filmed"
    with pytest.raises(SystemExit) as ended:
        app.main(["sample", str(folder), "--film"])
    assert not ended.value.code and f"torchdlo calibrate {folder}" in capsys.readouterr().out
    assert load_recording(folder).filmed


def test_the_sample_is_a_recording_of_ones_own(tmp_path, capsys):
    folder = tmp_path / "rope"
    with pytest.raises(SystemExit) as ended:
        app.main(["sample", str(folder)])
    assert not ended.value.code and f"torchdlo calibrate {folder}" in capsys.readouterr().out
    with pytest.raises(SystemExit) as ended:
        app.main(["check", str(folder)])
    assert not ended.value.code
    (folder / "rope.json").write_text("mine")
    with pytest.raises(SystemExit) as ended:
        app.main(["sample", str(folder)])
    assert ended.value.code == 2 and (folder / "rope.json").read_text() == "mine"
