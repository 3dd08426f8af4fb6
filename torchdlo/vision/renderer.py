"""Pictures of scenes for data sets: colours, depths and masks, several cameras at once, without a graphics processor.

Triangles go into a z-buffer with one or four samples per pixel, each surface in a pixel is shaded once, and the key
light casts soft shadows. It is done by `renderer.cpp`, or in array operations where no compiler is at hand; nothing has
a gradient. The same input makes the same bytes, whatever the batch and the number of threads.

Cameras are those of OpenCV without distortion: x right, y down, z forward, pixel (0, 0) is the centre of the one at the
top left.
"""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from torchdlo.errors import InputError
from torchdlo.physics.kernels import native
from torchdlo.vision.look import Look, Paint
from torchdlo.vision.surfaces import Surface

__all__ = [
    "ARM",
    "BODY",
    "NOTHING",
    "PARTICLES",
    "ROPE",
    "TABLE",
    "Images",
    "Piece",
    "Pinhole",
    "Placement",
    "RenderModel",
    "RendererView",
    "looking_at",
    "render",
    "shifted_cameras",
]

NOTHING, TABLE, ROPE, BODY, ARM, PARTICLES = 0, 1, 1000, 2000, 3000, 4000
"""Numbers in masks: of what is behind all else, of tables and floors; those of the first rope, the first body, the
first arm and the first group of particles; others count on from there."""


@dataclass(frozen=True, eq=False)
class Piece:
    """A rigid surface that is drawn."""

    surface: Surface
    """In the frame that it moves with."""
    id: int
    """Its number in masks."""
    paint: str
    """Which paint of a `Look` it has: "table", "bodies", "shells", "joints" or "fingers"."""
    number: int = 0
    """Which of several paints."""
    frame: int = 0
    """Number of the frame that it moves with; 0 is the world."""
    shadow: bool = True
    """Whether it casts shadows."""


@dataclass(frozen=True, eq=False)
class RenderModel:
    """What there is to see in a scene; it does not change."""

    pieces: tuple[Piece, ...] = ()
    counts: tuple[int, ...] = ()
    """Vertices of each rope."""
    closed: tuple[bool, ...] = ()
    """Whether each rope is a loop."""
    radius: np.ndarray = field(default_factory=lambda: np.zeros(0))
    """Radii of the ropes at their vertices [m], shape (V,)."""
    particle_radius: np.ndarray = field(default_factory=lambda: np.zeros(0))
    """Radii of the balls that stand for particles [m], shape (M,)."""
    particle_group: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    """Group of each particle, whole, shape (M,)."""
    floor_height: float = -0.75
    """Height of the floor of the room, far below [m]."""


@dataclass(frozen=True, eq=False)
class Placement:
    """Where everything is, scenes of a batch first."""

    pos: Tensor
    """Origins of the frames, the world first [m], shape (B, F, 3)."""
    turn: Tensor
    """Rotation matrices of the frames, to the world [1], shape (B, F, 3, 3)."""
    ropes: Tensor
    """Vertices of all ropes [m], shape (B, V, 3)."""
    particles: Tensor
    """Particles [m], shape (B, M, 3)."""


class RendererView(Protocol):
    """What the renderer reads of cameras, with leading axes (C,) or (B, C)."""

    @property
    def intrinsics(self) -> Tensor:
        """Camera matrices [px], shape (..., 3, 3)."""
        ...

    @property
    def rotation(self) -> Tensor:
        """World to camera [1], shape (..., 3, 3)."""
        ...

    @property
    def translation(self) -> Tensor:
        """World to camera [m], shape (..., 3)."""
        ...


@dataclass(frozen=True, eq=False)
class Pinhole:
    """Cameras as tensors, see `RendererView`."""

    intrinsics: Tensor
    rotation: Tensor
    translation: Tensor


@dataclass(frozen=True, eq=False)
class Images:
    """What cameras see."""

    rgb: Tensor | None
    """Colours, uint8, shape (B, C, H, W, 3); None if not asked for."""
    depth: Tensor | None
    """Depths along z of the camera, infinite where there is nothing [m], float32, shape (B, C, H, W)."""
    ids: Tensor | None
    """Numbers of what is seen, see `TABLE` and the others [-], int16, shape (B, C, H, W)."""


