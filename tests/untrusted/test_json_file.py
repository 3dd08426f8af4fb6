"""The one reader of JSON: what it refuses, and that every refusal says place, expectation, finding and cure."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from torchdlo import scene_files
from torchdlo.agents.trajopt.search_result import read_trajectory
from torchdlo.coupling.robot import urdf
from torchdlo.errors import InputError
from torchdlo.reward_language import load_reward
from torchdlo.sysid.model import model_file
from torchdlo.untrusted import Entry, MissingFile, parse_json, read_json
from torchdlo.vision.camera import load_cameras
from torchdlo.vision.segment import load_ranges

pytestmark = pytest.mark.quick

WRONG = {
    "a key twice": (
        '{"a": [{"b": 1,\n "b": 2}]}',
        r"f: line 2, column 2: .* found a\[0\]\.b twice; remove one",
    ),
    "a key twice that is escaped": ('{"a": 1, "\\u0061": 2}', r"line 1, column 10: .* found a twice"),
    "NaN": ('{"a": [1, NaN]}', r"f: a\[1\]: line 1, column 11: expected a finite number, found NaN"),
    "infinity": ("-Infinity", "line 1, column 1: expected a finite number, found -Infinity"),
    "too large a number": ('{"a": {"b": 1e999}}', r"f: a\.b: line 1, .* at most 400 letters, found 1e999; write it"),
    "401 digits": ("[" + "7" * 401 + "]", r"f: \[0\]: .* found 7777777777\.\.\. with 401 letters"),
    "5000 digits": ("[" + "7" * 5000 + "]", r"with 5000 letters"),
    "5000 digits behind a point": ("[0." + "7" * 5000 + "]", r"a finite number of at most 400 letters, found 0\.7"),
    "beyond 64 bits": ("[9223372036854775808]", r"a whole number below 2\^63 in size, found 9223372036854775808"),
    "deep lists": ("[" * 100_000, "line 1, column 61: expected .* at most 60 objects and lists in each other"),
    "deep objects": ('{"a":' * 100_000, "at most 60 objects"),
    "deep lists behind a text of brackets": ('["' + "[" * 100 + '", ' + "[" * 100, "column 165: .* at most 60"),
    "cut": ('{"a": [1, 2', r"line 1, column 12 is not JSON \(Expecting"),
    "empty": ("", "line 1, column 1 is not JSON"),
    "two values": ("1 2", "line 1, column 3 is not JSON"),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_is_wrong_is_said_with_its_place(case: str) -> None:
    text, sentence = WRONG[case]
    with pytest.raises(InputError, match=sentence) as caught:
        parse_json(text, where="f", what="a list of f")
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 400


def test_sound_json_reads_as_json_does() -> None:
    content = {"a": [1, -2.5e-3, True, None, '[{\\"\u00e4'], "b": {"c": {}}, "": [[[]]], "d": 2**63 - 1}
    assert parse_json(json.dumps(content), where="f") == content
    assert parse_json("[NaN]", where="f", finite=False)[0] != 0
    within = "[" * 60 + "]" * 60
    assert parse_json(within, where="f") == json.loads(within)


@pytest.fixture
def hostile(tmp_path: Path) -> dict[str, Path]:
    """Things that are no regular files of JSON."""
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    (tmp_path / "binary").write_bytes(b'{"a": "\xff"}')
    with (tmp_path / "long").open("wb") as file:
        file.truncate(10**12)
    found = {name: tmp_path / name for name in ("pipe", "folder", "binary", "long", "none", "none/below", "nul\0byte")}
    return found | {"zero": Path("/dev/zero"), "random": Path("/dev/urandom")}


KINDS = {
    "a value": lambda path: read_json(path, "a list"),
    "scene": scene_files.read,
    "model": model_file.load,
    "trajectory": read_trajectory,
    "reward": load_reward,
    "cameras": load_cameras,
    "ranges": load_ranges,
    "URDF": urdf.read_urdf,
}
SAID = {
    "pipe": "found a pipe; give a regular file",
    "folder": "folder",
    "binary": "expected|xml|XML",
    "long": "expected .* of at most .* found 1 TB",
    "none": "found none",
    "none/below": "found none",
    "nul\0byte": r"nul\\x00byte: expected .* cannot be opened",
    "zero": "/dev/zero: expected .* found a device; give a regular file",
    "random": "found a device",
}


@pytest.mark.parametrize("kind", KINDS)
def test_only_regular_files_of_bounded_size_are_read(kind: str, hostile: dict[str, Path]) -> None:
    for name, path in hostile.items():
        with pytest.raises(InputError, match=SAID[name]) as caught:
            KINDS[kind](path)
        assert "\n" not in str(caught.value) and "\0" not in str(caught.value)
    with pytest.raises(MissingFile):
        KINDS[kind](hostile["none"])


def test_entries_say_where_they_are_and_what_was_expected() -> None:
    content = {"a": [1, "x", {"b": None}], "n": 5.7, "deep": [[1, 2], [3]], "flag": 1}
    entry = Entry(content, "f", "", "a thing")
    assert entry["a"][0].whole(0, 3) == 1 and entry["n"].number() == 5.7 and "b" not in entry["a"][2]
    for ask, sentence in (
        (lambda: entry["c"], "f: c: expected this entry in a thing, found none"),
        (lambda: entry["a"][2]["d"], r"f: a\[2\]\.d: expected this entry"),
        (lambda: entry["n"].whole(0, 9), "f: n: expected a whole number from 0 to 9, found 5.7"),
        (lambda: entry["n"].number(6, 7, "m"), "f: n: expected a finite number from 6 to 7 m, found 5.7"),
        (lambda: entry["flag"].flag(), "f: flag: expected true or false, found 1"),
        (lambda: entry["flag"].text(), "f: flag: expected a text"),
        (lambda: entry["a"].numbers(None), r"f: a: expected lists of n numbers .* found other values or lengths"),
        (lambda: entry["deep"].numbers(None, None), "f: deep: expected lists of nxn numbers"),
        (lambda: entry["a"].object(), "f: a: expected an object {...}, found a list of 3 entries"),
        (lambda: Entry([], "f", "", "a thing")["a"], "f: expected a thing, an object .* found an empty list"),
    ):
        with pytest.raises(InputError, match=sentence):
            ask()


SCENE = {"format": scene_files.FORMAT, "ropes": [{"points": [[0, 0, 0], [1, 0, 0]], "vertices": 5}], "effects": {}}
PHYSICAL = {
    "no rope": ({"ropes": []}, "ropes: expected at least one rope, given none"),
    "negative duration": ({"duration": -1.0}, "duration: expected seconds above 0, given -1"),
    "endless duration": ({"duration": 1e12}, "duration: expected a number of at most 1e.09 in size, given 1e.12"),
    "gravity": ({"effects": {"gravity": {"acceleration": [0, 0, -1e308]}}}, "effects.gravity.acceleration: expected a"),
    "an effect's choice": (
        {"effects": {"rod_contact": {"sweeps": "x"}}},
        "effects.rod_contact.sweeps: expected a whole",
    ),
    "mass": ({"ropes": [SCENE["ropes"][0] | {"mass": 1e308}]}, r"ropes\[0\]\.mass: expected a number of at most 1e.06"),
    "length": ({"ropes": [{"points": [[0, 0, 0], [1e308, 0, 0]]}]}, r"ropes\[0\]\.points\[1\]\[0\]: expected a number"),
    "vertices": (
        {"ropes": [SCENE["ropes"][0] | {"vertices": 5.7}]},
        r"ropes\[0\].vertices: expected a whole number, given 5.7",
    ),
}


@pytest.mark.parametrize("case", PHYSICAL)
def test_scenes_of_no_world_are_refused(case: str, tmp_path: Path) -> None:
    change, sentence = PHYSICAL[case]
    (tmp_path / "scene.json").write_text(json.dumps(SCENE | change))
    with pytest.raises(InputError, match=f"scene.json: {sentence}"):
        scene_files.load(tmp_path / "scene.json")


def test_arguments_that_are_swapped_are_said(tmp_path: Path) -> None:
    described = scene_files.SceneDescription((scene_files.RopeSpec(((0.0, 0.0, 0.0), (1.0, 0.0, 0.0))),), {})
    for call in (
        lambda: scene_files.save(tmp_path / "x.json", described),
        lambda: scene_files.assemble("scene.json"),
    ):
        with pytest.raises(InputError, match=r"expected a SceneDescription first, given .* are arguments swapped"):
            call()


def test_trajectories_of_no_numbers_are_refused(tmp_path: Path) -> None:
    from torchdlo.agents.trajopt.search_result import load_actions
    from torchdlo.agents.trajopt.task_problem import TaskProblem
    from torchdlo.envs import find

    problem = TaskProblem(find("lifting"), execution="eager")
    file = tmp_path / "t.json"
    for content, sentence in (
        ("[]", "t.json: expected a trajectory of torchdlo optimize, an object {...}, found an empty list"),
        ('{"actions": []}', "t.json: task: expected this entry"),
        ('{"task": "lifting"}', "t.json: actions: expected this entry in a trajectory of torchdlo optimize"),
        ('{"task": 3, "actions": [[1]]}', "t.json: task: expected a text"),
        ('{"task": "lifting", "actions": [[NaN]]}', r"t.json: actions\[0\]\[0\]: line 1, .* found NaN"),
        ('{"task": "lifting", "actions": [["x"]]}', "t.json: actions: expected lists of nxn numbers"),
        ('{"task": "lifting", "actions": [[1], [1, 2]]}', "t.json: actions: expected lists of nxn numbers"),
        ('{"task": "lifting", "actions": [[1]]}', r"expected \d+ actions of \d+ numbers for lifting, found \(1, 1\)"),
    ):
        file.write_text(content)
        with pytest.raises(InputError, match=sentence):
            load_actions(file, problem)
