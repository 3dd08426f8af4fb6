"""What a diagnosis found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from torchdlo.sysid.diagnosis.detection_limit import DetectionLimit
from torchdlo.sysid.diagnosis.error_floor import ErrorFloor, gap_rms
from torchdlo.sysid.diagnosis.gripper_forces import ForceErrors
from torchdlo.sysid.diagnosis.misleading_trials import MisleadingTrial
from torchdlo.sysid.diagnosis.significance import Agreement, benjamini_hochberg
from torchdlo.sysid.estimation.jobs import Fitted
from torchdlo.sysid.estimation.result import Overlay
from torchdlo.sysid.model.rope_model import RopeModel
from torchdlo.sysid.recordings.data_quality import DataIssue

UNEXPLAINED = 3.0
"""Times the floor: a gap beyond that is not explained."""

_SHRUNK = 0.8
"""Share of a gap that effects may leave at most if they are to explain it."""

UNKNOWN_FLOOR = (
    "Finer simulations of the calibrated model fail or differ from it by more than 5 cm: how well a perfect model "
    "could do is not known, so nothing counts as explained. Look at the first frames, and at the rope's length and "
    "mass, or give `--vertices`."
)
"""Note where nothing is known of the simulation's own errors."""


def verdict_word(effects: Sequence[str], left: float, level: float, share: float = 0.0) -> str:
    """Return the verdict on a gap [m] where a perfect model leaves `level`; where that is not known, none is small.

    Args:
        effects: what was found.
        left: the gap, weighted by what frames tell.
        level: the same of a perfect model.
        share: share of the plain gap that is left.
    """
    explained = np.isfinite(level) and left <= UNEXPLAINED * level and not (effects and share > _SHRUNK)
    return ("effects" if explained else "partial") if effects else ("none" if explained else "unknown")


@dataclass(frozen=True, eq=False)
class Candidate:
    """What became of one effect in one round."""

    name: str
    """The effect."""
    score: float
    """Share of the residual that its doses explain."""
    gain: float | None
    """Share of the train trials' excess gap that it closes after the fit; None if it was not fitted."""
    heldout_gain: float | None
    """The same on the test trials."""
    reason: str
    """Why it was taken or left."""
    test: Agreement | None = None
    """Whether what it explains on the test trials could be chance; None if it was not fitted."""


@dataclass(frozen=True, eq=False)
class BestCandidate:
    """An effect that closes much of the gap but is not named."""

    name: str
    """The effect."""
    numbers: dict[str, float]
    """Its numbers as they were fitted."""
    gain: float
    """Share of the train trials' excess gap that it closes."""
    heldout_gain: float
    """The same on the test trials."""
    against: str
    """Why it is not named."""
    test: Agreement
    """Whether what it explains on the test trials could be chance."""


@dataclass(eq=False)
class Diagnosis:
    """What was found."""

    verdict: str
    """"none", "effects", "partial" or "unknown"."""
    effects: list[str]
    """Names of the missing effects, in the order in which they were found."""
    ties: dict[str, list[str]]
    """By effect: others that the data cannot tell from it."""
    shares: dict[str, float]
    """By effect: share of the gap above the floor that it closed on the test trials."""
    baseline: Fitted
    """The calibrated baseline."""
    final: Fitted
    """The model with the effects."""
    floor: ErrorFloor
    """What no effect explains, on the test trials."""
    before: np.ndarray
    """Gap of each test trial with the baseline [m]."""
    after: np.ndarray
    """Gap of each test trial with the effects [m]."""
    candidates: list[list[Candidate]]
    """By round."""
    predictions: dict[str, dict[str, np.ndarray]]
    """Simulated markers [m] of "before" and "after", by trial name, shape (F, M, 3)."""
    model: RopeModel
    """The model with the effects."""
    drifts: np.ndarray
    """What the simulation's own errors change of the final model's coordinates, shape (2, K): of steps, of the mesh."""
    seconds: float = 0.0
    """Time that it took."""
    notes: list[str] = field(default_factory=list)
    """Sentences that a reader should know."""
    data_issues: list[DataIssue] = field(default_factory=list)
    """What is wrong with the data."""
    options: dict[str, Any] = field(default_factory=dict)
    """What was asked for."""
    overlays: list[Overlay] = field(default_factory=list)
    """Pictures of films with the rope before and after, if there are films."""
    tests: dict[str, Agreement] = field(default_factory=dict)
    """By effect: whether what it explains on the test trials could be chance."""
    limits: list[DetectionLimit] = field(default_factory=list)
    """From which size on effects would be named on this recording."""
    second_view: dict[str, Any] | None = None
    """Of films: places of one more camera, and what would be named from there; None if there are none."""
    leading: BestCandidate | None = None
    """What comes closest where a gap is left that nothing named explains."""
    misleading: list[MisleadingTrial] = field(default_factory=list)
    """Train trials that counted less."""
    forces: tuple[ForceErrors, ForceErrors] | None = None
    """How far forces at the grippers are off on the test trials, before and after; None where none count."""

    @property
    def looked_at(self) -> int:
        """How many candidates were looked at, one that was looked at in two rounds twice."""
        return sum(len(each) for each in self.candidates)

    @property
    def false_discovery_rates(self) -> dict[str, float]:
        """By effect: the false discovery rate at which it is named, of all candidates that were looked at."""
        every = (c for each in self.candidates for c in each)
        p = [t.p for t in self.tests.values()]
        p += [c.test.p for c in every if c.test is not None and c.name not in self.tests]
        return dict(zip(self.tests, map(float, benjamini_hochberg(p, self.looked_at)), strict=False))

    @property
    def compared(self) -> np.ndarray:
        """Which test trials both the baseline and the final model get through; all where that is none."""
        return finite_trials(self.before, self.after)

    @property
    def gaps(self) -> tuple[float, float]:
        """Root mean square gap [m] on these trials, with the baseline and with the effects."""
        return gap_rms(self.before[self.compared]), gap_rms(self.after[self.compared])


def finite_trials(*gaps: np.ndarray) -> np.ndarray:
    """Return which trials have finite gaps (B,) [m] with all models, shape (B,); all trials where none have."""
    finite: np.ndarray = np.isfinite(np.asarray(gaps)).all(0)
    return finite if finite.any() else np.ones_like(finite)
