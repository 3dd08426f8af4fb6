"""Every way in which a recording can be wrong has its sentence, and then nothing is written."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from torchdlo.cli import app
from torchdlo.errors import InputError
from torchdlo.sysid import load_recording

pytestmark = pytest.mark.quick

TRIAL = "train_1.npz"


def rope(**entries: Any) -> Callable[[Path], None]:
    """Change entries of rope.json; `...` removes one."""

    def spoil(folder: Path) -> None:
        content = json.loads((folder / "rope.json").read_text()) | entries
        content = {key: value for key, value in content.items() if value is not ...}
        (folder / "rope.json").write_text(json.dumps(content))

    return spoil


def text(content: str) -> Callable[[Path], None]:
    """Replace rope.json."""
    return lambda folder: (folder / "rope.json").write_text(content) and None


def arrays(change: Callable[[dict[str, np.ndarray]], Any]) -> Callable[[Path], None]:
    """Change the arrays of one trial."""

    def spoil(folder: Path) -> None:
        with np.load(folder / TRIAL) as archive:
            content = dict(archive)
        change(content)
        np.savez(folder / TRIAL, **content)

    return spoil


def put(name: str, index: Any, value: Any) -> Callable[[Path], None]:
    """Change elements of one array of one trial."""

    def change(content: dict[str, np.ndarray]) -> None:
        content[name] = content[name].copy()
        content[name][index] = value

    return arrays(change)


def array(name: str, make: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], None]:
    """Replace one array of one trial."""
    return arrays(lambda content: content.update({name: make(content[name])}))


def remove(*names: str) -> Callable[[Path], None]:
    """Remove arrays from one trial."""
    return arrays(lambda content: [content.pop(name) for name in names])


def add(name: str, value: np.ndarray) -> Callable[[Path], None]:
    """Add an array to one trial."""
    return arrays(lambda content: content.update({name: value}))


def trial_bytes(make: Callable[[bytes], bytes]) -> Callable[[Path], None]:
    """Change the file of one trial."""
    return lambda folder: (folder / TRIAL).write_bytes(make((folder / TRIAL).read_bytes())) and None


def drop(pattern: str) -> Callable[[Path], None]:
    """Remove files."""
    return lambda folder: [file.unlink() for file in folder.glob(pattern)] and None


def make_file(name: str) -> Callable[[Path], None]:
    """Add an empty file."""
    return lambda folder: (folder / name).touch()


def foreign_member(folder: Path) -> None:
    """A zip whose member `time` is no array."""
    with zipfile.ZipFile(folder / TRIAL, "w") as archive:
        archive.writestr("time", "hello")


def stretch_markers(content: dict[str, np.ndarray]) -> None:
    """Swap two far markers in all frames."""
    content["markers"] = content["markers"][:, [0, 1, 6, 3, 4, 5, 2, 7, 8]]


def one_marker_less(content: dict[str, np.ndarray]) -> None:
    """Drop a free marker, consistently."""
    keep = np.arange(9) != 4
    content["markers"] = content["markers"][:, keep]
    content["marker_arclength"] = content["marker_arclength"][keep]
    content["gripped"] = content["gripped"][keep]
    content["gripper_marker"] = np.array([0, 7])


def nan_json(value: str) -> Callable[[Path], None]:
    """Put a number into rope.json that JSON does not know."""

    def spoil(folder: Path) -> None:
        content = (folder / "rope.json").read_text()
        (folder / "rope.json").write_text(content.replace('"mass": 0.05', f'"mass": {value}'))

    return spoil


CASES: dict[str, tuple[Callable[[Path], None], tuple[str, ...]]] = {
    # rope.json
    "no rope.json": (drop("rope.json"), ("rope.json", "found none")),
    "rope.json is not JSON": (text("{length: 1}"), ("rope.json", "line 1, column 2 is not JSON")),
    "rope.json is binary": (
        lambda folder: (folder / "rope.json").write_bytes(b"\xff\xfe\x00") and None,
        ("rope.json", "as text in UTF-8, found byte 0xff at position 0"),
    ),
    "rope.json is a list": (text("[1, 2]"), ("rope.json", "JSON object", "a list")),
    "missing key": (rope(mass=...), ("rope.json", "mass", "missing")),
    "unknown key": (rope(lenght=1.0), ("rope.json", "lenght", "did you mean length")),
    "misspelt key": (rope(length=..., lenght=1.0), ("rope.json", "lenght", "did you mean length")),
    "unlike any key": (rope(zzz=1), ("rope.json", "zzz", "known are length")),
    "a loop": (rope(closed=True), ("rope.json", "closed", "expected false")),
    "other grips in one trial": (put("gripped", 1, False), (TRIAL, "gripped", "recording of their own")),
    "length is a text": (rope(length="1 m"), ("rope.json", "length", "number", "'1 m'")),
    "length is zero": (rope(length=0), ("rope.json", "length", "above 0", "found 0")),
    "length is true": (rope(length=True), ("rope.json", "length", "number")),
    "mass is negative": (rope(mass=-0.05), ("rope.json", "mass", "above 0 in kg", "-0.05")),
    "mass is null": (rope(mass=None), ("rope.json", "mass", "number", "null")),
    "mass is NaN": (nan_json("NaN"), ("rope.json: mass: line ", "finite", "NaN")),
    "mass is huge": (nan_json("1" + "0" * 400), ("rope.json: mass: line ", "with 401 letters")),
    "mass has too many digits": (nan_json("1" * 5000), ("rope.json: mass: line ", "with 5000 letters")),
    "mass is 1e308": (rope(mass=1e308), ("rope.json", "mass", "at most 100000 in kg", "1e+308")),
    "length is 1e308": (rope(length=1e308), ("rope.json", "length", "at most 10000 in m", "1e+308")),
    "gravity is 1e308": (rope(gravity=[0, 0, -1e308]), ("rope.json", "gravity", "at most 1000", "1e+308")),
    "noise is 1e308": (rope(marker_noise_std=1e308), ("rope.json", "marker_noise_std", "at most 1 in m", "1e+308")),
    "a key twice": (
        text('{"length": 1.0, "length": 2.0}'),
        ("rope.json: line 1, column 17", "found length twice"),
    ),
    "radius is zero": (rope(radius=0.0), ("rope.json", "radius", "above 0", "or null")),
    "radius in mm": (rope(radius=4.0), ("rope.json", "radius", "metres")),
    "noise is negative": (
        rope(marker_noise_std=-1e-3),
        ("rope.json", "marker_noise_std", "-0.001"),
    ),
    "gravity is a number": (rope(gravity=-9.81), ("rope.json", "gravity", "[gx, gy, gz]")),
    "gravity has two numbers": (rope(gravity=[0, -9.81]), ("rope.json", "gravity", "(2,)")),
    "gravity has texts": (rope(gravity=["0", "0", "-9"]), ("rope.json", "gravity", "m/s^2")),
    "table is a text": (rope(table_height="0"), ("rope.json", "table_height", "or null", "'0'")),
    "closed is a number": (rope(closed=1), ("rope.json", "closed", "true or false")),
    "notes is a number": (rope(notes=5), ("rope.json", "notes", "a text")),
    "rest shape is flat": (rope(rest_positions=[0, 1, 2]), ("rope.json", "rest_positions", "(3,)")),
    "rest shape is ragged": (
        rope(rest_positions=[[0, 0, 0], [1, 1]]),
        ("rope.json", "rest_positions", "different lengths"),
    ),
    "rest shape of other markers": (
        rope(rest_positions=[[0.1 * i, 0, 0] for i in range(7)]),
        ("rope.json", "rest_positions", "9 markers", "found 7"),
    ),
    "rest shape in mm": (
        rope(rest_positions=[[100.0 * i, 0, 0] for i in range(9)]),
        ("rope.json", "rest_positions", "metres"),
    ),
    # files
    "no train trial": (drop("train_*"), ("train_*.npz", "found none")),
    "no test trial": (drop("test_*"), ("test_*.npz", "found none")),
    "film without a camera": (make_file("test_7.mp4"), ("test_7.mp4", "expected the camera's name")),
    "film without cameras": (make_file("test_1.a.mp4"), ("cameras.json", "expected the file of the cameras")),
    "empty file": (trial_bytes(lambda data: b""), (TRIAL, "cannot be read")),
    "truncated file": (trial_bytes(lambda data: data[: len(data) // 2]), (TRIAL, ".npz archive")),
    "damaged bytes": (
        trial_bytes(lambda data: data[:3000] + bytes(300) + data[3300:]),
        (TRIAL, "cannot be read"),
    ),
    "not a zip": (trial_bytes(lambda data: b"hello"), (TRIAL, ".npz archive")),
    "a pickle": (trial_bytes(lambda data: b"\x80\x04]\x94."), (TRIAL, ".npz archive", "pickle")),
    "single array": (
        lambda folder: np.save((folder / TRIAL).open("wb"), np.zeros(3)),
        (TRIAL, "single array"),
    ),
    "foreign member": (foreign_member, (TRIAL, "time", "another kind of file")),
    "pickled array": (
        array("markers", lambda a: np.array([None, 1], dtype=object)),
        (TRIAL, "markers", "pickled"),
    ),
    # presence, type and shape
    "missing array": (remove("gripped"), (TRIAL, "gripped", "missing")),
    "unknown array": (add("gripper_quat", np.zeros(3)), (TRIAL, "gripper_quat", "unknown array")),
    "misspelt array": (
        arrays(lambda c: c.update(marker_arclenght=c.pop("marker_arclength"))),
        (TRIAL, "marker_arclenght", "did you mean marker_arclength"),
    ),
    "masks": (
        add("masks", np.zeros((40, 1, 8, 8), dtype=bool)),
        (TRIAL, "masks", "beside the trial"),
    ),
    "markers are texts": (array("markers", lambda a: a.astype(str)), (TRIAL, "markers", "float")),
    "markers are complex": (array("markers", lambda a: a + 0j), (TRIAL, "markers", "complex128")),
    "markers are flat": (
        array("markers", lambda a: a.reshape(40, 27)),
        (TRIAL, "markers", "(frames, markers, 3)", "(40, 27)"),
    ),
    "markers are transposed": (
        array("markers", lambda a: a.transpose(0, 2, 1)),
        (TRIAL, "markers", "(frames, markers, 3)", "(40, 3, 9)"),
    ),
    "gripped is a number": (
        array("gripped", lambda a: a.astype(int)),
        (TRIAL, "gripped", "bool", "int64"),
    ),
    "gripped is short": (array("gripped", lambda a: a[:-1]), (TRIAL, "gripped", "(9,)", "(8,)")),
    "suspect is short": (array("suspect", lambda a: a[:-1]), (TRIAL, "suspect", "(40,)", "(39,)")),
    "four frames": (
        arrays(lambda c: c.update({k: c[k][:4] for k in ("time", "markers", "suspect", "gripper_quaternion")})),
        (TRIAL, "markers", "at least 5 frames", "found 4"),
    ),
    "two markers": (
        arrays(
            lambda c: c.update(
                markers=c["markers"][:, :2],
                marker_arclength=c["marker_arclength"][:2],
                gripped=c["gripped"][:2],
            )
        ),
        (TRIAL, "markers", "at least 3 markers", "found 2"),
    ),
    "other markers than before": (arrays(one_marker_less), (TRIAL, "markers", "9 markers", "8")),
    # clock
    "time of other length": (array("time", lambda a: a[:-1]), (TRIAL, "time", "(40,)", "(39,)")),
    "time starts late": (array("time", lambda a: a + 1.0), (TRIAL, "time", "start at 0 s", "1")),
    "time goes back": (put("time", 7, 0.05), (TRIAL, "time", "strictly increasing", "frame 7")),
    "time is uneven": (put("time", slice(20, None), np.arange(20) * 0.01 + 0.25), (TRIAL, "time")),
    "time in ms": (array("time", lambda a: a * 1e3), (TRIAL, "time", "milliseconds")),
    "time has NaN": (put("time", 3, np.nan), (TRIAL, "time", "NaN", "(3)")),
    # places
    "arclength is negative": (
        array("marker_arclength", lambda a: a - 0.1),
        (TRIAL, "marker_arclength", "-0.1"),
    ),
    "arclength falls": (
        put("marker_arclength", 4, 0.3),
        (TRIAL, "marker_arclength", "increase", "marker 4"),
    ),
    "arclength beyond length": (
        put("marker_arclength", -1, 1.1),
        (TRIAL, "marker_arclength", "1 m", "1.1 for marker 8"),
    ),
    "arclength in mm": (
        array("marker_arclength", lambda a: a * 1e3),
        (TRIAL, "marker_arclength", "millimetres"),
    ),
    "nothing gripped": (array("gripped", np.zeros_like), (TRIAL, "gripped", "found none")),
    "everything gripped": (array("gripped", np.ones_like), (TRIAL, "gripped", "all 9")),
    "NaN in a gripped marker": (
        put("markers", (12, 7), np.nan),
        (TRIAL, "markers", "gripped marker 7 at frame 12"),
    ),
    "NaN in one coordinate": (
        put("markers", (12, 3, 1), np.nan),
        (TRIAL, "markers", "marker 3 at frame 12"),
    ),
    "infinite marker": (put("markers", (6, 3, 1), np.inf), (TRIAL, "markers", "(6, 3, 1)")),
    "marker never seen": (
        put("markers", (slice(None), 5), np.nan),
        (TRIAL, "markers", "marker 5 NaN in all 40 frames"),
    ),
    "markers in mm": (array("markers", lambda a: a * 1e3), (TRIAL, "markers", "millimetres")),
    "coinciding markers": (
        arrays(lambda c: c["markers"].__setitem__((slice(None), 3), c["markers"][:, 2])),
        (TRIAL, "markers", "markers 2 and 3 in the same place"),
    ),
    "swapped markers": (arrays(stretch_markers), (TRIAL, "markers", "markers 1 and 2 at most")),
    # clamps
    "quaternion without marker": (
        remove("gripper_marker"),
        (TRIAL, "gripper_marker", "together with gripper_quaternion"),
    ),
    "quaternion of other shape": (
        array("gripper_quaternion", lambda a: a[:, :1]),
        (TRIAL, "gripper_quaternion", "(40, 2, 4)", "(40, 1, 4)"),
    ),
    "quaternion not unit": (
        put("gripper_quaternion", (9, 1), [1.0, 1.0, 0.0, 0.0]),
        (TRIAL, "gripper_quaternion", "unit", "frame 9, clamp 1"),
    ),
    "quaternion has NaN": (
        put("gripper_quaternion", (9, 1, 2), np.nan),
        (TRIAL, "gripper_quaternion", "NaN"),
    ),
    "clamp out of range": (put("gripper_marker", 1, 9), (TRIAL, "gripper_marker", "found 9")),
    "clamp at a free marker": (put("gripper_marker", 1, 4), (TRIAL, "gripper_marker", "4", "free")),
    "clamp given twice": (put("gripper_marker", 1, 0), (TRIAL, "gripper_marker", "[0, 0]")),
    "clamp is a float": (
        array("gripper_marker", lambda a: a.astype(float)),
        (TRIAL, "gripper_marker", "integers", "float64"),
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_message_names_file_entry_and_problem(case: str, folder: Path) -> None:
    spoil, words = CASES[case]
    spoil(folder)
    with pytest.raises(InputError) as caught:
        load_recording(folder)
    message = str(caught.value)
    assert message.startswith(str(folder))
    for word in words:
        assert word in message


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("command", ["check", "calibrate"])
def test_command_says_one_line_and_writes_nothing(
    case: str,
    command: str,
    folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    CASES[case][0](folder)
    work = tmp_path / "work"
    work.mkdir()
    monkeypatch.chdir(work)
    before = {path: path.stat().st_mtime_ns for path in folder.iterdir()}
    with pytest.raises(SystemExit) as caught:
        app.main([command, str(folder)])
    said = capsys.readouterr()
    assert caught.value.code == 2
    assert said.out == ""
    assert said.err.startswith("error: ")
    assert said.err.count("\n") == 1
    assert not list(work.iterdir())
    assert {path: path.stat().st_mtime_ns for path in folder.iterdir()} == before


@pytest.mark.parametrize("kind", ["missing", "file"])
def test_not_a_folder(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "rope"
    if kind == "file":
        path.write_text("x")
    with pytest.raises(InputError, match="expected a recording folder"):
        load_recording(path)
