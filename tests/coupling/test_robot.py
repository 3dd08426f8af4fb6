"""Chains from URDF: poses, Jacobians, mimic joints, solids, and what wrong files are told."""

from __future__ import annotations

import math

import pytest
import torch

pytest.importorskip("pytorch_kinematics")

from torchdlo.coupling.robot import robot_kinematics as robot
from torchdlo.coupling.robot import urdf
from torchdlo.errors import InputError
from torchdlo.physics.linalg.rotation import rotate

pytestmark = pytest.mark.quick

F64 = torch.float64

# Craig's Denavit-Hartenberg parameters a, d, alpha of the Panda as its maker publishes them, with the flange last.
DH = [
    (0.0, 0.333, 0.0),
    (0.0, 0.0, -math.pi / 2),
    (0.0, 0.316, math.pi / 2),
    (0.0825, 0.0, math.pi / 2),
    (-0.0825, 0.384, -math.pi / 2),
    (0.0, 0.0, math.pi / 2),
    (0.088, 0.0, math.pi / 2),
    (0.0, 0.107, 0.0),
]

SLIDER = """<?xml version="1.0"?>
<robot name="slider">
  <link name="base"/><link name="arm"><visual><geometry><mesh filename="no.stl"/></geometry></visual></link>
  <link name="rail"><collision><geometry><sphere radius="0.1"/></geometry></collision></link><link name="twin"/>
  <joint name="turn" type="continuous"><parent link="base"/><child link="arm"/><axis xyz="0 0 2"/></joint>
  <joint name="slide" type="prismatic"><parent link="arm"/><child link="rail"/><axis xyz="1 0 0"/>
    <origin xyz="0 0 0.5" rpy="0.3 -0.2 0.5"/><limit lower="0" upper="0.2" velocity="1" effort="1"/></joint>
  <joint name="follow" type="prismatic"><parent link="rail"/><child link="twin"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="1" velocity="1" effort="1"/><mimic joint="slide" multiplier="-2" offset="0.05"/></joint>
  <transmission name="t"><actuator name="a"/></transmission>
  <gazebo reference="arm"><anything/></gazebo>
</robot>"""


def random_joints(arm: robot.Robot, *shape: int, seed: int = 0) -> torch.Tensor:
    share = torch.rand(*shape, len(arm.joints), generator=torch.Generator().manual_seed(seed), dtype=F64)
    return arm.lower + (arm.upper - arm.lower) * share


def dh(angles: list[float]) -> torch.Tensor:
    """Transform of the flange, from the textbook (Craig, Introduction to Robotics, eq. 3.6)."""
    whole = torch.eye(4, dtype=F64)
    for (a, d, alpha), theta in zip(DH, [*angles, 0.0], strict=True):
        ct, st, ca, sa = math.cos(theta), math.sin(theta), math.cos(alpha), math.sin(alpha)
        rows = [[ct, -st, 0, a], [st * ca, ct * ca, -sa, -sa * d], [st * sa, ct * sa, ca, ca * d], [0, 0, 0, 1]]
        whole = whole @ torch.tensor(rows, dtype=F64)
    return whole


def test_the_arm_has_the_published_geometry_and_limits():
    arm = robot.panda(base=(0.3, -0.4, 0.1))
    for q in random_joints(arm, 5):
        wanted = dh(q[:7].tolist())
        found = robot.transforms(arm, q)[arm.links.index("flange")]
        assert torch.allclose(found, wanted, atol=1e-14)
        tool = robot.tool_pose(arm, q)
        tip = wanted[:3, 3] + 0.105 * wanted[:3, 2] + torch.tensor([0.3, -0.4, 0.1], dtype=F64)
        assert torch.allclose(tool.pos, tip, atol=1e-14)
        assert torch.allclose(rotate(tool.quat, torch.tensor([0.0, 0, 1], dtype=F64)), wanted[:3, 2], atol=1e-14)
    assert arm.lower[:7].tolist() == [-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973]
    assert arm.upper[:7].tolist() == [2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973]
    assert arm.velocity[:7].tolist() == [2.175] * 4 + [2.61] * 3
    assert arm.arm == list(range(7))


def test_an_independent_reader_gives_the_same_poses():
    import pytorch_kinematics as pk

    arm = robot.panda()
    text = robot.resources.files("torchdlo").joinpath("data/robots/panda.urdf").read_text()
    bare = urdf.re.sub(r"<\?xml.*?\?>|<collision>.*?</collision>", "", text)
    chain = pk.build_serial_chain_from_urdf(bare, "tool").to(dtype=F64)
    q = random_joints(arm, 4)
    k = arm.links.index("tool")
    # It reads angles in single precision.
    assert torch.allclose(chain.forward_kinematics(q[:, :7]).get_matrix(), robot.transforms(arm, q)[:, k], atol=1e-6)


