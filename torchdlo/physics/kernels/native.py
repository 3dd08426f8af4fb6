"""C++ kernels: compiled once per machine with the compiler that `torch.compile` needs as well.

Headers stand beside the sources, or beside this file. Libraries are kept in the private folder of `torchdlo.cache`.
Where there is no compiler, or it fails, tensor operations take the place of all kernels, with one warning.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import hashlib
import os
import shlex
import shutil
import subprocess
import sysconfig
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from torchdlo import cache, notices

RODS = Path(__file__).parent
"""Sources of the rods' kernels, and headers that others share."""
COUPLING = Path(__file__).parents[2] / "coupling" / "kernels"
"""Sources of the couplings' kernels."""

FAST_MATH = (
    "-fno-math-errno",
    "-fno-signed-zeros",
    "-fno-trapping-math",
    "-fassociative-math",
    "-freciprocal-math",
    "-ffinite-math-only",
    "-fcx-limited-range",
)
"""What -ffast-math stands for, but for the start-up code that it links: that would let the whole process take numbers
below 1e-308 for zero."""

KERNELS: dict[str, Callable[[], ctypes.CDLL | None]] = {}
"""What loads each library, by its name; modules that use one put it here."""

_USUAL = ("-O3", "-march=native", "-fopenmp", "-shared", "-fPIC", "-std=c++17")
_WRAPPERS = ("ccache", "sccache", "distcc", "icecc", "env")


@dataclass(frozen=True)
class Compiler:
    """A C++ compiler that runs."""

    words: tuple[str, ...]
    """Its command."""
    macros: str
    """What it defines by itself: its version, and the instructions of this machine that it may use."""

    @property
    def program(self) -> str:
        """The compiler itself, without what it is started by, as in "ccache g++"."""
        plain = [word for word in self.words if not word.startswith("-") and Path(word).name not in _WRAPPERS]
        return plain[0] if plain else self.words[0]

    @property
    def version(self) -> str:
        """What it says of itself."""
        line = next((line for line in self.macros.splitlines() if line.startswith("#define __VERSION__ ")), "")
        return line.removeprefix("#define __VERSION__ ").strip('"') or "unknown version"


def compiler() -> Compiler | None:
    """Return the C++ compiler: `CXX` if that is set, else g++ or clang++; None, with one warning, if none runs."""
    return _compiler(os.environ.get("CXX", ""), os.environ.get("PATH", ""))


@functools.cache
def _compiler(given: str, path: str) -> Compiler | None:
    try:
        words = shlex.split(given)
    except ValueError as error:
        _without(f"CXX={given} is not a command ({error})")
        return None
    if not words:
        words = [name for name in ("g++", "clang++") if shutil.which(name)][:1]
    if not words:
        _without("no C++ compiler was found (g++ or clang++)")
        return None
    # Preprocessing nothing tells all of it in a hundredth of a second.
    command = [*words, "-march=native", "-dM", "-E", "-x", "c++", os.devnull]
    try:
        told = subprocess.run(command, capture_output=True, text=True, errors="replace", timeout=60)
    except (OSError, subprocess.TimeoutExpired) as error:
        _without(f"the C++ compiler {shlex.join(words)} does not run ({error})")
        return None
    if told.returncode:
        _without(f"the C++ compiler {shlex.join(words)} does not work ({last_line(told.stderr)})")
        return None
    return Compiler(tuple(words), told.stdout)


def _without(reason: str) -> None:
    notices.once("kernels", f"{reason}: slower tensor operations are used. `torchdlo doctor` says more.")


def last_line(text: str) -> str:
    """Return the line of a compiler's message that says most."""
    lines = [line for line in text.splitlines() if line.strip()]
    return next((line for line in lines if "error" in line), lines[-1] if lines else "no message").strip()


def works_on(device: str, what: str) -> bool:
    """Return whether kernels work on a kind of device, and warn once, by name, of what runs on a GPU without one.

    Args:
        device: "cpu", "cuda", ...
        what: what the kernel does, in words of the user.
    """
    if device not in ("cpu", "meta"):
        notices.once(
            f"{what} on {device}",
            f"{what}: there is no kernel for {device} devices, so that thousands of small tensor operations do it in "
            "every step; small batches are faster on the CPU.",
        )
    return device == "cpu"


@functools.cache
def library(source: Path, *options: str) -> ctypes.CDLL | None:
    """Return a source file as a loaded library, or None where it cannot be built or loaded; that is warned of once.

    Args:
        source: a C++ file whose functions have C names.
        options: what the compiler is told besides the usual.
    """
    found = compiler()
    folder = cache.cache_folder() if found else None
    if found is None or folder is None:
        return None
    folders = sorted({source.parent, RODS})
    texts = [source, *(header for each in folders for header in sorted(each.glob("*.h")))]
    parts = [found.macros, *found.words, *_USUAL, *options, *(text.read_text("utf-8") for text in texts)]
    key = hashlib.sha256("\0".join(parts).encode()).hexdigest()[:16]
    target = folder / f"{source.stem}-{key}.so"
    command = [*found.words, *_USUAL, *options, *(f"-I{each}" for each in folders), str(source)]
    try:
        if not cache.is_sound(target):
            with cache.file_lock(target.with_suffix(".lock")):
                # Another process may have built it while this one waited.
                if not cache.is_sound(target):
                    _build(command, target)
        return ctypes.CDLL(str(target))
    except subprocess.CalledProcessError as error:
        _without(f"{shlex.join(found.words)} could not build {source.name} ({last_line(error.stderr)})")
        return None
    except OSError as error:
        _without(f"{source.name} could not be built or loaded ({error})")
        return None


def _build(command: list[str], target: Path) -> None:
    for stray in target.parent.glob("build-*"):  # of a process that was killed while it built
        with contextlib.suppress(OSError):
            if time.time() - stray.stat().st_mtime > 86400:
                shutil.rmtree(stray)
    with tempfile.TemporaryDirectory(dir=target.parent, prefix="build-") as build:
        fresh = Path(build) / target.name
        subprocess.run([*command, "-o", str(fresh)], capture_output=True, text=True, errors="replace", check=True)
        cache.seal_file(fresh, target)


def python_header() -> Path:
    """Return where the header is that compiled steps need."""
    return Path(sysconfig.get_paths()["include"]) / "Python.h"


def prepare_torch_compile() -> bool:
    """Return whether `torch.compile` has a compiler; let it use the one that kernels use, and the private folder."""
    found = compiler()
    if found is None:
        return False
    if not python_header().is_file():
        notices.once("compile", f"{python_header()} is missing, so that steps are not compiled: install python3-dev.")
        return False
    import torch

    cache.keep_for_torch(torch.backends.cpu.get_cpu_capability())
    if len(found.words) > 1:
        # It takes the name of a program, not a command.
        import torch._inductor.config

        torch._inductor.config.cpp.cxx = (None, found.program)
    return True
