"""What is hidden in each recording, and how much of it: doses of effects, sized by the gap that they leave."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import laws
import numpy as np
from scenes import SPEEDS, Scene, draw, run, seen
from simulate import GRAVITY, Mesh, Track
from vectors import Array, conjugate, logarithm, multiply

TRIALS = list(SPEEDS)
SIZING = ["train_1", "test_0"]
"""Trials by which doses are sized."""
COARSE, FINE = (44, 2e-3), (97, 1e-3)
"""Elements and steps [s] to size doses with, and to make recordings with."""
ABSORBED = {"baseline.bending": 1.05, "baseline.twisting": 1.3, "baseline.damping": 1.3}
"""Changes of the numbers that a baseline's calibration would adjust."""

MEASUREMENT = ("time_delay", "marker_offset")
"""Effects of the measurement, not of the rope."""
PARTS = (
    "first",
    "ci",
    "singles",
    "nulls",
    "compounds",
    "outside",
    "ties",
    "all",
    "fresh",
    "links",
    "mismatch",
    "newer",
    "sealed",
)
"""Parts of the benchmark; what is fresh, sealed, made of links, or differs only in how it is made is not in all."""
MISMATCH = (
    ("implicit", "links"),
    ("table", "links"),
    ("joints", "links"),
    ("dropouts", ""),
    ("quantised", ""),
    ("coloured", "links"),
    ("grid", ""),
    ("table", ""),
    ("dropouts", "links"),
    ("quantised", "links"),
    ("coloured", ""),
    ("", "links"),
    ("", ""),
)
"""Kinds of recordings that hide nothing but differ in how they are made, and what they are made with."""
NEWER = ("gripper_play", "gripper_damping", "fluid_forces")
"""Effects of the library that came later."""
LIGHTER = 0.5
"""Share of a rope's weight that a liquid carries."""
REPEATS = 5
"""Recordings of each of these kinds."""
LINKS = (40, 61)
"""Least number of links in a chain, with those that clamps hold, and one more than the greatest."""
TIES = {"wind": ["tilted_gravity"], "tilted_gravity": ["wind"]}
"""Effects that the motions here hardly tell apart."""
PAIRS = (
    ("air_drag", "rest_curvature"),
    ("bending_damping", "point_mass"),
    ("time_delay", "air_drag"),
    ("marker_offset", "bending_damping"),
    ("tilted_gravity", "nonuniform_stiffness"),
    ("rest_curvature", "time_delay"),
    ("point_mass", "tilted_gravity"),
    ("gripper_compliance", "air_drag"),
    ("anisotropic_bending", "time_delay"),
    ("internal_friction", "marker_offset"),
    ("table_friction", "rest_curvature"),
    ("stretch", "point_mass"),
)
"""Two effects that are missing at once."""
OUTSIDE = ("attractor", "drifting_stiffness", "wall", "backlash", "rotating_frame")
"""Effects that no library has."""


@dataclass(frozen=True)
class Case:
    """What one recording hides."""

    kind: str
    """single, null, compound, outside or tie."""
    effects: tuple[str, ...]
    """Names of the effects."""
    ratio: float
    """Wanted ratio of gap to noise, of each effect by itself; 0: none."""
    seed: int
    """Seed of rope and motions."""
    variant: str = ""
    """How a null differs from a plain one: grid, coloured, table, dropouts, quantised, joints (hinges that each lose
    energy by themselves) and implicit (all of them alike, as by an implicit step); how a tie does: slow."""
    simulator: str = ""
    """What the recording is made with if not with exact rods: links."""

    @property
    def name(self) -> str:
        """Name that tells what it is; not the recording's."""
        ratio = f"{self.ratio:g}" if self.ratio else ""
        parts = [self.kind, *self.effects, self.variant, ratio, str(self.seed), self.simulator]
        return "-".join(p for p in parts if p)

    @property
    def scene(self) -> Scene:
        """Its rope and motions."""
        has, held = set(self.effects), None
        if {"gripper_compliance", "backlash", "gripper_play", "gripper_damping"} & has:
            held = 2
        elif {"attractor", "stretch", "air_drag", "wind", "fluid_forces"} & has:
            held = 1
        pace = 0.4 if self.variant == "slow" else 1.25 if "air_drag" in has else 1.0
        table = "table_friction" in has or self.variant == "table"
        scene = draw(self.seed, table=table, grippers=held, pace=pace)
        if "fluid_forces" in has:
            rope = scene.rope
            scene = replace(scene, fluid=LIGHTER * rope.mass / (rope.length * np.pi * rope.radius**2))
        if self.simulator == "links":
            # A clamp holds one link.
            count = int(np.random.default_rng([self.seed, 15]).integers(*LINKS))
            scene = replace(scene, grip=scene.rope.length / count)
        return scene


