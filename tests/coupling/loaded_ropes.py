"""Ropes that carry loads and touch, for tests of implicit steps."""

from __future__ import annotations

import math

import torch

from torchdlo.coupling import RodBody
from torchdlo.physics import tree
from torchdlo.physics.effects import EFFECTS
from torchdlo.scene import RigidBody, Rope, make

F64 = torch.float64
G = 9.81


def loaded(params, loads: dict[int, float]):
    """Return parameters with weights [kg] at vertices."""
    mass = params.rods.material.mass.clone()
    for vertex, load in loads.items():
        mass[..., vertex, :] += load
    return tree.replace(params, rods=tree.replace(params.rods, material=tree.replace(params.rods.material, mass=mass)))


def over_a_peg(
    load: float, dt: float, *, n: int = 121, dtype=F64, batch=(), mu: float = 0.0, heavier: float = 0.0, mass=0.011
):
    """A rope of 1 m over a peg of radius 3 cm, with a weight [kg] at each end."""
    radius, length = 0.003, 1.0
    # Vertices stand on a polygon whose edges touch.
    around = (0.03 + radius) / math.cos(0.5 * length / (n - 1) / 0.033)
    s = torch.linspace(-0.5, 0.5, n, dtype=dtype) * length
    a = (s / around).clamp(-math.pi / 2, math.pi / 2)
    down = (s.abs() - around * math.pi / 2).clamp(min=0)
    x = torch.stack([around * a.sin(), 0 * s, around * a.cos() - down], -1).expand(*batch, n, 3).clone()
    turn = math.sqrt(0.5)
    peg = RigidBody("cylinder", (0.03, 0.1), quat=(turn, turn, 0, 0), motion="fixed", mu_s=mu, mu_k=mu)
    made, params, state = make(
        [Rope(x, mass=mass, radius=radius, bend=1e-5, rest="straight")],
        [EFFECTS[name]() for name in ("bend", "gravity", "damping")] + [RodBody()],
        {"damping": {"rate": 0.5}},
        bodies=[peg],
        integrator="implicit",
        dt=dt,
        substeps=1,
        check=False,
    )
    return made, loaded(params, {0: load, -1: load + heavier}), state


def on_two_ropes(load: float, dt: float, *, mass: float = 0.01):
    """A box that lies on two slack ropes, each held at its ends."""
    ropes, n, radius = [], 41, 0.003
    for y in (-0.05, 0.05):
        s = torch.linspace(0, 1, n, dtype=F64)
        x = torch.stack([0.46 * (s - 0.5), torch.full_like(s, y), -0.075 * (1 - (2 * s - 1) ** 2)], -1)
        ropes.append(Rope(x, mass=mass, radius=radius, bend=1e-4, rest="straight"))
    box = RigidBody("box", (0.05, 0.08, 0.02), pos=(0.0, 0.0, -0.075 + radius + 0.024), mass=load)
    return make(
        ropes,
        [EFFECTS[name]() for name in ("bend", "gravity", "damping")] + [RodBody()],
        {"damping": {"rate": 0.5}},
        bodies=[box],
        integrator="implicit",
        dt=dt,
        substeps=1,
        prescribed_vertices=(0, n - 1, n, 2 * n - 1),
    )


def on_a_winch(load: float, dt: float, *, mass: float = 0.02, n: int = 46):
    """A weight on a rope of 0.45 m that hangs from the side of a drum of radius 5 cm."""
    drum, radius, turn = 0.05, 0.003, math.sqrt(0.5)
    x = torch.zeros(n, 3, dtype=F64)
    x[:, 0] = drum + radius
    x[:, 2] = -torch.linspace(0, 0.45, n, dtype=F64)
    body = RigidBody("cylinder", (drum, 0.1), quat=(turn, turn, 0, 0), motion="kinematic", mu_s=0.3, mu_k=0.3)
    made, params, state = make(
        [Rope(x, mass=mass, radius=radius, bend=1e-5, rest="straight")],
        [EFFECTS[name]() for name in ("bend", "gravity", "damping")] + [RodBody()],
        {"damping": {"rate": 0.5}},
        bodies=[body],
        integrator="implicit",
        dt=dt,
        substeps=1,
        prescribed_vertices=(0,),
    )
    return made, loaded(params, {-1: load}), state
