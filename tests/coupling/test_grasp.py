"""Ropes held by tools: what tools feel, closing and letting go during a rollout, and gradients."""

from __future__ import annotations

import pytest
import torch

from torchdlo.coupling.common.pose import Pose
from torchdlo.coupling.robot import attachment as grasp
from torchdlo.coupling.robot import inverse_kinematics
from torchdlo.coupling.robot import robot_kinematics as robot
from torchdlo.coupling.robot.attachment import Hands, carry_attachments, close_hands, tool_wrench
from torchdlo.physics import tree
from torchdlo.physics.effects import EFFECTS
from torchdlo.physics.linalg.rotation import rotate
from torchdlo.scene import Control, Rope, make, stationary_control, step, stepper

F64 = torch.float64
MASS, G = 0.2, 9.81
WAYS = [("explicit", "none"), ("explicit", "dynamic"), ("implicit", "none"), ("implicit", "quasistatic")]


def vec(*xyz: float) -> torch.Tensor:
    return torch.tensor(xyz, dtype=F64)


def rand(*shape: int, seed: int) -> torch.Tensor:
    """Numbers from -1 to 1."""
    return 2 * torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=F64) - 1


def line(n: int, towards: torch.Tensor, length: float = 0.4) -> torch.Tensor:
    return torch.linspace(0, length, n, dtype=F64)[:, None] * towards


def rope_scene(x, integrator="explicit", twist="none", values=None, **choices):
    names = ["gravity", "damping", *(["bend_frame", "twist"] if twist != "none" else ["bend"])]
    rope = Rope(x, mass=MASS, bend=2e-3, twist=3e-3, radius=0.01)
    substeps = 5 if integrator == "explicit" else 1
    choices = {"dt": 1e-3, "substeps": substeps, "integrator": integrator, "twist": twist} | choices
    return make([rope], [EFFECTS[n]() for n in names], {"damping": {"rate": 1.0}} | (values or {}), **choices)


def at(*xyz: float, quat=(1.0, 0.0, 0.0, 0.0)) -> Pose:
    return Pose(vec(*xyz)[None], vec(*quat)[None])


def turned(angle) -> torch.Tensor:
    """About x by an angle [rad], shape (..., 1)."""
    zero = torch.zeros_like(angle)
    return torch.cat([torch.cos(angle / 2), torch.sin(angle / 2), zero, zero], -1)


def control(hands: Hands, held: grasp.Grasp, tools: Pose) -> Control:
    return Control(*carry_attachments(hands, held, tools))