@dataclass(frozen=True)
class Dose:
    """How numbers grow with a dose, from 0 on, 1 being a fair amount."""

    numbers: Callable[[float], dict[str, float]]
    """The numbers of a dose."""
    most: float
    """Greatest dose that is plausible."""
    least: float = 0.0
    """Least dose that is."""


def curved(track: Track, mesh: Mesh) -> float:
    """Return a large curvature of a run [1/m]."""
    q = track.q[:: max(1, len(track.q) // 100)].swapaxes(0, 1)
    kappa = logarithm(multiply(conjugate(q[..., :-1]), q[..., 1:])) / mesh.step
    return float(np.quantile(np.sqrt(kappa[1] ** 2 + kappa[2] ** 2), 0.95))


def dose(effect: str, scene: Scene, bend: float, x: Array) -> Dose:
    """Return doses of an effect.

    Args:
        effect: its name.
        scene: the rope.
        bend: a large curvature of the plain rope [1/m].
        x: its nodes [m], (S, 3, B, N).
    """
    number = list(laws.PLAIN).index(next(k for k in laws.PLAIN if k.startswith(effect)))
    rng = np.random.default_rng([scene.seed, 14, number])
    angle, place, sign = rng.uniform(0, 2 * np.pi), rng.uniform(0.2, 0.6), rng.choice([-1.0, 1.0])
    c, s = np.cos(angle), np.sin(angle)
    rope, weight = scene.rope, scene.rope.mass * GRAVITY
    tip = x[..., -1] if scene.grippers == 1 else x[..., x.shape[-1] // 2]
    home = tip.mean((0, 2)) + np.array([0.15 * c, 0.15 * s, -0.1])
    far = float(np.quantile(c * x[:, 0] + s * x[:, 1], 0.995))
    table: dict[str, tuple[Callable[[float], dict[str, float]], float]] = {
        "air_drag": (lambda d: {"c_d": d}, 15),
        "wind": (lambda d: {"c_d": 1.2, "velocity.0": 1.5 * d**0.5 * c, "velocity.1": 1.5 * d**0.5 * s}, 16),
        "tilted_gravity": (lambda d: {"angles.0": 0.015 * d * c, "angles.1": 0.015 * d * s}, 8),
        "bending_damping": (lambda d: {"coefficient": 0.006 * d * rope.bending}, 20),
        "rest_curvature": (lambda d: {"curvature.0": 0.3 * d * c, "curvature.1": 0.3 * d * s}, 30),
        "bending_plasticity": (lambda d: {"yield_curvature": bend / (1 + d), "rate": 4.0}, 6),
        "internal_friction": (lambda d: {"moment": 0.1 * d * rope.bending * bend, "kappa_c": 0.1 * bend}, 8),
        "stiffening_bending": (lambda d: {"c": 0.3 * d / bend**2}, 15),
        "nonuniform_stiffness": (lambda d: {"position": place, "width": 0.1, "factor": 0.5 * sign * d}, 4.5),
        "anisotropic_bending": (lambda d: {"ratio": np.exp(0.3 * d), "direction": 0.5 * angle - 0.5 * np.pi}, 5),
        "point_mass": (lambda d: {"position": (place + 0.2) * rope.length, "mass": 0.1 * d * rope.mass}, 8),
        "stretch": (lambda d: {"EA": 250 * weight / d}, 12),
        "table_friction": (lambda d: {"mu": 0.15 * d}, 7),
        "gripper_compliance": (lambda d: {"stiffness": 30 * rope.bending / rope.length / d}, 20),
        "time_delay": (lambda d: {"delay": 0.006 * d}, 12),
        "marker_offset": (lambda d: {"offset.0": 0.002 * d * c, "offset.1": 0.002 * d * s}, 8),
        "gripper_play": (lambda d: {"angle": 0.02 * d, "stiffness": 10.0}, 8),
        "gripper_damping": (lambda d: {"stiffness": 30 * rope.bending / rope.length / d, "loss_time": 0.1}, 20),
        "fluid_forces": (lambda d: {"across": d, "along": 0.02 * d, "added_mass": min(d, 1.0)}, 3),
        "attractor": (
            lambda d: (
                {"strength": 4e-4 * weight * d, "position": rope.length * (1.0 if scene.grippers == 1 else 0.5)}
                | {f"at.{k}": float(home[k]) for k in range(3)}
            ),
            300,
        ),
        "drifting_stiffness": (lambda d: {"rate": 0.15 * sign * d}, 5),
        "wall": (
            lambda d: {"distance": far - 0.02 * d + rope.radius, "normal.0": c, "normal.1": s},
            8,
        ),
        "backlash": (lambda d: {"angle": 0.05 * d}, 8),
        "rotating_frame": (lambda d: {"rate": 0.15 * sign * d}, 10),
    }
    numbers, most = table[effect]
    # No table is as slippery as a small gap would want it.
    least = 0.4 if effect == "table_friction" else 0.0
    return Dose(lambda d: {f"{effect}.{k}": float(v) for k, v in numbers(d).items()}, most, least)


def look(scene: Scene, numbers: list[dict[str, float]]) -> tuple[Array, Track, Mesh]:
    """Return the free markers (V, T, F, M', 3) [m] of the T trials of `SIZING`, for each of V sets of numbers."""
    rows = [row for row in numbers for _ in SIZING]
    names = SIZING * len(numbers)
    track, mesh = run(scene, names, rows, *COARSE)
    markers, _ = seen(scene, names, rows, track, mesh)
    return markers.reshape(len(numbers), len(SIZING), *markers.shape[1:])[:, :, :, ~scene.gripped], track, mesh


@dataclass(frozen=True)
class Plain:
    """A plain rope, and what calibration could do about a gap."""

    markers: Array
    """Its free markers [m], (T, F, M', 3)."""
    basis: Array
    """Orthonormal directions that calibration can move them in, (K, T F M' 3)."""
    bend: float
    """A large curvature of it [1/m]."""
    x: Array
    """Its nodes [m], (S, 3, T, N)."""

    def gap(self, markers: Array) -> float:
        """Return the gap that calibration leaves, root mean square per coordinate [m]."""
        change = (markers - self.markers).ravel()
        return float(np.sqrt(np.mean((change - self.basis.T @ (self.basis @ change)) ** 2)))


def plain(scene: Scene) -> Plain:
    """Simulate a plain rope and what its calibration can change."""
    markers, track, mesh = look(scene, [{}, *({name: value} for name, value in ABSORBED.items())])
    basis, _ = np.linalg.qr((markers[1:] - markers[0]).reshape(len(ABSORBED), -1).T)
    return Plain(markers[0], basis.T, curved(track, mesh), track.x[:, :, : len(SIZING)])


def size(effect: str, scene: Scene, base: Plain, wanted: float) -> tuple[dict[str, float], float]:
    """Return an effect's numbers that leave a gap [m] as wanted, or as near as is plausible, and the gap they leave."""
    doses = dose(effect, scene, base.bend, base.x)
    amounts = [min(a, doses.most) for a in (0.25, 1.0, 4.0)]
    markers, _, _ = look(scene, [doses.numbers(a) for a in amounts])
    gaps = [base.gap(m) for m in markers]
    numbers = doses.numbers(max(_between(amounts, gaps, wanted, doses.most), doses.least))
    return numbers, base.gap(look(scene, [numbers])[0][0])


def _between(tried: list[float], gaps: list[float], gap: float, most: float) -> float:
    """Return the dose for a gap, straight between what was tried, on logarithmic axes."""
    at, got = np.log(tried), np.maximum.accumulate(np.log(gaps)) + 1e-6 * np.arange(len(gaps))
    want = np.log(gap)
    if want > got[-1]:
        found = at[-1] + (want - got[-1])
    elif want < got[0]:
        found = at[0] + (want - got[0])
    else:
        found = np.interp(want, got, at)
    return float(min(np.exp(found), most))


def all_cases() -> list[Case]:
    """Return the whole benchmark."""
    library = list(dict.fromkeys(name.split(".")[0] for name in laws.PLAIN))[:16]
    cases = [Case("single", (e,), r, 100 + k) for k, e in enumerate(library) for r in (10.0, 3.0, 30.0)]
    variants = ("", "grid", "coloured", "table")
    cases += [Case("null", (), 0.0, 200 + 10 * k + i, v) for i in range(3) for k, v in enumerate(variants)]
    cases += [Case("compound", p, 10.0, 300 + k) for k, p in enumerate(PAIRS)]
    cases += [Case("outside", (e,), r, 400 + k) for r in (10.0, 30.0) for k, e in enumerate(OUTSIDE)]
    cases += [Case("tie", (e,), 10.0, 500 + k, "slow") for k, e in enumerate(TIES)]
    return cases


def other_cases(seed: int, nulls: tuple[str, ...], pairs: tuple[tuple[str, str], ...], simulator: str) -> list[Case]:
    """Return other ropes and motions, in case that the program was fitted to those of the whole benchmark."""
    singles = [c for c in all_cases() if c.kind == "single" and c.ratio == 10]
    sizes = (10.0, 3.0, 30.0)
    cases = [Case("single", c.effects, sizes[k % 3], seed + k) for k, c in enumerate(singles)]
    cases += [Case("null", (), 0.0, seed + 100 + k, v) for k, v in enumerate(nulls)]
    cases += [Case("compound", p, 10.0, seed + 200 + k) for k, p in enumerate(pairs)]
    cases += [Case("outside", (e,), 10.0, seed + 300 + k) for k, e in enumerate(OUTSIDE[::2])]
    return [replace(c, simulator=simulator) for c in cases]


def subset(name: str) -> list[Case]:
    """Return a part of the benchmark, one of `PARTS`."""
    if name == "fresh":
        return other_cases(600, ("", "grid", "coloured", "table"), PAIRS[::3], "")
    if name == "links":
        return other_cases(1100, ("", "", "coloured", "table"), PAIRS[1::3], "links")
    if name == "newer":
        return [Case("single", (e,), r, 2200 + k) for r in (10.0, 30.0, 3.0) for k, e in enumerate(NEWER)]
    if name == "sealed":
        # Ropes and motions that no other part has, by both simulators in turns.
        made, library = ("", "links"), [c.effects for c in all_cases() if c.kind == "single" and c.ratio == 10]
        singles = [
            Case("single", e, ratio, 5000 + 100 * j + k, "", made[(j + k) % 2])
            for j, ratio in enumerate((10.0, 3.0, 30.0))
            for k, e in enumerate(library)
        ]
        pairs = [Case("compound", p, 10.0, 5300 + k, "", made[k % 2]) for k, p in enumerate(PAIRS)]
        return [*singles[:16], *pairs, *singles[16:]]
    if name == "mismatch":
        made = [(k, i, v, by) for i in range(REPEATS) for k, (v, by) in enumerate(MISMATCH)]
        return [Case("null", (), 0.0, 2000 + 10 * k + i, v, by) for k, i, v, by in made]
    cases = all_cases()
    if name == "all":
        return cases
    fair = [c for c in cases if c.kind == "single" and c.ratio == 10]
    if name == "first":
        nulls = [c for c in cases if c.kind == "null" and c.seed % 10 == 0]
        return [*fair, *nulls, *[c for c in cases if c.kind == "outside" and c.ratio == 10][:2]]
    if name == "ci":
        four = ("air_drag", "rest_curvature", "time_delay", "point_mass")
        others = [next(c for c in cases if c.kind == kind) for kind in ("null", "outside")]
        return [c for c in fair if c.effects[0] in four] + others
    return [c for c in cases if name in (c.kind, f"{c.kind}s")]
