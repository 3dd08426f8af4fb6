"""Small scenes to draw."""

from __future__ import annotations

import numpy as np
import torch

from torchdlo.vision import renderer
from torchdlo.vision.renderer import ARM, BODY, TABLE, Images, Piece, Pinhole, Placement, RenderModel, looking_at
from torchdlo.vision.surfaces import Surface, plate, solid


def only(
    *pieces: Piece, ropes: list[np.ndarray] = (), closed: tuple[bool, ...] = (), particles: int = 0
) -> RenderModel:
    """A model of pieces, ropes 1 cm thick and particles."""
    counts = tuple(len(r) for r in ropes)
    radius = np.full(sum(counts), 0.01)
    return RenderModel(
        pieces, counts, closed or (False,) * len(counts), radius, np.full(particles, 0.02), np.arange(particles) % 2
    )


def at(
    *places: tuple[float, float, float], ropes: list[np.ndarray] = (), particles: np.ndarray | None = None
) -> Placement:
    """A single scene: the world, then frames that are only shifted."""
    pos = torch.tensor([(0.0, 0.0, 0.0), *places])[None]
    turn = torch.eye(3).expand(1, len(places) + 1, 3, 3)
    x = torch.tensor(np.concatenate([np.zeros((0, 3)), *ropes]), dtype=torch.float32)[None]
    balls = torch.zeros(1, 0, 3) if particles is None else torch.tensor(particles, dtype=torch.float32)[None]
    return Placement(pos, turn, x, balls)


def seen(view: Pinhole) -> Pinhole:
    """One camera with its axis."""
    return Pinhole(view.intrinsics[None], view.rotation[None], view.translation[None])


def ball(radius: float = 0.1, around: int = 96, **choices) -> Piece:
    return Piece(solid("sphere", np.array([radius, 0.0, 0.0]), around), BODY, "bodies", frame=1, **choices)


def table(half: float = 1.0) -> Piece:
    return Piece(plate((-half, -half), (half, half), 0.0, 0.04), TABLE, "table", shadow=False)


def mixed() -> tuple[RenderModel, Placement]:
    """Everything that can be drawn at once."""
    t = np.linspace(0, 1, 12)
    line = np.stack([0.5 * t - 0.3, 0.1 * np.sin(6 * t), 0.02 + 0.1 * t * t], -1)
    loop = np.stack(
        [0.1 + 0.12 * np.cos(2 * np.pi * t[:-1]), 0.2 + 0.12 * np.sin(2 * np.pi * t[:-1]), 0.02 + 0 * t[:-1]], -1
    )
    box = Piece(solid("box", np.array([0.05, 0.04, 0.06])), BODY + 1, "bodies", number=1, frame=2)
    arm = Piece(solid("capsule", np.array([0.04, 0.1, 0.0]), 12), ARM, "shells", frame=3)
    points = np.random.default_rng(0).uniform((-0.3, -0.3, 0.02), (-0.1, -0.1, 0.15), (6, 3))
    model = only(table(), ball(0.06, 16), box, arm, ropes=[line, loop], closed=(False, True), particles=6)
    return model, at((0.2, -0.1, 0.06), (-0.2, 0.2, 0.06), (0.3, 0.2, 0.2), ropes=[line, loop], particles=points)


def drawn(model: RenderModel, placement: Placement, view: Pinhole, size: tuple[int, int], **choices) -> Images:
    choices = {"depth": True, "ids": True} | choices
    return renderer.render(model, placement, view, size, **choices)


def from_aside(size: tuple[int, int], **choices) -> Pinhole:
    return seen(looking_at((0.9, 0.5, 0.7), (0.0, 0.0, 0.05), size=size, **choices))


def volume(surface: Surface) -> float:
    """Volume that triangles enclose, positive if they are oriented outwards."""
    a, b, c = (surface.vertices[surface.faces[:, k]] for k in range(3))
    return float((a * np.cross(b, c)).sum() / 6)
