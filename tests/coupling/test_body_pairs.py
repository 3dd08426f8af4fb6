"""The kernel for contact among bodies does what the tensor operations do, and so does its derivative."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from tests.coupling.tumbling import F64, SHAPES, ground
from torchdlo.coupling.bodies import contact_op
from torchdlo.coupling.bodies.contact_effect import BodyContact, answer, contact_forces
from torchdlo.coupling.bodies.contact_solver import inertia
from torchdlo.coupling.bodies.dynamics import (
    PredictedBodyMotion,
    RigidBody,
    place_bodies,
    predict_free_motion,
    stationary_control,
)
from torchdlo.envs.assets.rigid_objects import pebble
from torchdlo.physics import tree
from torchdlo.physics.effects.base import ContactForces

pytestmark = pytest.mark.skipif(not contact_op.ready("cpu", F64), reason="there is no C++ compiler")

DT = 2e-3
SCENES = 11
"""Fill one block of lanes and a part of the next."""


def thrown(kinds: tuple[str, ...], seed: int = 1) -> list[RigidBody]:
    """Bodies that fly at each other, in another way in every scene; the first may be the ground."""
    g = torch.Generator().manual_seed(seed)

    def random(width: int, scale: float) -> torch.Tensor:
        return scale * torch.randn(SCENES, width, generator=g, dtype=F64)

    solids = (
        [ground(pos=(0.0, 0.0, -0.06), quat=(0.998, 0.05, 0.04, 0.0), restitution=0.4)] if kinds[0] == "plane" else []
    )
    for k, kind in enumerate(kinds[len(solids) :]):
        at = torch.tensor([(0.07 if kind == "mesh" else 0.09) * k - 0.02, 0.01 * k, 0.0], dtype=F64)
        toward = torch.tensor([0.8 - 0.8 * k, 0.1, -0.5], dtype=F64)
        turn, place = random(4, 1.0), at + random(3, 0.02)
        quat = turn / turn.norm(dim=-1, keepdim=True)
        numbers = {"vel": toward + random(3, 0.2), "omega": random(3, 1.0), "density": 600.0}
        numbers |= {"restitution": 0.3, "mu_s": 0.4, "mu_k": 0.3}
        if kind == "mesh":
            solids.append(pebble().solid(place, quat, name=f"mesh {k}", **numbers))
        else:
            solids.append(RigidBody(kind, SHAPES[kind], place, quat, **numbers))
    return solids


def answered(solids: list[RigidBody], contact: BodyContact, shift: float = 0.0, hold: bool = False):
    """Forces and torques, and the derivatives of a sum of them by all numbers, each of which is changed by a share.

    If `hold`, how they fall with displacements is among them, in units of inertia.
    """
    kinds, params, state = place_bodies(solids, torch.zeros(SCENES, 1, 3, dtype=F64))
    leaves, build = tree.flatten((params, state))
    signs = torch.Generator().manual_seed(2)
    leaves = [x * (1 + shift * torch.randn(x.shape, generator=signs, dtype=F64).sign()) for x in leaves]
    params, state = build(leaves)
    # The kernel takes meshes as they are: with a derivative by their grids there are tensor operations only.
    meshes = [id(params.grid), id(params.balls)] * ("mesh" in [k.shape for k in kinds])
    leaves = [x.requires_grad_() for x in leaves if id(x) not in meshes]
    one = torch.zeros(1, 1, dtype=F64)
    pulled = torch.tensor([[0.0, 0.0, -9.81]], dtype=F64)
    motion = predict_free_motion(kinds, params, state, stationary_control(kinds, state), pulled, one, DT)
    parts = answer(contact, motion, hold)
    found = torch.cat([x.expand(SCENES, -1, -1) for x in parts[:2]], -1)
    if hold:
        free = [k for k, b in enumerate(kinds) if b.motion == "free"]
        found = torch.cat(
            [found.flatten(1), (parts[2] / inertia(motion, free).amax()).expand(SCENES, -1, 6, 6).flatten(1)], -1
        )
    weight = torch.sin(torch.arange(found.numel(), dtype=F64)).reshape(found.shape)
    gradient = torch.autograd.grad((weight * found).sum(), leaves, allow_unused=True)
    return found.detach(), [torch.zeros_like(x) if g is None else g for x, g in zip(leaves, gradient, strict=True)]


CASES = {
    "box on plane": (("plane", "box"), {}),
    "cylinder on plane": (("plane", "cylinder"), {}),
    "sphere and box": (("sphere", "box"), {}),
    "box and cone": (("box", "cone"), {}),
    "capsule and cylinder": (("capsule", "cylinder"), {}),
    "cone and torus": (("cone", "torus"), {}),
    "torus and ring": (("torus", "ring"), {}),
    "ring and capsule": (("ring", "capsule"), {}),
    "mesh on plane": (("plane", "mesh"), {}),
    "mesh and mesh": (("mesh", "mesh"), {}),
    "box and mesh": (("box", "mesh"), {"points": 4}),
    "a heap": (("plane", "box", "cylinder", "capsule"), {"points": 4}),
    "too few rounds": (("plane", "box", "box"), {"steps": 1}),
}


@pytest.mark.parametrize(
    ("case", "hold"), [*((c, False) for c in CASES), ("box on plane", True), ("mesh and mesh", True), ("a heap", True)]
)
def test_the_kernel_and_tensor_operations_agree_with_their_gradients(case: str, hold: bool, monkeypatch) -> None:
    kinds, choices = CASES[case]
    solids, contact = thrown(kinds), BodyContact(**choices)
    found, gradient = answered(solids, contact, 0.0, hold)
    monkeypatch.setattr(contact_op, "ready", lambda *_: False)
    wanted, expected = answered(solids, contact, 0.0, hold)
    assert int((wanted.flatten(1).abs().amax(-1) > 0).sum()) >= 3  # scenes with contact
    assert float((found - wanted).norm()) < 1e-9 * float(wanted.norm())
    # Derivatives answer to rounding as the stiffness of contact makes them: the scale is what the tensor operations
    # themselves find when their inputs are rounded otherwise, by the last bit. Whether a step is worth taking that
    # changes next to nothing is a matter of rounding, too.
    _, rounded = answered(solids, contact, 2**-52, hold)
    for one, other, near in zip(gradient, expected, rounded, strict=True):
        noise = float((near - other).norm()) + 1e-10 * float(other.norm())
        assert float((one - other).norm()) <= 30 * noise


@pytest.mark.parametrize("slides", [False, True])
def test_how_contact_holds_a_body_is_how_its_force_falls_with_the_displacement(slides: bool) -> None:
    box = RigidBody("box", (0.05, 0.04, 0.03), (0, 0, 0.03), vel=(0.4 * slides, 0, 0), mass=0.3, mu_s=0.4, mu_k=0.3)
    kinds, params, state = place_bodies([ground(mu_s=0.4, mu_k=0.3), box], torch.zeros(1, 1, 3, dtype=F64))
    still, first = stationary_control(kinds, state), torch.zeros(1, 1, dtype=F64)
    motion = predict_free_motion(kinds, params, state, still, torch.tensor([[0.5, 0.2, -9.81]], dtype=F64), first, DT)
    hold = answer(BodyContact(), motion, True)[2]
    mass = inertia(motion, [1])
    for k in range(6):
        more = torch.zeros(6, dtype=F64)
        more[k] = 1e-3 if k < 3 else 1e-5  # less than what lifts a corner

        def wrench(sign: float, more=more) -> torch.Tensor:
            push = ContactForces(
                *(torch.zeros(1, 3, dtype=F64), *(torch.stack([0 * x, sign * x]) for x in more.split(3)))
            )
            return torch.cat(contact_forces(BodyContact(), motion.pushed(push)), -1)[..., 1, :]

        change = 0.5 * (wrench(1.0) - wrench(-1.0))
        expected = -(hold @ torch.linalg.solve(mass + hold, more.unsqueeze(-1))).squeeze(-1)
        assert float((change - expected).norm()) < 1e-4 * float(more.norm())


def test_scenes_of_a_block_do_what_each_does_alone() -> None:
    solids = thrown(("plane", "box", "cylinder", "capsule"))
    kinds, params, state = place_bodies(solids, torch.zeros(SCENES, 1, 3, dtype=F64))
    still, zero = stationary_control(kinds, state), torch.zeros(1, 1, dtype=F64)
    motion = predict_free_motion(kinds, params, state, still, 0.0, zero, DT)
    together = contact_forces(BodyContact(), motion)
    for k in (0, 7, 10):
        one = tree.map(lambda x, k=k: x[k : k + 1], state)
        own = params if params.mass.dim() == 2 else tree.map(lambda x, k=k: x[k : k + 1] if x.dim() == 3 else x, params)
        alone = contact_forces(
            BodyContact(), predict_free_motion(kinds, own, one, stationary_control(kinds, one), 0.0, zero, DT)
        )
        for whole, part in zip(together, alone, strict=True):
            assert torch.equal(whole[k : k + 1], part)


def moving(pos: torch.Tensor, vel: tuple[float, float, float]) -> PredictedBodyMotion:
    """Two balls, the second one at rest at `pos`, (B, 3)."""
    balls = [RigidBody("sphere", 0.05, vel=vel, mass=1.0), RigidBody("sphere", 0.05, pos, mass=1.0)]
    kinds, params, state = place_bodies(balls, torch.zeros(len(pos), 1, 3, dtype=F64))
    return predict_free_motion(
        kinds, params, state, stationary_control(kinds, state), 0.0, torch.zeros(1, 1, dtype=F64), DT
    )


def test_pairs_are_skipped_only_where_they_cannot_meet() -> None:
    # 1 m/s over 2 ms closes gaps below 2 mm.
    gap = torch.linspace(0.7e-3, 10.2e-3, 20, dtype=F64)[:, None]
    force, _ = contact_forces(BodyContact(), moving(torch.cat([0.1 + gap, 0 * gap, 0 * gap], -1), (1.0, 0.0, 0.0)))
    assert torch.equal(force[:, 0, 0] < 0, gap[:, 0] < 1.0 * DT)
    assert torch.equal(force[:, 0, 0] == 0, gap[:, 0] > 1.0 * DT)


def test_what_is_not_a_number_stays_so_and_spoils_no_other_scene() -> None:
    motion = moving(torch.tensor([[0.0999, 0.0, 0.0]] * 3, dtype=F64), (1.0, 0.0, 0.0))
    change = motion.change.clone()
    change[1, 0, 1] = torch.nan
    force, _ = contact_forces(BodyContact(), dataclasses.replace(motion, change=change))
    assert bool(force[1].isnan().any())
    assert torch.equal(force[0], force[2])
    assert bool(force[0].isfinite().all())


def test_a_mesh_that_is_nowhere_is_nowhere_for_the_kernel_too(monkeypatch) -> None:
    kinds, params, state = place_bodies(thrown(("sphere", "mesh")), torch.zeros(SCENES, 1, 3, dtype=F64))
    pos = state.pos.clone()
    pos[3, 0, 1] = torch.nan
    state = tree.replace(state, pos=pos)
    motion = predict_free_motion(
        kinds, params, state, stationary_control(kinds, state), 0.0, torch.zeros(1, 1, dtype=F64), DT
    )
    found = contact_forces(BodyContact(), motion)[0]
    monkeypatch.setattr(contact_op, "ready", lambda *_: False)
    wanted = contact_forces(BodyContact(), motion)[0]
    good = torch.arange(SCENES) != 3
    assert bool(found[3].isnan().any()) and bool(found[good].isfinite().all())
    torch.testing.assert_close(found[good], wanted[good], rtol=1e-9, atol=1e-9)


def test_the_operator_tells_compilers_the_truth() -> None:
    state = place_bodies(thrown(("box", "cone")), torch.zeros(SCENES, 1, 3, dtype=F64))[2]
    members = torch.cat(
        [state.pos.mT, torch.rand(SCENES, 34, 2, generator=torch.Generator().manual_seed(0), dtype=F64)], 1
    )
    fields = [members.permute(1, 2, 0).contiguous().requires_grad_()]
    none = fields[0].new_zeros(2, 0)
    lists = [0] * 6, [0, 0], [2, 5], [0, 1], [0, 1]
    for hold in (False, True):
        torch.library.opcheck(
            torch.ops.torchdlo.body_pairs.default,
            (fields, none, none, *lists, 8, 8, hold, [0.2, 1e-3, 0.02, DT]),
            test_utils=("test_schema", "test_autograd_registration", "test_faketensor"),
        )


def test_second_derivatives_are_refused() -> None:
    motion = moving(torch.tensor([[0.0999, 0.0, 0.0]], dtype=F64), (1.0, 0.0, 0.0))
    change = motion.change.clone().requires_grad_()
    force, _ = contact_forces(BodyContact(), dataclasses.replace(motion, change=change))
    (once,) = torch.autograd.grad(force.square().sum(), change, create_graph=True)
    with pytest.raises(RuntimeError, match="no second derivative"):
        torch.autograd.grad(once.sum(), change)
