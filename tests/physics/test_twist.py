"""Twist at clamps over many turns, linking number, and the two ways to treat twist."""

from __future__ import annotations

import math

import pytest
import torch
from helpers import F64, Statics, effects, energy, loads, run, speed, straight, vec

from torchdlo.physics import tree
from torchdlo.scene import Control, Rope, make, stationary_control, step

pytestmark = pytest.mark.quick


def wound(angle: float) -> torch.Tensor:
    """Director of an edge along x turned by an angle [rad] from y."""
    return vec(0.0, math.cos(angle), math.sin(angle))


def clamped(x: torch.Tensor, names=("bend", "twist", "damping"), rate: float = 5.0, **choices):
    """Rod with both end edges held, frames included; the first director of all edges starts at y for edges along x."""
    n = len(x)
    given = {"mass": 0.2, "bend": 2e-3, "twist": 1.5e-3, "radius": 0.02} | choices.pop("rope", {})
    values = {"damping": {"rate": rate, "twist_rate": rate}} if "damping" in names else {}
    choices = {"dt": 5e-3, "substeps": 1, "integrator": "implicit"} | choices
    return make(
        [Rope(x, director=vec(0, 1, 0), **given)],
        effects(*names),
        values,
        prescribed_vertices=(0, 1, n - 2, n - 1),
        prescribed_edges=(0, n - 2),
        **choices,
    )


def arc(n: int, slack: float = 0.8) -> torch.Tensor:
    """Bowed shape of length 1 in the x-z plane whose first and last edges lie along x."""
    s = (torch.arange(n - 1, dtype=F64) - 0.5) / (n - 3)
    s = s.clamp(0, 1)
    low, high = 0.0, 2.0
    for _ in range(60):
        top = 0.5 * (low + high)
        reach = torch.cos(top * torch.sin(2 * math.pi * s)).mean()
        low, high = (top, high) if reach > slack else (low, top)
    heading = top * torch.sin(2 * math.pi * s)
    edges = torch.stack([torch.cos(heading), 0 * s, torch.sin(heading)], -1) / (n - 1)
    return torch.cat([vec(0, 0, 0)[None], torch.cumsum(edges, 0)])


@pytest.mark.parametrize("twist", ["quasistatic", "dynamic"])
def test_a_straight_rod_wound_ten_turns_carries_ten_turns(twist):
    # T7. Ten turns at one clamp: the end twist is 20 pi exactly, twists linear, energy C Theta^2 / 2 (L - h).
    n, turns = 12, 10
    scene, params, state = clamped(straight(n), twist=twist, rate=30.0, rope={"bend": 0.2, "stretch": 1e5})
    start = stationary_control(scene, state)
    steps = 150

    def wind(k, _):
        return Control(start.pos, torch.stack([wound(0), wound(2 * math.pi * turns * min(1, (k + 1) / steps))]))

    state, _ = run(scene, params, state, steps + (200 if twist == "dynamic" else 0), wind)
    total = state.rods.twist[n - 2, 0] - state.rods.twist[0, 0] + state.rods.ref_twist.sum()
    assert float(total) == pytest.approx(2 * math.pi * turns, abs=1e-9)
    wanted = 2 * math.pi * turns * torch.arange(n - 1, dtype=F64) / (n - 2)
    assert float((state.rods.twist[:-1, 0] - wanted).abs().max()) < (1e-6 if twist == "quasistatic" else 1e-3)
    twisting = 0.5 * 1.5e-3 * (2 * math.pi * turns) ** 2 / (1 - 1 / (n - 1))
    assert float(energy(scene, params, state)) == pytest.approx(twisting, rel=1e-5)
    torque = loads(scene, params, state)[1]
    assert float(torque[0]) == pytest.approx(1.5e-3 * 2 * math.pi * turns / (1 - 1 / (n - 1)), rel=1e-3)
    assert float((state.rods.pos - straight(n)).abs().max()) < 1e-9


def writhe(points: torch.Tensor) -> float:
    """Writhe of a closed polygon by solid angles (Klenin and Langowski 2000, method 1a)."""
    n = len(points)
    ends = torch.roll(points, -1, 0)
    i, j = torch.triu_indices(n, n, offset=2)
    keep = ~((i == 0) & (j == n - 1))
    i, j = i[keep], j[keep]
    a, b, c, d = points[i], ends[i], points[j], ends[j]

    def unit(x):
        return x / x.norm(dim=-1, keepdim=True).clamp(min=1e-300)

    r13, r14, r23, r24 = c - a, d - a, c - b, d - b
    normals = [unit(torch.linalg.cross(*pair)) for pair in ((r13, r14), (r14, r24), (r24, r23), (r23, r13))]
    solid = sum(torch.asin((normals[k] * normals[(k + 1) % 4]).sum(-1).clamp(-1, 1)) for k in range(4))
    sign = torch.sign((torch.linalg.cross(d - c, b - a) * r13).sum(-1))
    return float((solid * sign).sum() / (2 * math.pi))


