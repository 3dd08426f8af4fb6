"""Malformed scenes are refused with a sentence that names what is wrong."""

from __future__ import annotations

import math
import re

import pytest
import torch
from helpers import circle, effects, run, straight, vec

from torchdlo.coupling import RodContact, SelfContact
from torchdlo.physics import tree
from torchdlo.physics.effects.external import Gravity
from torchdlo.physics.rod.topology import Topology
from torchdlo.scene import (
    Control,
    Params,
    RigidBody,
    Rope,
    Scene,
    finite,
    limits,
    make,
    rollout,
    stationary_control,
    step,
)

X = straight(6)
GOOD = {"mass": 0.1, "bend": 1e-3, "twist": 1e-3}


def rope(**changes) -> list[Rope]:
    return [Rope(**({"positions": X} | GOOD | changes))]


def nan_at(k: int) -> torch.Tensor:
    x = X.clone()
    x[k, 1] = math.nan
    return x


def equal(a: int, b: int) -> torch.Tensor:
    x = X.clone()
    x[a] = x[b]
    return x


BAD = {
    "no rope": (lambda: make([], []), "rope"),
    "positions are a list": (lambda: make(rope(positions=X.tolist()), []), "rope 0: positions"),
    "positions in two dimensions": (lambda: make(rope(positions=X[:, :2]), []), "rope 0: positions"),
    "positions of integers": (lambda: make(rope(positions=X.long()), []), "rope 0: positions"),
    "positions without vertices": (lambda: make(rope(positions=X[0]), []), "rope 0: positions"),
    "two vertices": (lambda: make(rope(positions=X[:2]), []), "rope 0: 2 vertices"),
    "NaN position": (lambda: make(rope(positions=nan_at(2)), []), "rope 0: positions contain NaN"),
    "neighbours coincide": (lambda: make(rope(positions=equal(3, 2)), []), "vertices 2 and 3"),
    "ends of a loop coincide": (lambda: make(rope(positions=equal(5, 0), closed=True), []), "vertices 5 and 0"),
    "second rope is wrong": (lambda: make([*rope(), Rope(nan_at(1), mass=0.1)], []), "rope 1"),
    "neither mass nor density": (lambda: make(rope(mass=None), []), "mass"),
    "mass and density": (lambda: make(rope(density=1000.0), []), "mass"),
    "mass 0": (lambda: make(rope(mass=0.0), []), "mass"),
    "negative mass": (lambda: make(rope(mass=-1.0), []), "mass"),
    "NaN mass": (lambda: make(rope(mass=math.nan), []), "mass"),
    "mass tensor with a zero": (lambda: make(rope(mass=torch.tensor([1.0, 0, 1, 1, 1, 1], dtype=X.dtype)), []), "mass"),
    "radius 0": (lambda: make(rope(radius=0.0), []), "radius"),
    "negative stiffness": (lambda: make(rope(bend=-1e-3), []), "bend"),
    "NaN stiffness": (lambda: make(rope(bend=math.nan), []), "bend"),
    "infinite bending stiffness": (lambda: make(rope(bend=math.inf), []), "bend"),
    "infinite mass": (lambda: make(rope(mass=math.inf), []), "mass"),
    "stretch 0": (lambda: make(rope(stretch=0.0), []), "stretch"),
    "stiffness of the wrong length": (lambda: make(rope(bend=torch.ones(4, dtype=X.dtype)), []), "bend"),
    "youngs and bend": (lambda: make(rope(youngs=1e7), []), "bend|youngs"),
    "unknown rest": (lambda: make(rope(rest="curly"), []), "rest"),
    "rest of the wrong length": (lambda: make(rope(rest=straight(4)), []), "rest"),
    "rest with NaN": (lambda: make(rope(rest=nan_at(2)), []), "rest"),
    "rest longer than the placed rope": (lambda: make(rope(rest=2 * X), effects("bend"), dt=1e-4), "rest|length"),
    "velocities of the wrong shape": (lambda: make(rope(velocities=X[:4]), []), "velocit"),
    "NaN velocities": (lambda: make(rope(velocities=nan_at(0)), []), "velocit"),
    "director along the edge": (lambda: make(rope(director=vec(1, 0, 0)), []), "director"),
    "ropes of different batch": (
        lambda: make([*rope(positions=X.expand(2, 6, 3)), *rope(positions=X.expand(3, 6, 3))], []),
        "batch",
    ),
    "unknown integrator": (lambda: make(rope(), [], integrator="magic"), "integrator"),
    "unknown twist": (lambda: make(rope(), [], twist="some"), "twist"),
    "dt 0": (lambda: make(rope(), [], dt=0.0), "dt"),
    "dt NaN": (lambda: make(rope(), [], dt=math.nan), "dt"),
    "a rope that is not in a list": (lambda: make(rope()[0], []), "a Rope is given; expected a list of ropes"),
    "positions in place of a rope": (lambda: make([X], []), "a Tensor is at place 0"),
    "the class of an effect": (lambda: make(rope(), [Gravity]), "class Gravity"),
    "the name of an effect": (lambda: make(rope(), ["gravity"]), "a str is at place 0 .* effects"),
    "effects by name": (lambda: make(rope(), "gravity"), "a str is given; expected a list of effects"),
    "a word for a mass": (lambda: make(rope(mass="heavy"), []), "mass is 'heavy'"),
    "a director of four numbers": (lambda: make(rope(director=torch.ones(4)), []), "director is .4,."),
    "a rest director along the rope": (lambda: make(rope(rest_director=X[1] - X[0]), []), "rest_director points along"),
    "a word for dt": (lambda: make(rope(), [], dt="1ms"), "dt is '1ms'"),
    "no substep": (lambda: make(rope(), [], substeps=0), "substeps"),
    "half a substep": (lambda: make(rope(), [], substeps=2.5), "substeps"),
    "too many newton steps": (
        lambda: make(rope(), [], constraint_iterations=12, integrator="implicit"),
        "at most 8: with more, straight ropes",
    ),
    "no newton step": (lambda: make(rope(), [], constraint_iterations=0), "constraint_iterations"),
    "small gamma": (lambda: make(rope(), [], implicit_weight=0.1), "implicit_weight"),
    "negative ahead": (lambda: make(rope(), [], numerical_damping=-0.5), "numerical_damping"),
    "held vertex outside": (lambda: make(rope(), [], prescribed_vertices=(6,)), "prescribed_vertices"),
    "held vertex negative": (lambda: make(rope(), [], prescribed_vertices=(-1,)), "prescribed_vertices"),
    "held vertex twice": (lambda: make(rope(), [], prescribed_vertices=(1, 1)), "prescribed_vertices"),
    "held edge outside": (lambda: make(rope(), [], prescribed_edges=(9,)), "prescribed_edges"),
    "held edge is the seam of an open rope": (
        lambda: make(rope(), effects("bend", "twist"), prescribed_edges=(5,), twist="quasistatic"),
        "prescribed_edges",
    ),
    "held edge without twist": (lambda: make(rope(), effects("bend"), prescribed_edges=(0,)), "prescribed_edges"),
    "effect twice": (lambda: make(rope(), effects("gravity", "gravity")), "gravity"),
    "both laws of bending": (lambda: make(rope(), effects("bend", "bend_frame")), "bend"),
    "implicit without lengths": (lambda: make(rope(), [], integrator="implicit", constrained=False), "constrained"),
    "small loop, implicit": (
        lambda: make(rope(positions=circle(4), closed=True), [], integrator="implicit"),
        "at least 5",
    ),
    "quasistatic without twist": (lambda: make(rope(), effects("bend"), twist="quasistatic"), "Twist"),
    "isotropic law for two stiffnesses": (lambda: make(rope(bend2=2e-3), effects("bend")), "bend"),
    "law without rest shape for a curved rest": (
        lambda: make(rope(positions=circle(6), closed=True, rest="as_placed"), effects("bend")),
        "rest|BendFrame",
    ),
    "plasticity without frames": (lambda: make(rope(), effects("bend", "bending_plasticity")), "BendFrame"),
    "values of an absent effect": (lambda: make(rope(), effects("gravity"), {"damping": {"rate": 1.0}}), "damping"),
    "unknown number": (lambda: make(rope(), effects("damping"), {"damping": {"speed": 1.0}}), "speed"),
    "number of the wrong size": (
        lambda: make(rope(), effects("gravity"), {"gravity": {"acceleration": (0.0, 1.0)}}),
        "gravity.acceleration",
    ),
    "NaN number": (lambda: make(rope(), effects("damping"), {"damping": {"rate": math.nan}}), "damping.rate"),
    "negative number": (lambda: make(rope(), effects("damping"), {"damping": {"rate": -1.0}}), "damping.rate is -1"),
    "number along the vertices": (
        lambda: make(rope(), effects("damping"), {"damping": {"rate": torch.ones(6, 1)}}),
        "damping.rate is .6, 1.",
    ),
    "stiffness along the rope or per scene": (
        lambda: make(rope(positions=X.expand(6, 6, 3), bend=torch.ones(6)), effects("bend")),
        "along the rope or per scene",
    ),
    "half precision": (lambda: make(rope(positions=X.half()), []), "float16"),
    "controls of two lengths": (lambda: uneven_controls(), "number of steps"),
    "stretch left to nothing": (
        lambda: make(rope(stretch=50.0), effects("bend"), constrained=False, dt=1e-4),
        "stretch",
    ),
    "infinite stretch as a force": (
        lambda: make(rope(), effects("bend", "stretch_force"), constrained=False, dt=1e-4),
        "stretch",
    ),
    "counts and flags differ": (lambda: Topology((3, 4), (True,)), "closed flags"),
    "empty topology": (lambda: Topology((), ()), "counts"),
    "controls of the wrong number": (lambda: wrong_control(2), "control"),
}


