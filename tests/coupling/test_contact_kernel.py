"""The kernel of implicit steps with contact finds what the tensor operations find, and bigger scenes stay calm."""

from __future__ import annotations

import pytest
import torch

from torchdlo import scene
from torchdlo.coupling import RodBody, RodContact
from torchdlo.physics import tree
from torchdlo.physics.constraints import contact_penalty as penalty
from torchdlo.physics.effects import EFFECTS
from torchdlo.physics.integrators import contact_kernel, contact_step
from torchdlo.physics.linalg import banded
from torchdlo.scene import RigidBody, Rope, check_gradients, make

F64 = torch.float64
IMPLICIT = {"integrator": "implicit", "dt": 2e-3, "substeps": 1}


def crossing(batch: int, closed: bool):
    """Two ropes that hit each other, one of them closed if asked for, above a free ball."""
    s = torch.linspace(0, 1, 15, dtype=F64)[:, None]
    one = torch.tensor([-0.1, 0, 0.03], dtype=F64) + s * torch.tensor([0.2, 0, 0], dtype=F64)
    angle = 2 * torch.pi * torch.arange(12, dtype=F64)[:, None] / 12
    ring = torch.cat([0.03 + 0.04 * angle.cos(), 0.04 * angle.sin(), torch.full_like(angle, 0.0365)], -1)
    other = ring if closed else torch.tensor([0.013, -0.1, 0.0365], dtype=F64) + s * one.new_tensor([0.0, 0.2, 0.0])
    shift = 1e-3 * torch.arange(batch, dtype=F64)[:, None, None] * one.new_tensor([1.0, 0.0, 0.0])
    falling = one.new_tensor([0.2, 0.1, -0.5]).expand(batch, other.shape[0], 3)
    numbers = {"radius": 0.003, "mass": 0.01, "bend": 1e-4}
    ropes = [
        Rope(one.expand(batch, *one.shape), **numbers),
        Rope(other + shift, closed=closed, velocities=falling, **numbers),
    ]
    ball = RigidBody("sphere", (0.02,), pos=(0.0, 0.0, 0.0065), mass=0.05)
    effects = [EFFECTS["bend"](), EFFECTS["gravity"](), RodContact(), RodBody()]
    return make(ropes, effects, bodies=[ball], prescribed_vertices=(0,), **IMPLICIT)


@pytest.mark.parametrize("closed", [False, True], ids=["open", "closed"])
def test_the_kernel_finds_what_tensor_operations_find(closed, monkeypatch):
    made, params, start = crossing(2, closed)
    control, ends = scene.stationary_control(made, start), []
    for kernel in (True, False):
        with monkeypatch.context() as patch, torch.no_grad():
            if not kernel:
                patch.setattr(contact_kernel, "available", lambda like: False)
            state = start
            for _ in range(12):
                state = scene.step(made, params, state, control)
        ends.append(state)
    moved = [x.bodies.pos - start.bodies.pos for x in ends]
    assert float((ends[0].rods.pos - ends[1].rods.pos).abs().max()) < 1e-10
    assert float((moved[0] - moved[1]).abs().max()) < 1e-10
    assert float(moved[0][..., :2].abs().max()) > 1e-6  # it was hit
    scene.check_state(ends[0])


@pytest.mark.parametrize("what", ["pos", "vel"])
def test_gradients_of_ropes_that_press_each_other_are_those_of_differences(what):
    made, params, state = crossing(1, False)
    control = scene.stationary_control(made, state)
    with torch.no_grad():
        for _ in range(2):
            state = scene.step(made, params, state, control)
    weight = torch.linspace(0, 1, state.rods.pos.numel(), dtype=F64).reshape(state.rods.pos.shape)

    def seen(given: torch.Tensor) -> torch.Tensor:
        now = tree.replace(state, rods=tree.replace(state.rods, **{what: given}))
        return (scene.step(made, params, now, control).rods.pos * weight).sum()

    found = check_gradients(seen, getattr(state.rods, what), directions=2, span=1e-7 if what == "pos" else 1e-5)
    assert found.error < 1e-6, str(found)


