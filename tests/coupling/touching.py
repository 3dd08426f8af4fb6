"""Ropes that touch, and distances measured without the code under test."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from torchdlo.coupling import RodContact
from torchdlo.physics import tree
from torchdlo.physics.effects.elastic import Bend
from torchdlo.scene import Params, Rope, Scene, State, make, stationary_control, step

F64 = torch.float64


def line(n: int, length: float, angle: float = 0.0, height: float = 0.0) -> Tensor:
    """Vertices (n, 3) of a straight rope through the z axis, at an angle to x."""
    s = torch.linspace(-length / 2, length / 2, n, dtype=F64)
    return torch.stack([s * math.cos(angle), s * math.sin(angle), torch.full_like(s, height)], -1)


def two(
    angle: float = 0.0,
    speed: float = 0.05,
    drift: tuple[float, float, float] = (0.0, 0.0, 0.0),
    values: dict[str, float] | None = None,
    contact: RodContact | None = None,
    gap: float = 2e-3,
    n: int = 21,
    **choices: Any,
) -> tuple[Scene, Params, State]:
    """Two ropes of 0.5 m, one above the other, that approach each other; the upper one drifts as well."""
    r = 0.01
    given = {"radius": r, "density": 1750.0, "youngs": 3e5}
    ropes = []
    for side, turned in ((1.0, 0.0), (-1.0, angle)):
        x = line(n, 0.5, turned, side * (r + gap / 2))
        v = torch.zeros_like(x) + torch.tensor([0.0, 0.0, -side * speed], dtype=F64)
        ropes.append(Rope(x, velocities=v + torch.tensor(drift, dtype=F64) * (side > 0), **given))
    numbers = {"mu_s": 0.0, "mu_k": 0.0} | (values or {})
    choices = {"dt": 1e-3, "substeps": 5} | choices
    return make(ropes, [Bend(), contact or RodContact()], {"rod_contact": numbers}, **choices)


def distances(x: Tensor, first: Tensor, second: Tensor) -> Tensor:
    """Exact distances of segments (first, first + 1) and (second, second + 1) of vertices x, by trying every case.

    The closest points lie inside both segments, or one of them is an end.
    """
    a, b, c, d = x[first], x[first + 1], x[second], x[second + 1]

    def to_segment(p: Tensor, q0: Tensor, q1: Tensor) -> Tensor:
        u = q1 - q0
        t = (((p - q0) * u).sum(-1) / (u * u).sum(-1)).clamp(0, 1)
        return (p - q0 - t[..., None] * u).norm(dim=-1)

    found = torch.stack([to_segment(a, c, d), to_segment(b, c, d), to_segment(c, a, b), to_segment(d, a, b)]).amin(0)
    u, v, w = b - a, d - c, a - c
    uu, vv, uv, uw, vw = ((p * q).sum(-1) for p, q in ((u, u), (v, v), (u, v), (u, w), (v, w)))
    det = uu * vv - uv * uv
    skew = det > 1e-12 * uu * vv
    safe = torch.where(skew, det, 1.0)
    s, t = (uv * vw - vv * uw) / safe, (uu * vw - uv * uw) / safe
    inside = skew & (s >= 0) & (s <= 1) & (t >= 0) & (t <= 1)
    return torch.where(inside, (w + s[..., None] * u - t[..., None] * v).norm(dim=-1), found)


def nearest(x: Tensor, counts: tuple[int, ...], apart: int = 3) -> float:
    """Least distance of edges of open ropes (V, 3), but of those closer than some steps on one rope."""
    rod = torch.tensor([k for k, n in enumerate(counts) for _ in range(n)])
    i, j = torch.triu_indices(len(x) - 1, len(x) - 1, 1)
    keep = (rod[i] == rod[i + 1]) & (rod[j] == rod[j + 1]) & ((rod[i] != rod[j]) | (j - i >= apart))
    return float(distances(x, i[keep], j[keep]).min())


def momenta(params: Params, state: State) -> tuple[Tensor, Tensor]:
    """Linear momentum, and angular momentum about the origin. Velocities are x_k - x_(k-1) over dt, so x_k will do."""
    p = params.rods.material.mass * state.rods.vel
    return p.sum(-2), torch.linalg.cross(state.rods.pos, p, dim=-1).sum(-2)


def run(scene: Scene, params: Params, state: State, count: int) -> State:
    """Step without gradients, held parts at rest."""
    control = stationary_control(scene, state)
    with torch.no_grad():
        for _ in range(count):
            state = step(scene, params, state, control)
    return state


def trefoil(n: int, scale: float = 0.02, tail: float = 0.3) -> Tensor:
    """Vertices (n, 3) of an overhand knot with straight tails, evenly spaced along the curve.

    The long trefoil (t^3 - 3t, t^4 - 4t^2, t^5 - 10t) of Shastri 1992.
    """
    t = torch.linspace(-2.15, 2.15, 4001, dtype=F64)
    x = scale * torch.stack([t**3 - 3 * t, t**4 - 4 * t**2, 0.35 * (t**5 - 10 * t)], -1)
    u = torch.linspace(0, tail, 2000, dtype=F64)[1:, None]
    before, after = x[0] - x[1], x[-1] - x[-2]
    x = torch.cat([x[0] + before / before.norm() * u.flip(0), x, x[-1] + after / after.norm() * u])
    s = torch.cat([t.new_zeros(1), (x[1:] - x[:-1]).norm(dim=-1).cumsum(0)])
    wanted = torch.linspace(0, 1, n, dtype=F64) * s[-1]
    k = torch.searchsorted(s, wanted).clamp(1, len(s) - 1)
    f = ((wanted - s[k - 1]) / (s[k] - s[k - 1]))[:, None]
    return (1 - f) * x[k - 1] + f * x[k]


def with_velocity(state: State, vel: Tensor) -> State:
    return tree.replace(state, rods=tree.replace(state.rods, vel=vel))
