"""Pictures of running episodes: which cameras a task has, and what they see of a batch of its scenes."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchdlo.coupling.robot.robot_kinematics import Robot, panda
from torchdlo.envs.core.episode import Episode
from torchdlo.envs.observations.cameras import WRIST_EYE, WRIST_TARGET, TaskCamera, front_camera, wrist_names
from torchdlo.errors import InputError
from torchdlo.physics import tree
from torchdlo.scene import State
from torchdlo.vision.look import Look
from torchdlo.vision.renderer import ROPE, Images, Pinhole, Placement, RenderModel, intrinsics, looking_at, render
from torchdlo.vision.scene_geometry import arm_frame, model_of, placement_of

__all__ = ["CLOUD", "CameraRig", "camera_rig", "cameras_of", "placed", "render_cameras", "rope_points", "views"]

MARGIN = 0.35
"""How far the table goes on beyond arms and ropes [m]."""
NEARBY = 0.4
"""Bodies this near to ropes are in the picture of the camera in front [m]."""
CLOUD = 384
"""Points of a cloud."""


@dataclass(frozen=True, eq=False)
class CameraRig:
    """A scene with the cameras of its task, ready to draw."""

    model: RenderModel
    arms: tuple[Robot, ...]
    bases: Tensor
    """Where the arms stand [m], shape (R, 3)."""
    cameras: tuple[TaskCamera, ...]
    frames: tuple[int, ...]
    """Frame that each camera moves with."""
    own: Pinhole
    """The cameras in those frames, shape (C, ...)."""
    size: tuple[int, int]
    """Width and height of pictures [px]."""


@functools.cache
def _robot() -> Robot:
    return panda()


def cameras_of(episode: Episode) -> tuple[TaskCamera, ...]:
    """Return the cameras of a task: those that it declares, and where it declares none, front and one at each wrist."""
    task, start = episode.task, episode.start
    bases, tools = torch.tensor(task.arms.base), start.tool.pos[0].detach()
    front = next((camera for camera in task.cameras if camera.name == "front"), None)
    if front is None:
        things = [start.state.rods.pos[0]]
        solid = [k for k, body in enumerate(episode.scene.bodies) if body.shape != "plane"]
        if solid:
            at = tree.part(start.state.bodies).pos[0, solid]
            near = (at[:, None] - start.state.rods.pos[0]).norm(dim=-1).amin(-1) < NEARBY
            things.append(at[near])
        if start.state.material_points:
            things.append(start.state.material_points.pos[0])
        front = front_camera(bases, tools, torch.cat(things).detach())
    found = {front.name: front}
    for arm, name in enumerate(wrist_names(len(bases))):
        found[name] = TaskCamera(name, WRIST_EYE, WRIST_TARGET, opening=1.2, arm=arm)
    found |= {camera.name: camera for camera in task.cameras}
    return tuple(found[name] for name in ("front", *sorted((n for n in found if n != "front"), reverse=True)))


def camera_rig(
    episode: Episode, *, cameras: Sequence[str | TaskCamera] | None = None, size: int | tuple[int, int] = 128
) -> CameraRig:
    """Return a scene with its cameras, ready to draw.

    Args:
        episode: the episode, of a batch of any size.
        cameras: which ones, by name, or others; all of the task if not given.
        size: of the pictures [px]: of both sides, or width and height.
    """
    usual = {camera.name: camera for camera in cameras_of(episode)}
    chosen = []
    for camera in usual.values() if cameras is None else cameras:
        if not isinstance(camera, TaskCamera) and camera not in usual:
            raise InputError(f"cameras: there is no {camera!r}; {episode.task.name} has {', '.join(usual)}.")
        chosen.append(camera if isinstance(camera, TaskCamera) else usual[camera])
    if not chosen or len({c.name for c in chosen}) < len(chosen):
        raise InputError(f"cameras: given {[c.name for c in chosen]}; expected one or more, each once.")
    both = (size, size) if isinstance(size, int) else size
    if not isinstance(both, tuple) or len(both) != 2 or not all(isinstance(n, int) and 8 <= n <= 4096 for n in both):
        raise InputError(f"size: it is {size!r}; expected 8 to 4096 pixels, or a width and a height of so many.")
    width, height = both
    task, x = episode.task, episode.start.state.rods.pos[0].detach()
    arms, bases = (_robot(),) * task.arms.count, torch.tensor(task.arms.base)
    corners = torch.cat([bases[:, :2], x[:, :2].to(bases)])
    low, high = (corners.amin(0) - MARGIN).tolist(), (corners.amax(0) + MARGIN).tolist()
    fine = 0.02 if max(width, height) <= 160 else 0.014
    model = model_of(
        episode.scene, episode.params, arms=arms, low=(low[0], low[1]), high=(high[0], high[1]), spacing=fine
    )
    frames, parts = [], []
    for camera in chosen:
        if camera.arm is not None and not 0 <= camera.arm < len(arms):
            raise InputError(f"camera {camera.name}: it is on arm {camera.arm} of {len(arms)}; they count from 0.")
        frames.append(0 if camera.arm is None else arm_frame(episode.scene, arms, camera.arm, "hand"))
        up = looking_at(camera.eye, camera.target, size=(width, height), opening=camera.opening)
        if camera.arm is not None:
            # On a hand the picture's upper side is away from it.
            up = _upright(up, torch.tensor(camera.eye).double())
        parts.append(replace(up, intrinsics=intrinsics((width, height), camera.opening)))
    own = Pinhole(*(torch.stack([getattr(p, n) for p in parts]) for n in ("intrinsics", "rotation", "translation")))
    return CameraRig(model, arms, bases, tuple(chosen), tuple(frames), own, (width, height))


def _upright(view: Pinhole, eye: Tensor) -> Pinhole:
    """Return a camera turned about its axis so that the z axis of the hand, to the fingers, is up in its picture."""
    ahead = view.rotation[2]
    down = -torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    down = down - (down @ ahead) * ahead
    down = down / down.norm()
    rotation = torch.stack([torch.linalg.cross(down, ahead), down, ahead])
    return Pinhole(view.intrinsics, rotation, -rotation @ eye)


def placed(rig: CameraRig, state: State, joints: Tensor) -> tuple[Placement, Pinhole]:
    """Return where everything is in scenes, and where cameras are, shape (B, C, ...); joints are (B, R, J)."""
    with torch.no_grad():
        placement = placement_of(state, arms=rig.arms, joints=joints, bases=rig.bases)
        frames = list(rig.frames)
        turn, pos = placement.turn[:, frames].double(), placement.pos[:, frames].double()
        rotation = rig.own.rotation @ turn.transpose(-1, -2)
        shift = rig.own.translation - (rotation @ pos[..., None])[..., 0]
        matrix = rig.own.intrinsics.expand(*rotation.shape)
        return placement, Pinhole(matrix, rotation, shift)


def views(rig: CameraRig, state: State, joints: Tensor) -> Pinhole:
    """Return where cameras are in scenes, shape (B, C, ...); joints are (B, R, J) [rad or m]."""
    return placed(rig, state, joints)[1]


def render_cameras(
    rig: CameraRig,
    state: State,
    joints: Tensor,
    *,
    looks: Sequence[Look] = (Look(),),
    samples: int = 4,
    shadow: int = 512,
    rgb: bool = True,
    depth: bool = False,
    ids: bool = False,
) -> Images:
    """Return what all cameras of a rig see of a batch of scenes; nothing has a gradient.

    Args:
        rig: the cameras.
        state: states of the scenes, shape (B, ...).
        joints: joints of the arms [rad or m], shape (B, R, J).
        looks: what scenes look like: one for all, or one each.
        samples: per pixel, 1 or 4; other arguments as in `renderer.render`.
        shadow: texels of the map of shadows along each side.
        rgb: whether colours are wanted.
        depth: whether depths are.
        ids: whether masks are.
    """
    placement, view = placed(rig, state, joints)
    wanted = {"rgb": rgb, "depth": depth, "ids": ids}
    return render(rig.model, placement, view, rig.size, looks=looks, samples=samples, shadow=shadow, **wanted)


PointCloud = Callable[[Images, Pinhole], Tensor]
"""Makes points [m], shape (B, N, 3), of what cameras see: depths and masks (B, C, H, W), and where the cameras are."""


def rope_points(images: Images, view: Pinhole, *, count: int = CLOUD) -> Tensor:
    """Return points of the ropes that cameras see, evenly chosen among their pixels [m], shape (B, count, 3).

    Pixels that are chosen more than once fill up where there are fewer; zeros where there are none.
    """
    depth, ids = tree.part(images.depth), tree.part(images.ids)
    rope = (ids >= ROPE) & (ids < ROPE + 1000)
    height, width = depth.shape[-2:]
    y, x = torch.meshgrid(torch.arange(height).double(), torch.arange(width).double(), indexing="ij")
    matrix = view.intrinsics[..., None, None, :, :]
    across = (x - matrix[..., 0, 2]) / matrix[..., 0, 0]
    ray = torch.stack([across, (y - matrix[..., 1, 2]) / matrix[..., 1, 1], torch.ones_like(across)], -1)
    local = ray * torch.where(rope, depth, 0.0).double()[..., None] - view.translation[..., None, None, :]
    world = (local.flatten(-3, -2) @ view.rotation).flatten(1, 2)
    seen, found = rope.flatten(1), []
    for points, own in zip(world, seen, strict=True):
        inside = points[own]
        if not len(inside):
            found.append(points.new_zeros(count, 3))
            continue
        found.append(inside[torch.linspace(0, len(inside) - 1, count).round().long()])
    return torch.stack(found).float()
