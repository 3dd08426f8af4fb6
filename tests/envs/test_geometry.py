"""Measures of curves, against curves whose measures are known."""

from __future__ import annotations

import math

import pytest
import torch

from torchdlo.envs.core import curve_geometry

pytestmark = pytest.mark.quick

F64 = torch.float64


def torus_knot(p: int, q: int, count: int = 200) -> torch.Tensor:
    """An open curve that all but closes to the (p, q) torus knot, shape (count, 3)."""
    t = torch.linspace(0, 2 * math.pi, count + 1, dtype=F64)[:-1]
    r = 2 + torch.cos(q * t)
    return torch.stack([r * torch.cos(p * t), r * torch.sin(p * t), -torch.sin(q * t)], -1)


def figure_eight(count: int = 200) -> torch.Tensor:
    """The knot of that name: ((2 + cos 2t) cos 3t, (2 + cos 2t) sin 3t, sin 4t)."""
    t = torch.linspace(0, 2 * math.pi, count + 1, dtype=F64)[:-1]
    r = 2 + torch.cos(2 * t)
    return torch.stack([r * torch.cos(3 * t), r * torch.sin(3 * t), torch.sin(4 * t)], -1)


def opened(x: torch.Tensor) -> torch.Tensor:
    """The same curve, opened where it is highest: there its ends can go upwards."""
    return x.roll(-int(x[:, 2].argmax()), 0)


def test_determinants_of_knots_are_those_of_the_tables():
    # Rolfsen's table: unknot 1, trefoil 3, figure eight 5, cinquefoil 5, 7_1 has 7.
    knots = [torus_knot(1, 2), torus_knot(2, 3), figure_eight(), torus_knot(2, 5), torus_knot(2, 7)]
    found = curve_geometry.knot_determinant(torch.stack([opened(x) for x in knots]))
    assert found.tolist() == [1, 3, 5, 5, 7]


def test_the_determinant_does_not_depend_on_the_view():
    x = opened(torus_knot(2, 3))
    mirrored = x * x.new_tensor([1.0, -1.0, 1.0])
    a = 0.3
    turned = x @ x.new_tensor([[math.cos(a), math.sin(a), 0], [-math.sin(a), math.cos(a), 0], [0, 0, 1]])
    assert curve_geometry.knot_determinant(torch.stack([x, mirrored, turned])).tolist() == [3, 3, 3]


def test_a_loop_that_only_looks_knotted_is_not():
    # The trefoil's top view with every strand above all earlier ones: it can be lifted off.
    x = opened(torus_knot(2, 3))
    x[:, 2] = torch.linspace(0, 1, len(x), dtype=F64)
    assert curve_geometry.crossings(x) >= 2 and curve_geometry.knot_determinant(x[None]) == 1


def test_crossings_are_counted_once():
    x = torch.tensor([[0, 0, 0], [2, 2, 0], [2, 0, 1], [0, 2, 1.0]], dtype=F64)
    y = torch.tensor([[-1, 0.5, 0], [3, 0.5, 0.0]], dtype=F64)
    assert int(curve_geometry.crossings(x)) == 1
    # The line y = 0.5 meets the first, the second and the third edge.
    assert int(curve_geometry.crossings(y, x)) == 3


def test_the_average_crossing_number_of_two_long_lines_is_that_of_one_crossing():
    # Two lines at right angles at a distance h: the solid angle of all views in which they cross is 2 pi of 4 pi, on
    # either side, so that pairs counted twice sum to 1 where the cut-off c is 0, and to h / sqrt(h^2 + c^2) with it.
    h, c = 0.1, curve_geometry.CORE
    s = 0.15 * torch.sinh(torch.linspace(-5, 5, 301, dtype=F64))
    a = torch.stack([s, 0 * s, 0 * s], -1)
    b = torch.stack([0 * s, s, h + 0 * s], -1)
    e, f, r = a[1:] - a[:-1], b[1:] - b[:-1], (a[1:] + a[:-1])[:, None] / 2 - (b[1:] + b[:-1])[None] / 2
    volume = (r * torch.linalg.cross(e[:, None].expand_as(r), f[None].expand_as(r))).sum(-1).abs()
    pairs = 2 * (volume / (r.square().sum(-1) + c * c) ** 1.5).sum() / (4 * math.pi)
    assert float(pairs) == pytest.approx(h / math.hypot(h, c), rel=0.02)
    # The function itself sees an edge between their ends as well: all but in one plane with them, by h over 11 m.
    whole = curve_geometry.crossing_number(torch.cat([a, b]))
    assert float(whole) == pytest.approx(float(pairs), rel=h / 11)


def test_windings_are_whole_for_loops_and_signed():
    t = torch.linspace(0, 2 * math.pi, 41, dtype=F64)[:-1]
    circle = torch.stack([torch.cos(t), torch.sin(t), 0 * t], -1)
    both = torch.stack([circle, circle.flip(0)])
    assert curve_geometry.winding(both, torch.tensor([0.3, 0.2], dtype=F64)).tolist() == pytest.approx([1, -1])
    assert curve_geometry.winding(both, torch.tensor([1.3, 0.2], dtype=F64)).tolist() == pytest.approx(
        [0, 0], abs=1e-12
    )


def test_chamfer_sums_both_means():
    a = torch.tensor([[0.0, 0, 0], [1, 0, 0]], dtype=F64)
    b = torch.tensor([[0.0, 0, 1], [1, 0, 1], [1, 0, 3]], dtype=F64)
    assert float(curve_geometry.chamfer(a, b)) == pytest.approx(1 + (1 + 1 + 3) / 3)