def test_both_fingers_open_by_one_number():
    arm = robot.panda()
    q = random_joints(arm, 1)[0]
    for opening in (0.0, 0.03):
        at = robot.poses(arm, torch.cat([q[:7], torch.tensor([opening], dtype=F64)]))
        left, right = (at.pos[arm.links.index(f"{side}_finger")] for side in ("left", "right"))
        assert float((left - right).norm()) == pytest.approx(2 * opening, abs=1e-12)


def test_limits_of_mimic_joints_bind_the_joint_that_they_follow():
    """The follower is at -2 q + 0.05, from -0.02 to 0.03, with |2 v| up to 1."""
    text = SLIDER.replace('lower="-1" upper="1"', 'lower="-0.02" upper="0.03"')
    made = robot.load_robot(text, tool="twin")
    assert (float(made.lower[1]), float(made.upper[1])) == pytest.approx((0.01, 0.035))
    assert float(made.velocity[1]) == 0.5
    # The other joint has none that mimics it, and wide limits bind nothing.
    assert not torch.isfinite(made.lower[0]) and robot.load_robot(SLIDER, tool="twin").upper[1] == 0.2
    with pytest.raises(InputError, match="'slide' and those that mimic it have limits that nowhere hold together"):
        robot.load_robot(text.replace('offset="0.05"', 'offset="-5"'), tool="twin")


def test_a_mimic_joint_follows_with_factor_and_offset():
    made = robot.load_robot(SLIDER, tool="twin")
    assert made.joints == ("turn", "slide")
    near, far = (robot.tool_pose(made, torch.tensor([0.4, s], dtype=F64)).pos for s in (0.0, 0.1))
    rail = torch.tensor([[0.0, 0.1], [-0.2, 0.0]], dtype=F64)
    # In the rail's frame the tool moves by 0.1 along x and by -2 x 0.1 along y.
    assert float((far - near).norm()) == pytest.approx(float(rail.norm()), rel=1e-12)
    start = robot.poses(made, torch.tensor([0.4, 0.0], dtype=F64)).pos
    assert float((start[-1] - start[-2]).norm()) == pytest.approx(0.05, rel=1e-12)


@pytest.mark.parametrize("make", [robot.panda, lambda: robot.load_robot(SLIDER, tool="twin")])
def test_the_jacobian_is_the_derivative_of_the_pose(make):
    arm = make()
    q = torch.tensor([0.4, 0.1], dtype=F64) if len(arm.joints) == 2 else random_joints(arm, 1)[0]
    whole = robot.jacobian(arm, robot.transforms(arm, q)) @ arm.mix
    moved = torch.autograd.functional.jacobian(lambda x: robot.tool_pose(arm, x).pos, q)
    assert torch.allclose(whole[:3], moved, atol=1e-12)

    def turned(x):
        matrix = robot.transforms(arm, x)[arm.links.index(arm.tool), :3, :3]
        spin = matrix @ matrix.detach().T
        return torch.stack([spin[2, 1] - spin[1, 2], spin[0, 2] - spin[2, 0], spin[1, 0] - spin[0, 1]]) / 2

    assert torch.allclose(whole[3:], torch.autograd.functional.jacobian(turned, q), atol=1e-12)


def test_poses_can_be_differentiated_twice():
    arm = robot.panda()
    q = random_joints(arm, 1).requires_grad_()
    assert torch.autograd.gradgradcheck(lambda x: robot.tool_pose(arm, x).pos, q, atol=1e-6)
    assert torch.autograd.gradcheck(lambda x: robot.tool_pose(arm, x).quat, q, atol=1e-6)


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_batches_equal_single_poses(dtype):
    arm = robot.panda(base=(0.1, 0.2, 0.3), base_quat=(0.6, 0.0, 0.0, 0.8))
    q = random_joints(arm, 3, 2).to(dtype)
    whole = robot.poses(arm, q)
    assert whole.pos.dtype == dtype and whole.pos.shape == (3, 2, len(arm.links), 3)
    one = robot.poses(arm, q[1, 1])
    assert torch.allclose(whole.pos[1, 1], one.pos, atol=10 * torch.finfo(dtype).eps)
    assert torch.allclose(whole.quat[1, 1].abs(), one.quat.abs(), atol=10 * torch.finfo(dtype).eps)


