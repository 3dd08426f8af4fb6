"""Archives of searches: packed and unpacked they are what they were, and files of version 0.1 are read."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from torchdlo.agents.trajopt.stored import (
    ARCHIVE,
    load_trajectory,
    pack_searches,
    read_index,
    read_searches,
    unpack_searches,
)
from torchdlo.errors import InputError

OLD_RESULT = {
    "generator": "torchdlo optimize",
    "task": "separation",
    "return": 94.78529357910156,
    "success": True,
    "searched": 94.7850341796875,
    "highest": 94.7850341796875,
    "solved_after": 60,
    "settings": {"method": "cmaes", "episodes": 600, "seed": 2, "rehearsed": 0.25},
    "versions": {"torchdlo": "0.1.0"},
    "curve": [{"episodes": 60, "best": None, "without_slope": 3, "rehearsed": True}],
}
"""What version 0.1 wrote, without what is called the same today."""


def written(folder: Path) -> dict:
    """A search that version 0.1 left, with numbers that do not and that do fit into single precision."""
    target = folder / "separation-cmaes-2"
    target.mkdir(parents=True)
    (target / "result.json").write_text(json.dumps(OLD_RESULT))
    trajectory = {"task": "separation", "actions": [[0.1, 1 / 3], [0.2, 2e-9]], "rewards": [0.5, 0.25], "missed": ""}
    (target / "trajectory.json").write_text(json.dumps(trajectory))
    return trajectory


def test_an_archive_gives_back_every_bit_under_the_names_of_today(tmp_path: Path) -> None:
    trajectory = written(tmp_path / "had")
    assert pack_searches(tmp_path / "had", tmp_path / "a.npz") == 1
    ((name, result, kept),) = read_searches(tmp_path / "a.npz")
    assert name == "separation-cmaes-2"
    assert result["search_return"] == result["max_return"] == 94.7850341796875 and result["episodes_to_success"] == 60
    assert result["settings"]["surrogate_share"] == 0.25
    assert result["curve"] == [{"episodes": 60, "best": None, "without_gradient": 3, "surrogate": True}]
    assert not {"searched", "highest", "solved_after"} & set(result)
    assert kept["actions"].tolist() == trajectory["actions"] and kept["rewards"].dtype == np.float64
    unpack_searches(tmp_path / "a.npz", tmp_path / "out")
    assert json.loads((tmp_path / "out" / name / "trajectory.json").read_text()) == trajectory
    assert json.loads((tmp_path / "out" / name / "result.json").read_text()) == result


def test_the_archive_of_the_repository_has_an_index_and_trajectories() -> None:
    index = read_index()
    assert len(index) == len({entry["name"] for entry in index}) == 51
    assert {"task", "method", "seed", "budget", "version", "return", "success"} < set(index[0])
    for entry in index:
        found = load_trajectory(entry["task"], entry["method"], entry["seed"])
        assert found["actions"].ndim == 2 and found["return"] == entry["return"]


def test_what_is_not_there_is_said(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"expected a search of coiling-cmaes-0, .*; asked for coiling-luck-9"):
        load_trajectory("coiling", "luck", 9)
    with pytest.raises(InputError, match=r"no\.npz: expected an archive of searches, found none"):
        read_index(tmp_path / "no.npz")
    (tmp_path / "text.npz").write_text("no")
    with pytest.raises(
        InputError,
        match=r"text\.npz: expected an archive of searches.*cannot be read",
    ):
        read_index(tmp_path / "text.npz")
    assert ARCHIVE.is_file()
