"""Laws beyond the plain rope: one dictionary of numbers per row, in SI units; rows without a law are plain.

The library's laws have the names and numbers of recordings.md; `OUTSIDE` are in no library.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from vectors import Array, conjugate, cross, dot, logarithm, multiply, norm, rotate

if TYPE_CHECKING:
    from simulate import Mesh, Rope

AIR = 1.2
"""Density of air [kg/m^3]."""
GRAVITY = 9.81
PLAIN: dict[str, float] = {
    "air_drag.c_d": 0.0,
    "wind.c_d": 0.0,
    "wind.velocity.0": 0.0,
    "wind.velocity.1": 0.0,
    "wind.velocity.2": 0.0,
    "tilted_gravity.angles.0": 0.0,
    "tilted_gravity.angles.1": 0.0,
    "bending_damping.coefficient": 0.0,
    "rest_curvature.curvature.0": 0.0,
    "rest_curvature.curvature.1": 0.0,
    "bending_plasticity.yield_curvature": 1e9,
    "bending_plasticity.rate": 10.0,
    "internal_friction.moment": 0.0,
    "internal_friction.kappa_c": 1.0,
    "stiffening_bending.c": 0.0,
    "nonuniform_stiffness.position": 0.5,
    "nonuniform_stiffness.width": 0.1,
    "nonuniform_stiffness.factor": 0.0,
    "nonuniform_stiffness.slope": 0.0,
    "anisotropic_bending.ratio": 1.0,
    "anisotropic_bending.direction": 0.0,
    "point_mass.position": 0.5,
    "point_mass.mass": 0.0,
    "stretch.EA": np.inf,
    "table_friction.mu": 0.0,
    "gripper_compliance.stiffness": 1e3,
    "time_delay.delay": 0.0,
    "marker_offset.offset.0": 0.0,
    "marker_offset.offset.1": 0.0,
    # Nobody's library has these.
    "attractor.strength": 0.0,
    "attractor.position": 0.0,
    "attractor.at.0": 0.0,
    "attractor.at.1": 0.0,
    "attractor.at.2": 0.0,
    "drifting_stiffness.rate": 0.0,
    "wall.distance": np.inf,
    "wall.normal.0": 1.0,
    "wall.normal.1": 0.0,
    "wall.normal.2": 0.0,
    "backlash.angle": 0.0,
    "rotating_frame.rate": 0.0,
    # The baseline's own numbers, as factors, to see what calibration would absorb.
    "baseline.bending": 1.0,
    "baseline.twisting": 1.0,
    "baseline.damping": 1.0,
    # Of the library, behind the others as their places number them.
    "gripper_play.angle": 0.0,
    "gripper_play.stiffness": 1e3,
    "gripper_damping.stiffness": 1e3,
    "gripper_damping.loss_time": 0.0,
    "fluid_forces.across": 0.0,
    "fluid_forces.along": 0.0,
    "fluid_forces.added_mass": 0.0,
}
"""Numbers by law, and where they do nothing."""

TABLE_RATE = 350.0
"""Frequency at which a node would bounce on the table or the wall [rad/s]."""
SLIP = 5e-4
"""Speed at which friction on the table is three quarters of what it becomes [m/s]."""
STOP = 1.0
"""Stiffness of what ends the play in a clamp [N m/rad]; it alone leaves 25 times the noise in r2b978eb9."""
CORNER = 0.1
"""Share of the play within which a spring that ends it is rounded off."""
SOFT_CLAMP = ("gripper_compliance", "backlash", "gripper_play", "gripper_damping")


@dataclass(frozen=True)
class Laws:
    """What holds for each row."""

    numbers: Sequence[dict[str, float]]
    """Numbers that differ from `PLAIN`, per row."""
    table: float | None = None
    """Height of a table [m]."""
    gravity: float = GRAVITY
    """Gravity [m/s^2]."""
    fluid: float | None = None
    """Density of the liquid around the rope [kg/m^3]."""

    @property
    def rows(self) -> int:
        """How many rows there are."""
        return len(self.numbers)

    @cached_property
    def _names(self) -> frozenset[str]:
        for row in self.numbers:
            for name in row:
                if name not in PLAIN:
                    raise ValueError(f"law {name!r} is unknown; expected one of {', '.join(PLAIN)}")
        return frozenset(name.split(".")[0] for row in self.numbers for name, v in row.items() if v != PLAIN[name])

    def on(self, law: str) -> bool:
        """Return whether any row has the law."""
        return law in self._names

    def get(self, name: str) -> Array:
        """Return a number of all rows, (B, 1)."""
        if name not in self._columns:
            self._columns[name] = np.array([[row.get(name, PLAIN[name])] for row in self.numbers])
        return self._columns[name]

    def vector(self, name: str, count: int = 3) -> Array:
        """Return a number with components of all rows, (count, B, 1), with an axis before B where rows are nested."""
        return np.array([self.get(f"{name}.{k}") for k in range(count)])

    @cached_property
    def _columns(self) -> dict[str, Array]:
        return {}


def _fit(a: Array, like: Array) -> Array:
    """Give components (c, B, 1) the axes of (c, ..., B, N)."""
    return a[:, None] if like.ndim == 4 else a


def elastic(given: Laws) -> Laws:
    """Return the laws without those that remember, for a rope that is only brought to rest."""
    past = ("internal_friction.moment", "bending_plasticity.yield_curvature")
    kept = [{k: v for k, v in row.items() if k not in past} for row in given.numbers]
    return Laws(kept, given.table, given.gravity, given.fluid)


def loose(given: Laws) -> bool:
    """Return whether clamps turn."""
    return any(given.on(law) for law in SOFT_CLAMP)


def extra_mass(given: Laws, arclength: Array) -> Array:
    """Return masses at the nodes [kg], (B, N); the one in between is shared by its neighbours."""
    mass, at = given.get("point_mass.mass"), given.get("point_mass.position")
    return mass * _hats(arclength, at)


def _hats(arclength: Array, at: Array) -> Array:
    """Return how much of what is at places (B, 1) belongs to each node, (B, N)."""
    return np.array([[np.interp(place, arclength, row) for row in np.eye(len(arclength))] for place in at[:, 0]])


def axial(given: Laws, rope: Rope) -> Array:
    """Return the stretching stiffness [N], (B, 1)."""
    return np.minimum(rope.axial, given.get("stretch.EA"))


def stiffness(given: Laws, rope: Rope, mesh: Mesh, time: float) -> Array:
    """Return the bending stiffness of the elements [N m^2], (B, N - 1)."""
    at = 0.5 * (mesh.arclength[:-1] + mesh.arclength[1:]) / rope.length
    scale = rope.bending * given.get("baseline.bending")
    if given.on("nonuniform_stiffness"):
        p, w, f, gradient = (given.get(f"nonuniform_stiffness.{k}") for k in ("position", "width", "factor", "slope"))
        scale = scale * np.exp(f * np.exp(-0.5 * ((at - p) / w) ** 2)) * (1 + gradient * (at - 0.5))
    if given.on("drifting_stiffness"):
        scale = scale * np.exp(given.get("drifting_stiffness.rate") * max(time, 0.0))
    return scale


def moment(
    given: Laws, rope: Rope, mesh: Mesh, kappa: Array, spin: Array, memory: dict[str, Array], time: float
) -> Array:
    """Return moments of the elements in the frame halfway between their nodes [N m], (3, ..., B, N - 1).

    Curvatures kappa [1/m] are rotation vectors per length: twist, then bending about the second and the third axis.
    """
    memory = {name: _fit(a, kappa) for name, a in memory.items()}
    bend = kappa[1:]
    if given.on("rest_curvature"):
        c = _fit(given.vector("rest_curvature.curvature", 2), kappa)
        bend = bend - np.stack([-c[1], c[0]])  # towards the second axis is about the third
    if "plastic" in memory:
        bend = bend - memory["plastic"]
    out = np.empty_like(kappa)
    out[0] = rope.twisting * given.get("baseline.twisting") * kappa[0]
    out[1:] = stiffness(given, rope, mesh, time) * _directed(given, bend, kappa)
    if given.on("stiffening_bending"):
        out[1:] *= 1 + given.get("stiffening_bending.c") * (bend * bend).sum(0)
    if given.on("bending_damping"):
        middle = 0.5 * (spin[..., 1:] + spin[..., :-1])
        rate = (spin[..., 1:] - spin[..., :-1]) / mesh.step + cross(kappa, middle)
        out[1:] += given.get("bending_damping.coefficient") * rate[1:]
    if given.on("internal_friction"):
        out[1:] += given.get("internal_friction.moment") * _dahl(given, kappa, memory)
    return out


def _directed(given: Laws, bend: Array, kappa: Array) -> Array:
    """Return curvatures as a stiffness that depends on direction sees them: times Q, of determinant 1."""
    if not given.on("anisotropic_bending"):
        return bend
    root, angle = np.sqrt(given.get("anisotropic_bending.ratio")), given.get("anisotropic_bending.direction")
    c, s = np.cos(angle), np.sin(angle)
    towards = np.stack([bend[1], -bend[0]])  # bending towards the second and the third axis
    along, across = c * towards[0] + s * towards[1], c * towards[1] - s * towards[0]
    along, across = root * along, across / root
    towards = np.stack([c * along - s * across, s * along + c * across])
    return np.stack([-towards[1], towards[0]])


def _dahl(given: Laws, kappa: Array, memory: dict[str, Array]) -> Array:
    """Return Dahl's state after a change of curvature, by one implicit step of z' = (k' - |k'| z) / kappa_c."""
    if "dahl" not in memory:
        return np.zeros_like(kappa[1:])
    change = (kappa[1:] - memory["bend"]) / given.get("internal_friction.kappa_c")
    return (memory["dahl"] + change) / (1 + np.sqrt((change * change).sum(0)))


def update_memory(given: Laws, kappa: Array, memory: dict[str, Array], dt: float) -> dict[str, Array]:
    """Return what laws remember after a step."""
    out: dict[str, Array] = {}
    bend = kappa[1:]
    if given.on("internal_friction"):
        out["dahl"], out["bend"] = _dahl(given, kappa, memory), bend
    if given.on("bending_plasticity"):
        plastic = memory.get("plastic", np.zeros_like(bend))
        driving = bend - plastic
        size = np.sqrt((driving * driving).sum(0)) + 1e-30
        beyond = np.maximum(size - given.get("bending_plasticity.yield_curvature"), 0.0)
        flow = -np.expm1(-given.get("bending_plasticity.rate") * dt)
        out["plastic"] = plastic + flow * beyond / size * driving
    return out


def force(given: Laws, rope: Rope, mesh: Mesh, weight: Array, x: Array, q: Array, v: Array, time: float) -> Array:
    """Return forces on the nodes from outside [N], (3, ..., B, N)."""
    out = -rope.damping * given.get("baseline.damping") * weight * v
    out = out + weight * _fit(_gravity(given), x)
    for law in ("air_drag", "wind"):
        if given.on(law):
            flow = v - _fit(given.vector("wind.velocity"), x) if law == "wind" else v
            tangent = rotate(q, np.array([1.0, 0.0, 0.0]).reshape((3,) + (1,) * (x.ndim - 1)))
            normal = flow - tangent * dot(tangent, flow)
            out -= AIR * given.get(f"{law}.c_d") * rope.radius * mesh.share * norm(normal) * normal
    if given.fluid is not None:
        out += _fluid(given, rope, mesh, x, q, v)
    if given.table is not None:
        out += _table(given, rope, weight, x, v)
    for law, load in (("attractor", _attractor), ("wall", _wall), ("rotating_frame", _rotating)):
        if given.on(law):
            out += load(given, rope, mesh, weight, x, v)
    return out


def _across(q: Array, v: Array) -> tuple[Array, Array]:
    """Return vectors at the nodes (3, ..., B, N) across the rope and along it."""
    tangent = rotate(q, np.array([1.0, 0.0, 0.0]).reshape((3,) + (1,) * (v.ndim - 1)))
    along = tangent * dot(tangent, v)
    return v - along, along


def _fluid(given: Laws, rope: Rope, mesh: Mesh, x: Array, q: Array, v: Array) -> Array:
    """Return what a liquid at rest does: buoyancy, drag across the rope, friction along it."""
    share, (across, along) = given.fluid * rope.radius * mesh.share, _across(q, v)
    out = -np.pi * rope.radius * share * _fit(_gravity(given), x)
    out = out - given.get("fluid_forces.across") * share * norm(across) * across
    return out - np.pi * given.get("fluid_forces.along") * share * norm(along) * along


def added_inertia(given: Laws, rope: Rope, mesh: Mesh, q: Array, dv: Array) -> Array:
    """Return what it takes to accelerate the liquid around the nodes by dv (3, ..., B, N) across the rope [N]."""
    if not given.on("fluid_forces"):
        return np.zeros_like(dv)
    across, _ = _across(q, dv)
    return given.get("fluid_forces.added_mass") * given.fluid * np.pi * rope.radius**2 * mesh.share * across


def _gravity(given: Laws) -> Array:
    """Return gravity [m/s^2], (3, B, 1), turned about a horizontal axis."""
    axis = np.concatenate([given.vector("tilted_gravity.angles", 2), np.zeros((1, given.rows, 1))])
    angle = norm(axis)
    unit, g = axis / angle, np.array([0.0, 0.0, -given.gravity])[:, None, None]
    return g + np.sin(angle) * cross(unit, g) + (1 - np.cos(angle)) * cross(unit, cross(unit, g))


def _table(given: Laws, rope: Rope, weight: Array, x: Array, v: Array) -> Array:
    """Return what a table does: a stiff, damped bed, and Coulomb friction."""
    depth = np.maximum(given.table + rope.radius - x[2], 0.0)
    spring = weight * TABLE_RATE**2
    out = np.zeros_like(x)
    # The bed's damping fades in over its sag under the rope's weight, so that it never jumps.
    sag = GRAVITY / TABLE_RATE**2
    out[2] = spring * depth - weight * TABLE_RATE * np.minimum(depth / sag, 1.0) * v[2]
    if given.on("table_friction"):
        speed = np.sqrt(v[0] ** 2 + v[1] ** 2) + 1e-12
        rub = given.get("table_friction.mu") * spring * depth * np.tanh(speed / SLIP) / speed
        out[0], out[1] = -rub * v[0], -rub * v[1]
    return out


def _attractor(given: Laws, rope: Rope, mesh: Mesh, weight: Array, x: Array, v: Array) -> Array:
    """Return the pull of a magnet on one place of the rope, strength d / (|d|^2 + 0.1^2)^(3/2)."""
    here = _hats(mesh.arclength, given.get("attractor.position"))
    away = _fit(given.vector("attractor.at"), x) - x
    return given.get("attractor.strength") * here * away / (dot(away, away) + 0.01) ** 1.5


def _wall(given: Laws, rope: Rope, mesh: Mesh, weight: Array, x: Array, v: Array) -> Array:
    """Return what a wall without friction does: points x with x.n > distance are behind it."""
    n = _fit(given.vector("wall.normal"), x)
    distance = given.get("wall.distance")
    depth = np.maximum(dot(n, x) + rope.radius - np.where(np.isfinite(distance), distance, 1e9), 0.0)
    press = weight * (TABLE_RATE**2 * depth + TABLE_RATE * np.minimum(depth / 1e-4, 1.0) * dot(n, v))
    return -np.maximum(press, 0.0) * n


def _rotating(given: Laws, rope: Rope, mesh: Mesh, weight: Array, x: Array, v: Array) -> Array:
    """Return the forces in a frame that turns about the vertical: Coriolis' and the centrifugal one."""
    rate = given.get("rotating_frame.rate")
    out = np.zeros_like(x)
    out[0] = weight * (2 * rate * v[1] + rate**2 * x[0])
    out[1] = weight * (-2 * rate * v[0] + rate**2 * x[1])
    return out


