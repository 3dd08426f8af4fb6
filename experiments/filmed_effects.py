"""Does `torchdlo diagnose` name what is missing when all that it has is films?

    python experiments/filmed_effects.py make --out runs/filmed_effects        # films of ropes that hide an effect
    python experiments/filmed_effects.py diagnose --out runs/filmed_effects    # and what is found in them, as a table
    python experiments/filmed_effects.py table --json experiments/filmed_effects.json    # of what was stored

`make` simulates ropes by the rod code of `experiments/hidden_effects`, which shares nothing with the program, and films
them by one or two cameras that are written down wrongly, with noise, blur and 2 % wrong frames: each of five effects
at ten times the noise of markers, and ropes that hide nothing. `diagnose` takes any folder of films with the answers
beside it. What is there already, in --out or in --json, is not done again.
"""

from __future__ import annotations

import json
import shutil
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

sys.path.append(str(Path(__file__).resolve().parent / "hidden_effects"))

from cases import FINE, Case
from filmed_cables import cameras_of
from make import answer, hide, record, write
from options import Parser, count, save

from torchdlo.report.pages import diagnosis as report
from torchdlo.sysid.diagnosis.effect_search import diagnose
from torchdlo.sysid.diagnosis.findings import findings
from torchdlo.sysid.recordings.recording import load_recording
from torchdlo.sysid.video.filming import film_recording
from torchdlo.vision.film import FilmLook

EFFECTS = ("point_mass", "rest_curvature", "bending_damping", "air_drag", "table_friction")
EXACT = 1e-6
"""Noise of markers that centre lines are drawn through [m]."""
LARGE = 3
"""Times its floor from which a gap of the calibrated rope is large."""


def cases(seeds: int, nothing: int) -> list[Case]:
    """Return what is hidden: each effect so many times, and nothing."""
    single = [Case("single", (e,), 10.0, 3000 + 10 * k + s) for s in range(seeds) for k, e in enumerate(EFFECTS)]
    return [*single, *[Case("null", (), 0.0, 3100 + s, "table" if s % 3 == 2 else "") for s in range(nothing)]]


def make(out: Path, chosen: list[Case], cameras: int, trials: int, seconds: float) -> None:
    """Film ropes that hide an effect, or nothing."""
    for case in chosen:
        name = f"{case.name}_{cameras}"
        folder, target = out / "films" / name, out / "answers" / f"{name}.json"
        if folder.is_dir():
            continue
        source = out / "markers" / case.name
        if not source.is_dir():
            numbers, gap = hide(case, case.scene)
            arrays = record(case, replace(case.scene, noise=EXACT), numbers, FINE, "films")
            write(source, replace(case.scene, noise=EXACT), arrays)
            save(str(out / "markers" / f"{case.name}.json"), answer(case, case.scene, numbers, gap))
        recording = load_recording(source)
        look = FilmLook(noise=4.0, wrong=0.02, seed=case.seed)
        seen = cameras_of(recording, cameras)
        film_recording(recording, seen, folder, look, off=1.0, trials=trials, seconds=seconds)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(out / "markers" / f"{case.name}.json", target)
        print(f"{name}: filmed", flush=True)


def look_at(folder: Path, answers: Path, seed: int, page: Path) -> dict[str, Any]:
    """Return what is found in films, beside what they hide."""
    recording = load_recording(folder)
    begun, wall = time.process_time(), time.perf_counter()
    found = diagnose(recording, workers=1, seed=seed)
    told = findings(found, recording)
    used = {"cpu_s": time.process_time() - begun, "wall_s": time.perf_counter() - wall}
    report.write_report(found, recording, page)
    answer = json.loads((answers / f"{folder.name}.json").read_text())
    true = answer["answer"]
    named = [e["name"] for e in told["effects"]]
    sets = [{e["name"], *e.get("indistinguishable_from", [])} for e in told["effects"]]
    right = all(any(t in each for each in sets) for t in true) and all(each & set(true) for each in sets)
    as_well = sorted({other for e in told["effects"] for other in e.get("indistinguishable_from", [])})
    return {
        "name": folder.name,
        "cameras": len(recording.train[0].films),
        "hidden": true,
        "true": answer["effects"],
        "verdict": told["verdict"],
        "named": named,
        "or": as_well,
        "right": right if true else told["verdict"] == "none",
        "gap": {k: v for k, v in told["gap"].items() if isinstance(v, float)},
        "effects": {e["name"]: {k: v["value"] for k, v in e["parameters"].items()} for e in told["effects"]},
        "candidates": told["candidates"],
        **used,
    }


def kept(row: dict[str, Any]) -> dict[str, Any]:
    """Return what is stored of a row in the repository."""
    return {key: value for key, value in row.items() if key != "candidates"}


