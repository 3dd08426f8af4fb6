"""Closed forms of the elastica, of buckling and of curved and twisted rods, from the energies that the steps use.

Equilibria are found by Newton's method on the Lagrangian of the discrete rod with fixed lengths (`helpers.Statics`), to
a last change below 1e-9 edges; `test_equilibria_stand_still_in_the_simulator` ties them to the steps. A clamp holding
the first edge acts in the middle of it, so rods are extended backwards by half an edge.
"""

from __future__ import annotations

import math

import pytest
import torch
from helpers import F64, Statics, circle, effects, energy, length_error, run, speed, straight, vec

from torchdlo.physics import tree
from torchdlo.scene import Rope, State, make

pytestmark = pytest.mark.quick

G = 9.81
CLAMPED = [(v, a) for v in (0, 1) for a in range(3)]


def cantilever(n_edges: int, length: float = 1.0, **rope) -> tuple:
    """Straight rod whose first edge is centred on the clamp at the origin."""
    h = length / (n_edges - 0.5)
    x = straight(n_edges + 1, n_edges * h, start=-h / 2)
    return make([Rope(x, **rope)], effects("bend"), dt=1e-6)


def tip_loaded(n_edges: int, a: float) -> torch.Tensor:
    """Tip position and angle under a = F L^2 / B, by load steps."""
    scene, params, state = cantilever(n_edges, mass=1.0, bend=1.0)
    rod = Statics(scene, params, state, fixed=CLAMPED, potential=lambda pos, share: share * a * pos[-1, 2])
    pos = rod.solve([share / 20 for share in range(1, 21)] if a > 2 else [0.2, 0.5, 1.0], reach=1.0).rods.pos
    edge = pos[-1] - pos[-2]
    return torch.stack([-pos[-1, 2], pos[-1, 0], torch.atan2(-edge[2], edge[0])])


TIP = [
    (0.25, 0.08275, 0.99588, 0.1243),
    (1.0, 0.30172, 0.94357, 0.4614),
    (2.0, 0.49346, 0.83936, 0.7818),
    (5.0, 0.71379, 0.61237, 1.2154),
    (10.0, 0.81061, 0.44500, 1.4303),
]


@pytest.mark.parametrize(("a", "drop", "reach", "angle"), TIP)
def test_tip_loaded_cantilever_is_the_elastica(a, drop, reach, angle):
    # S2: elliptic integrals; table to 5 digits. 40 edges, error O(h^2) ~ 6e-4: gate 0.2 %.
    found = tip_loaded(40, a)
    wanted = vec(drop, reach, angle)
    assert float(((found - wanted) / wanted).abs().max()) < 2e-3, found / wanted - 1


def test_small_tip_load_bends_by_the_beam_formula():
    # F L^3 / 3 B (1 + O(a^2)) with a = 1e-3; discretisation error O(h^2) = 1/40^2 / 4.
    assert float(tip_loaded(40, 1e-3)[0]) == pytest.approx(1e-3 / 3, rel=5e-4)


@pytest.mark.parametrize(
    ("clamp", "edges", "off"), [("vertex", 11, 0.005), ("vertex", 21, 0.00125), ("edge", 11, 0.16)]
)
def test_ropes_are_clamped_at_the_vertex_where_that_is_asked_for(clamp, edges, off):
    # F L^3 / 3 B for the length L beyond the second held vertex. At the vertex: the trapezoidal rule, 1 / (2 n^2) too
    # much with n free edges; in the middle of the edge before it: (L + h / 2)^3 but for 1 / (4 n^2).
    h, a = 1.0 / (edges - 1), 1e-3
    x = straight(edges + 1, edges * h, start=-h)
    scene, params, state = make(
        [Rope(x, mass=1.0, bend=1.0)], effects("bend"), dt=1e-6, prescribed_vertices=(0, 1), clamp=clamp
    )
    rod = Statics(scene, params, state, fixed=CLAMPED, potential=lambda pos, share: share * a * pos[-1, 2])
    drop = float(-rod.solve([1.0], reach=1.0).rods.pos[-1, 2])
    assert drop / (a / 3) - 1 == pytest.approx(off, rel=0.05)


