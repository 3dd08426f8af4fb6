"""Candidate lists hold every pair that can touch, and say when they do not."""

from __future__ import annotations

import math

import pytest
import torch
from touching import F64, distances, line, trefoil, two

from torchdlo.coupling import RodContact
from torchdlo.coupling.common.step_diagnostics import broad_phase as find
from torchdlo.coupling.rod_contact import broad_phase, broad_phase_op
from torchdlo.physics import tree
from torchdlo.physics.effects.elastic import Bend
from torchdlo.scene import Rope, check_state, make, ok, stationary_control, step

pytestmark = pytest.mark.quick


@pytest.fixture(params=["kernel", "tensors"])
def way(request, monkeypatch):
    """Pairs are found by the kernel, or by tensor operations."""
    if request.param == "tensors":
        monkeypatch.setattr(broad_phase_op, "ready", lambda *_: False)
    elif not broad_phase_op.ready("cpu", F64):
        pytest.skip("there is no C++ compiler")


def walk(n: int, seed: int, step_m: float = 0.015, box: float = 0.12) -> torch.Tensor:
    """A random walk of n vertices in a box, crowded enough for many pairs."""
    g = torch.Generator().manual_seed(seed)
    x, out = torch.zeros(3, dtype=F64), []
    for _ in range(n):
        out.append(x)
        d = torch.randn(3, generator=g, dtype=F64) - x / box
        x = x + step_m * d / d.norm()
    return torch.stack(out)


def listed(scene, params, state) -> tuple[list[set[tuple[int, int]]], float]:
    """Pairs on the list of each scene, and how many found no room."""
    control = stationary_control(scene, state)
    found = find(scene, params, state, control, control).effects["rod_contact"]
    at, batch = found["corners"], found["corners"].shape[:-2]
    pairs = []
    for b in range(batch.numel()):
        vertices = at.reshape(-1, *at.shape[-2:])[b] // batch.numel()
        real = found["real"].reshape(batch.numel(), -1)[b] > 0
        first, second = vertices[0][real].tolist(), vertices[2][real].tolist()
        pairs.append(set(zip(first, second, strict=True)))
        assert len(pairs[-1]) == int(real.sum()), "a pair is listed twice"
    return pairs, float(found["lost"].max())


def wanted(x: torch.Tensor, counts: tuple[int, ...], limit: float, arc: float) -> set[tuple[int, int]]:
    """Pairs within a distance, by trying all."""
    rod = [k for k, n in enumerate(counts) for _ in range(n)]
    i, j = torch.triu_indices(len(x) - 1, len(x) - 1, 1)
    length = (x[1:] - x[:-1]).norm(dim=-1)
    s = torch.cat([length.new_zeros(1), length.cumsum(0)])
    d = distances(x, i, j)
    return {
        (a, b)
        for a, b, near in zip(i.tolist(), j.tolist(), (d <= limit).tolist(), strict=True)
        if near
        and rod[a] == rod[a + 1]
        and rod[b] == rod[b + 1]
        and (rod[a] != rod[b] or (b - a >= 3 and s[b] - s[a + 1] >= arc))
    }


@pytest.mark.parametrize("n", [60, 300], ids=["all pairs", "cells"])
def test_the_list_is_what_trying_all_pairs_finds(n, way):
    r, burst, dt = 0.005, 0.5, 1e-3
    x = torch.stack([walk(n, seed) for seed in (1, 2)])
    contact = RodContact(room=40 * n, row=200, burst=burst)
    ropes = [Rope(x[:, : n - 20], radius=r, density=1000.0), Rope(x[:, n - 20 :], radius=r, density=1000.0)]
    scene, params, state = make(ropes, [Bend(), contact], dt=dt, substeps=5, check=False)
    found, lost = listed(scene, params, state)
    assert lost == 0
    limit = 2 * r + 2 * burst * dt
    for b in range(2):
        # Distances that are found differ by the pull to the middle, PULL l^2 / (4 d), so 1 % at most here.
        inner = wanted(x[b], (n - 20, 20), 0.99 * limit, math.pi * r)
        outer = wanted(x[b], (n - 20, 20), limit, math.pi * r)
        assert len(inner) > 20 and inner <= found[b] <= outer


def test_both_ways_give_the_same_list(way, monkeypatch):
    scene, params, state = make(
        [Rope(walk(150, 5), radius=0.005, density=1000.0)], [RodContact(room=2000, row=200)], check=False
    )
    few, _ = listed(scene, params, state)
    monkeypatch.setattr(broad_phase, "FEW", 1)
    assert listed(scene, params, state)[0] == few and few[0]


def test_neighbours_along_a_fine_rope_do_not_touch_and_strands_of_a_hairpin_do(way):
    # Edges of a third of the radius: a straight rope is nearer to itself than its diameter, but not in contact.
    r = 0.006
    straight = make([Rope(line(40, 39 * r / 3), radius=r, density=1000.0)], [RodContact(room=1000, burst=0.1)])
    assert listed(*straight) == ([set()], 0.0)
    a = torch.linspace(0, math.pi, 30, dtype=F64)
    arc = 0.9 * r * torch.stack([torch.sin(a), torch.cos(a), 0 * a], -1)  # bent just below its own radius
    legs = [
        torch.stack([-u, torch.full_like(u, s), 0 * u], -1)
        for u, s in (
            (torch.linspace(0.05, 0.001, 20, dtype=F64), 0.9 * r),
            (torch.linspace(0.001, 0.05, 20, dtype=F64), -0.9 * r),
        )
    ]
    x = torch.cat([legs[0], arc, legs[1]])
    pairs, _ = listed(*make([Rope(x, radius=r, density=1000.0)], [RodContact(room=3000, burst=0.1)]))
    assert {(10, 58)} <= pairs[0]


