"""Whether a fitted effect is a finding at all: its range must neither hold its off value nor what cannot be."""

from __future__ import annotations

import numpy as np

from torchdlo.physics.effects.parameter_name import ParameterName
from torchdlo.sysid.estimation.jobs import Fitted
from torchdlo.sysid.estimation.levenberg_marquardt import ParameterSpace, reach
from torchdlo.sysid.model.rope_model import RopeModel

__all__ = ["implausible", "not_told", "unresolved"]

_EDGE = 1e-3
"""Share of the range of a number from whose ends it counts as standing there."""

_RESOLVED = 4.0
"""Times the damping of the simulation's own steps from which a damping of the rope can be told from that of steps."""

_LEAST_DAMPING = 0.05
"""Share of a step that is its loss time at least, whatever is said of it."""


def implausible(fitted: Fitted, name: str, drifts: np.ndarray | None = None) -> str | None:
    """Return why one of the effects of a fit is no finding, None if it may be one.

    A vector is off only where the ranges of all of its components hold their off values; so is an effect that several
    numbers switch, a soft spot or a gradient. All comparisons are made in coordinates, where infinity is 0.

    Args:
        fitted: the model.
        name: one of its effects.
        drifts: of its coordinates, see `torchdlo.sysid.estimation.levenberg_marquardt.reach`.
    """
    space, point = fitted.space, fitted.point
    far = reach(point, space, drifts)
    if far is None:
        # One trial says nothing of how trials differ.
        return None
    switches: list[bool] = []
    for k, key in enumerate(space.names):
        which = ParameterName.parse(key)
        if which.effect != name:
            continue
        param = space.params[k]
        low, high = (float(end[k]) for end in _bounds(space))
        at, width = float(point.raw[k]), float(far[k])
        if param.off is None:
            continue
        off = float(space.to_raw(np.where(np.arange(len(space.names)) == k, param.off, fitted_values(fitted)))[k])
        switches.append(abs(at - off) <= width)
        spoken = which.number.replace("_", " ")
        if not np.isclose(high, off) and at > high - _EDGE * (high - low):
            return f"has a {spoken} at the edge of what can be"
        if not np.isclose(low, off) and at < low + _EDGE * (high - low):
            return f"has a {spoken} at the edge of what can be"
        if at - width <= low and at + width >= high:
            return f"has a {spoken} whose range holds all that can be"
    if switches and all(switches):
        return "has a range that holds the value at which it does nothing"
    return None


def not_told(fitted: Fitted, name: str, drifts: np.ndarray | None = None) -> list[str]:
    """Return the names of an effect's numbers without an off value whose ranges hold all that can be.

    Of those with one `implausible` says so: the effect is no finding. What others leave open is no reason against it.

    Args:
        fitted: the model.
        name: one of its effects.
        drifts: as in `implausible`.
    """
    space, point = fitted.space, fitted.point
    far = reach(point, space, drifts)
    if far is None:
        return []
    low, high = _bounds(space)
    whole = (point.raw - far <= low) & (point.raw + far >= high)
    parts = [(ParameterName.parse(key), param) for key, param in zip(space.names, space.params, strict=True)]
    return [
        key
        for key, (which, param), all_of_it in zip(space.names, parts, whole, strict=True)
        if which.effect == name and param.off is None and all_of_it
    ]


def _bounds(space: ParameterSpace) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and highest coordinates that are declared, shape (K,) each."""
    ends = space.to_raw(np.array([[p.low for p in space.params], [p.high for p in space.params]]))
    return ends.min(0), ends.max(0)


def unresolved(fitted: Fitted, name: str, model: RopeModel) -> str | None:
    """Return why an effect is too small to be told from what integrators do, None if it is not.

    An implicit step damps bending with the loss time of a share of itself: the model's own does, and so does that of
    whatever else made or smoothed a recording. As the grid is, that is a candidate to be excluded before any effect.

    Args:
        fitted: the model with the effect.
        name: the effect.
        model: what was simulated.
    """
    if name != "bending_damping":
        return None
    numbers = dict(zip(model.parameters, fitted.values, strict=True))
    loss = numbers[f"{name}.coefficient"] / numbers["bending_stiffness"]
    own = max(model.numerical_damping, _LEAST_DAMPING) * model.dt / model.substeps
    if loss >= _RESOLVED * own:
        return None
    return f"is no larger than the damping of the steps of simulations ({1e3 * loss:.2g} ms, they {1e3 * own:.2g} ms)"


def fitted_values(fitted: Fitted) -> np.ndarray:
    """Return the values of the numbers that were fitted, in the order of their space, shape (K,)."""
    return fitted.space.to_values(fitted.point.raw)
