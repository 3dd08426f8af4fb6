"""Matter as particles on a grid: what is static, what one may learn, what evolves, and how a scene of it is built."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import torch
from torch import Tensor

from torchdlo.coupling.mpm.constitutive_models import ConstitutiveModel
from torchdlo.physics import tree
from torchdlo.physics.effects.base import Values
from torchdlo.physics.execution import replay

WALLS = ("open", "separate", "slip", "stick")
"""What a side of the box is: nothing; a wall that lets go, with friction; one that holds matter along its normal only;
one that holds it."""

T = TypeVar("T")

MARGIN = 2
"""Layers of nodes outside of the box."""


@dataclass(frozen=True)
class Group:
    """Particles of one law, next to each other on the particle axis."""

    name: str
    law: ConstitutiveModel
    count: int


@dataclass(frozen=True)
class Grid:
    """The box in which matter may be, and its nodes; the same for all scenes of a batch."""

    low: tuple[float, float, float]
    """Lower faces of the box [m]."""
    high: tuple[float, float, float]
    """Upper faces of the box, whole numbers of spacings above the lower ones [m]."""
    spacing: float
    """Distance of nodes [m]."""
    walls: tuple[str, str, str, str, str, str] = ("separate",) * 6
    """What the faces -x, +x, -y, +y, -z, +z are, see `WALLS`."""
    window: tuple[int, int, int] | None = None
    """Nodes that are computed, a block that follows each scene's matter; None computes the whole box. Matter that does
    not fit into its window is reported, see `outside`."""

    def __post_init__(self) -> None:
        if not self.spacing > 0:
            raise ValueError(f"grid: spacing is {self.spacing}; expected a positive length in metres")
        for low, high in zip(self.low, self.high, strict=True):
            cells = (high - low) / self.spacing
            if round(cells) < 1 or abs(cells - round(cells)) > 1e-6 * cells:
                raise ValueError(
                    f"grid: the box reaches from {low} to {high} m, {cells:.6g} spacings of {self.spacing} m; expected "
                    f"a whole number, e.g. {low + max(1, round(cells)) * self.spacing:.6g} m as the upper face"
                )
        if len(self.walls) != 6 or any(w not in WALLS for w in self.walls):
            raise ValueError(f"grid: walls are {self.walls}; expected six of {WALLS}, for -x, +x, -y, +y, -z, +z")
        if self.window is not None and (len(self.window) != 3 or min(self.window) < 5):
            raise ValueError(f"grid: window is {self.window}; expected three numbers of nodes, at least 5 each")

    @property
    def nodes(self) -> tuple[int, int, int]:
        """Nodes along each axis, those of the margin included."""
        x, y, z = (
            round((high - low) / self.spacing) + 1 + 2 * MARGIN for low, high in zip(self.low, self.high, strict=True)
        )
        return x, y, z

    @property
    def size(self) -> tuple[int, int, int]:
        """Nodes along each axis that are computed."""
        whole = self.nodes
        if self.window is None:
            return whole
        x, y, z = (min(w, n) for w, n in zip(self.window, whole, strict=True))
        return x, y, z

    @property
    def first(self) -> tuple[float, float, float]:
        """Where the first node is [m]."""
        x, y, z = (low - MARGIN * self.spacing for low in self.low)
        return x, y, z


@dataclass(frozen=True)
class MpmDomain:
    """The static side of all matter of a scene; hashable, without tensors."""

    grid: Grid
    groups: tuple[Group, ...]

    @property
    def count(self) -> int:
        """Number of particles, P."""
        return sum(g.count for g in self.groups)

    def pieces(self) -> list[tuple[Group, slice]]:
        """Return the groups with their places on the particle axis."""
        found, start = [], 0
        for group in self.groups:
            found.append((group, slice(start, start + group.count)))
            start += group.count
        return found


@tree.struct
class ParticleParams:
    """Numbers of matter that stay the same along a rollout."""

    volume: Tensor
    """Volume of particles at rest [m^3], shape (..., P, 1)."""
    friction: Tensor
    """Coefficient of friction at walls that let go [1], shape (..., 1, 1)."""
    laws: dict[str, dict[str, Tensor]]
    """Numbers of each group's law and its "density" by their names, shape (..., n or 1, 1)."""


@tree.struct
class Particles:
    """What evolves. Stored as (..., C, P): one component of all particles of a scene side by side."""

    pos: Tensor
    """Positions [m], shape (..., P, 3)."""
    vel: Tensor
    """Velocities half a substep before `pos` (at the start: with it) [m/s], shape (..., P, 3)."""
    affine: Tensor
    """Velocity gradients, row by row [1/s], shape (..., P, 9)."""
    strain: Tensor
    """F F^T - I of the elastic deformation before the motion that `affine` is part of: xx, yy, zz, xy, xz, yz [1],
    shape (..., P, 6)."""
    history: Tensor
    """What else the law remembers, see `laws` [1], shape (..., P, 1)."""


@dataclass(frozen=True)
class ParticleBlock:
    """Some matter, as one hands it in."""

    positions: Tensor
    """Where particles are [m], shape (..., n, 3)."""
    law: ConstitutiveModel
    volume: float | Tensor
    """Volume of each particle [m^3], one number or shape (..., n)."""
    velocity: Tensor | None = None
    """Velocities [m/s], shape (..., n, 3) or (3,); None for rest."""
    numbers: dict[str, float | Tensor] = field(default_factory=dict)
    """Numbers of the law and "density" [kg/m^3] that differ from their defaults; a tensor has shape (...) per scene."""


