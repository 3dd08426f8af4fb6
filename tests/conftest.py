"""Settings and fixtures for all tests."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest

REPOSITORY = Path(__file__).resolve().parents[1]

# A small recording made of formulas.
LENGTH = 1.0
ARCLENGTH = np.array([0.0, 0.03, 0.2, 0.35, 0.5, 0.65, 0.8, 0.97, 1.0])
GRIPPED = np.array([1, 1, 0, 0, 0, 0, 0, 1, 1], dtype=bool)
N_FRAMES = 40


def swing(phase: float) -> dict[str, np.ndarray]:
    """Arrays of a trial: a shallow arc whose ends and middle swing."""
    time = np.arange(N_FRAMES) * 0.01
    s = ARCLENGTH / LENGTH
    x = 0.9 * s + 0.05 * np.sin(6 * time + phase)[:, None]
    y = 0.08 * np.sin(np.pi * s) * np.cos(9 * time + phase)[:, None]
    z = 0.5 - 0.15 * np.sin(np.pi * s) + 0.0 * time[:, None]
    return {
        "time": time,
        "markers": np.stack([x, y, z], axis=-1),
        "marker_arclength": ARCLENGTH.copy(),
        "gripped": GRIPPED.copy(),
        "gripper_quaternion": np.tile([1.0, 0.0, 0.0, 0.0], (N_FRAMES, 2, 1)),
        "gripper_marker": np.array([0, 8]),
        "suspect": time > 0.37,
    }


@pytest.fixture(scope="session", autouse=True)
def _one_thread() -> None:
    """Threads of several test processes only get in each other's way."""
    import torch

    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def repository() -> Path:
    """Root of the repository."""
    return REPOSITORY


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of measured recordings that may not be published with the code; skips if absent."""
    root = Path(os.environ.get("TORCHDLO_SHARED", REPOSITORY.parent / "shared"))
    if not (root / "data").is_dir():
        pytest.skip("measured recordings are not at hand: set TORCHDLO_SHARED to their folder")
    return root / "data"


@pytest.fixture(scope="session")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A correct recording folder; read only."""
    folder = tmp_path_factory.mktemp("recordings") / "rope"
    folder.mkdir()
    rope = {
        "length": LENGTH,
        "radius": 0.004,
        "mass": 0.05,
        "gravity": [0, 0, -9.81],
        "table_height": None,
        "marker_noise_std": 5e-4,
        "rest_positions": np.outer(ARCLENGTH, [0.0, 1.0, 0.0]).tolist(),
        "notes": "made of formulas",
    }
    (folder / "rope.json").write_text(json.dumps(rope))
    for phase, name in enumerate(("train_0", "train_1", "test_0", "test_1")):
        arrays = swing(float(phase))
        arrays["markers"][5:9, 4] = np.nan
        np.savez(folder / f"{name}.npz", **arrays)
    return folder


@pytest.fixture
def folder(template: Path, tmp_path: Path) -> Path:
    """A correct recording folder of one's own."""
    return Path(shutil.copytree(template, tmp_path / "rope"))
