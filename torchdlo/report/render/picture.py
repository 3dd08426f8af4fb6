"""Pictures of a run in three dimensions, drawn without a display: a fixed camera that sees all of the motion."""

from __future__ import annotations

import ctypes.util
import io
import os
from collections.abc import Sequence
from typing import Any

import numpy as np

from torchdlo.errors import InputError
from torchdlo.report.render.surfaces import COLORS, bounds, extent, pieces, points_of, spacing
from torchdlo.scene_files.run import Frames

__all__ = ["Picture", "check_renderer", "stills_png"]

_ANGLE = 30.0
"""Opening of the camera, from top to bottom [deg]."""


def check_renderer() -> Any:
    """Return the renderer, or say what is missing for it."""
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
    normals = np.zeros_like(mesh.points)
    for k in range(3):
        np.add.at(normals, faces[:, k], across)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    mesh.point_data.active_normals = normals


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
        self._drawn = []
        for piece in self._pieces:
            mesh = pv.PolyData.from_regular_faces(piece.at(frames, 0), piece.faces)
            _shade(mesh, piece.faces)
            actor = self._plotter.add_mesh(mesh, color=piece.color, ambient=0.3, diffuse=0.85, specular=0.12)
            # Its own smooth shading would work on a copy with the normals of the first frame.
            actor.prop.interpolation = "phong"
            self._drawn.append(mesh)
        self._matter = []
        for law, slots in points_of(frames).items():
            cloud = pv.PolyData(frames.material_points[0, slots].astype(float))
            size_px = float(np.clip(0.9 * spacing(frames.material_points[0, slots]) / span * size[1] * 1.4, 2, 30))
            self._plotter.add_mesh(cloud, color=COLORS[law], point_size=size_px, render_points_as_spheres=True)
            self._matter.append((cloud, slots))
        for height in frames.table:
            middle = (*(0.5 * (low + high))[:2], float(height))
            ground = pv.Plane(center=middle, i_size=3 * span, j_size=3 * span)
            self._plotter.add_mesh(ground, color=COLORS["table"], lighting=True)
        self._label = self._plotter.add_text("", position="lower_left", font_size=12, color="#303840")
        self._aim(pv, low, high)

    def _aim(self, pv: Any, low: np.ndarray, high: np.ndarray) -> None:
        """Put camera and lights so that the whole motion fills the picture."""
        ahead = -np.asarray(self.frames.camera_direction, float)
        ahead = ahead / np.linalg.norm(ahead)
        up = np.array([0.0, 0.0, 1.0]) if abs(ahead[2]) < 0.99 else np.array([0.0, 1.0, 0.0])
        right = np.cross(ahead, up)
        right = right / np.linalg.norm(right)
        up = np.cross(right, ahead)
        width, height = self._plotter.window_size
        tall = np.tan(np.radians(_ANGLE / 2))
        wide = tall * width / height
        middle = 0.5 * (low + high)
        seen = extent(self.frames)
        for _ in range(4):
            # The least distance at which all points are within the picture; then aim at the middle of what is seen.
            x, y, z = ((seen - middle) @ axis for axis in (right, up, ahead))
            away = max(np.max(np.abs(x) / wide - z), np.max(np.abs(y) / tall - z), 1e-3)
            shift = [away * 0.5 * np.add(*np.percentile(v / (away + z), [0, 100])) for v in (x, y)]
            middle = middle + shift[0] * right + shift[1] * up
        away = 1.1 * away
        camera = self._plotter.camera
        camera.position, camera.focal_point, camera.up = middle - away * ahead, middle, up
        camera.view_angle = _ANGLE
        self._plotter.reset_camera_clipping_range()
        for place, strength in (((-0.6, -0.5, 1.0), 0.65), ((1.0, -0.4, 0.5), 0.3), ((0.0, 1.0, 0.6), 0.25)):
            light = pv.Light(position=middle + 10 * away * np.array(place), focal_point=middle, intensity=strength)
            light.positional = False
            self._plotter.add_light(light)
        self._plotter.add_light(pv.Light(light_type="headlight", intensity=0.3))

    def image(self, k: int, note: str = "") -> np.ndarray:
        """Return the picture of frame k, 8 bits of red, green and blue, shape (height, width, 3)."""
        for piece, mesh in zip(self._pieces, self._drawn, strict=True):
            mesh.points = piece.at(self.frames, k)
            _shade(mesh, piece.faces)
        for cloud, slots in self._matter:
            cloud.points = self.frames.material_points[k, slots].astype(float)
        label = f"{self.frames.time[k]:.2f} s" + (f"  {note}" if note else "")
        self._label.set_text("lower_left", label)
        self._plotter.render()
        return np.array(self._plotter.screenshot(None, return_img=True))[..., :3]

    def close(self) -> None:
        """Free what the renderer holds."""
        self._plotter.close()

    def __enter__(self) -> Picture:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def stills_png(frames: Frames, moments: Sequence[float] | None = None, *, size: tuple[int, int] = (480, 420)) -> bytes:
    """Return pictures of several moments side by side, as a PNG file.

    Args:
        frames: the run.
        moments: which moments [s]; start, middle and end if not given.
        size: width and height of each in pixels.
    """
    from matplotlib import image

    wanted = frames.time[-1] * np.array([0.0, 0.5, 1.0]) if moments is None else np.asarray(moments)
    chosen = dict.fromkeys(np.abs(frames.time[:, None] - wanted).argmin(0).tolist())
    with Picture(frames, size=size) as picture:
        whole = np.concatenate([picture.image(k) for k in chosen], 1)
    content = io.BytesIO()
    image.imsave(content, whole, format="png", metadata={"Software": "torchdlo"})
    return content.getvalue()
