"""Make torchdlo/data/sample_rope: a small recording of a moving rope, simulated by PyElastica.

A rope of known stiffness is held at both ends by grippers that move, tilt and roll at random.
The recording looks like motion capture: noisy markers at 100 Hz, some of them not seen, already
moving in the first frame. Its notes say the true numbers. Needs the extra `peers` (pyelastica).
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from cosserat import (
    Grip,
    Rope,
    gap,
    lead_in,
    quaternion,
    resample,
    rotation,
    simulate,
    smooth,
)
from options import Parser, count

LENGTH, RADIUS, MASS, BENDING = 0.8, 0.004, 0.045, 3.0e-3
DAMPING = 0.6
"""Uniform damping rate [1/s]."""
HELD = 3
"""Elements held at each end."""
LEAD = 1.0
"""Time that the grippers move before the recording starts [s]."""
BASE = (
    np.array([[-0.225, 0.0, 1.0], [0.225, 0.0, 1.0]]),
    np.array([[0.0, -0.6, 0.0], [0.0, 0.6, 0.0]]),
)
"""Where the outermost markers are at rest [m], and yaw, pitch, roll there [rad]."""
REACH = np.array([0.08, 0.13, 0.13])
"""Largest displacement of a gripper along each axis [m]."""
TILT = np.array([0.5, 0.5, 0.7])
"""Largest yaw, pitch, roll away from rest [rad]."""


@dataclass(frozen=True)
class Config:
    """What to make, how fine and where."""

    out: str = str(Path(__file__).resolve().parents[1] / "torchdlo" / "data" / "sample_rope")
    """Folder the recording goes to."""
    elements: int = 91
    """Elements of the simulated rope."""
    duration: float = 3.0
    """Length of a trial [s]."""
    noise: float = 5e-4
    """Standard deviation of the free markers' noise [m]; the held ones have a tenth of it."""
    dropout: float = 0.01
    """Share of free markers that are not seen."""
    seed: int = 20
    """Seed of motions, noise and dropouts."""
    picture: str = ""
    """Write a picture of the trials to this file (needs matplotlib)."""
    smoke: bool = False
    """One short, coarse trial, to see that the script runs; give another --out with it."""


def true_rope() -> Rope:
    """The rope of the recording."""
    area = math.pi * RADIUS**2
    return Rope(LENGTH, RADIUS, MASS / (area * LENGTH), 4 * BENDING / (math.pi * RADIUS**4))


def random_motion(rng: np.random.Generator):
    """Sums of three sines between 0.5 and 1.5 Hz for every coordinate of both grippers."""
    shape = (3, 2, 6)
    rate = 2 * np.pi * rng.uniform(0.5, 1.5, shape)
    phase = rng.uniform(0, 2 * np.pi, shape)
    weight = rng.uniform(0.4, 1.0, shape) / rate**1.5  # slow waves are larger

    def waves(time):
        return (weight * np.sin(rate * time[:, None, None, None] + phase)).sum(1)

    largest = np.abs(waves(np.linspace(0, 5, 1001))).max(0)  # so that REACH and TILT are reached

    def motion(time):
        part = waves(time) / largest * smooth(time, 0.8 * LEAD)[:, None, None]
        angles = BASE[1] + TILT * part[..., 3:]
        return BASE[0] + REACH * part[..., :3], rotation(*np.moveaxis(angles, -1, 0))

    return motion


def marker_arclength(n: int) -> np.ndarray:
    """Arclength of the 13 markers [m], (13,): two on each gripper and nine in between.

    The inner marker of a gripper sits where the rope of n elements starts to be free to bend.
    """
    inner = (HELD - 0.5) * LENGTH / n
    return np.concatenate([[0.0], np.linspace(inner, LENGTH - inner, 11), [LENGTH]])


def clean_trial(motion, n: int, arclength: np.ndarray, times: np.ndarray, settle: float):
    """Markers (F, 13, 3) [m] without noise at `times` (F,) after the lead-in."""
    rope = true_rope()
    held = round(arclength[1] * n / LENGTH + 0.5)
    grips = Grip(elements=held), Grip(last=True, elements=held)
    start = lead_in(rope, n, grips, BASE, duration=settle)
    step = times[1] - times[0]
    every = np.arange(round(LEAD / step) + len(times)) * step
    run = simulate(rope, n, grips, motion, times=every, damping=DAMPING, start=start)
    positions = run.positions[-len(times) :]
    return resample(positions, np.linspace(0, LENGTH, n + 1), arclength)


