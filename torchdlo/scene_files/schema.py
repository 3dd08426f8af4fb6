"""What a scene file can say: plain data with the defaults of what it does not say."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from torchdlo.field_docs import with_field_docs

__all__ = [
    "Attachment",
    "BodySpec",
    "GridSpec",
    "HangingMass",
    "JointSpec",
    "Keyframe",
    "ParticleBlockSpec",
    "PointForceSpec",
    "RobotSpec",
    "RopeSpec",
    "SceneDescription",
]

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
Number = float | tuple[float, ...]
"""One number, or as many as a rope has vertices: of edges that of the edge after the vertex, of hinges that of the
vertex. The last edge of an open rope and the hinges at its ends count for nothing."""
Wall = Literal["open", "separate", "slip", "stick"]


@with_field_docs
@dataclass(frozen=True)
class HangingMass:
    """A point mass that hangs on a rope; drawn as a ball of steel, which touches nothing."""

    vertex: int
    """Number of the vertex; -1 is the last."""
    mass: float
    """Mass [kg]."""


@with_field_docs
@dataclass(frozen=True)
class PointForceSpec:
    """A force on a vertex that does not change."""

    vertex: int
    """Number of the vertex; -1 is the last."""
    force: Vector
    """Force [N]."""
    since: float = 0.0
    """When it begins [s]."""
    until: float | None = None
    """When it ends [s], if ever."""


@with_field_docs
@dataclass(frozen=True)
class RopeSpec:
    """A rope; fields without a comment are those of `scene.Rope`, where lists are tensors.

    Numbers are the same along the rope, or lists of as many as it has vertices: of edges that of the edge after the
    vertex, of hinges that of the vertex.
    """

    points: tuple[Vector, ...]
    """Corners of the line along which it lies [m]; its vertices, if `vertices` is not given."""
    vertices: int | None = None
    """How many vertices to place at equal distances along that line."""
    radius: Number = 0.005
    mass: float | None = None
    density: Number | None = None
    youngs: Number | None = None
    shear: Number | None = None
    bend: Number | None = None
    bend2: Number | None = None
    twist: Number | None = None
    stretch: Number | None = None
    closed: bool = False
    rest: Literal["straight", "as_placed"] | tuple[Vector, ...] = "straight"
    rest_curvature: tuple[tuple[float, float], ...] | None = None
    """One pair for all vertices, or a pair for each [1/m]."""
    rest_twist: Number | None = None
    director: Vector | None = None
    rest_director: Vector | None = None
    velocities: tuple[Vector, ...] | None = None
    """One velocity for all vertices, or one for each [m/s]."""
    initial_twist: Number | None = None
    """How much an open rope is twisted at the start, beyond its `director` [rad/m]."""
    model: str | None = None
    """Model file of `torchdlo calibrate` or `diagnose`, from which parameters and effects are taken."""
    hanging_masses: tuple[HangingMass, ...] = ()
    """What hangs on it."""
    point_forces: tuple[PointForceSpec, ...] = ()
    """What pulls on it."""


@with_field_docs
@dataclass(frozen=True)
class Keyframe:
    """Where something is at a time, from where it is at the start; between keyframes it moves by `path`."""

    time: float
    """When [s]."""
    move: Vector = (0.0, 0.0, 0.0)
    """How far it has moved [m]."""
    turn: Vector = (0.0, 0.0, 0.0)
    """By how much it has turned: axis times angle [rad]."""


@with_field_docs
@dataclass(frozen=True)
class Attachment:
    """Vertices of a rope that are held together as by one tool."""

    vertices: tuple[int, ...]
    """Numbers of vertices along the rope; -1 is the last."""
    rope: int = 0
    """Number of the rope."""
    edges: tuple[int, ...] = ()
    """Edges whose twist is held, too."""
    keyframes: tuple[Keyframe, ...] = ()
    """Motion about the first vertex; none if empty."""
    path: Literal["smooth", "linear"] = "smooth"
    """Whether it starts and stops at each keyframe without a jerk."""
    robot: int | None = None
    """Number of the robot whose tool holds them, in place of `keyframes`."""
    close: float = 0.0
    """When it grips [s]: from then on what it holds keeps its place in the tool."""
    release: float | None = None
    """When it is let go [s], if ever."""


@with_field_docs
@dataclass(frozen=True)
class BodySpec:
    """A rigid body; fields without a comment are those of `coupling.bodies.dynamics.RigidBody`."""

    shape: Literal["plane", "sphere", "box", "capsule", "cylinder", "cone", "torus", "ring", "mesh"]
    size: tuple[float, ...] = ()
    pos: Vector = (0.0, 0.0, 0.0)
    """Centre of mass; of a mesh, the origin of its file."""
    quat: Quaternion = (1.0, 0.0, 0.0, 0.0)
    vel: Vector = (0.0, 0.0, 0.0)
    omega: Vector = (0.0, 0.0, 0.0)
    motion: Literal["free", "fixed", "kinematic"] = "free"
    density: float | None = None
    mass: float | None = None
    inertia: Vector | None = None
    mu_s: float = 0.3
    mu_k: float = 0.3
    restitution: float = 0.0
    damping: float = 0.0
    name: str = ""
    keyframes: tuple[Keyframe, ...] = ()
    """Motion of a kinematic body."""
    path: Literal["smooth", "linear"] = "smooth"
    file: str | None = None
    """Of a mesh: any file that trimesh reads."""
    scale: float = 1.0
    """Of a mesh: metres per unit of the file."""
    cells: int = 48
    """Of a mesh: cells of its grid of distances along the longest side."""


@with_field_docs
@dataclass(frozen=True)
class JointSpec:
    """A point of a rope that is joined to a free body, or to another rope; fields are those of `scene.RopeJoint`."""

    rope: int = 0
    vertex: int | None = None
    """Number of a vertex along the rope; -1, the last, if neither it nor `at` is given."""
    at: float | None = None
    """Share of the rope's length where the point is, 0 to 1."""
    body: int | None = None
    """Number of a free body."""
    other_rope: int | None = None
    other_vertex: int = 0
    kind: Literal["weld", "ball"] = "weld"
    anchor: Vector | None = None


