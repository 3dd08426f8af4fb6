"""Kernels are built once, privately, and never loaded unless they are what was built."""

from __future__ import annotations

import ctypes
import os
import shutil
import stat
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from torchdlo import cache, notices
from torchdlo.coupling.mpm import transfer_op
from torchdlo.coupling.rod_contact import broad_phase_op
from torchdlo.physics.kernels import native
from torchdlo.physics.linalg import banded
from torchdlo.physics.rod import topology  # noqa: F401 (topology names the systems)

pytestmark = pytest.mark.quick

ROOT = Path(__file__).parents[2]
needs_compiler = pytest.mark.skipif(native.compiler() is None, reason="needs a C++ compiler")

COUPLED = """
import sys, torch
from torchdlo import scene
from torchdlo.coupling import BodyContact, RodBody, RodContact
from torchdlo.physics.effects.elastic import Bend
from torchdlo.physics.effects.external import Gravity

torch.set_num_threads(1)
line = torch.zeros(2, 12, 3, dtype=torch.float64)
line[0, :, 0], line[0, :, 2] = torch.linspace(-0.1, 0.1, 12), 0.021
line[1, :, 1], line[1, :, 2] = torch.linspace(-0.1, 0.1, 12), 0.0315
ropes = [scene.Rope(x, radius=0.005, density=1000.0, bend=1e-5) for x in line]
bodies = [
    scene.RigidBody("sphere", 0.015, motion="fixed"),
    scene.RigidBody("sphere", 0.01, pos=(0.05, 0, 0), density=500.0),
]
effects = [Gravity(), Bend(), RodContact(), RodBody(), BodyContact()]
made, params, now = scene.make(ropes, effects, bodies=bodies, dt=2e-3, substeps=4)
step = scene.stepper(made, execution="compiled" if "compiled" in sys.argv else "eager")
for _ in range(6):
    now = step(params, now, scene.stationary_control(made, now))
print(*now.rods.pos.flatten().tolist(), *now.bodies.pos.flatten().tolist())
"""


@pytest.fixture
def source(tmp_path: Path) -> Path:
    file = tmp_path / "source" / "answer.cpp"
    file.parent.mkdir()
    file.write_text('extern "C" int answer() { return 42; }\n')
    return file


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("TORCHDLO_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(notices, "_said", set())
    return tmp_path / "cache"


def load(source: Path, *options: str) -> ctypes.CDLL | None:
    return native.library.__wrapped__(source, *options)


def run(code: str, *words: str, **environment: str) -> subprocess.CompletedProcess[str]:
    kept = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"} | environment
    return subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True, env=kept)


@needs_compiler
def test_a_library_is_built_once_into_a_private_folder(source, folder):
    assert load(source).answer() == 42
    (built,) = folder.glob("*.so")
    before = built.stat().st_mtime_ns
    assert load(source).answer() == 42 and built.stat().st_mtime_ns == before
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert all(not file.stat().st_mode & 0o077 for file in folder.iterdir())


@needs_compiler
def test_what_a_library_depends_on_is_in_its_name(source, folder, monkeypatch):
    load(source)
    load(source, "-DOTHER")
    source.write_text('extern "C" int answer() { return 43; }\n')
    assert load(source).answer() == 43
    (source.parent / "header.h").write_text("// of use\n")
    load(source)
    found = native.compiler()
    for macros in (found.macros + "#define __AVX9__ 1\n", found.macros.replace("__VERSION__ ", '__VERSION__ "99" ')):
        monkeypatch.setattr(native, "compiler", lambda macros=macros: native.Compiler(found.words, macros))
        load(source)
    assert len(list(folder.glob("*.so"))) == 6


def cut(file: Path) -> None:
    os.truncate(file, 2000)


def flip(file: Path) -> None:
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)


def give_away(file: Path) -> None:
    if os.geteuid():
        pytest.skip("only root can give files away")
    os.chown(file, 12345, -1)


def link(file: Path) -> None:
    shutil.move(file, file.with_suffix(".elsewhere"))
    file.symlink_to(file.with_suffix(".elsewhere"))


def fifo(file: Path) -> None:
    file.unlink()
    os.mkfifo(file)


DAMAGE = {
    "cut": cut,
    "empty": lambda file: os.truncate(file, 0),
    "flipped": flip,
    "of another user": give_away,
    "writable by others": lambda file: file.chmod(0o777),
    "without hash": lambda file: file.with_name(file.name + ".sha256").unlink(),
    "a link": link,
    "a pipe": fifo,
}


