"""Finished searches in one archive: what each found, and its trajectory to the last bit.

The archive is a compressed .npz. "index" is JSON text, one entry per search: name, task, method, seed, budget, version,
return, success. "NAME/result" is the text of its result.json, "NAME/trajectory" that of its trajectory.json without the
arrays, which are entries of their own: "NAME/actions", "NAME/joints", "NAME/tool", "NAME/rewards".
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from torchdlo.agents.trajopt.search_result import upgrade_result
from torchdlo.errors import InputError
from torchdlo.files import replace_atomically
from torchdlo.untrusted import one_line, parse_json, read_json
from torchdlo.untrusted.array_file import ArrayFile

__all__ = ["ARCHIVE", "NAME", "load_trajectory", "pack_searches", "read_index", "read_searches", "unpack_searches"]

NAME = "searches.npz"
"""What an archive is called in the folder of a benchmark."""
ARCHIVE = Path(__file__).resolve().parents[3] / "experiments" / "trajopt" / NAME
"""The archive of the benchmark in a checkout of the repository."""


def load_trajectory(task: str, method: str, seed: int, archive: str | Path = ARCHIVE) -> dict[str, Any]:
    """Return a stored trajectory, as its trajectory.json has it, with arrays in the place of lists.

    Args:
        task: name of the task.
        method: "cmaes", "gd" or "hybrid".
        seed: of the search.
        archive: file that `pack_searches` wrote; by default that of the repository's benchmark.

    Returns:
        "actions" of shape (T, A) [m, degrees], "rewards" (T,), "return", "success", "choices" (precision and kind of
        steps with which it was found), and the rest of the file.
    """
    name = f"{task}-{method}-{seed}"
    with _Archive(archive) as found:
        if f"{name}/trajectory" not in found.files:
            known = ", ".join(entry["name"] for entry in found.index())
            raise InputError(f"{archive}: expected a search of {known}; asked for {name}.")
        return _trajectory(found, name)


def read_index(archive: str | Path = ARCHIVE) -> list[dict[str, Any]]:
    """Return what is in an archive: name, task, method, seed, budget, version, return and success of each search."""
    with _Archive(archive) as found:
        return found.index()


def read_searches(archive: str | Path) -> Iterator[tuple[str, dict[str, Any], dict[str, Any]]]:
    """Yield the name, the result and the trajectory of each search in an archive."""
    with _Archive(archive) as found:
        for entry in found.index():
            name = entry["name"]
            yield name, found.result(name), _trajectory(found, name)


def pack_searches(folder: str | Path, archive: str | Path) -> int:
    """Write all finished searches in the subfolders of a folder into an archive; return how many there are."""
    arrays: dict[str, np.ndarray] = {}
    index = []
    for file in sorted(Path(folder).glob("*/result.json")):
        name, result = file.parent.name, upgrade_result(read_json(file, "the result of a search", finite=False))
        settings, text = result["settings"], {}
        for key, value in upgrade_result(
            read_json(file.with_name("trajectory.json"), "a trajectory", finite=False)
        ).items():
            if isinstance(value, list):
                arrays[f"{name}/{key}"] = _exact(value)
            else:
                text[key] = value
        arrays[f"{name}/result"] = np.array(json.dumps(result, separators=(",", ":")))
        arrays[f"{name}/trajectory"] = np.array(json.dumps(text, separators=(",", ":")))
        index.append(
            {"name": name, "task": result["task"], "method": settings["method"], "seed": settings["seed"]}
            | {"budget": settings["episodes"], "version": result["versions"]["torchdlo"]}
            | {"return": result["return"], "success": result["success"]}
        )
    # Text is kept as bytes of UTF-8: an array of characters would take four bytes for each.
    packed: dict[str, Any] = {
        k: np.frombuffer(str(v).encode(), np.uint8) if v.dtype.kind == "U" else v for k, v in arrays.items()
    }
    with replace_atomically(Path(archive)) as temporary:
        np.savez_compressed(temporary, index=np.frombuffer(json.dumps(index).encode(), np.uint8), **packed)
    return len(index)


def unpack_searches(archive: str | Path, folder: str | Path) -> None:
    """Write result.json and trajectory.json of each search in an archive into a subfolder of its name."""
    for name, result, trajectory in read_searches(archive):
        plain = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in trajectory.items()}
        target = Path(folder) / name
        target.mkdir(parents=True, exist_ok=True)
        (target / "result.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
        (target / "trajectory.json").write_text(json.dumps(plain) + "\n", encoding="utf-8")


def _exact(value: list[Any]) -> np.ndarray:
    """Return numbers in single precision where that keeps every bit, else in double."""
    wide = np.array(value, dtype=np.float64)
    narrow = wide.astype(np.float32)
    return narrow if np.array_equal(narrow.astype(np.float64), wide, equal_nan=True) else wide


def _trajectory(found: _Archive, name: str) -> dict[str, Any]:
    content = found.json(f"{name}/trajectory")
    if not isinstance(content, dict):
        raise InputError(
            f"{found.inner.where}: {one_line(name, 60)}/trajectory: expected an object, found another value."
        )
    for key in found.files:
        if key.startswith(f"{name}/") and key.split("/")[1] not in ("result", "trajectory"):
            value = found[key]
            if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiu":
                raise InputError(f"{found.inner.where}: {one_line(key, 60)}: expected numbers, found something else.")
            content[key.split("/")[1]] = value.astype(np.float64)
    return content


class _Archive:
    """An opened archive, whose texts are text."""

    def __init__(self, path: str | Path) -> None:
        self.inner = ArrayFile(path, "an archive of searches")
        self.files = self.inner.files

    def __enter__(self) -> _Archive:
        return self

    def __exit__(self, *_: object) -> None:
        self.inner.close()

    def __getitem__(self, key: str) -> Any:
        value = self.inner[key]
        return value.tobytes().decode(errors="replace") if value.dtype == np.uint8 else value

    def json(self, key: str) -> Any:
        """Return the value of a text of JSON."""
        return parse_json(str(self[key]), where=f"{self.inner.where}: {key}", finite=False)

    def result(self, name: str) -> dict[str, Any]:
        """Return what a result.json said."""
        try:
            return upgrade_result(self.json(f"{name}/result"))
        except (AttributeError, TypeError, ValueError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(
                f"{self.inner.where}: {one_line(name, 60)}/result: expected a result of a search."
            ) from None

    def index(self) -> list[dict[str, Any]]:
        """Return what there is, an entry for each search."""
        found = self.json("index")
        if not isinstance(found, list) or not all(
            isinstance(e, dict) and isinstance(e.get("name"), str) for e in found
        ):
            raise InputError(f"{self.inner.where}: index: expected a list of searches, found something else.")
        return found
