"""Forces at the grippers: simulated as Newton says, read and checked, and what they tell of mass and stiffness."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.sysid.swaying import recording as swaying
from torchdlo.errors import InputError
from torchdlo.sysid.calibration.calibrate import calibrate
from torchdlo.sysid.model import initial_state, model_file
from torchdlo.sysid.model.grip_wrench import grips
from torchdlo.sysid.model.rope_model import RopeModel
from torchdlo.sysid.model.trial_batch import Start
from torchdlo.sysid.recordings.recording import Recording, Trial, load_recording, save_recording
from torchdlo.sysid.recordings.unit_doubts import doubts
from torchdlo.sysid.recordings.wrench import ForceSensor, check_forces, force_doubts

MASS, BEND, TWIST, RATE = 0.03, 2e-3, 1.2e-3, 0.8
G = np.array([0.0, 0.0, -9.81])
NOISE, FORCE, TORQUE = 2e-4, 5e-3, 5e-4


def empty(path: Path, *, ends: int = 2, step: float = 0.02, even: bool = False) -> Recording:
    """Grippers that shake a rope for 0.8 s, whose free markers are on a line."""
    rng = np.random.default_rng(0)
    s = np.linspace(0, 0.5, 9) if even else np.array([0.0, 0.03, 0.14, 0.25, 0.36, 0.47, 0.5])
    gripped = np.arange(len(s)) < 2
    gripped |= (np.arange(len(s)) >= len(s) - 2) & (ends == 2)
    time = np.arange(round(0.8 / step) + 1) * step

    def trial(name: str) -> Trial:
        a, b, w = *rng.uniform(0.03, 0.06, 2), rng.uniform(6, 12, 2)
        line = np.stack([s / s[-1] * 0.4, 0 * s, 0.3 - 0.4 * (s / s[-1]) * (1 - s / s[-1])], -1)
        sway = np.stack([0 * time, a * np.sin(w[0] * time), b * np.sin(w[1] * time)], -1)
        weight = np.where(s < 0.25, 1.0, -0.5)
        markers = line[None] + weight[None, :, None] * sway[:, None]
        return Trial(name, time, markers, s, gripped, None, None, np.zeros(len(time), bool))

    made = tuple(trial(n) for n in ("train_0", "train_1", "test_0"))
    return Recording(path, 0.5, 0.004, MASS, G, None, NOISE, None, None, False, "", made[:2], made[2:])


def with_sensors(trial: Trial) -> Trial:
    outer = np.array([0, len(trial.gripped) - 1] if trial.gripped[-1] else [0])
    return replace(trial, wrench=np.zeros((len(trial.time), len(outer), 6)), wrench_marker=outer)


def simulated(rope: Recording, vertices: int) -> tuple[RopeModel, np.ndarray, np.ndarray]:
    """The model, markers (B, F, M, 3) and forces and torques (B, F, W, 6) of a rope of known numbers."""
    trials = tuple(with_sensors(t) for t in rope.trials("all"))
    model = RopeModel(rope, vertices=vertices, forces=True)
    motion, begin = model.motion(trials), initial_state.read_off(trials)
    values = {"bending_stiffness": BEND, "twisting_stiffness": TWIST, "damping_rate": RATE, "mass": MASS}
    row = np.array([values[name] for name in model.parameters])
    start = Start(begin.pos, 0 * begin.vel)
    markers, wrench = model.with_forces(motion, start, row[None], grips(model.mesh, trials[0]))
    np.testing.assert_array_equal(markers, model.simulate(motion, start, row[None]))
    return model, markers[0], wrench[0]


def recorded(path: Path) -> Recording:
    """What sensors and cameras would say of it."""
    rope, rng = empty(path), np.random.default_rng(1)
    _, markers, wrench = simulated(rope, 13)
    made = []
    for trial, x, w in zip(rope.trials("all"), markers, wrench, strict=True):
        seen = x + NOISE * rng.normal(size=x.shape) * ~trial.gripped[:, None]
        felt = w + rng.normal(size=w.shape) * np.repeat([FORCE, TORQUE], 3)
        made.append(replace(with_sensors(trial), markers=seen, wrench=np.where(np.isfinite(w), felt, np.nan)))
    sensor = ForceSensor("world", FORCE, TORQUE)
    return replace(rope, train=tuple(made[:2]), test=tuple(made[2:]), wrench=sensor)


@pytest.fixture(scope="module")
def rope(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return recorded(tmp_path_factory.mktemp("rope"))


@pytest.mark.parametrize("ends", [1, 2])
def test_grippers_exert_what_momentum_and_its_moment_take(tmp_path: Path, ends: int) -> None:
    # Every vertex has a marker and every frame is a substep: F = sum m (a - g), torque = sum r x m (a - g), with
    # a = (x+ - x - d (x - x-)) / h^2 sqrt(d), d = exp(-rate h). Implicit steps balance forces to 1e-3 of the weight;
    # their inertia against bending has moments, of second order in the step.
    h = 5e-3
    model, markers, wrench = simulated(empty(tmp_path, ends=ends, step=h, even=True), 9)
    assert len(model.arclength) == markers.shape[2] and model.substeps == 1
    share = np.full(9, 1 / 8)
    share[[0, -1]] /= 2
    decay = np.exp(-RATE * h)
    x = markers
    a = (x[:, 2:] - x[:, 1:-1] - decay * (x[:, 1:-1] - x[:, :-2])) / (h * h * np.sqrt(decay))
    pull = MASS * share[:, None] * (a - G)
    force = wrench[:, 1:-1, :, :3].sum(2)
    assert np.abs(force - pull.sum(2)).max() < 1e-3 * np.linalg.norm(MASS * G) and np.isnan(wrench[:, -1]).all()
    about = x[:, 1:-1, :1]
    moment = np.cross(x[:, 1:-1] - about, pull).sum(2)
    ends_at = x[:, 1:-1][:, :, [0, -1][:ends]] - about
    torque = (wrench[:, 1:-1, :, 3:] + np.cross(ends_at, wrench[:, 1:-1, :, :3])).sum(2)
    assert np.abs(torque - moment).max() < 0.02 * np.abs(moment).max()


@pytest.mark.slow
@pytest.mark.parametrize("forces", [True, False])
def test_forces_tell_mass_and_stiffness_by_themselves(rope: Recording, forces: bool) -> None:
    # rope.json has a mass that is 60 % too large. Without forces the stiffness is too large by as much. A start that is
    # known to a millimetre makes forces of a rope that is jerked about uncertain by as much as its weight.
    said = replace(rope, mass=1.6 * MASS, wrench=rope.wrench if forces else None)
    result = calibrate(said, starts=6, iterations=5, vertices=13, refined=False)
    factor = 1.0 if forces else 1.6
    assert result.parameters["bending_stiffness"]["value"] == pytest.approx(factor * BEND, rel=0.03)
    assert ("mass" in result.parameters) == forces and result.test_mae_mm < 0.6
    assert result.model["rope"]["mass"] == pytest.approx(factor * MASS, rel=0.02)
    if forces:
        assert result.parameters["mass"]["unit"] == "kg"
        assert any("rope.json 48 g" in note for note in result.notes)


def test_a_mass_that_forces_told_goes_with_the_model(rope: Recording, tmp_path: Path) -> None:
    import json

    light = replace(rope, mass=1.6 * MASS)
    model = RopeModel(light, vertices=13, forces=True)
    values = np.array([{"mass": MASS}.get(n, g) for n, g in zip(model.parameters, model.guess(), strict=True)])
    path = tmp_path / "model.json"
    path.write_text(json.dumps(model_file.content(model, values), default=lambda x: x.tolist()))
    found = model_file.load(path)
    assert found.model(light).mass == MASS and "mass" not in found.model(light).parameters
    assert "mass" not in json.loads(path.read_text())["parameters"]


def test_forces_are_kept_in_files(rope: Recording, tmp_path: Path) -> None:
    save_recording(rope, tmp_path / "again")
    again = load_recording(tmp_path / "again")
    assert again.wrench == rope.wrench
    np.testing.assert_array_equal(again.train[0].wrench, rope.train[0].wrench)
    assert again.train[0].wrench_marker.tolist() == [0, 6]


def changed(rope: Recording, change) -> Recording:
    """The recording with what the train trials' forces (F, W, 6) become."""
    train = tuple(replace(t, wrench=change(t, t.wrench)) for t in rope.train)
    return replace(rope, train=train)


