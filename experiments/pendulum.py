"""What is missing in a model of a pendulum: the rules of a diagnosis on something that is no rope.

    python experiments/pendulum.py                       # a recording of its own, with friction and drag hidden
    python experiments/pendulum.py --csv my_pendulum.csv --radius 0.42 --noise 0.001

A CSV has the columns trial, time and angle, in seconds and radians from hanging straight down. Until time 0 the
pendulum is held still at its angle, then it is let go; trials whose names begin with "test" judge what the others
choose.

The plain model is theta'' = -stiffness sin(theta) - damping theta'. What may be missing: dry friction in the bearing,
drag of the air, a bearing that pulls back like a spring, and an angle that is not read from zero. The recording of its
own is made by another integrator (DOP853), with a friction that sticks more sharply.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from options import Parser
from scipy.integrate import solve_ivp

from torchdlo.errors import InputError
from torchdlo.physics.effects.base import Param
from torchdlo.sysid.diagnosis.other_systems import EffectSpec, Selection, System, points_trial, select
from torchdlo.sysid.recordings.recording import Trial

SLIP = 0.02
"""Speed at which the model's friction is 0.7 of its full size [rad/s]."""

BASELINE = {
    "stiffness": Param(20.0, 1.0, 400.0, "1/s^2", "log", None, "Gravity over length."),
    "damping": Param(0.05, 1e-4, 5.0, "1/s", "log", None, "Rate at which the speed decays."),
}

EFFECTS = (
    EffectSpec(
        "bearing_friction",
        "theta'' = -deceleration sign(theta')",
        {"deceleration": Param(0.0, 0.0, 10.0, "rad/s^2", "linear", 0.0, "What dry friction takes.")},
        ({"deceleration": 0.1},),
    ),
    EffectSpec(
        "air_drag",
        "theta'' = -coefficient |theta'| theta'",
        {"coefficient": Param(0.0, 0.0, 5.0, "1", "linear", 0.0, "Drag over inertia.")},
        ({"coefficient": 0.05},),
    ),
    EffectSpec(
        "bearing_spring",
        "theta'' = -spring theta",
        {"spring": Param(0.0, -50.0, 50.0, "1/s^2", "linear", 0.0, "Stiffness of the bearing over inertia.")},
        ({"spring": 1.0}, {"spring": -1.0}),
    ),
    EffectSpec(
        "zero_offset",
        "angle read = theta + offset",
        {"offset": Param(0.0, -0.5, 0.5, "rad", "linear", 0.0, "Reading of a pendulum that hangs straight down.")},
        ({"offset": 0.01}, {"offset": -0.01}),
    ),
)


def on_circle(angle: np.ndarray, radius: float) -> np.ndarray:
    """Return the bob's places for angles (...), shape (..., 1, 3) [m]."""
    return radius * np.stack([np.sin(angle), 0 * angle, -np.cos(angle)], -1)[..., None, :]


def system(radius: float, effects: tuple[EffectSpec, ...] = EFFECTS) -> System:
    """Return the pendulum with its plain model and what it may lack."""

    def simulate(numbers: dict[str, np.ndarray], trials: Sequence[Trial]) -> np.ndarray:
        n = {name: values[:, None] for name, values in numbers.items()}

        def rate(x: np.ndarray, v: np.ndarray) -> np.ndarray:
            out = -n["stiffness"] * np.sin(x) - n["damping"] * v
            for name, add in LAWS.items():
                if f"{name}.{add[0]}" in n:
                    out = out + add[1](n[f"{name}.{add[0]}"], x, v)
            return out

        offset = n.get("zero_offset.offset", np.zeros((1, 1)))
        read = np.array([np.arctan2(t.markers[0, 0, 0], -t.markers[0, 0, 2]) for t in trials])
        x = read[None] - offset + np.zeros((len(numbers["stiffness"]), 1))
        v = np.zeros_like(x)
        dt, frames = float(trials[0].time[1] - trials[0].time[0]), max(len(t.time) for t in trials)
        found = np.empty((frames, *x.shape))
        with np.errstate(all="ignore"):
            for k in range(frames):
                found[k] = x + offset
                # Runge and Kutta, of fourth order.
                a1 = rate(x, v)
                a2 = rate(x + 0.5 * dt * v, v + 0.5 * dt * a1)
                a3 = rate(x + 0.5 * dt * v + 0.25 * dt**2 * a1, v + 0.5 * dt * a2)
                a4 = rate(x + dt * v + 0.5 * dt**2 * a2, v + dt * a3)
                x = x + dt * v + dt**2 / 6 * (a1 + a2 + a3)
                v = v + dt / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
        return on_circle(np.moveaxis(found, 0, 2), radius)

    return System(simulate, BASELINE, effects)


LAWS = {
    "bearing_friction": ("deceleration", lambda f, x, v: -f * v / np.sqrt(v**2 + SLIP**2)),
    "air_drag": ("coefficient", lambda k, x, v: -k * np.abs(v) * v),
    "bearing_spring": ("spring", lambda k, x, v: -k * x),
}
"""By effect: its number, and what it adds to the acceleration."""


