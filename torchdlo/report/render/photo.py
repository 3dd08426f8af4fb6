"""Pictures of a run that look like photographs: paths of light (Mitsuba), then Open Image Denoise.

They take seconds to minutes each. Mitsuba runs in a process of its own, as its compiled variants end the process where
the LLVM library does not suit them; then the plain one is taken.
"""

from __future__ import annotations

import functools
import importlib.util
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from torchdlo.errors import InputError
from torchdlo.physics import tree
from torchdlo.report.render.picture import ANGLE, camera_of
from torchdlo.report.render.run_surfaces import COLORS, DrawnSurface, bounds, pieces, spacing
from torchdlo.scene_files.run import Frames
from torchdlo.vision.look import linear
from torchdlo.vision.renderer_reference import tube
from torchdlo.vision.shading_reference import surface_colors
from torchdlo.vision.surfaces import smoothed

__all__ = ["Photo", "check_photo"]

VARIANTS = ("llvm_ad_rgb", "scalar_rgb")
"""Of Mitsuba, the first that works is taken."""
_ROUGH = {"robot": 0.3, "joint": 0.4, "finger": 0.5}


def check_photo() -> None:
    """Say what is missing for photographs."""
    missing = [name for name in ("mitsuba", "pyoidn") if importlib.util.find_spec(name) is None]
    if missing:
        raise InputError(
            f"photographs need the package {' and '.join(missing)}; install them with pip install 'torchdlo[photo]'."
        )


@functools.cache
def mitsuba_variant() -> str:
    """Return the variant of Mitsuba that works on this machine."""
    check_photo()
    for name in VARIANTS:
        if not subprocess.run([sys.executable, "-m", _CHILD, "--try", name], capture_output=True).returncode:
            return name
    raise InputError("photographs: Mitsuba does not run on this machine; leave out --photo.")


_CHILD = "torchdlo.report.render.photo_child"


def _rgb(color: str) -> np.ndarray:
    red, green, blue = (int(color[k : k + 2], 16) / 255 for k in (1, 3, 5))
    return np.asarray(linear((red, green, blue)))


def _rope(frames: Frames, piece: DrawnSurface, k: int) -> dict[str, np.ndarray]:
    """Return a rope laid of three strands, with colours at its corners."""
    slots = piece.slots
    x, radius = frames.pos[k, slots].astype(float), frames.radius[slots].astype(float)
    closed = bool(frames.closed[frames.rope[slots[0]]])
    sides = 36
    pos, normal, uv, faces = tube(x, radius, closed, sides, 10)
    pitch = 7.0 * float(radius.mean())
    # Strands are ridges that wind about the axis: each point of a section is on the nearest of three circles.
    phase = (3 * uv[:, 0] + uv[:, 1] / pitch) % 1.0
    ridge = np.sqrt(np.maximum(1 - (1.7 * (phase - 0.5)) ** 2, 0))
    pos = pos - normal * (0.28 * float(radius.mean()) * (1 - ridge))[:, None]
    made = smoothed(pos, faces)
    # The first and the last corner of a ring are one.
    rings = made.normals.reshape(-1, sides + 1, 3).copy()
    rings[:, 0] = rings[:, -1] = rings[:, 0] + rings[:, -1]
    rings /= np.maximum(np.linalg.norm(rings, axis=-1, keepdims=True), 1e-12)
    shade = (0.55 + 0.45 * ridge)[:, None] * _rgb(piece.color)
    return {"vertices": pos, "normals": rings.reshape(-1, 3), "faces": faces, "colors": shade}


def _wood(reach: float) -> np.ndarray:
    """Return the texture of a table of boards, linear colours, shape (1024, 1024, 3)."""
    at = np.linspace(-reach, reach, 1024)
    p = np.stack([*np.meshgrid(at, at), np.zeros((1024, 1024))], -1).reshape(-1, 3)
    numbers = (*linear((0.78, 0.64, 0.47)), *linear((0.58, 0.42, 0.27)), 0.0, 1.0, 9.0 / reach, 0.94, 0.34, 3.0)
    m = np.broadcast_to(np.array(numbers, np.float32), (len(p), 12))
    return surface_colors(m, p, np.zeros((len(p), 2)), np.full(len(p), 0.5 * reach / 1024)).reshape(1024, 1024, 3)


class Photo:
    """Photographs of a run, used as a `render.Picture` is."""

    def __init__(self, frames: Frames, *, size: tuple[int, int] = (960, 720), samples: int = 48) -> None:
        """Prepare the drawing.

        Args:
            frames: the run.
            size: width and height in pixels.
            samples: paths of light per pixel.
        """
        self._variant = mitsuba_variant()
        self.frames, self._size, self._samples = frames, size, samples
        self._pieces = pieces(frames)
        low, high = bounds(frames)
        self._reach, self._middle = 2.5 * float(np.linalg.norm(high - low)), 0.5 * (low + high)
        planes = [p for p in self._pieces if p.kind == "body" and frames.body_shape[p.slots[0]] == "plane"]
        flat = [float(p.pose(frames, 0)[0][2]) for p in planes if p.pose(frames, 0)[1][2, 2] > 0.999]
        self._pieces = [p for p in self._pieces if not (p in planes and flat)]
        self._height = ([*map(float, frames.table), *flat] or [float(low[2]) - 0.05 * self._reach / 2.5])[0]
        self._wood = _wood(self._reach)

    def image(self, k: int, note: str = "") -> np.ndarray:
        """Return frame k, 8 bits of red, green and blue, shape (height, width, 3); `note` is left out."""
        frames, given = self.frames, dict[str, Any]()
        for number, piece in enumerate(self._pieces):
            if piece.kind == "rope":
                part = _rope(frames, piece, k)
            else:
                made = smoothed(tree.part(piece.corners), piece.faces)
                pos, turn = piece.pose(frames, k)
                part = {
                    "vertices": made.vertices @ turn.T + pos,
                    "normals": made.normals @ turn.T,
                    "faces": made.faces,
                    "color": _rgb(piece.color),
                }
            rough = next((r for name, r in _ROUGH.items() if COLORS[name] == piece.color), 0.45)
            part["rough"] = np.array(0.7 if piece.kind == "rope" else rough)
            given |= {f"{number}.{name}": value for name, value in part.items()}
        place, target, up = camera_of(frames, self._size)
        given |= {"place": place, "target": target, "up": up, "angle": np.array(ANGLE), "size": np.array(self._size)}
        given |= {"samples": np.array(self._samples), "wood": self._wood, "reach": np.array(self._reach)}
        given |= {"floor": np.array([*self._middle[:2], self._height]), "count": np.array(len(self._pieces))}
        if frames.material_points.shape[1]:
            given["grains"], given["grain"] = (
                frames.material_points[k].astype(float),
                np.array(0.6 * spacing(frames.material_points[k])),
            )
            given["grain_colors"] = np.stack([_rgb(COLORS[str(law)]) for law in frames.constitutive_model])
        with tempfile.TemporaryDirectory() as folder:
            source, target_ = Path(folder) / "scene.npz", Path(folder) / "image.npy"
            np.savez(source, **given)
            command = [sys.executable, "-m", _CHILD, self._variant, str(source), str(target_)]
            done = subprocess.run(command, capture_output=True, text=True)
            if done.returncode or not target_.exists():
                lines = done.stderr.strip().splitlines() or ["it said nothing"]
                raise InputError(f"photographs: Mitsuba ended with code {done.returncode}: {lines[-1]}")
            return np.load(target_)

    def close(self) -> None:
        """Do nothing; a drawing holds nothing."""

    def __enter__(self) -> Photo:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()