@with_field_docs
@dataclass(frozen=True)
class RobotSpec:
    """A chain of links whose joints go where they bring its tool along `keyframes`."""

    urdf: str = "panda"
    """File, or "panda" for the arm in the package."""
    tool: str | None = None
    """Link whose pose is commanded; the last one if there is only one end."""
    base: Vector = (0.0, 0.0, 0.0)
    """Where the first link stands [m]."""
    base_quat: Quaternion = (1.0, 0.0, 0.0, 0.0)
    """How it is turned."""
    joints: tuple[float, ...] = ()
    """Joints at the start [rad or m]; the middle of their ranges if not given."""
    pos: Vector | None = None
    """Where the tool is at the start [m], if `joints` are only a posture near it."""
    quat: Quaternion = (0.0, 1.0, 0.0, 0.0)
    """How it is turned there; it points down if not given."""
    keyframes: tuple[Keyframe, ...] = ()
    """Motion of the tool."""
    path: Literal["smooth", "linear"] = "smooth"


@with_field_docs
@dataclass(frozen=True)
class ParticleBlockSpec:
    """A block of a material, made of material points."""

    constitutive_model: Literal["elastic", "plastic", "liquid", "sand"]
    size: tuple[float, ...]
    """Half lengths of a box, or the radius of a ball [m]."""
    spacing: float
    """Distance of its points [m]; half a cell of the box is usual."""
    shape: Literal["box", "ball"] = "box"
    pos: Vector = (0.0, 0.0, 0.0)
    """Its middle [m]."""
    vel: Vector = (0.0, 0.0, 0.0)
    """Velocity at the start [m/s]."""
    parameters: dict[str, float] = field(default_factory=dict)
    """Parameters of its constitutive model, and its density, that differ from their defaults."""


@with_field_docs
@dataclass(frozen=True)
class GridSpec:
    """Where material points may be; fields without a comment are those of `coupling.mpm.particles.Grid`."""

    low: Vector
    high: Vector
    spacing: float
    walls: tuple[Wall, Wall, Wall, Wall, Wall, Wall] = ("separate",) * 6
    window: tuple[int, int, int] | None = None
    friction: float = 0.3
    """Coefficient of friction at walls that let go."""


@with_field_docs
@dataclass(frozen=True)
class SceneDescription:
    """A simulation from its start to its end; fields without a comment are those of `scene.Scene`."""

    ropes: tuple[RopeSpec, ...]
    effects: dict[str, dict[str, Any]]
    """Effects by name, each with the parameters and choices that differ from its defaults."""
    bodies: tuple[BodySpec, ...] = ()
    attachments: tuple[Attachment, ...] = ()
    joints: tuple[JointSpec, ...] = ()
    """What ropes are joined to."""
    robots: tuple[RobotSpec, ...] = ()
    material_points: tuple[ParticleBlockSpec, ...] = ()
    box: GridSpec | None = None
    """Where material points may be."""
    duration: float = 1.0
    """How long to simulate [s]."""
    dt: float = 1e-3
    substeps: int = 5
    integrator: Literal["explicit", "implicit"] = "explicit"
    contact: Literal["auto", "sweeps", "coupled"] = "auto"
    """How explicit steps find contact of ropes: by sweeps before edge lengths, or coupled with them in one solve, which
    is right for taut ropes over bodies. "auto" is coupled where ropes touch bodies, in double precision and without
    material points."""
    twist: Literal["none", "dynamic", "quasistatic"] = "none"
    constrained: bool = True
    constraint_iterations: int | None = None
    """Newton steps for edge lengths per substep, in implicit steps at most; if null, 3 explicit and 8 implicit ones."""
    twist_iterations: int = 4
    implicit_weight: float = 0.5
    """Share of a substep's change at which implicit steps take stiff forces and tensions."""
    numerical_damping: float = 0.0
    """Share of a substep by which implicit steps look ahead, 0 to 1: it damps fast modes."""
    clamp: Literal["edge", "vertex"] = "edge"
    """Where two neighbouring held vertices clamp a rope: in the middle of their edge, or at the last of them."""
    precision: Literal["float64", "float32"] = "float64"
    """Type of all numbers."""
    camera_direction: Vector = (0.5, -1.0, 0.45)
    """From where pictures are taken: direction from the scene to the camera."""
    notes: str = ""
    """Anything."""
