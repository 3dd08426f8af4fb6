"""Where ropes in motion begin, as their first pictures show it: no simulation is needed for that.

Over a picture or two a rope goes on as it moves. Its places and speeds, in smooth shapes about a rope in balance, are
fitted to those pictures. A rope that lies elsewhere than where its balance is may be found from one side only, as
readings are distances to what is nearest; so it is looked for from ropes that are swung to all sides. What one camera
does not tell, how far away the rope is, stays for simulations to tell.
"""

from __future__ import annotations

from dataclasses import fields

import numpy as np

from torchdlo.sysid.video.filmed_fit import fit
from torchdlo.sysid.video.filmed_problem import FilmedProblem
from torchdlo.sysid.video.filmed_starts import fit_starts

__all__ = ["look_at_first_pictures"]

_SWUNG = (3.0, 6.0)
"""How far ropes are swung, in usual deviations of a start."""

_KEPT = 4
"""Places of each trial that are followed to the end."""

_SPEEDS = 0.08
"""Seconds over which a rope goes on as it moves: a rope that falls freely is 31 mm elsewhere then."""

_LATE = 0.1
"""Seconds after which a first picture tells nothing of a start without a simulation."""


class _Gliding(FilmedProblem):
    """A problem of ropes that go on as they move."""

    def simulate(self, values: np.ndarray, frames: int | None = None, offsets: np.ndarray | None = None) -> np.ndarray:
        """Return places (P, B, T, M, 3) for offsets (P, B, J); numbers do not matter."""
        start = self.begin(self.offset[None] if offsets is None else offsets)
        count = self.motion.markers.shape[1] if frames is None else frames
        pos, vel = (x.reshape(-1, len(self.trials), 1, *x.shape[1:]) for x in (start.pos, start.vel))
        return pos + vel * (self.model.dt * np.arange(count))[:, None, None]


def look_at_first_pictures(own: FilmedProblem, raw: np.ndarray, *, cameras: bool = False) -> np.ndarray:
    """Let trials in motion begin as their first pictures show it, with cameras as numbers (N,) have them.

    Where that is is kept, see `FilmedProblem.shown`. Trials whose first picture was taken late begin as before.

    Args:
        own: the problem.
        raw: coordinates of the numbers.
        cameras: whether cameras may be elsewhere: a rope is drawn between its grippers, whose places are known.

    Returns:
        Coordinates of the numbers (N,), with cameras as first pictures show them.
    """
    if not own.offset.shape[1]:
        return raw
    looked = ~own.start.at_rest & (np.min([view.first for view in own.spines.views], 0) <= _LATE)
    if looked.any():
        own.offset = own.offset.copy()
        own.offset[looked], raw = _found(own.picked(np.flatnonzero(looked)), raw, cameras)
    own.shown = own.moved(own.offset[None])
    return raw


def _found(own: FilmedProblem, raw: np.ndarray, cameras: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return offsets of the starts of trials that are all in motion, (B, J), and coordinates of the numbers (N,)."""
    firsts = np.array([view.first for view in own.spines.views])
    until = firsts.min(0) + _SPEEDS
    short = _Gliding(**{f.name: getattr(own, f.name) for f in fields(own)}).shortened(float(until.max()))
    # Of each camera its first picture, if it takes one in time.
    one = _up_to(short, np.where(firsts <= until, firsts, -np.inf).max(0) + 1e-6)
    offset, trials = _swung(own.offset), len(own.trials)
    for passes, keep in ((4, _KEPT), (8, 1)):
        copies = one.picked(np.tile(np.arange(trials), len(offset)))
        copies.offset = offset.reshape(-1, offset.shape[-1])
        costs = fit_starts(copies, raw, passes).reshape(-1, trials)
        rows = np.argsort(np.where(np.isfinite(costs), costs, np.inf), axis=0, kind="stable")[:keep]
        offset = copies.offset[rows * trials + np.arange(trials)]
    few = _up_to(short, until)
    few.offset = offset[0]
    fit_starts(few, raw, 12)
    if cameras:
        raw = fit(few, raw, 12, near=True).raw
    return few.offset, raw


def _up_to(own: FilmedProblem, last: np.ndarray) -> FilmedProblem:
    """Return the problem in which pictures count up to a time of each trial (B,) [s]."""
    return own.counting([view.good & (view.time <= last[:, None]) for view in own.spines.views])


def _swung(offset: np.ndarray) -> np.ndarray:
    """Return offsets (P, B, J) of ropes as they begin, and swung to all sides."""
    out = [offset]
    for axis in range(3):
        for far in _SWUNG:
            for side in (-far, far):
                each = offset.reshape(len(offset), 2, -1, 3).copy()
                # The first of the shapes is the whole rope's.
                each[:, 0, 0, axis] += side
                out.append(each.reshape(offset.shape))
    return np.stack(out)