@pytest.mark.parametrize("twist", ["quasistatic", "dynamic"])
def test_linking_number_follows_the_clamp_while_the_rod_buckles(twist):
    # T7 (Calugareanu): Tw + Wr of the rod closed by a fixed far path = turns commanded, to 1e-3 turn, with growing
    # writhe.
    n, turns, steps = 25, 2.0, 240
    x = arc(n, 0.85)
    scene, params, state = clamped(x, twist=twist, rate=4.0)
    start = stationary_control(scene, state)
    a = torch.linspace(0, math.pi, 12, dtype=F64)[1:-1]
    middle, half = 0.5 * float(x[-1, 0]), 0.5 * float(x[-1, 0]) + 2.0
    closure = torch.cat(
        [
            vec(middle + half, 0, 0)[None],
            torch.stack([middle + half * torch.cos(a), 0 * a, -3 * torch.sin(a)], -1),
            vec(middle - half, 0, 0)[None],
        ]
    )

    def link(st):
        r = st.rods
        twisting = (r.twist[1 : n - 1] - r.twist[: n - 2] + r.ref_twist[1 : n - 1]).sum()
        wr = writhe(torch.cat([r.pos, closure]))
        return float(twisting) / (2 * math.pi), wr

    def wind(k, _):
        return Control(start.pos, torch.stack([wound(0), wound(2 * math.pi * turns * (k + 1) / steps)]))

    tw0, wr0 = link(state)
    last, seen = run(scene, params, state, steps, wind, link)
    for k, (tw, wr) in enumerate(seen):
        assert tw + wr - tw0 - wr0 == pytest.approx(turns * (k + 1) / steps, abs=1e-3), k
    # Buckled as far as statics says: after 1.5 s at rest, damped at 4 / s, exp(-1.5 s 4 / s / 2) = 5 % are left of the
    # 0.007 turns by which the moving rod lags behind the equilibrium: 1e-3. The bow may turn about the clamps' axis at
    # no cost, so statics holds its middle where it is across that.
    last, _ = run(scene, params, last, 300, wind(steps - 1, last))
    ends = [(v, axis) for v in (0, 1, n - 2, n - 1) for axis in range(3)]
    across = 1 if abs(float(last.rods.pos[n // 2, 1])) < abs(float(last.rods.pos[n // 2, 2])) else 2
    still = Statics(scene, params, last, fixed=[*ends, (n // 2, across)], fixed_twist=[0, n - 2], twisting=True)
    still.tension = last.rods.tension[still.edges, 0]
    wanted = link(still.solve())[1]
    assert abs(wanted) > 0.1 and link(last)[1] == pytest.approx(wanted, abs=1e-3)


def test_quasistatic_twist_is_the_long_time_limit_of_dynamic_twist():
    # A hanging bow whose end turns by 2 rad and then rests: both come to the same shape and the same twists.
    last = {}
    for twist in ("quasistatic", "dynamic"):
        scene, params, state = clamped(
            arc(16) * vec(1, 1, -1), names=("bend", "twist", "damping", "gravity"), twist=twist, rate=8.0
        )
        start = stationary_control(scene, state)

        def wind(k, _, start=start):
            return Control(start.pos, torch.stack([wound(0), wound(2.0 * min(1.0, (k + 1) / 100))]))

        state, _ = run(scene, params, state, 900, wind)
        assert speed(state) < 1e-7, speed(state)
        last[twist] = state.rods
    a, b = last["quasistatic"], last["dynamic"]
    assert float((a.pos - b.pos).abs().max()) < 1e-7
    strain = [r.twist[1:-1] - r.twist[:-2] + r.ref_twist[1:-1] for r in (a, b)]
    assert float((strain[0] - strain[1]).abs().max()) < 1e-7


@pytest.mark.parametrize("integrator", ["explicit", "implicit"])
@pytest.mark.parametrize("twist", ["dynamic", "quasistatic"])
def test_held_frames_are_where_the_control_wants_them(integrator, twist):
    # Directors of held edges equal their targets at the end of a step while their edge turns, over several turns.
    n = 10
    scene, params, state = clamped(
        arc(n), names=("bend_frame", "twist", "damping"), twist=twist, integrator=integrator, dt=2e-3, substeps=2
    )
    start = stationary_control(scene, state)
    for k in range(60):
        wanted = torch.stack([wound(0.1 * k), wound(-0.3 * k)])
        tilt = 0.02 * math.sin(0.2 * k)
        pos = start.pos + torch.stack([vec(0, 0, 0), vec(0, 0, 0), vec(0, tilt, 0), vec(0, tilt, 0)])
        state = step(scene, params, state, Control(pos, wanted))
        assert float((stationary_control(scene, state).director - wanted).abs().max()) < 1e-12
        assert bool(torch.isfinite(state.rods.pos).all())
    assert float(state.rods.twist[n - 2]) == pytest.approx(-0.3 * 59, abs=1e-9)


def test_held_frames_turn_evenly_within_a_step():
    # `step`: held parts move evenly to where the control wants them. One step of ten substeps equals ten steps of
    # one.
    found = []
    for steps, substeps in ((1, 10), (10, 1)):
        n = 8
        scene, params, state = clamped(
            arc(n), twist="dynamic", dt=0.01 / steps, substeps=substeps, integrator="explicit", names=("bend", "twist")
        )
        start = stationary_control(scene, state)
        for k in range(steps):
            state = step(
                scene, params, state, Control(start.pos, torch.stack([wound(0), wound(0.5 * (k + 1) / steps)]))
            )
        found.append(torch.cat([state.rods.twist, state.rods.twist_rate * 1e-3], -1))
    assert float((found[0] - found[1]).abs().max()) < 1e-9, (found[0] - found[1]).abs().max()


def test_twist_does_not_move_a_straight_isotropic_rod_at_rest():
    # T2 dynamically: twist waves in a straight rod exert no force on its vertices.
    scene, params, state = clamped(
        straight(10), names=("bend_frame", "twist"), twist="dynamic", dt=1e-3, rope={"stretch": 1e5}
    )
    twist = torch.linspace(0, 2, 9, dtype=F64)[:, None]
    state = tree.replace(state, rods=tree.replace(state.rods, twist=torch.cat([twist, torch.zeros(1, 1, dtype=F64)])))
    state, _ = run(scene, params, state, 100, stationary_control(scene, state))
    assert float((state.rods.pos - straight(10)).abs().max()) < 1e-12