def wrong_control(count: int):
    scene, params, state = make(rope(), effects("bend"), prescribed_vertices=(0,), dt=1e-3)
    return step(scene, params, state, Control(X[:count], X[:0]))


def uneven_controls():
    scene, params, state = make(
        rope(), effects("bend", "twist"), prescribed_vertices=(0,), prescribed_edges=(0,), twist="dynamic"
    )
    control = stationary_control(scene, state)
    several = Control(control.pos.expand(5, *control.pos.shape), control.director.expand(7, *control.director.shape))
    return rollout(scene, params, state, several)


def test_a_scene_with_lists_of_held_parts_is_hashable():
    scene, _, _ = make(rope(), effects("bend"), prescribed_vertices=[0, 1], dt=1e-3)
    assert hash(scene) and scene.prescribed_vertices == (0, 1)


@pytest.mark.parametrize("case", BAD)
def test_a_malformed_scene_is_refused_by_name(case):
    build, words = BAD[case]
    with pytest.raises(ValueError, match=words):
        build()


DAMPED = {"bending_damping": {"coefficient": 1e-3}}
UNSTABLE = {
    "bending": (effects("bend"), {"dt": 0.5, "substeps": 1}, {}),
    "stretching": (
        effects("bend", "stretch_force"),
        {"dt": 0.02, "substeps": 1, "constrained": False},
        {"stretch": 1e3},
    ),
    "twisting": (effects("bend", "twist"), {"dt": 0.02, "substeps": 1, "twist": "dynamic"}, {"twist": 1e-2}),
    "table contact": (effects("bend", "table"), {"dt": 0.008, "substeps": 1}, {}),
    "bending damping": (effects("bend", "bending_damping"), {"dt": 0.05, "substeps": 1, "values": DAMPED}, {}),
}


