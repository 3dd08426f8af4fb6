"""Make recordings of simulated ropes that hide an effect, with the answers in a folder of their own.

The recordings have names that say nothing. Those that are there already are left as they are, so that a run which was
stopped can go on.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import sys
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

sys.path.append(str(Path(__file__).resolve().parents[1]))

from cases import COARSE, FINE, MEASUREMENT, PARTS, TIES, TRIALS, Case, look, plain, size, subset
from options import Parser, save
from scenes import Scene, run, seen
from simulate import Mesh, Track
from vectors import Array, exponential, multiply

if TYPE_CHECKING:
    from links import Chain

HELD = 0.1
"""Noise of gripped markers, relative to that of free ones."""
DROPOUT = 0.01
"""Share of free markers that are not seen."""
LOST, TOGETHER = 0.15, 6
"""The same of a recording with many gaps, and frames that are lost together."""
GRID = 1e-3
"""Steps in which a recording is written whose places are coarse [m]."""
MEMORY = 0.8
"""Correlation of coloured noise from frame to frame."""


@dataclass(frozen=True)
class Config:
    """What to make and where."""

    out: str = "runs/hidden/recordings"
    """Folder that the recordings go to."""
    answers: str = "runs/hidden/answers"
    """Folder that the answers go to; it must not be within the other."""
    subset: str = "first"
    """Which part of the benchmark."""
    salt: str = "rope"
    """Recordings of another salt have other names and other noise."""
    smoke: bool = False
    """One short, coarse recording, to see that the script runs."""


def identity(case: Case, salt: str) -> str:
    """Return the name of a case's recording."""
    return "r" + hashlib.sha256(f"{salt} {case.name}".encode()).hexdigest()[:8]


def hide(case: Case, scene: Scene) -> tuple[dict[str, float], float]:
    """Return the numbers that a case hides, and the gap that they leave [m]."""
    if not case.effects:
        return {}, 0.0
    base, numbers, gap = plain(scene), {}, 0.0
    for effect in case.effects:
        found, gap = size(effect, scene, base, case.ratio * scene.noise)
        numbers |= found
    return numbers, gap if len(case.effects) == 1 else base.gap(look(scene, [numbers])[0][0])


def coloured(rng: np.random.Generator, shape: tuple[int, ...], memory: float) -> Array:
    """Return noise of unit variance (F, ...) that is correlated from frame to frame."""
    white = rng.standard_normal(shape)
    for k in range(1, len(white)):
        white[k] = memory * white[k - 1] + np.sqrt(1 - memory**2) * white[k]
    return white


def gaps(rng: np.random.Generator, shape: tuple[int, int]) -> Array:
    """Return which markers are lost in which frames (F, M), in stretches; all are seen in the first frame."""
    begun = rng.random(shape) < LOST / TOGETHER
    lost = np.zeros(shape, bool)
    for k in range(TOGETHER):
        lost[k:] |= begun[: len(begun) - k]
    lost[0] = False
    return lost


def simulate(case: Case, scene: Scene, rows: list[dict], fine: tuple[int, float]) -> tuple[Track, Mesh | Chain]:
    """Return the rope's motion in all trials, by the case's simulator."""
    if case.simulator != "links":
        return run(scene, TRIALS, rows, *fine)
    try:
        import links
    except ImportError as e:
        raise SystemExit(f"{e.name} is not installed; chains of links need it: pip install mujoco") from e
    count = round((scene.free_end - scene.grip) / scene.grip)
    return links.run(scene, TRIALS, rows, count, links.STEP, case.variant)


def record(case: Case, scene: Scene, numbers: dict[str, float], fine: tuple[int, float], salt: str) -> list[dict]:
    """Return the arrays of all trials."""
    seed = int(hashlib.sha256(f"{salt} {case.name} noise".encode()).hexdigest()[:8], 16)
    rows = [numbers] * len(TRIALS)
    markers, turns = seen(scene, TRIALS, rows, *simulate(case, scene, rows, fine))
    out = []
    for b, clean in enumerate(markers):
        rng = np.random.default_rng([seed, b])
        wild = case.variant == "coloured"
        noise = coloured(rng, clean.shape, MEMORY if wild else 0.0)
        level = np.where(scene.gripped, HELD, 1.0)[:, None] * scene.noise
        turn = turns[b]
        if wild:
            # The gripper's log is off by a little that differs between trials.
            level, clean = level * np.exp(0.2 * rng.standard_normal()), clean.copy()
            clean[:, scene.gripped] += 0.5 * scene.noise * rng.standard_normal(3)
            off = exponential(0.002 * rng.standard_normal((3, 1, 1)))
            turn = multiply(off, turn.transpose(2, 0, 1)).transpose(1, 2, 0)
        dirty = clean + level * noise
        if case.variant == "quantised":
            dirty[:, ~scene.gripped] = GRID * np.round(dirty[:, ~scene.gripped] / GRID)
        dirty[(rng.random(dirty.shape[:2]) < DROPOUT) & ~scene.gripped] = np.nan
        if case.variant == "dropouts":
            dirty[gaps(rng, dirty.shape[:2]) & ~scene.gripped] = np.nan
        last = [0, scene.markers - 1][: scene.grippers]
        out.append(
            {
                "time": scene.times,
                "markers": dirty.astype(np.float32),
                "marker_arclength": scene.arclength,
                "gripped": scene.gripped,
                "gripper_quaternion": turn.astype(np.float32),
                "gripper_marker": np.array(last),
            }
        )
    return out


