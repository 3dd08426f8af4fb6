"""Benchmark of identification from films: 20 runs over three ropes, filmed badly, against the true numbers.

Each rope is simulated by PyElastica from rest (four train trials and two test trials of 2 s), filmed by one camera
with noise, blur, a bar in front and 2 % wrong frames, and calibrated with a camera that is written down wrongly by up
to 1 degree, 1 %, 10 mm and half a frame. Stiffnesses are up to ten times off what a calibration starts from. What is
done is kept, so that the script can be stopped and started again. Needs the extras `peers` and `video`.
"""

from __future__ import annotations

import json
import math
import shutil
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from cosserat import Grip, Rope, lead_in, quaternion, resample, rotation, simulate, smooth
from options import Parser, count, save

from torchdlo.sysid.calibration.calibrate import calibrate
from torchdlo.sysid.recordings.recording import load_recording
from torchdlo.sysid.video.filming import film_recording
from torchdlo.vision.camera import looking_at
from torchdlo.vision.film import FilmLook

HELD, ELEMENTS = 3, 61
"""Elements that a gripper holds, and all of a rope."""


@dataclass(frozen=True)
class Case:
    """One rope."""

    length: float
    radius: float
    mass: float
    bending: float
    damping: float

    def rope(self) -> Rope:
        """Return it as a Cosserat rod."""
        area = math.pi * self.radius**2
        return Rope(
            self.length,
            self.radius,
            self.mass / (area * self.length),
            4 * self.bending / (math.pi * self.radius**4),
        )


ROPES = {
    "soft": Case(0.8, 0.004, 0.045, 1.5e-3, 0.6),
    "middle": Case(0.7, 0.005, 0.060, 5.0e-3, 0.4),
    "stiff": Case(0.6, 0.0045, 0.035, 1.2e-2, 0.9),
}


def waves(rng: np.random.Generator, case: Case):
    """Return a motion of both grippers that begins at rest, and its pose there."""
    apart = 0.56 * case.length
    anchors = np.array([[-apart / 2, 0.0, 1.0], [apart / 2, 0.0, 1.0]])
    angles = np.array([[0.0, -0.5, 0.0], [0.0, 0.5, 0.0]])
    rate, phase = 2 * np.pi * rng.uniform(0.4, 1.2, (3, 2, 6)), rng.uniform(0, 2 * np.pi, (3, 2, 6))
    weight = rng.uniform(0.4, 1.0, rate.shape) / rate**1.5
    reach = np.array([0.06, 0.1, 0.1, 0.4, 0.4, 0.5])

    def raw(when: np.ndarray) -> np.ndarray:
        return (weight * (np.sin(rate * when[:, None, None, None] + phase) - np.sin(phase))).sum(1)

    largest = np.abs(raw(np.linspace(0, 2.5, 501))).max(0)

    def motion(when: np.ndarray):
        part = raw(when) / largest * reach * smooth(when, 0.4)[:, None, None]
        return anchors + part[..., :3], rotation(*np.moveaxis(angles + part[..., 3:], -1, 0))

    return motion, (anchors, angles)


def record(case: Case, folder: Path, seed: int, trials: tuple[int, int], seconds: float) -> None:
    """Write a recording with markers of a rope that is moved about."""
    work = folder.with_name(f".{folder.name}")
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    rope, n = case.rope(), ELEMENTS
    inner = (HELD - 0.5) * case.length / n
    place = np.array([0.0, *np.linspace(inner, case.length - inner, 23), case.length])
    gripped = np.isin(np.arange(len(place)), [0, 1, len(place) - 2, len(place) - 1])
    grips = Grip(elements=HELD), Grip(last=True, elements=HELD)
    when = np.arange(round(100 * seconds) + 1) / 100
    names = [*(f"train_{k}" for k in range(trials[0])), *(f"test_{k}" for k in range(trials[1]))]
    for k, name in enumerate(names):
        motion, pose = waves(np.random.default_rng([seed, k]), case)
        begin = lead_in(rope, n, grips, pose, duration=min(4.0, 2 * seconds))
        run = simulate(rope, n, grips, motion, times=when, damping=case.damping, start=begin)
        turns = motion(when)[1]
        np.savez_compressed(
            work / f"{name}.npz",
            time=when,
            markers=resample(run.positions, np.linspace(0, case.length, n + 1), place),
            marker_arclength=place,
            gripped=gripped,
            gripper_quaternion=np.stack([quaternion(turns[:, i]) for i in range(2)], 1),
            gripper_marker=np.array([0, len(place) - 1]),
        )
    content = {"length": case.length, "radius": case.radius, "mass": case.mass, "gravity": [0.0, 0.0, -9.81]}
    content |= {"table_height": None, "marker_noise_std": None}
    (work / "rope.json").write_text(json.dumps(content) + "\n")
    work.replace(folder)


def run_one(case: Case, recording: Path, folder: Path, seed: int) -> dict:
    """Film a recording and calibrate on the films; return what was found beside what is true."""
    rng = np.random.default_rng(seed)
    eye = [rng.uniform(-0.3, 0.3), -rng.uniform(1.1, 1.4), rng.uniform(0.9, 1.1)]
    camera = looking_at("a", eye, [0.0, 0.0, 0.9], focal=650.0)
    look = FilmLook(noise=4.0, bar=(0.46, 0.0, 0.49, 1.0), wrong=0.02, seed=seed)
    shutil.rmtree(folder, ignore_errors=True)
    film_recording(load_recording(recording), [camera], folder, look, off=1.0)
    begun = time.process_time()
    found = calibrate(load_recording(folder), seed=seed)
    used = time.process_time() - begun
    shutil.rmtree(folder)
    true = {"bending_stiffness": case.bending, "damping_rate": case.damping, "twisting_stiffness": 2 / 3 * case.bending}
    rows = {
        name: {**found.parameters[name], "true": value, "error": found.parameters[name]["value"] / value - 1}
        for name, value in true.items()
    }
    tests = [t for t in found.per_trial if t["split"] == "test"]
    judged = {key: float(np.mean([t[key] for t in tests])) for key in ("iou", "boundary_f", "distance_px", "mae_mm")}
    return {"cpu_s": used, "parameters": rows, "test": judged, "notes": found.notes}


