"""What the model of a real cable lacks, and whether a diagnosis names what was planted into its recordings.

    python experiments/real_cables.py RECORDING [RECORDING ...] --out runs/cables
    python experiments/real_cables.py RECORDING --plant time_delay tilted_gravity marker_offset point_mass
    python experiments/real_cables.py --table runs/cables    # the tables of what is there, as Markdown

RECORDING is a folder as `torchdlo import-deform` writes it. Without `--plant`, the cable is diagnosed as it is; errors
are those published for the DEFORM cables (see `torchdlo.sysid.recordings.metrics`). `--blocks` makes the last
fifth of the trials, by their numbers, the test trials: published splits interleave cuts of the same motions.

Planted are: a delay of 20 ms (markers of the rope are taken from two hundredths of a second earlier than those of the
grippers), a frame that is 2 degrees out of level (all markers turned about x), and, as differences of two simulations
with and without them, markers 8 mm beside the axis and a bead of 10 g at 0.4 of the length. What the cable lacks anyhow
is known then: the model that its own diagnosis wrote is the baseline. A plant counts as named if it is among the
effects that are named in addition, or among those that cannot be told from them.
"""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from cable_table import table
from options import Parser, count, save

from torchdlo.cli.progress import progress
from torchdlo.files import write_atomically
from torchdlo.sysid.diagnosis.effect_search import BUDGETS, diagnose
from torchdlo.sysid.diagnosis.findings import findings, model_json
from torchdlo.sysid.diagnosis.verdict import Diagnosis
from torchdlo.sysid.model import initial_state as starts
from torchdlo.sysid.model import model_file
from torchdlo.sysid.model.model_file import ModelFile
from torchdlo.sysid.model.rope_model import RopeModel
from torchdlo.sysid.recordings.metrics import average, mean_absolute_error
from torchdlo.sysid.recordings.recording import Recording, Trial, load_recording

DELAY, TILT = 0.02, np.radians(2.0)

SIMULATED = {
    "marker_offset": {"marker_offset.offset.0": 0.008},
    "point_mass": {"point_mass.position": 0.4, "point_mass.mass": 0.01},
}
"""Numbers of the plants that are simulated; a position is a share of the length."""

PLANTS = ("time_delay", "tilted_gravity", *SIMULATED)


def blocks(recording: Recording) -> Recording:
    """Return the recording with the last fifth of its trials, by name, as test trials."""
    trials = sorted(recording.trials("all"), key=lambda t: t.name.rpartition("_")[2])
    cut = len(trials) - len(trials) // 5
    return replace(recording, train=tuple(trials[:cut]), test=tuple(trials[cut:]))


def delayed(trial: Trial) -> Trial:
    """Return the trial with free markers that lag the gripped ones."""
    late = round(DELAY / float(trial.time[1] - trial.time[0]))
    markers = trial.markers[late:].copy()
    markers[:, ~trial.gripped] = trial.markers[:-late, ~trial.gripped]
    cut = {"time": trial.time[: len(markers)], "markers": markers}
    for name in ("suspect", "gripper_quaternion"):
        if getattr(trial, name) is not None:
            cut[name] = getattr(trial, name)[late:]
    return replace(trial, **cut)


def tilted(trial: Trial) -> Trial:
    """Return the trial in a frame that is out of level."""
    c, s = np.cos(TILT), np.sin(TILT)
    return replace(trial, markers=trial.markers @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]]).T)


def simulated(recording: Recording, name: str, base: ModelFile) -> Recording:
    """Return the recording with what an effect changes in a simulation added to the free markers."""
    if name in base.effects:
        raise SystemExit(f"{base.path}: {name} is there already; expected a cable without it to plant it.")
    models = [base.model(recording), RopeModel(recording, effects=(*base.effects, name), **base.options)]
    numbers = base.values | SIMULATED[name]
    if name == "point_mass":
        numbers["point_mass.position"] *= recording.length
    trials, sims = recording.trials("all"), []
    for model in models:
        values = np.array(
            [numbers.get(n, g) for n, g in zip(model.parameters, model.guess(), strict=True)], dtype=float
        )
        motion = model.motion(trials)
        sims.append(model.simulate(motion, starts.begin(model, trials), values[None])[0])
    change = sims[1] - sims[0]
    made = []
    for trial, moved in zip(trials, change, strict=True):
        shift = np.where(trial.gripped[:, None], 0.0, moved[: len(trial.time)])
        made.append(replace(trial, markers=trial.markers + shift))
    first = len(recording.train)
    return replace(recording, train=tuple(made[:first]), test=tuple(made[first:]))


def planted(recording: Recording, name: str, base: ModelFile) -> Recording:
    """Return the recording with an effect planted."""
    if name in SIMULATED:
        return simulated(recording, name, base)
    change = {"time_delay": delayed, "tilted_gravity": tilted}[name]
    return replace(recording, train=tuple(map(change, recording.train)), test=tuple(map(change, recording.test)))


