"""Meshes as rigid bodies: distances against closed forms, the cache, and what is refused."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from tests.coupling.tumbling import F64, ground, run
from torchdlo.coupling.bodies import mesh_sdf, shape_sdf, triangles
from torchdlo.errors import InputError
from torchdlo.physics.linalg.rotation import rotate

pytestmark = pytest.mark.quick

trimesh = pytest.importorskip("trimesh", reason="meshes need trimesh")

CELLS = 20
MADE = {
    "sphere": (lambda: trimesh.creation.icosphere(3, radius=0.05), (0.05,)),
    "box": (lambda: trimesh.creation.box((0.1, 0.06, 0.04)), (0.05, 0.03, 0.02)),
    "torus": (lambda: trimesh.creation.torus(0.05, 0.018, major_sections=48, minor_sections=24), (0.05, 0.018)),
}


def parts(kind: str) -> tuple[torch.Tensor, torch.Tensor]:
    made = MADE[kind][0]()
    return torch.tensor(made.vertices), torch.tensor(made.faces)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


@pytest.mark.parametrize("kind", MADE)
def test_distances_mass_and_inertia_are_those_of_the_closed_form(kind: str, folder: Path) -> None:
    sampled = mesh_sdf.sample_mesh(*parts(kind), cells=CELLS, cache=folder)
    size = torch.nn.functional.pad(torch.tensor(MADE[kind][1], dtype=F64), (0, 3 - len(MADE[kind][1])), value=1.0)
    cells = tuple(n - 1 for n in sampled.grid.shape)
    spacing = float(2 * sampled.size[0] / cells[0])
    g = torch.Generator().manual_seed(0)
    points = (2 * torch.rand(3000, 3, generator=g, dtype=F64) - 1) * sampled.size
    found = shape_sdf.distance("mesh", sampled.size[None], points, sampled.grid.reshape(1, -1), cells)
    known, normal = shape_sdf.probe(kind, size[None], points)
    # Trilinear interpolation of a function of gradient 1 is off by less than half a diagonal where it has a crease, and
    # of second derivatives up to 1/r by h^2/8 per axis elsewhere; the triangles lie within the surface themselves.
    assert (found - known).abs().max() < 0.87 * spacing
    smooth = known.abs() < spacing
    if kind != "box":
        radius = MADE[kind][1][-1] - spacing
        middles = sampled.vertices[sampled.faces].mean(1)
        facets = shape_sdf.distance(kind, size[None], middles).abs().max()
        assert (found - known)[smooth].abs().max() < 3 * spacing**2 / (8 * radius) + facets
        _, sloped = shape_sdf.probe("mesh", sampled.size[None], points, sampled.grid.reshape(1, -1), cells)
        assert ((sloped - normal).norm(dim=-1)[smooth[:, 0]]).max() < 3 * spacing / radius
    volume, moments = shape_sdf.bulk(kind, size)
    # Inscribed polygons of n sides: area less by (2 pi / n)^2 / 6, second moments by twice that. Of a torus, n is 24
    # and 48: 1.1 + 0.3 %. Triangles of the sphere are smaller.
    assert torch.allclose(sampled.volume, volume, rtol=0.015)
    assert torch.allclose(sampled.moments, moments, rtol=0.03)
    # Balls touch the surface from within.
    balls = shape_sdf.distance(kind, size[None], sampled.balls[:, :3])[:, 0] + sampled.balls[:, 3]
    assert balls.abs().max() < 0.3 * spacing


def test_distances_are_those_of_the_nearest_triangle() -> None:
    vertices, faces = parts("torus")
    axes = tuple(torch.linspace(-0.08, 0.08, n, dtype=F64) for n in (9, 10, 11))
    found = triangles.grid_distances(axes, vertices[faces])
    nodes = torch.cartesian_prod(*axes)
    all_pairs = torch.stack([triangles.triangle_distances(p[None], vertices[faces]).amin() for p in nodes])
    assert torch.allclose(found.flatten(), all_pairs, atol=1e-9)
    ring = ((nodes[:, :2].norm(dim=-1) - 0.05).square() + nodes[:, 2].square()).sqrt()
    clear = (ring - 0.018).abs() > 1e-3
    inside = triangles.grid_inside(axes, vertices[faces]).flatten()
    assert torch.equal(inside[clear], (ring < 0.018)[clear])


def test_a_moved_and_turned_mesh_keeps_its_place(folder: Path) -> None:
    vertices, faces = parts("box")
    angle = torch.tensor(0.6, dtype=F64)
    turn = torch.tensor([[angle.cos(), -angle.sin(), 0], [angle.sin(), angle.cos(), 0], [0, 0, 1]], dtype=F64)
    shifted = vertices @ turn.T + torch.tensor([0.3, -0.1, 0.2], dtype=F64)
    sampled = mesh_sdf.sample_mesh(shifted, faces, cells=CELLS, cache=folder)
    body = sampled.solid(density=700.0)
    assert torch.allclose(torch.as_tensor(body.pos), torch.tensor([0.3, -0.1, 0.2], dtype=F64), atol=1e-9)
    back = rotate(torch.as_tensor(body.quat).expand(len(vertices), 4), sampled.vertices)
    assert torch.allclose(back + body.pos, shifted, atol=1e-9)
    assert torch.allclose(torch.as_tensor(body.mass), torch.tensor(700.0 * 0.1 * 0.06 * 0.04, dtype=F64))


def test_the_cache_returns_the_same_bits_and_mends_itself(tmp_path: Path) -> None:
    vertices, faces = parts("box")

    def sampled() -> dict[str, torch.Tensor]:
        return vars(mesh_sdf.sample_mesh(vertices, faces, cells=8, cache=tmp_path))

    first = sampled()
    (file,) = tmp_path.iterdir()
    written = file.read_bytes()
    before = file.stat().st_mtime_ns
    again = sampled()
    assert file.stat().st_mtime_ns == before
    assert all(torch.equal(first[k], again[k]) for k in first)
    for broken in (written[: len(written) // 2], written[:-1] + bytes([written[-1] ^ 1]), b""):
        file.write_bytes(broken)
        mended = sampled()
        assert all(torch.equal(first[k], mended[k]) for k in first)
        assert mesh_sdf._read(file) is not None
    mesh_sdf.sample_mesh(vertices, faces, cells=9, cache=tmp_path)
    assert len(list(tmp_path.iterdir())) == 2


def test_an_unwritable_cache_costs_only_time(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    assert mesh_sdf.sample_mesh(*parts("box"), cells=8, cache=tmp_path / "file").volume > 0


def test_files_are_read_in_their_unit(tmp_path: Path) -> None:
    made = MADE["box"][0]()
    made.apply_scale(1000.0)
    made.export(tmp_path / "box.stl")
    with pytest.raises(InputError, match=r"100 m long.*scale=0.001"):
        mesh_sdf.load_mesh(tmp_path / "box.stl", cache=tmp_path)
    found = mesh_sdf.load_mesh(tmp_path / "box.stl", scale=1e-3, cells=8, cache=tmp_path)
    assert torch.allclose(found.volume, torch.tensor([2.4e-4], dtype=F64))


def test_what_has_no_inside_is_refused(tmp_path: Path) -> None:
    vertices, faces = parts("box")
    for wrong, message in (
        (faces[1:], r"3 of its 18 edges are open.*fill_holes"),
        (torch.cat([faces, faces[:1]]), "more than two"),
        (torch.cat([faces[:1].flip(-1), faces[1:]]), "fix_normals"),
    ):
        with pytest.raises(InputError, match=message):
            mesh_sdf.sample_mesh(vertices, wrong, cache=tmp_path)
    with pytest.raises(InputError, match="no such file"):
        mesh_sdf.load_mesh(tmp_path / "none.stl")
    (tmp_path / "text.stl").write_text("solid nothing")
    with pytest.raises(InputError, match=r"text\.stl"):
        mesh_sdf.load_mesh(tmp_path / "text.stl")
    with pytest.raises(ValueError, match="cells is 1"):
        mesh_sdf.sample_mesh(vertices, faces, cells=1)


def test_a_surface_that_is_inside_out_is_turned(tmp_path: Path) -> None:
    vertices, faces = parts("box")
    assert mesh_sdf.sample_mesh(vertices, faces.flip(-1), cells=8, cache=tmp_path).volume > 0


def test_a_mesh_lands_and_stands(folder: Path) -> None:
    box = mesh_sdf.sample_mesh(*parts("box"), cells=CELLS, cache=folder)
    _, _, end = run([ground(), box.solid((0, 0, 0.022), density=500.0), box.solid((0, 0, 0.065), mass=0.1)], 0.3, 5e-3)
    # Its balls are inside by less than a third of a cell of 5 mm.
    assert end.pos[1, 2] == pytest.approx(0.02, abs=2e-3)
    assert end.pos[2, 2] == pytest.approx(0.06, abs=4e-3)
    assert end.vel[1:].norm(dim=-1).max() < 1e-3
