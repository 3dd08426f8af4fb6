"""Signed distances: against sampled surfaces, gradients, volumes, and derivatives."""

from __future__ import annotations

import itertools
import math

import pytest
import torch

from torchdlo.coupling.bodies import shape_sdf

pytestmark = pytest.mark.quick

F64 = torch.float64
SIZES = {
    "plane": (1.0, 1.0, 1.0),
    "sphere": (0.3, 1.0, 1.0),
    "box": (0.3, 0.2, 0.4),
    "capsule": (0.2, 0.3, 1.0),
    "cylinder": (0.3, 0.2, 1.0),
    "cone": (0.3, 0.5, 1.0),
    "torus": (0.3, 0.1, 1.0),
    "ring": (0.3, 0.1, 4.0),
}
EACH = pytest.mark.parametrize("shape", SIZES)
SOLID = pytest.mark.parametrize("shape", [s for s in SIZES if s != "plane"])


def size_of(shape: str) -> torch.Tensor:
    return torch.tensor([SIZES[shape]], dtype=F64)


def turned(profile: torch.Tensor, count: int) -> torch.Tensor:
    """Points (n, 2) of a radius and a height, turned about z."""
    angle = torch.linspace(0, 2 * math.pi, count, dtype=F64)[:-1, None]
    rho, z = profile[:, 0], profile[:, 1].expand(len(angle), -1)
    return torch.stack([rho * torch.cos(angle), rho * torch.sin(angle), z], -1).reshape(-1, 3)


def along(*corners: tuple[float, float], count: int = 60) -> torch.Tensor:
    f = torch.linspace(0, 1, count, dtype=F64)[:, None]
    at = torch.tensor(corners, dtype=F64)
    return torch.cat([(1 - f) * a + f * b for a, b in itertools.pairwise(at)])


def circle(a: float, start: float, end: float, count: int = 60) -> torch.Tensor:
    t = torch.linspace(start, end, count, dtype=F64)
    return a * torch.stack([torch.cos(t), torch.sin(t)], -1)


def surface(shape: str) -> torch.Tensor:
    """Points (n, 3) on a surface, made from what the shape is and not from its distance."""
    a, b, c = SIZES[shape]
    if shape == "sphere":
        return turned(circle(a, -math.pi / 2, math.pi / 2), 120)
    if shape == "cylinder":
        return turned(along((0, -b), (a, -b), (a, b), (0, b)), 160)
    if shape == "cone":
        return turned(along((0, -b / 4), (a, -b / 4), (0, 0.75 * b), count=80), 160)
    if shape == "capsule":
        upper, lower = circle(a, 0, math.pi / 2, 40), circle(a, -math.pi / 2, 0, 40)
        high = torch.tensor([0, b], dtype=F64)
        return turned(torch.cat([lower - high, along((a, -b), (a, b)), upper + high]), 140)
    if shape == "torus":
        return turned(circle(b, 0, 2 * math.pi) + torch.tensor([a, 0], dtype=F64), 160)
    if shape == "box":
        f = torch.linspace(-1, 1, 45, dtype=F64)
        u, v = (x.reshape(-1) for x in torch.meshgrid(f, f, indexing="ij"))
        one, half = torch.ones_like(u), torch.tensor((a, b, c), dtype=F64)
        faces = [torch.stack(axes, -1) for s in (one, -one) for axes in ((s, u, v), (u, s, v), (u, v, s))]
        return torch.cat(faces) * half
    # ring: the tube along the arc, and whole balls at its ends of which the part in the tube is left out
    t = torch.linspace(-c / 2, c / 2, 160, dtype=F64)
    tube = circle(b, 0, 2 * math.pi, 60)
    rho = a + tube[:, 0]
    x, y, z = torch.outer(torch.cos(t), rho), torch.outer(torch.sin(t), rho), tube[:, 1].expand(160, -1)
    points = [torch.stack([x, y, z], -1).reshape(-1, 3)]
    ball = turned(circle(b, -math.pi / 2, math.pi / 2, 40), 60)
    for side in (1, -1):
        end = torch.tensor([math.cos(c / 2), side * math.sin(c / 2), 0], dtype=F64)
        ahead = torch.tensor([-math.sin(c / 2), side * math.cos(c / 2), 0], dtype=F64)
        points.append((ball + a * end)[ball @ ahead >= 0])
    centre = float(shape_sdf.ring_centre(size_of("ring")))
    return torch.cat(points) - torch.tensor([centre, 0, 0], dtype=F64)


def places(count: int, seed: int = 0) -> torch.Tensor:
    g = torch.Generator().manual_seed(seed)
    return (torch.rand(count, 3, generator=g, dtype=F64) - 0.5) * 1.6


