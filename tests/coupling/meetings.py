"""Bodies of all shapes that overlap matter, before and after they exchange momentum once."""

from __future__ import annotations

import torch
from material_points import DOUBLE, ONE, ball

from torchdlo.coupling.bodies.dynamics import RigidBody, place_bodies, predict_free_motion, stationary_control
from torchdlo.coupling.mpm import substep as mpm
from torchdlo.coupling.mpm.body_coupling_effect import exchange
from torchdlo.coupling.mpm.constitutive_models import Elastic

SHAPES = {
    "plane": ((), "kinematic"),
    "sphere": (0.02, "free"),
    "box": ((0.02, 0.03, 0.015), "free"),
    "capsule": ((0.015, 0.02), "free"),
    "cylinder": ((0.02, 0.02), "free"),
    "cone": ((0.025, 0.05), "free"),
    "torus": ((0.025, 0.012), "free"),
    "ring": ((0.025, 0.012, 4.0), "free"),
    "mesh": ((0.04,) * 3, "free"),
}


def a_mesh():
    """Distances of a ball of 2 cm on a grid of 17 corners along each side."""
    line = torch.linspace(-0.04, 0.04, 17, dtype=DOUBLE)
    return torch.stack(torch.meshgrid(line, line, line, indexing="ij"), -1).norm(dim=-1) - 0.02


def meeting(names, effect, mu=0.4):
    """Matter at random velocities and bodies that overlap it, before and after one exchange."""
    medium, material_points, state = ball(Elastic(), batch=(2,), shake=0.3)
    generator, solids = torch.Generator().manual_seed(0), []
    for k, name in enumerate(names):
        size, motion = SHAPES[name]
        speed = {"vel": (0.1, -0.2, 0.3 - 0.5 * k), "omega": (3.0, -2.0, 4.0)} if motion == "free" else {}
        bulk = {"mass": 0.05, "inertia": (8e-6, 1e-5, 1.2e-5)} if motion == "free" else {}
        grid = a_mesh() if name == "mesh" else None
        quat = torch.randn(4, generator=generator, dtype=DOUBLE)
        quat = quat if motion == "free" else (1.0, 0.0, 0.0, 0.0)
        solids.append(
            RigidBody(
                name,
                size,
                (0.1, 0.105, 0.08 + 0.04 * k),
                quat,
                motion=motion,
                mu_s=mu,
                mu_k=mu,
                grid=grid,
                **speed,
                **bulk,
            )
        )
    bodies, params, placed = place_bodies(solids, state.pos)
    motion = predict_free_motion(bodies, params, placed, stationary_control(bodies, placed), 0.0, 0 * ONE, 2e-4)
    nodes, _ = mpm.to_grid(medium, material_points, state, 0 * ONE, 2e-4, ONE)
    impulse, torque, after, lost = exchange(effect, medium.grid, nodes, motion, (2,))
    return medium.grid, nodes, after, motion, (impulse, torque, lost)
