"""Clamps that turn elastically, told from those in which the rope bends.

Where the data does not say that clamps hold the rope stiffly up to their last marker, the baseline lets it bend between
the markers of a clamp. That takes up a part of what an elastic clamp does, so its law is tried with stiff ones.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from torchdlo.sysid.bench import SILENT, Bench
from torchdlo.sysid.floor import rms
from torchdlo.sysid.jobs import Fit, Fitted
from torchdlo.sysid.screen import Score

NAME = "gripper_compliance"

_SHARES = (0.2, 0.5, 1.5)
"""Lengths of rope that are as soft as a clamp where fits start, over the distance of its markers."""


def soft(bench: Bench, base: Fitted) -> bool:
    """Return whether clamps may be stiff that are not in a model which leaves something to be explained."""
    bends = bench.undecided and not dict(base.options).get("grip", 1.0)
    return bends and NAME not in base.effects and rms(bench.gaps(base, "all")) > SILENT * bench.level


def firm(base: Fitted, job: Fit) -> Fit:
    """Return the job of fitting the model without, likewise with clamps that hold the rope up to their last marker."""
    return replace(job, options=(*base.options, ("grip", 1.0)))


def stiff(bench: Bench, base: Fitted, score: Score, iterations: int, frames: int | None) -> Fit:
    """Return the job of fitting elastic clamps that hold the rope stiffly up to their last marker, see `extend`."""
    model, number = bench.pool.local.model(base.effects), f"{NAME}.stiffness"
    apart = min(float(np.diff(model.mesh.marker_arclength[run]).min()) for run in model.mesh.runs)
    bend = base.values[model.parameters.index("bending_stiffness")]
    starts = tuple(({number: bend / (share * apart)}, base.point.raw) for share in _SHARES)
    job = bench.extension(base, replace(score, starts=starts), [number], iterations, frames)
    return firm(base, job)
