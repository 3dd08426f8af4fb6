"""Read a data set with LeRobot itself: every frame, at random, in windows, by a loader, merged, and in a training.

Run by `make lerobot` in an environment of its own, which has LeRobot and not torchdlo. Exit code 0: LeRobot takes it.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import random
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

os.environ |= {"HF_HUB_OFFLINE": "1", "HF_DATASETS_OFFLINE": "1"}


def main() -> None:
    """Go through all that is to be accepted."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("root", type=Path, help="the data set")
    parser.add_argument("--steps", type=int, default=3, help="of the training; 0 for none")
    given = parser.parse_args()
    root = given.root.resolve()
    with tempfile.TemporaryDirectory(prefix="lerobot-") as folder:
        os.environ["HF_HOME"] = folder
        read(root, Path(folder))
        if given.steps:
            train(root, Path(folder) / "out", given.steps)
    print("accepted")


def read(root: Path, folder: Path) -> None:
    """Load the set in all ways."""
    import torch
    from lerobot.datasets import LeRobotDataset
    from lerobot.datasets.dataset_tools import merge_datasets

    data = LeRobotDataset("local/set", root=root, video_backend="pyav")
    cameras = [name for name, what in data.meta.features.items() if what["dtype"] == "video"]
    said, every = set(), []
    for k in range(len(data)):
        frame = data[k]
        said.add(frame["task"])
        every.append([mark(frame[camera]) for camera in cameras])
    for k in random.Random(0).sample(range(len(data)), min(40, len(data))):
        again = data[k]
        assert int(again["index"]) == k and isinstance(again["task"], str)
        for camera, first in zip(cameras, every[k], strict=True):
            assert mark(again[camera]) == first, f"{camera}, frame {k}: another picture"
    print(f"{len(data)} frames, the same in random order; instructions: {sorted(said)[:3]}")
    window = {"action": [0, 1 / data.fps, 2 / data.fps], cameras[0]: [-1 / data.fps, 0]} if cameras else {}
    some = LeRobotDataset("local/set", root=root, video_backend="pyav", episodes=[0], delta_timestamps=window)
    assert some[1]["action"].shape[0] == 3 and mark(some[1][cameras[0]][0]) == every[0][0]
    batch = next(iter(torch.utils.data.DataLoader(data, batch_size=8)))
    print("windows and loader:", {name: tuple(x.shape) for name, x in batch.items() if name in ("action", *cameras)})
    whole = merge_datasets([data, data], output_repo_id="local/two", output_dir=folder / "two")
    assert len(whole) == 2 * len(data)
    for k in (0, len(data) - 1, len(data), len(whole) - 1):
        assert mark(whole[k][cameras[0]]) == every[k % len(data)][0], f"after merging, frame {k} is another picture"
    print("merged:", len(whole))


def mark(picture: Any) -> str:
    """Return what tells a picture from others, without keeping it: a large set would not fit into memory."""
    return hashlib.sha256(picture.contiguous().numpy().tobytes()).hexdigest()


def train(root: Path, out: Path, steps: int) -> None:
    """Train ACT for some steps on the processor."""
    command = [str(Path(sys.executable).with_name("lerobot-train")), "--policy.type=act", "--policy.device=cpu"]
    command += ["--policy.pretrained_backbone_weights=null", "--policy.chunk_size=20", "--policy.n_action_steps=20"]
    command += [f"--dataset.root={root}", "--dataset.repo_id=local/set", "--dataset.video_backend=pyav"]
    command += ["--batch_size=4", "--num_workers=0", "--policy.push_to_hub=false", "--log_freq=1"]
    command += [f"--steps={steps}", f"--output_dir={out}", "--save_checkpoint=false", "--wandb.enable=false"]
    subprocess.run(command, check=True)


if __name__ == "__main__":
    main()
