"""Make tests/reference/{swing,twisted,held}.npz: recorded runs of PyElastica 1.0.0.

PyElastica integrates Cosserat rods (shear and stretch included) with position Verlet; it shares
no code and no discretisation of the elastic forces with torchdlo. Every file holds the numbers
of the rod, the motion of its held ends, vertex positions over time, and how far the run itself
is from converged. Needs the extra `peers` (pyelastica). Gazzola et al. 2018,
doi:10.1098/rsos.171628.

The held end of a discrete rod: node 0, node 1 and the frame of the element between them are
prescribed, so curvature starts in the middle of that edge. In `twisted`, `held` and the
`converged` arrays of `swing` that middle is the clamp, and the rod extends half an edge behind
it; positions then converge with the square of the edge length.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from cosserat import (
    GRAVITY,
    Grip,
    Rope,
    Run,
    gap,
    held_nodes,
    lead_in,
    quaternion,
    resample,
    rotation,
    simulate,
    smooth,
    still,
)
from options import Parser


@dataclass(frozen=True)
class Ends:
    """A rod held at both ends, and how the ends move."""

    rope: Rope
    """The rod between its two anchors."""
    pose: tuple[np.ndarray, np.ndarray]
    """Anchors (2, 3) [m] and yaw, pitch, roll (2, 3) [rad] at the start."""
    moved: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
    """Times (T,) -> displacements (T, 2, 3) [m] and added angles (T, 2, 3) [rad]."""
    damping: float
    """Uniform damping rate [1/s]."""
    gravity: float
    """Acceleration of gravity, downwards [m/s^2]."""
    notes: str
    """What is done, in words."""

    def motion(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Anchors (T, 2, 3) [m] and rotations (T, 2, 3, 3) at times (T,) [s]."""
        shift, angles = self.moved(time)
        return self.pose[0] + shift, rotation(*np.moveaxis(self.pose[1] + angles, -1, 0))

    def run(self, n: int, times: np.ndarray, *, settle: float, refine: int = 1) -> Run:
        """Lead-in and run with n elements, the anchors half an edge inside the ends."""
        rope, grips = with_ends(self.rope, n)
        start = lead_in(rope, n, grips, self.pose, duration=settle, gravity=self.gravity)
        keywords = {"damping": self.damping, "gravity": self.gravity, "refine": refine}
        return simulate(rope, n, grips, self.motion, times=times, start=start, **keywords)


def twisted() -> Ends:
    """An arc between two clamps in the x-z plane; the last clamp then turns about its axis."""

    def moved(time):
        angles = np.zeros((len(time), 2, 3))
        angles[:, 1, 2] = 4.0 * smooth(time, 1.0)
        return np.zeros_like(angles), angles

    return Ends(
        Rope(0.6, 0.003, 1100.0, 2e7),
        (np.array([[0, 0, 0], [0.3, 0, 0]]), np.array([[0, 0.6, 0], [0, -0.6, 0]])),
        moved,
        damping=2.0,
        gravity=0.0,
        notes="Naturally straight rod bent into an arc between two clamps in the x-z plane, at "
        "rest; the last clamp then turns by 4 rad about the rod's axis, "
        "roll(t) = 4 u^3 (10 - 15 u + 6 u^2) with u = min(t / 1 s, 1). No gravity. ",
    )


def held() -> Ends:
    """A sagging rope whose two held ends move and tilt."""
    size = np.array([[0.08, 0.05, 0.06], [0.06, 0.08, 0.05]])
    tilt = np.array([[0.35, 0.3, 0.5], [0.3, 0.4, 0.6]])
    rate = 2 * np.pi * np.array([[0.9, 1.1, 0.7], [1.2, 0.8, 1.0]])
    phase = np.array([[0.3, 1.1, 2.0], [2.4, 0.7, 1.6]])

    def moved(time):
        part = smooth(time, 0.5)[:, None, None]
        angle = rate * time[:, None, None] + phase
        return part * size * np.sin(angle), part * tilt * np.cos(angle)

    return Ends(
        Rope(0.7, 0.0035, 1150.0, 1.5e7),
        (np.array([[0, 0, 0], [0.45, 0, 0]]), np.array([[0, -0.8, 0], [0, 0.8, 0]])),
        moved,
        damping=0.5,
        gravity=GRAVITY,
        notes="Rope hanging at rest between two clamps, which then move and tilt smoothly: "
        "clamp_position and clamp_quaternion over clamp_time are the input. ",
    )


