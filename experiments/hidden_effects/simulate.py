"""Simulate ropes as geometrically exact rods, for recordings whose answer is known. Imports nothing of torchdlo.

Nodes have a position and an orientation each; between neighbours the strains of Simo and Reissner's rod are taken at
one point (Simo 1985, doi:10.1016/0045-7825(85)90050-7; one-point integration: Simo and Vu-Quoc 1986,
doi:10.1016/0045-7825(86)90079-4), so that a clamp holds a node's direction exactly where it is. Shear and stretch are
stiff, not excluded. Time steps are the generalised-alpha method for rotations (Bruels, Cardona, Arnold 2012,
doi:10.1016/j.mechmachtheory.2011.07.017), second-order, implicit; Newton's matrix is banded, found by coloured
differences in the bodies' frames, where it hardly changes, and kept while it serves. Several ropes and trials go
through at once: arrays are (components, rows, nodes).
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property

import laws
import numpy as np
from laws import Laws
from scipy.linalg import lapack
from vectors import Array, back, conjugate, cross, exponential, halfway, logarithm, multiply, rotate

GRAVITY = 9.81
SPECTRAL = 0.8
"""Factor by which a step reduces waves that are too fast for it."""
TOLERANCE = 1e-8
"""Largest correction [m, rad] after which a step is done."""
GRADING = 0.5
"""How much shorter than on average elements next to a clamp are, relatively."""
HALVINGS = 4
"""How often a step that does not converge is halved."""
WIDTH = 11
"""Entries of Newton's matrix on each side of its diagonal."""

Poses = Callable[[Array], tuple[Array, Array]]
"""Times (T,) [s] -> positions (3, B, G, T) [m] of clamps and their orientations (4, B, G, T), x axis along the rope."""


@dataclass(frozen=True)
class Rope:
    """A uniform rope, straight when undeformed."""

    length: float
    """Length between the first and the last marker [m]."""
    radius: float
    """Radius [m]."""
    mass: float
    """Mass of that length [kg]."""
    bending: float
    """Bending stiffness [N m^2]."""
    twisting: float
    """Twisting stiffness [N m^2]."""
    damping: float
    """Rate at which velocities decay [1/s]."""
    axial: float = 2e4
    """Stretching and shearing stiffness [N]; large, as the rope should not stretch."""


@dataclass(frozen=True)
class Mesh:
    """How the rope is cut and held: free from `first` to `last` [m], beyond which clamps hold it."""

    elements: int
    """Elements of the free part."""
    first: float
    """Arclength at which the first clamp ends [m]."""
    last: float
    """Arclength at which the second clamp begins, or the rope ends [m]."""
    both: bool
    """Whether there is a second clamp."""

    @cached_property
    def arclength(self) -> Array:
        """Arclength of the nodes [m], (N,), closer together at clamps, where a rope bends most."""
        u, turns = np.linspace(0.0, 1.0, self.elements + 1), 2 if self.both else 1
        share = u - GRADING * np.sin(turns * np.pi * u) / (turns * np.pi)
        return self.first + (self.last - self.first) * share

    @cached_property
    def step(self) -> Array:
        """Lengths of the elements [m], (N - 1,)."""
        return np.diff(self.arclength)

    @cached_property
    def share(self) -> Array:
        """Length of rope that belongs to each node [m], (N,)."""
        return 0.5 * (np.append(self.step, 0.0) + np.append(0.0, self.step))

    def points(self, x: Array, q: Array, arclength: Array, offset: Array) -> Array:
        """Return markers (3, F, M) between nodes, by cubics with the nodes' tangents, and beside the axis."""
        low = np.clip(np.searchsorted(self.arclength, arclength, side="right") - 1, 0, self.elements - 1)
        step = self.step[low]
        u = np.clip((arclength - self.arclength[low]) / step, 0.0, 1.0)
        tangent = rotate(q, np.eye(3)[:, :1, None])
        axis = (
            (1 + 2 * u) * (1 - u) ** 2 * x[..., low]
            + u * (1 - u) ** 2 * step * tangent[..., low]
            + u * u * (3 - 2 * u) * x[..., low + 1]
            - u * u * (1 - u) * step * tangent[..., low + 1]
        )
        if not offset.any():
            return axis
        turn = q[..., low] * (1 - u) + q[..., low + 1] * u
        return axis + rotate(turn / np.sqrt((turn * turn).sum(0)), offset[:, None, None])


