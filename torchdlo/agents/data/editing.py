"""New data sets from others: several made one, or some episodes of one. Pictures are copied as they are encoded."""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from torchdlo.agents.data import build
from torchdlo.agents.data.dataset_schema import CODECS, DEFAULTS, Schema
from torchdlo.agents.data.reading import DataSet, open_set
from torchdlo.agents.data.statistics import channel_histogram
from torchdlo.agents.trajopt.search_journal import code_versions
from torchdlo.errors import InputError

__all__ = ["Choice", "merge_datasets", "select_episodes"]


@dataclass(frozen=True)
class Choice:
    """Which episodes to keep; what is not given does not matter."""

    tasks: tuple[str, ...] = ()
    """Names of tasks, or instructions."""
    episodes: tuple[int, ...] = ()
    least_return: float | None = None
    limit: int | None = None
    """The first so many of each task."""

    def of(self, data: DataSet) -> list[int]:
        """Return the numbers of the episodes to keep."""
        about = data.provenance.get("episodes") or [{}] * len(data.episodes)
        known = {text for row in data.episodes for text in row["tasks"]} | {e.get("task") for e in about}
        for name in self.tasks:
            if name not in known:
                raise InputError(f"{data.path}: has no task {name!r}; it has {', '.join(sorted(filter(None, known)))}.")
        found, seen = [], dict[str, int]()
        for k, (row, own) in enumerate(zip(data.episodes, about, strict=True)):
            task = own.get("task") or row["tasks"][0]
            good = not self.tasks or bool({task, *row["tasks"]} & set(self.tasks))
            good &= not self.episodes or k in self.episodes
            good &= self.least_return is None or (own.get("return") or -np.inf) >= self.least_return
            good &= self.limit is None or seen.get(task, 0) < self.limit
            if good:
                seen[task] = seen.get(task, 0) + 1
                found.append(k)
        if not found:
            raise InputError(f"{data.path}: no episode is left; ask for less.")
        return found


def schema_of(data: DataSet) -> Schema:
    """Return what the frames of a set are like."""
    state = data.features.get("observation.state", {}).get("shape", [0])[0]
    front = data.features.get("observation.images.front")
    codecs = {name: codec for codec, (_, name) in CODECS.items()}
    codec = codecs.get(front["info"].get("video.codec"), "h264") if front else "h264"
    size = front["shape"][0] if front else 0
    schema = Schema(arms=max(1, min(2, state // 15)), size=size, fps=data.fps, codec=codec)
    odd = {n for n in schema.features.keys() ^ data.features.keys()}
    odd |= {n for n in schema.features.keys() & data.features.keys() if _form(schema, n) != _form(data, n)}
    if odd:
        raise InputError(
            f"{data.path}: it was not made by this version of torchdlo, as {', '.join(sorted(odd))} differ; LeRobot's "
            "own tools merge and filter sets of others."
        )
    return schema


def _form(owner: Schema | DataSet, name: str) -> tuple:
    what = owner.features[name]
    return what["dtype"], list(what["shape"]), what["names"]


def merge_datasets(paths: Sequence[Path], out: Path, callback: Callable[[int, int], None] | None = None) -> int:
    """Write a set of all episodes of others, in order; return how many there are."""
    sets = [open_set(path) for path in paths]
    schemas = [schema_of(data) for data in sets]
    for data, schema in zip(sets, schemas, strict=True):
        if schema != schemas[0]:
            raise InputError(
                f"{data.path}: it has {_said(schema)}, and {sets[0].path} has {_said(schemas[0])}; only sets that are "
                "alike can be merged: make them with the same options, tasks of one arm and of two in one go."
            )
    episodes = [episode for data in sets for episode in _episodes(data, range(len(data.episodes)))]
    return _write(out, schemas[0], episodes, {"generator": "torchdlo dataset merge"}, sets, callback)


def select_episodes(path: Path, out: Path, choice: Choice, callback: Callable[[int, int], None] | None = None) -> int:
    """Write a set of some episodes of another; return how many there are."""
    data = open_set(path)
    schema = schema_of(data)
    episodes = _episodes(data, choice.of(data))
    return _write(out, schema, episodes, {"generator": "torchdlo dataset filter"}, [data], callback)


def _said(schema: Schema) -> str:
    return f"{schema.arms} arm(s), pictures of {schema.size} px in {schema.codec}, {schema.fps} frames per second"


def _episodes(data: DataSet, chosen: Sequence[int]) -> list[build.DatasetEpisode]:
    columns, about = data.columns(), data.provenance.get("episodes") or [{}] * len(data.episodes)
    decided = {*DEFAULTS, "task_index"}

    def episode(k: int) -> build.DatasetEpisode:
        row = data.episodes[k]
        rows = slice(row["dataset_from_index"], row["dataset_to_index"])
        own = {name: values[rows] for name, values in columns.items() if name not in decided}
        clips = {camera: data.clip(k, camera) for camera in data.cameras}
        provenance = {name: value for name, value in about[k].items() if name != "episode_index"}
        return build.DatasetEpisode(
            row["tasks"][0],
            row["length"],
            lambda: dict(own),
            clips,
            lambda: {camera: channel_histogram(data.pictures(k, camera)) for camera in data.cameras},
            provenance | {"from": [data.path.resolve().name, k]},
        )

    return [episode(k) for k in chosen]


def _write(
    out: Path,
    schema: Schema,
    episodes: Sequence[build.DatasetEpisode],
    header: dict[str, Any],
    sets: Sequence[DataSet],
    callback: Callable[[int, int], None] | None,
) -> int:
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out}: it exists already; choose another --out.")
    sources = [{"name": data.path.resolve().name, "plan": data.provenance.get("plan")} for data in sets]
    out.parent.mkdir(parents=True, exist_ok=True)
    fresh = out.with_name(f".{secrets.token_hex(4)}-{out.name}")
    try:
        build.write_dataset(
            fresh, schema, episodes, header | {"versions": code_versions(), "sources": sources}, callback
        )
        if out.exists():
            out.rmdir()
        os.rename(fresh, out)
    finally:
        shutil.rmtree(fresh, ignore_errors=True)
    return len(episodes)
