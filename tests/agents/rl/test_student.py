"""Students that see clouds: what they see, whatever its order, and that they learn what their teachers do."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

pytest.importorskip("torchrl")
pytest.importorskip("kornia")

from lead import Lead

from torchdlo import envs
from torchdlo.agents.policies import CloudPolicy, CloudSpec, load_policy
from torchdlo.agents.policies.policy_files import save_policy
from torchdlo.agents.rl.episodes import TaskEpisodes
from torchdlo.agents.rl.student import DepthCamera, Student, _Eyes, cloud_spec, judge_student, teach
from torchdlo.errors import InputError

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")


class Teacher:
    """Leads the tool to y = 0.125, by what it sees of the rope's second vertex."""

    def features(self, observation, progress, start=None):
        return observation[:, 3:6]

    def mean(self, x):
        way = torch.stack([0 * x[:, 1], 0.125 - x[:, 1], 0 * x[:, 1]], -1) / 0.01
        return way.clamp(-1, 1)


def test_the_order_of_points_does_not_matter():
    policy = CloudPolicy(CloudSpec((0.0, 0.0, 0.0), ((0.1, 0.0, 0.0),)))
    cloud, tool, share = torch.randn(2, 20, 3), torch.randn(2, 1, 3), torch.rand(2, 1)
    one = policy(cloud, tool, tool, share)
    torch.testing.assert_close(one, policy(cloud.flip(1), tool, tool, share))
    assert not torch.allclose(one, policy(cloud + 0.05, tool, tool, share), atol=1e-6)
    assert policy.command(one).shape == (2, 6) and not policy.command(one)[:, 3:].any()


def test_clouds_lie_on_the_rope_wherever_the_camera_is():
    episodes = TaskEpisodes(Lead(), 3)
    episodes.reset()
    x = episodes.env.world.state.rods.pos
    for camera in (DepthCamera(noise=0.0, size=256), DepthCamera(noise=0.0, shift=0.1, size=256)):
        cloud = _Eyes(episodes, camera, torch.Generator().manual_seed(0)).see(episodes)
        assert cloud.shape == (3, 384, 3)
        assert float(torch.cdist(cloud, x).amin(-1).max()) < 0.015  # half an edge, and a pixel
    believed = _Eyes(episodes, DepthCamera(noise=0.0, shift=0.0, error=0.02), torch.Generator().manual_seed(0))
    exact = _Eyes(episodes, DepthCamera(noise=0.0, shift=0.0), torch.Generator().manual_seed(0))
    off = believed.see(episodes).mean(1) - exact.see(episodes).mean(1)
    assert float((off - believed.off[:, 0]).abs().max()) < 2e-3


def test_clouds_show_the_surfaces_of_what_is_fixed_beside_the_rope():
    task = envs.find("wiring_post")
    episodes = TaskEpisodes(task, 2)
    episodes.reset()
    assert cloud_spec(task).fixtures and not cloud_spec(envs.find("unknotting")).fixtures
    camera, random = DepthCamera(noise=0.0, size=256), torch.Generator().manual_seed(0)
    cloud = _Eyes(episodes, camera, random, fixtures=True).see(episodes)
    assert cloud.shape == (2, 384, 4)
    state, sizes = episodes.env.world.state, episodes.env.episode.params.bodies.size
    for b, (points, fixed) in enumerate(zip(cloud[..., :3], cloud[..., 3] == 1, strict=True)):
        assert 0 < fixed.sum() <= 96
        assert float(torch.cdist(points[~fixed], state.rods.pos[b]).amin(-1).max()) < 0.015
        at = points[fixed][:, None] - state.bodies.pos[b]
        radius, half = sizes.reshape(-1, len(at[0]), 3)[0, :, :2].unbind(-1)
        # Posts are upright cylinders: beside or on top, a millimetre for how they are drawn.
        beside, above = at[..., :2].norm(dim=-1) - radius, at[..., 2].abs() - half
        assert float(torch.maximum(beside, above).abs().amin(-1).max()) < 1e-3


def test_a_policy_that_sees_fixtures_tells_them_from_the_rope(tmp_path: Path):
    policy = CloudPolicy(CloudSpec((0.0, 0.0, 0.0), ((0.1, 0.0, 0.0),), fixtures=True))
    cloud, tool, share = torch.randn(2, 20, 4), torch.randn(2, 1, 3), torch.rand(2, 1)
    other = torch.cat([cloud[..., :3], 1 - cloud[..., 3:]], -1)
    one = policy(cloud, tool, tool, share)
    assert not torch.allclose(one, policy(other, tool, tool, share), atol=1e-6)
    save_policy(policy, tmp_path / "policy.pt")
    assert torch.equal(load_policy(tmp_path)(cloud, tool, tool, share), one)
    # Files from before clouds had fixtures do not say that they have.
    plain = policy.spec.plain()
    del plain["fixtures"]
    assert not CloudSpec.of(plain).fixtures


@pytest.mark.slow
def test_a_student_learns_what_its_teacher_does_and_goes_on_after_a_stop(tmp_path: Path):
    plan = Student(rounds=1, final=1, count=8, updates=100, subset=32)
    student, notes = teach(Lead(), Teacher(), folder=tmp_path, plan=plan)
    assert [row["fidelity"] for row in notes["log"]] == ["1ms/2", "1ms/2", "1ms/5"]
    assert notes["log"][0]["success"] == 1 and notes["episodes"] == 24
    judged = judge_student(student, Lead(), starts=8, conditions=("usual",))["conditions"]["usual"]
    assert judged["success"] >= 0.75

    class Stop(Exception):
        pass

    def stop(_: str, done: int, *__: object) -> None:
        if done == 2:
            raise Stop

    other = tmp_path / "other"
    with pytest.raises(Stop):
        teach(Lead(), Teacher(), folder=other, plan=plan, callback=stop)
    again, _ = teach(Lead(), Teacher(), folder=other, plan=plan, resume=True)
    assert all(torch.equal(a, b) for a, b in zip(student.parameters(), again.parameters(), strict=True))
    read = load_policy(tmp_path)
    assert isinstance(read, CloudPolicy) and read.spec == cloud_spec(Lead())
    assert torch.equal(read.all[0].weight, student.all[0].weight)


def test_going_on_with_another_plan_or_teacher_is_refused(tmp_path: Path):
    plan = Student(rounds=1, final=0, count=1, updates=1, subset=8, camera=DepthCamera(size=32, count=16))

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        teach(Lead(), Teacher(), folder=tmp_path, plan=plan, callback=stop)

    class Other(Teacher):
        def state_dict(self):
            return {"weight": torch.ones(2)}

    for teacher, changes, said in (
        (Teacher(), {"seed": 3}, r"seed 0 \(now 3\)"),
        (Teacher(), {"noise": 0.5}, r"noise 0.001 \(now 0.5\)"),
        (Other(), {}, "another teacher"),
    ):
        with pytest.raises(InputError, match=f"student.part: it belongs to a run with {said}; give the same"):
            teach(Lead(), teacher, folder=tmp_path, plan=replace(plan, **changes), resume=True)
    _, notes = teach(Lead(), Teacher(), folder=tmp_path, plan=plan, resume=True)
    assert len(notes["log"]) == 2