@dataclass
class State:
    """Where all rows are, how they move, and what their laws remember; arrays (components, B, N)."""

    x: Array
    """Positions [m]."""
    q: Array
    """Orientations."""
    v: Array
    """Velocities [m/s], then angular velocities in the body's frame [rad/s]."""
    dv: Array
    """Their rates [m/s^2, rad/s^2]."""
    a: Array
    """The method's own accelerations."""
    memory: dict[str, Array] = field(default_factory=dict)
    """What laws remember, by name."""


@dataclass(frozen=True)
class Track:
    """Nodes at the ends of all steps."""

    time: Array
    """Times [s], (S,)."""
    x: Array
    """Positions [m], (S, 3, B, N)."""
    q: Array
    """Orientations, (S, 4, B, N)."""


class Diverged(RuntimeError):
    """A step has no solution that Newton's method finds."""


class Simulator:
    """One rope, some rows of it, each with laws and a motion of its own."""

    def __init__(
        self, rope: Rope, mesh: Mesh, given: Laws, poses: Poses, dt: float, spectral: float = SPECTRAL
    ) -> None:
        self.rope, self.mesh, self.laws, self.poses, self.dt = rope, mesh, given, poses, dt
        self.am, self.af = (2 * spectral - 1) / (spectral + 1), spectral / (spectral + 1)
        self.implicit_weight = 0.5 + self.af - self.am
        self.beta = 0.25 * (self.implicit_weight + 0.5) ** 2
        nodes, rows = mesh.elements + 1, given.rows
        density, share = rope.mass / rope.length, mesh.share
        self.weight = density * share + laws.extra_mass(given, mesh.arclength)
        self.inertia = density * rope.radius**2 * np.array([0.5, 0.25, 0.25])[:, None] * share
        self.held = np.zeros((6, nodes), bool)
        self.held[:, 0] = True
        if mesh.both:
            self.held[:, -1] = True
        if laws.loose(given):
            self.held[3:] = False
        self.matrix: tuple[Array, Array] | None = None
        self.free = (~self.held).astype(float)[:, None]
        self._places(rows, nodes)

    def _places(self, rows: int, nodes: int) -> None:
        """Remember where differences by colour go in the banded matrix."""
        column, c, r, j = [], [], [], []
        for offset in (-1, 0, 1):
            for i in range(max(0, -offset), min(nodes, nodes - offset)):
                for by in range(6):
                    for of in range(6):
                        column.append(i), c.append(by), r.append(of), j.append(i + offset)
        node, by, of, at = (np.array(k) for k in (column, c, r, j))
        self.source = (of, node % 3 * 6 + by, slice(None), at)
        row, col = at * 6 + of, node * 6 + by
        shift = np.arange(rows) * nodes * 6
        self.target = (2 * WIDTH + (row - col)[:, None] + 0 * shift, col[:, None] + shift)
        self.colour = np.zeros((6, 18, 1, nodes))
        for k in range(3):
            for by in range(6):
                self.colour[by, k * 6 + by, :, k::3] = 1.0

    def rates(self, state: State, move: Array) -> tuple[Array, Array, Array]:
        """Return accelerations, velocities and their rates if nodes move by `move` (6, ..., B, N) [m, rad]."""
        h, old = self.dt, [k[:, None] if move.ndim == 4 else k for k in (state.a, state.v, state.dv)]
        a = ((move / h - old[1]) / h - (0.5 - self.beta) * old[0]) / self.beta
        v = old[1] + h * ((1 - self.implicit_weight) * old[0] + self.implicit_weight * a)
        dv = ((1 - self.am) * a + self.am * old[0] - self.af * old[2]) / (1 - self.af)
        return a, v, dv

    def residual(self, state: State, move: Array, time: float, grips: tuple[Array, Array, Array]) -> Array:
        """Return the lack of balance (6, ..., B, N) [N, N m] in the nodes' frames; 0 where they are held.

        Args:
            state: before the step.
            move: what nodes do in it: a displacement in the world frame, a rotation in their own.
            time: after the step [s].
            grips: poses of the clamps then, and their angular velocities.
        """
        x0, q0 = (k[:, None] if move.ndim == 4 else k for k in (state.x, state.q))
        x, q = x0 + move[:3], multiply(q0, exponential(move[3:]))
        _, v, dv = self.rates(state, move)
        rope, h = self.rope, self.mesh.step
        middle = halfway(q[..., :-1], q[..., 1:])
        edge = (x[..., 1:] - x[..., :-1]) / h
        strain = back(middle, edge)
        strain[0] -= 1.0
        axial = laws.axial(self.laws, rope)
        strain[0] *= axial
        strain[1:] *= rope.axial
        force = rotate(middle, strain)
        kappa = logarithm(multiply(conjugate(q[..., :-1]), q[..., 1:])) / h
        spin = v[3:]
        moment = rotate(middle, laws.moment(self.laws, rope, self.mesh, kappa, spin, state.memory, time))
        lever = 0.5 * h * cross(edge, force)
        out = np.zeros_like(move)
        inner, turn = out[:3], out[3:]
        # Balance: mass times acceleration minus all loads; the elements' force and moment act on both their nodes.
        inner += self.weight * dv[:3] - laws.force(self.laws, rope, self.mesh, self.weight, x, q, v[:3], time)
        inner += laws.added_inertia(self.laws, rope, self.mesh, q, dv[:3])
        inner[..., :-1] -= force
        inner[..., 1:] += force
        turn[..., :-1] -= moment + lever
        turn[..., 1:] += moment - lever
        inner[:] = back(q0, inner)
        turn[:] = back(q, turn) + self.inertia.reshape(3, *(1,) * (x.ndim - 2), -1) * (dv[3:] + rope.damping * spin)
        if laws.loose(self.laws):
            turn += laws.grip_moment(self.laws, q, spin, grips, self.mesh.both)
        return out * (self.free[:, None] if move.ndim == 4 else self.free)

    def factorise(self, state: State, move: Array, time: float, grips) -> None:
        """Find Newton's matrix by differences, one colour of nodes and one component at a time, and factorise it."""
        size = 1e-7
        base = self.residual(state, move, time, grips)
        nodes, rows = base.shape[-1], base.shape[-2]
        # In the node's frame, as the residual.
        change = np.broadcast_to(self.colour * size, (6, 18, rows, nodes)).copy() * self.free[:, None]
        change[:3] = rotate(state.q[:, None], change[:3])
        gradient = (self.residual(state, move[:, None] + change, time, grips) - base[:, None]) / size
        band = np.zeros((3 * WIDTH + 1, rows * nodes * 6))
        band[self.target] = gradient[self.source].reshape(len(self.target[0]), rows)
        fixed = np.broadcast_to(self.held.T[None], (rows, nodes, 6)).ravel()
        band[2 * WIDTH, fixed] = 1.0
        lu, pivots, info = lapack.dgbtrf(band, WIDTH, WIDTH)
        if info:
            raise Diverged(f"the simulation failed at {time:.3f} s: Newton's matrix is singular")
        self.matrix = lu, pivots

    def correction(self, state: State, residual: Array) -> Array:
        """Return Newton's correction of the move."""
        lu, pivots = self.matrix
        found, _ = lapack.dgbtrs(lu, WIDTH, WIDTH, -residual.transpose(1, 2, 0).ravel(), pivots)
        change = found.reshape(residual.shape[1], residual.shape[2], 6).transpose(2, 0, 1).copy()
        change[:3] = rotate(state.q, change[:3])
        return change

    def step(self, state: State, time: float, grips: tuple[Array, Array, Array]) -> State:
        """Return the state one step later, at `time`."""
        h = self.dt
        move = h * state.v + h * h * ((0.5 - self.beta) * state.a + self.beta * state.a)
        anchors, turns, _ = grips
        for k, node in enumerate((0, -1)[: anchors.shape[-1]]):
            move[:3, :, node] = anchors[..., k] - state.x[..., node]
            if self.held[3, node]:
                move[3:, :, node] = logarithm(multiply(conjugate(state.q[..., node]), turns[..., k]))
        before = np.inf
        for tries in range(40):
            if self.matrix is None:
                self.factorise(state, move, time, grips)
            change = self.correction(state, self.residual(state, move, time, grips))
            move += change
            size = abs(change).max()
            if not size < 3.0:
                break
            if size < TOLERANCE:
                return self._accept(state, move, grips, time)
            if tries % 8 == 7 or size > 0.5 * before:
                self.matrix = None
                before = np.inf
            else:
                before = size
        self.matrix = None
        raise Diverged(f"the simulation failed at {time:.3f} s: Newton's method does not converge; use a smaller dt")

    def _accept(self, state: State, move: Array, grips, time: float) -> State:
        a, v, dv = self.rates(state, move)
        x, q = state.x + move[:3], multiply(state.q, exponential(move[3:]))
        q /= np.sqrt((q * q).sum(0))
        for k, node in enumerate((0, -1)[: grips[0].shape[-1]]):
            # What is prescribed has no inertia of its own: its rates are those of the motion.
            if self.held[3, node]:
                v[3:, :, node], dv[3:, :, node], a[3:, :, node] = grips[2][..., k], 0.0, 0.0
        kappa = logarithm(multiply(conjugate(q[..., :-1]), q[..., 1:])) / self.mesh.step
        memory = laws.update_memory(self.laws, kappa, state.memory, self.dt)
        return State(x, q, v, dv, a, memory)

    def grips(self, times: Array) -> tuple[Array, Array, Array]:
        """Return poses and angular velocities of the clamps, times last."""
        x, q = self.poses(times)
        e = 1e-4
        _, before = self.poses(times - e)
        _, after = self.poses(times + e)
        return x, q, logarithm(multiply(conjugate(before), after)) / (2 * e)

    def _advance(self, state: State, time: float, grips: tuple[Array, Array, Array], halvings: int) -> State:
        """Return the state at `time`, by smaller steps where one does not converge."""
        try:
            return self.step(state, time, grips)
        except Diverged:
            if not halvings:
                raise
        half = copy(self)
        half.dt, half.matrix = 0.5 * self.dt, None
        middle = tuple(p[..., 0] for p in self.grips(np.array([time - half.dt])))
        state = half._advance(state, time - half.dt, middle, halvings - 1)
        return half._advance(state, time, grips, halvings - 1)

    def run(self, state: State, times: Array) -> tuple[Track, State]:
        """Go through the times (S,) [s], `dt` apart, the first of which is the state's."""
        prescribed = self.grips(times)
        xs, qs = [state.x], [state.q]
        for k in range(1, len(times)):
            state = self._advance(state, times[k], tuple(p[..., k] for p in prescribed), HALVINGS)
            xs.append(state.x)
            qs.append(state.q)
        return Track(times, np.array(xs), np.array(qs)), state