def test_a_closed_rope_is_not_near_itself_across_its_seam(way):
    a = 2 * math.pi * torch.arange(30, dtype=F64) / 30
    ring = 0.1 * torch.stack([torch.cos(a), torch.sin(a), 0 * a], -1)
    assert listed(*make([Rope(ring, radius=0.005, density=1000.0, closed=True)], [RodContact()])) == ([set()], 0.0)
    flat = ring * torch.tensor([1.0, 0.05, 1.0], dtype=F64)  # squeezed until its sides meet
    pairs, _ = listed(*make([Rope(flat, radius=0.005, density=1000.0, closed=True)], [RodContact()], check=False))
    assert (7, 22) in pairs[0]


def test_a_full_list_and_fast_vertices_are_reported(way):
    full = two(contact=RodContact(room=5))
    state = step(*full, stationary_control(full[0], full[2]))
    assert not bool(ok(state)) and float(state.diagnostics[..., 0]) > 0
    with pytest.raises(RuntimeError, match=r"no room for .* pairs of edges.*; give a larger `room` to RodContact"):
        check_state(state)
    scene, params, state = two(contact=RodContact(burst=0.0), speed=0.0)
    check_state(step(scene, params, state, stationary_control(scene, state)))
    shoved = tree.replace(
        state, rods=tree.replace(state.rods, vel=state.rods.vel.index_fill(0, torch.tensor([3]), 1.0))
    )
    control = stationary_control(scene, state)
    from_rest = find(scene, params, state, control, control)
    late = step(scene, from_rest, shoved, control, broad_phase=lambda scene, params, *others: params)
    with pytest.raises(RuntimeError, match="mm further within a step than contact looked"):
        check_state(late)


@pytest.mark.parametrize("dtype", [torch.float32, F64], ids=["float32", "float64"])
@pytest.mark.parametrize("n", [60, 300], ids=["all pairs", "cells"])
@pytest.mark.skipif(not broad_phase_op.ready("cpu", F64), reason="there is no C++ compiler")
def test_the_kernel_finds_what_tensor_operations_find(n, dtype, monkeypatch):
    # Three ropes, one of them a loop, in eleven scenes that move differently, one vertex held and carried away.
    g = torch.Generator().manual_seed(3)
    x = torch.stack([walk(n, seed, box=0.12 + 0.0005 * n) for seed in range(11)]).to(dtype)
    parts = [x[:, : n // 2], x[:, n // 2 : n - 12], x[:, n - 12 :]]
    ropes = [
        Rope(
            p,
            radius=0.005 + 0.001 * k,
            density=1000.0,
            closed=k == 2,
            velocities=torch.randn(p.shape, generator=g).to(p),
        )
        for k, p in enumerate(parts)
    ]
    contact = RodContact(room=60 * n, row=300, burst=0.5)
    scene, params, state = make(ropes, [contact], dt=1e-3, prescribed_vertices=(4,), check=False)
    start = stationary_control(scene, state)
    aimed = tree.replace(start, pos=start.pos + 0.004)  # faster than all others
    found = []
    for there in (True, False):
        with monkeypatch.context() as patch:
            if not there:
                patch.setattr(broad_phase_op, "ready", lambda *_: False)
            values = find(scene, params, state, start, aimed).effects["rod_contact"]
            moved = state.rods.pos + 0.03 * torch.sin(torch.arange(3 * n, dtype=dtype)).reshape(n, 3)
            found.append((listed(scene, params, state), values["reach"], contact.capacity_overflow(moved, values)))
    (pairs, lost), reach, short = found[0]
    (others, lost_too), reach_too, short_too = found[1]
    # Pairs whose distance is within rounding of the limit may be on one list only.
    limit = 1 if dtype == torch.float32 else 0
    assert lost == lost_too == 0 and all(len(a) > n and len(a ^ b) <= limit for a, b in zip(pairs, others, strict=True))
    rounding = 20 * torch.finfo(dtype).eps
    assert torch.allclose(reach, reach_too, rtol=rounding, atol=0) and float(reach.min()) > 0.01
    assert float(short[..., 1].min()) > 0 and torch.allclose(short, short_too, rtol=0, atol=rounding * 0.2)


def test_a_crowded_row_of_cells_is_reported(monkeypatch):
    # Of tensor operations only: the kernel has room for any number of edges in a row.
    monkeypatch.setattr(broad_phase_op, "ready", lambda *_: False)
    x = torch.stack([walk(300, 1)])
    scene, params, state = make([Rope(x, radius=0.005, density=1000.0)], [RodContact(room=20000, row=2)], check=False)
    assert listed(scene, params, state)[1] > 0


def test_the_overhand_knot_is_found_with_room_to_spare(way):
    scene, params, state = make([Rope(trefoil(121), radius=0.003, density=1000.0)], [RodContact()])
    pairs, lost = listed(scene, params, state)
    assert lost == 0 and 3 <= len(pairs[0]) < 242
