"""A diagnosis without a search, so that what surrounds it is tested in milliseconds."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from torchdlo.physics.effects import EFFECTS
from torchdlo.sysid.diagnosis import error_floor as floors
from torchdlo.sysid.diagnosis.effect_library import PARAMETERS
from torchdlo.sysid.diagnosis.error_floor import ErrorFloor
from torchdlo.sysid.diagnosis.verdict import Candidate, Diagnosis
from torchdlo.sysid.estimation.jobs import Fitted
from torchdlo.sysid.estimation.levenberg_marquardt import ParameterSpace, Point
from torchdlo.sysid.recordings.recording import Recording

BASELINE = {"bending_stiffness": 2e-3, "twisting_stiffness": 1.5e-3, "damping_rate": 0.8}


def fitted(values: dict[str, float], effects: tuple[str, ...] = (), trials: int = 3) -> Fitted:
    """Numbers with some slope, so that they have ranges."""
    params = [PARAMETERS[n] if "." not in n else EFFECTS[n.split(".")[0]].params[n.split(".")[1]] for n in values]
    space = ParameterSpace(tuple(values), tuple(params), (1.0,) * len(values))
    rng, k = np.random.default_rng(0), len(values)
    curvature = np.tile(np.eye(k), (trials, 1, 1))
    point = Point(
        space.to_raw(np.array(list(values.values()))),
        1e-3,
        0.05 * rng.normal(size=(trials, k)),
        curvature,
        np.ones(trials),
    )
    return Fitted(effects, np.array(list(values.values())), space, point)


def fake_diagnosis(recording: Recording, **fields: Any) -> Diagnosis:
    """Air drag was missing: the baseline lags, the model with drag is off by noise."""
    trials, rng = (*recording.train, *recording.test), np.random.default_rng(1)
    before, after = {}, {}
    for t in trials:
        speed = np.gradient(t.markers, t.time, axis=0)
        before[t.name] = np.where(t.gripped[:, None], t.markers, t.markers + 0.01 * speed)
        after[t.name] = t.markers + 2e-4 * rng.normal(size=t.markers.shape) * ~t.gripped[:, None]
    gaps = [floors.trial_gaps([x[t.name] for t in recording.test], recording.test) for x in (before, after)]
    numbers = BASELINE | {"damping_rate": 0.5, "air_drag.c_d": 1.4}
    candidates = [
        Candidate("air_drag", 0.8, 0.95, 0.93, "taken"),
        Candidate("wind", 0.78, 0.94, 0.92, "as good as the best"),
        Candidate("bending_damping", 0.3, 0.2, -0.1, "does not help on the test trials"),
        *(Candidate(n, 0.01, None, None, "its doses explain less") for n in ("point_mass", "stretch", "time_delay")),
        *(Candidate(n, 0.01, None, None, "its doses explain less") for n in ("tilted_gravity", "marker_offset")),
    ]
    return Diagnosis(
        **{
            "verdict": "effects",
            "effects": ["air_drag"],
            "ties": {"air_drag": ["wind"]},
            "shares": {"air_drag": 0.93},
            "baseline": fitted(BASELINE),
            "final": fitted(numbers, ("air_drag",)),
            "drifts": np.full((2, len(numbers)), 0.01),
            "floor": ErrorFloor(3e-4, 1e-4, 2e-4),
            "before": gaps[0],
            "after": gaps[1],
            "candidates": [candidates],
            "predictions": {"before": before, "after": after},
            "model": SimpleNamespace(parameters=list(numbers)),
            "seconds": 12.0,
            **fields,
        }
    )
