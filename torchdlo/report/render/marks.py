"""Pictures with numbers on the vertices of ropes, and where in them vertices are seen."""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np
import torch

from torchdlo.envs.core import episode
from torchdlo.report.render.episode_film import stills
from torchdlo.report.render.picture import Picture
from torchdlo.scene_files.run import Frames

__all__ = ["MarkCamera", "MarkedView", "marked_view", "spaced_vertices"]

_SLACK = 0.004
"""How much nearer than a rope's surface something has to be to hide it [m]."""


class MarkedView:
    """A picture of a moment in which vertices can be found and given numbers."""

    def __init__(self, image: np.ndarray, pixels: np.ndarray, visible: np.ndarray) -> None:
        """Keep a picture (height, width, 3), where vertices are in it (V, 2), and which are seen (V,)."""
        self.image = image
        self.pixels, self.visible = torch.as_tensor(pixels), torch.as_tensor(visible)

    def marked(self, slots: Sequence[int]) -> bytes:
        """Return the picture as PNG, with the numbers of these vertices beside dots on them."""
        from PIL import Image, ImageDraw, ImageFont

        picture = Image.fromarray(np.ascontiguousarray(self.image))
        draw, font = ImageDraw.Draw(picture), ImageFont.load_default(15)
        for slot in slots:
            u, v = self.pixels[slot].tolist()
            draw.ellipse((u - 3, v - 3, u + 3, v + 3), fill="#ffffff", outline="#000000")
            # Above the dot, on white: readable on whatever is behind.
            text = str(slot)
            box = draw.textbbox((u, v - 5), text, font=font, anchor="mb")
            draw.rectangle((box[0] - 2, box[1] - 1, box[2] + 2, box[3] + 1), fill="#ffffff")
            draw.text((u, v - 5), text, font=font, anchor="mb", fill="#000000")
        content = io.BytesIO()
        picture.save(content, format="PNG")
        return content.getvalue()


def _before(frames: Frames, eye: np.ndarray, k: int) -> np.ndarray:
    """Return how far a rope's own surface may be before its vertices, as it is seen slantwise [m], shape (V,)."""
    x = frames.pos[k]
    along = np.zeros_like(x)
    for rope in np.unique(frames.rope):
        rows = np.flatnonzero(frames.rope == rope)
        along[rows] = np.gradient(x[rows], axis=0)
    ray = x - eye
    cos = (along * ray).sum(-1) / np.maximum(np.linalg.norm(along, axis=-1) * np.linalg.norm(ray, axis=-1), 1e-12)
    return frames.radius / np.sqrt(np.maximum(1 - cos**2, 0.1))


def marked_view(frames: Frames, k: int = -1, *, size: tuple[int, int] = (960, 720)) -> MarkedView:
    """Return the picture of frame k, and which vertices are seen in it.

    A vertex is hidden where something is nearer to the camera than the surface of its rope, or if it is off the
    picture.
    """
    k %= len(frames.time)
    with Picture(frames, size=size) as picture:
        image, depth = picture.image(k), picture.depth()
        pixels, ahead = picture.project(frames.pos[k])
    column, row = np.round(pixels).astype(int).T
    inside = (column >= 0) & (column < size[0]) & (row >= 0) & (row < size[1]) & (ahead > 0)
    seen = np.full(len(ahead), np.nan)
    seen[inside] = depth[row[inside], column[inside]]
    hidden = seen < ahead - _before(frames, picture.eye, k) - _SLACK
    return MarkedView(image, pixels, inside & ~hidden)


class MarkCamera:
    """Draws worlds of an episode for plans."""

    def now(self, made: episode.Episode, world: episode.EpisodeState) -> bytes:
        """Return the scene without arms, with numbers on vertices, as PNG."""
        view = marked_view(stills(made, [world], arms=False))
        return view.marked(spaced_vertices(view))

    def stills(self, made: episode.Episode, worlds: Sequence[episode.EpisodeState]) -> bytes:
        """Return moments in rows of four, with arms, as PNG."""
        from PIL import Image

        frames = stills(made, worlds)
        with Picture(frames, size=(480, 360)) as picture:
            images = [Image.fromarray(np.ascontiguousarray(picture.image(k))) for k in range(len(frames.time))]
        wide = min(4, len(images))
        sheet = Image.new("RGB", (480 * wide, 360 * -(-len(images) // wide)), "#ffffff")
        for k, image in enumerate(images):
            sheet.paste(image, (480 * (k % wide), 360 * (k // wide)))
        content = io.BytesIO()
        sheet.save(content, format="PNG")
        return content.getvalue()


def spaced_vertices(view: MarkedView, apart: float = 26.0) -> list[int]:
    """Return vertices that are seen and that are so far apart in a picture [pixels]."""
    chosen: list[int] = []
    for slot in view.visible.nonzero()[:, 0].tolist():
        if all(float((view.pixels[slot] - view.pixels[other]).norm()) >= apart for other in chosen):
            chosen.append(slot)
    return chosen
