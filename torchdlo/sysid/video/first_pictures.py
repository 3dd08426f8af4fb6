"""Where ropes in motion begin, as their first pictures show it: no simulation is needed for that.

Over a picture or two a rope goes on as it moves. Its places and speeds, in smooth shapes about a rope in balance, are
fitted to those pictures. A rope that lies elsewhere than where its balance is may be found from one side only, as
readings are distances to what is nearest; so it is looked for from ropes that are swung to all sides. What one camera
does not tell, how far away the rope is, stays for simulations to tell.
"""

from __future__ import annotations

from dataclasses import fields

import numpy as np

from torchdlo.sysid.model.trial_batch import Start
from torchdlo.sysid.video.filmed_problem import FilmedProblem
from torchdlo.sysid.video.filmed_starts import fit_starts

__all__ = ["look_at_first_pictures"]

_SWUNG = (3.0, 6.0)
"""How far ropes are swung, in usual deviations of a start."""

_KEPT = 4
"""Places of each trial that are followed to the end."""

_SPEEDS = 0.08
"""Seconds over which a rope goes on as it moves: a rope that falls freely is 31 mm elsewhere then."""


class _Gliding(FilmedProblem):
    """A problem of ropes that go on as they move."""

    def simulate(self, values: np.ndarray, frames: int | None = None, offsets: np.ndarray | None = None) -> np.ndarray:
        """Return places (P, B, T, M, 3); see `FilmedProblem.simulate`."""
        start = self.begin(self.offset[None] if offsets is None else offsets)
        count = self.motion.markers.shape[1] if frames is None else frames
        pos, vel = (x.reshape(-1, len(self.trials), 1, *x.shape[1:]) for x in (start.pos, start.vel))
        moved = pos + vel * (self.model.dt * np.arange(count))[:, None, None]
        return np.repeat(moved, len(values), 0) if len(moved) == 1 else moved


def look_at_first_pictures(own: FilmedProblem, raw: np.ndarray) -> None:
    """Let trials in motion begin as their first pictures show it, with cameras as numbers (N,) have them.

    Where that is is kept: `FilmedProblem.shown`.
    """
    if not own.offset.shape[1]:
        return
    first = max(float(v.time[b, v.good[b]][:1].sum()) for v in own.spines.views for b in range(len(own.trials)))
    parts = {f.name: getattr(own, f.name) for f in fields(own)}
    own.shown = None
    short = _Gliding(**parts).shortened(first + _SPEEDS)
    offset, trials = _swung(short), len(own.trials)
    for passes, keep in ((4, _KEPT), (8, 1)):
        copies = short.picked(np.tile(np.arange(trials), len(offset)))
        copies.offset = offset.reshape(-1, offset.shape[-1])
        costs = fit_starts(copies, raw, passes, seconds=first + 1e-3).reshape(-1, trials)
        rows = np.argsort(np.where(np.isfinite(costs), costs, np.inf), axis=0, kind="stable")[:keep]
        offset = copies.offset[rows * trials + np.arange(trials)]
    short.offset = offset[0]
    fit_starts(short, raw, 12)
    own.offset = short.offset
    found = short.begin(short.offset[None])
    own.shown = Start(found.pos, found.vel, own.start.at_rest)


def _swung(own: FilmedProblem) -> np.ndarray:
    """Return offsets (P, B, J) of ropes as they begin, and swung to all sides."""
    out = [own.offset]
    for axis in range(3):
        for far in _SWUNG:
            for side in (-far, far):
                each = own.offset.reshape(len(own.offset), 2, -1, 3).copy()
                # The first of the shapes is the whole rope's.
                each[:, 0, 0, axis] += side
                out.append(each.reshape(own.offset.shape))
    return np.stack(out)
