"""Drive PyElastica: one uniform Cosserat rod whose ends are held and moved as prescribed.

Used by the scripts that make reference runs and the sample recording. Needs the extra `peers`
(pyelastica 1.0.0, doi:10.1098/rsos.171628), imported on first use.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

GRAVITY = 9.81
Motion = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Times (T,) [s] -> anchor positions (T, G, 3) [m] and rotations (T, G, 3, 3), body to world.

The body's x axis points along the rod from its first to its last node, at both ends.
"""


@dataclass(frozen=True)
class Rope:
    """A uniform, naturally straight rod of circular section."""

    length: float
    """Length from first to last node [m]."""
    radius: float
    """Radius of the section [m]."""
    density: float
    """Mass per volume [kg/m^3]."""
    youngs: float
    """Young's modulus, of bending [Pa]; the shear modulus, of twisting, is a third of it."""
    stiffening: float = 1.0
    """Factor on the stretching and shearing stiffness only; large is close to inextensible."""

    @property
    def area(self) -> float:
        """Area of the section [m^2]."""
        return math.pi * self.radius**2

    @property
    def bending(self) -> float:
        """Bending stiffness E I [N m^2]."""
        return self.youngs * math.pi * self.radius**4 / 4

    @property
    def twisting(self) -> float:
        """Twisting stiffness G J [N m^2]."""
        return self.youngs / 3 * math.pi * self.radius**4 / 2

    def numbers(self) -> dict[str, float]:
        """The rod's numbers by name, SI units."""
        return {
            "length": self.length,
            "radius": self.radius,
            "density": self.density,
            "mass": self.density * self.area * self.length,
            "youngs_modulus": self.youngs,
            "shear_modulus": self.youngs / 3,
            "stretch_modulus": self.youngs * self.stiffening,
            "bending_stiffness": self.bending,
            "twisting_stiffness": self.twisting,
            "axial_stiffness": self.youngs * self.stiffening * self.area,
        }

    def time_step(self, edge: float) -> float:
        """A step [s] with margin below the limits of stretching waves and of shearing."""
        speed = math.sqrt(self.youngs * self.stiffening / self.density)
        return 0.45 * min(edge / speed, math.sqrt(3) * self.radius / speed)


@dataclass(frozen=True)
class Grip:
    """One held end: its nodes, the elements among them, and where they sit behind the anchor."""

    last: bool = False
    """Whether the last end is held, not the first."""
    elements: int = 1
    """Number of elements whose frames are held; their nodes are held too, one more."""
    anchor: float = 0.0
    """Arclength from the rod's end to the anchor, the point whose motion is given [m]."""
    loose: bool = False
    """Whether the innermost of those nodes stays free, as in PyElastica's own clamp."""


@dataclass(frozen=True)
class Start:
    """Where a run begins; at rest unless velocities are given."""

    positions: np.ndarray
    """Node positions [m], shape (3, n+1)."""
    directors: np.ndarray
    """Rows d1, d2, d3 per element, shape (3, 3, n)."""
    velocities: np.ndarray | None = None
    """Node velocities [m/s], shape (3, n+1)."""
    spins: np.ndarray | None = None
    """Angular velocities in the material frame [rad/s], shape (3, n)."""


@dataclass(frozen=True)
class Run:
    """Frames of a run and its last state."""

    time: np.ndarray
    """Times of the frames [s], shape (F,)."""
    positions: np.ndarray
    """Node positions [m], shape (F, n+1, 3)."""
    d1: np.ndarray
    """First director of every element, unit vectors, shape (F, n, 3)."""
    end: Start
    """State after the last frame."""
    time_step: float
    """Integration step [s]."""


def rotation(yaw: np.ndarray, pitch: np.ndarray, roll: np.ndarray) -> np.ndarray:
    """Rotations Rz(yaw) Ry(-pitch) Rx(roll); angles (...) [rad], result (..., 3, 3)."""
    (cy, sy), (cp, sp), (cr, sr) = ((np.cos(a), np.sin(a)) for a in (yaw, pitch, roll))
    one, zero = np.ones_like(cy), np.zeros_like(cy)

    def matrix(*rows):
        return np.stack([np.stack(r, -1) for r in rows], -2)

    about_z = matrix((cy, -sy, zero), (sy, cy, zero), (zero, zero, one))
    about_y = matrix((cp, zero, -sp), (zero, one, zero), (sp, zero, cp))
    about_x = matrix((one, zero, zero), (zero, cr, -sr), (zero, sr, cr))
    return about_z @ about_y @ about_x


