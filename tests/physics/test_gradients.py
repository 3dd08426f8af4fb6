"""Gradients of 200-step rollouts against central differences, number by number, and replay against plain autograd.

All numbers of a case are disturbed at once in the batch axis: five-point differences
(8 (f(h) - f(-h)) - (f(2h) - f(-2h))) / 12 h, error O(h^4), rounding 1e-16 |f| / h.
"""

from __future__ import annotations

import pytest
import torch
from helpers import F64, circle, rand, vec, wild

from torchdlo.physics import tree
from torchdlo.physics.effects import EFFECTS
from torchdlo.physics.effects.gripper_compliance import GripperCompliance
from torchdlo.physics.effects.loose_clamps import GripperDamping, GripperPlay
from torchdlo.physics.execution import replay
from torchdlo.scene import Control, Rope, make, rollout, stationary_control, step, stepper

STEPS = 200
POINTS = ((-2.0, 1 / 12), (-1.0, -8 / 12), (1.0, 8 / 12), (2.0, -1 / 12))

# Numbers by the path of their leaf in (params, state, controls).
MATERIAL = ["rods.material.bend", "rods.material.mass", "rods.rest.length"]
FRAMES = ["rods.material.twist", "rods.rest.curvature", "rods.rest.twist"]
VALUES = {
    "damping": {"rate": 2.0, "twist_rate": 20.0},
    "table": {"height": -0.25, "hardness": 60.0},
    "table_friction": {"mu": 0.4, "slip": 0.02, "height": -0.25, "hardness": 60.0},
    "air_drag": {"c_d": 5.0},
    "bending_damping": {"coefficient": 2e-4},
    "bending_plasticity": {"yield_curvature": 0.8, "rate": 3.0, "hardening": 0.3},
    "rest_curvature": {"curvature": (0.7, -0.5)},
    "varying_rest_curvature": {"modes": (0.2, 0.5, -0.3, 0.4, 0.1, -0.2, 0.3, 0.2, -0.4, 0.1)},
    "stiffness_profile": {"factors": tuple(0.1 * (-1) ** k * (1 + k % 5) for k in range(16))},
    "nonuniform_stiffness": {"position": 0.4, "width": 0.2, "factor": 0.5, "slope": 0.3},
    "point_mass": {"position": 0.53, "mass": 0.1},
    "wind": {"velocity": (2.0, -1.0, 1.5), "c_d": 4.0},
    "tilted_gravity": {"angles": (0.1, -0.15), "acceleration": (0.3, 0.2, -9.7)},
    "stretch": {"EA": 60.0},
    "internal_friction": {"moment": 2e-3, "kappa_c": 0.8},
    "stiffening_bending": {"c": 0.02},
    # Far from one, twist in balance snaps over in this throw and no derivative exists.
    "anisotropic_bending": {"ratio": 1.4, "direction": 0.4},
    "gripper_compliance": {"stiffness": 0.02},
    "link_chain": {"length": 0.03},
    "gripper_play": {"angle": 0.02, "stiffness": 0.02},
    "gripper_damping": {"stiffness": 0.02, "loss_time": 0.05},
    "buoyancy": {"density": 200.0, "acceleration": (0.3, 0.2, -9.7)},
    "fluid_forces": {"across": 1.2, "along": 0.1, "added_mass": 0.9, "density": 200.0},
}
INSTANCES = {
    "gripper_compliance": GripperCompliance(hinges=(1,)),
    "gripper_play": GripperPlay(hinges=(1,)),
    "gripper_damping": GripperDamping(hinges=(1,)),
}
CLAMPS = ["gripper_play", "gripper_damping"]
LAWS = ["internal_friction", "stiffening_bending", "anisotropic_bending", "gripper_compliance"]
CASES: dict[str, dict] = {
    "explicit": {
        "effects": ["bend", "gravity", "damping", "air_drag", "point_mass", "nonuniform_stiffness"],
        "dt": 1e-3,
    },
    "explicit extensible": {"effects": ["bend", "gravity", "damping"], "dt": 1e-3, "rope": {"stretch": 40.0}},
    "explicit forces": {
        "effects": ["stretch_force", "bend", "gravity"],
        "dt": 1e-3,
        "rope": {"stretch": 40.0},
        "constrained": False,
    },
    "explicit wind": {"effects": ["bend", "gravity", "tilted_gravity", "wind", "stretch"], "dt": 1e-3},
    "implicit wind": {"effects": ["bend", "tilted_gravity", "wind", "stretch"], "dt": 3e-3},
    "explicit laws": {"effects": ["bend_frame", "twist", "gravity", *LAWS], "dt": 1e-3, "twist": "dynamic"},
    "implicit laws": {"effects": ["bend_frame", "twist", "gravity", *LAWS], "dt": 2e-3, "twist": "quasistatic"},
    "implicit clamps": {"effects": ["bend_frame", "twist", "gravity", *CLAMPS], "dt": 2e-3, "twist": "quasistatic"},
    "explicit fluid": {"effects": ["bend", "gravity", "buoyancy", "fluid_forces"], "dt": 1e-3},
    "implicit fluid": {"effects": ["bend", "gravity", "buoyancy", "fluid_forces"], "dt": 3e-3},
    "explicit loop": {"effects": ["bend", "gravity"], "dt": 1e-3, "closed": True},
    "explicit dynamic": {
        "effects": ["bend_frame", "twist", "gravity", "damping", "bending_damping", "rest_curvature", "link_chain"],
        "dt": 1e-3,
        "twist": "dynamic",
    },
    "explicit quasistatic": {
        "effects": ["bend_frame", "twist", "gravity", "rest_curvature"],
        "dt": 1e-3,
        "twist": "quasistatic",
    },
    "explicit along": {
        "effects": ["bend_frame", "twist", "gravity", "varying_rest_curvature", "stiffness_profile"],
        "dt": 1e-3,
        "twist": "quasistatic",
    },
    "implicit": {
        "effects": ["bend", "gravity", "damping", "air_drag", "point_mass", "nonuniform_stiffness"],
        "dt": 3e-3,
    },
    "implicit extensible": {"effects": ["bend", "gravity"], "dt": 3e-3, "rope": {"stretch": 40.0}},
    "implicit table": {"effects": ["bend", "gravity", "damping", "table", "table_friction"], "dt": 3e-3},
    "explicit table": {"effects": ["bend", "gravity", "table", "table_friction"], "dt": 2e-3},
    "implicit dynamic": {
        "effects": ["bend_frame", "twist", "gravity", "damping", "bending_damping", "bending_plasticity"],
        "dt": 2e-3,
        "twist": "dynamic",
    },
    "implicit quasistatic": {
        "effects": ["bend_frame", "twist", "gravity", "bending_damping", "bending_plasticity"],
        "dt": 2e-3,
        "twist": "quasistatic",
    },
    "implicit loop quasistatic": {
        "effects": ["bend_frame", "twist", "gravity", "damping"],
        "dt": 1e-3,
        "twist": "quasistatic",
        "closed": True,
    },
}


