"""A fit that is far from its films says so: what finer simulations change of it is no floor."""

from __future__ import annotations

import numpy as np

from torchdlo.sysid.diagnosis.error_floor import ErrorFloor
from torchdlo.sysid.diagnosis.verdict import UNKNOWN_FLOOR
from torchdlo.sysid.video.filmed_diagnosis import _far, _verdict


def test_a_blunt_floor_is_said() -> None:
    said = _far(6.6e-3, ErrorFloor(3e-4, 0.0, 6.6e-3))
    assert said.startswith("Finer simulations of the calibrated model differ from it by 6.6 mm, 22 times")
    assert _far(np.inf, ErrorFloor(3e-4, 0.0, np.inf)) == UNKNOWN_FLOOR


def test_nothing_is_explained_by_a_blunt_floor() -> None:
    noise = 3e-4
    assert _verdict([], 5e-3, 5e-3, ErrorFloor(noise, 0.0, 6.7e-3), 6.7e-3) == "unknown"
    assert _verdict([], 4e-4, 4e-4, ErrorFloor(noise, 0.0, 4e-4), 4e-4) == "none"
    assert _verdict(["air_drag"], 5e-3, 4e-3, ErrorFloor(noise, 0.0, 6.7e-3), 6.7e-3) == "partial"
