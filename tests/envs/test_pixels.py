"""Cameras of tasks and what they add to observations."""

from __future__ import annotations

import dataclasses
import functools
import math

import pytest
import torch
from test_contract import small

from torchdlo import envs
from torchdlo.envs import TASKS
from torchdlo.envs.core import episode
from torchdlo.envs.observations.cameras import TaskCamera
from torchdlo.envs.observations.pixels import camera_rig, cameras_of, render_cameras, views
from torchdlo.errors import InputError
from torchdlo.vision.renderer import ARM, BODY, PARTICLES, ROPE, TABLE

pytest.importorskip("torchrl")

from torchrl.envs.utils import check_env_specs

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")

SIZE = 48


def made(name: str = "lifting", horizon: int = 2, **choices):
    choices = {"num_envs": 2, "execution": "eager", "seed": 0, "pixels": {"size": SIZE}} | choices
    return envs.make(small(name, horizon), **choices)


@functools.cache
def started(name: str) -> episode.Episode:
    return episode.prepare(envs.find(name), 1, execution="eager")


QUICK = ("coiling", "lifting", "wiring_post")


@pytest.mark.parametrize("name", [n if n in QUICK else pytest.param(n, marks=pytest.mark.slow) for n in TASKS])
def test_every_task_has_cameras_that_see_what_it_is_about(name: str):
    made = started(name)
    task, world = made.task, made.start
    names = [camera.name for camera in cameras_of(made)]
    assert names == ["front", "wrist_right", "wrist_left"][: 1 + task.arms.count]
    seen = render_cameras(camera_rig(made, size=96), world.state, world.joints, rgb=False, depth=True, ids=True)
    front, *wrists = seen.ids[0]
    wanted = {TABLE, *(ARM + k for k in range(task.arms.count))}
    wanted |= {ROPE + k for k in range(len(made.scene.topology.counts))}
    wanted |= {BODY + k for k, body in enumerate(made.scene.bodies) if body.motion == "free"}
    wanted |= {PARTICLES} if made.scene.material_points else set()
    assert wanted <= set(front.unique().tolist())
    for wrist in wrists:
        hand = float(((wrist >= ARM) & (wrist < ARM + 10)).float().mean())
        assert 0.02 < hand < 0.4  # the hand is seen, and another one beside it, but they do not fill the picture
        assert float((wrist == TABLE).float().mean()) > 0.2


def test_wrist_cameras_go_with_the_hand():
    made = started("lifting")
    rig, world = camera_rig(made, size=SIZE), made.start
    here = views(rig, world.state, world.joints)
    turned = world.joints.clone()
    turned[..., 6] += 0.5  # the last joint turns the hand about its own axis
    there = views(rig, world.state, turned)
    torch.testing.assert_close(here.rotation[:, 0], there.rotation[:, 0])
    for k, camera in enumerate(rig.cameras[1:], 1):
        places = [-(v.rotation[0, k].T @ v.translation[0, k]) for v in (here, there)]
        # 13.5 cm from the axis: the chord of half a radian.
        assert float((places[0] - places[1]).norm()) == pytest.approx(2 * 0.135 * 0.2474, rel=1e-3)
        # The tool is where the camera looks, 10.5 cm before the hand: 0.045 m beside its axis, nearly.
        tool = here.rotation[0, k] @ world.tool.pos[0, camera.arm].double() + here.translation[0, k]
        assert abs(float(tool[0])) < 1e-4 and float(tool[2]) > 0.1


def test_specs_say_what_pictures_are():
    check_env_specs(made())
    env = made(pixels={"size": (40, 24), "masks": True, "depth": True, "points": True, "looks": "random"})
    check_env_specs(env)
    td = env.reset()
    assert td["pixels", "front"].shape == (2, 24, 40, 3) and td["pixels", "front"].dtype == torch.uint8
    assert td["masks", "wrist_left"].shape == td["depth", "wrist_right"].shape == (2, 24, 40)
    assert td["points"].shape == (2, 384, 3)
    env = made(pixels={"size": 160, "cameras": ("front",), "pixels": False, "points": True})
    apart = torch.cdist(env.reset()["points"], env.world.state.rods.pos.float()).amin(-1)
    # Points are on the rope: 1 cm from its axis, whose vertices are 2 cm apart; a pixel is 7 mm wide.
    assert float(apart.max()) < math.hypot(0.01, 0.01) + 0.007 and float(apart.mean()) > 0.005


