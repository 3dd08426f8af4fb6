"""The suggested motion tells apart what the recording cannot, and stays within what the laboratory has shown."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.test_cli import run
from torchdlo.errors import InputError
from torchdlo.report.pages import design_page as report
from torchdlo.sysid.diagnosis import budget
from torchdlo.sysid.diagnosis.error_floor import trial_gaps
from torchdlo.sysid.estimation.jobs import FitJob, SimulationJob
from torchdlo.sysid.estimation.result_cache import digest
from torchdlo.sysid.estimation.worker_pool import Pool
from torchdlo.sysid.experiment_design import design as search
from torchdlo.sysid.experiment_design import excitation_motions
from torchdlo.sysid.experiment_design.design import Design, design_experiment, design_json
from torchdlo.sysid.experiment_design.model_discrimination import rms_size
from torchdlo.sysid.model import initial_state as starts
from torchdlo.sysid.model import model_file
from torchdlo.sysid.model.rope_model import RopeModel
from torchdlo.sysid.model.trial_batch import Start
from torchdlo.sysid.recordings.recording import Recording, Trial, save_recording

S = np.array([0.0, 0.015, 0.06, 0.12, 0.18, 0.24, 0.3])
GRIPPED = np.arange(len(S)) < 2
NOISE = 5e-4
OPTIONS = {"vertices": 21, "numerical_damping": 0.0, "clamp_fraction": 0.0, "substep": 1e-2}
TRUTH = {
    "bending_stiffness": 5e-3,
    "twisting_stiffness": 4e-3,
    "damping_rate": 1.5,
    "tilted_gravity.angles.0": 0.04,
    "tilted_gravity.angles.1": 0.03,
}


def slow(name: str, along: int, frames: int = 41) -> Trial:
    """A rope below a gripper that points downwards and goes to and fro slowly, along x or along y."""
    time = np.arange(frames) * 0.02
    sway = np.zeros((frames, 3))
    sway[:, along] = 0.02 * (1 - np.cos(2 * np.pi * np.clip(time - 0.1, 0, None)))
    markers = sway[:, None] - S[:, None] * np.array([0.0, 0.0, 1.0])
    down = Rotation.from_rotvec([0.0, 0.5 * np.pi, 0.0]).as_quat(scalar_first=True)
    quaternion = np.tile(down, (frames, 1, 1))
    return Trial(name, time, markers, S, GRIPPED, quaternion, np.array([0]), np.zeros(frames, bool))


def empty(path: Path) -> Recording:
    """Trials without a simulated rope."""
    trials = (slow("train_0", 0), slow("train_1", 1), slow("test_0", 0))
    gravity = np.array([0.0, 0.0, -9.81])
    return Recording(path, 0.3, 0.005, 0.015, gravity, None, NOISE, None, None, False, "", trials[:2], trials[2:])


def measured(recording: Recording, trials: tuple[Trial, ...], start: Start, seed: int) -> tuple[Trial, ...]:
    """Trials as a rope under tilted gravity and noise show them."""
    model = RopeModel(replace(recording, train=trials, test=()), effects=("tilted_gravity",), **OPTIONS)
    unseen = [replace(t, markers=np.where(GRIPPED[:, None], t.markers, np.nan)) for t in trials]
    sims = model.simulate(model.motion(unseen), start, np.array([[TRUTH[n] for n in model.parameters]]))[0]
    rng = np.random.default_rng(seed)
    return tuple(
        replace(t, markers=np.where(GRIPPED[:, None], t.markers, s + NOISE * rng.normal(size=s.shape)))
        for t, s in zip(trials, sims, strict=True)
    )


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """Slow motions of a rope under tilted gravity."""
    bare = empty(tmp_path_factory.mktemp("design") / "rope")
    trials = (*bare.train, *bare.test)
    first = np.stack([t.markers[0] for t in trials])
    made = measured(bare, trials, Start(first, 0 * first, np.ones(3, bool)), 1)
    return replace(bare, train=made[:2], test=made[2:])


def write_findings(folder: Path, recording: Recording, ties: list[str]) -> Path:
    """What a diagnosis that named the tilt would have written."""
    folder.mkdir()
    model = RopeModel(recording, effects=("tilted_gravity",), **OPTIONS)
    # The stiffness 10 % off: fits are not to start at the truth.
    values = TRUTH | {"bending_stiffness": 1.1 * TRUTH["bending_stiffness"]}
    content = model_file.content(model, np.array([values[n] for n in model.parameters]))
    (folder / "model.json").write_text(json.dumps(content, default=lambda x: np.asarray(x).tolist()))
    findings = {
        "generator": "torchdlo diagnose",
        "recording": str(recording.path),
        "recording_sha256": digest({f.name: getattr(recording, f.name) for f in dataclasses.fields(recording)[1:]}),
        "effects": [{"name": "tilted_gravity", "indistinguishable_from": ties}],
    }
    (folder / "findings.json").write_text(json.dumps(findings))
    return folder


@pytest.fixture(scope="module")
def found(recording: Recording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Findings, in a folder that takes the journal of the design, too."""
    return write_findings(tmp_path_factory.mktemp("found") / "rope", recording, ["rest_curvature"])