def table(rows: list[dict]) -> str:
    """Return the runs as lines of Markdown, and how many are good."""
    lines = [
        "| rope | seed | bending | damping | twist | IoU | edges | px | CPU s |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        parts = row["parameters"]
        shares = [
            f"{100 * parts[k]['error']:+.1f} %" for k in ("bending_stiffness", "damping_rate", "twisting_stiffness")
        ]
        judged = row["test"]
        lines.append(
            f"| {row['rope']} | {row['seed']} | {' | '.join(shares)} | {judged['iou']:.2f} | "
            f"{judged['boundary_f']:.2f} | {judged['distance_px']:.2f} | {row['cpu_s']:.0f} |"
        )
    main = ("bending_stiffness", "damping_rate")
    near = sum(all(abs(r["parameters"][k]["error"]) < 0.05 for k in main) for r in rows)
    held = [
        r["parameters"][k]["low"] <= r["parameters"][k]["true"] <= r["parameters"][k]["high"]
        for r in rows
        for k in main
    ]
    lines += ["", f"{near} of {len(rows)} within 5 % in both; {sum(held)} of {len(held)} ranges hold the true value."]
    return "\n".join(lines)


def stored(row: dict) -> dict:
    """Return what is kept of a run in the repository."""
    parts = {k: {n: v[n] for n in ("true", "value", "low", "high")} for k, v in row["parameters"].items()}
    return {"rope": row["rope"], "seed": row["seed"], "cpu_s": row["cpu_s"], "parameters": parts, "test": row["test"]}


def summary(rows: list[dict]) -> str:
    """Return the table and the sentences of the documentation, from rows as `stored` returns them."""
    names = {"bending_stiffness": "bending", "damping_rate": "damping", "twisting_stiffness": "twist"}

    def error(row: dict, name: str) -> float:
        return 100 * (row["parameters"][name]["value"] / row["parameters"][name]["true"] - 1)

    def between(values: list[float], digits: int = 1, unit: str = "") -> str:
        low, high = (f"{x:.{digits}f}" for x in (min(values), max(values)))
        return f"{low}{unit}" if low == high else f"{low} to {high}{unit}"

    lines = [f"| rope | runs | {' | '.join(names.values())} |", "|---|---|---|---|---|"]
    for rope in ROPES:
        own = [r for r in rows if r["rope"] == rope]
        if own:
            cells = " | ".join(between([error(r, n) for r in own], 1, " %") for n in names)
            lines.append(f"| {rope} | {len(own)} | {cells} |")
    near = sum(all(abs(error(r, n)) < 5 for n in ("bending_stiffness", "damping_rate")) for r in rows)
    ranges = [r["parameters"][n] for r in rows for n in names]
    held = sum(p["low"] <= p["true"] <= p["high"] for p in ranges)
    seen = {k: [r["test"][k] for r in rows] for k in ("distance_px", "mae_mm", "boundary_f", "iou")}
    used = sorted(r["cpu_s"] for r in rows)
    lines += [
        "",
        f"{near} of {len(rows)} runs have bending stiffness and damping within 5 %.",
        f"{held} of {len(ranges)} ranges hold the true value.",
        f"Unseen films: {between(seen['distance_px'], 2)} px, {between(seen['mae_mm'], 2)} mm,",
        f"boundary F {between(seen['boundary_f'], 2)}, overlap {between(seen['iou'], 2)}.",
        f"{used[0]:.0f} to {used[-1]:.0f} CPU seconds, {float(np.median(used)):.0f} in the median.",
    ]
    return "\n".join(lines)


def main() -> None:
    """Run what is left of the benchmark."""
    parser = Parser(__file__, description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--out", default="runs/video_benchmark", help="folder that keeps what is done")
    parser.add_argument("--json", default="", help="file for all rows")
    parser.add_argument("--runs", type=count, default=20)
    parser.add_argument("--summary", default="", help="print the table of the documentation from a file, and end")
    parser.flag("smoke", "one short run of one rope")
    options = parser.parse_args()
    if options.summary:
        print(summary(json.loads(Path(options.summary).read_text())["rows"]))
        return
    torch.set_num_threads(1)
    out, rows = Path(options.out), []
    trials, seconds = ((1, 1), 0.6) if options.smoke else ((4, 2), 2.0)
    names = list(ROPES)
    for seed in range(1 if options.smoke else options.runs):
        name = names[seed % len(names)]
        done = out / f"run_{seed:02d}.json"
        if not done.is_file():
            source = out / f"{name}_markers"
            if not source.is_dir():
                record(ROPES[name], source, names.index(name), trials, seconds)
            row = {"rope": name, "seed": seed} | run_one(ROPES[name], source, out / f"films_{seed:02d}", seed)
            save(str(done), row)
        rows.append(json.loads(done.read_text()))
        print(table(rows[-1:]).splitlines()[2], flush=True)
    save(options.json, {"rows": [stored(r) for r in rows]})
    print(table(rows))


if __name__ == "__main__":
    main()