def fill_box(low: Sequence[float], high: Sequence[float], spacing: float, like: Tensor | None = None) -> Tensor:
    """Return the points of a cubic lattice inside a box, half a spacing or less off its faces, shape (n, 3)."""
    like = torch.zeros(()) if like is None else like
    axes = []
    for a, b in zip(low, high, strict=True):
        count = max(1, round((b - a) / spacing))
        start = 0.5 * (a + b - (count - 1) * spacing)
        axes.append(start + spacing * torch.arange(count, dtype=like.dtype, device=like.device))
    return torch.cartesian_prod(*axes)


def fill_ball(centre: Sequence[float], radius: float, spacing: float, like: Tensor | None = None) -> Tensor:
    """Return the points of a cubic lattice inside a ball, shape (n, 3)."""
    points = fill_box([-radius] * 3, [radius] * 3, spacing, like)
    return points[points.norm(dim=-1) <= radius] + points.new_tensor(list(centre))


def rows_of(x: Tensor) -> Tensor:
    """Return a view of (..., P, C) in the order of its storage, (..., C, P), or of that in the logical order."""
    return x.mT


def stored(x: Tensor) -> Tensor:
    """Return (..., P, C) with the same values stored as (..., C, P)."""
    return rows_of(rows_of(x).contiguous())


def laid_out(state: T) -> T:
    """Return the state of a scene, stored to the last stride as compiled steps expect it; matter in its own order."""
    whole: Any = state
    particles = replay.laid_out(whole.material_points, rows_of, rows_of)
    return tree.replace(replay.laid_out(tree.replace(state, material_points=())), material_points=particles)


def assemble(
    blobs: Sequence[ParticleBlock], grid: Grid, *, friction: float | Tensor = 0.3
) -> tuple[MpmDomain, ParticleParams, Particles]:
    """Put matter on one particle axis.

    Args:
        blobs: the matter.
        grid: box and nodes.
        friction: coefficient at walls that let go, one number or per scene.
    """
    if not blobs:
        raise ValueError("matter: no blob given; expected at least one")
    batch = torch.broadcast_shapes(*(b.positions.shape[:-2] for b in blobs))
    like, groups, laws = blobs[0].positions, [], {}
    parts: dict[str, list[Tensor]] = {"pos": [], "vel": [], "volume": []}
    for index, blob in enumerate(blobs):
        name = f"{blob.law.name}_{index}"
        _check(name, blob, grid)
        x = blob.positions.to(like).expand(*batch, *blob.positions.shape[-2:])
        velocity = like.new_zeros(3) if blob.velocity is None else blob.velocity.to(like)
        parts["pos"].append(x)
        parts["vel"].append(velocity.expand_as(x))
        volume = torch.as_tensor(blob.volume, dtype=like.dtype, device=like.device)
        parts["volume"].append(volume.expand(*batch, x.shape[-2]).unsqueeze(-1))
        groups.append(Group(name, blob.law, x.shape[-2]))
        laws[name] = _numbers(blob, like)
    pos, vel, volume = (stored(torch.cat(parts[n], -2)) for n in ("pos", "vel", "volume"))
    zero = pos.new_zeros(*batch, 9, pos.shape[-2]).mT
    particles = Particles(pos, vel, zero, zero[..., :6].mT.clone().mT, zero[..., :1].mT.clone().mT)
    rub = torch.as_tensor(friction, dtype=like.dtype, device=like.device)[..., None, None]
    return MpmDomain(grid, tuple(groups)), ParticleParams(volume, rub, laws), particles


def _numbers(blob: ParticleBlock, like: Tensor) -> Values:
    declared = {**blob.law.params, "density": blob.law.density}
    given = {n: torch.as_tensor(v, dtype=like.dtype, device=like.device) for n, v in blob.numbers.items()}
    return {
        n: (given[n] if n in given else like.new_tensor(p.default))[..., None, None].clone()
        for n, p in declared.items()
    }


def _check(name: str, blob: ParticleBlock, grid: Grid) -> None:
    x = blob.positions
    if x.dim() < 2 or x.shape[-1] != 3 or not x.is_floating_point():
        raise ValueError(f"{name}: positions are {tuple(x.shape)}; expected a float tensor (..., n, 3) in metres")
    low, high = x.new_tensor(grid.low), x.new_tensor(grid.high)
    if not bool(((x >= low) & (x <= high)).all()):
        raise ValueError(
            f"{name}: particles lie between {x.amin((*range(x.dim() - 1),)).tolist()} and "
            f"{x.amax((*range(x.dim() - 1),)).tolist()} m; expected all inside the box {grid.low} to {grid.high}"
        )
    declared = {**blob.law.params, "density": blob.law.density}
    for key, value in blob.numbers.items():
        if key not in declared:
            raise ValueError(f"{name}: {blob.law.name} has no number {key!r}; it has {sorted(declared)}")
        value, least = torch.as_tensor(value, dtype=torch.float64), 0.0
        positive = declared[key].scale == "log"
        below = 0.5 if key == "poisson" else math.inf
        if not bool(((value > least if positive else value >= least) & (value < below)).all()):
            wanted = "a positive number" if positive else f"at least 0 and below {below:g}"
            raise ValueError(f"{name}: {key} is {value.flatten().tolist()[:3]}; expected {wanted}")
    if not bool((torch.as_tensor(blob.volume) > 0).all()):
        raise ValueError(f"{name}: volume has to be positive; give the volume of one particle in m^3, spacing^3")
