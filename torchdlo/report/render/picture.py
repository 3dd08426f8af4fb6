"""Pictures of a run in three dimensions, drawn without a display: a fixed camera that sees all of the motion."""

from __future__ import annotations

import ctypes.util
import io
import os
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from scipy.ndimage import gaussian_filter

from torchdlo.errors import InputError
from torchdlo.physics import tree
from torchdlo.report.render.run_surfaces import COLORS, DrawnSurface, bounds, extent, pieces, points_of, spacing
from torchdlo.scene_files.run import Frames
from torchdlo.vision import renderer as vision
from torchdlo.vision.surfaces import smoothed

__all__ = ["ANGLE", "Picture", "camera_of", "check_renderer", "drawing", "stills_png"]

ANGLE = 30.0
"""Opening of the camera, from top to bottom [deg]."""


def check_renderer(*, photo: bool = False) -> Any:
    """Return the renderer, or say what is missing for it, or for photographs."""
    if photo:
        from torchdlo.report.render.photo import check_photo

        return check_photo()
    try:
        import pyvista
        import vtk
    except ImportError:
        raise InputError("pictures need the package pyvista; install it with pip install 'torchdlo[view]'.") from None
    # Without any of these the renderer would end the process.
    if not any(map(ctypes.util.find_library, ("EGL", "OSMesa"))) and not os.environ.get("DISPLAY"):
        raise InputError(
            "pictures need a library that draws without a display, libEGL or libOSMesa, and none is there; install "
            "one, e.g. with apt install libegl1 libgl1-mesa-dri."
        )
    # That there is no display is no news.
    vtk.vtkLogger.SetStderrVerbosity(vtk.vtkLogger.VERBOSITY_OFF)
    return pyvista


def _shade(mesh: Any, faces: np.ndarray) -> None:
    """Put normals on the corners: means of those of the triangles round them, by their areas."""
    a, b, c = (mesh.points[faces[:, k]] for k in range(3))
    across = np.cross(b - a, c - a)
    at, count = faces.T.reshape(-1), len(mesh.points)
    normals = np.stack([np.bincount(at, np.tile(across[:, k], 3), count) for k in range(3)], -1)
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    mesh.point_data.active_normals = normals