def looking_at(
    eye: Sequence[float], target: Sequence[float], *, size: tuple[int, int], opening: float = 0.8, roll: float = 0.0
) -> Pinhole:
    """Return one camera, with no leading axes, in whose pictures the world's z is up.

    Args:
        eye: where it is [m].
        target: what is in the middle of its picture [m].
        size: width and height of the picture [px].
        opening: angle that its picture covers from top to bottom [rad].
        roll: by how much it is turned about its axis [rad].
    """
    place = torch.as_tensor(eye, dtype=torch.float64)
    ahead = torch.as_tensor(target, dtype=torch.float64) - place
    ahead = ahead / ahead.norm()
    up = torch.tensor([0.0, 0.0, 1.0] if abs(float(ahead[2])) < 0.999 else [0.0, 1.0, 0.0], dtype=torch.float64)
    right = torch.linalg.cross(ahead, up)
    right = right / right.norm()
    down = torch.linalg.cross(ahead, right)
    turn = torch.tensor(roll, dtype=torch.float64)
    across, along = turn.cos() * right + turn.sin() * down, turn.cos() * down - turn.sin() * right
    rotation = torch.stack([across, along, ahead])
    return Pinhole(intrinsics(size, opening), rotation, -rotation @ place)


def intrinsics(size: tuple[int, int], opening: float) -> Tensor:
    """Return the matrix of a camera whose picture covers an angle from top to bottom [rad], shape (3, 3)."""
    width, height = size
    focal = 0.5 * height / float(np.tan(0.5 * opening))
    rows = [[focal, 0.0, 0.5 * (width - 1)], [0.0, focal, 0.5 * (height - 1)], [0.0, 0.0, 1.0]]
    return torch.tensor(rows, dtype=torch.float64)


def shifted_cameras(view: RendererView, looks: Sequence[Look]) -> Pinhole:
    """Return the cameras of scenes, (C,) or (B, C), turned, moved and zoomed as looks say, (B, C)."""
    lead = torch.broadcast_shapes(view.rotation.shape[:-2], view.intrinsics.shape[:-2], view.translation.shape[:-1])
    count, batch = lead[-1], len(looks)
    matrix, turn = (x.expand(batch, count, 3, 3).double() for x in (view.intrinsics, view.rotation))
    shift = view.translation.expand(batch, count, 3).double()
    if not any(look.aside for look in looks):
        return Pinhole(matrix, turn, shift)
    none = (0.0,) * 7
    rows = [[look.aside[c % len(look.aside)] if look.aside else none for c in range(count)] for look in looks]
    off = torch.tensor(rows, dtype=torch.float64)
    zeros = torch.zeros_like(off[..., 0])
    x, y, z = off[..., :3].unbind(-1)
    cross = torch.stack([zeros, -z, y, z, zeros, -x, -y, x, zeros], -1).unflatten(-1, (3, 3))
    turned = torch.linalg.matrix_exp(cross)
    zoom = torch.ones(batch, count, 3, 3, dtype=torch.float64)
    zoom[..., :2, :2] = off[..., 6].exp()[..., None, None]
    return Pinhole(matrix * zoom, turned @ turn, (turned @ shift[..., None])[..., 0] + off[..., 3:6])


class _Call(ctypes.Structure):
    _fields_ = (
        *((n, ctypes.c_int64) for n in ("batch", "cameras", "width", "height", "samples")),
        *((n, ctypes.c_int64) for n in ("vertices", "faces", "pieces", "ropes", "slots", "particles", "groups")),
        *((n, ctypes.c_int64) for n in ("shadow", "detail")),
        *((n, ctypes.c_void_p) for n in ("vertex", "normal", "face", "piece_vertex", "piece_face", "piece_flags")),
        *((n, ctypes.c_void_p) for n in ("piece_id", "piece_sphere", "piece_pose", "piece_material")),
        *((n, ctypes.c_void_p) for n in ("rope_start", "rope_closed", "rope_id", "rope_pos", "rope_radius")),
        *((n, ctypes.c_void_p) for n in ("rope_material", "particle_pos", "particle_radius", "particle_group")),
        *((n, ctypes.c_void_p) for n in ("group_id", "group_material", "camera", "light", "rgb", "depth", "ids")),
    )


