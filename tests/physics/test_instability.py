"""Instabilities of twisted and of naturally curved rods, and where twist goes in bent ones.

Equilibria come from Newton's method on the Lagrangian of the discrete rod, `helpers.Statics`.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from helpers import F64, Statics, effects, energy, run, straight, vec, view
from scipy.integrate import solve_bvp
from scipy.optimize import brentq

from torchdlo.physics import tree
from torchdlo.scene import Control, Rope, State, make, stationary_control

CLAMPED = [(v, a) for v in (0, 1) for a in range(3)]

# Localised buckling: van der Heijden and Thompson 2000 (Nonlinear Dynamics 21, 71); Nizette and Goriely 1999 (Journal
# of Mathematical Physics 40, 2830). With m = M L / B, t = T L^2 / B, slack d and end rotation R follow from
# d = sqrt(16 / t (1 - m^2 / 4 t)) and R = m B / C + 4 acos(m / 2 sqrt t).
BEND, TWIST, LENGTH, SLACK, TURNS = 1.345, 0.789, 100.0, 3.0, 27
MOMENT, TENSION = 98.541496, 2900.9932
ROOT = 0.5 * math.sqrt(4 * TENSION - MOMENT**2)
STEEPEST = math.acos(MOMENT**2 / (2 * TENSION) - 1)


def localised(n: int) -> Statics:
    """Twisted clamped rod with n free edge lengths, an odd number, at the shape of the continuous rod."""
    h = LENGTH / n
    s = ((torch.arange(n + 2, dtype=F64) - 0.5) * h - LENGTH / 2) / LENGTH
    wave = torch.stack([torch.sin(MOMENT * s / 2), -torch.cos(MOMENT * s / 2)], -1)
    side = 2 * LENGTH * ROOT / TENSION * wave / torch.cosh(ROOT * s)[:, None]
    slope = (side[1:] - side[:-1]) / h
    edges = h * torch.cat([(1 - slope.square().sum(-1, keepdim=True)).sqrt(), slope], -1)
    x = torch.cat([vec(0, 0, 0)[None], torch.cumsum(edges, 0)])
    span = LENGTH - SLACK + h
    x = x - x[:1] - torch.linspace(0, 1, n + 2, dtype=F64)[:, None] * (x[-1] - x[0] - vec(span, 0, 0))
    x[[0, 1, -2, -1]] = torch.tensor([0, h, span - h, span], dtype=F64)[:, None] * vec(1, 0, 0)
    x = x - vec(span / 2, 0, 0)
    middle = (n + 1) // 2
    x[middle, :2] = 0.0
    rope = Rope(x, mass=1.0, bend=BEND, twist=TWIST, rest=straight(n + 2, (n + 1) * h), director=vec(0, 1, 0))
    scene, params, state = make([rope], effects("bend", "twist"), dt=1e-9, check=False)
    last = state.rods.director[n]
    angle = 2 * math.pi * TURNS - math.atan2(float(last[2]), float(last[1]))
    twist = torch.cat([torch.linspace(0, angle, n + 1, dtype=F64), torch.zeros(1, dtype=F64)])[:, None]
    # The rod may turn about its axis at no cost and shift along it at almost none: its middle stays on the axis of
    # the half turn that maps the shape to itself, which takes no force.
    ends = [(v, a) for v in (0, 1, n, n + 1) for a in range(3)]
    rod = Statics(
        scene,
        params,
        tree.replace(state, rods=tree.replace(state.rods, twist=twist)),
        fixed=[*ends, (middle, 0), (middle, 1)],
        fixed_twist=[0, n],
        twisting=True,
    )
    rod.tension = torch.full_like(rod.tension, -TENSION * BEND / LENGTH**2)
    rod.solve(reach=1.0)
    return rod


def pull(rod: Statics) -> float:
    """Force that the clamp at the start exerts along the axis [N]."""

    def lagrangian(pos: torch.Tensor) -> torch.Tensor:
        length = (pos[rod.after[rod.edges]] - pos[rod.edges]).norm(dim=-1)
        return energy(rod.scene, rod.params, rod.state, pos) + (rod.tension * length).sum()

    gradient = torch.func.grad(lagrangian)(rod.state.rods.pos)
    middle = len(gradient) // 2
    assert float(gradient[middle].norm()) < 1e-9 and float(gradient[0, 1:].norm()) < 1e-4
    return -float(gradient[0, 0] + gradient[1, 0])


@pytest.mark.slow
def test_twisted_clamped_rods_buckle_into_the_localised_helix():
    # T6: M = m B / L, T = t B / L^2, cos of the steepest angle m^2 / 2 t - 1, envelope
    # (cos a - cos a_max) / (1 - cos a_max) = tanh^2(root s). The helix has wave number m / 2 L = 0.49, so
    # (k h)^2 / 12 = 0.5 % of curvature at 200 edges, which near the soft bifurcation moves the angle by some per
    # cent: 3 % at 301 edges, and extrapolation by h^2 to 1 %.
    found = {}
    for n in (201, 301):
        rod = localised(n)
        r, h = rod.state.rods, LENGTH / n
        strain = (r.twist[1 : n + 1] - r.twist[:n] + r.ref_twist[1 : n + 1])[:, 0]
        assert float(strain.max() - strain.min()) < 1e-9
        cosine = (r.pos[1:, 0] - r.pos[:-1, 0]) / h
        envelope = (cosine - cosine.min()) / (1 - cosine.min())
        wanted = torch.tanh(ROOT * (torch.arange(n + 1, dtype=F64) * h - LENGTH / 2) / LENGTH).square()
        error = float((envelope - wanted).norm() / wanted.norm())
        moment, radius = TWIST / h * float(strain.mean()), float(r.pos[:, 1:].norm(dim=-1).max())
        found[n] = np.array([moment, pull(rod), math.acos(float(cosine.min())), radius, error])
    wanted = np.array([MOMENT * BEND / LENGTH, TENSION * BEND / LENGTH**2, STEEPEST, 0.0150 * LENGTH])
    fine = found[301][:4] / wanted - 1
    assert found[301][4] < 0.03 and np.abs(fine).max() < 0.03, (found, fine)
    limit = found[301] + (found[301] - found[201]) / ((301 / 201) ** 2 - 1)
    assert np.abs(limit[:4] / wanted - 1).max() < 0.01, limit[:4] / wanted - 1
    # Errors, not differences, fall by (301 / 201)^2 = 2.24: observed order within 0.3.
    orders = math.log(found[201][4] / found[301][4]) / math.log(301 / 201)
    assert orders == pytest.approx(2, abs=0.3), orders


# A rod whose natural shape is an arc in a vertical plane, clamped level and curling upwards, with B = m' = L = 1.
CURL, CURLED = 4.0, 12


def curled(weight: float, dt: float):
    """Scene, parameters and state of the rod under a weight per length."""
    h = 1 / (CURLED - 0.5)
    heading = 2 * math.atan(CURL * h / 2) * torch.arange(CURLED, dtype=F64)
    edges = h * torch.stack([torch.cos(heading), 0 * heading, torch.sin(heading)], -1)
    x = torch.cat([vec(-h / 2, 0, 0)[None], vec(-h / 2, 0, 0) + torch.cumsum(edges, 0)])
    rope = Rope(x, mass=CURLED * h, bend=1.0, twist=0.8, rest="as_placed", radius=0.01, director=vec(0, 1, 0))
    return make(
        [rope],
        effects("bend_frame", "twist", "gravity"),
        {"gravity": {"acceleration": (0, 0, -weight)}},
        twist="quasistatic",
        integrator="implicit",
        dt=dt,
        substeps=1,
        prescribed_vertices=(0, 1),
        prescribed_edges=(0,),
    )


def softest(rod: Statics, mass: torch.Tensor) -> tuple[float, torch.Tensor, torch.Tensor]:
    """Lowest squared frequency of motions that keep lengths, twist in balance, and its positions and twists."""
    k, a = rod.hessian(0.0), len(rod.free_x)
    b = a + len(rod.free_t)
    follow = -torch.linalg.solve(k[a:b, a:b], k[a:b, :a])
    light = mass.expand(-1, 3).reshape(-1)[rod.free_x].rsqrt()
    lengths = k[b:, :a] * light
    null = torch.linalg.svd(lengths, full_matrices=True)[2][len(lengths) :].T
    stiffness = light[:, None] * (k[:a, :a] + k[:a, a:b] @ follow) * light
    values, vectors = torch.linalg.eigh(null.T @ stiffness @ null)
    y = light * (null @ vectors[:, 0])
    size = len(mass)
    pos = torch.zeros(3 * size, dtype=F64).index_put((rod.free_x,), y).reshape(-1, 3)
    twist = torch.zeros(size, dtype=F64).index_put((rod.free_t,), follow @ y)[:, None]
    return float(values[0]), pos, twist


def test_hung_curved_rods_leave_their_plane_beyond_the_static_threshold():
    # S9. The threshold is where the smallest eigenvalue of the planar equilibrium's second derivative changes sign.
    # 3 % below it a disturbance across the plane swings as cos(w t), 3 % above it grows as cosh(w t), w^2 that
    # eigenvalue over the mass. The mode's faster companions shift w by O(dt^2): 1 % after a radian at dt = 0.01.
    scene, params, state = curled(1.0, 1e-2)
    mass = params.rods.material.mass
    rod = Statics(
        scene,
        params,
        state,
        fixed=CLAMPED,
        fixed_twist=[0],
        twisting=True,
        potential=lambda pos, share: share * (mass[:, 0] * pos[:, 2]).sum(),
    )
    low, high = 8.0, 16.0
    rod.solve([1.0, 2.0, 4.0, 6.0, 8.0], reach=1.0)
    assert float(rod.lowest()) > 0
    for _ in range(10):
        middle = 0.5 * (low + high)
        rod.solve([middle], reach=1.0)
        assert float(rod.state.rods.pos[:, 1].abs().max()) < 1e-9  # still the planar branch
        low, high = (middle, high) if float(rod.lowest()) > 0 else (low, middle)
    assert 8.0 < low < high < 16.0
    tiny = 1e-5
    for factor in (0.97, 1.03):
        rod.solve([low * factor], reach=1.0)
        squared, mode, twist = softest(rod, mass)
        assert float(mode[:, 1].norm()) > 0.99 * float(mode.norm()) and (squared > 0) is (factor < 1)
        still = rod.state
        moving, values, _ = curled(low * factor, 1e-2)
        pushed = view(moving, values, still, still.rods.pos + tiny * mode, still.rods.twist + tiny * twist).state
        rate = math.sqrt(abs(squared))
        count = round(1.2 / rate / 1e-2)

        def share(s: State, still=still, mode=mode) -> float:
            return float((mass * mode * (s.rods.pos - still.rods.pos)).sum() / tiny)

        _, seen = run(moving, values, tree.replace(still, rods=pushed), count, seen=share)
        t = 1e-2 * torch.arange(1, count + 1, dtype=F64) * rate
        wanted = torch.cos(t) if squared > 0 else torch.cosh(t)
        assert float((torch.tensor(seen) - wanted).abs().max()) < 0.01, (factor, seen[-1], wanted[-1])


def led(turned: float, x: torch.Tensor, rest) -> torch.Tensor:
    """Twists from the first edge on when the last edge's frame is turned, all vertices held."""
    n = len(x)
    rope = Rope(x, mass=1.0, bend=1.0, twist=0.8, rest=rest, radius=0.01, director=vec(0, 0, 1))
    scene, params, state = make(
        [rope],
        effects("bend_frame", "twist"),
        twist="quasistatic",
        dt=1e-2,
        substeps=1,
        integrator="implicit",
        prescribed_vertices=tuple(range(n)),
        prescribed_edges=(0, n - 2),
    )
    start = stationary_control(scene, state)
    edge = x[-1] - x[-2]
    side = torch.linalg.cross(edge / edge.norm(), start.director[1])

    def turn(k, _):
        angle = turned * min(1.0, (k + 1) / 30)
        last = math.cos(angle) * start.director[1] + math.sin(angle) * side
        return Control(start.pos, torch.stack([start.director[0], last]))

    state, _ = run(scene, params, state, 40, turn)
    return torch.flip(state.rods.twist[: n - 1, 0], [0])