def like(x: torch.Tensor) -> torch.Tensor:
    """Another shape with the same edge lengths."""
    edges = x[1:] - x[:-1]
    turned = edges + 0.2 * edges.norm(dim=-1, keepdim=True) * rand(*edges.shape, seed=7, low=-1)
    turned = turned / turned.norm(dim=-1, keepdim=True) * edges.norm(dim=-1, keepdim=True)
    return torch.cat([x[:1], x[:1] + torch.cumsum(turned, 0)])


def build(case: str):
    """Scene and (params, state, controls) of a case: a curved rope thrown about, one end led by hand."""
    c = dict(CASES[case])
    names, closed, extra = c.pop("effects"), c.pop("closed", False), c.pop("rope", {})
    n = 8
    if closed:
        x = circle(n, 0.25) + 0.03 * wild(n, 1)
    else:
        s = torch.linspace(0, 1, n, dtype=F64)
        x = torch.stack([0.7 * s, 0.15 * torch.sin(3 * s), 0.2 * s * s], -1)
    v = torch.linalg.cross(vec(1.0, 0.5, -1.0).expand_as(x), x - x[0])
    given = {"mass": 0.3, "bend": 2e-3, "radius": 0.02, "closed": closed} | extra
    if c.get("twist"):
        given |= {"bend2": 3e-3, "twist": 2e-3, "rest": "as_placed" if closed else like(x)}
    held = {"prescribed_vertices": (0,)} | ({"prescribed_edges": (0,)} if c.get("twist") else {})
    values = {k: w for k, w in VALUES.items() if k in names}
    made = [INSTANCES.get(name) or EFFECTS[name]() for name in names]
    scene, params, state = make([Rope(x, velocities=v, **given)], made, values, substeps=1, **held, **c)
    if c.get("twist") == "dynamic":
        first = 0.2 * rand(n, 1, seed=4, low=-1) * params.rods.rest.edge_mask
        first[0] = 0
        state = tree.replace(state, rods=tree.replace(state.rods, twist=first))
    start = stationary_control(scene, state)
    t = torch.linspace(0, 1, STEPS, dtype=F64)[:, None, None]
    pos = start.pos + 0.05 * torch.sin(6 * t) * vec(0.3, 1.0, 0.5)
    controls = Control(
        pos,
        start.director + torch.sin(4 * t) * vec(0.1, 0.4, 0.6)
        if held.get("prescribed_edges")
        else start.director.expand(STEPS, 0, 3),
    )
    return scene, (params, state, controls)


