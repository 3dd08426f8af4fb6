"""What a step is compiled of, and how often."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from torch.autograd import forward_ad

from torchdlo import scene
from torchdlo.coupling import RodBody, RodContact
from torchdlo.physics import tree
from torchdlo.physics.effects.elastic import Bend
from torchdlo.physics.effects.external import Gravity
from torchdlo.physics.execution import compiled


def hanging(scenes: int, held: tuple[int, ...] = (0, 1), **choices):
    """A rope of five vertices held at one end, with controls that move it."""
    x = torch.zeros(scenes, 5, 3, dtype=torch.float64)
    x[..., 0] = torch.linspace(0, 1, 5, dtype=torch.float64)
    made = scene.make([scene.Rope(x, mass=0.1, bend=1e-3)], [Gravity(), Bend()], prescribed_vertices=held, **choices)
    start = scene.stationary_control(made[0], made[2])
    shift = 1e-3 * torch.arange(1, 5, dtype=torch.float64).reshape(4, 1, 1, 1)
    return *made, tree.replace(tree.map(lambda c: c.expand(4, *c.shape).clone(), start), pos=start.pos + shift)


@pytest.fixture
def graphs(monkeypatch: pytest.MonkeyPatch):
    """Return a function that counts the graphs made so far; they are run without a code generator."""
    monkeypatch.setattr(compiled, "compile_graph", lambda graph, examples, options: graph.forward)
    torch._dynamo.reset()
    torch._dynamo.utils.counters.clear()
    return lambda: torch._dynamo.utils.counters["stats"]["unique_graphs"]


def test_forward_mode_through_contact_is_refused():
    choice, params, state, controls = hanging(1)
    touching = dataclasses.replace(choice, effects=(*choice.effects, RodContact()))
    with forward_ad.dual_level(), pytest.raises(NotImplementedError, match="reverse mode"):
        scene.step(touching, params, state, tree.map(lambda c: c[0], controls))


@pytest.mark.compile
def test_compiled_steps_leave_dual_numbers_their_tangents(graphs):
    choice, params, state, controls = hanging(1)
    control, run = tree.map(lambda c: c[0], controls), scene.stepper(choice, execution="compiled")
    moving = torch.ones_like(state.rods.vel)
    with torch.no_grad():
        for _ in range(2):  # the second call knows the code
            run(params, state, control)
        with forward_ad.dual_level():
            dual = tree.replace(state, rods=tree.replace(state.rods, vel=forward_ad.make_dual(state.rods.vel, moving)))
            found = forward_ad.unpack_dual(run(params, dual, control).rods.pos).tangent
            wanted = forward_ad.unpack_dual(scene.step(choice, params, dual, control).rods.pos).tangent
    assert float(found.abs().max()) > 0
    torch.testing.assert_close(found, wanted)


@pytest.mark.compile
@pytest.mark.slow
@pytest.mark.parametrize("choices", [{"substeps": 2}, {"integrator": "implicit", "substeps": 1}])
@pytest.mark.parametrize("learned", ["bend", "vel"])
def test_a_rollout_with_gradients_compiles_one_graph(graphs, choices, learned):
    made, params, state, controls = hanging(2, **choices)
    number = (params.rods.material.bend if learned == "bend" else state.rods.vel).clone().requires_grad_()
    if learned == "bend":
        params = tree.replace(
            params, rods=tree.replace(params.rods, material=tree.replace(params.rods.material, bend=number))
        )
    else:
        state = tree.replace(state, rods=tree.replace(state.rods, vel=number))
    found = {}
    for execution in ("eager", "compiled"):
        last, _ = scene.rollout(scene.stepper(made, execution=execution), params, state, controls)
        (found[execution],) = torch.autograd.grad(last.rods.pos.square().sum(), number)
    assert graphs() == 1
    assert float(found["eager"].abs().max()) > 0
    # The same operations in the same order: rounding of float64 over 4 steps at most.
    assert torch.allclose(found["compiled"], found["eager"], rtol=1e-12, atol=0)


@pytest.mark.compile
@pytest.mark.slow
@pytest.mark.parametrize(
    ("scenes", "held", "substeps"),
    # Strides of axes of size 1 are whatever an operation leaves them to be: one scene, or one held vertex.
    [(2, (0, 1), 1), (2, (0, 1), 3), (1, (0, 1), 2), (2, (0,), 2)],
)
def test_a_rollout_without_gradients_compiles_one_graph(graphs, scenes, held, substeps):
    made, params, state, controls = hanging(scenes, held, substeps=substeps)
    with torch.no_grad():
        last, _ = scene.rollout(scene.stepper(made), params, state, controls)
        expected, _ = scene.rollout(scene.stepper(made, execution="eager"), params, state, controls)
    assert graphs() == 1
    assert torch.allclose(last.rods.pos, expected.rods.pos, rtol=1e-12, atol=0)


@pytest.mark.compile
@pytest.mark.slow
def test_compiled_steps_tell_tensors_of_different_kinds_apart(graphs):
    made = hanging(2)[0]
    step = scene.stepper(made)
    for scenes, double in ((2, True), (3, True), (2, True), (3, False), (3, True), (3, False), (2, True)):
        _, *inputs, controls = hanging(scenes)
        inputs = [*inputs, tree.map(lambda c: c[0], controls)]
        if not double:
            inputs = tree.to(inputs, torch.float32)
        found, wanted = (run(*inputs).rods.pos for run in (step, scene.stepper(made, execution="eager")))
        assert found.shape == wanted.shape and found.dtype == wanted.dtype
        # The same operations in the same order: rounding at most.
        assert torch.allclose(found, wanted, rtol=1e-12 if double else 1e-6, atol=0)
    assert graphs() == 3


@pytest.mark.compile
@pytest.mark.slow
def test_replays_run_the_graph_of_rollouts_without_gradients(graphs):
    made, params, state, controls = hanging(2, substeps=2)
    step = scene.stepper(made)
    with torch.no_grad():
        scene.rollout(step, params, state, controls)
    moved = tree.replace(controls, pos=controls.pos.clone().requires_grad_())
    last, _ = scene.rollout(step, params, state, moved, segment=1)
    assert graphs() == 1, "what is replayed backwards is not recorded before"
    (slope,) = torch.autograd.grad(last.rods.pos.square().sum(), moved.pos)
    assert graphs() == 2 and float(slope.abs().max()) > 0


@pytest.mark.compile
@pytest.mark.slow
def test_a_rollout_with_bodies_and_gradients_compiles_one_graph_and_the_survey(graphs):
    # Bodies have no gradient at first, and one as soon as a rope has touched them.
    x = torch.zeros(1, 5, 3, dtype=torch.float64)
    x[..., 0] = torch.linspace(0, 0.1, 5, dtype=torch.float64)
    ball = scene.RigidBody("sphere", 0.02, (0.05, 0, -0.0245), density=500.0)
    rope = scene.Rope(x, mass=0.01, bend=1e-5, radius=0.005)
    made, params, state = scene.make(
        [rope], [Gravity(), RodBody()], prescribed_vertices=(0,), substeps=2, bodies=[ball]
    )
    control = scene.stationary_control(made, state)
    vel = state.rods.vel.clone().requires_grad_()
    state = tree.replace(state, rods=tree.replace(state.rods, vel=vel))
    step = scene.stepper(made)
    for _ in range(3):
        state = step(params, state, control)
    (gradient,) = torch.autograd.grad(state.bodies.pos.square().sum(), vel)
    assert float(gradient.abs().max()) > 0
    assert graphs() == 2


@pytest.mark.parametrize("execution", ["eager", "compiled"])
def test_controls_of_the_wrong_shape_are_refused(execution):
    made, params, state, controls = hanging(2, substeps=1)
    wrong = tree.map(lambda c: c[0, ..., :1, :], controls)
    with pytest.raises(ValueError, match="control: pos and director"):
        scene.stepper(made, execution=execution)(params, state, wrong)


@pytest.mark.parametrize("execution", ["eager", "recorded", "compiled"])
def test_swapped_arguments_are_refused(execution):
    made, params, state, controls = hanging(2, substeps=1)
    with pytest.raises(TypeError, match="it is given State, Params, Control; expected Params, State, Control"):
        scene.stepper(made, execution=execution)(state, params, tree.map(lambda c: c[0], controls))