@needs_compiler
@pytest.mark.parametrize("damage", DAMAGE)
def test_a_library_that_is_not_as_it_was_built_is_built_anew(damage, source, folder):
    load(source)
    (built,) = folder.glob("*.so")
    # A copy: this process has the file in its memory.
    shutil.copy(built, built.with_suffix(".copy"))
    os.replace(built.with_suffix(".copy"), built)
    assert cache.is_sound(built)
    DAMAGE[damage](built)
    assert not cache.is_sound(built)
    assert load(source).answer() == 42
    assert cache.is_sound(built)


@needs_compiler
def test_a_planted_library_never_runs(source, folder, tmp_path):
    load(source)
    (built,) = folder.glob("*.so")
    trace, evil = tmp_path / "ran", tmp_path / "evil.cpp"
    evil.write_text(f'#include <cstdio>\n__attribute__((constructor)) void go() {{ fclose(fopen("{trace}", "w")); }}\n')
    command = [*native.compiler().words, "-shared", "-fPIC", str(evil), "-o", str(built)]
    subprocess.run(command, check=True)
    assert load(source).answer() == 42 and not trace.exists()
    ctypes.CDLL(subprocess.run([*command[:-1], str(tmp_path / "evil.so")], check=True).args[-1])
    assert trace.exists()  # it would have


@pytest.mark.parametrize("given", ["false", "/nowhere/g++", "g++ 'unbalanced", "g++ -no-such-option"])
def test_a_compiler_that_fails_is_warned_of_once(given, source, folder, monkeypatch, caplog):
    monkeypatch.setenv("CXX", given)
    other = shutil.copy(source, source.with_name("other.cpp"))
    assert load(source) is None and load(Path(other)) is None
    assert not native.prepare_torch_compile()
    (said,) = caplog.messages
    assert "slower tensor operations" in said and "\n" not in said


@needs_compiler
def test_a_source_that_cannot_be_built_is_warned_of_by_name(source, folder, caplog):
    source.write_text("not C++\n")
    assert load(source) is None
    assert "could not build answer.cpp" in caplog.text
    assert not list(folder.glob("build-*"))


@needs_compiler
def test_a_compiler_may_be_a_command_of_several_words(source, folder, tmp_path, monkeypatch):
    wrapper = tmp_path / "ccache"
    wrapper.write_text('#!/bin/sh\nexec "$@"\n')
    wrapper.chmod(0o755)
    own = native.compiler().program
    monkeypatch.setenv("CXX", f"{wrapper} {own} -g0")
    assert native.compiler().program == own
    assert load(source).answer() == 42