def grip_moment(given: Laws, q: Array, spin: Array, grips: tuple[Array, Array, Array], both: bool) -> Array:
    """Return the lack of moment (3, ..., B, N) [N m], in the nodes' frames, that springs of the clamps make.

    Args:
        given: the laws.
        q: orientations of the nodes, (4, ..., B, N).
        spin: their angular velocities, in their frames [rad/s], (3, ..., B, N).
        grips: poses of the clamps, and their angular velocities in their frames.
        both: whether there are two.
    """
    out = np.zeros((3, *q.shape[1:]))
    spring, play = given.get("gripper_compliance.stiffness")[:, 0], given.get("backlash.angle")[:, 0]
    # What ends the play gives way: Newton's method misses a wall, and stops of 20 N m/rad.
    spring = np.where(play > 0, np.minimum(spring, STOP), spring)
    corner = CORNER * given.get("gripper_play.angle")[:, 0]
    play = np.maximum(play, given.get("gripper_play.angle")[:, 0])
    for law in ("gripper_play", "gripper_damping"):
        spring = np.minimum(spring, given.get(f"{law}.stiffness")[:, 0])
    damper = spring * given.get("gripper_damping.loss_time")[:, 0]
    for k, node in enumerate((0, -1)[: 1 + both]):
        grip, turning = ((a[:, None, :, k] if q.ndim == 4 else a[..., k]) for a in grips[1:])
        angle = logarithm(multiply(conjugate(grip), q[..., node]))
        size = norm(angle)
        away = multiply(conjugate(q[..., node]), grip)
        # Newton's method misses a sharp corner. Nothing is left of it where the rope is not turned.
        beyond = 0.5 * (size + np.hypot(size - play, corner) - np.hypot(play, corner))
        out[..., node] = spring * beyond / size * angle
        out[..., node] += damper * (spin[..., node] - rotate(away, turning))
    return out
