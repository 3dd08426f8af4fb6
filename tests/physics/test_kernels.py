"""The C++ kernels of the rods do what the tensor operations do that have derivatives."""

from __future__ import annotations

import pytest
import torch
from helpers import F64, circle, effects, run, straight, vec, wild

from torchdlo.physics import tree
from torchdlo.physics.execution import tracing
from torchdlo.physics.kernels import lanes
from torchdlo.scene import Rope, make, stationary_control, step

pytestmark = pytest.mark.quick

GIVEN = {"mass": 0.1, "bend": 1e-3, "twist": 1e-3, "radius": 0.01}

IMPLICIT = {"dt": 2e-3, "integrator": "implicit"}
BALANCED = IMPLICIT | {"twist": "quasistatic", "prescribed_vertices": (0, 1)}


def ropes(batch: tuple[int, ...], dtype: torch.dtype, *, loop: bool) -> list[Rope]:
    """An open rope, and a closed one beside it."""
    line = wild(9, 1, batch=batch, rough=0.05)
    given = GIVEN | {"stretch": 200.0}
    ring = circle(6, 0.2) + vec(0, 1, 0) + 0.02 * wild(6, 2, batch=batch)
    made = [Rope(line.to(dtype), velocities=wild(9, 4, batch=batch).to(dtype), **given)]
    return [*made, Rope(ring.to(dtype), closed=True, **GIVEN, stretch=1e3)] if loop else made


def stepped(monkeypatch, kernels: bool, built, steps: int):
    """States of a scene with or without the kernels, and which of them were used."""
    used, apply = set(), lanes.apply

    def watched(kernel, *others, **more):
        used.add(kernel)
        return apply(kernel, *others, **more)

    with monkeypatch.context() as patch, torch.no_grad():
        patch.setattr(lanes, "ready", lambda like: kernels and lanes.available(like))
        patch.setattr(lanes, "apply", watched)
        state, _ = run(*built, steps)
    return state, used


FRAMED = ("look", "carry", "curve", "pull", "answer", "twist", "settle", "balance")


def assert_same(monkeypatch, built, tolerance, steps=6, uses=FRAMED):
    there, used = stepped(monkeypatch, True, built, steps)
    here, unused = stepped(monkeypatch, False, built, steps)
    assert used == set(uses)
    assert not unused
    for a, b in zip(tree.leaves(there.rods), tree.leaves(here.rods), strict=True):
        assert a.shape == b.shape
        assert bool(torch.isfinite(b).all())
        assert float((a - b).abs().max()) < tolerance * max(1.0, float(b.abs().max()))


@pytest.mark.parametrize("batch", [(), (1,), (11,), (2, 3)])
@pytest.mark.parametrize("loop", [False, True])
def test_implicit_steps_are_the_same_for_any_batch(batch, loop, monkeypatch):
    built = make(
        ropes(batch, F64, loop=loop),
        effects("gravity", "bend_frame", "twist", "damping"),
        {"damping": {"rate": 0.5}},
        **BALANCED,
        prescribed_edges=(0, 9) if loop else (0,),
    )
    assert_same(monkeypatch, built, 1e-9)


@pytest.mark.parametrize("ahead", [0.0, 0.1])
def test_drag_of_hinges_and_steps_that_look_ahead_are_the_same(ahead, monkeypatch):
    built = make(
        ropes((3,), F64, loop=False),
        effects("gravity", "bend", "bending_damping", "damping"),
        {"bending_damping": {"coefficient": 1e-4}},
        **IMPLICIT,
        numerical_damping=ahead,
        prescribed_vertices=(0, 8),
    )
    assert_same(monkeypatch, built, 1e-9, uses=("look", "bend", "curve", "damp", "pull", "carry", "balance"))


@pytest.mark.parametrize("loop", [False, True])
def test_damping_of_bends_answers_to_twists_the_same(loop, monkeypatch):
    built = make(
        ropes((5,), F64, loop=loop),
        effects("gravity", "bend_frame", "twist", "bending_damping"),
        {"bending_damping": {"coefficient": 1e-4}},
        **BALANCED,
        prescribed_edges=(0,),
    )
    assert_same(monkeypatch, built, 1e-9, uses=(*FRAMED, "damp"))


@pytest.mark.parametrize("length", [0.03, -0.02, 0.0])
def test_chains_of_links_are_the_same(length, monkeypatch):
    built = make(
        ropes((3,), F64, loop=False),
        effects("gravity", "bend_frame", "twist", "link_chain"),
        {"link_chain": {"length": length}},
        **BALANCED,
        prescribed_edges=(0,),
    )
    assert_same(monkeypatch, built, 1e-9, uses=(*FRAMED, "joint", "spring"))