def quaternion(matrix: np.ndarray) -> np.ndarray:
    """Rotation matrices (..., 3, 3) as continuous (w, x, y, z) along the first axis (..., 4)."""
    m = matrix
    trace = np.trace(m, axis1=-2, axis2=-1)
    diagonal = np.stack([trace, m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]], -1)
    size = np.maximum(1 - trace[..., None] + 2 * diagonal, 0) / 4
    size[..., 0] = np.maximum(1 + trace, 0) / 4  # squares of w, x, y, z
    pairs = [
        (m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]),
        (m[..., 1, 0] + m[..., 0, 1], m[..., 0, 2] + m[..., 2, 0], m[..., 2, 1] + m[..., 1, 2]),
    ]
    wx, wy, wz = (p / 4 for p in pairs[0])
    xy, xz, yz = (p / 4 for p in pairs[1])
    s = size
    rows = np.stack(
        [
            np.stack([s[..., 0], wx, wy, wz], -1),
            np.stack([wx, s[..., 1], xy, xz], -1),
            np.stack([wy, xy, s[..., 2], yz], -1),
            np.stack([wz, xz, yz, s[..., 3]], -1),
        ],
        -2,
    )
    best = np.argmax(s, -1)[..., None, None]
    quat = np.take_along_axis(rows, best, -2)[..., 0, :]
    quat = quat / np.linalg.norm(quat, axis=-1, keepdims=True)
    flip = np.sign(np.sum(quat[1:] * quat[:-1], -1, keepdims=True))
    quat[1:] *= np.cumprod(np.where(flip == 0, 1, flip), 0)
    return quat


def smooth(time: np.ndarray, duration: float) -> np.ndarray:
    """Step from 0 to 1 within `duration` with two vanishing derivatives at both ends."""
    u = np.clip(time / duration, 0, 1)
    return u**3 * (10 - 15 * u + 6 * u**2)


@functools.cache
def _classes():
    """PyElastica's simulator with what is used here, and the boundary condition of a grip."""
    import elastica as ea
    from elastica.boundary_conditions import ConstraintBase

    class Simulator(ea.BaseSystemCollection, ea.Constraints, ea.Forcing, ea.Damping):
        pass

    class Held(ConstraintBase):
        """Nodes and frames at one end follow a schedule given at every half step."""

        def __init__(self, *, schedule, grip, half_step, **kwargs):
            super().__init__(**kwargs)
            self.positions, self.velocities, self.directors = schedule
            nodes, elements = self.positions.shape[-1], grip.elements
            self.nodes = slice(-nodes, None) if grip.last else slice(0, nodes)
            self.elements = slice(-elements, None) if grip.last else slice(0, elements)
            self.half_step = half_step

        def constrain_values(self, system, time):
            k = min(round(time / self.half_step), len(self.positions) - 1)
            system.position_collection[:, self.nodes] = self.positions[k]
            system.director_collection[:, :, self.elements] = self.directors[k][..., None]

        def constrain_rates(self, system, time):
            k = min(round(time / self.half_step), len(self.positions) - 1)
            system.velocity_collection[:, self.nodes] = self.velocities[k]
            system.omega_collection[:, self.elements] = 0.0  # held frames are set, not turned

    return ea, Simulator, Held