@functools.cache
def _library() -> ctypes.CDLL | None:
    source = Path(__file__).with_name("renderer.cpp")
    # Products and sums are rounded one by one, so that bytes do not depend on the processor.
    found = native.library(source, "-fno-math-errno", "-fno-trapping-math", "-ffp-contract=off")
    if found is not None:
        found.render.argtypes, found.render.restype = (ctypes.c_void_p, ctypes.c_int), None
    return found


@functools.lru_cache(maxsize=64)
def pack_model(model: RenderModel) -> dict[str, np.ndarray]:
    """Return a model as the renderer reads it."""
    pieces = model.pieces
    vertices = [len(p.surface.vertices) for p in pieces]
    starts = np.cumsum([0, *vertices])
    empty = np.zeros((0, 3))
    balls = []
    for p in pieces:
        x = p.surface.vertices
        middle = 0.5 * (x.min(0) + x.max(0))
        balls.append([*middle, np.linalg.norm(x - middle, axis=1).max()])
    groups = int(model.particle_group.max()) + 1 if len(model.particle_group) else 0
    found = {
        "vertex": np.concatenate([empty, *(p.surface.vertices for p in pieces)]).astype(np.float32),
        "normal": np.concatenate([empty, *(p.surface.normals for p in pieces)]).astype(np.float32),
        "face": np.concatenate([empty, *(p.surface.faces + s for p, s in zip(pieces, starts, strict=False))]),
        "piece_vertex": starts,
        "piece_face": np.cumsum([0, *(len(p.surface.faces) for p in pieces)]),
        "piece_flags": np.array([int(p.shadow) for p in pieces]),
        "piece_sphere": np.array(balls).reshape(-1, 4).astype(np.float32),
        "rope_start": np.cumsum([0, *model.counts]),
        "rope_closed": np.array(model.closed),
        "rope_radius": np.asarray(model.radius).astype(np.float32),
        "particle_radius": np.asarray(model.particle_radius).astype(np.float32),
        "particle_group": np.asarray(model.particle_group),
    }
    numbers = {
        "piece_id": [p.id for p in pieces],
        "rope_id": [ROPE + k for k in range(len(model.counts))],
        "group_id": [PARTICLES + k for k in range(groups)],
    }
    found = {k: v if v.dtype == np.float32 else v.astype(np.int32) for k, v in found.items()}
    found |= {k: np.array(v).astype(np.int16) for k, v in numbers.items()}
    return {k: np.ascontiguousarray(v) for k, v in found.items()}


