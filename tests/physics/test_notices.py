"""What a scene leaves out is said once: bodies and ropes that nothing keeps apart, bending without stiffness."""

from __future__ import annotations

import logging

import pytest
from helpers import straight, vec

from torchdlo import notices
from torchdlo.coupling import RodBody, RodContact
from torchdlo.coupling.bodies.dynamics import RigidBody
from torchdlo.physics.effects.elastic import Bend
from torchdlo.physics.effects.external import Gravity
from torchdlo.physics.effects.table import Table
from torchdlo.scene import Rope, make

BALL = RigidBody("sphere", (0.02,), pos=(0.0, 0.0, -0.1), mass=0.1)


def rope(height: float = 0.0, bend: float = 1e-4) -> Rope:
    x = straight(11, 0.5)
    x[:, 2] = height
    return Rope(x, radius=0.003, density=1000.0, bend=bend)


def said(caplog, monkeypatch, *given, **choices) -> str:
    monkeypatch.setattr(notices, "_said", set())
    caplog.clear()
    with caplog.at_level(logging.WARNING, logger="torchdlo"):
        for _ in range(2):
            make(*given, **choices)
    return caplog.text


@pytest.mark.parametrize(
    ("ropes", "effects", "bodies", "sentence"),
    [
        ([rope()], [Bend(), Gravity()], [BALL], "ropes go through its bodies; add RodBody"),
        ([rope(), rope(0.1)], [Bend()], [], "ropes 0 and 1 go through each other; add RodContact"),
        ([rope(bend=0.0)], [Bend()], [], "Bend acts, but no rope has a stiffness"),
        ([rope()], [Gravity()], [], "has a bending stiffness, but nothing bends"),
    ],
)
def test_what_is_left_out_is_said_once(ropes, effects, bodies, sentence, caplog, monkeypatch):
    assert said(caplog, monkeypatch, ropes, effects, bodies=bodies).count(sentence) == 1


def test_scenes_that_leave_nothing_out_are_silent(caplog, monkeypatch):
    assert not said(caplog, monkeypatch, [rope(), rope(0.1)], [Bend(), RodContact(), RodBody()], bodies=[BALL])
    # Too far apart to meet soon, and a rope of no stiffness without bending.
    assert not said(caplog, monkeypatch, [rope(), rope(1.0)], [Bend()])
    assert not said(caplog, monkeypatch, [rope(bend=0.0)], [Gravity()])


@pytest.mark.parametrize(("hardness", "told"), [(500.0, True), (2000.0, False)])
def test_a_table_that_is_too_soft_for_a_thin_rope_is_told(hardness, told, caplog, monkeypatch) -> None:
    thin = Rope(straight(11, 0.5) + vec(0, 0, 1.0), radius=0.15e-3, density=1000.0)
    text = said(caplog, monkeypatch, [thin], [Gravity(), Table()], {"table": {"hardness": hardness}})
    assert ("rest 3.9e-05 m deep in the table, 26% of their radius" in text) == told