def number(trees, path: str):
    """The leaf at a path such as "rods.material.bend", "effects.damping.rate", "state.pos" or "controls.pos"."""
    params, state, controls = trees
    if path.startswith("effects."):
        _, effect, name = path.split(".")
        return params.effects[effect][name]
    at = {"state": state.rods, "controls": controls}.get(path.split(".")[0], params)
    for name in path.split(".") if at is params else path.split(".")[1:]:
        at = getattr(at, name)
    return at


def swapped(trees, leaves: dict[str, torch.Tensor]):
    """The trees with some leaves replaced."""
    _params, _state, _controls = trees
    places = {id(number(trees, path)): new for path, new in leaves.items()}
    assert len(places) == len(leaves)
    return tree.map(lambda leaf: places.get(id(leaf), leaf), trees)


def paths(case: str, scene, trees) -> list[str]:
    found = list(MATERIAL)
    if scene.twist != "none":
        found += FRAMES
        found += ["controls.director"]
    if scene.twist == "dynamic":
        found += ["rods.material.inertia", "state.twist", "state.twist_rate"]
    if "extensible" in case or "forces" in case:
        found += ["rods.material.stretch"]
    if any(e.name in ("air_drag", "table", "fluid_forces") for e in scene.effects):
        found += ["rods.material.radius"]
    found += [
        f"effects.{e}.{name}"
        for e, values in trees[0].effects.items()
        for name in values
        if (e, name) != ("damping", "twist_rate") or scene.twist == "dynamic"
    ]
    return [*found, "state.pos", "state.vel", "controls.pos"]


def direction(path: str, leaf: torch.Tensor, k: int) -> torch.Tensor:
    """By how much a leaf is moved, per unit of h: about its own size where it has one."""
    if path in UNSIZED:
        return rand(*leaf.shape, seed=50 + k, low=-0.5, high=0.5) * UNSIZED[path]
    return leaf.abs() * rand(*leaf.shape, seed=50 + k, low=0.5, high=1.5)


def objective(state, kept) -> torch.Tensor:
    """A number per scene that sees all of the last state and the way there."""
    r = state.rods

    def weigh(x, seed):
        return (rand(*x.shape[-2:], seed=seed, low=-1) * x).sum((-1, -2))

    return weigh(r.pos, 1) + 0.1 * weigh(r.vel, 2) + weigh(kept.mean(0), 3)


def seen(state):
    return state.rods.pos


