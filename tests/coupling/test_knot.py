"""The overhand knot: it holds, and its loop has the radius that the pull sets."""

from __future__ import annotations

import math

import pytest
import torch
from touching import distances, trefoil

from torchdlo.coupling import RodContact
from torchdlo.physics import tree
from torchdlo.physics.effects.elastic import Bend
from torchdlo.physics.effects.external import Damping
from torchdlo.scene import Rope, check_state, make, stationary_control, step, stepper

pytestmark = pytest.mark.quick

BEND, RADIUS = 1.26e-4, 2e-3


def loose(n: int, scale: float, mu: float, room: int = 0, **choices):
    """An overhand knot with held ends, damped so that it finds its rest."""
    x = trefoil(n, scale, 0.2)
    values = {"rod_contact": {"mu_s": mu, "mu_k": mu}, "damping": {"rate": 8.0}}
    choices = {"dt": 1e-3, "substeps": 10, "prescribed_vertices": (0, n - 1)} | choices
    contact = RodContact(friction=mu > 0, burst=2.0, room=room)
    return make([Rope(x, radius=RADIUS, density=1000.0, bend=BEND)], [Bend(), Damping(), contact], values, **choices)


def pull(step, made, state, target: float, speed: float, rest: float):
    """Move the ends to a distance along their line, and then hold them for a time."""
    scene, params, _ = made
    dt = scene.dt
    with torch.no_grad():
        ends = state.rods.pos[[0, -1]]
        span = ends[1] - ends[0]
        axis, length = span / span.norm(), float(span.norm())
        count = max(1, round(abs(target - length) / speed / dt))
        control = stationary_control(scene, state)
        for k in range(count + round(rest / dt)):
            grown = (target - length) * min(1.0, (k + 1) / count) / 2
            state = step(params, state, tree.replace(control, pos=ends + torch.stack([-axis, axis]) * grown))
    return state


def measured(state) -> tuple[float, float, float]:
    """Tension of the tails [N], radius of the loop [m], and least distance over the diameter.

    The radius is the length of the loop, from the last contact on one side to the first on the other, over the angle by
    which it turns.
    """
    x = state.rods.pos
    edge = x[1:] - x[:-1]
    length = edge.norm(dim=-1)
    t = edge / length[:, None]
    angle = torch.atan2(torch.linalg.cross(t[:-1], t[1:]).norm(dim=-1), (t[:-1] * t[1:]).sum(-1))
    i, j = torch.triu_indices(len(x) - 1, len(x) - 1, 3)
    d = distances(x, i, j)
    near = d < 2 * RADIUS * 1.02
    a, b = int(i[near].max()), int(j[near].min())
    assert b - a > 10, "the knot has come undone"
    tension = 0.5 * float(state.rods.tension[1, 0] + state.rods.tension[-4, 0])
    return tension, float(length[a:b].sum() / angle[a:b].sum()), float(d.min()) / (2 * RADIUS)


@pytest.mark.slow
def test_pull_and_radius_of_the_knot_follow_the_energy_of_its_loop():
    # C6: T R^2 / B = 1/2 for a thin rope without friction (the loop has pi B / R of bending, the pull does work on
    # 2 pi R of length); here r / R = 0.02 and 10 % for its thickness, Audoly, Clauvelin, Neukirch 2007,
    # doi:10.1103/PhysRevLett.99.164301. Vertices 6 mm apart, the shortest length of the braid is sqrt(r R) = 14 mm.
    made = loose(241, 0.025, 0.0, room=3000, integrator="implicit", dt=2e-3, substeps=1)
    run = stepper(made[0], execution="recorded")
    state, radii = made[2], []
    for span in (0.806, 0.86):
        state = pull(run, made, state, span, 0.1, 4.0)
        check_state(state)
        tension, radius, apart = measured(state)
        assert tension * radius**2 / BEND == pytest.approx(0.5, rel=0.1)
        assert apart > 0.98
        radii.append(radius)
    assert RADIUS / radii[0] == pytest.approx(0.02, rel=0.15) and radii[1] < 0.95 * radii[0]


@pytest.mark.slow
def test_friction_holds_the_knot_against_pulling_and_against_letting_go():
    # Audoly 2007: the contact forces of the braid, times mu, add to the pull while the loop is made smaller, and take
    # from it while it grows. Compared over the same way, at the same speed, to that without friction.
    found = {}
    for mu in (0.0, 0.1):
        made = loose(121, 0.02, mu, substeps=5)
        run = stepper(made[0], execution="recorded")
        state = pull(run, made, made[2], 0.84, 0.2, 0.3)
        state = pull(run, made, state, 0.86, 0.05, 0.6)
        for way, spans in (("tightened", (0.875, 0.88, 0.885)), ("loosened", (0.865, 0.855, 0.845))):
            seen = []
            for target in spans:
                state = pull(run, made, state, target, 0.05, 0.0)
                seen.append(measured(state))
            check_state(state)
            found[mu, way] = sum(tension * radius**2 / BEND for tension, radius, _ in seen[1:]) / 2
    assert found[0.1, "tightened"] > 1.05 * found[0.0, "tightened"], found
    assert found[0.1, "loosened"] < 0.95 * found[0.0, "loosened"], found


def test_a_knot_pulled_tight_stays_a_knot():
    # C7: ends at 1 m/s for 0.2 s; the knot is there and strands are apart by 0.9 diameters at least, all the way.
    made = loose(81, 0.02, 0.2, substeps=4)
    scene, state = made[0], made[2]
    span = float((state.rods.pos[-1] - state.rods.pos[0]).norm())
    least = math.inf
    i, j = torch.triu_indices(80, 80, 3)
    for k in range(10):
        state = pull(lambda p, s, c: step(scene, p, s, c), made, state, span + 0.02 * (k + 1), 1.0, 0.0)
        least = min(least, float(distances(state.rods.pos, i, j).min()) / (2 * RADIUS))
    check_state(state)
    assert measured(state)[1] < 0.05  # the loop is small, and there
    assert least > 0.9, least