def camera_of(frames: Frames, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return place and target [m] of the camera that sees the whole motion, and what is up in its picture.

    Args:
        frames: the run.
        size: width and height of the picture.
    """
    low, high = bounds(frames)
    ahead = -np.asarray(frames.camera_direction, float)
    ahead = ahead / np.linalg.norm(ahead)
    up = np.array([0.0, 0.0, 1.0]) if abs(ahead[2]) < 0.99 else np.array([0.0, 1.0, 0.0])
    right = np.cross(ahead, up)
    right = right / np.linalg.norm(right)
    up = np.cross(right, ahead)
    tall = np.tan(np.radians(ANGLE / 2))
    wide = tall * size[0] / size[1]
    middle = 0.5 * (low + high)
    seen = extent(frames)
    for _ in range(4):
        # The least distance at which all points are within the picture; then aim at the middle of what is seen.
        x, y, z = ((seen - middle) @ axis for axis in (right, up, ahead))
        away = max(np.max(np.abs(x) / wide - z), np.max(np.abs(y) / tall - z), 1e-3)
        shift = [away * 0.5 * np.add(*np.percentile(v / (away + z), [0, 100])) for v in (x, y)]
        middle = middle + shift[0] * right + shift[1] * up
    return middle - 1.1 * away * ahead, middle, up


def _level(frames: Frames, piece: DrawnSurface) -> bool:
    """Return whether a plane is level, and stays where it is."""
    pos, turn = piece.pose(frames, 0)
    again = piece.pose(frames, len(frames.time) - 1)
    return bool(turn[2, 2] > 0.9999 and np.allclose(pos, again[0]))


_TEXELS, _LAMP = 384, (-0.5, -0.35, 1.0)
"""Texels of the floor along each side, and the direction to the lamp that casts shadows on it."""


class _Floor:
    """A level floor with the soft shadow of everything on it, as its texture."""

    def __init__(
        self, pv: Any, plotter: Any, frames: Frames, pieces: Sequence[DrawnSurface], low: np.ndarray, high: np.ndarray
    ) -> None:
        planes = [p for p in pieces if p.kind == "body" and frames.body_shape[p.slots[0]] == "plane"]
        flat = [float(p.pose(frames, 0)[0][2]) for p in planes if _level(frames, p)]
        span = float(np.linalg.norm(high - low))
        # Without a table, a floor is a little below all else.
        heights = [*map(float, frames.table), *flat] or ([] if planes else [float(low[2]) - 0.05 * span])
        self._shadow, self._texture, self._pv = None, None, pv
        for height in heights[:1]:
            self._reach, middle = 1.5 * span, 0.5 * (low + high)
            ground = pv.Plane(center=(*middle[:2], height), i_size=2 * self._reach, j_size=2 * self._reach)
            self._shadow = floor_shadow(frames, pieces, (*middle[:2], height), self._reach)
            self._texture = pv.Texture(np.full((_TEXELS, _TEXELS, 3), 235, np.uint8))
            self._texture.interpolate = True
            plotter.add_mesh(ground, texture=self._texture, ambient=0.35, diffuse=0.8, specular=0.0)
            self._color = np.array(pv.Color(COLORS["table"]).int_rgb[:3], float)

    def show(self, k: int) -> None:
        """Show the shadows of frame k."""
        if self._shadow is None or self._texture is None:
            return
        dark = 1 - 0.42 * self._shadow(k)[..., None]
        image = (self._color * dark).astype(np.uint8)
        self._texture.SetInputDataObject(self._pv.Texture(image).GetInput())


def floor_shadow(
    frames: Frames, pieces: Sequence[DrawnSurface], middle: tuple[float, float, float], reach: float
) -> Callable[[int], np.ndarray]:
    """Return what makes the shadow on a square floor at a frame: 0 to 1, rows from +y to -y, shape (384, 384).

    The lamp is a camera that looks straight down, whose picture plane is the floor: what it sees of things is their
    shadow. It is far away; edges are softened by the same width everywhere.
    """
    planes = [k for k, shape in enumerate(frames.body_shape) if shape == "plane"]
    solids = [p for p in pieces if p.kind == "weight" or (p.kind == "body" and p.slots[0] not in planes)]
    ropes = [p for p in pieces if p.kind == "rope"]
    made = tuple(
        vision.Piece(smoothed(tree.part(p.corners), p.faces), vision.BODY, "bodies", frame=1 + k)
        for k, p in enumerate(solids)
    )
    grains = frames.material_points[:, :: max(1, frames.material_points.shape[1] // 20_000)]
    slots = np.concatenate([np.zeros(0, int), *(p.slots for p in ropes)])
    count = grains.shape[1]
    size = spacing(frames.material_points[0]) if count else 0.0
    model = vision.RenderModel(
        made,
        tuple(len(p.slots) for p in ropes),
        tuple(bool(frames.closed[frames.rope[p.slots[0]]]) for p in ropes),
        frames.radius[slots],
        np.full(count, 0.6 * size),
        np.zeros(count, int),
    )
    lamp = np.array(middle) + 8 * reach * np.array(_LAMP)
    away = lamp[2] - middle[2]
    # Right in the picture is +x, down is -y.
    turn = np.diag([1.0, -1.0, -1.0])
    focal = 0.5 * _TEXELS * away / reach
    centre = 0.5 * (_TEXELS - 1) - focal * (turn @ (np.array(middle) - lamp))[:2] / away
    matrix = np.array([[focal, 0, centre[0]], [0, focal, centre[1]], [0, 0, 1]])
    view = vision.Pinhole(*(torch.from_numpy(x)[None] for x in (matrix, turn, -turn @ lamp)))

    def shadow(k: int) -> np.ndarray:
        poses = [(np.zeros(3), np.eye(3)), *(p.pose(frames, k) for p in solids)]
        pos, turns = (torch.from_numpy(np.stack(x))[None] for x in zip(*poses, strict=True))
        ropes_at, grains_at = torch.from_numpy(frames.pos[k, slots])[None], torch.from_numpy(grains[k])[None]
        placed = vision.Placement(pos, turns, ropes_at, grains_at)
        seen = vision.render(model, placed, view, (_TEXELS, _TEXELS), samples=1, rgb=False, ids=True).ids
        seen = tree.part(seen)[0, 0]
        return gaussian_filter((seen.numpy() != vision.NOTHING).astype(np.float32), 2.2)

    return shadow


class Picture:
    """A drawing of a run that can be moved to any of its frames. Ropes are smooth curves through their vertices."""

    def __init__(self, frames: Frames, *, size: tuple[int, int] = (960, 720)) -> None:
        """Prepare the drawing.

        Args:
            frames: the run.
            size: width and height in pixels.
        """
        pv = check_renderer()
        self.frames, self._pieces = frames, pieces(frames)
        low, high = bounds(frames)
        span = float(np.linalg.norm(high - low))
        self._plotter = pv.Plotter(off_screen=True, window_size=size, lighting="none")
        self._plotter.set_background("#ffffff", top="#dfe7ee")
        self._drawn: list[Any] = []
        for piece in self._pieces:
            if piece.kind == "body" and frames.body_shape[piece.slots[0]] == "plane" and _level(frames, piece):
                self._drawn.append(None)  # the floor
                continue
            # Rigid ones are moved as a whole, so their normals are found once.
            own = piece.at(frames, 0) if piece.corners is None else piece.corners
            mesh = pv.PolyData.from_regular_faces(own, piece.faces)
            _shade(mesh, piece.faces)
            actor = self._plotter.add_mesh(mesh, color=piece.color, ambient=0.3, diffuse=0.85, specular=0.12)
            # Its own smooth shading would work on a copy with the normals of the first frame.
            actor.prop.interpolation = "phong"
            self._drawn.append(mesh if piece.corners is None else actor)
        self._matter = []
        for law, slots in points_of(frames).items():
            cloud = pv.PolyData(frames.material_points[0, slots].astype(float))
            size_px = float(np.clip(0.9 * spacing(frames.material_points[0, slots]) / span * size[1] * 1.4, 2, 30))
            self._plotter.add_mesh(cloud, color=COLORS[law], point_size=size_px, render_points_as_spheres=True)
            self._matter.append((cloud, slots))
        self._floor = _Floor(pv, self._plotter, frames, self._pieces, low, high)
        self._label = self._plotter.add_text("", position="lower_left", font_size=12, color="#303840")
        self._aim(pv)

    def _aim(self, pv: Any) -> None:
        """Put camera and lights so that the whole motion fills the picture."""
        place, middle, up = camera_of(self.frames, self._plotter.window_size)
        away = float(np.linalg.norm(place - middle))
        camera = self._plotter.camera
        camera.position, camera.focal_point, camera.up = place, middle, up
        camera.view_angle = ANGLE
        self._plotter.reset_camera_clipping_range()
        for way, strength in ((_LAMP, 0.65), ((1.0, -0.4, 0.5), 0.3), ((0.0, 1.0, 0.6), 0.25)):
            light = pv.Light(position=middle + 10 * away * np.array(way), focal_point=middle, intensity=strength)
            light.positional = False
            self._plotter.add_light(light)
        self._plotter.add_light(pv.Light(light_type="headlight", intensity=0.3))

    def image(self, k: int, note: str = "") -> np.ndarray:
        """Return the picture of frame k, 8 bits of red, green and blue, shape (height, width, 3)."""
        for piece, drawn in zip(self._pieces, self._drawn, strict=True):
            if drawn is None:
                continue
            if piece.corners is None:
                drawn.points = piece.at(self.frames, k)
                _shade(drawn, piece.faces)
                continue
            matrix = np.eye(4)
            matrix[:3, 3], matrix[:3, :3] = piece.pose(self.frames, k)
            drawn.user_matrix = matrix
        self._floor.show(k)
        for cloud, slots in self._matter:
            cloud.points = self.frames.material_points[k, slots].astype(float)
        label = f"{self.frames.time[k]:.2f} s" + (f"  {note}" if note else "")
        self._label.set_text("lower_left", label)
        self._plotter.render()
        return np.array(self._plotter.screenshot(None, return_img=True))[..., :3]

    @property
    def eye(self) -> np.ndarray:
        """Where the camera is [m], shape (3,)."""
        return np.asarray(self._plotter.camera.position, float)

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return where points (N, 3) are seen, in pixels from the upper left (N, 2), and how far ahead [m] (N,)."""
        camera = self._plotter.camera
        eye = np.asarray(camera.position)
        ahead = np.asarray(camera.focal_point) - eye
        ahead = ahead / np.linalg.norm(ahead)
        right = np.cross(ahead, np.asarray(camera.up))
        right = right / np.linalg.norm(right)
        away = points - eye
        depth = away @ ahead
        width, height = self._plotter.window_size
        scale = 0.5 * height / np.tan(np.radians(ANGLE / 2)) / depth
        u = 0.5 * width + scale * (away @ right)
        v = 0.5 * height - scale * (away @ np.cross(right, ahead))
        return np.stack([u, v], -1), depth

    def depth(self) -> np.ndarray:
        """Return how far ahead of the camera is what each pixel of the last picture shows [m], NaN where nothing is."""
        return -np.asarray(self._plotter.get_image_depth(fill_value=np.nan))

    def close(self) -> None:
        """Free what the renderer holds."""
        self._plotter.close()

    def __enter__(self) -> Picture:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def drawing(frames: Frames, *, size: tuple[int, int], photo: bool = False) -> Any:
    """Return what draws a run: a `Picture`, or a `photo.Photo`."""
    if not photo:
        return Picture(frames, size=size)
    from torchdlo.report.render.photo import Photo

    return Photo(frames, size=size)


def stills_png(
    frames: Frames,
    moments: Sequence[float] | None = None,
    *,
    size: tuple[int, int] = (480, 420),
    photo: bool = False,
) -> bytes:
    """Return pictures of several moments side by side, as a PNG file.

    Args:
        frames: the run.
        moments: which moments [s]; start, middle and end if not given.
        size: width and height of each in pixels.
        photo: whether they are photographs, which take minutes.
    """
    from matplotlib import image

    wanted = frames.time[-1] * np.array([0.0, 0.5, 1.0]) if moments is None else np.asarray(moments)
    chosen = dict.fromkeys(np.abs(frames.time[:, None] - wanted).argmin(0).tolist())
    with drawing(frames, size=size, photo=photo) as picture:
        whole = np.concatenate([picture.image(k) for k in chosen], 1)
    content = io.BytesIO()
    image.imsave(content, whole, format="png", metadata={"Software": "torchdlo"})
    return content.getvalue()
