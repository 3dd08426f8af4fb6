"""Damaged sets are named, and readers and edits of sound ones keep every frame."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from short_task import Dots, plan

from torchdlo.agents.data import (
    Choice,
    FrameData,
    check_dataset,
    merge_datasets,
    open_set,
    select_episodes,
    to_tensordict,
)
from torchdlo.agents.data.making import make_dataset
from torchdlo.cli import app
from torchdlo.errors import InputError

FRONT = "observation.images.front"


def changed(path: Path, **values: object) -> None:
    """Change entries of a JSON file."""
    path.write_text(json.dumps(json.loads(path.read_text()) | values))


def frames(own: Path, **columns: object) -> None:
    """Change columns of the frames."""
    file = own / "data/chunk-000/file-000.parquet"
    table = pq.read_table(file)
    for name, values in columns.items():
        name = name.replace("__", ".")
        table = table.set_column(table.column_names.index(name), name, pa.array(values))
    pq.write_table(table, file)


def test_a_sound_set_has_no_faults(made: Path) -> None:
    assert check_dataset(made) == []


def test_each_fault_is_named(own: Path) -> None:
    (problem,) = check_dataset(own / "nowhere")
    assert "info.json: expected a file of a LeRobot data set, found none" in problem
    frames(own, index=np.arange(1, 21))
    assert "the column index has 1 in frame 0; expected no gaps" in check_dataset(own)[0]
    frames(own, index=np.arange(20), timestamp=np.float32(np.arange(20) / 50))
    assert any("timestamp is 0.07" in x or "timestamp is 0.08" in x for x in check_dataset(own))


def test_wrong_statistics_types_and_counts_are_named(own: Path) -> None:
    stats = json.loads((own / "meta/stats.json").read_text())
    stats["action"]["q99"][0] += 0.1
    stats[FRONT]["mean"][0][0][0] += 0.01
    (own / "meta/stats.json").write_text(json.dumps(stats))
    first, second = check_dataset(own)
    assert "q99 of action is" in first and f"mean of {FRONT} is" in second
    changed(own / "meta/info.json", total_frames=21, total_episodes=6)
    assert any("total_frames is 21; the tables have 20" in x for x in check_dataset(own))
    changed(own / "meta/info.json", total_frames=20, total_episodes=5)
    frames(own, next__reward=np.zeros(20, np.float64))
    assert any("'next.reward' is of type double" in x for x in check_dataset(own))


def test_damaged_files_are_named(own: Path) -> None:
    video = own / f"videos/{FRONT}/chunk-000/file-000.mp4"
    whole = video.read_bytes()
    video.write_bytes(whole[: len(whole) // 2])
    problems = check_dataset(own)
    assert problems and all(FRONT in x for x in problems) and "file-000.mp4" in problems[0]
    video.unlink()
    assert any("the video is missing" in x for x in check_dataset(own))
    video.write_bytes(whole)
    assert check_dataset(own) == []
    file = own / "data/chunk-000/file-000.parquet"
    file.write_bytes(file.read_bytes()[:-100])
    (problem,) = check_dataset(own)
    assert "damaged and cannot be read" in problem and len(problem.splitlines()) == 1
    (own / "meta/tasks.parquet").write_bytes(b"PAR1")
    assert "tasks.parquet: it is damaged" in check_dataset(own)[0]


def test_sets_of_other_versions_are_refused(own: Path) -> None:
    changed(own / "meta/info.json", codebase_version="v2.1")
    with pytest.raises(InputError, match=r"it is a data set of version v2.1; expected v3.0"):
        open_set(own)
    assert cli_code("check", own) == 1 and cli_code("info", own) == 2


def cli_code(*words: object) -> int:
    """Exit code of the command."""
    try:
        app.main(["dataset", *map(str, words)])
    except SystemExit as end:
        return int(end.code or 0)
    return 0


def test_commands_say_what_is_in_a_set(made: Path, own: Path, capsys) -> None:
    assert cli_code("check", made, "--json") == 0
    assert json.loads(capsys.readouterr().out)["problems"] == []
    assert cli_code("info", made, "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["episodes"] == 5 and found["tasks"]["short"]["failed"] > 0
    (own / "meta/stats.json").unlink()
    assert cli_code("check", own) == 1
    said = capsys.readouterr()
    assert "stats.json: expected a file of a LeRobot data set, found none" in said.out and "1 problem" in said.err


def test_merged_and_filtered_sets_hold_the_same_frames(made: Path, tmp_path: Path) -> None:
    assert merge_datasets([made, made], tmp_path / "two") == 10 and check_dataset(tmp_path / "two") == []
    assert select_episodes(tmp_path / "two", tmp_path / "some", Choice(episodes=(1, 8))) == 2
    assert check_dataset(tmp_path / "some") == []
    data, some = open_set(made), open_set(tmp_path / "some")
    a, b = data.columns(), some.columns()
    for k, source in enumerate((1, 3)):
        assert np.array_equal(b["action"][b["episode_index"] == k], a["action"][a["episode_index"] == source])
        for one, other in zip(some.pictures(k, FRONT), data.pictures(source, FRONT), strict=True):
            assert np.array_equal(one, other)
    assert [row["from"] for row in some.provenance["episodes"]] == [["two", 1], ["two", 8]]
    assert select_episodes(made, tmp_path / "few", Choice(tasks=("short",), limit=2)) == 2
    with pytest.raises(InputError, match="has no task 'long'; it has"):
        select_episodes(made, tmp_path / "x", Choice(tasks=("long",)))
    with pytest.raises(InputError, match="no episode is left"):
        select_episodes(made, tmp_path / "x", Choice(least_return=1e6))
    with pytest.raises(InputError, match="it exists already"):
        merge_datasets([made], tmp_path / "two")


def test_sets_that_differ_are_not_merged(made: Path, tmp_path: Path) -> None:
    make_dataset(plan(episodes=1, size=16), tmp_path / "smaller", painter=Dots())
    with pytest.raises(InputError, match=r"pictures of 16 px in h264.* only sets that are alike can be merged"):
        merge_datasets([made, tmp_path / "smaller"], tmp_path / "two")
    assert not list(tmp_path.glob("*two*"))


def test_tensordicts_tell_what_came_after(made: Path) -> None:
    td = to_tensordict(open_set(made), episodes=[1, 3])
    assert td.batch_size == (8,) and td["observation", "state"].shape == (8, 15)
    assert td["observation", "images", "front"].dtype == torch.uint8
    assert td["next", "reward"].shape == (8, 1) and td["next", "done"].squeeze(-1).tolist() == [False] * 3 + [True] + [
        False
    ] * 3 + [True]
    now, later = td["observation", "state"], td["next", "observation", "state"]
    assert torch.equal(later[:3], now[1:4]) and torch.equal(later[3], now[3]) and torch.equal(later[4:7], now[5:])
    assert td["next", "terminated"].sum() == 2 and not td["next", "truncated"].any()
    assert td["episode"].unique().tolist() == [1, 3]
    from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(8), batch_size=4)
    buffer.extend(td)
    assert buffer.sample()["action"].shape == (4, 6)


def test_frames_come_with_what_follows_and_the_instruction(made: Path) -> None:
    data = FrameData(made, ahead={"action": 3})
    assert len(data) == 20
    item = data[6]
    assert item["action"].shape == (3, 6) and item["action_is_pad"].tolist() == [False, False, True]
    assert torch.equal(item["action"][2], data[7]["action"][0]) and item["task"].startswith("Lead the first end")
    shots = list(open_set(made).pictures(1, FRONT))
    assert torch.equal(item[FRONT].movedim(0, -1), torch.as_tensor(shots[2]))
    batch = next(iter(torch.utils.data.DataLoader(data, batch_size=5)))
    assert batch[FRONT].shape == (5, 3, 32, 32)
    with pytest.raises(InputError, match="has no column speed"):
        FrameData(made, ahead={"speed": 2})


def test_pages_show_names_as_they_are(own: Path, tmp_path: Path) -> None:
    # Instructions with signs of HTML and slashes, in a folder with a name of that kind.
    table = pq.read_table(own / "meta/tasks.parquet")
    evil = "<script>alert('x')</script> left/right & \"so on\""
    pq.write_table(table.set_column(1, "task", pa.array([evil])), own / "meta/tasks.parquet")
    file = own / "meta/episodes/chunk-000/file-000.parquet"
    rows = pq.read_table(file)
    rows = rows.set_column(rows.column_names.index("tasks"), "tasks", pa.array([[evil]] * 5))
    pq.write_table(rows, file)
    odd = own.rename(own.with_name("a<b>&c"))
    assert check_dataset(odd) == []
    out = tmp_path / "page.html"
    assert cli_code("view", odd, "--episode", 0, "--episode", 4, "--out", out) == 0
    page = out.read_text()
    assert "<script>alert" not in page and "&lt;script&gt;alert" in page and "a&lt;b&gt;&amp;c" in page
    assert page.count("data:video/mp4;base64,") == 4 and "http" not in page.replace("http-equiv", "")
    assert merge_datasets([odd], tmp_path / "copy") == 5 and open_set(tmp_path / "copy").tasks == (evil,)
    assert cli_code("view", odd, "--episode", 9) == 2
    changed(odd / "meta/info.json", features=open_set(odd).features | {"a/b": {"dtype": "float32", "shape": [1]}})
    assert any("the name 'a/b' has a slash" in x for x in check_dataset(odd))