def record(config: Config, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Arrays of one trial in the recording format."""
    n, settle = (20, 0.5) if config.smoke else (config.elements, 5.0)
    arclength = marker_arclength(n)
    times = np.arange(round(100 * config.duration) + 1) / 100
    motion = random_motion(rng)
    markers = clean_trial(motion, n, arclength, times, settle)
    speed = np.linalg.norm(np.diff(markers, axis=0), axis=-1) * 100
    print(f"  speed at the start up to {speed[0].max():.2f}, at most {speed.max():.2f} m/s")
    gripped = np.isin(np.arange(13), [0, 1, 11, 12])
    noise = np.where(gripped, 0.1, 1.0)[:, None] * config.noise
    markers = markers + noise * rng.standard_normal(markers.shape)
    markers[(rng.random(markers.shape[:2]) < config.dropout) & ~gripped] = np.nan
    turns = motion(times + LEAD)[1]
    return {
        "time": times,
        "markers": markers.astype(np.float32),
        "marker_arclength": arclength,
        "gripped": gripped,
        "gripper_quaternion": np.stack([quaternion(turns[:, i]) for i in range(2)], 1).astype(np.float32),
        "gripper_marker": np.array([0, 12]),
    }


def describe(config: Config) -> dict:
    """Contents of rope.json."""
    rope = true_rope()
    return {
        "length": LENGTH,
        "radius": RADIUS,
        "mass": MASS,
        "gravity": [0.0, 0.0, -9.81],
        "table_height": None,
        "marker_noise_std": config.noise,
        "notes": "Simulated by PyElastica 1.0.0 (Cosserat rod, 91 elements), not measured. True "
        f"numbers: bending stiffness {rope.bending:.4g} N m^2, twisting stiffness "
        f"{rope.twisting:.4g} N m^2, axial stiffness {rope.youngs * rope.area:.4g} N, uniform "
        f"damping rate {DAMPING} 1/s on velocities, straight and untwisted when undeformed, no "
        "air drag, no table. Two grippers hold the rope, each with two markers; the inner one "
        "sits where the rope leaves the gripper. Noise is white, "
        f"{1e3 * config.noise} mm on free markers and a tenth of it on gripped ones; the "
        "grippers' orientations are exact and equal when the rope is straight and untwisted. "
        "One per cent of the free markers is not seen. The rope already moves in the first frame.",
    }


def draw(trials: dict[str, dict[str, np.ndarray]], path: str) -> None:
    """Picture of every trial: the rope in x-z and y-z at ten times."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4 * len(trials), 7))
    axes = figure.subplots(2, len(trials), squeeze=False)
    for column, (name, trial) in zip(axes.T, trials.items(), strict=True):
        column[0].set_title(name)
        for frame in np.linspace(0, len(trial["time"]) - 1, 10).astype(int):
            x, y, z = trial["markers"][frame].T
            color = (frame / len(trial["time"]), 0.3, 0.6)
            column[0].plot(x, z, ".-", color=color)
            column[1].plot(y, z, ".-", color=color)
        for ax, label in zip(column, ("x", "y"), strict=True):
            ax.set(xlabel=f"{label} [m]", ylabel="z [m]", aspect="equal")
    figure.savefig(path, dpi=60)


def main() -> None:
    """Make the recording."""
    parser = Parser(__file__, description=(__doc__ or "").split("\n\n")[0])
    for name in ("out", "picture"):
        parser.add_argument(f"--{name}", default=getattr(Config, name))
    parser.add_argument("--elements", type=count, default=Config.elements)
    parser.add_argument("--seed", type=int, default=Config.seed)
    for name in ("duration", "noise", "dropout"):
        parser.add_argument(f"--{name}", type=float, default=getattr(Config, name))
    parser.flag("smoke", "one short, coarse trial")
    parser.flag("converge", "only compare element counts")
    options = vars(parser.parse_args())
    converge, config = options.pop("converge"), Config(**options)
    if converge:
        times, arclength = np.linspace(0, 3, 31), marker_arclength(config.elements)
        runs = []
        for n in (config.elements, 3 * config.elements):
            motion = random_motion(np.random.default_rng([config.seed, 0]))
            runs.append(clean_trial(motion, n, arclength, times, 5.0))
        print(f"{config.elements} elements against three times as many: {gap(*runs):.2f} mm")
        return
    out = Path(config.out)
    out.mkdir(parents=True, exist_ok=True)
    names = [*(f"train_{i}" for i in range(3)), *(f"test_{i}" for i in range(2))]
    trials = {}
    for i, name in enumerate(names[:1] if config.smoke else names):
        print(name)
        trials[name] = record(config, np.random.default_rng([config.seed, i]))
        np.savez_compressed(out / f"{name}.npz", **trials[name])
    (out / "rope.json").write_text(json.dumps(describe(config), indent=1) + "\n")
    if config.picture:
        draw(trials, config.picture)
    print(f"{sum(p.stat().st_size for p in out.iterdir()) / 1e3:.0f} kB in {out}")


if __name__ == "__main__":
    main()
