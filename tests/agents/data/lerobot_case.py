"""A data set out of formulas that LeRobot has read, trained on and merged (`make lerobot`): its bytes are recorded."""

from __future__ import annotations

import hashlib
import json
import sys
import tempfile
from pathlib import Path

import numpy as np

from torchdlo.agents.data import video_codec
from torchdlo.agents.data.build import DatasetEpisode, write_dataset
from torchdlo.agents.data.dataset_schema import Schema
from torchdlo.agents.data.statistics import channel_histogram

RECORD = Path(__file__).with_name("lerobot_case.json")
LENGTH, SIZE = 100, 128


def make(out: Path) -> None:
    """Write the set: two arms, three episodes, two instructions."""
    schema = Schema(arms=2, size=SIZE)
    with tempfile.TemporaryDirectory() as folder:
        episodes = [_episode(schema, k, Path(folder)) for k in range(3)]
        write_dataset(out, schema, episodes, {"generator": "torchdlo tests"})


def _episode(schema: Schema, k: int, folder: Path) -> DatasetEpisode:
    at = np.arange(LENGTH)[:, None]
    # Quarters are exact in binary, so that no processor rounds their sums otherwise.
    columns = {
        name: (((at * (c + 3) + np.arange(len(parts)) * 5 + 7 * k) % 16) / 4).astype(np.float32)
        for c, (name, parts) in enumerate(schema.vectors.items())
    }
    last = at[:, 0] == LENGTH - 1
    columns |= {"next.reward": (at[:, 0] / 4).astype(np.float32), "next.success": last, "next.done": last}
    clips, counts = {}, {}
    for c, key in enumerate(schema.pictures):
        frames = np.zeros((LENGTH, SIZE, SIZE, 3), np.uint8)
        frames[..., 0] = np.arange(SIZE)
        frames[..., 1] = 40 * k + 30 * c
        for t in range(LENGTH):
            frames[t, 16:32, t : t + 16] = (230, 200, 40)
        path = folder / f"{k}-{key}.mp4"
        video_codec.encode_video(path, frames, fps=schema.fps, codec=schema.codec)
        clips[key] = video_codec.Clip(path, 0, LENGTH)
        counts[key] = channel_histogram(video_codec.decode_video(path, fps=schema.fps))
    told = ("Coil the rope to the left.", "Coil the rope to the right.")[k % 2]
    return DatasetEpisode(told, LENGTH, lambda: dict(columns), clips, lambda: counts, {"task": "formula", "seed": k})


def hashes(folder: Path) -> dict[str, str]:
    """Return the hash of every file."""
    files = sorted(file for file in folder.rglob("*") if file.is_file())
    return {str(file.relative_to(folder)): hashlib.sha256(file.read_bytes()).hexdigest() for file in files}


def versions() -> dict[str, str]:
    """Return the versions of what writes bytes."""
    import av
    import pyarrow

    return {"pyarrow": pyarrow.__version__, "av": av.__version__}


if __name__ == "__main__":
    make(Path(sys.argv[1]))
    if "--record" in sys.argv:
        content = {"accepted_by": sys.argv[sys.argv.index("--record") + 1], "versions": versions()}
        RECORD.write_text(json.dumps(content | {"files": hashes(Path(sys.argv[1]))}, indent=1) + "\n")
