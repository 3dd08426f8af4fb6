"""What may be other than in training: friction and stiffness of ropes, starts, and what actions come to."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from torchdlo import scene as scenes
from torchdlo.envs import Task
from torchdlo.errors import InputError
from torchdlo.physics import tree
from torchdlo.scene import Params, Scene

__all__ = ["Disturbance", "disturbed_params", "drawn_params"]


@dataclass(frozen=True)
class Disturbance:
    """What is not as it was in training."""

    friction: float = 1.0
    """Factor of all friction of ropes: with themselves, the table and bodies, and of bodies with each other."""
    stiffness: float = 1.0
    """Factor of the ropes' stiffness in bending and torsion."""
    start: float = 1.0
    """Factor of how far starts vary."""
    noise: float = 0.0
    """Deviation of what is added to each action [m]."""


_FRICTION = (("rod_contact", "mu_s"), ("rod_contact", "mu_k"), ("table_friction", "mu"))


def _scaled(params: Params, friction: float | Tensor, stiffness: float | Tensor, scene: Scene) -> Params:
    """Return parameters with friction and stiffness times factors: numbers, or tensors of shape (B, 1, 1)."""
    effects = {name: dict(values) for name, values in params.effects.items()}
    for effect, number in _FRICTION:
        if number in effects.get(effect, {}):
            effects[effect][number] = effects[effect][number] * friction
    material = params.rods.material
    material = tree.replace(material, bend=material.bend * stiffness, twist=material.twist * stiffness)
    bodies = params.bodies
    if scene.bodies:
        own = tree.part(bodies)
        bodies = tree.replace(own, mu_s=own.mu_s * friction, mu_k=own.mu_k * friction)
    return tree.replace(params, effects=effects, rods=tree.replace(params.rods, material=material), bodies=bodies)


def disturbed_params(params: Params, how: Disturbance, scene: Scene, task: Task) -> Params:
    """Return parameters with other friction and stiffness."""
    changed = _scaled(params, how.friction, how.stiffness, scene)
    try:
        scenes.check_step(scene, changed)
    except ValueError as error:
        raise InputError(f"perturbation: {task.name} cannot be played with {how}: {error}") from None
    return changed


def drawn_params(params: Params, size: float, scene: Scene, task: Task, random: Tensor) -> Params:
    """Return parameters in which each scene has a friction and a stiffness of its own.

    Args:
        params: those of the task.
        size: factors lie between 1 - size and 1 + size.
        scene: theirs.
        task: whose name errors say.
        random: numbers between 0 and 1 that decide, shape (B, 2).
    """
    if not 0 <= size < 1:
        raise InputError(f"disturbed: it is {size}; expected a share of friction and stiffness, from 0 to below 1.")
    disturbed_params(params, Disturbance(stiffness=1 + size), scene, task)  # what is stiffest has to hold
    factors = 1 + size * (2 * random - 1)
    friction, stiffness = (x.reshape(-1, 1, 1).to(params.rods.material.bend) for x in factors.unbind(-1))
    return _scaled(params, friction, stiffness, scene)
