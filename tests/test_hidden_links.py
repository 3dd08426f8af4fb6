"""The chains of links that hide effects, which MuJoCo simulates: against closed forms and exact rods."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="chains of links are simulated by MuJoCo: pip install mujoco")

FOLDER = Path(__file__).parents[1] / "experiments" / "hidden_effects"
sys.path[:0] = [str(FOLDER), str(FOLDER.parent)]

import cases  # noqa: E402
import links  # noqa: E402
import make  # noqa: E402
import scenes  # noqa: E402
from laws import GRAVITY, Laws  # noqa: E402
from simulate import Rope  # noqa: E402

STIFF = Rope(0.3, 0.004, 0.02, 1.0, 0.8, 0.0)
LOAD = GRAVITY * STIFF.mass / STIFF.length
COUNT = 12
HINGES = STIFF.length * np.arange(COUNT) / COUNT


def level(times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """One clamp at the origin, along x."""
    turn = np.zeros((4, 1, 1, len(times)))
    turn[0] = 1.0
    return np.zeros((3, 1, 1, len(times))), turn


def end(numbers: dict[str, float], gravity: float = GRAVITY) -> np.ndarray:
    """The end of the chain at rest in one clamp, (3,)."""
    chain, dt = links.Chain(COUNT, 0.0, STIFF.length, False), 4e-3
    rope = links.Links(STIFF, chain, Laws([numbers], gravity=gravity), dt)
    links.settle(rope, level, dt)
    track = rope.run(level, np.arange(2) * dt, 1)
    x, q = (a[0, :, 0][:, None] for a in (track.x, track.q))
    return chain.points(x, q, np.array([STIFF.length]), np.zeros(3))[:, 0, 0]


def sag(*, bending: float = 1.0, clamp: float = np.inf, bead: float = 0.0, at: float = 0.0) -> float:
    """How far the end of a chain sags [m]: every hinge turns by moment times length of a link over stiffness."""
    moment = LOAD * (STIFF.length - HINGES) ** 2 / 2 + bead * GRAVITY * np.maximum(at - HINGES, 0.0)
    turn = moment * STIFF.length / COUNT / bending
    turn[0] += moment[0] / clamp
    return float(turn @ (STIFF.length - HINGES))


@pytest.mark.parametrize(
    ("numbers", "expected"),
    [
        ({}, sag()),
        ({"point_mass.mass": 0.01, "point_mass.position": 0.21}, sag(bead=0.01, at=0.21)),
        ({"anisotropic_bending.ratio": 4.0, "anisotropic_bending.direction": 0.5 * np.pi}, sag(bending=2.0)),
        ({"gripper_compliance.stiffness": 5.0}, sag(clamp=5.0)),
        ({"nonuniform_stiffness.factor": np.log(3.0), "nonuniform_stiffness.width": 1e3}, sag(bending=3.0)),
    ],
)
def test_a_chain_sags_as_the_sum_of_its_hinges(numbers: dict[str, float], expected: float) -> None:
    found = end(numbers)
    assert -found[2] == pytest.approx(expected, rel=2e-3)
    assert abs(found[1]) < 1e-6


def test_a_naturally_curved_chain_is_a_polygon() -> None:
    found = end({"rest_curvature.curvature.0": 4.0}, gravity=0.0)
    angle = 4.0 * STIFF.length / COUNT * (1 + np.arange(COUNT))
    expected = STIFF.length / COUNT * np.array([np.cos(angle).sum(), np.sin(angle).sum(), 0.0])
    assert np.linalg.norm(found - expected) < 1e-5


def test_a_chain_of_many_links_in_two_clamps_moves_as_an_exact_rod() -> None:
    scene = replace(scenes.draw(7, grippers=2), duration=0.2)
    rod = scenes.seen(scene, ["train_1"], [{}], *scenes.run(scene, ["train_1"], [{}], *cases.COARSE))[0]
    errors = []
    for count in (12, 24):
        track, chain = links.run(scene, ["train_1"], [{}], count, 1e-3)
        chained = scenes.seen(scene, ["train_1"], [{}], track, chain)[0]
        assert np.allclose(chained[:, :, ~scene.gripped][0, 0], rod[:, :, ~scene.gripped][0, 0], atol=0.03)
        errors.append(np.sqrt(np.mean((chained - rod) ** 2)))
        # The weld holds the last link where the second clamp is.
        held = chain.points(*scenes._at(track, 0, scene.times), scene.arclength, np.zeros(3))
        assert np.abs(held[:, :, -2:].transpose(1, 2, 0) - rod[0][:, -2:]).max() < 1e-4
    assert errors[0] < 0.02
    assert 1.5 < errors[0] / errors[1] < 3.0  # hinges beside clamps are wrong by half a link


def test_a_step_that_is_too_long_is_taken_in_shorter_ones(monkeypatch) -> None:
    scene, tried = replace(scenes.draw(7, grippers=1), duration=0.05), []

    def fails_at_first(scene, trials, given, count, dt, variant):
        tried.append(dt)
        if len(tried) < 3:
            raise links.Diverged("too long")
        return "done"

    monkeypatch.setattr(links, "_run", fails_at_first)
    assert links.run(scene, ["train_0"], [{}], 10, 1e-3) == "done"
    assert tried == [1e-3, 5e-4, 2.5e-4]
    monkeypatch.setattr(links, "_run", lambda *_: (_ for _ in ()).throw(links.Diverged("too long")))
    with pytest.raises(links.Diverged, match="too long"):
        links.run(scene, ["train_0"], [{}], 10, 1e-3)


def test_a_simulation_that_fails_says_so(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    chain = links.Chain(COUNT, 0.0, STIFF.length, False)
    rope = links.Links(STIFF, chain, Laws([{}]), 1e-3)
    rope.data.qvel[rope.hinges] = np.nan
    with pytest.raises(links.Diverged, match=r"failed at 0\.0\d\d s; use a smaller dt"):
        rope.run(level, np.arange(20) * 1e-3, 1)
    assert not list(tmp_path.iterdir())


def test_trials_of_a_chain_have_the_same_laws() -> None:
    with pytest.raises(ValueError, match="expected the same numbers for all"):
        links.run(scenes.draw(7), ["train_0", "train_1"], [{}, {"time_delay.delay": 0.1}], 10, 1e-3)


def test_chains_hide_what_rods_do_in_recordings_of_their_own() -> None:
    chains, others = cases.subset("links"), [*cases.all_cases(), *cases.subset("fresh")]
    assert {e for c in chains if c.kind == "single" for e in c.effects} == {
        e for c in others if c.kind == "single" for e in c.effects
    }
    assert {c.kind for c in chains} == {"single", "null", "compound", "outside"}
    assert not {make.identity(c, "s") for c in chains} & {make.identity(c, "s") for c in others}
    for scene in (c.scene for c in chains):  # clamps hold whole links
        free = (scene.free_end - scene.grip) / scene.grip
        assert free == pytest.approx(round(free)) and scene.arclength[1] == scene.grip
    rods = [replace(c, simulator="") for c in chains]
    assert not {make.identity(c, "s") for c in chains} & {make.identity(c, "s") for c in rods}