def at_rest(x: Array, q: Array) -> State:
    """Return a state without motion."""
    zero = np.zeros((6, *x.shape[1:]))
    return State(x, q, zero, zero.copy(), zero.copy())


def straight(mesh: Mesh, anchors: Array, turns: Array) -> State:
    """Return the rope straight from its first clamp on, anchors (3, B, G) [m], turns (4, B, G)."""
    ahead = np.zeros((3, 1, mesh.elements + 1))
    ahead[0] = mesh.arclength - mesh.first
    q = np.repeat(turns[..., :1], mesh.elements + 1, -1)
    return at_rest(anchors[..., :1] + rotate(q, ahead), q)


def settle(rope: Rope, mesh: Mesh, given: Laws, poses: Poses, duration: float = 4.0, dt: float = 4e-3) -> State:
    """Return the rope at rest in the clamps' pose at time 0, after it was brought there from a straight line.

    The clamps go there in the first half of `duration` [s]; strong damping brings the rope to rest.
    """
    x1, q1 = poses(np.zeros(1))
    start, turn = x1[..., 0], q1[..., 0]
    level = np.zeros_like(turn)
    level[0] = 1.0
    begin = start[:, :, :1] + np.array([0.0, mesh.last - mesh.first])[: start.shape[-1]] * np.eye(3)[0][:, None, None]
    vector = logarithm(turn)

    def there(times: Array) -> tuple[Array, Array]:
        part = ramp(times / (0.5 * duration))
        return begin[..., None] + (start - begin)[..., None] * part, exponential(vector[..., None] * part)

    damped = replace(rope, damping=10.0)
    work = Simulator(damped, mesh, laws.elastic(given), there, dt, spectral=0.3)
    _, state = work.run(straight(mesh, begin, level), np.arange(round(duration / dt) + 1) * dt)
    return at_rest(state.x, state.q)


def ramp(u: Array) -> Array:
    """Return a smooth step from 0 at 0 to 1 at 1, with three vanishing derivatives at its ends."""
    u = np.clip(u, 0.0, 1.0)
    return u**4 * (35 - 84 * u + 70 * u**2 - 20 * u**3)
