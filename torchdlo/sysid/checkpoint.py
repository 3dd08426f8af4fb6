"""What a long fit writes down, so that nothing is lost when it stops."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np

from torchdlo.errors import InputError
from torchdlo.files import write_atomically
from torchdlo.sysid.recording import Recording


class Checkpoint:
    """A file with the best numbers of each variant of a model."""

    def __init__(self, path: Path | None, recording: Recording, options: dict[str, Any], resume: bool) -> None:
        self.path = path
        digest = hashlib.sha256(json.dumps(options, sort_keys=True).encode())
        for trial in (*recording.train, *recording.test):
            digest.update(trial.markers.tobytes())
        self.content: dict[str, Any] = {"generator": "torchdlo calibrate", "key": digest.hexdigest(), "best": {}}
        if not resume:
            return
        if path is None or not path.exists():
            raise InputError(f"{path}: there is no checkpoint to resume from; run without --resume first.")
        try:
            found = json.loads(path.read_text())
            same = found["key"] == self.content["key"]
        except (ValueError, KeyError, TypeError):
            raise InputError(
                f"{path}: expected a checkpoint of torchdlo calibrate, found something else; run without --resume."
            ) from None
        if not same:
            raise InputError(
                f"{path}: the checkpoint belongs to another recording or other options; run without --resume."
            )
        self.content = found

    def recall(self, rest: str) -> list[float] | None:
        """Return the numbers kept for a variant."""
        return self.content["best"].get(rest)

    def keep(self, rest: str, values: np.ndarray) -> None:
        """Write numbers down."""
        self.content["best"][rest] = [float(v) for v in values]
        if self.path is not None:
            write_atomically(self.path, json.dumps(self.content))
