"""The kernel for contact of ropes with bodies does what the tensor operations do, and so does its derivative."""

from __future__ import annotations

import pytest
import torch
from touching import F64, line

from torchdlo import scene
from torchdlo.coupling import RodBody
from torchdlo.coupling.rod_body import rod_body_op as body_sweeps
from torchdlo.envs.assets.rigid_objects import pebble
from torchdlo.physics import tree
from torchdlo.physics.effects.elastic import Bend
from torchdlo.physics.effects.external import Damping, Gravity
from torchdlo.scene import RigidBody, Rope, make, stationary_control

pytestmark = pytest.mark.skipif(not body_sweeps.ready("cpu", F64), reason="there is no C++ compiler")

SOLIDS = {
    "plane": RigidBody("plane", pos=(0, 0, -0.0052), motion="fixed", mu_s=0.5, mu_k=0.3),
    "box": RigidBody("box", (0.03, 0.02, 0.02), (-0.02, 0.01, 0.023), (0.95, 0.2, 0.1, 0.15), (0.2, 0.1, -1.0),
                 (3.0, 1.0, -2.0), density=300.0, restitution=0.3),
    "sphere": RigidBody("sphere", 0.02, (0.06, 0.01, 0.024), vel=(0.0, 0.2, -1.0), density=300.0, restitution=0.2),
    "cone": RigidBody("cone", (0.03, 0.05), (-0.09, 0.02, 0.016), (0.95, 0.2, 0.5, 0.15), (0.0, 0.2, -1.0),
                      density=300.0),
    "ring": RigidBody("ring", (0.03, 0.005, 4.0), (0.11, 0.01, 0.012), (0.8, 0.4, -0.3, 0.15), (0.0, 0.2, -1.0),
                  density=300.0),
    "torus": RigidBody("torus", (0.03, 0.006), (0.02, 0.03, 0.018), (0.9, 0.3, 0.2, 0.15), (0.0, 0.2, -1.0),
                       density=300.0),
    "capsule": RigidBody("capsule", (0.01, 0.03), (-0.11, 0.03, 0.0125), (0.7, 0.7, 0.1, 0.0), motion="kinematic"),
    "cylinder": RigidBody("cylinder", (0.01, 0.03), (0.14, 0.03, 0.017), (0.7, 0.6, 0.1, 0.0), (0.0, 0.0, -1.0),
                      density=200.0),
    "mesh": pebble().solid((-0.06, -0.02, 0.033), (0.9, 0.3, 0.2, 0.15), vel=(0.0, 0.2, -1.0), density=300.0),
}  # fmt: skip
"""One body of each shape, on, above or between two ropes."""
CHOICES = [{}, {"friction": False, "sweeps": 2}, {"rounds": 2, "pieces": 3}]


def crossing(count: int, solids: list[RigidBody], **choices):
    """Two ropes in several scenes, a little higher in each, among bodies; the second one is a closed loop."""
    x = line(12, 0.3).expand(count, -1, -1).clone()
    x[..., 1] = 0.01 * torch.sin(9 * x[..., 0])
    x[..., 2] += 0.002 * torch.linspace(0, 1, count, dtype=F64)[:, None]
    a = 2 * torch.pi * torch.arange(16, dtype=F64) / 16
    loop = torch.stack([0.12 * a.cos(), 0.03 + 0.02 * a.sin(), 0 * a], -1).expand(count, -1, -1)
    ropes = [
        Rope(x, radius=0.005, density=1e3, bend=1e-4),
        Rope(loop, radius=0.005, density=900.0, closed=True, bend=1e-4),
    ]
    effects = [Gravity(), Bend(), Damping(), RodBody(**choices)]
    return make(ropes, effects, bodies=solids, dt=1e-3, substeps=2, prescribed_vertices=(0,), check=False)