def read(path: Path, radius: float) -> list[Trial]:
    """Return the trials of a CSV file, from the moment at which the pendulum is let go."""
    rows: dict[str, list[tuple[float, float]]] = {}
    with path.open(newline="") as file:
        lines = csv.DictReader(file)
        missing = {"trial", "time", "angle"} - set(lines.fieldnames or ())
        if missing:
            raise InputError(f"{path}: column {', '.join(sorted(missing))} is missing; expected trial, time and angle.")
        for number, line in enumerate(lines, 2):
            try:
                rows.setdefault(line["trial"], []).append((float(line["time"]), float(line["angle"])))
            except ValueError:
                raise InputError(
                    f"{path}: line {number}: time {line['time']!r} and angle {line['angle']!r}; expected numbers, in "
                    "seconds and radians."
                ) from None
    trials = []
    for name, pairs in rows.items():
        time, angle = np.array(sorted(pairs)).T
        held, free = time < 0, time >= 0
        if held.sum() < 5 or free.sum() < 20:
            raise InputError(
                f"{path}: {name}: {held.sum()} rows before time 0 and {free.sum()} after it; expected at least 5 of "
                "the pendulum held still and 20 of it let go."
            )
        # It starts at the mean of what was read while it was held, which is known better than one reading.
        points = on_circle(np.r_[angle[held].mean(), angle[free][1:]], radius)
        trials.append(points_trial(name, time[free] - time[free][0], points))
    return trials


def write(path: Path, hidden: dict[str, float], *, seed: int = 0, noise: float = 2e-3, duration: float = 6.0) -> None:
    """Write a recording of a pendulum that hides something, with angles that are noisy [rad]."""
    rng = np.random.default_rng(seed)
    deceleration, drag = hidden.get("bearing_friction", 0.0), hidden.get("air_drag", 0.0)
    spring, offset = hidden.get("bearing_spring", 0.0), hidden.get("zero_offset", 0.0)

    def rate(_: float, y: np.ndarray) -> list[float]:
        x, v = y
        lost = 0.04 * v + drag * abs(v) * v + deceleration * np.tanh(v / 0.005)
        return [v, -23.4 * np.sin(x) - spring * x - lost]

    names, angles = ["train_0", "train_1", "train_2", "test_0", "test_1"], [0.5, 1.3, 2.0, 0.9, 1.7]
    with path.open("w", newline="") as file:
        lines = csv.writer(file)
        lines.writerow(["trial", "time", "angle"])
        for name, start in zip(names, angles, strict=True):
            time = np.arange(0, duration, 0.02)
            swing = solve_ivp(rate, (0, duration), [start, 0.0], "DOP853", time, rtol=1e-9, atol=1e-9).y[0]
            time, swing = np.r_[np.arange(-15, 0) * 0.02, time], np.r_[np.full(15, start), swing]
            for t, x in zip(time, swing + offset + noise * rng.standard_normal(len(swing)), strict=True):
                lines.writerow([name, f"{t:.3f}", f"{x:.6f}"])


def told(found: Selection) -> str:
    """Return what was found, in words."""
    said = [
        f"{found.verdict}: the gap on test trials goes from {1e3 * found.before:.2f} to {1e3 * found.after:.2f} mm."
    ]
    said.append(f"A perfect model would leave {1e3 * found.level:.2f} mm.")
    for name in found.effects:
        own = [f"{k.split('.')[1]} {v:.3g} [{a:.3g}, {b:.3g}]" for k, (v, a, b) in found.numbers.items() if name in k]
        test = found.tests[name]
        said.append(
            f"{name.replace('_', ' ')}: {', '.join(own)}; p {test.p:.2g} ({test.units} {test.unit}s), false discovery "
            f"rate {found.rates[name]:.2g}" + (f"; or {', '.join(found.ties[name])}" if found.ties[name] else "") + "."
        )
    return "\n".join([*said, *(f"Doubt: {doubt}." for doubt in found.doubts)])


def main() -> None:
    """Diagnose a pendulum and say what was found."""
    parser = Parser(__file__, description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--csv", default="", help="a recording; one with friction and drag is made if not given")
    parser.add_argument("--radius", type=float, default=0.42, help="of the bob's circle [m]")
    parser.add_argument("--noise", type=float, default=4.9e-4, help="of its place, per coordinate [m]")
    config = parser.parse_args()
    path = Path(config.csv or "runs/pendulum.csv")
    if not config.csv:
        path.parent.mkdir(parents=True, exist_ok=True)
        write(path, {"bearing_friction": 0.3, "air_drag": 0.08})
    trials = read(path, config.radius)
    train, test = ([t for t in trials if t.name.startswith("test") == held] for held in (False, True))
    print(told(select(system(config.radius), train, test, config.noise)))


if __name__ == "__main__":
    main()
