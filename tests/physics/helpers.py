"""Shapes, energies and an exact solver of statics, shared by the tests of the rods."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from torchdlo.physics import tree
from torchdlo.physics.effects import EFFECTS
from torchdlo.physics.effects import base as effect
from torchdlo.physics.effects.elastic import Bend, BendFrame, Stretch, Twist
from torchdlo.physics.rod import kinematics as rod
from torchdlo.physics.rod.topology import preceding
from torchdlo.scene import Control, Params, Scene, State, stationary_control, step

F64 = torch.float64
ELASTIC = (Stretch, Bend, BendFrame, Twist)


def vec(*numbers: float) -> Tensor:
    return torch.tensor(numbers, dtype=F64)


def straight(n: int, length: float = 1.0, along: Sequence[float] = (1, 0, 0), start: float = 0.0) -> Tensor:
    """Vertices (n, 3) of a straight rope from `start` to `start + length` along an axis."""
    axis = vec(*along)
    return start * axis + torch.linspace(0, length, n, dtype=F64)[:, None] * axis / axis.norm()


def circle(n: int, radius: float = 1.0) -> Tensor:
    """Vertices (n, 3) of a closed ring in the x-y plane."""
    a = 2 * math.pi * torch.arange(n, dtype=F64) / n
    return radius * torch.stack([torch.cos(a), torch.sin(a), torch.zeros_like(a)], -1)


def wild(n: int, seed: int, closed: bool = False, batch: tuple[int, ...] = (), rough: float = 0.15) -> Tensor:
    """Random bent vertices (..., n, 3) with unequal edges."""
    g = torch.Generator().manual_seed(seed)
    base = circle(n, 0.2 * n / 6.28) if closed else straight(n, 0.2 * (n - 1))
    noise = torch.randn(*batch, n, 3, generator=g, dtype=F64)
    return base + rough * 0.5 * noise


def rand(*shape: int, seed: int = 0, low: float = 0.5, high: float = 2.0) -> Tensor:
    g = torch.Generator().manual_seed(seed)
    return low + (high - low) * torch.rand(*shape, generator=g, dtype=F64)


def altered(scene: Scene, params: Params) -> rod.RodParams:
    """The rods' parameters as the effects change them."""
    rods = params.rods
    for e in scene.effects:
        rods = e.modify_material(scene.topology, rods, params.effects.get(e.name, {}))
    return rods


def view(
    scene: Scene, params: Params, state: State, pos: Tensor | None = None, twist: Tensor | None = None
) -> rod.View:
    """The view of a state whose positions and twists are replaced; frames are carried along, differentiably."""
    rods = altered(scene, params)
    s = state.rods
    old = rod.view(scene.topology, rods, s, scene.dt / scene.substeps)
    if pos is not None:
        director, reference = rod.advance_frames(scene.topology, rods, old, pos)
        s = tree.replace(s, pos=pos, director=director, ref_twist=reference)
    if twist is not None:
        s = tree.replace(s, twist=twist)
    return rod.view(scene.topology, rods, s, scene.dt / scene.substeps)


def energy(
    scene: Scene, params: Params, state: State, pos: Tensor | None = None, twist: Tensor | None = None
) -> Tensor:
    """Elastic energy of the scene's effects [J], per scene."""
    v = view(scene, params, state, pos, twist)
    parts = [e.energy(v, params.effects[e.name]).sum((-1, -2)) for e in scene.effects if isinstance(e, ELASTIC)]
    return sum(parts, torch.zeros(()))


def loads(scene: Scene, params: Params, state: State) -> tuple[Tensor, Tensor]:
    """Forces on vertices [N] (..., V, 3) and torques on edges [N m] (..., V, 1) of the effects in closed form."""
    v = view(scene, params, state)
    found = effect.total_loads(scene.effects, v, params.effects)
    mask = v.params.rest.edge_mask
    pull = found.get("gradient", torch.zeros_like(v.state.pos)) * mask
    force = pull - preceding(scene.topology, pull) + found.get("force", 0.0)
    if "acceleration" in found:
        force = force + v.params.material.mass * found["acceleration"]
    return force, found.get("torque", torch.zeros_like(v.state.twist)) * mask


def effects(*names: str) -> list:
    return [EFFECTS[name]() for name in names]