CLAMP_NOTES = (
    "The rod as stored has n = elements edges of rest length edge_length. Held are nodes 0, 1, "
    "n-1, n and the frames of the first and the last edge. clamp_position is the middle of that "
    "edge, clamp_quaternion (w, x, y, z) maps body to world with x along the rod from first to "
    "last node and y = d1, so the held nodes sit at +- edge_length / 2 along x. span is the rest "
    "length between the two clamps; the half edge behind each clamp only serves to hold it. "
    "positions (frames, n+1, 3) and d1 (frames, n, 3: first material director of each edge) are "
    "a run with elements_run elements between the same clamps, read off by cubic splines at the "
    "nodes and edges of the stored rod. Starts at rest from start_positions and start_d1. "
    "convergence_mm: largest distance of that run to one with half the elements, over all frames; "
    "the run's own error is about a third of it. convergence_time_step_mm: with half the "
    "elements, the change that half the time step makes. "
)
LAW_NOTES = (
    "PyElastica 1.0.0, PositionVerlet, CosseratRod. Natural shape straight, node masses half at "
    "the two ends. Damping: AnalyticalLinearDamper with uniform_damping_constant = damping_rate, "
    "velocities and spins of all nodes and elements times exp(-damping_rate dt) in every step, "
    "that is a force -damping_rate * mass * velocity. Stretching and shearing stiffness: "
    "axial_stiffness and 27/28 shear_modulus/youngs_modulus of it."
)


def with_ends(rope: Rope, n: int) -> tuple[Rope, tuple[Grip, Grip]]:
    """A rope of n edges with half an edge behind each of its two clamps, and the clamps."""
    edge = rope.length / (n - 1)
    return replace(rope, length=n * edge), (Grip(anchor=edge / 2), Grip(True, anchor=edge / 2))


