"""What a long fit writes down, so that nothing is lost when it stops."""

from __future__ import annotations

import json
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from torchdlo.errors import InputError
from torchdlo.files import write_atomically
from torchdlo.sysid.estimation.result_cache import digest
from torchdlo.sysid.recordings.recording import Recording
from torchdlo.untrusted import read_entry


class Checkpoint:
    """A file with the best numbers of each variant of a model."""

    def __init__(self, path: Path | None, recording: Recording, options: dict[str, Any], resume: bool) -> None:
        self.path = path
        measured = {f.name: getattr(recording, f.name) for f in fields(recording) if f.name != "path"}
        self.content: dict[str, Any] = {"generator": "torchdlo calibrate", "key": digest(measured, options), "best": {}}
        if not resume:
            return
        if path is None or not path.exists():
            raise InputError(f"{path}: there is no checkpoint to resume from; run without --resume first.")
        found = read_entry(path, "a checkpoint of torchdlo calibrate")
        if found.object().keys() != self.content.keys():
            raise InputError(
                f"{path}: expected a checkpoint of torchdlo calibrate, found something else; run without --resume."
            )
        for name in found["best"].object():
            found["best"][name].numbers(None)
        if found["key"].text() != self.content["key"]:
            raise InputError(
                f"{path}: the checkpoint belongs to another recording or other options; run without --resume."
            )
        self.content = found.object()

    def recall(self, rest: str) -> list[float] | None:
        """Return the numbers kept for a variant."""
        return self.content["best"].get(rest)

    def keep(self, rest: str, values: np.ndarray) -> None:
        """Write numbers down."""
        self.content["best"][rest] = [float(v) for v in values]
        if self.path is not None:
            write_atomically(self.path, json.dumps(self.content))
