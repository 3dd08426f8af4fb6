"""What an exported data set holds: the columns of a frame and the layout of its files (LeRobot data set v3.0).

A name that begins with `action` is what policies put out and one that begins with `observation` what they take in, so
everything else is called `next.` or `torchdlo.` something. The set is as wide as the task with the most arms: what an
arm that is not there would say is 0, and what its camera would see is black.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from torchdlo.envs.observations.cameras import SIDES
from torchdlo.errors import InputError

__all__ = ["CODECS", "DEFAULTS", "JOINTS", "SIDES", "STATE", "Schema", "camera_names", "data_path", "video_path"]

FORMAT = "v3.0"
"""Version of the layout."""
CHUNK = 1000
"""Files in a folder."""
DATA_MB, VIDEO_MB = 100, 200
"""Size of a file from which on the next episode begins another one [MB]."""
JOINTS = 7
POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")
STATE = (*(f"joint_{k}" for k in range(JOINTS)), "opening", *POSE)
"""What is known of an arm: joints [rad], distance of the fingers [m], pose of the tool [m] and [1]."""
DEFAULTS = {"timestamp": "float32", "frame_index": "int64", "episode_index": "int64", "index": "int64"}
"""Columns that every set has, beside `task_index`."""
CODECS = {"h264": ("libx264", "h264"), "av1": ("libsvtav1", "av1")}
"""Encoder, and the name by which readers know what it makes."""
GROUP = 2
"""Distance of pictures that are decoded without others: near, as readers jump."""


def camera_names(arms: int) -> tuple[str, ...]:
    """Return the names of the cameras of a set."""
    return ("front", *(f"wrist_{side}" for side in SIDES[:arms]))


@dataclass(frozen=True)
class Schema:
    """What the frames of a set are like."""

    arms: int
    """Arms of the task that has the most."""
    size: int
    """Width and height of pictures [px]; 0 for a set without pictures."""
    fps: int = 50
    """Frames per second: an action lasts 20 ms."""
    codec: str = "h264"

    def __post_init__(self) -> None:
        if not 1 <= self.arms <= len(SIDES):
            raise InputError(f"arms: a data set has 1 or {len(SIDES)} of them, given {self.arms}.")
        if self.size and (self.size % 2 or not 16 <= self.size <= 1024):
            raise InputError(f"size: expected an even number of pixels from 16 to 1024, or 0, given {self.size}.")
        if self.codec not in CODECS:
            raise InputError(f"codec: expected one of {', '.join(CODECS)}, given {self.codec!r}.")

    @property
    def vectors(self) -> dict[str, list[str]]:
        """Names of the components of every column that is a vector."""
        arms = SIDES[: self.arms]
        action = [f"{side}_d{axis}" for side in arms for axis in "xyz"]
        action += [f"{side}_d{axis}" for side in arms for axis in ("roll", "pitch", "yaw")]
        return {
            "observation.state": [f"{side}_{name}" for side in arms for name in STATE],
            "action": action,
            "torchdlo.executed": action,
            "torchdlo.target": [f"{side}_{name}" for side in arms for name in POSE],
            "torchdlo.joint_target": [f"{side}_joint_{k}" for side in arms for k in range(JOINTS)],
        }

    @property
    def scalars(self) -> dict[str, str]:
        """Types of the columns that are single numbers, beside `DEFAULTS`."""
        return {"next.reward": "float32", "next.success": "bool", "next.done": "bool"}

    @property
    def pictures(self) -> tuple[str, ...]:
        """Columns that are pictures."""
        return tuple(f"observation.images.{name}" for name in camera_names(self.arms)) if self.size else ()

    @property
    def features(self) -> dict[str, dict[str, Any]]:
        """The columns as `meta/info.json` declares them."""
        found: dict[str, dict[str, Any]] = {
            name: {"dtype": "float32", "shape": [len(parts)], "names": parts} for name, parts in self.vectors.items()
        }
        scalars = self.scalars | DEFAULTS | {"task_index": "int64"}
        found |= {name: {"dtype": kind, "shape": [1], "names": None} for name, kind in scalars.items()}
        return found | {name: self._picture() for name in self.pictures}

    def _picture(self) -> dict[str, Any]:
        info = {
            "video.height": self.size,
            "video.width": self.size,
            "video.codec": CODECS[self.codec][1],
            "video.pix_fmt": "yuv420p",
            "is_depth_map": False,
            "video.fps": self.fps,
            "video.channels": 3,
            "video.g": GROUP,
            "has_audio": False,
        }
        names = ["height", "width", "channels"]
        return {"dtype": "video", "shape": [self.size, self.size, 3], "names": names, "info": info}


def data_path(chunk: int, file: int) -> str:
    """Return where a file of frames is in a set."""
    return f"data/chunk-{chunk:03d}/file-{file:03d}.parquet"


def video_path(key: str, chunk: int, file: int) -> str:
    """Return where a file of pictures is in a set."""
    return f"videos/{key}/chunk-{chunk:03d}/file-{file:03d}.mp4"