def table(rows: list[dict[str, Any]]) -> str:
    """Return rows as Markdown, and how often findings are right, with 90 % bounds by counting (Clopper-Pearson)."""
    lines = [
        "| films | cameras | hidden | verdict | named | or | gap on unseen films [mm] | floor | CPU s |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        before, after, floor = (
            1e3 * row["gap"][k] for k in ("test_rmse_before_m", "test_rmse_after_m", "noise_floor_m")
        )
        gap = f"{before:.2f} → {after:.2f}" if row["named"] else f"{before:.2f}"
        hidden, named = _with_numbers(row["hidden"], row["true"]), _with_numbers(row["named"], row["effects"])
        # A star is of an earlier version of the program.
        name = row["name"].removeprefix("single-") + " *" * row.get("earlier", False)
        lines.append(
            f"| {name} | {row['cameras']} | {hidden or 'nothing'} | `{row['verdict']}` "
            f"| {named} | {', '.join(row['or'])} | {gap} | {floor:.2f} | {row['cpu_s']:.0f} |"
        )
    lines.append("")
    some, none = ([row for row in rows if bool(row["hidden"]) == wanted] for wanted in (True, False))
    said = {f"something hidden, {n} camera{'s' * (n > 1)}": [r for r in some if r["cameras"] == n] for n in (2, 1)}
    for what, each in said.items():
        among = [set(r["hidden"]) <= {*r["named"], *r["or"]} for r in each]
        lines += [_rate(f"{what}: named", among)]
        large = [r["gap"]["test_rmse_before_m"] >= LARGE * r["gap"]["noise_floor_m"] for r in each]
        lines += [
            _rate(
                f"{what}, gap of {LARGE} floors or more: named", [a for a, big in zip(among, large, strict=True) if big]
            )
        ]
        lines += [_rate(f"{what}: named, and nothing else", [r["right"] for r in each])]
    lines += [_rate("nothing hidden: nothing named", [not r["named"] for r in none])]
    lines += [_rate("nothing hidden: said to be explained", [r["right"] for r in none])]
    return "\n".join(lines)


def _with_numbers(names: list[str], numbers: dict[str, dict[str, float]]) -> str:
    """Return effects with their numbers, in SI units."""
    said = ((name, ", ".join(f"{v:.3g}" for v in numbers.get(name, {}).values())) for name in names)
    return "; ".join(f"{name.replace('_', ' ')} {each}".strip() for name, each in said)


def _rate(what: str, right: list[bool]) -> str:
    """Return how often something is so, with its 90 % bounds."""
    from scipy.stats import binomtest

    if not right:
        return f"{what}: none tried"
    ends = binomtest(sum(right), len(right)).proportion_ci(0.9)
    return f"{what}: {sum(right)} of {len(right)}, {ends.low:.0%} to {ends.high:.0%}"


def main() -> None:
    """Make films, or diagnose those that are there."""
    parser = Parser(__file__, description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("what", choices=("make", "diagnose", "table"))
    parser.add_argument("--out", type=Path, default=Path("runs/filmed_effects"), help="folder that keeps what is done")
    parser.add_argument("--films", type=Path, default=None, help="folder of films, if not those that were made")
    parser.add_argument("--answers", type=Path, default=None, help="folder of what they hide, NAME.json with `answer`")
    parser.add_argument("--only", nargs="*", default=None, help="names of films")
    parser.add_argument("--seeds", type=count, default=3, help="films of each effect")
    parser.add_argument("--nothing", type=count, default=10, help="films that hide nothing")
    parser.add_argument("--cameras", type=int, choices=(1, 2), default=2)
    parser.add_argument("--trials", type=count, default=2, help="most trials of each split")
    parser.add_argument("--seconds", type=float, default=2.5, help="of each trial")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", default="", help="file that keeps what was found")
    given = parser.parse_args()
    if given.what == "make":
        make(given.out, cases(given.seeds, given.nothing), given.cameras, given.trials, given.seconds)
        return
    films, answers = given.films or given.out / "films", given.answers or given.out / "answers"
    stored = Path(given.json) if given.json else None
    rows = {r["name"]: r for r in json.loads(stored.read_text())["rows"]} if stored and stored.is_file() else {}
    names = given.only or sorted(file.parent.name for file in films.glob("*/rope.json"))
    for name in names if given.what == "diagnose" else ():
        done = given.out / "found" / f"{name}.json"
        if name not in rows and not done.is_file():
            save(str(done), look_at(films / name, answers, given.seed, given.out / "reports" / name))
        if done.is_file():
            rows[name] = json.loads(done.read_text())
        print(table([rows[name]]).splitlines()[2], flush=True)
        save(given.json, {"rows": [kept(rows[n]) for n in sorted(rows)]})
    print(table([rows[n] for n in sorted(rows)]))


if __name__ == "__main__":
    main()