@pytest.mark.parametrize("term", UNSTABLE)
def test_an_unstable_step_names_its_limit_and_a_cure_that_works(term):
    names, choices, changes = UNSTABLE[term]
    bow = X + 0.02 * torch.sin(3 * X[:, :1]) * vec(0, 0, 1) + vec(0, 0, 0.004)
    with pytest.raises(ValueError, match=term) as caught:
        make(rope(positions=bow, **changes), names, **choices)
    need = int(re.search(r"substeps=(\d+)", str(caught.value)).group(1))
    scene, params, state = make(rope(positions=bow, rest="straight", **changes), names, **choices | {"substeps": need})
    state, _ = run(scene, params, state, 300)
    assert bool(finite(state)) and float(state.rods.pos.abs().max()) < 2
    # ... and it is not far from the limit.
    bound = limits(scene, params)[term]
    assert 0.6 * bound < choices["dt"] / need < bound


@pytest.mark.parametrize("term", ["bending", "stretching", "twisting"])
def test_limits_are_those_of_the_discrete_rod(term):
    # Beyond twice the limit a small disturbance grows by orders of magnitude; at 95 % it stays small.
    names, choices, changes = UNSTABLE[term]
    scene, params, _state = make(rope(**changes), names, **choices | {"substeps": 1000})
    bound = limits(scene, params)[term]
    for factor, stays in ((0.95, True), (1.5, False)):
        good, p, s = make(rope(**changes), names, **choices | {"substeps": 1000})
        fast = Scene(good.topology, good.effects, **choices | {"dt": factor * bound, "substeps": 1})
        r = s.rods
        kick = 1e-6 * torch.tensor([1.0, -1.0] * 3, dtype=X.dtype)[:, None]
        s = tree.replace(s, rods=tree.replace(r, pos=r.pos + kick * vec(1.0, 0, 1.0), twist=r.twist + kick))
        s, _ = run(fast, p, s, 60, stationary_control(fast, s))
        size = max(
            float((s.rods.pos - r.pos).abs().nan_to_num(1e9).max()), float(s.rods.twist.abs().nan_to_num(1e9).max())
        )
        assert (size < 1e-3) is stays, (factor, size)


