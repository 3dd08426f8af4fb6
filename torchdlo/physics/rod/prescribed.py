"""Holding parts of rods: where held vertices and edges are, how firmly, and what that takes."""

from __future__ import annotations

from dataclasses import field
from typing import Any

import torch
from torch import Tensor

from torchdlo.physics import tree
from torchdlo.physics.linalg import rotation


@tree.struct
class Targets:
    """Where held vertices and edges are at the end of a substep."""

    pos: Tensor
    """Positions of the held vertices [m], shape (..., H, 3)."""
    director: Tensor
    """First material directors of the held edges [1], shape (..., G, 3)."""
    attachment_weight: dict[str, Tensor] = field(default_factory=dict)
    """How firmly the held "vertices" (..., H, 1) and "edges" (..., G, 1) are held, 0 to 1; 1 if not said."""


def between(start: Any, control: Any, share: Tensor | None) -> Targets:
    """Return where held parts are at the end of a substep.

    Args:
        start: where they were when the step began, see `scene.Control`.
        control: where they are at its end.
        share: part of the step that is over then, shape (1,); None at its end.
    """
    if share is None:
        return Targets(control.pos, control.director, control.attachment_weight)
    director = rotation.turn_towards(start.director, control.director, share)
    return Targets(start.pos + share * (control.pos - start.pos), director, control.attachment_weight)


@tree.struct
class Reaction:
    """What holds exert on the rods."""

    force: Tensor
    """Force on the held vertices [N], shape (..., H, 3)."""
    couple: Tensor
    """Torque on the held edges about their axis [N m], shape (..., G, 1)."""

    def sized(self, like: Tensor, vertices: int, edges: int) -> Reaction:
        """Return this reaction, or none where other parts than these were held; `like` has shape (..., V, 3)."""
        if (self.force.shape[-2], self.couple.shape[-2]) == (vertices, edges):
            return self
        return unfelt(like, vertices, edges)


def unfelt(like: Tensor, vertices: int, edges: int) -> Reaction:
    """Return no reaction; `like` has shape (..., V, 3)."""
    batch = like.shape[:-2]
    return Reaction(like.new_zeros(*batch, vertices, 3), like.new_zeros(*batch, edges, 1))


def spread(values: Tensor, slots: tuple[int, ...], size: int, otherwise: Tensor) -> Tensor:
    """Return `otherwise` (..., V, C) with `values` (..., H, C) put at the given slots."""
    if not slots:
        return otherwise
    place = {slot: k for k, slot in enumerate(slots)}
    pieces, start = [], 0
    for slot in sorted(place):
        if slot > start:
            pieces.append(otherwise[..., start:slot, :])
        k = place[slot]
        pieces.append(values[..., k : k + 1, :].expand(*otherwise.shape[:-2], 1, otherwise.shape[-1]))
        start = slot + 1
    if start < size:
        pieces.append(otherwise[..., start:, :])
    return tree.cat_vertices(pieces)


def free(slots: tuple[int, ...], attachment_weight: Tensor | None, like: Tensor, size: int) -> Tensor:
    """Return 1 for free slots and 1 less the grip for held ones, shape (V, 1) or (..., V, 1)."""
    if attachment_weight is None or not slots:
        return like.new_tensor([[0.0] if slot in slots else [1.0] for slot in range(size)])
    return spread(1 - attachment_weight, slots, size, like.new_ones(*attachment_weight.shape[:-2], size, 1))


def put(values: Tensor, slots: tuple[int, ...], attachment_weight: Tensor | None, otherwise: Tensor) -> Tensor:
    """Return `otherwise` (..., V, C) with held slots moved to `values` (..., H, C) by the share of their grip."""
    if attachment_weight is not None and slots:
        values = torch.lerp(*torch.broadcast_tensors(otherwise[..., list(slots), :], values, attachment_weight))
    return spread(values, slots, otherwise.shape[-2], otherwise)


def check_grip(attachment_weight: dict[str, Tensor], counts: tuple[int, int]) -> None:
    """Raise a `ValueError` if the shares do not fit the numbers of held vertices and edges."""
    for part, share in attachment_weight.items():
        if share.shape[-2:] != (dict(zip(("vertices", "edges"), counts, strict=True)).get(part), 1):
            raise ValueError(
                f"control: grip {part!r} is {tuple(share.shape)}; expected 'vertices' of shape (..., {counts[0]}, 1) "
                f"and 'edges' of shape (..., {counts[1]}, 1)"
            )
