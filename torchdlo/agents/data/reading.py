"""Reading data sets: what is in them, their frames as arrays, tensors or tensordicts, and their pictures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from torchdlo.agents.data import parquet, video_codec
from torchdlo.agents.data.build import PROVENANCE
from torchdlo.agents.data.dataset_schema import FORMAT, data_path, video_path
from torchdlo.errors import InputError
from torchdlo.untrusted import Entry, read_json

__all__ = ["DataSet", "FrameData", "open_set", "to_tensordict"]


@dataclass(frozen=True, eq=False)
class DataSet:
    """A data set on a disk. Tables are read when they are asked for."""

    path: Path
    info: dict[str, Any]
    tasks: tuple[str, ...]
    """Instructions by their numbers."""
    episodes: list[dict[str, Any]] = field(repr=False)
    """The table of episodes, a row each."""

    @property
    def fps(self) -> int:
        """Frames per second."""
        return self.info["fps"]

    @property
    def features(self) -> dict[str, dict[str, Any]]:
        """The columns as the set declares them."""
        return self.info["features"]

    @property
    def cameras(self) -> tuple[str, ...]:
        """Columns that are videos."""
        return tuple(name for name, what in self.features.items() if what["dtype"] == "video")

    @property
    def provenance(self) -> dict[str, Any]:
        """How it was made; {} for sets of other programs."""
        file = self.path / PROVENANCE
        return json_file(file) if file.is_file() else {}

    @property
    def stats(self) -> dict[str, Any]:
        """Statistics of the columns."""
        return json_file(self.path / "meta/stats.json")

    def files(self) -> list[tuple[int, int]]:
        """Return the numbers of the files of frames, in order."""
        return list(dict.fromkeys((row["data/chunk_index"], row["data/file_index"]) for row in self.episodes))

    def columns(self) -> dict[str, np.ndarray]:
        """Return all columns but pictures, shape (N,) or (N, D)."""
        tables = [parquet.read_table(self.path / data_path(*numbers)) for numbers in self.files()]
        names = [name for name, what in self.features.items() if what["dtype"] != "video"]
        return {name: np.concatenate([column_array(t, name, self.path) for t in tables]) for name in names}

    def clip(self, episode: int, camera: str) -> video_codec.Clip:
        """Return where the pictures of an episode are."""
        row = self.episodes[episode]
        numbers = (row[f"videos/{camera}/chunk_index"], row[f"videos/{camera}/file_index"])
        first = round(row[f"videos/{camera}/from_timestamp"] * self.fps)
        return video_codec.Clip(self.path / video_path(camera, *numbers), first, row["length"])

    def pictures(self, episode: int, camera: str, first: int = 0, count: int | None = None) -> Iterator[np.ndarray]:
        """Yield pictures of an episode (H, W, 3), 8 bits, from a frame on."""
        clip = self.clip(episode, camera)
        most = clip.count - first if count is None else count
        return video_codec.decode_video(clip.path, fps=self.fps, first=clip.first + first, count=most)


def json_file(file: Path) -> dict[str, Any]:
    """Return the object in a JSON file."""
    content = read_json(file, "a file of a LeRobot data set", cure=f"is {file.parent.parent} one?", finite=False)
    if not isinstance(content, dict):
        raise InputError(f"{file}: expected an object, found {type(content).__name__}.")
    return content


def column_array(table: Any, name: str, where: Path) -> np.ndarray:
    """Return a column as an array, shape (N,) or (N, D)."""
    if name not in table.column_names:
        raise InputError(f"{where}: the frames have no column {name!r}, which meta/info.json declares.")
    column = table.column(name).combine_chunks()
    if hasattr(column.type, "list_size"):
        return column.flatten().to_numpy(zero_copy_only=False).reshape(len(column), column.type.list_size)
    return column.to_numpy(zero_copy_only=False)


def _check_info(info: Entry) -> None:
    """Check types of what everything else reads without asking."""
    info["fps"].number(1e-3, 1e6, "1/s")
    for name in ("total_episodes", "total_frames"):
        info[name].whole(0)
    for name in info["features"].object():
        said = info["features"][name]
        said["dtype"].text(most=100)
        for size in said["shape"].items(10):
            size.whole(0, 10**9)


def open_set(path: Path) -> DataSet:
    """Open a data set.

    Raises:
        InputError: There is none, it is of another version, or its description is damaged.
    """
    path = Path(path)
    info = json_file(path / "meta/info.json")
    version = str(info.get("codebase_version"))
    if version.split(".")[0] != FORMAT.split(".")[0]:
        raise InputError(
            f"{path}: it is a data set of version {version}; expected {FORMAT}: convert it with the tools of LeRobot."
        )
    missing = {"features", "fps", "total_episodes", "total_frames"} - info.keys()
    if missing:
        raise InputError(f"{path}/meta/info.json: lacks {', '.join(sorted(missing))}; it is damaged.")
    _check_info(Entry(info, f"{path}/meta/info.json", "", "the description of a LeRobot data set"))
    table = parquet.read_table(path / "meta/tasks.parquet")
    if not {"task", "task_index"} <= set(table.column_names):
        raise InputError(
            f"{path}/meta/tasks.parquet: expected columns task and task_index, found {table.column_names}."
        )
    rows = sorted(table.select(["task_index", "task"]).to_pylist(), key=lambda row: row["task_index"])
    files = sorted((path / "meta/episodes").glob("chunk-*/file-*.parquet"))
    if not files:
        raise InputError(f"{path}/meta/episodes: the table of episodes is missing.")
    episodes = [row for file in files for row in parquet.read_table(file).to_pylist()]
    return DataSet(path, info, tuple(row["task"] for row in rows), episodes)


def _tensor(x: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(x))


def to_tensordict(data: DataSet, *, pictures: bool = True, episodes: Sequence[int] | None = None) -> TensorDict:
    """Return a set as a tensordict of N frames, as TorchRL's replay buffers take it.

    Names that have dots become nested keys, `next.reward` for instance ("next", "reward") of shape (N, 1). It also has
    ("next", "observation", ...), `terminated` and `truncated`, and the number of its episode under "episode". Pictures
    are 8 bits, channels first, shape (N, 3, H, W).

    Args:
        data: the set.
        pictures: whether to read these too; they take 49 kB each at 128 pixels.
        episodes: which ones; all if not given.
    """
    columns, chosen = data.columns(), list(range(len(data.episodes))) if episodes is None else list(episodes)
    rows = [np.flatnonzero(columns["episode_index"] == k) for k in chosen]
    at = np.concatenate(rows)
    found: dict[tuple[str, ...], Tensor] = {}
    for name, values in columns.items():
        x = _tensor(values[at])
        found[_key(name)] = x if x.dim() > 1 else x[:, None]
    for camera in data.cameras if pictures else ():
        shots = [np.stack(list(data.pictures(k, camera))) for k in chosen]
        found[_key(camera)] = _tensor(np.concatenate(shots)).movedim(-1, 1).contiguous()
    # What is seen after an action is what is seen before the next; of the last frame nothing later is known.
    later = torch.arange(1, len(at) + 1)
    ends = torch.as_tensor(np.cumsum([len(r) for r in rows])) - 1
    later[ends] = ends
    for key in [key for key in found if key[0] == "observation"]:
        found["next", *key] = found[key][later]
    success, done = found["next", "success"], found["next", "done"]
    found["next", "terminated"] = done & success
    found["next", "truncated"] = done & ~success
    found["episode",] = found.pop(("episode_index",))
    return TensorDict(_nested(found), batch_size=[len(at)])


def _key(name: str) -> tuple[str, ...]:
    return tuple(name.split("."))


def _nested(flat: dict[tuple[str, ...], Tensor]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in flat.items():
        place = found
        for part in key[:-1]:
            place = place.setdefault(part, {})
        place[key[-1]] = value
    return found


class FrameData(torch.utils.data.Dataset):
    """A set as a data set of PyTorch: a dictionary of tensors per frame, with what comes after it if asked for.

    Pictures are 8 bits, channels first, (3, H, W); decoding begins at the frame that is asked for.
    """

    def __init__(self, path: Path, *, pictures: bool = True, ahead: dict[str, int] | None = None) -> None:
        """Open a set.

        Args:
            path: its folder.
            pictures: whether to return pictures.
            ahead: for columns how many frames to return, from this one on, such as {"action": 20}; after the end of the
                episode its last is repeated, and `NAME_is_pad` says so.
        """
        self.data = open_set(path)
        self.ahead, self.cameras = ahead or {}, self.data.cameras if pictures else ()
        self._columns = {name: _tensor(x) for name, x in self.data.columns().items()}
        unknown = self.ahead.keys() - self._columns.keys()
        if unknown:
            raise InputError(f"{path}: has no column {', '.join(sorted(unknown))}; it has {', '.join(self._columns)}.")
        self._ends = {row["episode_index"]: row["dataset_to_index"] for row in self.data.episodes}

    def __len__(self) -> int:
        return len(self._columns["index"])

    def __getitem__(self, k: int) -> dict[str, Any]:
        if not -len(self) <= k < len(self):
            raise IndexError(k)
        k %= len(self)
        found: dict[str, Any] = {name: x[k] for name, x in self._columns.items()}
        episode = int(found["episode_index"])
        for name, count in self.ahead.items():
            wanted = torch.arange(k, k + count)
            last = self._ends[episode] - 1
            found[name] = self._columns[name][wanted.clamp(max=last)]
            found[f"{name}_is_pad"] = wanted > last
        for camera in self.cameras:
            (image,) = self.data.pictures(episode, camera, int(found["frame_index"]), 1)
            found[camera] = _tensor(image).movedim(-1, 0)
        found["task"] = self.data.tasks[int(found["task_index"])]
        return found
