"""What a long export keeps while it is under way: one folder of finished files per attempt, renamed into place."""

from __future__ import annotations

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

from torchdlo.agents.data import parquet, video
from torchdlo.agents.data.record import Recording
from torchdlo.agents.data.schema import Schema
from torchdlo.agents.data.statistics import histogram
from torchdlo.errors import InputError
from torchdlo.untrusted import MissingFile, read_entry

__all__ = ["Attempt", "keep", "load", "packed", "sweep"]

RECORD, FRAMES = "attempt.json", "frames.parquet"


@dataclass(frozen=True)
class Attempt:
    """A finished attempt."""

    folder: Path
    record: dict[str, Any]

    @property
    def success(self) -> bool:
        """Whether it is an episode of the set."""
        return bool(self.record["success"])


def packed(recording: Recording, task: str, source: str, schema: Schema) -> dict[str, bytes]:
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
            video.encode(file, frames, fps=schema.fps, codec=schema.codec)
            seen = video.decode(file, fps=schema.fps, first=0, count=len(frames))
            counts[key] = histogram(seen).tolist()
        if recording.success:
            parquet.write_tables(folder / FRAMES, [parquet.frame_table(recording.columns)])
        (folder / RECORD).write_text(json.dumps(record | {"histograms": counts}, allow_nan=False), encoding="utf-8")
        files = {file.name: file.read_bytes() for file in sorted(folder.iterdir())}
    return files


def keep(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write the files of an attempt so that its folder is complete as soon as it is there."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    temporary = folder.with_name(f".{secrets.token_hex(4)}-{folder.name}")
    try:
        temporary.mkdir()
        for name, content in files.items():
            (temporary / name).write_bytes(content)
        os.rename(temporary, folder)
    except OSError as error:
        if error.errno is not None:
            raise OSError(error.errno, error.strerror, str(folder)) from error
        raise
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def sweep(folder: Path) -> None:
    """Remove what a run that was killed left half done."""
    for file in folder.glob("**/.*-*"):
        if file.is_dir():
            shutil.rmtree(file, ignore_errors=True)


def load(folder: Path) -> Attempt | None:
    """Return the attempt in a folder, or None if there is none."""
    file = folder / RECORD
    try:
        return Attempt(folder, read_entry(file, "the record of an attempt").object())
    except MissingFile:
        return None
    except InputError as error:
        raise InputError(f"{error} Remove {folder} and --resume.") from None
