"""Views in ordinary and degenerate states, in which every effect is asked for its loads."""

from __future__ import annotations

import torch

from torchdlo.physics import tree
from torchdlo.physics.effects import EFFECTS
from torchdlo.physics.effects import base as effect
from torchdlo.physics.effects.gripper_compliance import GripperCompliance
from torchdlo.physics.effects.loose_clamps import GripperDamping, GripperPlay
from torchdlo.physics.effects.measurement import Track
from torchdlo.physics.rod import kinematics as rod
from torchdlo.scene import Rope, default_values, make

F64 = torch.float64

# Numbers at which an effect acts, where its defaults are off.
ACTIVE = {
    "table": {"height": -0.02, "hardness": 200.0},
    "table_friction": {"mu": 0.4, "slip": 1e-3, "height": -0.02, "hardness": 200.0},
    "bending_damping": {"coefficient": 1e-3},
    "bending_plasticity": {"yield_curvature": 0.5, "rate": 5.0},
    "rest_curvature": {"curvature": (0.8, -0.4)},
    "stiffness_profile": {"factors": (0.2, -0.1) * 8},
    "varying_rest_curvature": {"modes": (0.8, 0.3, 0.0, 0.2, 0.0, -0.4, 0.0, 0.1, 0.0, -0.2)},
    "nonuniform_stiffness": {"position": 0.4, "width": 0.2, "factor": 0.5, "slope": 0.3},
    "point_mass": {"position": 0.23, "mass": 0.1},
    "wind": {"velocity": (1.5, -0.7, 0.4), "c_d": 1.1},
    "tilted_gravity": {"angles": (0.1, -0.15), "acceleration": (0.3, 0.2, -9.7)},
    "stretch": {"EA": 80.0},
    "internal_friction": {"moment": 1e-3, "kappa_c": 0.8},
    "stiffening_bending": {"c": 0.02},
    "anisotropic_bending": {"ratio": 2.5, "direction": 0.4},
    "gripper_compliance": {"stiffness": 0.02},
    "gripper_play": {"angle": 0.05, "stiffness": 0.02},
    "gripper_damping": {"stiffness": 0.02, "loss_time": 0.03},
    "fluid_forces": {"across": 1.1, "along": 0.1, "added_mass": 0.8},
    "link_chain": {"length": 0.05},
    "time_delay": {"delay": 0.013},
    "marker_offset": {"offset": (0.01, -0.02)},
}
# Effects that need static choices.
INSTANCES = {
    "gripper_compliance": GripperCompliance(hinges=(1,)),
    "gripper_play": GripperPlay(hinges=(1,)),
    "gripper_damping": GripperDamping(hinges=(1,)),
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
        [INSTANCES.get(name) or EFFECTS[name]()],
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


def remembering(made, params, state, values):
    """The state with what the effect remembers of the same ropes a moment earlier."""
    one, r = made.effects[0], state.rods
    if not one.memory:
        return state
    earlier = tree.replace(r, pos=r.pos - 0.02 * r.vel, twist=r.twist - 0.1 * r.twist_rate, vel=0.9 * r.vel)
    seen = one.update_memory(rod.view(made.topology, params.rods, earlier, made.dt), values)
    seen = one.update_memory(
        rod.view(made.topology, params.rods, tree.replace(r, memory={one.name: seen}), made.dt), values
    )
    pos, rate = r.pos + 0.02 * r.vel.flip(-2), r.twist + 0.1 * r.twist_rate.flip(-2)
    return tree.replace(state, rods=tree.replace(r, pos=pos, twist=rate, memory={one.name: seen}))


def track(view: rod.View) -> Track:
    """Seven frames of markers where edges begin, the first two of which are gripped."""
    real = [slot for slot, mask in enumerate(view.topology.edge_mask()) if mask]  # others have no frame
    time = 0.01 * torch.arange(7, dtype=view.state.pos.dtype)
    t = time[:, None, None]
    m1, m2, pos, vel = (x[..., real, :].unsqueeze(-3) for x in (*view.frames(), view.state.pos, view.state.vel))
    pos = pos + t * vel + 3 * t.square() * m1
    gripped = torch.arange(len(real)) < 2
    return Track(time, pos, m1 + t * m2, m2 - t * m1, gripped)


def matrix(bend: torch.Tensor) -> torch.Tensor:
    """Bending stiffness of 1, 2 or 3 numbers as (11, 22, 12)."""
    if bend.shape[-1] == 3:
        return bend
    return torch.cat([bend[..., :1], bend[..., -1:], torch.zeros_like(bend[..., :1])], -1)


def respond(made, params, state, values=None) -> dict[str, torch.Tensor]:
    """Everything the effect does: loads, flow, what it remembers, shifts of markers, and the numbers it alters."""
    one = made.effects[0]
    values = params.effects[one.name] if values is None else values
    altered = one.modify_material(made.topology, params.rods, values)
    state = remembering(made, params, state, values)
    view = rod.view(made.topology, altered, state.rods, made.dt)
    found = dict(effect.total_loads([one], view, {one.name: values}))
    flow = one.plastic_flow(view, values)
    if flow is not None:
        found["flow"] = flow
    if one.memory:
        found["remembered"] = one.update_memory(view, values)
    if one.kind == "measurement":
        seen = track(view)
        found["observed"] = one.observe(seen, values) - seen.pos
    for part in ("rest", "material"):
        before, after = getattr(params.rods, part), getattr(altered, part)
        for field in before.__dataclass_fields__:
            old, new = getattr(before, field), getattr(after, field)
            if old is not new:
                old, new = (matrix(old), matrix(new)) if field == "bend" else (old, new)
                found[f"altered {part}.{field}"] = new - old
    return found


__all__ = ["ACTIVE", "EFFECTS", "F64", "INSTANCES", "default_values", "respond", "ropes", "scene", "track"]