UNSIZED = {
    "rods.rest.curvature": 1.0,
    "rods.rest.twist": 1.0,
    "state.pos": 0.01,
    "state.vel": 1.0,
    "state.twist": 1.0,
    "state.twist_rate": 100.0,
    "controls.pos": 3e-3,
    "controls.director": 0.1,
}
# Two steps of the differences, the better of which counts: at the larger one some vertices change over to contact or
# flow,
# at the smaller one small derivatives drown in rounding.
SIZES = (1e-4, 1e-6)


@pytest.mark.parametrize("case", CASES)
def test_gradients_of_a_rollout_equal_central_differences(case):
    scene, trees = build(case)
    names = paths(case, scene, trees)
    moves = {p: direction(p, number(trees, p), k) for k, p in enumerate(names)}
    leaves = {p: number(trees, p).detach().clone().requires_grad_() for p in names}
    found = objective(*rollout(lambda *a: step(scene, *a), *swapped(trees, leaves), keep=seen))
    gradients = dict(zip(names, torch.autograd.grad(found, list(leaves.values())), strict=True))

    weights = torch.tensor([w for _, w in POINTS], dtype=F64)
    shifts = torch.tensor([[f * size for f, _ in POINTS] for size in SIZES], dtype=F64).reshape(-1)
    batch = len(names) * len(shifts)
    spread = {}
    for k, p in enumerate(names):
        shift = torch.zeros(batch, dtype=F64)
        shift[k * len(shifts) : (k + 1) * len(shifts)] = shifts
        spread[p] = number(trees, p).unsqueeze(int(p.startswith("controls"))) + shift[:, None, None] * moves[
            p
        ].unsqueeze(int(p.startswith("controls")))
    with torch.no_grad():
        params, state, controls = swapped(trees, spread)
        state = tree.map(lambda x: x.expand(batch, *x.shape[-2:]), state)
        controls = tree.map(
            lambda x: x if x.dim() == 4 else x.unsqueeze(1).expand(STEPS, batch, *x.shape[1:]), controls
        )
        values = objective(*rollout(lambda *a: step(scene, *a), params, state, controls, keep=seen))
    slopes = (values.reshape(len(names), len(SIZES), len(POINTS)) * weights).sum(-1) / torch.tensor(SIZES, dtype=F64)
    wrong = {}
    for k, p in enumerate(names):
        got = float((gradients[p] * moves[p]).sum())
        errors = (slopes[k] / got - 1).abs()
        assert abs(got) > 1e-8, f"{p} does not matter here"
        if not float(errors.min()) <= 1e-5:
            wrong[p] = (got, *slopes[k].tolist())
    assert not wrong, wrong


def test_every_number_of_every_effect_is_checked_above():
    # Initial values not listed: `history`-like leaves. A new effect or number has to enter a case.
    checked = {path for case in CASES for path in paths(case, *build(case))}
    # Those of markers act on what a rollout gives, not within it.
    # What touches has tests of its own, in tests/coupling.
    acting = [cls for cls in EFFECTS.values() if cls.kind != "measurement" and not cls.is_contact]
    wanted = {f"effects.{cls.name}.{name}" for cls in acting for name in cls.params}
    assert wanted <= checked, wanted - checked


@pytest.mark.parametrize("case", ["explicit", "implicit dynamic", "implicit table"])
def test_replayed_gradients_equal_plain_autograd(case):
    # The same operations in the same order: equal to rounding, 1e-10 relative; segments that do not divide the steps,
    # nested.
    scene, trees = build(case)
    names = paths(case, scene, trees)
    trees = (*trees[:2], tree.map(lambda c: c[:50], trees[2]))

    def gradients(**how):
        leaves = {p: number(trees, p).detach().clone().requires_grad_() for p in names}
        last, kept = rollout(lambda *a: step(scene, *a), *swapped(trees, leaves), keep=seen, **how)
        return [kept.detach(), *torch.autograd.grad(objective(last, kept), list(leaves.values()))]

    plain = gradients()
    for how in ({"segment": 1}, {"segment": 7}, {"segment": 50}, {"segment": 80}, {"segment": 4, "nested": True}):
        for a, b in zip(plain, gradients(**how), strict=True):
            assert float((a - b).norm()) <= 1e-10 * float(a.norm()), how


