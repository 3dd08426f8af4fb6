"""Steps of many alike scenes without gradients, recorded once for each scene and number of them.

What contact missed stays as it was, and so does what held parts feel unless that is asked for: it is not computed.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from torchdlo import scene as scenes
from torchdlo.physics import tree
from torchdlo.physics.execution import tracing

Step = Callable[[scenes.Params, scenes.State, scenes.Control], scenes.State]
"""A step of some scene."""

_RECORDINGS = tracing.Recordings(32)
"""Those of this process."""


def _moved(scene: scenes.Scene, params: scenes.Params, state: scenes.State, control: scenes.Control) -> scenes.State:
    after = scenes.step(scene, params, state, control)
    return tree.replace(after, diagnostics=state.diagnostics, reaction=state.reaction)


def _felt(scene: scenes.Scene, params: scenes.Params, state: scenes.State, control: scenes.Control) -> scenes.State:
    return tree.replace(scenes.step(scene, params, state, control), diagnostics=state.diagnostics)


def recorded_step(
    scene: scenes.Scene,
    params: scenes.Params,
    state: scenes.State,
    control: scenes.Control,
    *,
    reactions: bool = False,
) -> Step:
    """Return the step of a scene for inputs of these shapes; `reactions`: with what held parts feel."""
    step = _felt if reactions else _moved
    return _RECORDINGS.find((scene, reactions), partial(step, scene), params, state, control)