@dataclass
class Statics:
    """Equilibrium of inextensible rods by Newton's method on the exact Lagrangian, load by load."""

    scene: Scene
    params: Params
    state: State
    fixed: Sequence[tuple[int, int]] = ()
    """Held coordinates (vertex, axis)."""
    fixed_twist: Sequence[int] = ()
    twisting: bool = False
    """Whether twists are unknowns."""
    potential: Callable[[Tensor, float], Tensor] = lambda pos, share: pos.sum() * 0
    """Potential of the loads [J] at positions (V, 3), at a share of the whole load."""
    tension: Tensor | None = None
    lengths: bool = True
    residual: float = field(default=math.nan, init=False)

    def __post_init__(self) -> None:
        size = self.scene.topology.size
        real = torch.tensor(self.scene.topology.edge_mask()) > 0
        held = torch.zeros(size, 3, dtype=torch.bool)
        for vertex, axis in self.fixed:
            held[vertex, axis] = True
        self.real = real
        self.free_x = (~held.reshape(-1)).nonzero().squeeze(-1)
        free_t = real.clone() if self.twisting else torch.zeros(size, dtype=torch.bool)
        for slot in self.fixed_twist:
            free_t[slot] = False
        self.free_t = free_t.nonzero().squeeze(-1)
        after = torch.tensor(self.scene.topology.successor())
        bound = held.all(-1)
        self.edges = (real & ~(bound & bound[after])).nonzero().squeeze(-1)
        if not self.lengths:
            self.edges = self.edges[:0]
        self.after = after
        if self.tension is None:
            self.tension = torch.zeros(len(self.edges), dtype=F64)

    def split(self, z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        a, b = len(self.free_x), len(self.free_x) + len(self.free_t)
        pos = self.state.rods.pos.reshape(-1).index_put((self.free_x,), z[:a]).reshape(-1, 3)
        twist = self.state.rods.twist.reshape(-1).index_put((self.free_t,), z[a:b]).reshape(-1, 1)
        return pos, twist, z[b:]

    def lagrangian(self, z: Tensor, share: float) -> Tensor:
        pos, twist, tension = self.split(z)
        u = energy(self.scene, self.params, self.state, pos, twist) + self.potential(pos, share)
        length = (pos[self.after[self.edges]] - pos[self.edges]).norm(dim=-1)
        return u + (tension * (length - self.params.rods.rest.length[self.edges, 0])).sum()

    def unknowns(self) -> Tensor:
        return torch.cat(
            [self.state.rods.pos.reshape(-1)[self.free_x], self.state.rods.twist.reshape(-1)[self.free_t], self.tension]
        )

    def gradient(self, z: Tensor, share: float = 1.0) -> Tensor:
        return torch.func.grad(self.lagrangian)(z, share)

    def hessian(self, share: float = 1.0) -> Tensor:
        z = self.unknowns()
        return torch.func.jacrev(torch.func.grad(self.lagrangian), chunk_size=128)(z, share)

    def take(self, z: Tensor) -> None:
        """Make z the state; the frames follow."""
        pos, twist, tension = self.split(z.detach())
        v = view(self.scene, self.params, self.state, pos, twist)
        self.state = tree.replace(self.state, rods=v.state)
        self.tension = tension

    def solve(
        self, shares: Sequence[float] = (1.0,), steps: int = 40, tolerance: float = 1e-11, reach: float = 0.3
    ) -> State:
        """Newton with the largest change of a step limited to `reach` edge lengths."""
        h = float(self.params.rods.rest.length[self.real].mean())
        for share in shares:
            for _ in range(steps):
                z = self.unknowns()
                g = self.gradient(z, share)
                k = torch.func.jacrev(torch.func.grad(self.lagrangian), chunk_size=128)(z, share)
                dz = -torch.linalg.solve(k, g)
                a = len(self.free_x)
                big = float(dz[:a].abs().max()) / (reach * h)
                self.take(z + dz / max(1.0, big))
                self.residual = float(dz[:a].abs().max()) / h
                if self.residual < tolerance:
                    break
            assert self.residual < 1e-7, f"statics did not converge: last change {self.residual:.1e} edges at {share}"
        return self.state

    def lowest(self, count: int = 1) -> Tensor:
        """Lowest eigenvalues of the energy's second derivative on motions that keep lengths."""
        k = self.hessian()
        m = len(self.free_x) + len(self.free_t)
        upper, jac = k[:m, :m], k[m:, :m]
        if len(jac):
            _, s, v = torch.linalg.svd(jac, full_matrices=True)
            null = v[int((s > 1e-10 * s.max()).sum()) :].T
            upper = null.T @ upper @ null
        return torch.linalg.eigvalsh(upper)[:count]


def run(
    scene: Scene,
    params: Params,
    state: State,
    count: int,
    control: Control | Callable[[int, State], Control] | None = None,
    seen: Callable[[State], object] | None = None,
) -> tuple[State, list]:
    """Step without gradients; returns the last state and what `seen` said after every step.

    Held parts stay where they are, or follow a control or a function (number of the step, state) -> control.
    """
    out = []
    with torch.no_grad():
        given = stationary_control(scene, state) if control is None else control
        for k in range(count):
            state = step(scene, params, state, given(k, state) if callable(given) else given)
            if seen is not None:
                out.append(seen(state))
    return state, out


def length_error(scene: Scene, params: Params, state: State) -> float:
    """Largest relative error of edge lengths."""
    edge = rod.edge_vectors(scene.topology, state.rods.pos, params.rods.rest.edge_mask).norm(dim=-1, keepdim=True)
    return float(((edge / params.rods.rest.length - 1) * params.rods.rest.edge_mask).abs().max())


def speed(state: State) -> float:
    return float(state.rods.vel.norm(dim=-1).max())