@pytest.mark.compile
@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["explicit", "implicit"])
def test_gradients_through_compiled_steps_equal_eager_ones(integrator):
    # The same operations fused and reordered: rounding, grown through five steps, stays far below 1e-9 relative.
    n, dt = 6, {"explicit": 1e-3, "implicit": 5e-3}[integrator]
    x = wild(n, 1, rough=0.04)
    v = torch.linalg.cross(vec(1.0, 0.5, -1.0).expand_as(x), x - x[0])
    scene, params, state = make(
        [Rope(x, velocities=v, mass=0.3, bend=2e-3, radius=0.02)],
        [EFFECTS[name]() for name in ("bend", "gravity", "damping")],
        prescribed_vertices=(0,),
        integrator=integrator,
        dt=dt,
        substeps=1,
    )
    controls = tree.map(lambda c: c.expand(5, *c.shape), stationary_control(scene, state))
    trees = (params, state, controls)
    names = [*MATERIAL, "effects.gravity.acceleration", "effects.damping.rate", "state.pos", "state.vel"]
    found = {}
    for execution in ("eager", "compiled"):
        leaves = {p: number(trees, p).detach().clone().requires_grad_() for p in names}
        last, kept = rollout(stepper(scene, execution=execution), *swapped(trees, leaves), keep=seen)
        found[execution] = torch.autograd.grad(objective(last, kept), list(leaves.values()))
    for name, a, b in zip(names, found["eager"], found["compiled"], strict=True):
        assert float(a.norm()) > 0 and float((a - b).norm()) <= 1e-9 * float(a.norm()), name


def test_replay_keeps_inputs_where_offload_says():
    # On the CPU the flag changes nothing but must be accepted: same numbers.
    x = rand(5).requires_grad_()
    for offload in (True, False):
        y = replay.replay(lambda t: {"y": t["x"].sin()}, {"x": x}, offload=offload)["y"]
        (g,) = torch.autograd.grad(y.sum(), x)
        assert torch.equal(g, x.cos())
    y = replay.replay(lambda t, k: t["x"].sin() * k, {"x": x}, x, offload=(True, False))
    (g,) = torch.autograd.grad(y.sum(), x)
    assert torch.allclose(g, x * x.cos() + x.sin())


def test_replay_says_that_closed_over_tensors_get_no_gradient():
    # A captured tensor is a constant: its gradient is missing, and the documentation says so.
    x, hidden = rand(3).requires_grad_(), rand(3, seed=1).requires_grad_()
    y = replay.replay(lambda t: t * hidden, x)
    y.sum().backward()
    assert hidden.grad is None and x.grad is not None
    assert "captured ones get none" in replay.replay.__doc__


def test_replay_does_not_follow_outputs_that_nothing_depends_on():
    class Counted(torch.autograd.Function):
        """Hand on a tensor, and count how often its gradient is asked for."""

        asked = 0

        @staticmethod
        def forward(ctx, x):
            return x.clone()

        @staticmethod
        def backward(ctx, gradient):
            Counted.asked += 1
            return gradient

    x = rand(3).requires_grad_()
    used, unused = replay.replay(lambda t: (t.sin(), Counted.apply(t)), x)
    assert torch.equal(torch.autograd.grad(used.sum(), x, retain_graph=True)[0], x.cos()) and Counted.asked == 0
    assert torch.equal(torch.autograd.grad(unused.sum(), x)[0], torch.ones_like(x)) and Counted.asked == 1


def test_rollout_rejects_bad_lengths_and_segments():
    scene, (params, state, controls) = build("explicit")
    none = tree.map(lambda c: c[:0], controls)
    with pytest.raises(ValueError, match="0 steps"):
        rollout(lambda *a: step(scene, *a), params, state, none)
    with pytest.raises(ValueError, match="segment"):
        rollout(lambda *a: step(scene, *a), params, state, controls, segment=0)
