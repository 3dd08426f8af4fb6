"""Actions that lead tools through points."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

__all__ = ["actions_through", "resample_evenly"]


def actions_through(
    points: Sequence[Sequence[tuple[float, float, float]]], horizon: int, off: Tensor, *, max_translation: float = 0.01
) -> Tensor:
    """Return actions that lead tools through points and then keep them there, shape (..., horizon, 6 arms).

    Every leg takes actions in proportion to the longest way of a tool on it.

    Args:
        points: how far the tools are from their starts [m], one row of points per leg, one point per tool.
        horizon: actions in all.
        off: what is added to all points [m], shape (..., arms, 3).
        max_translation: greatest way of a tool in an action [m].
    """
    off = off.to(torch.float64).unsqueeze(-3)
    way = off.new_tensor(points).reshape(-1, *off.shape[-2:]) + off
    legs = torch.cat([torch.zeros_like(off), way], -3).diff(dim=-3)
    need = (legs.norm(dim=-1).amax(-1) / max_translation - 1e-9).ceil().clamp(min=1)
    most = int(need.sum(-1).max())
    if most > horizon:
        raise ValueError(f"way-points: they take {most} actions of {max_translation} m; expected at most {horizon}")
    # Which share of each leg is behind the tools before and after each action.
    done = torch.arange(horizon + 1, dtype=off.dtype, device=off.device).unsqueeze(-1) - (
        need.cumsum(-1) - need
    ).unsqueeze(-2)
    share = (done / need.unsqueeze(-2)).clamp(0, 1)
    xyz = (share @ legs.flatten(-2)).diff(dim=-2)
    return torch.cat([xyz, torch.zeros_like(xyz)], -1)


def resample_evenly(curve: Tensor, count: int) -> Tensor:
    """Return `count` vertices along a dense curve (n, 3), at even distances along it."""
    along = torch.cat([curve.new_zeros(1), (curve[1:] - curve[:-1]).norm(dim=-1).cumsum(0)])
    wanted = torch.linspace(0, 1, count, dtype=curve.dtype) * along[-1]
    k = torch.searchsorted(along, wanted).clamp(1, len(along) - 1)
    share = ((wanted - along[k - 1]) / (along[k] - along[k - 1]))[:, None]
    return (1 - share) * curve[k - 1] + share * curve[k]
