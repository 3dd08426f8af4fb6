"""Clamps that turn elastically, told from those in which the rope bends.

Where clamps do not seem to hold the rope stiffly up to their last marker, the baseline lets it bend between the markers
of a clamp. That takes up a part of what an elastic clamp does, so its law is tried with stiff ones; and what is missing
may have made clamps seem soft.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from torchdlo.physics.effects.gripper_compliance import GripperCompliance
from torchdlo.sysid.diagnosis.error_floor import gap_rms
from torchdlo.sysid.diagnosis.score_test import Score
from torchdlo.sysid.diagnosis.workspace import SILENT, Workspace
from torchdlo.sysid.estimation.jobs import FitJob, Fitted
from torchdlo.sysid.model.rope_model import RopeModel

NAME = GripperCompliance.name

_SHARES = (0.2, 0.5, 1.5)
"""Lengths of rope that are as soft as a clamp where fits start, over the distance of its markers."""


def bends_between_markers(model: RopeModel) -> bool:
    """Return whether a model lets the rope bend between the markers of a clamp."""
    return bool(model.mesh.clamps) and model.clamp_fraction < 1


def may_be_stiff(bench: Workspace, base: Fitted) -> bool:
    """Return whether clamps may be stiff that are not in a model which leaves something to be explained."""
    bends = bends_between_markers(bench.pool.local.model(base.effects, base.options))
    return bends and NAME not in base.effects and gap_rms(bench.gaps(base, "all")) > SILENT * bench.level


def firm_clamp_job(base: Fitted, job: FitJob) -> FitJob:
    """Return the job of fitting the model without, likewise with clamps that hold the rope up to their last marker."""
    return replace(job, options=(*base.options, ("clamp_fraction", 1.0)))


def clamp_notes(model: RopeModel, final: Fitted) -> list[str]:
    """Return a sentence on what a clamp may be in which the rope bends, for a reader of a model."""
    if not bends_between_markers(model) or NAME in final.effects:
        return []
    bend = final.values[model.parameters.index("bending_stiffness")]
    spring = bend / (0.5 * (1 - model.clamp_fraction) * _apart(model))
    return [
        "The rope seems to bend between the two markers of a clamp. A clamp that turns like a spring of "
        f"{spring:.2g} N m/rad ({NAME.replace('_', ' ')}) would look alike: to tell them apart, hold it close to the "
        "inner marker and record again."
    ]


def _apart(model: RopeModel) -> float:
    """Return the distance of the markers of a clamp [m]."""
    return min(float(np.diff(model.mesh.marker_arclength[run]).min()) for run in model.mesh.runs)


def stiff_clamp_job(bench: Workspace, base: Fitted, score: Score, iterations: int, frames: int | None) -> FitJob:
    """Return the job of fitting elastic clamps that hold the rope stiffly up to their last marker, see `extend`."""
    model, number = bench.pool.local.model(base.effects), f"{NAME}.stiffness"
    bend = base.values[model.parameters.index("bending_stiffness")]
    starts = tuple(({number: bend / (share * _apart(model))}, base.point.raw) for share in _SHARES)
    job = bench.extension(base, replace(score, starts=starts), [number], iterations, frames)
    return firm_clamp_job(base, job)