def test_twist_spreads_over_arcs():
    # T10. One end turned by 90 degrees, the other held, from the turned end: linear along a straight rod and along a
    # straight rod bent to a semicircle (bending of an isotropic rod does not feel twist): 45 degrees in the middle.
    # A natural arc resists: angle'' = (B K^2 / C) sin(angle).
    n, quarter = 41, math.pi / 2
    h = 1 / (n - 1)
    heading = math.pi * h * torch.arange(n - 1, dtype=F64)
    edges = h * torch.stack([torch.cos(heading), torch.sin(heading), 0 * heading], -1)
    arc = torch.cat([vec(0, 0, 0)[None], torch.cumsum(edges, 0)])
    line = torch.linspace(quarter, 0, n - 1, dtype=F64)
    assert float((led(quarter, straight(n), "straight") - line).abs().max()) < 1e-9
    # Averaging the frames of both edges softens bending by cos^2(twist per hinge / 2), a constant here.
    assert float((led(quarter, arc, "straight") - line).abs().max()) < 1e-9

    # Natural semicircle: K = pi / L, from edge centre to edge centre; error O(h^2) of order (K h)^2.
    s = np.linspace(0, 1 - h, n - 1)
    k2 = math.pi**2 / 0.8
    solved = solve_bvp(
        lambda s, y: np.stack([y[1], k2 * np.sin(y[0])]),
        lambda a, b: np.array([a[0] - quarter, b[0]]),
        s,
        np.stack([quarter * np.exp(-math.sqrt(k2) * s), -quarter * np.exp(-math.sqrt(k2) * s)]),
        tol=1e-8,
    )
    natural = led(quarter, arc, "as_placed")
    assert float((natural - torch.from_numpy(solved.sol(s)[0])).abs().max()) < quarter * (math.pi * h) ** 2