def rolled(made, frames: int) -> tuple[torch.Tensor, list[torch.Tensor]]:
    """All that evolves after some frames, and the derivative of a sum of it by all numbers but masks."""
    choice, params, state = made
    leaves, build = tree.flatten((params.bodies, params.rods.material, state))
    # The kernel takes meshes as they are: with a derivative by their grids there are tensor operations only.
    meshes = [params.bodies.grid.data_ptr(), params.bodies.balls.data_ptr()]
    leaves = [x if x.data_ptr() in meshes else x.clone().requires_grad_() for x in leaves]
    learned = [x for x in leaves if x.requires_grad]
    bodies, material, now = build(leaves)
    params = tree.replace(params, bodies=bodies, rods=tree.replace(params.rods, material=material))
    control = stationary_control(choice, now)
    for _ in range(frames):
        now = scene.step(choice, params, now, control)
    moving = (now.rods.pos, now.rods.vel, now.bodies.pos, now.bodies.quat, now.bodies.vel, now.bodies.omega)
    found = torch.cat([x.flatten() for x in moving])
    weight = torch.sin(torch.arange(len(found), dtype=F64))
    gradient = torch.autograd.grad((weight * found).sum(), learned, allow_unused=True)
    return found.detach(), [torch.zeros_like(x) if g is None else g for x, g in zip(learned, gradient, strict=True)]


@pytest.mark.parametrize("choices", CHOICES, ids=["default", "smooth", "rounds"])
def test_the_kernel_and_tensor_operations_agree_with_their_gradients(choices, monkeypatch):
    # Eleven scenes fill one block of lanes at least, and a part of another. Rounding of 1e-16 grows with the stiffness
    # of contact, 1e4, and from step to step.
    solids = list(SOLIDS.values())
    made = crossing(11, solids, **choices)
    found, gradient = rolled(made, 3)
    monkeypatch.setattr(body_sweeps, "ready", lambda *_: False)
    wanted, expected = rolled(made, 3)
    assert float((found - wanted).norm()) < 1e-9 * float(wanted.norm())
    for one, other in zip(gradient, expected, strict=True):
        assert float((one - other).norm()) <= 1e-9 * float(other.norm())
    # All bodies but the plane, which has none, were felt: their sizes matter.
    sizes = expected[2].abs()
    assert bool((sizes[1:, 0] > 0).all()), dict(zip(SOLIDS, sizes[:, 0].tolist(), strict=True))


@pytest.mark.parametrize("kernel", [True, False])
def test_edges_flat_on_a_surface_have_the_derivative_of_their_nearest_point(kernel, monkeypatch):
    # It is the middle of each edge, and goes towards the end that is lowered.
    monkeypatch.setattr(body_sweeps, "ready", lambda *_, ready=body_sweeps.ready: kernel and ready(*_))
    x = line(4, 0.03)
    table = RigidBody("box", (0.1, 0.1, 0.02), (0.0, 0.0, -0.0249), motion="fixed", mu_s=0.5, mu_k=0.3)
    choice, params, state = make([Rope(x, radius=0.005, density=1e3)], [RodBody()], bodies=[table], dt=2e-4)
    control = stationary_control(choice, state)

    def turned(pos: torch.Tensor) -> torch.Tensor:
        now = tree.replace(state, rods=tree.replace(state.rods, pos=pos))
        vel = scene.step(choice, params, now, control).rods.vel
        return (vel[..., 2] * torch.tensor([1.0, -2.0, 3.0, 1.0], dtype=F64)).sum()

    pos = state.rods.pos.clone().requires_grad_()
    (slope,) = torch.autograd.grad(turned(pos), pos)
    for k in range(4):
        step = torch.zeros_like(state.rods.pos)
        step[..., k, 2] = 1e-9
        difference = float(turned(state.rods.pos + step) - turned(state.rods.pos - step)) / 2e-9
        assert float(slope[..., k, 2]) == pytest.approx(difference, rel=1e-3), k


