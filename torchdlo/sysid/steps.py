"""Steps of many alike scenes without gradients, recorded once for each scene and number of them."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from torchdlo import scene as scenes
from torchdlo.physics import traced

Step = Callable[[scenes.Params, scenes.State, scenes.Control], scenes.State]
"""A step of some scene."""

_RECORDINGS = traced.Recordings(32)
"""Those of this process."""


def recorded(scene: scenes.Scene, params: scenes.Params, state: scenes.State, control: scenes.Control) -> Step:
    """Return the step of a scene for inputs of these shapes."""
    return _RECORDINGS.find(scene, partial(scenes.step, scene), params, state, control)