def test_forces_that_cannot_be_the_ropes_are_refused(rope: Recording) -> None:
    check_forces(rope)
    assert not force_doubts(rope)
    with pytest.raises(InputError, match=r"train_0.npz: wrench: .*multiply it by -1"):
        check_forces(changed(rope, lambda t, w: -w))
    sideways = changed(rope, lambda t, w: w[..., [2, 0, 1, 3, 4, 5]])
    with pytest.raises(InputError, match=r"8[0-9] degrees off the vertical"):
        check_forces(sideways)
    # Clamps whose z axis points along the world's x: what was given in one frame, but is in the other.
    half = np.sqrt(0.5)
    quat = np.tile([half, 0.0, half, 0.0], (len(rope.train[0].time), 2, 1))
    turned = tuple(replace(t, gripper_quaternion=quat, gripper_marker=t.wrench_marker) for t in rope.train)
    wrong = replace(rope, train=turned, wrench=ForceSensor("gripper", FORCE))
    with pytest.raises(InputError, match=r"set wrench\.frame to world"):
        check_forces(wrong)
    with pytest.raises(InputError, match="multiply it by -1"):
        calibrate(changed(rope, lambda t, w: -w))


def test_bias_drift_and_the_weight_of_a_gripper_are_said(rope: Recording) -> None:
    heavier = changed(rope, lambda t, w: w + np.array([0, 0, 0.05 * 9.81 / 2, 0, 0, 0]))
    (said,) = force_doubts(heavier)
    # Their weight has no inertia here: forces are no rope's, somewhere between 30 and 80 g.
    assert "rope.json says 30 g" in said and "weight of grippers" in said and said in "".join(doubts(heavier))
    drifting = changed(rope, lambda t, w: w + np.outer(t.time, [0.0, 0.5, 0, 0, 0, 0])[:, None])
    said = force_doubts(drifting)
    assert len(said) == 2 and all("drifts by" in each and "along y" in each for each in said)


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({"frame": "camera", "force_noise_std": 0.1}, "wrench.frame: expected world or gripper"),
        ({"frame": "world", "force_noise_std": 0}, "force_noise_std: expected a finite number above 0 in N"),
        ({"frame": "world"}, "force_noise_std: expected, but missing"),
        ({"frame": "gripper", "force_noise_std": 0.1}, "gripper_quaternion: expected orientations of all grippers"),
        (None, "wrench: expected frame and noise of the forces in train_0.npz"),
    ],
)
def test_what_a_file_lacks_is_said(rope: Recording, tmp_path: Path, entries: dict | None, message: str) -> None:
    import json

    save_recording(rope, tmp_path / "again")
    file = tmp_path / "again" / "rope.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"wrench": entries}))
    with pytest.raises(InputError, match=message):
        load_recording(tmp_path / "again")


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"wrench_marker": None}, "wrench_marker: expected together with wrench"),
        ({"wrench_marker": np.array([0, 3])}, "wrench_marker: expected indices of gripped markers, found 3"),
        ({"wrench_marker": np.array([0, 1])}, "found two markers of the same one"),
        ({"wrench_marker": np.array([0])}, r"wrench: expected shape \(41, 1, 6\)"),
    ],
)
def test_forces_that_do_not_fit_the_grippers_are_refused(
    rope: Recording, tmp_path: Path, arrays: dict, message: str
) -> None:
    save_recording(rope, tmp_path / "again")
    file = tmp_path / "again" / "train_0.npz"
    kept = dict(np.load(file)) | arrays
    np.savez(file, **{k: v for k, v in kept.items() if v is not None})
    with pytest.raises(InputError, match=message):
        load_recording(tmp_path / "again")


@pytest.mark.parametrize(("marker", "columns"), [([14, 0], [1, 0]), ([0], [0])])
def test_forces_of_other_grippers_or_in_another_order_are_refused(
    tmp_path: Path, marker: list[int], columns: list[int]
) -> None:
    bare = swaying(tmp_path, both=True, frames=20)
    wrench = np.zeros((20, 2, 6))
    train = [replace(t, wrench=wrench, wrench_marker=np.array([0, 14])) for t in bare.train]
    train[1] = replace(train[1], wrench=wrench[:, columns], wrench_marker=np.array(marker))
    sensor = ForceSensor("world", 0.01)
    good = replace(bare, wrench=sensor, train=(*train[::2], replace(train[0], name="train_1")))
    save_recording(good, tmp_path / "good")
    assert len(load_recording(tmp_path / "good").train) == 3
    save_recording(replace(good, train=tuple(train)), tmp_path / "other")
    with pytest.raises(InputError, match=r"train_1.npz: wrench_marker: expected \[0, 14\] as in train_0.npz, found \["):
        load_recording(tmp_path / "other")
