"""The one reader of arrays: what is declared is looked at before anything is inflated."""

from __future__ import annotations

import io
import os
import pickle
import resource
import struct
import time
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from torchdlo.errors import InputError
from torchdlo.scene_files import RopeSpec, SceneDescription
from torchdlo.scene_files.run import Frames, load_frames, run, save_frames
from torchdlo.sysid import load_recording
from torchdlo.sysid.recordings.import_deform import read_positions
from torchdlo.untrusted.array_file import ArrayFile, read_arrays
from torchdlo.untrusted.tensor_file import read_tensors

pytestmark = pytest.mark.quick


def member(shape: str, descr: str = "'<f8'", content: bytes = b"", version: int = 1) -> bytes:
    """An .npy with any header."""
    head = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}".encode()
    head += b" " * (-(len(head) + 11) % 64) + b"\n"
    size = struct.pack("<H" if version == 1 else "<I", len(head))
    return b"\x93NUMPY" + bytes([version, 0]) + size + head + content


def archive(path: Path, members: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> Path:
    with zipfile.ZipFile(path, "w", method) as file:
        for name, content in members.items():
            file.writestr(name, content)
    return path


def bomb(path: Path, name: str = "x", size: int = 300 * 2**20) -> Path:
    """Zeros that take a thousandth of their size."""
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as file,
        file.open(f"{name}.npy", "w") as out,
    ):
        out.write(member(f"({size},)", "'|u1'"))
        for _ in range(size >> 20):
            out.write(bytes(1 << 20))
    return path


