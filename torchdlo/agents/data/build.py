"""From finished episodes to a data set: frames, videos, tables of tasks and episodes, statistics, provenance."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from torchdlo.agents.data import parquet, video_codec
from torchdlo.agents.data.dataset_schema import CHUNK, DATA_MB, FORMAT, VIDEO_MB, Schema, data_path, video_path
from torchdlo.agents.data.statistics import column_statistics, picture_statistics

__all__ = ["PROVENANCE", "DatasetEpisode", "write_dataset"]

PROVENANCE = "meta/torchdlo.json"
"""Where a set says how it was made; other readers do not mind it."""


@dataclass(frozen=True, eq=False)
class DatasetEpisode:
    """An episode that is to be in a set."""

    told: str
    length: int
    columns: Callable[[], dict[str, np.ndarray]]
    """Its columns, without those that its place in the set decides."""
    clips: dict[str, video_codec.Clip]
    """Its pictures."""
    histograms: Callable[[], dict[str, np.ndarray]]
    """How often each value is in its pictures, by column, shape (3, 256)."""
    provenance: dict[str, Any]


def write_dataset(
    out: Path,
    schema: Schema,
    episodes: Sequence[DatasetEpisode],
    header: dict[str, Any],
    callback: Callable[[int, int], None] | None = None,
) -> None:
    """Write a set into a folder.

    Args:
        out: the folder; it is created.
        schema: what frames are like.
        episodes: what is in it, in order.
        header: what is to be said of how it was made, beside what is said of each episode.
        callback: told (episodes done, in all).
    """
    sentences = list(dict.fromkeys(episode.told for episode in episodes))
    rows: list[dict[str, Any]] = []
    gathered: dict[str, list[np.ndarray]] = {}
    counts = {key: np.zeros((3, 256), np.int64) for key in schema.pictures}
    tables, start = [], 0
    for k, episode in enumerate(episodes):
        columns = _numbered(schema, episode, k, start, sentences.index(episode.told))
        for name, values in columns.items():
            gathered.setdefault(name, []).append(values)
        for key, found in episode.histograms().items():
            counts[key] += found
        tables.append(parquet.frame_table(columns))
        end = start + episode.length
        rows.append({"episode_index": k, "tasks": [episode.told], "length": episode.length})
        rows[-1] |= {"dataset_from_index": start, "dataset_to_index": end}
        start = end
        if callback is not None:
            callback(k + 1, len(episodes))
    _write_frames(out, tables, rows)
    for key in schema.pictures:
        _write_videos(out, key, [episode.clips[key] for episode in episodes], rows, schema.fps)
    stats = {name: column_statistics(np.concatenate(parts)) for name, parts in gathered.items()}
    stats |= {key: picture_statistics(found, start) for key, found in counts.items()}
    _write_meta(out, schema, rows, sentences, stats)
    listed = [{"episode_index": k} | episode.provenance for k, episode in enumerate(episodes)]
    _write_json(out / PROVENANCE, header | {"episodes": listed})


def _numbered(schema: Schema, episode: DatasetEpisode, k: int, start: int, task: int) -> dict[str, np.ndarray]:
    """Return the columns of an episode with its place in the set, in the order of the schema."""
    own, at = episode.columns(), np.arange(episode.length, dtype=np.int64)
    own |= {
        "timestamp": (at / schema.fps).astype(np.float32),
        "frame_index": at,
        "episode_index": np.full_like(at, k),
        "index": start + at,
        "task_index": np.full_like(at, task),
    }
    return {name: own[name] for name, what in schema.features.items() if what["dtype"] != "video"}


def _filed(sizes: Sequence[int], most: int) -> Iterator[tuple[int, list[int]]]:
    """Yield the numbers of files and the episodes in each, by the sizes of episodes and the most of a file [B]."""
    file, members, total = 0, list[int](), 0
    for k, size in enumerate(sizes):
        if members and total + size > most:
            yield file, members
            file, members, total = file + 1, [], 0
        members.append(k)
        total += size
    yield file, members


def _write_frames(out: Path, tables: Sequence[Any], rows: list[dict[str, Any]]) -> None:
    for file, members in _filed([table.nbytes for table in tables], DATA_MB * 10**6):
        chunk, place = divmod(file, CHUNK)
        path = out / data_path(chunk, place)
        path.parent.mkdir(parents=True, exist_ok=True)
        parquet.write_tables(path, [tables[k] for k in members])
        for k in members:
            rows[k] |= {"data/chunk_index": chunk, "data/file_index": place}


def _write_videos(out: Path, key: str, clips: Sequence[video_codec.Clip], rows: list[dict[str, Any]], fps: int) -> None:
    sizes = [sum(packet.size for _, packet in clip.packets(fps)) for clip in clips]
    for file, members in _filed(sizes, VIDEO_MB * 10**6):
        chunk, place = divmod(file, CHUNK)
        path = out / video_path(key, chunk, place)
        path.parent.mkdir(parents=True, exist_ok=True)
        video_codec.concatenate_clips(path, [clips[k] for k in members], fps=fps)
        first = 0
        for k in members:
            end = first + clips[k].count
            rows[k] |= {f"videos/{key}/chunk_index": chunk, f"videos/{key}/file_index": place}
            rows[k] |= {f"videos/{key}/from_timestamp": first / fps, f"videos/{key}/to_timestamp": end / fps}
            first = end


def _write_meta(
    out: Path, schema: Schema, rows: list[dict[str, Any]], sentences: list[str], stats: dict[str, Any]
) -> None:
    pa, _ = parquet.import_pyarrow()
    path = out / "meta/episodes/chunk-000/file-000.parquet"
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = [row | {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0} for row in rows]
    parquet.write_tables(path, [pa.Table.from_pylist(rows)])
    parquet.write_tables(out / "meta/tasks.parquet", [parquet.tasks_table(sentences)])
    _write_json(out / "meta/stats.json", stats)
    info = {
        "codebase_version": FORMAT,
        "robot_type": "panda" if schema.arms == 1 else "bi_panda",
        "total_episodes": len(rows),
        "total_frames": rows[-1]["dataset_to_index"],
        "total_tasks": len(sentences),
        "chunks_size": CHUNK,
        "data_files_size_in_mb": DATA_MB,
        "video_files_size_in_mb": VIDEO_MB,
        "fps": schema.fps,
        "splits": {"train": f"0:{len(rows)}"},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4" if schema.size else None,
        "features": schema.features,
    }
    _write_json(out / "meta/info.json", info)


def _write_json(path: Path, content: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=1, allow_nan=False, ensure_ascii=False) + "\n", encoding="utf-8")