def test_pictures_are_drawn_only_when_they_are_asked_for():
    assert "pixels" not in made(pixels=False).reset()
    td = made(pixels={"size": SIZE, "cameras": ("front",)}).reset()
    assert list(td["pixels"].keys()) == ["front"]


def test_pictures_of_a_batch_are_those_of_its_scenes():
    env = made(num_envs=3)
    td = env.rollout(2, lambda td: td.set("action", torch.full((3, 12), 0.004)))["next"]
    rig, world = env._sensor.rig, env.world
    for b in range(3):
        own = episode.tree.map(lambda x, b=b: x[b : b + 1] if len(x) == 3 else x, world.state)
        seen = render_cameras(rig, own, world.joints[b : b + 1]).rgb[0]
        for k, camera in enumerate(rig.cameras):
            assert torch.equal(seen[k], td["pixels", camera.name][b, -1])
    assert not torch.equal(td["pixels", "front"][0], td["pixels", "front"][1])  # starts differ


def test_seeds_decide_looks_and_do_not_change_starts():
    def first(seed: int, **choices):
        return made(seed=seed, pixels={"size": SIZE, **choices}).reset()

    one, two, other = first(0, looks="random"), first(0, looks="random"), first(1, looks="random")
    assert torch.equal(one["pixels", "front"], two["pixels", "front"])
    assert not torch.equal(one["pixels", "front"], other["pixels", "front"])
    assert torch.equal(one["observation"], first(0)["observation"])
    assert torch.equal(one["observation"], made(seed=0, pixels=False).reset()["observation"])


def test_looks_are_drawn_again_for_scenes_that_begin_again():
    env = made(pixels={"size": SIZE, "looks": "random"}, variation=False)
    before, looks = env.reset(), env._looks
    td = before.clone().set("_reset", torch.tensor([[True], [False]]))
    env.reset(td)
    assert env._looks[0] != looks[0] and env._looks[1] == looks[1]


def test_tasks_may_have_cameras_of_their_own():
    made = started("coiling")
    top = TaskCamera("top", (0.0, 0.0, 1.5), (0.0, 0.1, 0.0))
    rig = camera_rig(made, cameras=("front", top), size=SIZE)
    assert [c.name for c in rig.cameras] == ["front", "top"]
    kind = type("Other", (type(made.task),), {"cameras": (top,)})
    other = dataclasses.replace(made, task=kind())
    assert {c.name for c in cameras_of(other)} == {"front", "wrist_right", "top"}


@pytest.mark.parametrize(
    ("pixels", "said"),
    [
        ({"size": 4}, "8 to 4096 pixels"),
        ({"size": "big"}, "8 to 4096 pixels"),
        ({"cameras": ("back",)}, "there is no 'back'; lifting has front, wrist_right, wrist_left"),
        ({"cameras": ()}, "expected one or more"),
        ({"colour": True}, "there is no choice colour"),
        ({"samples": 2}, "expected 1 or 4"),
        ({"looks": "wild"}, "expected 'usual' or 'random'"),
        ({"pixels": False}, "nothing is to be seen"),
    ],
)
def test_bad_choices_are_named(pixels: dict, said: str):
    from torchdlo.envs.observations.sensor import sensor_of

    with pytest.raises(InputError, match=said):
        sensor_of(started("lifting"), pixels)


def test_cameras_that_make_no_sense_are_named():
    with pytest.raises(InputError, match="a word of letters"):
        TaskCamera("../front", (0, 0, 1), (0, 0, 0))
    with pytest.raises(InputError, match="two different places"):
        TaskCamera("front", (0, 0, 1), (0, 0, 1))
