"""What a calibration writes down, so that nothing is lost when it stops.

A calibration that is run again asks for the same steps in the same order, and comes to where it was stopped by reading
instead of computing: to the last bit as if never stopped.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from torchdlo.errors import InputError
from torchdlo.journal import read_json, write_json
from torchdlo.sysid.estimation.result_cache import decode, digest, encode, program
from torchdlo.sysid.recordings.recording import Recording
from torchdlo.untrusted import Entry

__all__ = ["Checkpoint"]

T = TypeVar("T")


class Checkpoint:
    """A file with the results of steps, and the best numbers of each variant of a model."""

    def __init__(self, path: Path | None, recording: Recording, options: dict[str, Any], resume: bool) -> None:
        self.path = path
        measured = {f.name: getattr(recording, f.name) for f in fields(recording) if f.name != "path"}
        key = digest(measured, options)
        self.content: dict[str, Any] = {"generator": "torchdlo calibrate", "key": key, "program": program()}
        if resume:
            self._resume()
        for part in ("best", "steps"):
            self.content.setdefault(part, {})

    def _resume(self) -> None:
        if self.path is None or not self.path.exists():
            raise InputError(f"{self.path}: there is no checkpoint to resume from; run without --resume first.")
        found = read_json(self.path)
        if found is None or "key" not in found or not isinstance(found.get("best"), dict):
            raise InputError(
                f"{self.path}: expected a checkpoint of torchdlo calibrate, found something else, or a damaged one; "
                "run without --resume."
            )
        for values in found["best"].values():
            Entry(values, str(self.path), "best", "a checkpoint of torchdlo calibrate").numbers(None, most=1e300)
        if found["key"] != self.content["key"]:
            raise InputError(
                f"{self.path}: the checkpoint belongs to another recording or other options; run without --resume."
            )
        # Steps of another version are not those of this one; its best numbers are as good a start as any.
        same = found.get("program") == self.content["program"]
        self.content |= {"best": found["best"], "steps": found.get("steps", {}) if same else {}}

    def recall(self, rest: str) -> list[float] | None:
        """Return the numbers kept for a variant whose steps are not."""
        steps = any(name.startswith(f"{rest}:") for name in self.content["steps"])
        return None if steps else self.content["best"].get(rest)

    def once(self, rest: str, step: str, compute: Callable[[], T]) -> T:
        """Return the result of a step of a variant, which is computed unless it is written down."""
        name = f"{rest}: {step}"
        kept = self.content["steps"].get(name)
        if kept is not None:
            return _unpacked(kept)
        found = compute()
        self.content["steps"][name] = _packed(found)
        self._write()
        return found

    def keep(self, rest: str, values: np.ndarray) -> None:
        """Write numbers down."""
        self.content["best"][rest] = [float(v) for v in values]
        self._write()

    def _write(self) -> None:
        if self.path is not None:
            write_json(self.path, self.content, indent=None)


def _packed(value: Any) -> dict[str, Any]:
    arrays: list[np.ndarray] = []
    plain = encode(value, arrays)
    packed = [[a.dtype.str, a.shape, base64.b64encode(np.ascontiguousarray(a).tobytes()).decode()] for a in arrays]
    # As text: what is not finite is no JSON of the standard, and texts are hashed faster.
    return {"plain": json.dumps(plain), "arrays": packed}


def _unpacked(kept: dict[str, Any]) -> Any:
    arrays = {
        f"a{k}": np.frombuffer(base64.b64decode(data), dtype).reshape(shape).copy()
        for k, (dtype, shape, data) in enumerate(kept["arrays"])
    }
    return decode(json.loads(kept["plain"]), arrays)
