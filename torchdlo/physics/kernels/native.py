"""C++ kernels: compiled once per machine with the compiler that `torch.compile` needs as well.

Headers stand beside the sources, or beside this file.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import logging
import os
import shutil
import subprocess
import tempfile
from pathlib import Path

RODS = Path(__file__).parent
"""Sources of the rods' kernels, and headers that others share."""
COUPLING = Path(__file__).parents[2] / "coupling" / "kernels"
"""Sources of the couplings' kernels."""

_log = logging.getLogger(__name__)


@functools.cache
def library(source: Path, *options: str) -> ctypes.CDLL | None:
    """Return a source file as a loaded library, or None where no C++ compiler is at hand or it fails.

    Args:
        source: a C++ file whose functions have C names.
        options: what the compiler is told besides the usual.
    """
    compiler = os.environ.get("CXX") or shutil.which("g++") or shutil.which("clang++")
    if compiler is None:
        _log.warning("no C++ compiler found (g++ or clang++): %s is replaced by slower tensor operations", source.name)
        return None
    machine = Path("/proc/cpuinfo").read_bytes()[:2048] if Path("/proc/cpuinfo").exists() else b""
    flags = next((line for line in machine.splitlines() if line.startswith((b"model name", b"flags"))), b"")
    folders = sorted({source.parent, RODS})
    texts = [source, *(header for folder in folders for header in sorted(folder.glob("*.h")))]
    text = b"".join(each.read_bytes() for each in texts)
    key = hashlib.sha256(text + " ".join((compiler, *options)).encode() + flags).hexdigest()[:16]
    folder = Path(os.environ.get("TORCHDLO_CACHE", Path.home() / ".cache" / "torchdlo"))
    target = folder / f"{source.stem}-{key}.so"
    if not target.exists():
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder) as build:
            fresh = Path(build) / target.name
            usual = ["-O3", "-march=native", "-fopenmp", "-shared", "-fPIC", "-std=c++17"]
            headers = [f"-I{each}" for each in folders]
            command = [compiler, *usual, *options, *headers, str(source), "-o", str(fresh)]
            made = subprocess.run(command, capture_output=True, text=True)
            if made.returncode:
                _log.warning("%s could not build %s, using tensor operations: %s", compiler, source.name, made.stderr)
                return None
            os.replace(fresh, target)
    return ctypes.CDLL(str(target))
