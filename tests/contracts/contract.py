"""Views in ordinary and degenerate states, in which every effect is asked for its loads."""

from __future__ import annotations

import torch

from torchdlo.physics import effect, rod, tree
from torchdlo.physics.effects import EFFECTS
from torchdlo.scene import Rope, default_values, make

F64 = torch.float64

# Numbers at which an effect acts, where its defaults are off.
ACTIVE = {
    "table": {"height": -0.02, "hardness": 200.0},
    "table_friction": {"mu": 0.4, "slip": 1e-3, "height": -0.02, "hardness": 200.0},
    "bending_damping": {"coefficient": 1e-3},
    "bending_plasticity": {"yield_curvature": 0.5, "rate": 5.0},
    "rest_curvature": {"curvature": (0.8, -0.4)},
    "nonuniform_stiffness": {"position": 0.4, "width": 0.2, "factor": 0.5, "slope": 0.3},
    "point_mass": {"position": 0.23, "mass": 0.1},
}


def ropes(batch: tuple[int, ...] = (), seed: int = 0, dtype=F64) -> list[Rope]:
    """An open and a closed rope, both curved, near the table."""
    g = torch.Generator().manual_seed(seed)
    a = torch.arange(6, dtype=F64) / 6 * 2 * torch.pi
    loop = 0.1 * torch.stack([torch.cos(a), torch.sin(a), 0.2 * torch.sin(2 * a)], -1) + torch.tensor(
        [0.0, 0.5, 0.0], dtype=F64
    )
    line = torch.linspace(0, 0.6, 7, dtype=F64)[:, None] * torch.tensor([1.0, 0.0, 0.0], dtype=F64)
    made = []
    for x, closed in ((line, False), (loop, True)):
        x = x + 0.02 * torch.randn(*batch, *x.shape, generator=g, dtype=F64)
        v = torch.randn(*batch, *x.shape[-2:], generator=g, dtype=F64)
        made.append(
            Rope(
                x.to(dtype),
                velocities=v.to(dtype),
                mass=0.1,
                bend=1e-3,
                bend2=None,
                twist=2e-3,
                stretch=50.0,
                closed=closed,
                radius=0.01,
            )
        )
    return made


def scene(name: str, batch: tuple[int, ...] = (), seed: int = 0, dtype=F64, given: list[Rope] | None = None):
    """Scene, parameters and state in which the one effect acts."""
    made, params, state = make(
        given or ropes(batch, seed, dtype),
        [EFFECTS[name]()],
        {EFFECTS[name].name: ACTIVE.get(name, {})},
        constrained=False,
        check=False,
        dt=1e-5,
        substeps=1,
    )
    g = torch.Generator().manual_seed(seed + 7)
    r = state.rods
    twist = torch.randn(r.twist.shape, generator=g, dtype=F64).to(dtype)
    rate = torch.randn(r.twist.shape, generator=g, dtype=F64).to(dtype)
    pos = r.pos if given else 1.02 * r.pos  # stretched
    return made, params, tree.replace(state, rods=tree.replace(r, pos=pos, twist=twist, twist_rate=rate))


def respond(made, params, state, values=None) -> dict[str, torch.Tensor]:
    """Everything the effect does: loads, flow, and the numbers that it alters."""
    one = made.effects[0]
    values = params.effects[one.name] if values is None else values
    altered = one.alter(made.topology, params.rods, values)
    view = rod.view(made.topology, altered, state.rods, made.dt)
    found = dict(effect.total([one], view, {one.name: values}))
    flow = one.flow(view, values)
    if flow is not None:
        found["flow"] = flow
    for part in ("rest", "material"):
        before, after = getattr(params.rods, part), getattr(altered, part)
        for field in before.__dataclass_fields__:
            if getattr(before, field) is not getattr(after, field):
                found[f"altered {part}.{field}"] = getattr(after, field) - getattr(before, field)
    return found


__all__ = ["ACTIVE", "EFFECTS", "F64", "default_values", "respond", "ropes", "scene"]
