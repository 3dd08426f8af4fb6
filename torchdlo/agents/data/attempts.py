"""What a long export keeps while it is under way: one folder of finished files per attempt, renamed into place."""

from __future__ import annotations

import hashlib
import json
import os
import secrets
import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from torchdlo.agents.data import parquet, video_codec
from torchdlo.agents.data.dataset_schema import Schema
from torchdlo.agents.data.record import EpisodeRecording
from torchdlo.agents.data.statistics import channel_histogram
from torchdlo.files import write_atomically
from torchdlo.journal import read_json, write_json

__all__ = ["Attempt", "attempt_files", "read_attempt", "remove_unfinished", "write_attempt"]

RECORD, FRAMES = "attempt.json", "frames.parquet"
SUMS = "sums.json"
"""Hashes of an attempt's files, and of the plan that it belongs to."""


@dataclass(frozen=True)
class Attempt:
    """A finished attempt."""

    folder: Path
    record: dict[str, Any]

    @property
    def success(self) -> bool:
        """Whether it is an episode of the set."""
        return bool(self.record["success"])


def attempt_files(recording: EpisodeRecording, task: str, source: str, schema: Schema) -> dict[str, bytes]:
    """Return the files of an attempt by name.

    Pictures are decoded again after they are encoded: that proves that they can be, and statistics are of what readers
    see.
    """
    start = recording.start
    record = {
        "task": task,
        "told": start.told,
        "attempt": start.number,
        "seed": start.seed,
        "look_seed": start.part("look"),
        "offsets": recording.offsets,
        "actions_from": source,
        "success": recording.success,
        "failed": recording.failed,
        "return": recording.returned if np.isfinite(recording.returned) else None,
        "frames": len(recording.columns.get("next.reward", ())),
    }
    files = {}
    with tempfile.TemporaryDirectory(prefix="torchdlo-") as name:
        folder = Path(name)
        counts = {}
        for key, frames in recording.pictures.items():
            file = folder / f"{key}.mp4"
            video_codec.encode_video(file, frames, fps=schema.fps, codec=schema.codec)
            seen = video_codec.decode_video(file, fps=schema.fps, first=0, count=len(frames))
            counts[key] = channel_histogram(seen).tolist()
        if recording.success:
            parquet.write_tables(folder / FRAMES, [parquet.frame_table(recording.columns)])
        (folder / RECORD).write_text(json.dumps(record | {"histograms": counts}, allow_nan=False), encoding="utf-8")
        files = {file.name: file.read_bytes() for file in sorted(folder.iterdir())}
    return files


def write_attempt(folder: Path, files: Mapping[str, bytes], plan: str = "") -> None:
    """Write the files of an attempt at a plan so that its folder is complete as soon as it is there."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    temporary = folder.with_name(f".{secrets.token_hex(4)}-{folder.name}")
    try:
        temporary.mkdir()
        for name, content in files.items():
            write_atomically(temporary / name, content)
        sums = {name: hashlib.sha256(content).hexdigest() for name, content in files.items()}
        write_json(temporary / SUMS, {"plan": plan, "files": sums})
        os.rename(temporary, folder)
    except OSError as error:
        if error.errno is not None:
            raise OSError(error.errno, error.strerror, str(folder)) from error
        raise
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def remove_unfinished(folder: Path) -> None:
    """Remove what a run that was killed left half done."""
    for file in folder.glob("**/.*-*"):
        if file.is_dir():
            shutil.rmtree(file, ignore_errors=True)


def read_attempt(folder: Path, plan: str | None = None) -> Attempt | None:
    """Return the attempt at a plan, or at any, in a folder, None if there is none that is whole."""
    record = read_json(folder / RECORD)
    if record is None or "success" not in record:
        return None
    if not (folder / SUMS).exists():  # earlier versions had none
        return Attempt(folder, record)
    sums = read_json(folder / SUMS)
    try:
        if sums is None:
            return None
        whole = plan in (None, sums["plan"]) and RECORD in sums["files"]
        whole = whole and all(_hash(folder / name) == seal for name, seal in sums["files"].items())
    except (KeyError, TypeError, AttributeError, OSError):
        return None
    return Attempt(folder, record) if whole else None


def _hash(file: Path) -> str:
    with file.open("rb") as content:
        return hashlib.file_digest(content, "sha256").hexdigest()
