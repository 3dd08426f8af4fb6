"""Rigid bodies from meshes: a grid of signed distances, mass and inertia, and points where they touch others.

A mesh is sampled once: the grid is kept in the cache folder under a hash of its vertices, faces and options. In the
simulation it costs as much as any other shape, however many triangles the mesh has. What the grid cannot show are
edges and walls thinner than its spacing: edges are rounded by about a spacing.
"""

from __future__ import annotations

import hashlib
import io
import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchdlo import work_budget
from torchdlo.coupling.bodies import shape_sdf, triangles
from torchdlo.coupling.bodies.dynamics import RigidBody
from torchdlo.errors import InputError
from torchdlo.files import write_atomically
from torchdlo.physics.linalg import rotation
from torchdlo.physics.linalg.numerics import normalize
from torchdlo.physics.tree import replace, struct
from torchdlo.untrusted import one_line, open_regular

VERSION = 1
"""Counts up when sampling gives other numbers, so that old files of the cache are not read."""
_LARGEST_FILE = 512 * 2**20
"""Largest file of a mesh [bytes]."""
SMALLEST, LARGEST = 1e-3, 10.0
"""Lengths of meshes [m] outside of which the unit is taken to be wrong."""
MARGIN = 3
"""Cells between a mesh and the border of its grid."""
INSET = 1.5
"""How far below the surface the balls of contact stand, in cells."""


@struct
class MeshShape:
    """A mesh, sampled. Its frame has the centre of mass at the origin and the principal axes along x, y, z."""

    grid: Tensor
    """Signed distances at the corners of cells, negative inside [m], shape (nx, ny, nz)."""
    size: Tensor
    """Half lengths of the grid [m], shape (3,)."""
    balls: Tensor
    """Balls that touch the surface from within: centre and radius [m], shape (P, 4)."""
    volume: Tensor
    """Volume [m^3], shape (1,)."""
    moments: Tensor
    """Principal moments of inertia per mass [m^2], shape (3,)."""
    centre: Tensor
    """Centre of mass in the frame of the file [m], shape (3,)."""
    axes: Tensor
    """Unit quaternion that turns principal axes into those of the file [1], shape (4,)."""
    vertices: Tensor
    """Vertices, for pictures [m], shape (V, 3)."""
    faces: Tensor
    """Vertices of the triangles, outwards oriented [-], int64, shape (F, 3)."""

    def solid(self, pos: Any = (0.0, 0.0, 0.0), quat: Any = (1.0, 0.0, 0.0, 0.0), **fields: Any) -> RigidBody:
        """Return a body of this shape.

        Args:
            pos: where the origin of the file stands [m], shape (..., 3).
            quat: how the axes of the file are turned, (w, x, y, z), shape (..., 4).
            fields: other fields of `RigidBody`, such as density or mass.
        """
        pos, quat = (torch.as_tensor(x, dtype=self.grid.dtype) for x in (pos, quat))
        quat = quat / quat.norm(dim=-1, keepdim=True)
        if "density" in fields:
            fields["mass"] = fields.pop("density") * self.volume[0]
        if "mass" in fields:
            mass = torch.as_tensor(fields["mass"], dtype=self.grid.dtype)
            fields.setdefault("inertia", mass.unsqueeze(-1) * self.moments)
        stands = pos + rotation.rotate(quat, self.centre.expand_as(pos))
        turned = rotation.multiply(quat, self.axes.expand_as(quat))
        return RigidBody("mesh", self.size, stands, turned, grid=self.grid, balls=self.balls, **fields)


@dataclass(frozen=True)
class Sampling:
    """How a mesh is sampled."""

    cells: int = 48
    """Cells along the longest side of the mesh."""
    balls: int = 64
    """Points of the surface at which it may touch other bodies."""

    def __post_init__(self) -> None:
        for name, least in (("cells", 4), ("balls", 4)):
            if not getattr(self, name) >= least:
                raise ValueError(f"mesh: {name} is {getattr(self, name)}; expected at least {least}")


