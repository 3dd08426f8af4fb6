"""Importing the package is light: torch, and nothing that only some users need."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.quick

OPTIONAL = (
    "matplotlib",
    "scipy",
    "rich",
    "typer",
    "torchrl",
    "tensordict",
    "kornia",
    "cv2",
    "cma",
    "trimesh",
    "pytorch_kinematics",
)


def loaded_by(statement: str) -> set[str]:
    """Modules that a fresh interpreter has after a statement."""
    code = f"{statement}\nimport sys\nprint(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return set(done.stdout.split())


@pytest.mark.parametrize("module", ["torchdlo", "torchdlo.physics", "torchdlo.sysid"])
def test_optional_packages_stay_unimported(module: str) -> None:
    # What torch itself brings along is not ours to judge.
    ours = loaded_by(f"import {module}") - loaded_by("import torch")
    assert not ours & set(OPTIONAL)


def test_a_recording_is_checked_without_torch(repository: Path) -> None:
    folder = repository / "torchdlo" / "data" / "sample_rope"
    assert "torch" not in loaded_by(f"from torchdlo.cli import main\nmain(['check', {str(folder)!r}])")