@needs_compiler
def test_two_processes_that_build_at_once_build_once(source, tmp_path):
    log, slow = tmp_path / "log", tmp_path / "slow"
    own = native.compiler().program
    slow.write_text(f'#!/bin/sh\ncase "$*" in *-shared*) echo built >> {log}; sleep 1;; esac\nexec {own} "$@"\n')
    slow.chmod(0o755)
    code = "import sys, pathlib; from torchdlo.physics.kernels import native as n"
    code += "; print(n.library(pathlib.Path(sys.argv[1])).answer())"
    kept = os.environ | {"PYTHONPATH": str(ROOT), "CXX": str(slow), "TORCHDLO_CACHE": str(tmp_path / "cache")}
    command = [sys.executable, "-c", code, str(source)]
    both = [subprocess.Popen(command, env=kept, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    assert [process.communicate(timeout=600)[0].strip() for process in both] == ["42", "42"]
    assert log.read_text().split() == ["built"]


def test_kernels_leave_small_numbers_of_others_alone_and_have_none_themselves():
    code = """
import numpy, torch
from torchdlo.physics.kernels import lanes
from torchdlo.physics.linalg import banded
from torchdlo.physics.rod import topology
assert (banded.kernel() is None) == (lanes._library() is None)
entries, rhs = torch.full((180, 3), 0.1), torch.zeros(60, 3)
entries[:60], rhs[0] = 3.0, 1e-6
found = torch.ops.torchdlo.solve_banded(entries, rhs, "tridiagonal:o60", False).abs()
print(numpy.float64(1e-310) * 1 > 0, float(torch.tensor(1e-310, dtype=torch.float64) * 1) > 0)
print(bool(((found > 0) & (found < 1.1e-38)).any()))
"""
    done = run(code)
    assert done.returncode == 0, done.stderr
    small, other, inside = done.stdout.split()
    assert (small, other) == ("True", "True")
    assert inside == "False" or banded.kernel() is None


@pytest.fixture(scope="module")
def without_compiler(tmp_path_factory) -> str:
    empty = tmp_path_factory.mktemp("empty")
    return run(COUPLED, "compiled", PATH=str(empty), CXX="", TORCHDLO_CACHE=str(empty / "cache"))


def test_without_a_compiler_all_runs_with_one_warning(without_compiler):
    assert without_compiler.returncode == 0, without_compiler.stderr
    (line,) = without_compiler.stderr.splitlines()
    assert "no C++ compiler" in line and "slower tensor operations" in line


@needs_compiler
def test_without_a_compiler_scenes_move_the_same(without_compiler):
    with_it = run(COUPLED)
    assert with_it.returncode == 0 and not with_it.stderr, with_it.stderr
    here, there = (torch.tensor([float(x) for x in done.stdout.split()]) for done in (with_it, without_compiler))
    assert float((here - there).abs().max()) < 1e-9


def test_a_folder_that_others_can_write_is_not_used(tmp_path, folder, monkeypatch, caplog):
    folder.mkdir(mode=0o700)
    folder.chmod(0o770)
    monkeypatch.setattr(cache.tempfile, "gettempdir", lambda: str(tmp_path))
    used = cache._private.__wrapped__(folder)
    assert used != folder and used.parent == tmp_path and stat.S_IMODE(used.stat().st_mode) == 0o700
    (said,) = caplog.messages
    assert "other users can write there" in said and str(used) in said
    assert cache._private.__wrapped__(folder) == used  # again: it is kept


def test_a_folder_below_one_that_anybody_can_rename_is_not_used(tmp_path):
    open_to_all = tmp_path / "open"
    open_to_all.mkdir()
    open_to_all.chmod(0o777)
    assert "can replace" in cache.privacy_problem(open_to_all / "torchdlo")
    open_to_all.chmod(0o1777)
    assert not cache.privacy_problem(open_to_all / "torchdlo")


def test_a_folder_of_another_user_is_not_used(tmp_path):
    (tmp_path / "torchdlo").mkdir(mode=0o700)
    give_away(tmp_path / "torchdlo")
    assert "belongs to another user" in cache.privacy_problem(tmp_path / "torchdlo")


def test_where_no_folder_can_be_made_another_is_used_or_none(tmp_path, folder, monkeypatch, caplog):
    (tmp_path / "file").write_text("")
    monkeypatch.setattr(cache.tempfile, "gettempdir", lambda: str(tmp_path / "file"))
    assert cache._private.__wrapped__(tmp_path / "file" / "cache") is None
    assert "cannot be written" in caplog.text


def test_the_cache_of_torch_is_private_unless_the_user_chose_one(folder, monkeypatch):
    monkeypatch.delenv("TORCHINDUCTOR_CACHE_DIR", raising=False)
    cache.keep_for_torch("AVX2")
    assert os.environ["TORCHINDUCTOR_CACHE_DIR"] == str(folder / "inductor_avx2")
    monkeypatch.delenv("TORCHINDUCTOR_CACHE_DIR")
    cache.keep_for_torch("AVX512")  # a machine that shares the folder
    assert os.environ["TORCHINDUCTOR_CACHE_DIR"] == str(folder / "inductor_avx512")
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", "elsewhere")
    cache.keep_for_torch("AVX2")
    assert os.environ["TORCHINDUCTOR_CACHE_DIR"] == "elsewhere"


def test_a_gpu_without_a_kernel_is_warned_of_once_by_name(monkeypatch, caplog):
    monkeypatch.setattr(notices, "_said", set())
    for _ in range(2):
        assert not broad_phase_op.ready("cuda", torch.float32)
    assert not transfer_op.ready("meta", torch.float32)
    assert not caplog.messages[1:]
    assert "RodContact" in caplog.text and "cuda" in caplog.text


def test_compilers_take_what_is_ready_as_a_constant():
    import torch._dynamo

    def ask() -> bool:
        return True

    assert vars(torch.compiler.assume_constant_result(ask)).items() <= vars(broad_phase_op.ready).items()