def load_mesh(path: str | Path, *, scale: float = 1.0, cache: Path | None = None, **sampling: int) -> MeshShape:
    """Read a closed surface from any file that trimesh reads, and sample it.

    Args:
        path: the file.
        scale: metres per unit of the file; 0.001 for millimetres.
        cache: folder for sampled meshes; TORCHDLO_CACHE or ~/.cache/torchdlo if not given.
        sampling: fields of `Sampling`.
    """
    trimesh = _trimesh()
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: there is no such file; expected a mesh (STL, OBJ, PLY, GLB, OFF, ...).")
    open_regular(path, "a mesh", most=_LARGEST_FILE).close()
    try:
        mesh = trimesh.load_mesh(path)
    except ImportError as error:
        lacking = f"needs the package {error.name}" if error.name else one_line(error, 80)
        raise InputError(
            f"{path}: the reader of {path.suffix or 'such files'} cannot be used ({lacking}); install that, or "
            "convert the mesh to STL, PLY or OBJ."
        ) from None
    except Exception as error:  # readers of many formats meet damage in as many ways
        said = one_line(str(error) or type(error).__name__, 120)
        raise InputError(
            f"{path}: trimesh cannot read it as a mesh ({said}); is it complete? If so, convert it to STL, PLY or OBJ."
        ) from None
    if not len(getattr(mesh, "faces", ())) or not len(mesh.vertices):
        raise InputError(f"{path}: holds no triangles; expected a closed surface.")
    low, high = int(mesh.faces.min()), int(mesh.faces.max())
    if low < 0 or high >= len(mesh.vertices):
        wrong = low if low < 0 else high
        raise InputError(
            f"{path}: has a triangle with vertex {wrong}; expected 0 to {len(mesh.vertices) - 1}: mend the mesh."
        )
    vertices, faces = torch.tensor(mesh.vertices), torch.tensor(mesh.faces)
    return sample_mesh(vertices, faces, scale=scale, cache=cache, name=str(path), **sampling)


def sample_mesh(
    vertices: Tensor,
    faces: Tensor,
    *,
    scale: float = 1.0,
    cache: Path | None = None,
    name: str = "mesh",
    **sampling: int,
) -> MeshShape:
    """Sample a closed surface of triangles.

    Args:
        vertices: corners, in units of `scale`, shape (V, 3).
        faces: vertices of the triangles, shape (F, 3).
        scale: metres per unit.
        cache: as in `load_mesh`.
        name: what messages call it.
        sampling: fields of `Sampling`.
    """
    options = Sampling(**sampling)
    vertices, faces = vertices.to(torch.float64).cpu() * scale, faces.to(torch.int64).cpu()
    faces = _checked(vertices, faces, name)
    digest = hashlib.sha256(f"{VERSION} {options} {tuple(vertices.shape)}".encode())
    for part in (vertices, faces):
        digest.update(part.contiguous().numpy().tobytes())
    folder = cache or Path(os.environ.get("TORCHDLO_CACHE", Path.home() / ".cache" / "torchdlo"))
    file = folder / f"mesh-{digest.hexdigest()[:32]}.pt"
    known = _read(file)
    if known is not None:
        return MeshShape(**known)
    made = _sampled(vertices, faces, options, name)
    _write(file, vars(made))
    return made


def _trimesh() -> Any:
    try:
        import trimesh
    except ImportError:
        raise InputError("mesh: needs the package trimesh; install it with pip install trimesh==5.2.0.") from None
    return trimesh