def test_parameters_are_checked_against_the_step_when_asked():
    scene, params, _ = make(rope(), effects("bend"), dt=1e-3)
    assert isinstance(params, Params) and limits(scene, params)["bending"] > 1e-3 / 5


def test_controls_and_states_of_other_scenes_are_refused_in_a_sentence():
    scene, params, state = make(rope(), effects("gravity"), prescribed_vertices=(0,))
    control = stationary_control(scene, state)

    def given(pos) -> Control:
        return tree.replace(control, pos=pos)

    with pytest.raises(ValueError, match=re.escape("control: pos and director are ((1, 2), (0, 3))")):
        step(scene, params, state, given(control.pos[:, :2]))
    with pytest.raises(ValueError, match=re.escape("batches (3,), the state is of ()")):
        step(scene, params, state, given(control.pos.expand(3, 1, 3)))
    with pytest.raises(TypeError, match="control: pos and director are ndarray, Tensor"):
        step(scene, params, state, given(control.pos.numpy()))
    other = make(rope(positions=straight(4)), effects("gravity"))[2]
    with pytest.raises(ValueError, match="state: it has 4 vertices and no bodies, the scene 6 and none"):
        step(scene, params, other, control)
    many = make(rope(positions=X.expand(2, -1, 3)), effects("gravity"), prescribed_vertices=(0,))
    pos = stationary_control(scene, many[2]).pos
    assert step(*many, given(pos)).rods.pos.shape == step(*many, control).rods.pos.shape == (2, 6, 3)
    with pytest.raises(ValueError, match=re.escape("batches (3,), the state is of (2,)")):
        step(*many, given(pos[:1].expand(3, 1, 3)))
    grip = {"vertices": torch.ones(3, 1, 1, dtype=torch.float64)}
    with pytest.raises(ValueError, match=re.escape("batches () and (3,), the state is of ()")):
        step(scene, params, state, tree.replace(control, attachment_weight=grip))


def test_two_effects_that_keep_ropes_apart_are_not_solved_together():
    both = [*effects("gravity"), RodContact(), SelfContact()]
    make(rope(), both, dt=1e-3)
    with pytest.raises(ValueError, match="leave self_contact out"):
        make(rope(), both, dt=1e-3, contact="coupled")


def test_targets_of_bodies_of_more_scenes_are_refused():
    box = RigidBody("box", (0.05, 0.05, 0.05), pos=(0, 0, -1), motion="kinematic")
    scene, params, state = make(rope(), effects("gravity"), bodies=[box])
    control = stationary_control(scene, state)
    wide = tree.replace(control, bodies=tree.map(lambda x: x.expand(3, *x.shape[-2:]), control.bodies))
    with pytest.raises(ValueError, match=re.escape("(3,), the state is of ()")):
        step(scene, params, state, wide)