def weighted(n_edges: int, gamma: float) -> tuple[Statics, State]:
    """Cantilever under its own weight, gamma = w L^3 / B."""
    scene, params, state = cantilever(n_edges, density=1.0 / math.pi / 0.01**2, radius=0.01, bend=G / gamma)
    mass = params.rods.material.mass

    def weight(pos, share):
        return share * G * (mass[:, 0] * pos[:, 2]).sum()

    rod = Statics(scene, params, state, fixed=CLAMPED, potential=weight)
    return rod, rod.solve([share / 12 for share in range(1, 13)] if gamma > 2 else [0.3, 1.0], reach=1.0)


OWN_WEIGHT = [(0.1, 0.01250, 0.99991), (1.0, 0.12347, 0.99125), (10.0, 0.70020, 0.65635)]


@pytest.mark.parametrize(("gamma", "drop", "reach"), OWN_WEIGHT)
def test_cantilever_under_its_own_weight_lies_on_the_master_curve(gamma, drop, reach):
    # S3 (Romero et al. 2021). 40 edges; gate 0.2 %, plus half a unit of the last digit of the table.
    _, state = weighted(40, gamma)
    tip = state.rods.pos[-1]
    assert float(-tip[2]) == pytest.approx(drop, rel=2e-3, abs=5e-6)
    assert float(tip[0]) == pytest.approx(reach, rel=2e-3)


def test_cantilever_converges_with_the_square_of_the_edge_length():
    # S3. Differences of drops at n, 2n, 4n fall by 4.
    drops = [float(-weighted(n, 10.0)[1].rods.pos[-1, 2]) for n in (12, 24, 48)]
    slope = math.log2((drops[0] - drops[1]) / (drops[1] - drops[2]))
    assert slope == pytest.approx(2.0, abs=0.25), (drops, slope)


def test_equilibria_stand_still_in_the_simulator():
    # The Newton equilibrium is one of the time steps, explicit and implicit: no vertex moves by more than rounding
    # allows.
    for integrator in ("explicit", "implicit"):
        h = 1.0 / 11.5
        x = straight(13, 12 * h, start=-h / 2)
        rope = Rope(x, mass=12 * h, bend=1.0)
        scene, params, state = make(
            [rope], effects("bend", "gravity"), integrator=integrator, dt=2e-4, substeps=1, prescribed_vertices=(0, 1)
        )
        mass = params.rods.material.mass
        rod = Statics(
            scene, params, state, fixed=CLAMPED, potential=lambda pos, s, m=mass: s * G * (m[:, 0] * pos[:, 2]).sum()
        )
        still = rod.solve([0.1, 0.4, 1.0])
        after, _ = run(scene, params, still, 300)
        assert speed(after) < 1e-7, (integrator, speed(after))
        assert float((after.rods.pos - still.rods.pos).abs().max()) < 1e-9


def test_dynamic_relaxation_ends_at_the_elastica():
    # S3, gamma = 10, by implicit steps with damping; residual speed reported; error as in the static solution: 1e-6.
    n_edges = 16
    h = 1.0 / (n_edges - 0.5)
    x = straight(n_edges + 1, n_edges * h, start=-h / 2)
    rope = Rope(x, mass=n_edges * h, bend=G / 10)
    scene, params, state = make(
        [rope],
        effects("bend", "gravity", "damping"),
        {"damping": {"rate": 6.0}},
        integrator="implicit",
        dt=0.02,
        substeps=1,
        prescribed_vertices=(0, 1),
    )
    state, _ = run(scene, params, state, 600)
    assert speed(state) < 1e-8
    _, wanted = weighted(n_edges, 10.0)
    assert float((state.rods.pos - wanted.rods.pos).abs().max()) < 1e-6
    assert length_error(scene, params, state) < 1e-9


def column(n_edges: int, clamps: str) -> tuple[Statics, torch.Tensor]:
    """Straight rod of length 1, B = 1, along x, with the constraints of an Euler case; and its vertices."""
    extra = {"pinned": 0, "free": 1, "clamped": 2}[clamps]
    h = 1.0 / (n_edges - 0.5 * extra)
    x = straight(n_edges + 1, n_edges * h, start=-0.5 * h if extra else 0.0)
    scene, params, state = make([Rope(x, mass=1.0, bend=1.0)], effects("bend"), dt=1e-6)
    last = n_edges
    fixed = [(0, 0), (0, 1), (0, 2)]
    if clamps == "pinned":
        fixed += [(last, 1), (last, 2)]
    if clamps in ("free", "clamped"):
        fixed += [(1, 1), (1, 2), (1, 0)]
    if clamps == "clamped":
        fixed += [(last, 1), (last, 2), (last - 1, 1), (last - 1, 2)]
    return Statics(scene, params, state, fixed=fixed), x