def _checked(vertices: Tensor, faces: Tensor, name: str) -> Tensor:
    """Return the faces, oriented outwards; refuse what has no inside or is of another unit."""
    if not bool(torch.isfinite(vertices).all()):
        raise InputError(f"{name}: has vertices that are not finite; mend the mesh.")
    edges, count, balance = triangles.edge_counts(faces)
    loose, crowded = count == 1, count > 2
    turned = (count == 2) & (balance != 0)
    for wrong, what, cure in (
        (loose, "are open (belong to one triangle)", "close its holes, e.g. with trimesh.repair.fill_holes(mesh)"),
        (crowded, "belong to more than two triangles", "remove inner walls and doubled faces"),
        (turned, "join triangles of opposite orientation", "orient it with trimesh.repair.fix_normals(mesh)"),
    ):
        if bool(wrong.any()):
            first = vertices[edges[wrong][0]].mean(0)
            where = ", ".join(f"{x:.4g}" for x in first.tolist())
            raise InputError(
                f"{name}: is not watertight: {int(wrong.sum())} of its {len(edges)} edges {what}, the first at "
                f"({where}) m; {cure}, or export it as a closed solid."
            )
    longest = float((vertices.amax(0) - vertices.amin(0)).amax())
    if not SMALLEST <= longest <= LARGEST:
        guess = f"scale={1e-3 if longest > LARGEST else 1e3:g}"
        raise InputError(
            f"{name}: is {longest:.4g} m long; expected {SMALLEST:g} to {LARGEST:g} m. Give scale, the metres per unit "
            f"of the file ({guess} if that is the unit)."
        )
    volume = triangles.enclosed_volume(vertices[faces])
    if abs(volume) < 1e-9 * longest**3:
        raise InputError(f"{name}: encloses no volume; expected a solid.")
    return faces if volume > 0 else faces.flip(-1)


def _sampled(vertices: Tensor, faces: Tensor, options: Sampling, name: str) -> MeshShape:
    solid = _trimesh().Trimesh(vertices.numpy(), faces.numpy(), process=False)
    centre, inertia = torch.tensor(solid.center_mass), torch.tensor(solid.moment_inertia)
    volume = torch.tensor([float(solid.volume)], dtype=torch.float64)
    turn = _principal(inertia)
    vertices = (vertices - centre) @ turn
    corners = vertices[faces]
    half, step = vertices.abs().amax(0), float((vertices.amax(0) - vertices.amin(0)).amax()) / options.cells
    cells = [2 * math.ceil(float(h) / step + MARGIN) for h in half]
    nodes = float(math.prod(n + 1 for n in cells))
    work = f"{options.cells} cells along the longest side, {nodes:.4g} in all,"
    work_budget.check(name, work, memory=30 * nodes, seconds=2e-5 * nodes, cure="use fewer cells")
    size = torch.tensor([0.5 * n * step for n in cells], dtype=torch.float64)
    axes = tuple(
        torch.linspace(-float(s), float(s), n + 1, dtype=torch.float64) for s, n in zip(size, cells, strict=True)
    )
    grid = triangles.grid_distances(axes, corners)
    grid = torch.where(triangles.grid_inside(axes, corners), -grid, grid)
    shape = MeshShape(
        grid=grid,
        size=size,
        balls=grid.new_zeros(0, 4),
        volume=volume,
        moments=torch.diagonal(turn.T @ inertia @ turn) / volume,
        centre=centre,
        axes=_quaternion(turn),
        vertices=vertices,
        faces=faces,
    )
    return replace(shape, balls=_balls(shape, INSET * step, options.balls))


def _principal(inertia: Tensor) -> Tensor:
    """Return principal axes as the columns of a rotation; those of the file where they are principal."""
    off = inertia - torch.diag(torch.diagonal(inertia))
    if float(off.abs().max()) < 1e-6 * float(inertia.diagonal().max()):
        return torch.eye(3, dtype=inertia.dtype)
    turn = torch.linalg.eigh(inertia).eigenvectors
    return turn * torch.det(turn).sign()


def _quaternion(turn: Tensor) -> Tensor:
    """Return the unit quaternion of a rotation matrix: the null vector of q -> R q - q R, shape (4,)."""
    # Bar-Itzhack 2000, doi:10.2514/2.4654: the eigenvector of the largest eigenvalue of K.
    r, t = turn, turn.trace()
    axis = torch.stack([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])
    rest = r + r.T - t * torch.eye(3, dtype=r.dtype)
    k = torch.cat([torch.cat([t[None], axis])[None], torch.cat([axis[:, None], rest], 1)])
    return torch.linalg.eigh(k).eigenvectors[:, -1]