def diagnosed(recording: Recording, out: Path, plant: str, base: ModelFile | None, choices: dict[str, Any]) -> dict:
    """Return the row of the table, from the file if it was written before; a search that was stopped goes on."""
    kept, model = out.with_suffix(".json"), out.with_name(f"{out.name}-model.json")
    if kept.exists():
        return json.loads(kept.read_text())
    print(out.name, flush=True)
    with progress() as callback:
        found = diagnose(recording, **choices, callback=callback, journal=out, resume=out.exists(), given=base)
    write_atomically(model, model_json(found))
    save(str(kept), row(recording, out.name.removesuffix(f"-{plant}"), found, plant, base))
    shutil.rmtree(out)
    return json.loads(kept.read_text())


def row(recording: Recording, name: str, found: Diagnosis, plant: str, base: ModelFile | None) -> dict:
    """Return what a diagnosis found, for the table."""
    compared = [t for t, through in zip(recording.test, found.compared, strict=True) if through]
    errors = {
        when: 1e3 * average(mean_absolute_error, [sims[t.name] for t in compared], compared)
        for when, sims in found.predictions.items()
    }
    numbers = dict(zip(found.model.parameters, map(float, found.final.values), strict=True))
    told = findings(found, recording)
    return {
        "recording": name,
        "plant": plant,
        "verdict": found.verdict,
        "effects": found.effects,
        "ties": found.ties,
        "shares": found.shares,
        "p_values": {e["name"]: e["test"] and e["test"]["p_value"] for e in told["effects"]},
        "detection_limits": told["detection_limits"],
        "candidates": told["candidates"],
        "test_mae_before_mm": errors["before"],
        "test_mae_after_mm": errors["after"],
        "test_trials": [len(compared), len(recording.test)],
        "floor_mm": 1e3 * found.floor.total,
        "gap_before_mm": (1e3 * found.before).tolist(),
        "gap_after_mm": (1e3 * found.after).tolist(),
        "numbers": numbers,
        "baseline": list(base.effects) if base else [],
        "named": not plant or any(plant in (e, *found.ties.get(e, [])) for e in found.effects),
        "seconds": found.seconds,
    }


def stored(folder: Path) -> list[dict]:
    """Return the rows of all recordings and plants in a folder of results."""
    found = [json.loads(p.read_text()) for p in sorted(folder.glob("*.json")) if not p.stem.endswith("-model")]
    return [row for row in found if isinstance(row, dict)]


def show(rows: list[dict]) -> None:
    """Print the table."""
    print(f"{'recording':14}{'planted':16}{'verdict':10}{'before':>8}{'after':>8}  effects")
    for r in rows:
        mark = "" if r["named"] else "   (NOT NAMED)"
        names = ", ".join(r["effects"]) or "-"
        print(
            f"{r['recording']:14}{r['plant'] or '-':16}{r['verdict']:10}"
            f"{r['test_mae_before_mm']:8.2f}{r['test_mae_after_mm']:8.2f}  {names}{mark}"
        )
    print("before, after: mean absolute error per coordinate on the test trials [mm]")
    for r in rows:
        through, tested = r["test_trials"]
        if through < tested:
            print(f"{r['recording']}: on {through} of {tested} test trials; a simulation fails on the others")


def main() -> None:
    """Diagnose the recordings."""
    parser = Parser(__file__, description=__doc__)
    parser.add_argument("recordings", nargs="*", type=Path, help="folders of recordings")
    parser.add_argument("--table", default="", help="folder of results whose tables are printed; nothing is run")
    parser.add_argument("--plant", nargs="*", choices=PLANTS, default=[], help="effects to plant, one at a time")
    parser.add_argument("--budget", choices=sorted(BUDGETS), default="full")
    parser.add_argument("--trials", type=count, default=None, help="most train trials to use")
    parser.add_argument("--vertices", type=count, default=None, help="vertices of the rope")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=count, default=None, help="processes; one per core if not given")
    parser.add_argument("--out", default="runs/cables", help="folder of the results; what is in it is not done again")
    parser.flag("blocks", "test on the last fifth of the trials")
    args = parser.parse_args()
    if args.table:
        print(table(stored(Path(args.table))))
        return
    if not args.recordings:
        parser.error("no recording is given; expected folders as `torchdlo import-deform` writes them, or --table")
    rows, choices = [], {k: getattr(args, k) for k in ("budget", "seed", "trials", "vertices", "workers")}
    for path in args.recordings:
        recording = load_recording(path)
        recording = blocks(recording) if args.blocks else recording
        out = Path(args.out) / (f"{path.name}-blocks" if args.blocks else path.name)
        plain = diagnosed(recording, out, "", None, choices)
        if not args.plant:
            rows.append(plain)
        for plant in args.plant:
            base = model_file.load(out.with_name(f"{out.name}-model.json"))
            here = planted(recording, plant, base)
            rows.append(diagnosed(here, out.with_name(f"{out.name}-{plant}"), plant, base, choices))
    show(rows)
    save(f"{args.out}/real_cables.json", rows)


if __name__ == "__main__":
    main()