def test_single_precision_is_as_good_as_the_operations_are(monkeypatch):
    def moved(dtype, kernels):
        built = make(
            ropes((5,), dtype, loop=True),
            effects("gravity", "bend_frame", "twist"),
            **BALANCED,
            prescribed_edges=(0, 9),
        )
        return stepped(monkeypatch, kernels, built, 5)[0].rods

    right = moved(F64, False)
    for name, most in (("pos", 2e-5), ("twist", 3e-6), ("tension", 1e-2)):
        exact = getattr(right, name)
        here, there = (getattr(moved(torch.float32, k), name) for k in (True, False))
        assert here.dtype == torch.float32
        assert float((here - exact).abs().max()) < max(most, 2 * float((there - exact).abs().max()))


def test_explicit_steps_carry_frames_the_same_way(monkeypatch):
    built = make(
        ropes((3,), F64, loop=True),
        effects("gravity", "bend_frame", "twist"),
        dt=5e-4,
        integrator="explicit",
        twist="dynamic",
        prescribed_vertices=(0,),
    )
    assert_same(monkeypatch, built, 1e-9, uses=("look", "carry", "curve", "pull", "answer", "twist", "project"))


@pytest.mark.parametrize("batch", [(), (1,), (11,), (2, 3)])
@pytest.mark.parametrize("loop", [False, True])
def test_explicit_steps_are_the_same_for_any_batch(batch, loop, monkeypatch):
    built = make(
        ropes(batch, F64, loop=loop),
        effects("gravity", "bend", "damping"),
        {"damping": {"rate": 0.5}},
        dt=2e-4,
        prescribed_vertices=(0, 1),
    )
    assert_same(monkeypatch, built, 1e-9, uses=("look", "bend", "project"))


def test_lengths_are_kept_as_well_in_single_precision(monkeypatch):
    # A long rope of short edges: its tensions answer to the last digits of lengths and of the system's diagonal.
    pos = straight(60, 1.0)
    pos[..., 2] = -0.1 * pos[..., 0] ** 2
    rest = (pos[1:] - pos[:-1]).norm(dim=-1)
    off = {}
    for kernels in (True, False):
        rope = Rope(pos.float(), radius=0.005, density=1000.0, bend=1e-4)
        built = make([rope], effects("gravity", "bend"), dt=1e-3, substeps=5, prescribed_vertices=(0, 1))
        moved = stepped(monkeypatch, kernels, built, 20)[0].rods.pos.double()
        off[kernels] = float(((moved[1:] - moved[:-1]).norm(dim=-1) - rest).abs().max())
    # Rounding of positions near 1 m, of half 6e-8 m at both ends in three directions.
    assert off[True] < 2e-7 and off[False] < 2e-7


def test_a_rope_pulled_beyond_its_length_gives_way_the_same(monkeypatch):
    pos = straight(8, 1.0)
    scene, params, state = make(
        [Rope(pos, **GIVEN)],
        effects("gravity", "bend"),
        **IMPLICIT,
        numerical_damping=0.1,
        prescribed_vertices=(0, 7),
    )
    still = stationary_control(scene, state)
    pulled = tree.replace(still, pos=still.pos + torch.linspace(0, 0.02, 2, dtype=F64)[:, None] * vec(1, 0, 0))
    found = []
    for kernels in (True, False):
        with monkeypatch.context() as patch, torch.no_grad():
            patch.setattr(lanes, "ready", lambda like, kernels=kernels: kernels and lanes.available(like))
            now = state
            for _ in range(5):
                now = step(scene, params, now, pulled)
            found.append(now.rods)
    assert float(found[1].tension.max()) > 1.0
    for name in ("pos", "tension"):
        a, b = (getattr(rods, name) for rods in found)
        torch.testing.assert_close(a, b, rtol=1e-7, atol=1e-10)


def test_they_are_used_in_recorded_steps_only(monkeypatch):
    scene, params, state = make(ropes((2,), F64, loop=False), effects("gravity", "bend"), **IMPLICIT)
    used, apply = [], lanes.apply
    monkeypatch.setattr(lanes, "apply", lambda kernel, *others: (used.append(kernel), apply(kernel, *others))[1])
    control = stationary_control(scene, state)
    with torch.no_grad():
        plain = step(scene, params, state, control)
    assert not used
    fast = tracing.record(lambda *given: step(scene, *given), params, state, control)(params, state, control)
    assert {"look", "bend", "balance"} <= set(used)
    torch.testing.assert_close(fast.rods.pos, plain.rods.pos, rtol=0, atol=1e-14)