def test_what_is_pushed_on_to_a_body_that_was_far_touches_it(monkeypatch):
    # The rope leaves the floor in which it starts, more than a diameter up and against a ceiling within a step.
    x = line(12, 0.03).expand(3, -1, -1).clone()
    x[..., 2] -= 0.001 * torch.arange(3, dtype=F64)[:, None]
    rope = Rope(
        x, radius=0.005, density=1e3, bend=1e-4, velocities=torch.full_like(x, 0.0) + torch.tensor([0.0, 0, 20])
    )
    floor = RigidBody("plane", pos=(0, 0, 0.01), motion="fixed", mu_s=0.5, mu_k=0.3)
    above = RigidBody("plane", pos=(0, 0, 0.0175), quat=(0, 1, 0, 0), motion="fixed", mu_s=0.5, mu_k=0.3)
    alone, made = (
        make([rope], [RodBody()], bodies=[floor, *more], dt=1e-3, substeps=1, check=False) for more in ([], [above])
    )
    moved = [scene.step(*each, stationary_control(each[0], each[2])).rods.vel for each in (alone, made)]
    assert bool(((moved[0] - moved[1]).norm(dim=-1).amax(-1) > 0.1).all()), "nothing was hit"
    found, gradient = rolled(made, 1)
    monkeypatch.setattr(body_sweeps, "ready", lambda *_: False)
    wanted, expected = rolled(made, 1)
    assert float((found - wanted).norm()) < 1e-9 * float(wanted.norm())
    one, other = (torch.cat([x.flatten() for x in parts]) for parts in (gradient, expected))
    assert float((one - other).norm()) <= 1e-9 * float(other.norm())


def test_bodies_in_another_order_do_the_same():
    # As many bodies and points, but for other bodies: what the kernel keeps from the first scene is of no use.
    ends = []
    for names in (("plane", "sphere"), ("sphere", "plane")):
        made = crossing(2, [SOLIDS[name] for name in names])
        with torch.no_grad():
            state = made[2]
            for _ in range(4):
                state = scene.step(*made[:2], state, stationary_control(made[0], state))
        ends.append((state.rods.pos, state.bodies.pos[:, names.index("sphere")]))
    for one, other in zip(*ends, strict=True):
        assert torch.allclose(one, other, rtol=0, atol=1e-12)


def test_blocks_of_scenes_do_what_each_scene_does_alone():
    # Points that are skipped where no scene of a block touches are those that exert nothing: only rounding differs.
    solids = list(SOLIDS.values())[:4]
    together, _ = rolled(crossing(11, solids), 4)
    parts = together.split([11 * n for n in (84, 84, 12, 16, 12, 12)])
    for k in (0, 7, 10):
        choice, params, state = crossing(11, solids)
        one = tree.map(lambda x, k=k: x[k : k + 1] if x.dim() == 3 else x, (params, state))
        alone, _ = rolled((choice, *one), 4)
        for part, own in zip(parts, alone.split([84, 84, 12, 16, 12, 12]), strict=True):
            assert float((part.reshape(11, -1)[k] - own).abs().max()) < 1e-11 * float(part.abs().max())


@pytest.mark.compile
def test_a_compiled_push_agrees_with_an_eager_one(monkeypatch):
    given, push = [], body_sweeps.contact_wrenches
    monkeypatch.setattr(
        body_sweeps, "contact_wrenches", lambda *words, **named: given.append((words, named)) or push(*words, **named)
    )
    choice, params, state = crossing(2, [SOLIDS["plane"], SOLIDS["box"]])
    scene.step(choice, params, state, stationary_control(choice, state))
    (view, motion, *rest), named = given[-1]

    def pushed(change: torch.Tensor) -> torch.Tensor:
        found = push(view, tree.replace(motion, change=change), *rest, **named)
        return torch.cat([found.force, found.body_force, found.body_torque], -2)

    found = []
    for way in (pushed, torch.compile(pushed, backend="aot_eager", fullgraph=True)):
        change = motion.change.clone().requires_grad_()
        force = way(change)
        (slope,) = torch.autograd.grad(force.square().sum(), change)
        found.append((force.detach(), slope))
    for eager, other in zip(*found, strict=True):
        # The same operations: rounding at most.
        assert float(eager.norm()) > 0 and float((eager - other).norm()) <= 1e-12 * float(eager.norm())