EULER = {"pinned": math.pi**2, "free": math.pi**2 / 4, "clamped": 4 * math.pi**2}


@pytest.mark.parametrize("clamps", EULER)
def test_columns_buckle_at_eulers_load(clamps):
    # S5. The compressed straight rod loses stability where the smallest eigenvalue of the Lagrangian's second
    # derivative on
    # motions that keep lengths changes sign: P = pi^2 B/L^2 (pinned), /4 (clamped-free), x4 (clamped-clamped). 1 %.
    rod, _ = column(40, clamps)

    def lowest(load: float) -> float:
        rod.potential = lambda pos, share: load * pos[-1, 0]
        rod.tension = torch.full_like(rod.tension, -load)  # pushed everywhere
        assert float(rod.gradient(rod.unknowns()).abs().max()) < 1e-9 * max(load, 1)
        return float(rod.lowest())

    low, high = 0.5 * EULER[clamps], 1.5 * EULER[clamps]
    assert lowest(low) > 0 > lowest(high)
    for _ in range(14):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if lowest(middle) > 0 else (low, middle)
    assert low == pytest.approx(EULER[clamps], rel=0.01)


POST = [(20, 1.01540, 0.96973, 0.10971), (60, 1.15172, 0.74102, 0.29660), (120, 1.88480, 0.12316, 0.40159)]