@SOLID
def test_distances_are_those_to_the_surface(shape):
    # A surface sampled every h lies no further than h / sqrt(2) from some sample: d_s^2 <= d^2 + h^2 / 2 where it is
    # flat, and samples are never nearer than the surface.
    p, s = places(400), surface(shape)
    brute = torch.cdist(p, s).amin(-1)
    found = shape_sdf.distance(shape, size_of(shape), p)[:, 0].abs()
    h = 0.03
    assert bool((brute > found - 1e-12).all())
    assert bool((brute < (found.square() + h * h / 2).sqrt() + 1e-12).all()), float((brute - found).max())


@EACH
def test_normals_are_the_slope_of_the_distance_and_have_length_one(shape):
    # Central differences with h = 1e-6: 1e-16 / h from rounding, h^2 from curvature, h / (4 R) where it jumps (at the
    # ends of a capsule, R > 0.1), and nothing at kinks, where one point in a million lies within h.
    p, size, h = places(2000), size_of(shape), 1e-6
    _, normal = shape_sdf.probe(shape, size, p)
    d = h * torch.eye(3, dtype=F64)
    gradient = torch.cat(
        [shape_sdf.distance(shape, size, p + e) - shape_sdf.distance(shape, size, p - e) for e in d], -1
    ) / (2 * h)  # fmt: skip
    assert float((gradient - normal).abs().max()) < h / (4 * 0.1)
    assert float((normal.norm(dim=-1) - 1).abs().max()) < 1e-12


@SOLID
def test_volume_centre_and_moments_are_those_of_the_inside(shape):
    # Random points, n of them in the solid: standard errors of shares of 1 / sqrt(n) at most; four of them are allowed.
    p = places(1_000_000)
    inside = p[shape_sdf.distance(shape, size_of(shape), p)[:, 0] < 0]
    tolerance = 4 / math.sqrt(len(inside))
    volume, moments = shape_sdf.bulk(shape, size_of(shape)[0])
    assert len(inside) / len(p) * 1.6**3 == pytest.approx(float(volume), rel=tolerance)
    x2 = inside.square().mean(0)
    found = x2.sum() - x2
    assert float(((found - moments) / moments).abs().max()) < tolerance
    assert float(inside.mean(0).abs().max()) < tolerance * float(moments.max().sqrt())
    off = (inside[:, [0, 0, 1]] * inside[:, [1, 2, 2]]).mean(0)
    assert float(off.abs().max()) < tolerance * float(moments.max()), "axes are not principal"


@EACH
def test_derivatives_by_points_and_sizes_are_exact(shape):
    p = places(24, 3).requires_grad_()
    size = size_of(shape).requires_grad_()
    assert torch.autograd.gradcheck(lambda p, s: shape_sdf.probe(shape, s, p), (p, size), atol=1e-6)


@EACH
@pytest.mark.parametrize("dtype", [torch.float32, F64], ids=["float32", "float64"])
def test_degenerate_points_have_unit_normals_and_finite_derivatives(shape, dtype):
    a, b, c = SIZES[shape]
    p = [[0, 0, 0], [0, 0, 0.1], [a, 0, 0], [0, 0, 0.75 * b], [a, 0, -b / 4], [a, b, c], [a, 0, b], [-a, 0, 0]]
    p = torch.tensor(p, dtype=dtype).requires_grad_()
    size = size_of(shape).to(dtype).requires_grad_()
    distance, normal = shape_sdf.probe(shape, size, p)
    assert float((normal.detach().norm(dim=-1) - 1).abs().max()) < 1e-6
    found = torch.autograd.grad(
        distance.sum() + (normal * normal.new_tensor([1, 2, 3])).sum(), (p, size), allow_unused=True
    )
    assert all(g is None or bool(torch.isfinite(g).all()) for g in found)


def test_a_grid_of_distances_is_interpolated_and_goes_on_beyond_its_border():
    # Trilinear interpolation of a function with second derivatives 1 / d: errors of cell^2 / (8 d) per direction.
    cells, half = (32, 36, 40), torch.tensor([[0.4, 0.45, 0.5]], dtype=F64)
    axes = [torch.linspace(-1, 1, n + 1, dtype=F64) * half[0, k] for k, n in enumerate(cells)]
    grid = (torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).norm(dim=-1) - 0.3).reshape(1, -1)
    p = places(2000)
    p = p[p.norm(dim=-1) > 0.15]
    distance, normal = shape_sdf.probe("mesh", half, p, grid, cells)
    bound = 3 * 0.025**2 / (8 * 0.15)
    inside = (p.abs() < half).all(-1)
    exact = p.norm(dim=-1) - 0.3
    assert float((distance[:, 0] - exact)[inside].abs().max()) < bound
    # Beyond the border the nearest surface is not exactly where the border's nearest one is.
    assert float((distance[:, 0] - exact)[~inside].abs().max()) < 0.15
    assert bool((distance[:, 0] >= exact - bound).all())
    away = p / p.norm(dim=-1, keepdim=True)
    assert float((normal * away).sum(-1)[inside].min()) > 0.99
    assert float((normal.norm(dim=-1) - 1).abs().max()) < 1e-12