def write(folder: Path, scene: Scene, trials: list[dict]) -> None:
    """Write a recording that is complete or not there."""
    scratch = folder.with_name(f".{folder.name}")
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir(parents=True)
    rope = {
        "length": scene.rope.length,
        "radius": scene.rope.radius,
        "mass": scene.rope.mass,
        "gravity": [0.0, 0.0, -9.81],
        "table_height": scene.table,
        "marker_noise_std": scene.noise,
    } | ({} if scene.fluid is None else {"fluid_density": scene.fluid})
    (scratch / "rope.json").write_text(json.dumps(rope, indent=1) + "\n")
    for name, arrays in zip(TRIALS, trials, strict=True):
        np.savez_compressed(scratch / f"{name}.npz", **arrays)
    scratch.replace(folder)


def answer(case: Case, scene: Scene, numbers: dict[str, float], gap: float) -> dict:
    """Return what a recording hides, in words and numbers."""
    effects: dict[str, dict[str, float]] = {}
    for name, value in numbers.items():
        effect, number = name.split(".", 1)
        effects.setdefault(effect, {})[number] = value
    named = [] if case.kind == "outside" else list(case.effects)
    return {
        "case": case.name,
        "kind": case.kind,
        "variant": case.variant,
        "answer": named,
        "effects": effects,
        "measurement": [e for e in named if e in MEASUREMENT],
        "ties": TIES.get(named[0], []) if len(named) == 1 else [],
        "wanted_ratio": case.ratio,
        "ratio": gap / scene.noise,
        "gap_m": gap,
        "noise_m": scene.noise,
        "scene": asdict(scene),
    }


def make(case: Case, scene: Scene, folder: Path, target: Path, salt: str, fine: tuple[int, float]) -> float:
    """Make one recording and its answer; return the ratio of its gap to the noise."""
    numbers, gap = hide(case, scene)
    trials = record(case, scene, numbers, fine, salt)
    save(str(target), answer(case, scene, numbers, gap))
    write(folder, scene, trials)
    return gap / scene.noise


def main() -> None:
    """Make the recordings that are not there yet."""
    parser = Parser(__file__, description=(__doc__ or "").split("\n\n")[0])
    for name in ("out", "answers", "salt"):
        parser.add_argument(f"--{name}", default=getattr(Config, name))
    parser.add_argument("--subset", default=Config.subset, choices=PARTS)
    parser.flag("smoke", "one short, coarse recording")
    config = Config(**vars(parser.parse_args()))
    out, answers = Path(config.out).resolve(), Path(config.answers).resolve()
    if answers.is_relative_to(out):
        parser.error(f"--answers {config.answers} is within --out {config.out}; expected folders apart")
    cases = subset("nulls" if config.smoke else config.subset)[: 1 if config.smoke else None]
    # A short recording must not pass for the real one.
    salt = config.salt + " smoke" * config.smoke
    names = [identity(case, salt) for case in cases]
    there = [(out / name).exists() and (answers / f"{name}.json").exists() for name in names]
    todo = [pair for pair, done in zip(zip(names, cases, strict=True), there, strict=True) if not done]
    begun = time.perf_counter()
    for k, (name, case) in enumerate(todo, 1):
        scene = replace(case.scene, duration=0.5) if config.smoke else case.scene
        # A null of its own kind: a rope that is simulated as coarsely as a model might be.
        fine = COARSE if config.smoke or case.variant == "grid" else FINE
        ratio = make(case, scene, out / name, answers / f"{name}.json", salt, fine)
        left = (time.perf_counter() - begun) / k * (len(todo) - k)
        print(f"{k}/{len(todo)} {name}: gap {ratio:.1f} times the noise; {left / 60:.0f} min left", flush=True)


if __name__ == "__main__":
    main()
