"""Joints that fix what others fix already: they are refused, as forces of such joints are not determined.

Joints that make no circles cannot do that. Where some do, the rank of what they fix is looked at: one point more or
less of a body matters, so that circles alone do not tell.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

_LEAST = 1e-6
"""Smallest singular value over the largest from which on joints count as independent."""
_NEAR = 0.1
"""The same where ropes that are joined meet bodies, over their radius over how far joints are from centres of mass."""


def _circles(nodes: Sequence[set[int]]) -> list[list[int]]:
    """Return the points of each group of them that make a circle, by what each of them joins."""
    root: dict[int, int] = {}

    def find(node: int) -> int:
        while root.setdefault(node, node) != node:
            node = root[node] = root[root[node]]
        return node

    closing = []
    for joined in nodes:
        first, *others = joined
        for other in others:
            a, b = find(first), find(other)
            if a == b:
                closing.append(a)
            root[b] = a
    of_point = [find(next(iter(joined))) for joined in nodes]
    return [[k for k, own in enumerate(of_point) if own == group] for group in sorted({find(x) for x in closing})]


def _jacobian(points: Sequence[tuple[tuple[int, float], ...]], bodies: Sequence[int], arms: Tensor) -> Tensor:
    """Return how points answer to vertices and bodies, turns of which count as motions at the farthest arm."""
    slots = sorted({slot for point in points for slot, _ in point})
    there, most = sorted({k for k in bodies if k >= 0}), arms.norm(dim=-1).amax().clamp(min=1e-12)
    rows = arms.new_zeros(len(points), 3, len(slots) + 2 * len(there), 3)
    one = torch.eye(3, dtype=arms.dtype, device=arms.device)
    for k, (point, body) in enumerate(zip(points, bodies, strict=True)):
        for slot, weight in point:
            rows[k, :, slots.index(slot)] += weight * one
        if body >= 0:
            at = len(slots) + 2 * there.index(body)
            rows[k, :, at] = -one
            rows[k, :, at + 1] = torch.linalg.cross(arms[k].expand(3, 3), one) / most
    return rows.flatten(2).flatten(0, 1)


def check_repeats(joints: Any, local: Tensor, radius: float) -> None:
    """Raise a `ValueError` that names a joint which repeats others.

    Args:
        joints: the static side of the joints, see `joints.Joints`.
        local: joined points in the frames of their bodies [m], shape (..., A, 3); the first scene is looked at.
        radius: that of the thickest rope [m].
    """
    nodes = [
        {slot for slot, _ in point} | ({-1 - body} if body >= 0 else set())
        for point, body in zip(joints.points, joints.bodies, strict=True)
    ]
    arms = local.detach().double().reshape(-1, *local.shape[-2:])[0]
    for group in _circles(nodes):
        own = arms[group]
        rows = _jacobian([joints.points[k] for k in group], [joints.bodies[k] for k in group], own)
        values, vectors = torch.linalg.eigh(rows @ rows.mT)
        least = max(_LEAST, min(0.05, _NEAR * radius / max(1e-12, float(own.norm(dim=-1).amax()))))
        if float(values[0]) >= least**2 * float(values[-1]):
            continue
        share = vectors[:, 0].reshape(-1, 3).norm(dim=-1)
        first = torch.tensor(joints.first)
        points = torch.tensor([k for k, x in zip(group, share.tolist(), strict=True) if x > 0.05])
        *others, last = sorted(set((torch.searchsorted(first, points, right=True) - 1).tolist()))
        known = " and ".join(f"joints[{k}]" for k in others)
        what = f"repeats what {known} hold{'s' if len(others) == 1 else ''} together already"
        raise ValueError(f"joints[{last}]: {what if others else 'holds the same twice'}; leave it out")
