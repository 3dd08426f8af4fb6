"""Joint targets for real arms: limits, time, files, and a dry run."""

from __future__ import annotations

import csv
import json
import math
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

pytest.importorskip("pytorch_kinematics", reason="arms need the extra robots")

sys.path.insert(0, str(Path(__file__).parent / "rl"))
from lead import Lead

from torchdlo import envs
from torchdlo.agents import deployment
from torchdlo.agents.data.demonstrators import make_demonstrator
from torchdlo.agents.deployment import (
    JointMotion,
    _sampled,
    arms_of,
    motion_text,
    play_motion,
    replay_joints,
    time_scale,
)
from torchdlo.agents.policies import Policy, PolicySpec, save_policy, task_features
from torchdlo.cli import app
from torchdlo.cli.policies import _perturb
from torchdlo.cli.policy_deployment import _source
from torchdlo.coupling.robot.robot_kinematics import load_robot, panda, tool_pose
from torchdlo.envs.core.task import straight
from torchdlo.errors import InputError

HERE = torch.zeros(1, 1, 3)


def actions() -> torch.Tensor:
    made = torch.zeros(6, 6)
    made[:, 1] = 0.025 / 6
    return made


@pytest.fixture(scope="module")
def path() -> dict[str, torch.Tensor]:
    found, good = play_motion(Lead(), actions(), HERE)
    assert good
    return found


def test_joints_bring_the_tool_along_the_path(path):
    motion = time_scale(Lead(), arms_of(Lead()), path, same=True)
    assert motion.position.shape == (7, 7)
    full = torch.cat([motion.position, torch.zeros(7, 1, dtype=torch.float64)], -1)
    tool = tool_pose(panda(base=Lead.arms.base[0]), full).pos
    # 25 mm to the left, as the actions say.
    torch.testing.assert_close((tool[-1] - tool[0])[1], torch.tensor(0.025, dtype=torch.float64), atol=2e-4, rtol=0)


def test_speeds_and_accelerations_stay_within_their_limits(path):
    robots = arms_of(Lead())
    limit = robots[0].velocity[robots[0].arm]
    motion = time_scale(Lead(), robots, path, same=True, share=0.5, acceleration=10.0)
    # 4 mm in 2 ms is far too fast for an arm.
    assert motion.slower > 1
    steps = motion.position.diff(dim=0) / motion.time.diff()[:, None]
    assert (steps.abs() <= 0.5 * limit * (1 + 1e-9)).all()
    assert (motion.velocity.abs() <= 0.5 * limit * (1 + 1e-9)).all()
    assert motion.acceleration is not None and float(motion.acceleration.abs().max()) <= 10.0 * (1 + 1e-9)
    assert (motion.velocity[0] == 0).all() and (motion.velocity[-1] == 0).all()
    assert float(motion.time[-1]) == pytest.approx(6 * 0.002 * motion.slower)