@pytest.mark.parametrize("transpose", [False, True])
def test_systems_with_a_term_of_low_rank_are_those_of_full_matrices(transpose):
    rng, (slots, pairs, scenes) = torch.Generator().manual_seed(0), (6, 3, 2)
    name = f"touching:o{slots}"
    entries = 0.1 * torch.rand(42 * slots, scenes, generator=rng, dtype=F64)
    for c in (0, 4, 8):  # diagonals of the blocks of 3 x 3
        entries[c * slots : (c + 1) * slots] += 2
    entries[41 * slots :] -= 2
    vertex = torch.stack([torch.randperm(slots, generator=rng)[:4] for _ in range(pairs * scenes)], -1)
    left, right = (torch.randn(4, 3, 3, pairs, scenes, generator=rng, dtype=F64) for _ in range(2))
    right[..., 0, 0] = 0.0  # a pair that has no part in it
    vertex = vertex.reshape(4, pairs, scenes)
    rhs = torch.randn(4 * slots, scenes, generator=rng, dtype=F64)
    found = torch.ops.torchdlo.solve_low_rank(entries, vertex, left, right, rhs, name, transpose)
    whole = banded.dense_matrix(entries, name)
    for b in range(scenes):
        for k in range(pairs):
            rows = torch.stack([c * slots + vertex[:, k, b] for c in range(3)], -1).flatten()
            up = left[..., k, b].flatten(0, 1)
            whole[b][rows[:, None], rows] += up @ right[..., k, b].transpose(0, 1).flatten(1)
    matrix = whole.mT if transpose else whole
    assert float((matrix @ found.T.unsqueeze(-1) - rhs.T.unsqueeze(-1)).abs().max()) < 1e-10


def test_recorded_steps_move_as_others_do():
    made, params, start = crossing(1, False)
    control, ends = scene.stationary_control(made, start), []
    for step in (scene.stepper(made, execution="recorded"), scene.stepper(made, execution="eager")):
        state = start
        with torch.no_grad():
            for _ in range(12):
                state = step(params, state, control)
        ends.append(state.rods.pos)
    assert float((ends[0] - ends[1]).abs().max()) < 1e-9


def test_a_rope_that_piles_up_comes_to_rest_without_gaining_energy():
    s = torch.linspace(0, 1, 41, dtype=F64)
    turn = 6 * torch.pi * s
    x = torch.stack([0.03 * turn.cos(), 0.03 * turn.sin(), 0.02 + 0.05 * s], -1)
    rope = Rope(x, radius=0.004, mass=0.02, bend=1e-5, rest="as_placed")
    effects = [EFFECTS["bend_frame"](), EFFECTS["gravity"](), EFFECTS["damping"](), RodContact(room=400), RodBody()]
    made, params, state = make(
        [rope], effects, {"damping": {"rate": 2.0}}, bodies=[RigidBody("plane", motion="fixed")], **IMPLICIT
    )
    step, control = scene.stepper(made, execution="recorded"), scene.stationary_control(made, state)
    mass, energy = params.rods.material.mass, []
    with torch.no_grad():
        for _ in range(300):
            state = step(params, state, control)
            moving = 0.5 * (mass * state.rods.vel.square()).sum()
            energy.append(float(moving + 9.81 * (mass[..., 0] * state.rods.pos[..., 2]).sum()))
    scene.check_state(state)
    assert max(energy) <= energy[0] * (1 + 1e-3) and energy[-1] < 0.6 * energy[0]
    assert float(state.rods.vel.norm(dim=-1).max()) < 0.1 and float(state.rods.pos[:, 2].min()) > 0.004 * 0.95


@pytest.mark.parametrize("kernel", [True, False], ids=["kernel", "tensors"])
def test_a_knot_in_single_precision_is_not_softened_for_rounding(kernel, monkeypatch):
    """Rounding leaves more than what counts as solved: softer contact would cost eightfold and not help."""
    from torchdlo.envs import find, parse_fidelity, with_fidelity
    from torchdlo.envs.core import episode

    if kernel and not contact_kernel.available(torch.zeros(())):
        pytest.skip("no C++ compiler")
    task = with_fidelity(find("unknotting"), parse_fidelity("2ms/1/implicit"))
    made = episode.prepare(task, 1, execution="eager")
    if not kernel:
        monkeypatch.setattr(contact_kernel, "available", lambda like: False)
    hard, searched = [], contact_step._searched

    def watched(touching, tension, whole=False):
        found = searched(touching, tension, whole)
        hard.append(float(found[3].min()))
        return found

    monkeypatch.setattr(contact_step, "_searched", watched)
    world, action = made.start, torch.zeros(1, task.width)
    for _ in range(2 if kernel else 1):
        world = episode.act(made, world, action)
    assert len(hard) >= 10
    assert min(hard) > 0.05 * penalty.HARD, hard
    assert sum(x == pytest.approx(penalty.HARD) for x in hard) >= 0.6 * len(hard), hard
    assert not bool(world.failed.any())