def make_ends(case: Ends, sizes: tuple[int, int], frames: int, settle: float) -> dict:
    """Arrays of a file of a rod held at both ends.

    Args:
        sizes: Edges of the rod as it is stored, and elements of the run, at least as many.
        frames: Number of frames.
        settle: Duration of the lead-in [s].
    """
    n, finest = sizes
    times = np.linspace(0, 2, frames)
    runs = [case.run(k, times, settle=settle) for k in (finest, finest // 2)]
    finer = case.run(finest // 2, times, settle=settle, refine=2)
    s = [(np.arange(k + 1) - 0.5) / (k - 1) for k in (finest, finest // 2, n)]
    inside = np.linspace(0, 1, 61)
    change = gap(*(resample(r.positions, a, inside) for r, a in zip(runs, s, strict=False)))
    print(f"  {finest} elements against {finest // 2}: {change:.3f} mm")

    rope, grips = with_ends(case.rope, n)
    anchors, turns = case.motion(times)
    held = [held_nodes(rope, n, g, anchors[:, i], turns[:, i]) for i, g in enumerate(grips)]
    first, last = (h.swapaxes(1, 2) for h in held)
    free = resample(runs[0].positions, s[0], s[2][2:-2])
    positions = np.concatenate([first, free, last], 1)
    middle = [(a[1:] + a[:-1]) / 2 for a in (s[0], s[2])]
    d1 = resample(runs[0].d1, *middle)
    tangent = np.diff(positions, axis=1)
    tangent /= np.linalg.norm(tangent, axis=-1, keepdims=True)
    d1 -= np.sum(d1 * tangent, -1, keepdims=True) * tangent
    d1 /= np.linalg.norm(d1, axis=-1, keepdims=True)

    clamp_time = np.linspace(0, 2, 401)
    anchors, turns = case.motion(clamp_time)
    numbers = rope.numbers() | {
        "span": case.rope.length,
        "edge_length": rope.length / n,
        "elements": n,
        "elements_run": finest,
        "gravity": case.gravity,
        "damping_rate": case.damping,
        "time_step": runs[0].time_step,
        "convergence_mm": change,
        "convergence_time_step_mm": gap(runs[1].positions, finer.positions),
    }
    return numbers | {
        "time": times,
        "positions": positions.astype(np.float32),
        "d1": d1.astype(np.float32),
        "start_positions": positions[0],
        "start_d1": d1[0],
        "clamp_time": clamp_time,
        "clamp_position": anchors,
        "clamp_quaternion": np.stack([quaternion(turns[:, i]) for i in range(2)], 1),
        "held_nodes": np.array([0, 1, n - 1, n]),
        "notes": np.array(case.notes + CLAMP_NOTES + LAW_NOTES),
    }


def released(rope: Rope, n: int, times: np.ndarray, arclength: np.ndarray) -> np.ndarray:
    """Positions [m] (F, M, 3) at `arclength` (M,) of the rope clamped exactly at the origin.

    Shear and stretch of the half edge between the clamp and node 1 are missing if node 1 is held
    and counted twice if it is free, so the mean of both is taken.
    """
    edge = rope.length / (n - 0.5)
    longer, s = replace(rope, length=n * edge), (np.arange(n + 1) - 0.5) * edge
    grips = [Grip(anchor=edge / 2, loose=loose) for loose in (False, True)]
    runs = [simulate(longer, n, (grip,), still, times=times).positions for grip in grips]
    return resample(sum(runs) / 2, s, arclength)


def make_swing(n: int, finest: int, frames: int) -> dict[str, np.ndarray]:
    """Arrays of the rope that is clamped horizontally and released (case D8)."""
    times = np.linspace(0, 1, frames)
    arclength = np.linspace(0, 1, 60)
    rope = Rope(1.0, 0.005, 1000.0, 1e6)
    arrays: dict[str, np.ndarray] = {}
    numbers: dict[str, float] = {"elements": n, "elements_converged": finest}
    for name, law in (("", replace(rope, stiffening=100.0)), ("_extensible", rope)):
        plain = simulate(law, n, (Grip(loose=True),), still, times=times)
        limit = [released(law, k, times, arclength) for k in (finest // 2, finest)]
        arrays |= {f"positions{name}": plain.positions, f"converged{name}": limit[-1]}
        half = simulate(law, n // 2, (Grip(loose=True),), still, times=times).positions
        numbers |= {
            f"stretch_modulus{name}": law.youngs * law.stiffening,
            f"axial_stiffness{name}": law.youngs * law.stiffening * law.area,
            f"time_step{name}": plain.time_step,
            f"convergence_mm{name}": gap(plain.positions[:, ::2], half),
            f"converged_change_mm{name}": gap(*limit),
            f"converged_change_tip_mm{name}": gap(limit[0][-1, -1], limit[1][-1, -1]),
        }
        print(f"  tip{name} {plain.positions[-1, -1]}, converged {limit[-1][-1, -1]}")
        print(f"  finest against half of it: {gap(*limit):.3f} mm over all")
    notes = (
        "Rope clamped horizontally at the origin along x, released from straight under gravity "
        "along -z, undamped. positions and positions_extensible: n = elements; node 0 and the "
        "first frame are held, so curvature starts half an edge inside, as when vertices 0 and 1 "
        "are held. converged and converged_extensible: elements_converged elements, the clamp "
        "exactly at the origin, read off at arclength. Without suffix the stretching and shearing "
        "stiffness is 100 times that of E, close to inextensible; _extensible has that of E, "
        "where the shear angle at the clamp (3 per cent) and the laws of stretching (tension "
        "E A (1 - l0/l), bending moment over the third power of l/l0) count: a rod without "
        "shear differs by millimetres at 0.6 s and by about a centimetre at 1 s. "
        "convergence_mm: largest distance to a run with half the elements, over all frames; "
        "converged_change_mm and converged_change_tip_mm: the same for the converged run, over "
        "all and for the tip at 1 s. "
    )
    arrays = {key: value.astype(np.float32) for key, value in arrays.items()}
    numbers = rope.numbers() | {"gravity": GRAVITY, "damping_rate": 0.0} | numbers
    return numbers | arrays | {"time": times, "arclength": arclength, "notes": notes + LAW_NOTES}


@dataclass(frozen=True)
class Config:
    """What to make, how fine and where."""

    case: str = "all"
    """Which file: swing, twisted, held or all."""
    out: str = str(Path(__file__).resolve().parents[1] / "tests" / "reference")
    """Folder the files go to."""
    smoke: bool = False
    """Few elements and frames, to see that the script runs; give another --out with it."""


def main() -> None:
    """Make the files that are asked for."""
    parser = Parser(__file__, description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--case", default=Config.case, choices=["all", "swing", "twisted", "held"])
    parser.add_argument("--out", default=Config.out, help="folder the files go to")
    parser.flag("smoke", "coarse and quick")
    config = Config(**vars(parser.parse_args()))
    out = Path(config.out)
    out.mkdir(parents=True, exist_ok=True)
    swing, ends = (118, 472, 21), ((100, 240), 41, 5.5)
    if config.smoke:
        swing, ends = (8, 12, 3), ((8, 12), 3, 0.5)
    makers = {
        "swing": lambda: make_swing(*swing),
        "twisted": lambda: make_ends(twisted(), *ends),
        "held": lambda: make_ends(held(), *ends),
    }
    for name, make in makers.items():
        if config.case in ("all", name):
            print(name)
            path = out / f"{name}.npz"
            np.savez_compressed(path, **make())
            print(f"  {path}: {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
