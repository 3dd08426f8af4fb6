"""A set that was made once, for tests that read it."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

pytest.importorskip("pyarrow", reason="data sets need the extra dataset")
pytest.importorskip("av", reason="data sets need the extra dataset")
pytest.importorskip("pytorch_kinematics", reason="arms need the extra robots")

from short_task import SHORT, Dots, plan

from torchdlo import envs
from torchdlo.agents.data.making import make_dataset


@pytest.fixture(autouse=True)
def _short_tasks(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, kind in SHORT.items():
        monkeypatch.setitem(envs.TASKS, name, kind)


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five episodes of a task of one arm; read only."""
    out = tmp_path_factory.mktemp("sets") / "small"
    envs.TASKS.update(SHORT)
    try:
        make_dataset(plan(), out, painter=Dots())
    finally:
        for name in SHORT:
            envs.TASKS.pop(name)
    return out


@pytest.fixture
def own(made: Path, tmp_path: Path) -> Path:
    """A copy of it that may be damaged."""
    return Path(shutil.copytree(made, tmp_path / "own"))