def test_twist_stops_at_a_sharp_kink():
    # T10. A natural kink of 60 degrees halfway resists turning by its whole bending energy: torque balance of both legs
    # with the kink, two unknown angles on its edges. Curvature K = 2 tan(30 degrees) in the mean of both frames,
    # E = (B / 2 h) K^2 (c^2 + 1 - 2 c cos(mean)), c = cos(difference / 2); legs of C / (m h) each, m hinges long.
    n, quarter = 41, math.pi / 2
    h = 1 / (n - 1)
    kink = 2 * math.tan(math.pi / 6)
    turn = torch.where(torch.arange(n - 1) < (n - 1) // 2, 0.0, math.pi / 3).to(F64)
    bent = torch.cat([vec(0, 0, 0)[None], h * torch.cumsum(torch.stack([turn.cos(), turn.sin(), 0 * turn], -1), 0)])
    angles = led(quarter, bent, "as_placed")
    m = (n - 1) // 2 - 1

    def slope(before: float, after: float) -> tuple[float, float]:
        """Derivatives of bending and twisting energy of the kink by the two angles."""
        mean, half = 0.5 * (before + after), 0.5 * (before - after)
        c, s = math.cos(half), math.sin(half)
        by_half = kink**2 / (2 * h) * (-2 * c * s + 2 * s * math.cos(mean)) + 0.8 / h * 4 * half
        by_mean = kink**2 / h * c * math.sin(mean)
        return 0.5 * (by_mean + by_half), 0.5 * (by_mean - by_half)

    def after(before: float) -> float:
        return brentq(lambda y: slope(before, y)[1] + 0.8 / (m * h) * y, -1.0, before, xtol=1e-14)

    before = brentq(lambda y: slope(y, after(y))[0] - 0.8 / (m * h) * (quarter - y), 0.0, quarter, xtol=1e-14)
    assert float(angles[m]) == pytest.approx(before, abs=1e-8)
    assert float(angles[m + 1]) == pytest.approx(after(before), abs=1e-8)
    assert math.degrees(float(angles[m + 1 :].abs().max())) < 8  # 45 without the kink