def designed(recording: Recording, found: Path, *, resume: bool = False) -> Design:
    """A short search."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(budget, "BUDGETS", {"fast": budget.Budget(2, 2, 2, 1, 1)})
        for name, value in {"WIDTHS": (0.5,), "COUNT": 4, "LEADERS": 1, "ITERATIONS": 1}.items():
            patch.setattr(search, name, value)
        options = {"journal": found / "journal", "resume": resume}
        return design_experiment(recording, findings=found, seconds=1.0, workers=1, **options)


@pytest.fixture(scope="module")
def design(recording: Recording, found: Path) -> Design:
    """The motion that tells tilt and natural curvature apart."""
    return designed(recording, found)


def refitted(design: Design, recording: Recording, new: Trial) -> dict[str, tuple[float, float]]:
    """Gap of each rival in the old train trials and in a new one [m] after a fit to all of them."""
    joined = replace(recording, train=(*recording.train, new), test=())
    found = {}
    with Pool(joined, OPTIONS, workers=1) as pool:
        for name, rival in design.models.items():
            start = starts.begin(pool.local.model(rival.effects), joined.train)
            job = FitJob(rival.effects, rival.values[None], rival.space.names, tuple(rival.space.units), 3, start)
            ((_, fitted),) = pool.fit([job])
            ((_, sims),) = pool.simulate([SimulationJob(rival.effects, fitted.values[None], "train", start)])
            gaps = trial_gaps(sims[0], joined.train)
            found[name] = float(np.sqrt(np.mean(gaps[:-1] ** 2))), float(gaps[-1])
    return found


@pytest.mark.slow
def test_the_suggested_motion_separates_what_the_recording_cannot(design: Design, recording: Recording) -> None:
    assert set(design.models) == {"tilted_gravity", "rest_curvature"}
    # Both explain the slow motions; the suggested one sets them apart.
    assert design.reference < design.needed < design.separation
    best = design.options[0].gesture
    (new,) = measured(
        recording, (replace(design.trial, name="train_2"),), excitation_motions.first_pose(design.rig, [best]), 2
    )
    gaps = refitted(design, recording, new)
    # Of 51 x 5 x 3 noisy coordinates the root mean square scatters by 2.6 %; four times that.
    assert gaps["tilted_gravity"][1] == pytest.approx(NOISE, rel=0.1)
    # Squares add up: what the rival leaves above the noise is what was foretold for it.
    foretold = next(rms_size(p.left) for p in design.pairs if p.truth == "tilted_gravity")
    left = np.sqrt(gaps["rest_curvature"][1] ** 2 - NOISE**2)
    assert left > 0.5 * foretold and left > design.needed * design.noise


@pytest.mark.slow
def test_the_report_tells_all(design: Design, tmp_path: Path) -> None:
    report.write_design(design, tmp_path, command="torchdlo design-experiment rope")
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(report.FILES)
    content = json.loads((tmp_path / "design.json").read_text())
    assert content["generator"] == "torchdlo design-experiment" and content == json.loads(design_json(design))
    assert content["separation"] > content["needed"] > content["separation_of_recording"]
    assert len(content["motions"]) == len(design.options) and content["motions"][0]["separation"] is not None
    arrays = np.load(tmp_path / "motion.npz")
    assert np.isfinite(arrays["markers"][:, GRIPPED]).all() and np.isnan(arrays["markers"][:, ~GRIPPED]).all()
    page = (tmp_path / "report.html").read_text()
    assert "rest curvature" in page and page.count("data:image/png") == 1
    text = report.design_table(design)
    assert "the recording at hand" in text.splitlines()[-1] and len(text.splitlines()) == len(design.options) + 2


def test_motions_stay_within_what_was_recorded(tmp_path: Path) -> None:
    rig = excitation_motions.make_rig(empty(tmp_path))
    # 4 cm to and fro once a second: 2 cm to each side, 2 pi 2 cm/s; smoothing over 0.1 s takes 1 % off a sine.
    np.testing.assert_allclose(rig.reach, [0.02, 0.02, 0.0], atol=2e-5)
    assert rig.speed == pytest.approx(0.04 * np.pi, rel=0.02)
    found = excitation_motions.motion_menu(rig, 2.0, 9.81)
    assert {"hold", "swing", "ladder", "stop", "circle", "roll"} == {g.kind for g in found}
    tried = [*found, *excitation_motions.nearby_motions(found[4], np.random.default_rng(0), 8, 1.0, 2.0)]
    for gesture in tried:
        trial = excitation_motions.motion_trial(rig, gesture, 2.0, "motion")
        centre = trial.markers[:, GRIPPED].mean(1)
        level = Rotation.from_rotvec([0.0, 0.0, -gesture.heading]).apply(centre - centre[0])
        speed = np.linalg.norm(np.gradient(centre, trial.time, axis=0), axis=-1)
        assert (np.abs(level) <= rig.reach + 1e-9).all() and speed.max() <= rig.speed * (1 + 1e-6)
        # Grippers begin at rest: the start of the rope is read off the first tenth of a second.
        assert np.ptp(centre[trial.time <= 0.1], axis=0).max() < 1e-12
        length = np.linalg.norm(trial.markers[:, 1] - trial.markers[:, 0], axis=-1)
        np.testing.assert_allclose(length, 0.015, atol=1e-12)


def test_a_roll_turns_the_clamp_about_the_rope(tmp_path: Path) -> None:
    rig = excitation_motions.make_rig(empty(tmp_path))
    trial = excitation_motions.motion_trial(rig, excitation_motions.ExcitationMotion("roll", 0.5), 2.5, "motion")
    turn = Rotation.from_quat(trial.gripper_quaternion[:, 0], scalar_first=True)
    np.testing.assert_allclose(turn.apply([1.0, 0, 0]), np.tile([0, 0, -1.0], (len(turn), 1)), atol=1e-12)
    # Half a turn, from the clamp's y axis to its opposite.
    np.testing.assert_allclose(turn[-1].apply([0, 1.0, 0]), -turn[0].apply([0, 1.0, 0]), atol=1e-9)


def test_two_clamps_come_as_close_as_they_were(tmp_path: Path) -> None:
    bare = empty(tmp_path)
    trial = bare.train[0]
    # The last two markers are held too, 24 cm away, and come 5 cm closer and back once a second.
    markers = trial.markers + 0.0
    nearer = 0.025 * (1 - np.cos(2 * np.pi * trial.time))
    markers[:, -2:] = markers[:, :1] + np.stack([0.24 - nearer, 0 * nearer, 0 * nearer], -1)[:, None]
    markers[:, -1, 0] += 0.06
    both = GRIPPED | (np.arange(len(S)) >= len(S) - 2)
    trial = replace(trial, markers=markers, gripped=both, gripper_quaternion=None, gripper_marker=None)
    rig = excitation_motions.make_rig(replace(bare, train=(trial,), test=()))
    assert rig.closer == pytest.approx(0.05, rel=0.02)
    gesture = next(g for g in excitation_motions.motion_menu(rig, 2.0, 9.81) if g.kind == "against")
    played = excitation_motions.motion_trial(rig, gesture, 2.0, "motion").markers
    apart = np.linalg.norm(played[:, -2:].mean(1) - played[:, :2].mean(1), axis=-1)
    assert 0.005 < apart[0] - apart.min() <= rig.closer + 1e-9 and apart.max() <= apart[0] + 1e-12
    middle = played[:, both].mean(1)
    np.testing.assert_allclose(middle - middle[0], 0.0, atol=1e-12)


def test_a_larger_scale_allows_larger_and_faster_motions(tmp_path: Path) -> None:
    rig, wider = (excitation_motions.make_rig(empty(tmp_path), scale) for scale in (1.0, 3.0))
    gesture = excitation_motions.ExcitationMotion("swing", 1.0)
    assert excitation_motions.largest_amplitude(wider, gesture, 2.0)[0] == pytest.approx(
        3 * excitation_motions.largest_amplitude(rig, gesture, 2.0)[0]
    )


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({}, "expected the folder of a diagnosis or names of effects"),
        ({"names": ["wind", "tilted_gravty"]}, "did you mean tilted_gravity"),
        ({"names": ["wind", "table_friction"]}, "table_friction cannot act in"),
        ({"names": ["wind"]}, "expected two or more effects to tell apart, found wind"),
        ({"names": ["wind", "time_delay"], "seconds": 0.1}, "seconds: expected 1 to 60, found 0.1"),
        ({"names": ["wind", "time_delay"], "mass": 9.0}, "mass: expected kilograms"),
        ({"names": ["wind", "point_mass"], "mass": 0.01}, "cannot be told from point_mass"),
    ],
)
def test_what_cannot_be_separated_is_refused(recording: Recording, options: dict[str, object], said: str) -> None:
    with pytest.raises(InputError, match=said):
        design_experiment(recording, workers=1, **options)


def test_findings_must_be_of_this_recording_and_tie(recording: Recording, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"findings.json: expected the findings of torchdlo diagnose, found none"):
        design_experiment(recording, findings=tmp_path, workers=1)
    folder = write_findings(tmp_path / "a", recording, [])
    with pytest.raises(InputError, match="nothing to separate: the diagnosis names tilted_gravity, and nothing ties"):
        design_experiment(recording, findings=folder, workers=1)
    other = replace(recording, mass=0.02)
    with pytest.raises(InputError, match="found that of another recording"):
        design_experiment(other, findings=folder, workers=1)


@pytest.mark.slow
def test_a_search_that_was_stopped_goes_on(
    design: Design, recording: Recording, found: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def lost(*_: object) -> None:
        raise AssertionError("computed again")

    for name in ("_led", "_done"):
        monkeypatch.setattr(Pool, name, lost)
    again = designed(recording, found, resume=True)
    assert again.separation == design.separation and again.options[0].gesture == design.options[0].gesture


@pytest.mark.slow
def test_the_command_writes_the_suggestion(
    design: Design,
    recording: Recording,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    asked: dict[str, object] = {}

    def fake(recording: object, names: list[str], **options: object) -> Design:
        asked.update(options, names=names)
        return design

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(search, "design_experiment", fake)
    save_recording(recording, tmp_path / "rope")
    assert run("design-experiment", "rope", "--effects", "rest_curvature, tilted_gravity", "--seed", 3) == 0
    assert asked["names"] == ["rest_curvature", "tilted_gravity"] and asked["findings"] is None and asked["seed"] == 3
    said = capsys.readouterr().out
    assert said.startswith("To tell tilted gravity and rest curvature apart") and "the recording at hand" in said
    # Its own files are written again; the findings of a diagnosis are looked for where that writes them.
    assert run("design-experiment", "rope", "--json") == 0
    assert asked["findings"] == Path("runs/diagnose/rope") and asked["names"] == []
    assert json.loads(capsys.readouterr().out)["motion"]["kind"] == design.options[0].gesture.kind


def test_the_command_says_why_it_stops(
    recording: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    save_recording(recording, tmp_path / "rope")
    assert run("design-experiment", "rope") == 2
    assert "runs/diagnose/rope/findings.json: expected the findings" in capsys.readouterr().err
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "motion.npz").write_bytes(b"of somebody else")
    assert run("design-experiment", "rope", "--effects", "wind,time_delay", "--out", "out") == 2
    assert "motion.npz: exists without design.json" in capsys.readouterr().err

    def stopped(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(search, "design_experiment", stopped)
    assert run("design-experiment", "rope", "--effects", "wind,time_delay") == 130
    assert "interrupted; there was no result yet, and nothing was written" in capsys.readouterr().err
