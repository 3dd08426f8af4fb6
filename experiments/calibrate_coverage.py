"""How often the 90 % intervals of `calibrate` hold the truth: recordings by an independent simulator, each drawn anew.

Every recording has a rope, grippers' motions and noise of its own, three train trials and one test trial. They are made
by the simulator of `hidden_effects`, which shares nothing with torchdlo. Ropes stretch and shear as solid ones do, and
clamps begin to hold up to half a radius before or behind the marker that is said to be there. Results are kept in a
file of lines; what is there already is not done again.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

sys.path.append(str(Path(__file__).resolve().parent / "hidden_effects"))

import make
import scenes
from cases import Case
from options import Parser, count

from torchdlo.sysid.calibration.calibrate import calibrate
from torchdlo.sysid.recordings.recording import load_recording

TRIALS = ["train_0", "train_1", "train_2", "test_0"]
"""Trials of each recording."""
MESH = (64, 1e-3)
"""Elements and steps [s] that recordings are made with."""


@dataclass(frozen=True)
class Config:
    """What to make."""

    count: int = 20
    """Recordings."""
    first: int = 1000
    """Seed of the first rope: none of those of the blinded benchmark."""
    duration: float = 1.5
    """Length of a trial [s]."""
    starts: int = 16
    """Random starts of each calibration."""
    out: str = "runs/coverage/results.jsonl"
    """File of results, one a line."""
    smoke: bool = False
    """One short recording, to see that the script runs."""


def recorded(seed: int, config: Config, folder: Path) -> dict[str, float]:
    """Write a recording and return its true numbers."""
    case = Case("null", (), 0.0, seed)
    scene = replace(scenes.draw(seed), duration=0.5 if config.smoke else config.duration)
    rope = replace(scene.rope, axial=4 * scene.rope.bending / scene.rope.radius**2)
    scene, off = replace(scene, rope=rope), rope.radius * np.random.default_rng([seed, 21]).uniform(-0.5, 0.5)
    make.TRIALS[:] = TRIALS
    trials = make.record(case, scene, {}, (24, 2e-3) if config.smoke else MESH, "coverage")
    make.write(folder, scene, [misplaced(trial, scene, off) for trial in trials])
    return {
        "bending_stiffness": rope.bending,
        "twisting_stiffness": rope.twisting,
        "damping_rate": rope.damping,
    }


def misplaced(trial: dict[str, Any], scene: scenes.Scene, off: float) -> dict[str, Any]:
    """Return a trial whose inner markers on grippers are further along the rope than where clamps end, by `off` [m]."""
    markers, arclength = trial["markers"].copy(), trial["marker_arclength"].copy()
    for outer, inner in ((0, 1), (-1, -2))[: scene.grippers]:
        axis = markers[:, inner] - markers[:, outer]
        markers[:, inner] += off * axis / np.linalg.norm(axis, axis=-1, keepdims=True)
        arclength[inner] += off if inner > 0 else -off
    return trial | {"markers": markers, "marker_arclength": arclength}


def judged(seed: int, config: Config) -> dict[str, Any]:
    """Make and calibrate one recording."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "recording"
        truth = recorded(seed, config, path)
        begun = time.process_time()
        options = {"starts": 2, "iterations": 1} if config.smoke else {"starts": config.starts}
        result = calibrate(load_recording(path), **options)
    return {
        "seed": seed,
        "truth": truth,
        "parameters": result.parameters,
        "test_mae_mm": result.test_mae_mm,
        "cpu_seconds": time.process_time() - begun,
    }


def table(rows: list[dict[str, Any]]) -> str:
    """Return how often each interval holds the truth, how wide it is, and how far off values are."""
    out = ["| | held | half width, median | error, median |", "|---|---|---|---|"]
    total = 0
    for name in rows[0]["truth"]:
        true = np.array([row["truth"][name] for row in rows])
        value, low, high = (
            np.array([row["parameters"][name][key] for row in rows]) for key in ("value", "low", "high")
        )
        held = int(((low <= true) & (true <= high)).sum())
        total += held
        half, error = np.median(0.5 * (high - low) / true), np.median(abs(value / true - 1))
        out.append(f"| {name.replace('_', ' ')} | {held} of {len(rows)} | {half:.2%} | {error:.2%} |")
    n = len(rows[0]["truth"]) * len(rows)
    return "\n".join([*out, f"| all | {total} of {n} ({total / n:.0%}) | | |"])


def main() -> None:
    """Make what is missing and say how often intervals held."""
    parser = Parser(__file__, description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--out", default=Config.out, help="file of results")
    parser.add_argument("--count", type=count, default=Config.count, help="recordings")
    parser.add_argument("--first", type=int, default=Config.first, help="seed of the first rope")
    parser.add_argument("--starts", type=count, default=Config.starts, help="random starts of each calibration")
    parser.add_argument("--duration", type=float, default=Config.duration, help="length of a trial [s]")
    parser.flag("smoke", "one short recording")
    config = Config(**vars(parser.parse_args()))
    out = Path(config.out)
    out.parent.mkdir(parents=True, exist_ok=True)
    rows = [json.loads(line) for line in out.read_text().splitlines()] if out.exists() else []
    for seed in range(config.first, config.first + (1 if config.smoke else config.count)):
        if any(row["seed"] == seed for row in rows):
            continue
        rows.append(judged(seed, config))
        with out.open("a") as file:
            file.write(json.dumps(rows[-1]) + "\n")
        print(f"{seed}: {rows[-1]['cpu_seconds']:.0f} s", flush=True)
    print(table(rows))


if __name__ == "__main__":
    main()
