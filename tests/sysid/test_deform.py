"""Conversion of a DEFORM checkout, on one that the test makes."""

from __future__ import annotations

import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest

from torchdlo.cli import app
from torchdlo.errors import InputError
from torchdlo.sysid import load_recording
from torchdlo.sysid.recordings.import_deform import find_cables, read_cable, read_positions, suspect_frames

SPACING = np.array([0.02, 0.1, 0.11, 0.1, 0.09, 0.025])
REST = np.stack([np.concatenate([[0], np.cumsum(SPACING)]), np.zeros(7), np.full(7, 0.015)], axis=1)


def motion(seed: int, n_frames: int = 60) -> np.ndarray:
    """Marker positions [m], shape (F, M, 3): a rigid rope that swings."""
    time = np.arange(n_frames) * 0.01
    angle = 0.3 * np.sin(5 * time + seed)
    turned = np.stack(
        [
            REST[:, 0] * np.cos(angle)[:, None],
            REST[:, 0] * np.sin(angle)[:, None],
            np.full((n_frames, 7), 0.4),
        ],
        axis=-1,
    )
    return turned + np.array([0.1 * seed, 0, 0])


def write(path: Path, content: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(pickle.dumps(content))


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A checkout with one cable whose mass is known by name and one whose mass is not."""
    root = tmp_path / "DEFORM"
    for cable in ("DLO1", "DLO9"):
        for split, numbers in (("train", (48, 49, 101)), ("eval", (7, 54))):
            for number in numbers:
                # As published: frames of three coordinate lists, each with all markers.
                content = motion(number).transpose(0, 2, 1).tolist()
                write(root / "data_set" / cable / split / f"{number}.pkl", content)
    table = ", ".join(f"({x!r}, {y!r}, {z!r})" for x, y, z in REST.tolist())
    (root / "train_DEFORM.py").write_text(
        "import torch\n"
        "def train(DLO_type, device):\n"
        '    if DLO_type == "DLO7":\n'
        "        rest_vert = (torch.tensor(((1., 2., 3.), (4., 5., 6.)))).to(device)\n"
        '    elif DLO_type == "DLO1":\n'
        "        n_vert = 7\n"
        f"        rest_vert = (torch.tensor(({table}))).unsqueeze(dim=0).repeat(1, 1, 1)\n"
        "        rest_vert = torch.cat((rest_vert[:, :, 0], -rest_vert[:, :, 1]), dim=-1)\n"
        "raise RuntimeError('this script must not be run')\n"
    )
    return root


def test_converts_a_cable(checkout: Path, tmp_path: Path) -> None:
    with pytest.raises(SystemExit) as caught:
        app.main(["import-deform", str(checkout), str(tmp_path / "out")])
    assert not caught.value.code
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["dlo1"]
    recording = load_recording(tmp_path / "out" / "dlo1")
    assert [t.name for t in recording.train] == ["train_048", "train_049", "train_101"]
    assert [t.name for t in recording.test] == ["test_007", "test_054"]
    assert recording.mass == 0.03108 and recording.marker_mass == 4e-4
    assert recording.radius is None and recording.table_height is None
    assert recording.length == pytest.approx(SPACING.sum())
    np.testing.assert_allclose(recording.rest_positions, REST)
    trial = recording.test[1]
    np.testing.assert_array_equal(trial.markers, motion(54))
    np.testing.assert_allclose(np.diff(trial.marker_arclength), SPACING)
    np.testing.assert_array_equal(trial.gripped, [1, 1, 0, 0, 0, 1, 1])
    np.testing.assert_allclose(trial.time, np.arange(60) / 100)
    assert not trial.suspect.any()


def test_other_layouts(checkout: Path, tmp_path: Path) -> None:
    assert list(find_cables(checkout)) == list(find_cables(checkout / "data_set"))
    alone = checkout / "data_set" / "DLO9"
    assert find_cables(alone) == {"DLO9": alone}
    # Frames of (marker, coordinate) are read alike.
    write(tmp_path / "a.pkl", motion(3).tolist())
    np.testing.assert_array_equal(read_positions(tmp_path / "a.pkl"), motion(3))


def test_mass_is_asked_for(checkout: Path) -> None:
    with pytest.raises(InputError, match="--mass"):
        read_cable(checkout / "data_set" / "DLO9")
    recording = read_cable(checkout / "data_set" / "DLO9", mass=0.02)
    assert recording.mass == 0.02 and recording.rest_positions is None


def test_jumps_and_wrong_spacing_are_suspect() -> None:
    positions = motion(1)
    assert not suspect_frames(positions, SPACING).any()
    positions[20, 3, 2] += 0.02  # a jump of one frame spoils the three differences around it
    positions[40:, :4, 0] -= 0.02
    suspect = suspect_frames(positions, SPACING)
    assert np.flatnonzero(suspect[:38]).tolist() == [18, 19, 20, 21, 22]
    assert suspect[40:].all()


def test_frames_marked_as_in_the_known_conversion(shared_data: Path, tmp_path: Path) -> None:
    known = load_recording(shared_data / "deform_dlo4")
    for trial in known.train + known.test:
        split, number = trial.name.split("_")
        folder = tmp_path / "DLO4" / {"train": "train", "test": "eval"}[split]
        write(folder / f"{int(number)}.pkl", trial.markers.transpose(0, 2, 1).tolist())
    again = read_cable(tmp_path / "DLO4")
    assert again.length == pytest.approx(known.length, abs=1e-6)
    for new, old in zip(again.train + again.test, known.train + known.test, strict=True):
        assert new.name == old.name
        np.testing.assert_array_equal(new.suspect, old.suspect)
        np.testing.assert_allclose(new.marker_arclength, old.marker_arclength, atol=1e-6)


class Trap:
    """What a hostile pickle holds."""

    def __reduce__(self) -> tuple[object, ...]:
        return (Path.touch, (Path("trap-was-sprung"),))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (Trap(), "could run code"),
        (np.zeros((5, 3, 7)), "numpy arrays"),
        ([[[1.0, 2.0]]], "expected shape"),
        ([[1.0], [1.0, 2.0]], "lists of numbers of one size"),
        ({"a": 1}, "lists of numbers of one size"),
        ("text", "lists of numbers of one size"),
        (np.full((5, 3, 7), np.nan).tolist(), "NaN or infinity"),
    ],
)
def test_other_pickles_are_refused(
    content: object, words: str, checkout: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    bad = checkout / "data_set" / "DLO1" / "eval" / "54.pkl"
    write(bad, content)
    with pytest.raises(InputError, match=words) as caught:
        read_cable(checkout / "data_set" / "DLO1")
    assert str(bad) in str(caught.value)
    assert not Path("trap-was-sprung").exists()


@pytest.mark.parametrize("spoil", [b"", b"hello", b"\x80\x04]", b"\x80\x04cos\nsystem\n."])
def test_damaged_pickles_are_refused(spoil: bytes, tmp_path: Path) -> None:
    (tmp_path / "1.pkl").write_bytes(spoil)
    with pytest.raises(InputError, match=r"1\.pkl"):
        read_positions(tmp_path / "1.pkl")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["{root}/nowhere", "{out}"], "expected a checkout"),
        (["{root}/data_set/DLO1/train", "{out}"], "found no cable"),
        (["{root}", "{out}", "--cable", "DLO5"], "expected a cable DLO5"),
        (["{root}", "{out}", "--cable", "DLO9"], "--mass"),
        (["{root}", "{out}", "--cable", "DLO1", "--mass", "-1"], "--mass"),
        (["{root}", "{root}/data_set"], "choose a new one"),
    ],
)
def test_command_says_one_line_and_writes_nothing(
    arguments: list[str],
    words: str,
    checkout: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    if "new one" in words:
        (checkout / "data_set" / "dlo1").mkdir()
        (checkout / "data_set" / "dlo1" / "mine.txt").touch()
    out = tmp_path / "out"
    before = sorted(checkout.rglob("*"))
    filled = [a.format(root=checkout, out=out) for a in arguments]
    with pytest.raises(SystemExit) as caught:
        app.main(["import-deform", *filled])
    said = capsys.readouterr()
    assert caught.value.code == 2
    assert said.out == "" and words in said.err
    lines = [line for line in said.err.splitlines() if not line.startswith("left out")]
    assert len(lines) == 1
    assert not out.exists() and sorted(checkout.rglob("*")) == before


def test_nothing_is_written_when_a_later_cable_is_bad(checkout: Path, tmp_path: Path) -> None:
    shutil.copytree(checkout / "data_set" / "DLO1", checkout / "data_set" / "DLO2")
    (checkout / "data_set" / "DLO2" / "eval" / "7.pkl").write_bytes(b"")
    with pytest.raises(SystemExit) as caught:
        app.main(["import-deform", str(checkout), str(tmp_path / "out")])
    assert caught.value.code == 2
    assert not (tmp_path / "out").exists()
