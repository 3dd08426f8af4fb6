"""The benchmark of hidden effects: its simulator against closed forms, its recordings, and its scorer."""

from __future__ import annotations

import ast
import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import solve_bvp, solve_ivp

FOLDER = Path(__file__).parents[1] / "experiments" / "hidden_effects"
sys.path[:0] = [str(FOLDER), str(FOLDER.parent)]

import cases  # noqa: E402
import laws  # noqa: E402
import make  # noqa: E402
import scenes  # noqa: E402
import score  # noqa: E402
import table  # noqa: E402
from laws import GRAVITY, Laws  # noqa: E402
from simulate import Mesh, Rope, Simulator, at_rest, settle  # noqa: E402
from vectors import exponential, logarithm, multiply, rotate  # noqa: E402

from torchdlo.cli.app import main as torchdlo  # noqa: E402

BEAM = Rope(0.3, 0.004, 0.02, 0.01, 0.008, 0.0)
DENSITY = BEAM.mass / BEAM.length


def level(times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """One clamp at the origin, along x."""
    turn = np.zeros((4, 1, 1, len(times)))
    turn[0] = 1.0
    return np.zeros((3, 1, 1, len(times))), turn


def downwards(times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """One clamp at the origin, pointing down."""
    return np.zeros((3, 1, 1, len(times))), exponential(np.array([0, np.pi / 2, 0]).reshape(3, 1, 1, 1) + 0 * times)


def rest(rope: Rope, numbers: dict[str, float], elements: int = 40, gravity: float = GRAVITY, poses=level):
    """The rope at rest in one clamp, (3, N)."""
    mesh = Mesh(elements, 0.0, rope.length, False)
    return settle(rope, mesh, Laws([numbers], gravity=gravity), poses, duration=3.0).x[:, 0]


def test_the_generator_does_not_import_what_it_judges() -> None:
    for file in FOLDER.glob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [str(node.module)] if isinstance(node, ast.ImportFrom) else []
            assert not any(n.split(".")[0] == "torchdlo" for n in names), f"{file.name} imports {names}"


def test_a_rotation_is_its_logarithms_exponential() -> None:
    rng = np.random.default_rng(0)
    v = rng.uniform(-1.7, 1.7, (3, 50))
    assert np.allclose(logarithm(exponential(v)), v, atol=1e-12)
    p, x = exponential(rng.uniform(-1, 1, (3, 50))), rng.standard_normal((3, 50))
    assert np.allclose(rotate(multiply(p, exponential(v)), x), rotate(p, rotate(exponential(v), x)), atol=1e-12)


def test_a_heavy_cantilever_bends_as_the_elastica() -> None:
    load = DENSITY * GRAVITY

    def gradient(s, y):  # y = angle below the horizontal, its rate; B angle'' = -load (L - s) cos(angle)
        return np.array([y[1], -load * (BEAM.length - s) / soft.bending * np.cos(y[0])])

    soft = replace(BEAM, bending=2e-3)
    s = np.linspace(0, soft.length, 400)
    found = solve_bvp(gradient, lambda a, b: np.array([a[0], b[1]]), s, np.zeros((2, 400)) + 0.5, tol=1e-8)
    angle = found.sol(s)[0]
    tip = np.array([np.trapezoid(np.cos(angle), s), -np.trapezoid(np.sin(angle), s)])
    assert abs(tip[1]) > 0.3 * soft.length  # far from small deflections
    errors = [np.linalg.norm(rest(soft, {}, n)[[0, 2], -1] - tip) for n in (20, 40)]
    assert errors[1] < 3e-4
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.25)  # second order


def sag(bending: float) -> float:
    """How far a cantilever's end sags under its weight by bending and by shear [m]."""
    load = DENSITY * GRAVITY
    return load * BEAM.length**4 / (8 * bending) + load * BEAM.length**2 / (2 * BEAM.axial)


STIFF = replace(BEAM, bending=1.0, twisting=0.8)
"""Sags by 0.7 mm: the linear theory errs by a relative (sag / length)^2 = 5e-6, the mesh by about (1 / 40)^2 = 6e-4."""


@pytest.mark.parametrize(
    ("numbers", "expected"),
    [
        ({}, sag(1.0)),
        ({"point_mass.mass": 0.01, "point_mass.position": 0.3}, sag(1.0) + 0.01 * GRAVITY * (0.3**3 / 3 + 0.3 / 2e4)),
        ({"anisotropic_bending.ratio": 4.0, "anisotropic_bending.direction": 0.5 * np.pi}, sag(2.0)),
        ({"anisotropic_bending.ratio": 4.0, "anisotropic_bending.direction": 0.0}, sag(0.5)),
        ({"gripper_compliance.stiffness": 5.0}, sag(1.0) + DENSITY * GRAVITY * 0.3**2 / 2 / 5.0 * 0.3),
        ({"nonuniform_stiffness.factor": np.log(3.0), "nonuniform_stiffness.width": 1e3}, sag(3.0)),
    ],
)
def test_a_stiff_cantilever_sags_as_in_the_textbook(numbers: dict[str, float], expected: float) -> None:
    end = rest(STIFF, numbers)[:, -1]
    assert -end[2] == pytest.approx(expected, rel=2e-3)
    assert abs(end[1]) < 1e-6


def test_a_rope_with_natural_curvature_is_an_arc_towards_the_side_that_the_numbers_say() -> None:
    end = rest(BEAM, {"rest_curvature.curvature.0": 4.0, "rest_curvature.curvature.1": 3.0}, gravity=0.0)[:, -1]
    radius, angle = 0.2, 5.0 * BEAM.length
    side = radius * (1 - np.cos(angle))
    expected = [radius * np.sin(angle), 0.8 * side, 0.6 * side]
    assert np.linalg.norm(end - expected) < 3e-4


def test_a_hanging_rope_stretches_by_its_weight() -> None:
    end = rest(BEAM, {"stretch.EA": 20.0}, poses=downwards)[:, -1]
    assert -end[2] - BEAM.length == pytest.approx(DENSITY * GRAVITY * BEAM.length**2 / 2 / 20.0, rel=5e-3)


@pytest.mark.parametrize("c_d", [0.0, 20.0])
def test_a_stiff_rope_in_a_loose_clamp_is_a_pendulum(c_d: float) -> None:
    rope = replace(STIFF, length=0.5, mass=0.02, damping=0.4)
    mesh, first, dt = Mesh(60, 0.0, rope.length, False), 0.6, 1e-3
    # Masses at nodes have 1 / (2 n^2) too much inertia; with 60 elements that is 0.1 mm of this swing.
    inertia = rope.mass * rope.length**2 / 3 + 0.25 * rope.mass * rope.radius**2
    drag = laws.AIR * c_d * rope.radius * rope.length**4 / 4

    def swing(_, y):
        weight = -0.5 * rope.mass * GRAVITY * rope.length * np.sin(y[0])
        return [y[1], (weight - drag * abs(y[1]) * y[1]) / inertia - rope.damping * y[1]]

    angle = solve_ivp(swing, (0, 1), [first, 0.0], rtol=1e-9, atol=1e-10).y[0, -1]
    numbers = {"air_drag.c_d": c_d, "gripper_compliance.stiffness": 1e-9}
    down = exponential(np.array([0, np.pi / 2 - first, 0]).reshape(3, 1, 1) + np.zeros(mesh.elements + 1))
    along = rotate(down, np.eye(3)[:, :1, None])
    state, rate = at_rest(along * mesh.arclength, down), swing(0, [first, 0.0])[1]
    state.dv[:3] = -rate * np.array([along[2], along[1], -along[0]]) * mesh.arclength
    state.dv[4] = -rate
    state.a = state.dv.copy()
    simulator = Simulator(rope, mesh, Laws([numbers]), downwards, dt)
    track, _ = simulator.run(state, np.arange(1001) * dt)
    expected = rope.length * np.array([np.sin(angle), 0.0, -np.cos(angle)])
    assert np.linalg.norm(track.x[-1, :, 0, -1] - expected) < 3e-4


def test_a_struck_cantilever_rings_and_fades_as_in_the_textbook() -> None:
    # First mode: 3.516 sqrt(B / density) / L^2; a moment c times the rate of curvature damps it by c/B omega^2 / 2.
    beam, ratio = replace(BEAM, bending=0.05), 1e-3
    omega = 1.8751041**2 * np.sqrt(beam.bending / DENSITY) / beam.length**2
    numbers = {"bending_damping.coefficient": ratio * beam.bending}
    mesh, dt = Mesh(30, 0.0, beam.length, False), 5e-4
    start = settle(beam, mesh, Laws([{}]), level, duration=3.0)
    simulator = Simulator(beam, mesh, Laws([numbers], gravity=0.0), level, dt)
    track, _ = simulator.run(start, np.arange(1400) * dt)
    z, time = track.x[:, 2, 0, -1], track.time
    peaks = np.flatnonzero((z[1:-1] > z[:-2]) & (z[1:-1] > z[2:])) + 1
    peaks = peaks[1:]  # the first one has higher modes
    period = (time[peaks[-1]] - time[peaks[0]]) / (len(peaks) - 1)
    assert period == pytest.approx(2 * np.pi / omega, rel=0.01)
    decay = np.log(z[peaks[0]] / z[peaks[-1]]) / (time[peaks[-1]] - time[peaks[0]])
    assert decay == pytest.approx(0.5 * ratio * omega**2, rel=0.03)


def test_friction_and_flow_follow_their_laws() -> None:
    friction = Laws([{"internal_friction.moment": 1.0, "internal_friction.kappa_c": 2.0}])
    flow = Laws([{"bending_plasticity.yield_curvature": 1.0, "bending_plasticity.rate": 5.0}])
    kappa, past, steps = np.zeros((3, 1, 1)), {}, 2000
    for k in range(steps + 1):
        kappa[1] = 4.0 * k / steps
        past = laws.update_memory(friction, kappa.copy(), past, 1e-3)
    # z = 1 - exp(-kappa / kappa_c), to the first order of the step.
    assert past["dahl"][0, 0, 0] == pytest.approx(1 - np.exp(-2.0), abs=2.0 / steps)
    past = {}
    for _ in range(200):
        past = laws.update_memory(flow, kappa, past, 1e-3)
    assert past["plastic"][0, 0, 0] == pytest.approx(3.0 * (1 - np.exp(-1.0)), rel=1e-9)


def test_a_recording_is_converged() -> None:
    scene = replace(scenes.draw(2), duration=0.5)

    def free(elements: int, dt: float) -> np.ndarray:
        found = scenes.run(scene, ["train_1"], [{}], elements, dt)
        return scenes.seen(scene, ["train_1"], [{}], *found)[0][0][:, ~scene.gripped]

    fine, coarse, finest = (free(n, dt) for n, dt in (cases.FINE, cases.COARSE, (140, 7e-4)))
    errors = [np.linalg.norm(m - finest, axis=-1).max() for m in (fine, coarse)]
    assert errors[0] < 3e-4
    assert errors[1] > 2 * errors[0]


def test_late_and_displaced_markers_are_seen_as_such() -> None:
    scene = replace(scenes.draw(2, grippers=2), duration=0.2, rate=100)
    numbers = [{}, {"time_delay.delay": 0.02}, {"marker_offset.offset.0": 0.004, "marker_offset.offset.1": 0.003}]
    found = scenes.run(scene, ["train_1"] * 3, numbers, *cases.COARSE)
    plain, late, beside = scenes.seen(scene, ["train_1"] * 3, numbers, *found)[0]
    free = ~scene.gripped
    # The three rows are the same rope, each to the tolerance of the steps.
    assert np.allclose(late[2:, free], plain[:-2, free], atol=1e-5)
    assert np.allclose(late[:, ~free], plain[:, ~free]) and np.allclose(beside[:, ~free], plain[:, ~free])
    assert np.allclose(np.linalg.norm(beside - plain, axis=-1)[:, free], 0.005, atol=1e-5)


KINDS = [
    cases.Case("null", (), 0.0, 1),
    cases.Case("null", (), 0.0, 2, "coloured"),
    cases.Case("null", (), 0.0, 3, "table"),
    cases.Case("single", ("table_friction",), 10.0, 4),
    cases.Case("compound", ("marker_offset", "time_delay"), 10.0, 5),
    cases.Case("outside", ("wall",), 10.0, 6),
    cases.Case("outside", ("backlash",), 10.0, 7),
]
HIDDEN = {
    "table_friction.mu": 0.4,
    "marker_offset.offset.0": 0.004,
    "time_delay.delay": 0.02,
    "wall.distance": 0.05,
    "wall.normal.0": 0.0,
    "wall.normal.1": 1.0,
    "backlash.angle": 0.1,
}


@pytest.mark.parametrize("case", KINDS, ids=lambda c: c.name)
def test_a_recording_is_as_the_format_says_and_tells_nothing(case: cases.Case, tmp_path: Path, capsys) -> None:
    numbers = {k: v for k, v in HIDDEN.items() if k.split(".")[0] in case.effects}
    scene = replace(case.scene, duration=0.3)
    folder = tmp_path / make.identity(case, "test")
    make.write(folder, scene, make.record(case, scene, numbers, (20, 4e-3), "test"))
    with pytest.raises(SystemExit) as end:
        torchdlo(["check", str(folder)])
    assert not end.value.code, capsys.readouterr().err
    told = json.loads((folder / "rope.json").read_text())
    assert set(told) == {"length", "radius", "mass", "gravity", "table_height", "marker_noise_std"}
    assert re.fullmatch("r[0-9a-f]{8}", folder.name)
    answer = make.answer(case, scene, numbers, 1e-3)
    assert answer["answer"] == ([] if case.kind == "outside" else list(case.effects))
    assert json.loads(json.dumps(answer))["ratio"] == pytest.approx(1e-3 / scene.noise)


def test_doses_are_found_between_those_that_were_tried() -> None:
    assert cases._between([0.25, 1.0, 4.0], [1e-3, 4e-3, 16e-3], 8e-3, 100.0) == pytest.approx(2.0, rel=1e-4)
    assert cases._between([0.25, 1.0, 4.0], [1e-3, 4e-3, 16e-3], 64e-3, 100.0) == pytest.approx(16.0, rel=1e-3)
    assert cases._between([0.25, 1.0, 4.0], [1e-3, 4e-3, 16e-3], 1.0, 10.0) == 10.0


def test_every_effect_has_a_dose_and_every_case_a_recording_of_its_own() -> None:
    sealed = cases.subset("sealed")
    assert len(sealed) == 60 and len({c.seed for c in sealed}) == 60
    assert {len({c.simulator for c in sealed if c.effects == e}) for e in {c.effects for c in sealed[:16]}} == {2}
    every = [*cases.all_cases(), *cases.subset("fresh"), *sealed]
    assert len({c.seed for c in cases.subset("fresh")} - {c.seed for c in cases.all_cases()}) == 27
    assert len({make.identity(c, "s") for c in every}) == len(every)
    for case in every:
        x = np.zeros((2, 3, 2, 5))
        for effect in case.effects:
            numbers = cases.dose(effect, case.scene, 5.0, x).numbers(1.0)
            assert numbers and Laws([numbers]).on(effect)
    assert {c.kind for c in cases.subset("ci")} == {"single", "null", "outside"} and len(cases.subset("ci")) == 6


def found(verdict: str, *effects: tuple[str, dict[str, float], list[str]], after: float = 5e-4) -> dict:
    """Findings as `torchdlo diagnose` writes them."""
    numbers = [
        {k: {"value": v, "low": 0.9 * v, "high": 1.1 * v, "unit": "1"} for k, v in e[1].items()} for e in effects
    ]
    listed = [
        {"name": e[0], "parameters": n, "share_of_gap": 0.9, "indistinguishable_from": e[2]}
        for e, n in zip(effects, numbers, strict=True)
    ]
    gap = {"test_rmse_before_m": 5e-3, "test_rmse_after_m": after, "noise_floor_m": 5e-4, "per_trial": []}
    return {"verdict": verdict, "effects": listed, "gap": gap, "seconds": 60.0}


def truth(kind: str, effects: dict[str, dict[str, float]], ratio: float = 10.0) -> dict:
    """An answer as make.py writes it."""
    case = cases.Case(kind, tuple(effects), ratio, 1)
    numbers = {f"{e}.{k}": v for e, n in effects.items() for k, v in n.items()}
    answer = make.answer(case, replace(scenes.draw(1), noise=5e-4), numbers, ratio * 5e-4)
    return answer


def test_the_scorer_tells_right_from_wrong() -> None:
    drag, delay = {"air_drag": {"c_d": 2.0}}, {"time_delay": {"delay": 0.02}}
    both, late = drag | delay, ("time_delay", {"delay": 0.02}, [])
    given = {
        "right": (truth("single", drag), found("effects", ("air_drag", {"c_d": 2.1}, []))),
        "wrong": (truth("single", drag, 3.0), found("effects", ("bending_damping", {"coefficient": 1e-5}, []))),
        "set": (truth("single", drag), found("effects", ("bending_damping", {}, ["air_drag"]))),
        "unknown": (truth("single", drag), found("unknown", after=5e-3)),
        "failed": (truth("single", drag), None),
        "force": (truth("single", delay), found("effects", ("air_drag", {"c_d": 9.0}, []))),
        "clean": (truth("null", {}), found("none")),
        "alarm": (truth("null", {}), found("effects", ("air_drag", {"c_d": 0.1}, []))),
        "outside": (truth("outside", {"wall": {"distance": 0.1}}), found("partial", ("wind", {}, []), after=3e-3)),
        "fooled": (truth("outside", {"wall": {"distance": 0.1}}), found("effects", ("wind", {}, []))),
        "two": (
            truth("compound", both),
            found("effects", ("air_drag", {"c_d": 4.0}, []), late),
        ),
        "one": (truth("compound", both), found("effects", ("air_drag", {"c_d": 2.0}, []))),
    }
    rows = [table.judge(name, *pair) for name, pair in given.items()]
    assert [r["recording"] for r in rows if r["right"]] == ["right", "clean", "outside", "two"]
    rates, figures = (table.summary(rows)[k] for k in ("rates", "figures"))
    assert rates["single, named first"] == {"yes": 1, "of": 6}
    assert rates["single, in the named set"] == {"yes": 2, "of": 6}
    assert rates["nothing missing, an effect named"] == {"yes": 1, "of": 2}
    assert rates["outside the library, called explained"] == {"yes": 1, "of": 2}
    assert rates["two at once, both named"] == {"yes": 1, "of": 2}
    assert rates["measurement called something else"] == {"yes": 1, "of": 3}
    assert rates["single, gap about 3 times the noise"] == {"yes": 0, "of": 1}
    # Errors: 5 % (its range holds the truth), 100 % (it does not), 0 and 0.
    assert rates["ranges that hold the truth"] == {"yes": 3, "of": 4}
    assert figures["error of numbers, median"] == pytest.approx(0.025)
    assert figures["error of numbers, 90 %"] == pytest.approx(1.0)
    assert figures["gap above the noise closed, median"] == pytest.approx(1.0)
    assert rates["failed"] == {"yes": 1, "of": 12}
    page = table.markdown(rows, "Test")
    assert "| air_drag | 1 |" in page and "| (wall) |" in page and "| wrong |" in page


def test_without_the_right_effect_a_diagnosis_should_not_claim_to_explain_everything() -> None:
    drag = truth("single", {"air_drag": {"c_d": 2.0}})
    verdicts = ("unknown", "partial", "none", "effects")
    named = [("wind", {"c_d": 1.0, "velocity.0": 0.0}, [])]
    given = [found(v, *(named if v in ("partial", "effects") else [])) for v in verdicts]
    rows = [table.judge(v, table.without_it(drag), f) for v, f in zip(verdicts, given, strict=True)]
    assert [r["right"] for r in rows] == [True, True, False, False] and rows[0]["truth"] == ["air_drag"]
    rates = table.summary(rows)["rates"]
    assert rates["taken out of the library, abstained"] == {"yes": 2, "of": 4}
    assert rates["taken out of the library, called explained"] == {"yes": 1, "of": 4}
    assert "single, named first" not in rates and "| (air_drag) |" in table.markdown(rows, "Test")


def test_what_is_hidden_is_left_out_of_the_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, kind in (("ra", "single"), ("rb", "null")):
        (tmp_path / "recordings" / name).mkdir(parents=True)
        (tmp_path / "recordings" / name / "rope.json").write_text("{}")
        answer = truth(kind, {"air_drag": {"c_d": 2.0}} if kind == "single" else {})
        (tmp_path / f"{name}.json").write_text(json.dumps(answer))
    ran = []

    def fake(command: list[str], **_: object) -> object:
        ran.append(command)
        Path(command[command.index("-o") + 1]).mkdir(parents=True)
        (Path(command[command.index("-o") + 1]) / "findings.json").write_text(json.dumps(found("unknown")))
        return SimpleNamespace(returncode=0)

    monkeypatch.setattr(score.subprocess, "run", fake)
    words = ["--recordings", str(tmp_path / "recordings"), "--answers", str(tmp_path), "--out", str(tmp_path / "out")]
    monkeypatch.setattr(sys, "argv", ["score.py", *words, "--subset", "there", "--removed"])
    score.main()
    assert len(ran) == 1 and ran[0][-2:] == ["--exclude-effect", "air_drag"]
    rates = json.loads((tmp_path / "out" / "removed" / "score.json").read_text())["rates"]
    assert rates["taken out of the library, abstained"] == {"yes": 1, "of": 1}


def test_numbers_with_directions_are_compared_as_vectors() -> None:
    wind = {"wind": {"c_d": 1.2, "velocity.0": 3.0, "velocity.1": 4.0}}
    # Half the coefficient and more speed: the same push.
    fast = 2.0**0.5
    same = found("effects", ("wind", {"c_d": 0.6, "velocity.0": 3 * fast, "velocity.1": 4 * fast}, []))
    assert table.judge("a", truth("single", wind), same)["errors"]["wind"] == pytest.approx(0.0, abs=1e-12)
    flat = {"anisotropic_bending": {"ratio": 2.0, "direction": 0.2}}
    turned = found("effects", ("anisotropic_bending", {"ratio": 0.5, "direction": 0.2 + np.pi / 2}, []))
    error = table.judge("a", truth("single", flat), turned)["errors"]["anisotropic_bending"]
    assert error == pytest.approx(0.0, abs=1e-12)


def test_the_scripts_work_together(tmp_path: Path) -> None:
    places = ["--answers", str(tmp_path / "answers")]

    def call(script: str, *words: str) -> str:
        command = [sys.executable, str(FOLDER / script), *places, *words]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        return done.stdout

    recordings, out = tmp_path / "recordings", tmp_path / "out"
    call("make.py", "--smoke", "--out", str(recordings))
    name = next(recordings.iterdir()).name
    assert call("make.py", "--smoke", "--out", str(recordings)) == ""  # it is there already
    (out / name).mkdir(parents=True)
    (out / name / "findings.json").write_text(json.dumps(found("none")))
    page = call("score.py", "--recordings", str(recordings), "--out", str(out), "--ready")
    assert "| nothing missing, said so | 1 of 1 | 100% |" in page
    assert json.loads((out / "score.json").read_text())["rows"][0]["right"] is True
    assert (out / "score.md").read_text() in page


def test_what_clamps_and_liquids_do_is_as_declared() -> None:
    # A clamp turned by 0.1 about z, a node by 0.4 and turning at 3 rad/s, while the clamp turns at 1 rad/s: 0.3 rad of
    # turn, of which 0.05 is play, and 2 rad/s.
    numbers = {"gripper_play.angle": 0.05, "gripper_play.stiffness": 2.0}
    damped = {"gripper_damping.stiffness": 2.0, "gripper_damping.loss_time": 0.1}
    about_z = np.array([0.0, 0.0, 1.0])[:, None, None]
    q, spin = exponential(0.4 * about_z + np.zeros((3, 2, 4))), 3.0 * about_z + np.zeros((3, 2, 4))
    grips = np.zeros((3, 2, 1)), exponential(0.1 * about_z + np.zeros((3, 2, 1))), about_z + np.zeros((3, 2, 1))
    turn = laws.grip_moment(Laws([numbers, damped]), q, spin, grips, False)
    # The corner at the end of the play is rounded off within 0.005 rad: 5e-5 rad of it are left 0.25 rad beyond.
    np.testing.assert_allclose(turn[2, :, 0], [2.0 * 0.25, 2.0 * (0.3 + 0.1 * 2.0)], rtol=5e-4)
    assert not turn[:, :, 1:].any() and np.abs(turn[:2]).max() < 1e-12
    # Along x at 2 m/s and across at 3 m/s: buoyancy, 1/2 rho c (2 r) v^2 across, 1/2 rho c (2 pi r) v^2 along.
    mesh, density = Mesh(10, 0.0, BEAM.length, False), 1000.0
    numbers = {"fluid_forces.across": 1.1, "fluid_forces.along": 0.02, "fluid_forces.added_mass": 0.9}
    wet, q = Laws([numbers], fluid=density), exponential(np.zeros((3, 1, 11)))
    v = np.broadcast_to(np.array([2.0, 3.0, 0.0])[:, None, None], (3, 1, 11))
    found = laws._fluid(wet, BEAM, mesh, np.zeros((3, 1, 11)), q, v).sum(-1)[:, 0]
    r, whole = BEAM.radius, BEAM.length
    drag = [-0.5 * density * 0.02 * 2 * np.pi * r * 4 * whole, -0.5 * density * 1.1 * 2 * r * 9 * whole]
    np.testing.assert_allclose(found, [*drag, density * np.pi * r**2 * whole * GRAVITY], rtol=1e-12)
    heavy = laws.added_inertia(wet, BEAM, mesh, q, v).sum(-1)[:, 0]
    np.testing.assert_allclose(heavy, [0.0, 0.9 * density * np.pi * r**2 * whole * 3.0, 0.0], rtol=1e-12)


def test_newer_effects_have_recordings_of_their_own() -> None:
    newer = cases.subset("newer")
    assert len({c.seed for c in newer}) == 3 and not {c.effects for c in newer} & {c.effects for c in cases.all_cases()}
    (wet,) = {c.scene.fluid for c in newer if c.effects == ("fluid_forces",)}
    rope = next(c.scene.rope for c in newer if c.effects == ("fluid_forces",))
    assert wet * np.pi * rope.radius**2 * rope.length == pytest.approx(0.5 * rope.mass)
    # What came before is as it was: seeds go by the places of numbers.
    assert list(laws.PLAIN).index("baseline.damping") == 43