@pytest.mark.parametrize(("slope", "load", "chord", "deflection"), POST)
def test_buckled_columns_follow_the_elastica(slope, load, chord, deflection):
    # S5. Pinned rod with its ends held at the chord of an end slope: P / Pcr, deflection in the middle and slope of the
    # end, 60 edges, table to 5 digits. Hinges turn by the largest angle 2 sqrt(P) sin(slope / 2) / n, up to 0.12: the
    # tangent law makes P differ by about its square over 4, 0.4 %, and the shape, which the ends fix, by less: 0.1 %.
    n = 60
    straight_rod, _ = column(n, "pinned")
    angle = math.radians(slope) * torch.cos(math.pi * (torch.arange(n, dtype=F64) + 0.5) / n)
    edges = torch.stack([torch.cos(angle), 0 * angle, torch.sin(angle)], -1) / n
    shape = torch.cat([vec(0, 0, 0)[None], torch.cumsum(edges, 0)])
    shape = shape - torch.linspace(0, 1, n + 1, dtype=F64)[:, None] * (shape[-1] - vec(chord, 0, 0))
    state = tree.replace(straight_rod.state, rods=tree.replace(straight_rod.state.rods, pos=shape))
    ends = [(v, a) for v in (0, n) for a in range(3)]
    rod = Statics(straight_rod.scene, straight_rod.params, state, fixed=ends)
    rod.tension = -load * math.pi**2 * torch.cos(angle)
    pos = rod.solve([1.0], reach=1.0).rods.pos

    def lagrangian(x: torch.Tensor) -> torch.Tensor:
        return energy(rod.scene, rod.params, rod.state, x) + (rod.tension * (x[1:] - x[:-1]).norm(dim=-1)).sum()

    push = float(torch.func.grad(lagrangian)(pos)[0, 0])
    assert abs(push) == pytest.approx(load * math.pi**2, rel=5e-3)
    assert float(pos[n // 2, 2]) == pytest.approx(deflection, rel=1e-3)
    assert math.degrees(math.atan2(float(pos[1, 2]), float(pos[1, 0]))) == pytest.approx(slope, rel=1e-3)


def test_columns_buckle_under_their_own_weight_between_the_brackets():
    # S6: w L^3 / B = 7.8373 is critical for a clamped base and a free top: stable at 7.5, falls at 8.2.
    n_edges = 40
    for gamma, stable in ((7.5, True), (8.2, False)):
        h = 1.0 / (n_edges - 0.5)
        x = straight(n_edges + 1, n_edges * h, (0, 0, 1), start=-h / 2)
        scene, params, state = make([Rope(x, mass=n_edges * h, bend=G / gamma)], effects("bend"), dt=1e-6)
        m = params.rods.material.mass[:, 0]
        rod = Statics(scene, params, state, fixed=CLAMPED, potential=lambda pos, s, m=m: G * (m * pos[:, 2]).sum())
        above = torch.flip(torch.cumsum(torch.flip(m, [0]), 0), [0])
        rod.tension = -G * above[rod.edges + 1]
        assert float(rod.gradient(rod.unknowns()).abs().max()) < 1e-9
        assert (float(rod.lowest()) > 0) is stable


@pytest.mark.parametrize(
    ("span", "a", "sag"), [(0.9, 0.560094, 0.190709), (0.8, 0.338202, 0.265438), (0.5, 0.114820, 0.398194)]
)
def test_hanging_chain_is_a_catenary(span, a, sag):
    # S7. 2 a sinh(D / 2a) = L, sag a (cosh(D/2a) - 1), horizontal tension w a, end tension w a cosh(D/2a); 0.2 % at
    # 60 edges.
    n, w = 60, G
    s = torch.linspace(-0.5, 0.5, n + 1, dtype=F64)
    x0 = a * torch.asinh(s / a)
    start = torch.stack([x0, 0 * s, a * torch.cosh(x0 / a) - a], -1)
    edges = start[1:] - start[:-1]
    edges = edges / edges.norm(dim=-1, keepdim=True) / n
    shape = torch.cat([start[:1], start[:1] + torch.cumsum(edges, 0)])
    shape[-1] = start[-1]
    rope = Rope(shape, mass=1.0, bend=1e-9, rest=straight(n + 1))
    scene, params, state = make([rope], effects("bend"), dt=1e-6)
    m = params.rods.material.mass[:, 0]
    rod = Statics(
        scene,
        params,
        state,
        fixed=[(0, k) for k in range(3)] + [(n, k) for k in range(3)],
        potential=lambda pos, share: G * (m * pos[:, 2]).sum(),
    )
    rod.tension = torch.full_like(rod.tension, w * a)
    pos = rod.solve().rods.pos
    assert float(pos[0, 2] - pos[:, 2].min()) == pytest.approx(sag, rel=2e-3)
    tangent = (pos[1:] - pos[:-1]) * n
    assert float(rod.tension[0] * tangent[0, 0]) == pytest.approx(w * a, rel=2e-3)
    # The first edge starts half an edge inside: compare its tension at the vertex, w a cosh there.
    x_mid = float(0.5 * (pos[0, 0] + pos[1, 0]))
    assert float(rod.tension[0]) == pytest.approx(w * a * math.cosh(x_mid / a), rel=2e-3)
    # At the vertex, half an edge further: dT/ds = w sin(slope).
    end = float(rod.tension[0]) + 0.5 * w / n * abs(float(tangent[0, 2]))
    assert end == pytest.approx(w * a * math.cosh(span / 2 / a), rel=2e-3)


def test_forty_five_degree_bend_follows_bathe_and_bolourchi():
    # S8 (Bathe and Bolourchi 1979): R = 100, 45 degrees, EI = 8.3333e5 both ways, GJ = 8.333e5, tip force 600 out of
    # plane.
    # Converged displacements (-23.646, -13.721, 53.578) with EA = 1e7; 64 edges; 1 % of the largest.
    n, radius, force = 64, 100.0, 600.0
    step_angle = math.pi / 4 / (n - 0.5)
    a = step_angle * (torch.arange(n + 1, dtype=F64) - 0.5)
    x = radius * torch.stack([torch.sin(a), 1 - torch.cos(a), 0 * a], -1)
    rope = Rope(x, mass=1.0, bend=8.3333e5, twist=8.333e5, stretch=1e7, rest="as_placed")
    scene, params, state = make([rope], effects("stretch_force", "bend_frame", "twist"), constrained=False, dt=1e-9)
    rod = Statics(
        scene,
        params,
        state,
        fixed=CLAMPED,
        fixed_twist=[0],
        twisting=True,
        lengths=False,
        potential=lambda pos, share: -share * force * pos[-1, 2],
    )
    pos = rod.solve([0.1, 0.3, 0.6, 1.0], reach=2.0).rods.pos
    moved = pos[-1] - x[-1]
    assert float((moved - vec(-23.646, -13.721, 53.578)).abs().max()) < 0.01 * 53.578


def ring(n: int, twist_stiffness: float, total: float) -> Statics:
    """Naturally straight rod closed to a ring with B = 1 whose ends were turned by `total` before they were joined."""
    rope = Rope(circle(n), mass=1.0, bend=1.0, twist=twist_stiffness, closed=True, rest="straight")
    scene, params, state = make([rope], effects("bend_frame", "twist"), dt=1e-6)
    # The cut-and-glue angle enters as natural twist of the opposite sign, spread evenly.
    rest = tree.replace(params.rods.rest, twist=torch.full((n, 1), -total / n, dtype=F64))
    params = tree.replace(params, rods=tree.replace(params.rods, rest=rest))
    return Statics(scene, params, state, twisting=True)


@pytest.mark.parametrize("n", [16, 24])
def test_twisted_rings_buckle_at_michells_twist(n):
    # T4 (Michell, Zajac). Unstable beyond 2 pi sqrt(3) B / C; at n vertices times 1 + 30.3 / n^2 (1.0535 at 24): 2 %
    # after it.
    c = 1.3

    def lowest(total: float) -> float:
        rod = ring(n, c, total)
        # A ring of uniform twist is in balance: tension from the gradient by least squares.
        z = rod.unknowns()
        m = len(rod.free_x) + len(rod.free_t)
        g = rod.gradient(z)[:m]
        jac = torch.func.jacrev(lambda y: rod.gradient(y)[m:])(z)[:, :m]
        rod.tension = -torch.linalg.lstsq(jac.T, g[:, None]).solution[:, 0]
        assert float(rod.gradient(rod.unknowns())[:m].abs().max()) < 1e-9
        # Seven motions cost nothing: six rigid ones and the common spin of the frames.
        return float(rod.lowest(8).min())

    low, high = 0.8 * 10.8828 / c, 1.3 * 10.8828 / c
    for _ in range(12):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if lowest(middle) > -1e-7 else (low, middle)
    expected = 10.8828 / c * (1 + 0.0535 * 24**2 / n**2)
    assert low == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize(("law", "n"), [("bend", 36), ("bend_frame", 72)])
def test_twisted_straight_rods_buckle_at_greenhills_moment(law, n):
    # T5. Clamped-clamped, no thrust: M L / B = 8.98682; the end may slide along the axis. 1 %. Averaging the material
    # frames of
    # both edges (Bergou 2010) makes bending softer by cos^2(twist per hinge / 2): `bend_frame` needs more edges.
    c = 0.8
    h = 1.0 / (n - 1)
    x = straight(n + 1, n * h, start=-h / 2)
    scene, params, state = make([Rope(x, mass=1.0, bend=1.0, twist=c)], effects(law, "twist"), dt=1e-6)
    fixed = [*CLAMPED, (n - 1, 1), (n - 1, 2), (n, 1), (n, 2)]

    def lowest(moment: float) -> float:
        # Inextensible motions of a straight rod do not stretch or twist it to first order: twists need not be
        # unknowns.
        rod = Statics(scene, params, state, fixed=fixed)
        twist = (moment / c * h * torch.arange(n + 1, dtype=F64))[:, None]
        twist[-1] = 0
        rod.state = tree.replace(state, rods=tree.replace(state.rods, twist=twist))
        assert float(rod.gradient(rod.unknowns()).abs().max()) < 1e-9
        return float(rod.lowest())

    low, high = 8.0, 10.0
    for _ in range(9):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if lowest(middle) > 0 else (low, middle)
    assert low == pytest.approx(8.98682, rel=0.01)


def test_twist_spreads_linearly_and_keeps_a_straight_rod_straight():
    # T2. Statics with the far edge held at 3 rad: twists linear to 1e-8, no transverse motion.
    n = 12
    scene, params, state = make(
        [Rope(straight(n), mass=1.0, bend=1.0, twist=0.5)], effects("bend_frame", "twist"), dt=1e-6
    )
    twist = torch.zeros(n, 1, dtype=F64)
    twist[n - 2] = 3.0
    rod = Statics(
        scene,
        params,
        tree.replace(state, rods=tree.replace(state.rods, twist=twist)),
        fixed=[*CLAMPED, (n - 1, 1), (n - 1, 2)],
        twisting=True,
        fixed_twist=[0, n - 2],
    )
    found = rod.solve().rods
    wanted = 3.0 * torch.arange(n - 1, dtype=F64) / (n - 2)
    assert float((found.twist[:-1, 0] - wanted).abs().max()) < 1e-8
    assert float((found.pos - straight(n)).abs().max()) < 1e-10