@pytest.mark.parametrize("acceleration", [0.0, 3.0])
@pytest.mark.parametrize(("integrator", "twist"), WAYS)
def test_a_tool_feels_weight_and_acceleration_of_a_hanging_rope(integrator, twist, acceleration):
    # A straight hanging rope moves as a whole: the force is m (g + a) from the first steps on.
    edges = (0,) if twist != "none" else ()
    scene, params, state = rope_scene(
        line(9, vec(0, 0, -1)),
        integrator,
        twist,
        {"damping": {"rate": 0.0}},
        prescribed_vertices=(0, 1),
        prescribed_edges=edges,
    )
    hands = Hands(1, (0, 0), (0,) * len(edges))
    held = close_hands(scene, hands, stationary_control(scene, state), at(0.05, 0.02, 0.1), torch.ones(1, 1, dtype=F64))
    with torch.no_grad():
        for k in range(20):
            t = (k + 1) * scene.dt
            tool = at(0.05, 0.02, 0.1 + 0.5 * acceleration * t * t)
            state = step(scene, params, state, control(hands, held, tool))
    force, torque = tool_wrench(scene, hands, state, tool)
    # Rounding of positions over the square of the substep, 1e-16 / 4e-8, times the mass of a vertex and their number.
    assert float(force[0, 2]) == pytest.approx(-MASS * (G + acceleration), rel=1e-6)
    # The lever of the weight about the tool's point.
    wanted = torch.linalg.cross(vec(-0.05, -0.02, 0), vec(0, 0, -MASS * (G + acceleration)))
    assert torch.allclose(torque[0], wanted, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize(("integrator", "twist"), WAYS)
def test_what_a_tool_feels_is_the_momentum_that_a_swinging_rope_gets(integrator, twist):
    # P' = F + m g for all vertices together, over each step; velocities stand half a substep before positions.
    edges = (0,) if twist != "none" else ()
    values = {"damping": {"rate": 0.0, "twist_rate": 0.0}}
    scene, params, state = rope_scene(
        line(7, vec(1, 0, 0)), integrator, twist, values, prescribed_vertices=(0, 1), prescribed_edges=edges
    )
    hands = Hands(1, (0, 0), (0,) * len(edges))
    held = close_hands(scene, hands, stationary_control(scene, state), at(0, 0, 0), torch.ones(1, 1, dtype=F64))
    mass = params.rods.material.mass
    with torch.no_grad():
        for k in range(20):
            before = (mass * state.rods.vel).sum(-2)
            tool = at(3e-4 * k, -1e-4 * k * k, 2e-4 * k)
            state = step(scene, params, state, control(hands, held, tool))
            force, _ = tool_wrench(scene, hands, state, tool)
            gained = ((mass * state.rods.vel).sum(-2) - before) / scene.dt - MASS * vec(0, 0, -G)
            if k > 0:  # the first step is half a substep shorter
                assert torch.allclose(-force[0], gained, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("twist", ["dynamic", "quasistatic"])
def test_a_tool_that_turns_about_the_rope_feels_its_twist(twist):
    # Both ends held, one turned by an angle: torque GJ angle / L', L' the length between the centres of held edges.
    n, length, angle = 8, 0.35, 0.8
    x = line(n, vec(1, 0, 0), length)
    # Without weight, which would bend the rope; a bent one resists otherwise.
    values = {"gravity": {"acceleration": (0.0, 0.0, 0.0)}, "damping": {"rate": 5.0, "twist_rate": 60.0}}
    scene, params, state = rope_scene(
        x, "implicit", twist, values, prescribed_vertices=(0, 1, n - 2, n - 1), prescribed_edges=(0, n - 2)
    )
    hands = Hands(2, (0, 0, 1, 1), (0, 1))
    ends = Pose(torch.stack([x[0], x[-1]]), vec(1, 0, 0, 0).expand(2, 4))
    held = close_hands(scene, hands, stationary_control(scene, state), ends, torch.ones(2, 1, dtype=F64))
    with torch.no_grad():
        for k in range(300):
            turn = torch.tensor([[0.0], [angle * min(1.0, (k + 1) / 100)]], dtype=F64)
            tools = Pose(ends.pos, turned(turn))
            state = step(scene, params, state, control(hands, held, tools))
    _, torque = tool_wrench(scene, hands, state, tools)
    span = length * (n - 2) / (n - 1)
    # The rope pulls each tool back towards the other. Twist waves decay as e^{-30 0.2}.
    wanted = 3e-3 * angle / span
    assert float(torque[1, 0]) == pytest.approx(-wanted, rel=5e-3)
    assert float(torque[0, 0]) == pytest.approx(wanted, rel=5e-3)


def test_parts_keep_their_place_in_the_tool():
    scene, params, state = rope_scene(
        line(8, vec(1, 0, 0)), "implicit", "quasistatic", prescribed_vertices=(2, 3), prescribed_edges=(2,)
    )
    hands = Hands(1, (0, 0), (0,))
    first = Pose(vec(0.1, 0.05, 0.2)[None], turned(torch.tensor([[0.4]], dtype=F64)))
    held = close_hands(scene, hands, stationary_control(scene, state), first, torch.ones(1, 1, dtype=F64))
    with torch.no_grad():
        for k in range(100):
            tool = Pose(first.pos + vec(0.0, 0.1, 0.05) * (k / 100), turned(torch.tensor([[0.4 + k / 100]], dtype=F64)))
            state = step(scene, params, state, control(hands, held, tool))
    again = close_hands(scene, hands, stationary_control(scene, state), tool, torch.ones(1, 1, dtype=F64))
    assert torch.allclose(again.offset, held.offset, atol=1e-12, rtol=0)
    assert torch.allclose(again.director, held.director, atol=1e-9)


def closing(k: int) -> torch.Tensor:
    """Three scenes: never held, closed from step 10 to 30, closed from step 20 on; shape (3, 1, 1)."""
    return torch.tensor([False, 10 <= k < 30, k >= 20], dtype=torch.float64).reshape(3, 1, 1)


def lifted(scene, params, state, closed, count=50):
    """Run with a tool that rises at 0.4 m/s, and as fast towards the end that is fixed; returns the states."""
    hands, held, seen = Hands(1, (0, -1)), None, []
    tool = Pose(vec(0.2, 0, 0)[None], vec(1, 0, 0, 0)[None])
    with torch.no_grad():
        for k in range(count):
            held = close_hands(scene, hands, stationary_control(scene, state), tool, closed(k), held)
            tool = Pose(tool.pos + vec(-4e-4, 0, 4e-4), tool.quat)
            state = step(scene, params, state, control(hands, held, tool))
            seen.append(state)
    return seen


@pytest.mark.parametrize("integrator", ["explicit", "implicit"])
def test_scenes_of_a_batch_are_grasped_and_released_each_at_its_own_time(integrator):
    # Not straight: a straight rope that is pushed together may bend to any side.
    x = line(9, vec(1, 0, 0))
    x = (x + 0.03 * torch.sin(8 * x[:, :1]) * vec(0, 0, 1)).expand(3, 9, 3)
    scene, params, state = rope_scene(x, integrator, prescribed_vertices=(4, 0))
    together = lifted(scene, params, state, closing)
    for k in range(3):
        alone = rope_scene(x[k], integrator, prescribed_vertices=(4, 0))
        seen = lifted(*alone, lambda step, k=k: closing(step)[k])
        for a, b in zip(together, seen, strict=True):
            assert torch.allclose(a.rods.pos[k], b.rods.pos, atol=1e-10, rtol=0)
    height = torch.stack([s.rods.pos[:, 4, 2] for s in together])
    rise = height[1:] - height[:-1]
    assert torch.allclose(rise[9:29, 1], torch.full((20,), 4e-4, dtype=F64), atol=1e-12, rtol=0)
    assert torch.allclose(rise[19:, 2], torch.full((30,), 4e-4, dtype=F64), atol=1e-12, rtol=0)
    # Let go, the vertex flies on with the tool's speed, less gravity and the pull of its neighbours.
    assert 0 < float(rise[29, 1]) < 4e-4
    # Rounding of positions, 1e-17, times 3e-2 kg over the square of the substep, 4e-8 s^2.
    assert float(together[-1].reaction.force[:2, 0].abs().max()) < 1e-9
    assert float(together[5].reaction.force[:, 0].abs().max()) < 1e-9


@pytest.mark.parametrize(("integrator", "twist"), [*WAYS, ("implicit", "dynamic"), ("explicit", "quasistatic")])
def test_open_hands_leave_the_rope_alone_and_closed_ones_are_plain_holds(integrator, twist):
    x = line(7, vec(1, 0, 0))
    edges = (3,) if twist != "none" else ()
    free = rope_scene(x, integrator, twist)
    scene, params, state = rope_scene(x, integrator, twist, prescribed_vertices=(3, 4), prescribed_edges=edges)
    one = {"vertices": torch.ones(2, 1, dtype=F64), "edges": torch.ones(len(edges), 1, dtype=F64)}
    states = {"none": free[2], "open": state, "closed": state, "held": state}
    with torch.no_grad():
        for k in range(10):
            still = stationary_control(scene, state)
            led = tree.replace(still, pos=still.pos + vec(0.0, 0.02, 0.01) * (k / 40))
            grips = {"open": tree.map(torch.zeros_like, one), "closed": one, "held": {}}
            for name, attachment_weight in grips.items():
                states[name] = step(scene, params, states[name], tree.replace(led, attachment_weight=attachment_weight))
            states["none"] = step(free[0], free[1], states["none"], stationary_control(free[0], states["none"]))
    # Rounding, grown by Newton's stopping.
    assert torch.allclose(states["open"].rods.pos, states["none"].rods.pos, atol=1e-9)
    assert torch.allclose(states["open"].rods.twist, states["none"].rods.twist, atol=1e-7)
    assert torch.allclose(states["closed"].rods.pos, states["held"].rods.pos, atol=1e-12, rtol=0)


def test_a_loose_grip_adds_inertia():
    # A vertex held by a share c moves by (1 - c) of the way that forces would take it: falling from rest beside a
    # tool at rest, a free mass falls g dt^2 / 2 in the first step of one substep.
    x = line(3, vec(1, 0, 0))
    scene, params, state = rope_scene(
        x, prescribed_vertices=(0, 1, 2), substeps=1, constrained=False, values={"damping": {"rate": 0.0}}
    )
    led = stationary_control(scene, state)
    for share in (0.0, 0.25, 1.0):
        attachment_weight = {"vertices": torch.full((3, 1), share, dtype=F64)}
        fallen = step(scene, params, state, tree.replace(led, attachment_weight=attachment_weight)).rods.pos[:, 2]
        assert torch.allclose(fallen, torch.full((3,), -(1 - share) * 0.5 * G * 1e-6, dtype=F64), rtol=1e-9)


@pytest.mark.parametrize(("integrator", "twist"), WAYS)
def test_the_gradient_of_a_grip_is_that_of_differences(integrator, twist):
    scene, params, state = rope_scene(line(6, vec(1, 0, 0)), integrator, twist, prescribed_vertices=(0, 3))
    led = stationary_control(scene, state)
    led = tree.replace(led, pos=led.pos + vec(0, 2e-4, 1e-4))
    weight = rand(6, 3, seed=1)

    def shape(share):
        now = state
        attachment_weight = {"vertices": torch.stack([torch.ones_like(share), share])[:, None]}
        for _ in range(5):
            now = step(scene, params, now, tree.replace(led, attachment_weight=attachment_weight))
        return (weight * now.rods.pos).sum()

    share = torch.tensor(0.6, dtype=F64, requires_grad=True)
    (found,) = torch.autograd.grad(shape(share), share)
    with torch.no_grad():
        wanted = (shape(share + 1e-5) - shape(share - 1e-5)) / 2e-5
    # Central differences: third derivatives times 1e-10, rounding 1e-16 / 1e-5 on top of values of about 1e-6.
    assert float(found) == pytest.approx(float(wanted), rel=1e-4)


@pytest.mark.slow
def test_gradients_through_inverse_kinematics_and_weld_are_those_of_differences():
    pytest.importorskip("pytorch_kinematics")
    arm = robot.panda()
    x = line(8, vec(1, 0, 0), 0.28) + vec(0.45, -0.1, 0.4)
    scene, params, state = rope_scene(x, "implicit", prescribed_vertices=(0, 1), dt=2e-3)
    hands, steps = Hands(1, (0, 0)), 200
    down = vec(0, 1, 0, 0)
    first = Pose(x[0], down)
    seed = inverse_kinematics.solve_ik(
        arm, first, 0.5 * (arm.lower + arm.upper), search=inverse_kinematics.IkSearch(steps=60, polish=8)
    )
    assert bool(seed.settled)
    held = close_hands(
        scene, hands, stationary_control(scene, state), tree.map(lambda q: q[None], first), torch.ones(1, 1, dtype=F64)
    )
    weight, t = rand(8, 3, seed=3), torch.linspace(0, 1, steps, dtype=F64)[:, None]
    many = inverse_kinematics.IkSearch(steps=20, polish=6)

    def shape(goal, bent):
        pos = first.pos + goal * (1 - torch.cos(torch.pi * t)) / 2
        found = inverse_kinematics.solve_ik(
            arm, Pose(pos, down.expand(steps, 4)), seed.joints.expand(steps, -1), search=many
        )
        assert bool(found.settled.all())
        tool = robot.tool_pose(arm, found.joints + bent * torch.sin(torch.pi * t))
        now = state
        for k in range(steps):
            now = step(scene, params, now, control(hands, held, Pose(tool.pos[k : k + 1], tool.quat[k : k + 1])))
        return (weight * now.rods.pos).sum()

    goal = vec(0.05, 0.08, 0.1).requires_grad_()
    bent = (0.02 * rand(8, seed=5) * vec(1, 1, 1, 1, 1, 1, 1, 0)).requires_grad_()
    found = torch.autograd.grad(shape(goal, bent), (goal, bent))
    for which, gradient in enumerate(found):
        way = rand(*gradient.shape, seed=9 + which)
        with torch.no_grad():
            shifted = [
                shape(*(leaf + size * way if k == which else leaf for k, leaf in enumerate((goal, bent))))
                for size in (1e-5, -1e-5)
            ]
        assert float((gradient * way).sum()) == pytest.approx(float(shifted[0] - shifted[1]) / 2e-5, rel=1e-4)


def test_wrong_hands_are_refused_with_what_was_expected():
    scene, _, state = rope_scene(line(5, vec(1, 0, 0)), prescribed_vertices=(0, 4))
    one = torch.ones(1, 1, dtype=F64)
    with pytest.raises(ValueError, match="1 vertices and 0 edges; the scene can hold 2 and 0"):
        close_hands(scene, Hands(1, (0,)), stationary_control(scene, state), at(0, 0, 0), one)
    with pytest.raises(ValueError, match=r"expected \(..., 2, 3\)"):
        close_hands(scene, Hands(2, (0, 1)), stationary_control(scene, state), at(0, 0, 0), one)
    with pytest.raises(ValueError, match="expected -1"):
        Hands(1, (0, 1))


def test_a_grip_of_wrong_shape_is_refused():
    scene, params, state = rope_scene(line(5, vec(1, 0, 0)), prescribed_vertices=(0, 4))
    for attachment_weight in ({"vertices": torch.ones(1, 1)}, {"vertex": torch.ones(2, 1)}):
        with pytest.raises(ValueError, match="expected 'vertices' of shape"):
            step(
                scene,
                params,
                state,
                tree.replace(stationary_control(scene, state), attachment_weight=attachment_weight),
            )


def test_tools_turn_what_they_hold():
    scene, _, state = rope_scene(line(5, vec(1, 0, 0)), prescribed_vertices=(1,))
    hands = Hands(1, (0,))
    held = close_hands(scene, hands, stationary_control(scene, state), at(0.1, -0.2, 0.0), torch.ones(1, 1, dtype=F64))
    quat = turned(torch.tensor([[0.5 * torch.pi]], dtype=F64))
    pos, _, _ = carry_attachments(hands, held, Pose(vec(0.1, -0.2, 0.0)[None], quat))
    assert torch.allclose(pos, vec(0.1, -0.2, 0.2)[None])
    assert torch.allclose(rotate(quat, vec(0, 1, 0)[None]), vec(0, 0, 1)[None])


@pytest.mark.slow
@pytest.mark.compile
def test_a_compiled_step_with_grips_is_the_same():
    x = line(6, vec(1, 0, 0)).expand(2, 6, 3)
    scene, params, state = rope_scene(x, prescribed_vertices=(0, 3), substeps=1)
    led = stationary_control(scene, state)
    share = torch.tensor([[1.0, 0.0], [1.0, 1.0]], dtype=F64)[..., None]
    led = tree.replace(led, pos=led.pos + vec(0, 0, 1e-3), attachment_weight={"vertices": share})
    with torch.no_grad():
        fast, slow = stepper(scene)(params, state, led), step(scene, params, state, led)
    assert torch.allclose(fast.rods.pos, slow.rods.pos, atol=1e-12, rtol=0)
    # Forces are differences of positions over the square of the step.
    assert torch.allclose(fast.reaction.force, slow.reaction.force, rtol=1e-6, atol=1e-6)
