"""What is written is LeRobot's format v3.0, as read by pyarrow and av alone."""

from __future__ import annotations

import json
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

FPS = 50
CAMERAS = ("observation.images.front", "observation.images.wrist_right")


def test_files_and_description_are_those_of_the_format(made: Path) -> None:
    files = sorted(str(file.relative_to(made)) for file in made.rglob("*") if file.is_file())
    assert files == [
        "data/chunk-000/file-000.parquet",
        "meta/episodes/chunk-000/file-000.parquet",
        "meta/info.json",
        "meta/stats.json",
        "meta/tasks.parquet",
        "meta/torchdlo.json",
        *(f"videos/{camera}/chunk-000/file-000.mp4" for camera in CAMERAS),
    ]
    info = json.loads((made / "meta/info.json").read_text())
    assert set(info) == {
        "codebase_version", "robot_type", "total_episodes", "total_frames", "total_tasks", "chunks_size",
        "data_files_size_in_mb", "video_files_size_in_mb", "fps", "splits", "data_path", "video_path", "features",
    }  # fmt: skip
    assert info["codebase_version"] == "v3.0" and info["fps"] == FPS and info["splits"] == {"train": "0:5"}
    assert info["data_path"].format(chunk_index=0, file_index=0) == files[0]
    assert info["video_path"].format(video_key=CAMERAS[0], chunk_index=0, file_index=0) == files[6]
    wanted = {
        "observation.state": 15, "action": 6, "torchdlo.executed": 6, "torchdlo.target": 7, "torchdlo.joint_target": 7,
    }  # fmt: skip
    for name, size in wanted.items():
        what = info["features"][name]
        assert what["dtype"] == "float32" and what["shape"] == [size] and len(what["names"]) == size
    for name in ("timestamp", "frame_index", "episode_index", "index", "task_index", "next.reward", "next.success"):
        assert info["features"][name]["shape"] == [1] and info["features"][name]["names"] is None
    camera = info["features"][CAMERAS[0]]
    assert camera["shape"] == [32, 32, 3] and camera["info"]["video.codec"] == "h264"
    assert camera["info"]["is_depth_map"] is False and camera["info"]["video.fps"] == FPS


def test_frames_have_the_types_of_the_format(made: Path) -> None:
    file = pq.ParquetFile(made / "data/chunk-000/file-000.parquet")
    schema = file.schema_arrow
    assert schema.field("action").type == pa.list_(pa.float32(), 6)
    assert schema.field("observation.state").type == pa.list_(pa.float32(), 15)
    # Single numbers are no lists of one.
    assert schema.field("timestamp").type == pa.float32() and schema.field("next.success").type == pa.bool_()
    assert all(schema.field(n).type == pa.int64() for n in ("index", "episode_index", "frame_index", "task_index"))
    assert file.num_row_groups == 5 and file.metadata.row_group(0).column(0).compression == "SNAPPY"
    table = file.read().to_pydict()
    assert table["index"] == list(range(20)) and table["frame_index"] == [0, 1, 2, 3] * 5
    assert table["episode_index"] == [k for k in range(5) for _ in range(4)]
    assert np.array_equal(np.float32(table["timestamp"]), np.float32(np.array(table["frame_index"]) / FPS))
    assert table["next.done"] == [False, False, False, True] * 5 and all(table["next.success"][3::4])


def test_tasks_are_a_table_whose_index_is_the_sentence(made: Path) -> None:
    table = pq.read_table(made / "meta/tasks.parquet")
    assert table.schema.field("task_index").type == pa.int64() and table.schema.field("task").type == pa.string()
    about = json.loads(table.schema.metadata[b"pandas"])
    assert about["index_columns"] == ["task"] and [c["name"] for c in about["columns"]] == ["task_index", "task"]
    assert table["task_index"].to_pylist() == list(range(len(table)))
    assert table["task"].to_pylist() == ["Lead the first end of a short rope to the left of a place."]


def test_episodes_say_where_their_frames_and_pictures_are(made: Path) -> None:
    rows = pq.read_table(made / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    for k, row in enumerate(rows):
        assert row["episode_index"] == k and row["length"] == 4 and len(row["tasks"]) == 1
        assert (row["dataset_from_index"], row["dataset_to_index"]) == (4 * k, 4 * k + 4)
        assert row["data/chunk_index"] == row["data/file_index"] == row["meta/episodes/chunk_index"] == 0
        for camera in CAMERAS:
            assert row[f"videos/{camera}/file_index"] == 0
            ends = (row[f"videos/{camera}/from_timestamp"], row[f"videos/{camera}/to_timestamp"])
            assert ends == (4 * k / FPS, (4 * k + 4) / FPS)


def test_every_picture_is_exactly_at_its_time(made: Path) -> None:
    with av.open(str(made / f"videos/{CAMERAS[0]}/chunk-000/file-000.mp4")) as container:
        stream = container.streams.video[0]
        assert stream.average_rate == FPS and stream.codec_context.pix_fmt == "yuv420p"
        packets = [p for p in container.demux(stream) if p.pts is not None]
        # No reordering, and every other picture needs no other one.
        assert [p.pts * stream.time_base for p in packets] == [Fraction(k, FPS) for k in range(20)]
        assert all(p.pts == p.dts for p in packets) and all(p.is_keyframe for p in packets[::2])


def test_statistics_are_those_of_all_frames(made: Path) -> None:
    stats = json.loads((made / "meta/stats.json").read_text())
    table = pq.read_table(made / "data/chunk-000/file-000.parquet")
    for name in ("action", "observation.state", "next.reward", "timestamp"):
        x = np.array(table[name].to_pylist(), np.float64).reshape(20, -1)
        assert np.allclose(stats[name]["mean"], x.mean(0)) and np.allclose(stats[name]["std"], x.std(0))
        assert np.allclose(stats[name]["q01"], np.quantile(x, 0.01, axis=0)) and stats[name]["count"] == [20]
        assert np.allclose(stats[name]["max"], x.max(0)) and "q99" in stats[name]
    with av.open(str(made / f"videos/{CAMERAS[1]}/chunk-000/file-000.mp4")) as container:
        frames = np.stack([f.to_ndarray(format="rgb24") for f in container.decode(video=0)]) / 255
    own = stats[CAMERAS[1]]
    assert np.shape(own["mean"]) == (3, 1, 1) and np.allclose(np.ravel(own["mean"]), frames.mean((0, 1, 2)))
    assert np.allclose(np.ravel(own["std"]), frames.std((0, 1, 2)))
    assert np.allclose(np.ravel(own["min"]), frames.min((0, 1, 2)))
    for name, share in (("q01", 0.01), ("q50", 0.5), ("q99", 0.99)):
        wanted = np.quantile(frames.reshape(-1, 3), share, axis=0, method="inverted_cdf")
        assert np.allclose(np.ravel(own[name]), wanted)


def test_provenance_says_how_to_make_each_episode_again(made: Path) -> None:
    about = json.loads((made / "meta/torchdlo.json").read_text())
    assert about["plan"]["tasks"] == ["short"] and about["versions"]["torchdlo"]
    tried = about["attempts"]["short"]
    assert 0 < about["failures"]["short"] == tried - 5
    rows = about["episodes"]
    assert len(rows) == 5 and len({row["seed"] for row in rows}) == 5
    assert all(row["actions_from"] == "scripted demonstration" and row["return"] > 0 for row in rows)
    assert rows[-1]["attempt"] == tried - 1
