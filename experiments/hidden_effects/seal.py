"""Answers are sealed by their hashes before a diagnosis sees a recording, so that nobody can change them afterwards."""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Sequence
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parents[1]))

from options import save

FILE = "seal.json"
"""The file with the hashes, in the folder of the findings."""


def hash_of(answers: Path, name: str) -> str:
    """Return the hash of a recording's answer."""
    return hashlib.sha256((answers / f"{name}.json").read_bytes()).hexdigest()


def seal(answers: Path, out: Path, names: Sequence[str]) -> str:
    """Seal the answers of recordings that are neither sealed nor diagnosed; return one hash of all that are sealed."""
    sealed = read(out)
    for name in names:
        if name not in sealed and not (out / name / "findings.json").exists():
            sealed[name] = hash_of(answers, name)
    save(str(out / FILE), sealed)
    return hashlib.sha256(json.dumps(sealed, sort_keys=True).encode()).hexdigest()


def read(out: Path) -> dict[str, str]:
    """Return the hashes of answers by recording; none where nothing was sealed."""
    return json.loads((out / FILE).read_text()) if (out / FILE).exists() else {}


def kept(answers: Path, out: Path, name: str) -> bool:
    """Return whether a recording's answer was sealed before it was diagnosed.

    Raises:
        SystemExit: It was changed since.
    """
    sealed = read(out).get(name)
    if sealed is None:
        return False
    if sealed != hash_of(answers, name):
        raise SystemExit(
            f"{answers / name}.json: its hash is not the one in {out / FILE}: the answer was changed after it had been "
            "sealed; make the recordings anew and diagnose them again"
        )
    return True
