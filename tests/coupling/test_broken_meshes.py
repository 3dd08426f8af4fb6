"""Meshes and robots that are broken, too large, or need what is not there are refused in a sentence."""

from __future__ import annotations

import zipfile
from pathlib import Path

import pytest

from torchdlo.coupling.bodies.mesh_sdf import load_mesh
from torchdlo.coupling.robot import urdf
from torchdlo.errors import InputError

pytestmark = pytest.mark.quick


def archive(path: Path, **members: str) -> None:
    with zipfile.ZipFile(path, "w") as file:
        for name, content in members.items():
            file.writestr(name.replace("__", "/") + ".model", content)


BROKEN = {
    "a.3mf": lambda p: archive(p, x="<"),
    "b.3mf": lambda p: p.write_bytes(b"PK\x03\x04 cut"),
    "c.3mf": lambda p: archive(p, **{"3D__3dmodel": "<model><resources/></model>"}),
    "a.stl": lambda p: p.write_bytes(b"solid x\nfacet normal 0 0\n"),
    "b.stl": lambda p: p.write_bytes(bytes(80) + b"\xff\xff\xff\xff"),
    "a.ply": lambda p: p.write_bytes(b"ply\nformat ascii 1.0\nelement vertex 3\nend_header\n"),
    "a.obj": lambda p: p.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 1000000000\n"),
    "a.off": lambda p: p.write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n"),
    "a.glb": lambda p: p.write_bytes(b"glTF\x02\0\0\0\xff\xff\xff\xff"),
    "a.gltf": lambda p: p.write_text('{"asset": {"version": "2.0"}, "meshes": [{"primitives": [{}]}]}'),
    "a.xyz": lambda p: p.write_text("0 0 0\n"),
    "a": lambda p: p.write_text("no"),
    "empty.stl": lambda p: p.write_bytes(b""),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_meshes_are_refused_in_a_sentence(name: str, tmp_path: Path) -> None:
    pytest.importorskip("trimesh")
    BROKEN[name](tmp_path / name)
    with pytest.raises(InputError) as caught:
        load_mesh(tmp_path / name, cache=tmp_path / "cache")
    said = str(caught.value)
    assert said.startswith(str(tmp_path / name)) and "\n" not in said and len(said) < 500


def test_a_reader_that_is_not_there_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trimesh = pytest.importorskip("trimesh")

    def lacking(*_: object, **__: object) -> None:
        raise ModuleNotFoundError("No module named 'collada'", name="collada")

    monkeypatch.setattr(trimesh, "load_mesh", lacking)
    (tmp_path / "arm.dae").write_text("<COLLADA/>")
    with pytest.raises(
        InputError, match=r"arm.dae: the reader of .dae cannot be used \(needs the package collada\); .* convert"
    ):
        load_mesh(tmp_path / "arm.dae")


def chain(count: int) -> str:
    links = "".join(f'<link name="l{k}"/>' for k in range(count + 1))
    joint = '<joint name="j{0}" type="fixed"><parent link="l{0}"/><child link="l{1}"/></joint>'
    return f'<robot name="r">{links}{"".join(joint.format(k, k + 1) for k in range(count))}</robot>'


ROBOTS = {
    "a long chain": (chain(1500), "has 1500 joints; expected at most 500"),
    "deep elements": ("<robot>" + "<a>" * 100_000, "is not complete XML"),
    "entities": (
        '<!DOCTYPE r [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;">]><robot name="&b;"/>',
        "",
    ),
    "a huge number": (
        chain(1).replace('type="fixed">', 'type="fixed"><origin xyz="1e300 0 0"/>'),
        r"xyz is '1e300 0 0'; expected 3 finite number\(s\) up to 1e.06",
    ),
    "an endless number": (
        chain(1).replace('type="fixed">', f'type="fixed"><origin xyz="{"1" * 10_000} 0 0"/>'),
        r"xyz is '1+\.\.\.; expected 3 finite",
    ),
    "a lone surrogate": ("<robot>\udce9</robot>", "is not complete XML"),
}


@pytest.mark.parametrize("case", ROBOTS)
def test_robots_that_are_none_are_refused_in_a_sentence(case: str) -> None:
    text, sentence = ROBOTS[case]
    with pytest.raises(InputError, match=sentence) as caught:
        urdf.read_urdf(text)
    assert len(str(caught.value)) < 500
    assert len(urdf.read_urdf(chain(400)).joints) == 400
