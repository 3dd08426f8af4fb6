"""Checking a data set: every frame is read and decoded, and all that a set says of itself is computed again."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from torchdlo.agents.data import parquet
from torchdlo.agents.data.dataset_schema import DEFAULTS, data_path
from torchdlo.agents.data.reading import DataSet, open_set
from torchdlo.agents.data.statistics import channel_histogram, column_statistics, picture_statistics
from torchdlo.errors import InputError

__all__ = ["check_dataset"]

_TYPES = {"float32": "float", "float64": "double", "int64": "int64", "bool": "bool", "string": "string"}


def check_dataset(path: Path, callback: Callable[[int, int], None] | None = None) -> list[str]:
    """Return what is wrong with a set, a sentence each; none if it is sound.

    Args:
        path: the set.
        callback: told (episodes done, in all).
    """
    try:
        data = open_set(path)
    except InputError as error:
        return [str(error)]
    found = [*_declared(data), *_tables(data)]
    if found:
        return found
    try:
        columns, stats = data.columns(), data.stats
    except InputError as error:
        return [str(error)]
    found = [*_numbers(data, columns), *_finite(columns)]
    if not found:
        for name, values in columns.items():
            if values.dtype.kind in "fib":
                found += _compared(name, stats.get(name), column_statistics(values))
        found += _pictures(data, stats, callback)
    return found


def _declared(data: DataSet) -> Iterator[str]:
    info, where = data.info, data.path / "meta/info.json"
    for name in (*DEFAULTS, "task_index"):
        if name not in data.features:
            yield f"{where}: the column {name} is not declared."
    for name in data.features:
        if "/" in name:
            yield f"{where}: the name {name!r} has a slash, which no column may have."
    fps = info["fps"]
    if not isinstance(fps, int) or fps < 1:
        yield f"{where}: fps is {fps!r}; expected a whole number above 0."
    counts = {"total_episodes": len(data.episodes), "total_tasks": len(data.tasks)}
    counts["total_frames"] = sum(row["length"] for row in data.episodes)
    for name, count in counts.items():
        if info.get(name) != count:
            yield f"{where}: {name} is {info.get(name)}; the tables have {count}."


def _tables(data: DataSet) -> Iterator[str]:
    """Say whether columns have the names and the types that are declared."""
    for numbers in data.files():
        file = data.path / data_path(*numbers)
        try:
            table = parquet.read_table(file)
        except InputError as error:
            yield str(error)
            continue
        declared = {name: what for name, what in data.features.items() if what["dtype"] != "video"}
        for name in declared.keys() ^ set(table.column_names):
            where = "is not declared" if name in table.column_names else "is missing"
            yield f"{file}: the column {name!r} {where}."
        for name in declared.keys() & set(table.column_names):
            yield from _typed(table.schema.field(name).type, declared[name], f"{file}: the column {name!r}")


def _typed(kind: Any, declared: dict[str, Any], where: str) -> Iterator[str]:
    size = declared["shape"][0]
    vector = hasattr(kind, "list_size")
    own, item = (kind.list_size, str(kind.value_type)) if vector else (1, str(kind))
    if own != size or vector != (size > 1):
        yield f"{where} has {own} numbers a frame; meta/info.json says {size}."
    if item != _TYPES.get(declared["dtype"], declared["dtype"]):
        yield f"{where} is of type {item}; meta/info.json says {declared['dtype']}."


def _numbers(data: DataSet, columns: dict[str, np.ndarray]) -> Iterator[str]:
    """Say whether frames are numbered without gaps, at their times, and as the table of episodes says."""
    count = len(columns["index"])
    wrong = np.flatnonzero(columns["index"] != np.arange(count))
    if len(wrong):
        yield f"{data.path}: the column index has {columns['index'][wrong[0]]} in frame {wrong[0]}; expected no gaps."
    start = 0
    for k, row in enumerate(data.episodes):
        end = start + row["length"]
        if (row["episode_index"], row["dataset_from_index"], row["dataset_to_index"]) != (k, start, end):
            yield (
                f"{data.path}: episode {k} is said to have frames {row['dataset_from_index']} to "
                f"{row['dataset_to_index']}; by the lengths they are {start} to {end}."
            )
            return
        at = np.arange(row["length"])
        own = {name: values[start:end] for name, values in columns.items()}
        if len(own["index"]) != row["length"]:
            yield f"{data.path}: episode {k} has {len(own['index'])} frames; its length is {row['length']}."
            return
        wanted = {"frame_index": at, "timestamp": (at / data.fps).astype(np.float32), "episode_index": 0 * at + k}
        for name, values in wanted.items():
            bad = np.flatnonzero(own[name] != values)
            if len(bad):
                yield (
                    f"{data.path}: {name} is {own[name][bad[0]]} in frame {bad[0]} of episode {k}; expected "
                    f"{values[bad[0]]}."
                )
        told = {data.tasks[t] if 0 <= t < len(data.tasks) else None for t in np.unique(own["task_index"]).tolist()}
        if told != set(row["tasks"]):
            yield (
                f"{data.path}: the frames of episode {k} have the instructions {sorted(map(str, told))}; the table of "
                f"episodes says {row['tasks']}."
            )
        start = end


def _finite(columns: dict[str, np.ndarray]) -> Iterator[str]:
    for name, values in columns.items():
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            frame = int(np.argwhere(~np.isfinite(values))[0][0])
            yield f"the column {name} is not finite in frame {frame}."


def _compared(name: str, said: Any, computed: dict[str, Any]) -> Iterator[str]:
    if said is None:
        yield f"meta/stats.json: has nothing on {name}."
        return
    for key, values in computed.items():
        if key not in said:
            yield f"meta/stats.json: {name} lacks {key}."
        elif np.shape(said[key]) != np.shape(values) or not np.allclose(said[key], values, rtol=1e-6, atol=1e-9):
            yield f"meta/stats.json: {key} of {name} is {_short(said[key])}; computed again it is {_short(values)}."


def _short(values: Any) -> str:
    flat = np.ravel(values)
    return f"[{', '.join(f'{x:.6g}' for x in flat[:3])}{', ...' if len(flat) > 3 else ''}]"


def _pictures(data: DataSet, stats: dict[str, Any], callback: Callable[[int, int], None] | None) -> Iterator[str]:
    """Decode all pictures; say which cannot be, are not at their times, or have other statistics."""
    counts = {camera: np.zeros((3, 256), np.int64) for camera in data.cameras}
    broken = False
    for k in range(len(data.episodes)):
        for camera in data.cameras:
            shape, wrong = tuple(data.features[camera]["shape"]), set[tuple[int, ...]]()

            def seen(images: Iterator[np.ndarray], shape: tuple = shape, wrong: set = wrong) -> Iterator[np.ndarray]:
                for image in images:
                    if image.shape != shape:
                        wrong.add(image.shape)
                    yield image

            try:
                counts[camera] += channel_histogram(seen(data.pictures(k, camera)))
            except (InputError, KeyError) as error:
                broken = True
                yield f"episode {k}, {camera}: {error}"
            if wrong:
                yield f"episode {k}, {camera}: pictures have the shape {wrong.pop()}; meta/info.json says {shape}."
        if callback is not None:
            callback(k + 1, len(data.episodes))
    for camera, found in counts.items():
        if not broken:
            yield from _compared(camera, stats.get(camera), picture_statistics(found, data.info["total_frames"]))