@functools.lru_cache(maxsize=4096)
def _painted(model: RenderModel, look: Look) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return materials of pieces, ropes and groups of particles, (n, 12) each, and lights (32,)."""

    def paint(piece: Piece) -> Paint:
        found = getattr(look, piece.paint)
        return found if isinstance(found, Paint) else found[piece.number % len(found)]

    groups = len(pack_model(model)["group_id"])
    kinds = (
        [paint(p) for p in model.pieces],
        [look.ropes[k % len(look.ropes)] for k in range(len(model.counts))],
        [look.particles[k % len(look.particles)] for k in range(groups)],
    )
    pieces, ropes, grains = (np.array([p.numbers() for p in kind], np.float32).reshape(-1, 12) for kind in kinds)
    return pieces, ropes, grains, np.array(look.lights(model.floor_height), np.float32)


def renderer_inputs(
    model: RenderModel, placement: Placement, view: RendererView, looks: Sequence[Look], size: tuple[int, int]
) -> dict[str, np.ndarray]:
    """Return everything as the renderer reads it, scenes of a batch first."""
    batch = len(placement.ropes)
    if len(looks) not in (1, batch):
        raise InputError(f"render: {len(looks)} looks for {batch} scenes; expected one, or one for each.")
    looks = list(looks) * (batch if len(looks) == 1 else 1)
    if placement.ropes.shape[1] != sum(model.counts) or placement.particles.shape[1] != len(model.particle_radius):
        raise InputError(
            f"render: {placement.ropes.shape[1]} vertices and {placement.particles.shape[1]} particles; the model has "
            f"{sum(model.counts)} and {len(model.particle_radius)}: give a placement that was made with the model."
        )
    frames = [p.frame for p in model.pieces]
    pose = torch.cat([placement.turn[:, frames].flatten(-2), placement.pos[:, frames]], -1)
    eye = shifted_cameras(view, looks)
    matrix = eye.intrinsics
    focal = torch.stack([matrix[..., 0, 0], matrix[..., 1, 1], matrix[..., 0, 2], matrix[..., 1, 2]], -1)
    camera = torch.cat([focal, eye.rotation.flatten(-2), eye.translation], -1)
    paints = [np.stack(rows) for rows in zip(*(_painted(model, look) for look in looks), strict=True)]
    moving = {
        "piece_pose": pose,
        "rope_pos": placement.ropes,
        "particle_pos": placement.particles,
        "camera": camera,
    }
    found = {k: np.ascontiguousarray(v.detach().cpu().numpy().astype(np.float32)) for k, v in moving.items()}
    painted = dict(zip(("piece_material", "rope_material", "group_material", "light"), paints, strict=True))
    return pack_model(model) | found | painted


def render(
    model: RenderModel,
    placement: Placement,
    view: RendererView,
    size: tuple[int, int],
    *,
    looks: Sequence[Look] = (Look(),),
    samples: int = 4,
    shadow: int = 512,
    detail: bool = True,
    rgb: bool = True,
    depth: bool = False,
    ids: bool = False,
) -> Images:
    """Return what cameras see of a batch of scenes, on the CPU.

    Args:
        model: what there is to see.
        placement: where it is.
        view: the cameras, leading axes (C,) for the same ones in all scenes, or (B, C).
        size: width and height of the pictures [px].
        looks: what scenes look like: one for all, or one each.
        samples: per pixel, 1 or 4.
        shadow: texels of the map of shadows along each side, 0 for no shadows.
        detail: whether tubes of ropes are coarser where they are small in a picture.
        rgb: whether colours are wanted.
        depth: whether depths are; with 4 samples the harmonic mean of those of what `ids` says.
        ids: whether masks are; with 4 samples a pixel shows what most samples see.
    """
    width, height = size
    if samples not in (1, 4):
        raise InputError(f"render: samples is {samples}; expected 1 or 4 per pixel.")
    if not (0 < width <= 4096 and 0 < height <= 4096 and 0 <= shadow <= 8192):
        raise InputError(
            f"render: size is {width} x {height} and shadow {shadow}; expected 1 to 4096 pixels, and 0 to 8192 texels."
        )
    given = renderer_inputs(model, placement, view, looks, size)
    batch, count = given["camera"].shape[:2]
    shape = (batch, count, height, width)
    out = {
        "rgb": np.empty((*shape, 3), np.uint8) if rgb else None,
        "depth": np.empty(shape, np.float32) if depth else None,
        "ids": np.empty(shape, np.int16) if ids else None,
    }
    settings = {"width": width, "height": height, "samples": samples, "shadow": shadow, "detail": int(detail)}
    library = _library()
    if library is None:
        from torchdlo.vision.renderer_reference import draw

        draw(given, settings, out)
    else:
        call = _Call(batch=batch, cameras=count, **settings, **_counts(given))
        for name, value in {**given, **out}.items():
            setattr(call, name, None if value is None else value.ctypes.data)
        library.render(ctypes.addressof(call), torch.get_num_threads())
    return Images(*(None if x is None else torch.from_numpy(x) for x in out.values()))


def _counts(given: dict[str, np.ndarray]) -> dict[str, int]:
    """Return how many there are of everything."""
    return {
        "vertices": len(given["vertex"]),
        "faces": len(given["face"]),
        "pieces": len(given["piece_id"]),
        "ropes": len(given["rope_id"]),
        "slots": len(given["rope_radius"]),
        "particles": len(given["particle_radius"]),
        "groups": len(given["group_id"]),
    }