def peak() -> float:
    """Largest memory of this process so far [bytes]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


WRONG: dict[str, tuple[Callable[[Path], object], str]] = {
    "empty": (lambda p: p.write_bytes(b""), "cannot be read"),
    "text": (lambda p: p.write_text("no"), "cannot be read"),
    "a single array": (lambda p: p.write_bytes(member("(1,)", content=bytes(8))), "found a single array"),
    "a pickle": (lambda p: p.write_bytes(pickle.dumps([1])), "found a pickle, which is never loaded"),
    "another kind of file": (lambda p: archive(p, {"x": b"hello"}), "x: expected an array, found another kind of file"),
    "not an array": (lambda p: archive(p, {"x.npy": b"hello"}), "cannot be read"),
    "objects": (lambda p: np.savez(p, x=np.array([None])), "x: expected an array of numbers, found pickled Python obj"),
    "records": (lambda p: np.savez(p, x=np.zeros(2, "i4,f8")), "x: expected an array of numbers or texts, found"),
    "more than it holds": (lambda p: archive(p, {"x.npy": member("(10**12,)")}), "cannot be read"),
    "a huge shape": (
        lambda p: archive(p, {"x.npy": member("(1000000000000,)")}),
        "expected 8 TB for its",
    ),
    "a negative shape": (lambda p: archive(p, {"x.npy": member("(-1,)")}), "x: expected a shape of whole numbers"),
    "a true shape": (lambda p: archive(p, {"x.npy": member("(True,)", content=bytes(8))}), "x: expected a shape"),
    "nothing, often": (lambda p: archive(p, {"x.npy": member("(10000000000000, 0)")}), "x: expected a shape of whole"),
    "less than it says": (lambda p: archive(p, {"x.npy": member("(4,)", content=bytes(8))}), "expected 32 bytes"),
    "a deep header": (lambda p: archive(p, {"x.npy": member("(" * 5000 + ")" * 5000)}), "cannot be read"),
    "a long header": (lambda p: archive(p, {"x.npy": member("(1,)" + " " * 10**6, version=2)}), "cannot be read"),
    "packed in another way": (
        lambda p: archive(p, {"x.npy": member("(1,)", content=bytes(8))}, zipfile.ZIP_LZMA),
        "x: expected it stored or deflated",
    ),
    "a wrong sum": (
        lambda p: p.write_bytes(
            archive(p, {"x.npy": member("(1,)", content=b"abcdefgh")}, 0).read_bytes().replace(b"abcdefgh", b"abcdefgg")
        ),
        r"cannot be read \(Bad CRC",
    ),
}


@pytest.mark.parametrize("case", WRONG)
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_damaged_archives_are_refused_in_a_sentence(case: str, tmp_path: Path) -> None:
    make, sentence = WRONG[case]
    path = tmp_path / "a.npz"
    make(path)
    with pytest.raises(InputError, match=f"a.npz: .*{sentence}") as caught:
        read_arrays(path, "numbers")
    assert "\n" not in str(caught.value)


def test_an_archive_with_a_name_twice_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    with pytest.warns(UserWarning, match="Duplicate"), zipfile.ZipFile(path, "w") as file:
        for _ in range(2):
            file.writestr("x.npy", member("(1,)", content=bytes(8)))
    with pytest.raises(InputError, match="x: expected each array once, found it twice"):
        read_arrays(path, "numbers")


def test_a_long_list_of_contents_is_refused_before_it_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w") as file:
        for k in range(10_001):
            file.writestr(f"{k}.npy", b"")
    with pytest.raises(InputError, match="at most 10000 arrays, found more"):
        read_arrays(path, "numbers")


def test_bombs_are_refused_by_their_headers(tmp_path: Path, folder: Path) -> None:
    path = bomb(tmp_path / "a.npz")
    assert path.stat().st_size < 2 * 2**20
    before, begun = peak(), time.process_time()
    with pytest.raises(InputError, match=r"expected arrays of at most 268 MB, found 315 MB once inflated"):
        read_arrays(path, "numbers")
    with ArrayFile(path, "numbers") as found, pytest.raises(InputError, match="once inflated"):
        found["x"]
    # An unknown array of a trial is refused by its name, and one of a wrong shape by its shape.
    trial = folder / "train_1.npz"
    trial.write_bytes(path.read_bytes())
    with pytest.raises(InputError, match=r"train_1.npz: x: unknown array; known are time"):
        load_recording(folder)
    assert time.process_time() - begun < 2.0 and peak() - before < 50e6


def test_a_pipe_is_no_trial(folder: Path) -> None:
    (folder / "train_1.npz").unlink()
    os.mkfifo(folder / "train_1.npz")
    with pytest.raises(InputError, match=r"train_1.npz: expected a trial, found a pipe"):
        load_recording(folder)


def test_sound_archives_read_as_numpy_reads_them(tmp_path: Path) -> None:
    content = {"a": np.arange(6.0).reshape(2, 3), "b": np.array("text"), "c": np.zeros((0, 3), bool), "d": np.array(5)}
    np.savez_compressed(tmp_path / "a.npz", **content)
    found = read_arrays(tmp_path / "a.npz", "numbers")
    assert found.keys() == content.keys()
    for name, value in content.items():
        assert found[name].dtype == value.dtype and np.array_equal(found[name], value)
    assert list(read_arrays(tmp_path / "a.npz", "numbers", names=("c", "none"))) == ["c"]


@pytest.fixture(scope="module")
def frames() -> Frames:
    rope = RopeSpec(((0.0, 0.0, 0.0), (0.2, 0.0, 0.0)), vertices=5, mass=0.01, bend=1e-4)
    return run(SceneDescription((rope,), {"gravity": {}, "bend": {}}, duration=0.02))


def put(name: str, index: object, value: object) -> Callable[[dict[str, np.ndarray]], None]:
    return lambda arrays: arrays[name].__setitem__(index, value)


def instead(name: str, value: object) -> Callable[[dict[str, np.ndarray]], None]:
    return lambda arrays: arrays.__setitem__(name, np.asarray(value))


FRAMES: dict[str, tuple[Callable[[dict[str, np.ndarray]], None], str]] = {
    "NaN in time": (put("time", 1, np.nan), r"time: expected finite numbers up to 1e.06, found nan at index \[1\]"),
    "time goes back": (put("time", 1, -1.0), "time: expected rising times, found -1 s after 0 s at frame 1"),
    "infinite position": (put("pos", (1, 2, 0), np.inf), r"pos: expected finite .* found inf at index \[1, 2, 0\]"),
    "far position": (put("pos", (0, 0, 0), 1e30), "pos: expected finite numbers up to"),
    "positions flat": (instead("pos", np.zeros((3, 15))), r"pos: expected shape \(3, vertices, 3\), found \(3, 15\)"),
    "fewer frames": (instead("twist", np.zeros((1, 5))), r"twist: expected shape \(3, 5\), found \(1, 5\)"),
    "texts for numbers": (instead("radius", ["x"] * 5), "radius: expected numbers with a point, found <U1"),
    "a rope too many": (put("rope", 0, 7), "rope: expected numbers from 0 to 0, found 7"),
    "a rope without vertices": (instead("closed", [False, False]), "rope: expected at least 2 vertices of each rope"),
    "no frames": (lambda a: [a.__setitem__(k, a[k][:0]) for k in MOVING] and None, "at least one of frames"),
    "unknown shape": (
        lambda a: [instead("body_shape", ["cube"])(a), *(instead(k, v)(a) for k, v in BODY.items())] and None,
        "body_shape: expected one of .* found 'cube'",
    ),
    "a triangle of vertex 1e9": (
        lambda a: (
            [
                instead("mesh_vertices", np.zeros((3, 3)))(a),
                instead("mesh_faces", [[0, 1, 10**9]])(a),
                instead("mesh_body", [0])(a),
                instead("body_shape", ["mesh"])(a),
                *(instead(k, v)(a) for k, v in BODY.items()),
            ]
            and None
        ),
        "mesh_faces: expected numbers from 0 to 2, found 1000000000",
    ),
    "tension of fewer vertices": (instead("tension", np.zeros((3, 4))), r"tension: expected shape \(3, 5\), found"),
    "energy of more frames": (instead("bending_energy", np.zeros(4)), r"bending_energy: expected shape \(3\), found"),
    "contact of a body that is not": (
        instead("body_contact_force", np.zeros((3, 1, 3))),
        r"body_contact_force: expected shape \(3, 0, 3\), found \(3, 1, 3\)",
    ),
    "moments that are no numbers": (
        put("bending_moment", (1, 2, 0), np.nan),
        r"bending_moment: expected finite numbers up to 1e\+30, found nan at index \[1, 2, 0\]",
    ),
    "no direction": (instead("camera_direction", [0.0, 0.0, 0.0]), "camera_direction: expected a direction"),
}
MOVING = (
    *("time", "pos", "twist", "force", "body_pos", "body_quat", "material_points"),
    *("tension", "curvature", "twist_density", "bending_moment", "contact_force"),
    *("kinetic_energy", "gravitational_energy", "bending_energy", "twisting_energy"),
    *("body_kinetic_energy", "body_gravitational_energy"),
)
BODY = {
    "body_pos": np.zeros((3, 1, 3)),
    "body_quat": np.tile([1.0, 0, 0, 0], (3, 1, 1)),
    "body_size": np.ones((1, 3)),
    "body_motion": ["fixed"],
}


@pytest.mark.parametrize("case", FRAMES)
def test_frames_that_are_no_run_are_refused(case: str, frames: Frames, tmp_path: Path) -> None:
    spoil, sentence = FRAMES[case]
    save_frames(frames, tmp_path / "frames.npz")
    assert np.array_equal(load_frames(tmp_path).pos, frames.pos)
    with np.load(tmp_path / "frames.npz") as found:
        arrays = {name: found[name].copy() for name in found.files}
    spoil(arrays)
    np.savez(tmp_path / "frames.npz", **arrays)
    with pytest.raises(InputError, match=f"frames.npz: {sentence}|expected {sentence}"):
        load_frames(tmp_path)


def nested(depth: int, wide: int) -> bytes:
    """A pickle of a few hundred bytes whose lists hold the same lists over and over: wide ** depth numbers."""
    inner: object = [1.0] * wide
    for _ in range(depth):
        inner = [inner] * wide
    return pickle.dumps(inner)


def looped() -> bytes:
    inner: list[object] = []
    inner.append(inner)
    return pickle.dumps(inner)


DEFORM = {
    "lists over and over": (nested(8, 12), "found something else"),
    "rows over and over": (nested(2, 60), "the same over and over"),
    "deep lists": (nested(3, 3), "found something else|over and over"),
    "a list in itself": (looped(), "found something else|over and over"),
    "a far place": (b"\x80\x04]r\xff\xff\xff\x7f.", "found one that is not sound"),
    "a far place as text": (b"]p999999999999\n.", "found one that is not sound|cannot be read"),
    "texts": (pickle.dumps([[["1"] * 6] * 3] * 4), "found something else|over and over"),
}


@pytest.mark.parametrize("case", DEFORM)
def test_pickles_of_lists_cannot_grow(case: str, tmp_path: Path) -> None:
    content, sentence = DEFORM[case]
    (tmp_path / "0.pkl").write_bytes(content)
    before, begun = peak(), time.process_time()
    with pytest.raises(InputError, match=sentence):
        read_positions(tmp_path / "0.pkl")
    assert len(content) < 1000 and time.process_time() - begun < 1.0 and peak() - before < 50e6


def test_tensors_are_of_archives_without_code_and_of_bounded_size(tmp_path: Path) -> None:
    torch.save({"a": torch.ones(3)}, tmp_path / "good.pt")
    assert torch.equal(read_tensors(tmp_path / "good.pt", "weights")["a"], torch.ones(3))
    torch.save({"a": print}, tmp_path / "code.pt")
    (tmp_path / "old.pt").write_bytes(pickle.dumps({"a": 1}))
    os.mkfifo(tmp_path / "pipe.pt")
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("a/data.pkl", bytes(30 * 2**20))
    (tmp_path / "bomb.pt").write_bytes(buffer.getvalue())
    for name, sentence in (
        ("code.pt", "found something else"),
        ("old.pt", "found something else"),
        ("pipe.pt", "found a pipe"),
        ("bomb.pt", "at most 10 MB, found 31.5 MB once unpacked"),
        ("none.pt", "found none"),
    ):
        with pytest.raises(InputError, match=sentence):
            read_tensors(tmp_path / name, "weights", most=10**7)