def _sharpness(corners: Tensor, faces: Tensor, count: int) -> Tensor:
    """Return by how much the angles of triangles round each vertex fall short of a full turn [rad], shape (V,)."""
    rest = torch.full((count,), 2 * math.pi, dtype=corners.dtype)
    for i in range(3):
        at, p, q = corners[:, i], corners[:, (i + 1) % 3], corners[:, (i + 2) % 3]
        sine = torch.linalg.cross(p - at, q - at).norm(dim=-1)
        rest = rest.index_add(0, faces[:, i], -torch.atan2(sine, ((p - at) * (q - at)).sum(-1)))
    return rest


def _spread_points(shape: MeshShape, count: int) -> Tensor:
    """Return points of the surface (count, 3) far from each other, sharp corners first."""
    corners = shape.vertices[shape.faces]
    a, b, c = corners.unbind(1)
    area = torch.linalg.cross(b - a, c - a).norm(dim=-1)
    # Vertices, and points evenly over the area: of the low-discrepancy sequence R2 of Roberts 2018.
    n = torch.arange(1, 16 * count + 1, dtype=torch.float64)
    face = torch.searchsorted(area.cumsum(0) / area.sum(), (n - 0.5) / len(n)).clamp(max=len(area) - 1)
    u, v = (n * 0.7548776662466927) % 1, (n * 0.5698402909980532) % 1
    over = u + v > 1
    u, v = torch.where(over, 1 - u, u)[:, None], torch.where(over, 1 - v, v)[:, None]
    inner = a[face] + u * (b - a)[face] + v * (c - a)[face]
    used = torch.unique(shape.faces)
    points = torch.cat([shape.vertices[used], inner])
    sharp = _sharpness(corners, shape.faces, len(shape.vertices))[used].clamp(0, 1)
    weight = torch.cat([1 + 3 * sharp, torch.ones(len(inner), dtype=torch.float64)])
    chosen = [int((weight * points.norm(dim=-1)).argmax())]
    far = (points - points[chosen[0]]).norm(dim=-1)
    for _ in range(count - 1):
        chosen.append(int((weight * far).argmax()))
        far = torch.minimum(far, (points - points[chosen[-1]]).norm(dim=-1))
    return points[chosen]


def _balls(shape: MeshShape, inset: float, count: int) -> Tensor:
    """Return balls (count, 4) within a mesh that touch its surface. At corners they are smaller than their inset."""
    surface = _spread_points(shape, count)
    cells, flat = tuple(n - 1 for n in shape.grid.shape), shape.grid.reshape(1, -1)

    def distance(points: Tensor) -> Tensor:
        return shape_sdf.distance("mesh", shape.size, points, flat, cells)

    # A normal over the width of the inset leads away from all faces of a corner.
    step = inset * torch.eye(3, dtype=torch.float64)
    normal = normalize(torch.cat([distance(surface + e) - distance(surface - e) for e in step], -1))
    within = surface - inset * normal
    # Where the body is too thin for a ball, it is a point of the surface.
    sunk = distance(within) < 0
    corners = shape.vertices[shape.faces]
    radius = torch.stack([triangles.triangle_distances(m[None], corners).amin(-1) for m in within])
    return torch.where(sunk, torch.cat([within, radius], -1), torch.cat([surface, torch.zeros_like(radius)], -1))


def _write(file: Path, content: dict[str, Tensor]) -> None:
    stored = io.BytesIO()
    torch.save(content, stored)
    try:
        write_atomically(file, hashlib.sha256(stored.getbuffer()).digest() + stored.getvalue())
    except OSError:
        # Without a writable folder every run samples anew; that costs time and nothing else.
        return


def _read(file: Path) -> dict[str, Tensor] | None:
    """Return what a file holds, or None if it is not there or not as it was written."""
    try:
        content = file.read_bytes()
    except OSError:
        return None
    digest, stored = content[:32], content[32:]
    if hashlib.sha256(stored).digest() != digest:
        return None
    return torch.load(io.BytesIO(stored), weights_only=True)