def test_every_collision_shape_is_a_solid_that_follows_its_link():
    arm = robot.panda()
    q = random_joints(arm, 2)
    solids, at = robot.solids(arm, q, mu_s=0.7), robot.body_targets(arm, q)
    assert len(solids) == len(arm.shapes) == at.pos.shape[-2] >= 10
    assert {s.shape for s in solids} <= {"box", "capsule", "sphere", "cylinder"}
    assert {s.motion for s in solids} == {"kinematic"} and solids[0].mu_s == 0.7
    # The finger's box reaches from its pad, in the plane between the fingers, to its back.
    k = [s.link for s in arm.shapes].index("left_finger")
    closed = torch.cat([q[:, :7], torch.zeros(2, 1, dtype=F64)], -1)
    box, hand = robot.body_targets(arm, closed), robot.poses(arm, closed)
    middle = box.pos[:, k] - hand.pos[:, arm.links.index("hand")]
    across = rotate(hand.quat[:, arm.links.index("hand")], torch.tensor([0.0, 1, 0], dtype=F64))
    assert torch.allclose((middle * across).sum(-1), torch.full((2,), arm.shapes[k].size[1], dtype=F64), atol=1e-12)


WRONG = {
    "cut": (SLIDER[:400], "not complete XML"),
    "not a robot": ("<world/>", "expected <robot>"),
    "no movable joint": (
        '<robot name="r"><link name="a"/><link name="b"/><joint name="j" type="fixed"><parent link="a"/>'
        '<child link="b"/></joint></robot>',
        "no joint moves",
    ),
    "unknown link": (SLIDER.replace('<child link="rail"/>', '<child link="rial"/>'), "did you mean 'rail'"),
    "unknown type": (SLIDER.replace("continuous", "helical"), "of type 'helical'; expected one of revolute"),
    "unknown mimic": (SLIDER.replace('joint="slide"', 'joint="slid"'), "did you mean 'slide'"),
    "a circle": (SLIDER.replace('<parent link="base"/>', '<parent link="twin"/>'), "do not make one tree"),
    "twice": (SLIDER.replace('<link name="twin"/>', '<link name="twin"/><link name="twin"/>'), "'twin' is there twice"),
    "limits": (SLIDER.replace('lower="0" upper="0.2"', 'lower="0.3" upper="0.2"'), "expected lower <= upper"),
    "not a number": (SLIDER.replace('xyz="0 0 0.5"', 'xyz="0 0 x"'), "expected 3 finite number"),
    "no axis": (SLIDER.replace('xyz="0 0 2"', 'xyz="0 0 0"'), "expected a direction"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_descriptions_are_refused_with_what_was_expected(case):
    text, sentence = WRONG[case]
    with pytest.raises(InputError, match=sentence):
        robot.load_robot(text)


def test_a_wrong_tool_or_file_is_refused(tmp_path):
    with pytest.raises(InputError, match="did you mean 'twin'"):
        robot.load_robot(SLIDER, tool="twinn")
    with pytest.raises(InputError, match="no joint moves the link 'base'"):
        robot.load_robot(SLIDER, tool="base")
    with pytest.raises(InputError, match="expected a URDF file, found none"):
        robot.load_robot(tmp_path / "no.urdf")
    with pytest.raises(ValueError, match=r"expected \(\.\.\., 8\)"):
        robot.poses(robot.panda(), torch.zeros(7))


def test_reading_is_silent(capfd):
    robot.load_robot(SLIDER, tool="twin")
    robot.panda()
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    "fixed",
    [
        '<axis xyz="0 0 0"/>',
        '<axis xyz="0 0 0"/><limit lower="1" upper="-1" velocity="0" effort="0"/>',
        "<axis/>",
        '<limit effort="0"/>',
    ],
)
def test_what_means_nothing_on_a_fixed_joint_is_passed_over(fixed):
    box = '<collision><geometry><box size="0 0 0"/></geometry></collision>'
    text = (
        f'<robot name="r"><link name="a">{box}</link><link name="b"/><link name="c"/>'
        f'<joint name="f" type="fixed"><parent link="a"/><child link="b"/>{fixed}</joint>'
        '<joint name="m" type="revolute"><parent link="b"/><child link="c"/><axis xyz="0 0 2"/>'
        '<limit lower="-1" upper="1" velocity="1" effort="1"/></joint></robot>'
    )
    found = urdf.read_urdf(text)
    assert [j.kind for j in found.joints] == ["fixed", "revolute"] and found.shapes == ()
    assert found.joints[1].axis == (0.0, 0.0, 1.0)
    with pytest.raises(InputError, match="axis 0 0 0"):
        urdf.read_urdf(text.replace("0 0 2", "0 0 0"))