def held_nodes(rope: Rope, n: int, grip: Grip, anchor: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Positions [m] (T, 3, K) of a grip's nodes, for anchors (T, 3) and rotations (T, 3, 3)."""
    count = grip.elements + (not grip.loose)
    ahead = np.arange(count) * rope.length / n - grip.anchor
    if grip.last:
        ahead = -ahead[::-1]
    return anchor[..., None] + turn[..., :, :1] * ahead


def directors(turn: np.ndarray) -> np.ndarray:
    """Director rows d1, d2, d3 = body y, z, x axes of rotations (..., 3, 3)."""
    return np.stack([turn[..., 1], turn[..., 2], turn[..., 0]], -2)


def simulate(
    rope: Rope,
    n: int,
    grips: tuple[Grip, ...],
    motion: Motion,
    *,
    times: np.ndarray,
    damping: float = 0.0,
    gravity: float = GRAVITY,
    start: Start | None = None,
    refine: int = 1,
) -> Run:
    """Run one rod of `n` elements; frames at even `times` (F,) [s] from 0, damping rate [1/s]."""
    ea, Simulator, Held = _classes()
    frame = times[1] - times[0]
    substeps = refine * math.ceil(frame / rope.time_step(rope.length / n))
    dt = frame / substeps
    half = np.arange(2 * substeps * (len(times) - 1) + 1) * dt / 2
    anchors, turns = motion(half)
    rod = ea.CosseratRod.straight_rod(
        n,
        np.zeros(3),
        np.array([1.0, 0.0, 0.0]),
        np.array([0.0, 1.0, 0.0]),
        rope.length,
        rope.radius,
        rope.density,
        youngs_modulus=rope.youngs,
    )
    rod.shear_matrix *= rope.stiffening
    simulator = Simulator()
    simulator.append(rod)
    if start is None:  # straight along x, first anchor where the motion has it
        rod.position_collection += (anchors[0, 0] - [grips[0].anchor, 0, 0])[:, None]
    else:
        rod.position_collection[:] = start.positions
        rod.director_collection[:] = start.directors
        if start.velocities is not None:
            rod.velocity_collection[:] = start.velocities
            rod.omega_collection[:] = start.spins
    for i, grip in enumerate(grips):
        nodes = held_nodes(rope, n, grip, anchors[:, i], turns[:, i])
        schedule = nodes, np.gradient(nodes, dt / 2, axis=0), directors(turns[:, i])
        simulator.constrain(rod).using(Held, schedule=schedule, grip=grip, half_step=dt / 2)
    if gravity:
        acceleration = np.array([0.0, 0.0, -gravity])
        simulator.add_forcing_to(rod).using(ea.GravityForces, acc_gravity=acceleration)
    if damping:
        simulator.dampen(rod).using(ea.AnalyticalLinearDamper, uniform_damping_constant=damping, time_step=dt)
    simulator.finalize()
    stepper, now = ea.PositionVerlet(), 0.0
    positions, d1 = [], []
    for k in range(len(times)):
        for _ in range(substeps if k else 0):
            now = stepper.step(simulator, now, dt)
        positions.append(rod.position_collection.T.copy())
        d1.append(rod.director_collection[0].T.copy())
    if not np.isfinite(positions[-1]).all():
        raise RuntimeError(f"the run of {n} elements blew up with steps of {dt:.3g} s")
    state = (
        rod.position_collection,
        rod.director_collection,
        rod.velocity_collection,
        rod.omega_collection,
    )
    return Run(times, np.array(positions), np.array(d1), Start(*(a.copy() for a in state)), dt)


def resample(positions: np.ndarray, arclength: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Positions (F, n+1, 3) at even arclengths (n+1,) as cubic splines at `wanted` (M,) [m]."""
    from scipy.interpolate import CubicSpline

    return CubicSpline(arclength, positions, axis=1)(wanted)


def gap(a: np.ndarray, b: np.ndarray) -> float:
    """Largest distance [mm] between two sets of points (..., 3)."""
    return float(1e3 * np.linalg.norm(a - b, axis=-1).max())


def still(time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The motion of one end held at the origin along x."""
    shape = (len(time), 1, 3)
    return np.zeros(shape), np.broadcast_to(np.eye(3), (*shape, 3))


def lead_in(
    rope: Rope,
    n: int,
    grips: tuple[Grip, Grip],
    pose: tuple[np.ndarray, np.ndarray],
    *,
    duration: float,
    gravity: float = GRAVITY,
) -> Start:
    """Bring a straight rod to a pose of its two ends, strongly damped, and let it come to rest.

    Args:
        pose: Anchors (2, 3) [m] and yaw, pitch, roll (2, 3) [rad] of the two ends.
        duration: Time for it [s]; the motion takes the first 0.3 of it.
    """
    span = rope.length - grips[0].anchor - grips[1].anchor
    straight = np.array([[0.0, 0.0, 0.0], [span, 0.0, 0.0]])

    def motion(time):
        tilt, part = (smooth(time, c * duration)[:, None, None] for c in (0.1, 0.3))
        turns = rotation(*np.moveaxis(tilt * pose[1], -1, 0))  # first, so that it buckles that way
        return straight + part * (pose[0] - straight), turns

    times = np.array([0.0, duration])
    end = simulate(rope, n, grips, motion, times=times, damping=12.0, gravity=gravity).end
    residual = np.linalg.norm(end.velocities, axis=0).max()
    print(f"  lead-in: residual speed {residual:.1e} m/s")
    return replace(end, velocities=None, spins=None)