def played(motion: JointMotion, order: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Positions, velocities and accelerations between points, as a controller has them: cubics (4) or quintics (6)."""
    step, share = float(motion.time[1] - motion.time[0]), torch.linspace(0, 1, 101, dtype=torch.float64)

    def powers(u: torch.Tensor, times: int) -> torch.Tensor:
        """Derivatives of 1, u, u^2 ... by time, shape (..., order)."""
        rows = [math.prod(range(n - times + 1, n + 1)) * u ** max(0, n - times) for n in range(order)]
        return torch.stack(rows, -1) / step**times

    told = [motion.position, motion.velocity, motion.acceleration][: order // 2]
    ends = torch.stack([powers(torch.tensor(u, dtype=torch.float64), d) for u in (0.0, 1.0) for d in range(len(told))])
    known = torch.stack([x for part in (slice(None, -1), slice(1, None)) for x in (y[part] for y in told)])
    solved = torch.linalg.solve(ends, known.flatten(1)).reshape(order, *known.shape[1:])
    return tuple(torch.einsum("un,nkj->ukj", powers(share, d), solved) for d in range(3))


def along(shares: torch.Tensor, joint: int = 0, to: str = "velocity") -> JointMotion:
    """How the arm is told to move one joint: by shares of its greatest speed per action, or up to its limit."""
    robot = arms_of(Lead())[0]
    joints = 0.5 * (robot.lower + robot.upper).expand(len(shares), -1).clone()
    if to == "velocity":
        joints[:, joint] += 2e-3 * robot.velocity[joint] * shares
    else:
        joints[:, joint] = robot.upper[joint] - shares
    none = torch.zeros(len(shares), 1, 4, dtype=torch.float64)
    return time_scale(Lead(), [robot], {"pos": none[..., :3], "quat": none, "joints": joints[:, None]}, same=True)


@pytest.mark.parametrize("order", [4, 6])
@pytest.mark.parametrize("bent", [False, True])
def test_limits_hold_for_what_controllers_make_of_the_points(order: int, bent: bool):
    """One joint begins at once at half of its greatest speed, and ends so; or goes to and fro."""
    shares = torch.arange(40, dtype=torch.float64)
    motion = along(8 * (0.7 * shares).sin() if bent else 0.5 * shares)
    position, velocity, acceleration = played(motion, order)
    limit = panda().velocity[0]
    assert motion.acceleration is not None and motion.slower > 1
    assert float(acceleration.abs().max()) == pytest.approx(10, rel=1e-6)
    assert float(velocity.abs().amax((0, 1))[0] / limit) <= 1 + 1e-9
    torch.testing.assert_close(position[-1], motion.position[1:], rtol=0, atol=1e-12)
    assert not motion.velocity[[0, -1]].any()


def test_the_greatest_speed_may_be_between_points():
    robot = arms_of(Lead())[0]
    x = 0.01 * torch.tensor([0.0, 1, 2, 3, 3, 3], dtype=torch.float64)[:, None].expand(-1, 7)
    motion = JointMotion((), 0.02 * torch.arange(6.0), x, deployment._velocities(robot, x, 0.02)[0], None, 1.0)
    velocity = played(motion, 4)[1]
    assert float(velocity.abs().max()) > 1.02 * float(motion.velocity.abs().max())
    fastest = deployment._fastest(x, motion.velocity, 0.02)
    torch.testing.assert_close(velocity.abs().amax((0, 1)), fastest, rtol=1e-3, atol=0)


def test_joints_that_stop_at_a_limit_do_not_swing_beyond_it():
    motion = along(torch.tensor([0.03, 0.03, 0.02, 0.01, 0, 0, 0, 0.01], dtype=torch.float64), joint=1, to="limit")
    position, _, acceleration = played(motion, 4)
    assert float(position[..., 1].max()) <= float(panda().upper[1]) + 1e-12
    assert float(acceleration.abs().max()) == pytest.approx(10, rel=1e-6)
    # Accelerations differ before and after a point: controllers are left with cubics.
    assert motion.acceleration is None
    assert "acceleration" not in json.loads(motion_text(motion, "json", {}))
    ros = json.loads(motion_text(motion, "ros2", {}))["points"]
    assert len(ros) == 8 and ros[3]["accelerations"] == [] and len(ros[3]["velocities"]) == 7


def test_joints_beyond_their_limits_are_named(path):
    wrong = path | {"joints": path["joints"] + torch.tensor([0.0, 0, 0, 5.0, 0, 0, 0, 0])}
    with pytest.raises(InputError, match=r"joint .*4.* would be .* beyond its limit at point"):
        time_scale(Lead(), arms_of(Lead()), wrong, same=True)


def test_another_arm_follows_the_tools_path(path):
    """The same arm, but found by inverse kinematics alone."""
    motion = time_scale(Lead(), arms_of(Lead()), path, same=False)
    full = torch.cat([motion.position, torch.zeros(7, 1, dtype=torch.float64)], -1)
    tool = tool_pose(panda(base=Lead.arms.base[0]), full).pos
    torch.testing.assert_close(tool, path["pos"][:, 0], atol=1e-3, rtol=0)


def test_a_path_out_of_reach_is_refused(path):
    far = path | {"pos": path["pos"] + 3}
    with pytest.raises(InputError, match="cannot get to point 0"):
        time_scale(Lead(), arms_of(Lead()), far, same=False)


def gantry(limit: str = 'lower="-5" upper="5" velocity="1"', turn: str = "0 0 0", after: str = "") -> str:
    """An arm of three slides along x, y and z, whose tool is turned as it is; `after` is what else it has."""
    links = '<link name="tool"/>' + "".join(f'<link name="link{k}"/>' for k in range(4))
    slides = "".join(
        f'<joint name="slide{k}" type="prismatic"><parent link="link{k}"/><child link="link{k + 1}"/>'
        f'<axis xyz="{axis}"/><limit {limit} effort="1"/></joint>'
        for k, axis in enumerate(("1 0 0", "0 1 0", "0 0 1"))
    )
    hand = f'<parent link="link3"/><child link="tool"/><origin rpy="{turn}"/>'
    return f'<robot name="gantry">{links}{slides}<joint name="hand" type="fixed">{hand}</joint>{after}</robot>'


def hanging(off: float = 0.0) -> str:
    """The turn of a tool as the task has it, and so many degrees about the vertical."""
    # It points down: half a turn about an axis that lies flat.
    down = Lead().arms.quats[0]
    assert abs(down[0]) < 1e-6 and abs(down[3]) < 1e-6
    return f"{math.pi} 0 {2 * math.atan2(down[2], down[1]) + math.radians(off)}"


def of_gantry(path: dict[str, torch.Tensor], **choices: str) -> JointMotion:
    """How it moves along the path, with its tool turned as the arm of the simulation has it."""
    quat = path["quat"][:1, 0]
    path = path | {"quat": quat.expand(len(path["pos"]), 1, 4)}
    robot = load_robot(gantry(**choices), tool="tool", base=Lead.arms.base[0])
    return time_scale(Lead(), [robot], path, same=False)


def test_tools_that_cannot_be_turned_as_they_should_be_are_refused(path):
    motion = of_gantry(path, turn=hanging())
    full = path["pos"][:, 0] - torch.tensor(Lead.arms.base[0], dtype=torch.float64)
    torch.testing.assert_close(motion.position, full, atol=1e-3, rtol=0)
    for turn, off in (("0 0 0", 180), (hanging(20), 20)):
        with pytest.raises(InputError, match=f"mm and {off} degrees; place"):
            of_gantry(path, turn=turn)


def mimicking(limit: str, mimic: str) -> str:
    """A slide that carries nothing and goes as the third one of `gantry` does."""
    return (
        '<link name="other"/><joint name="other" type="prismatic"><parent link="link3"/><child link="other"/>'
        f'<axis xyz="0 0 1"/><limit {limit} effort="1"/><mimic joint="slide2" {mimic}/></joint>'
    )


def test_arms_without_speed_are_refused(path):
    yaw = hanging()
    for velocity in ("0", "-1e-3"):
        with pytest.raises(InputError, match="joint slide0, or one that mimics it, has a greatest speed of"):
            of_gantry(path, turn=yaw, limit=f'lower="-5" upper="5" velocity="{velocity}"')


def test_limits_of_joints_that_mimic_others_hold(path):
    """The tool stays 50 mm high and goes 25 mm to the side; the third slide stands still, and others follow it."""
    near = {"lower": -1e-3, "upper": 1e-3, "velocity": 1e-3}
    limit = " ".join(f'{name}="{value}"' for name, value in near.items())
    with pytest.raises(InputError, match="its tool cannot get to point 0"):
        of_gantry(path, turn=hanging(), after=mimicking(limit, 'multiplier="1"'))
    # An offset of -50 mm, and of 50 mm for one that goes the other way, leave the place where it is within its limits.
    for mimic in ('multiplier="1" offset="-0.05"', 'multiplier="-1" offset="0.05"'):
        motion = of_gantry(path, turn=hanging(), after=mimicking(limit, mimic))
        assert float(motion.position[:, 2].sub(0.05).abs().max()) < 1e-3


def test_the_simulator_plays_what_was_written(path):
    motion = time_scale(Lead(), arms_of(Lead()), path, same=True)
    assert replay_joints(Lead(), arms_of(Lead()), motion, HERE)
    still = replace(motion, position=motion.position[:1].expand(7, -1), velocity=torch.zeros_like(motion.velocity))
    assert not replay_joints(Lead(), arms_of(Lead()), still, HERE)


def test_the_simulator_keeps_to_the_times_of_the_file(path):
    step, limit = 1e-3 * Lead().frame_skip, 10.0
    slow = time_scale(Lead(), arms_of(Lead()), path, same=True, acceleration=limit)
    assert slow.slower > 2.0
    fast = replace(slow, time=slow.time / slow.slower, velocity=slow.velocity * slow.slower)
    torch.testing.assert_close(_sampled(fast, step), fast.position, rtol=0, atol=1e-12)
    played = _sampled(slow, step)
    assert len(played) == 1 + math.ceil(float(slow.time[-1]) / step - 1e-6)
    assert torch.equal(played[-1], slow.position[-1])
    # What controllers make of the points keeps within the limits, and so does what is played.
    assert float((played.diff(dim=0, n=2) / step**2)[:-1].abs().max()) < 1.001 * limit
    assert replay_joints(Lead(), arms_of(Lead()), slow, HERE)


def test_files_say_the_same():
    time = torch.tensor([0.0, 1.25], dtype=torch.float64)
    numbers = [torch.tensor([[a], [b]], dtype=torch.float64) for a, b in ((0.1, 0.2), (0.0, 0.5), (0.3, -0.3))]
    motion = JointMotion(("elbow",), time, *numbers, 2.0)
    rows = list(csv.DictReader(motion_text(motion, "csv", {}).splitlines()))
    assert rows[1] == {"time": "1.25", "elbow": "0.2", "elbow_velocity": "0.5"}
    plain = json.loads(motion_text(motion, "json", {"task": "lead"}))
    assert (plain["task"], plain["joints"], plain["position"]) == ("lead", ["elbow"], [[0.1], [0.2]])
    ros = json.loads(motion_text(motion, "ros2", {}))
    assert ros["joint_names"] == ["elbow"]
    assert ros["points"][1]["time_from_start"] == {"sec": 1, "nanosec": 250_000_000}
    assert ros["points"][1]["velocities"] == [0.5]


def test_the_command_writes_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys):
    monkeypatch.setitem(envs.TASKS, "lead", Lead)
    file = tmp_path / "trajectory.json"
    file.write_text(json.dumps({"task": "lead", "actions": actions()[:, :3].tolist()}))
    with pytest.raises(SystemExit) as done:
        app.main(["deploy", str(file), "--format", "ros2", "--dry-run", "--json"])
    assert done.value.code in (0, None)
    said = json.loads(capsys.readouterr().out)
    assert said["success"] and said["dry_run_success"] and said["points"] == 7
    written = json.loads((tmp_path / "joints-ros2.json").read_text())
    assert len(written["points"]) == 7 and math.isfinite(written["points"][3]["positions"][0])
    with pytest.raises(SystemExit) as done:
        app.main(["deploy", str(file), "--format", "yaml"])
    assert done.value.code == 2


def found(folder: Path, **choices: object) -> Path:
    """A trajectory of the task that was found in another way than the task says."""
    said = {"double": False, "execution": "compiled"} | choices
    file = folder / "trajectory.json"
    file.write_text(json.dumps({"task": "lead", "actions": actions()[:, :3].tolist(), "choices": said}))
    return file


def test_a_trajectory_is_deployed_as_it_was_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys):
    monkeypatch.setitem(envs.TASKS, "lead", Lead)
    fine = {"step": 0.002, "substeps": 1, "integrator": "implicit"}
    judged = {"reward": {"near": "-z(tool_0)"}, "success": "z(tool_0) > 10"}
    file = found(tmp_path, double=True, grasps=[6], fidelity=fine, reward=judged)
    task, what = _source(file)
    assert (task.grasps, task.arms.vertex, task.fidelity.text) == ((6,), (6,), "2ms/1/implicit")
    assert what.dtype == torch.float64
    with pytest.raises(SystemExit):
        app.main(["deploy", str(file), "--format", "json", "--json"])
    # Held at its other end, the rope is led 25 mm away; the reward's condition is never true.
    assert not json.loads(capsys.readouterr().out)["success"]
    written = json.loads((tmp_path / "joints-json.json").read_text())["position"]
    full = torch.tensor([[*row, 0.0] for row in written], dtype=torch.float64)
    tool = tool_pose(panda(base=Lead.arms.base[0]), full).pos
    start = torch.tensor(straight((0.0, 0.1, 0.05), 8, torch.zeros(1, 3))[0][6].tolist(), dtype=torch.float64)
    torch.testing.assert_close(tool[0], start, atol=1e-3, rtol=0)


def test_what_a_trajectory_was_found_with_is_given_or_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys):
    monkeypatch.setitem(envs.TASKS, "lead", Lead)
    for choices, said in (
        ({"rope": {"bend": 1e-3}}, "found for its own rope; give that one, or another, with --rope-model"),
        ({"part": {"from": "", "kept": [], "horizon": 6}}, "is a part of a task"),
    ):
        with pytest.raises(InputError, match=said):
            _source(found(tmp_path, **choices))
    rope = envs.RopeMaterial(line_density=0.05, bend=1e-4, damping=20.0)
    monkeypatch.setattr("torchdlo.scene_files.cable", lambda path: rope)
    assert _source(found(tmp_path, rope={"bend": 1e-3}), None, Path("model.json"))[0].rope == rope


def test_trajectories_of_other_scenes_are_not_compared_with_policies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(envs.TASKS, "lead", Lead)
    task = Lead()
    spec = PolicySpec(task_features(task), 3, task="lead", reach=task.max_translation, turns=3)
    save_policy(Policy(spec), tmp_path / "policy.pt")
    for choices, said in (({"grasps": [6]}, "other grasps"), ({"rope": {"bend": 1e-3}}, "another rope")):
        with pytest.raises(InputError, match=f"found with {said}"):
            _perturb([tmp_path], None, found(tmp_path, **choices), 1, 0, tmp_path, False)
        with pytest.raises(InputError, match=f"found with {said}"):
            make_demonstrator(task, str(tmp_path / "trajectory.json"))
