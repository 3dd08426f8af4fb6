"""Kill long commands at random moments, resume them, and compare with runs that nobody disturbed.

A run is killed by SIGKILL, with all its processes, up to three times: each time at a moment drawn evenly from the time
that an undisturbed run works, which begins when it has the lock of its folder. Then it goes on to its end. What it
wrote has to be equal to the last bit, but for the time that it took. Commands are the real ones; the recording is a
part of the sample, and the task a short rope, so that starting Python takes the most time.

    python experiments/kill_matrix.py --out runs/kill_matrix
    python experiments/kill_matrix.py --commands calibrate,train --kills 5 --out runs/kill_matrix
"""

from __future__ import annotations

import contextlib
import csv
import hashlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from options import Parser, count, save

ROOT = Path(__file__).resolve().parents[1]
SAMPLE = ROOT / "torchdlo" / "data" / "sample_rope"
TRIALS, FRAMES = ("train_0", "train_1", "test_0"), 60
"""What is taken of the sample."""
FILMED = 0.25
"""Length of films [s]."""
KEPT_EFFECTS = ("air_drag",)
"""What a diagnosis looks for."""
TIMES = {"seconds", "cpu_seconds", "sha256"}
"""What may differ: how long it took, and hashes of content that says so."""
CHAIN = 3
"""Kills of one run at most."""


def recording(folder: Path) -> str:
    """Write the recording that is identified."""
    import numpy as np

    folder.mkdir(parents=True, exist_ok=True)
    shutil.copy(SAMPLE / "rope.json", folder)
    for name in TRIALS:
        with np.load(SAMPLE / f"{name}.npz") as whole:
            frames = len(whole["time"])
            np.savez(folder / f"{name}.npz", **{k: x[:FRAMES] if len(x) == frames else x for k, x in whole.items()})
    return str(folder)


def films(rope: str, folder: Path) -> str:
    """Write a recording with films of another one."""
    from torchdlo.sysid.recordings.recording import load_recording
    from torchdlo.sysid.video.filming import film_recording
    from torchdlo.vision.camera import looking_at
    from torchdlo.vision.film import FilmLook

    if not folder.is_dir():
        camera = looking_at("a", [0.15, -1.35, 1.0], [0.0, 0.0, 0.88], focal=650.0)
        film_recording(load_recording(rope), [camera], folder, FilmLook(), trials=1, seconds=FILMED)
    return str(folder)


def commands(rope: str, filmed: str) -> dict[str, tuple[str, ...]]:
    """Return the smallest real settings of every command."""
    from torchdlo.sysid.diagnosis.effect_library import library

    excluded = [word for name in library() if name not in KEPT_EFFECTS for word in ("--exclude-effect", name)]
    return {
        "calibrate": ("calibrate", rope, "--starts", "3", "--iterations", "3", "--vertices", "9", "--rest", "straight"),
        "calibrate_films": ("calibrate", filmed, "--starts", "3", "--iterations", "2", "--vertices", "9"),
        "diagnose": ("diagnose", rope, "--workers", "1", "--vertices", "9", *excluded),
        "optimize": (
            "optimize",
            "short",
            "--method",
            "cmaes",
            "--episodes",
            "96",
            "--population",
            "8",
            "--execution",
            "recorded",
        ),
        "train": ("train", "short", "--algo", "ppo", "--episodes", "64", "--count", "4", "--set", "interval=0"),
        "dataset": ("dataset", "make", "short", *"--episodes 12 --batch 2 --size 0 --workers 0".split()),
    }


def play() -> None:
    """Run the command line with the task of a short rope."""
    from torchdlo import envs
    from torchdlo.cli.app import main as run

    envs.TASKS["short"] = short_task()
    run(sys.argv[1:])


def short_task() -> Any:
    """Return a task of a few milliseconds: lead the first end of a short rope to the left of a place."""
    from torchdlo.envs.core.task import RADIUS, Arms, Task, make, straight
    from torchdlo.scene import Rope

    @dataclass(frozen=True)
    class Short(Task):
        horizon: int = 4
        frame_skip: int = 1
        name: ClassVar[str] = "short"
        arms: ClassVar[Any] = Arms(base=((-0.2, -0.45, 0.0),), vertex=(1,))
        reset_noise: ClassVar[Any] = ((0.02, 0.01),)

        def build(self, moved: Any) -> Any:
            rope = Rope(straight((0.0, 0.1, 0.05), 6, moved[:, 0]), RADIUS, mass=0.006, youngs=1e4)
            return make(self, [rope])

        def rewards(self, seen: Any) -> dict[str, Any]:
            return {"left": seen.x[:, 1, 1] - 0.1}

        def success(self, seen: Any) -> Any:
            return seen.x[:, 1, 1] > 0.137

        def waypoints(self) -> list[list[tuple[float, float, float]]]:
            return [[(0.0, 0.04, 0.0)]]

    return Short


def started(words: tuple[str, ...], folder: Path, resume: bool) -> subprocess.Popen[bytes]:
    """Start a command as the leader of a process group."""
    begin = [sys.executable, "-c", "import kill_matrix; kill_matrix.play()"]
    command = [*begin, *words, "--out", str(folder), *(["--resume"] if resume else [])]
    places = [str(ROOT), str(ROOT / "experiments"), os.environ.get("PYTHONPATH", "")]
    paths = os.pathsep.join(filter(None, places))
    env = os.environ | {"PYTHONPATH": paths, "OMP_NUM_THREADS": "1"}
    pipes = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
    return subprocess.Popen(command, env=env, start_new_session=True, **pipes)


def ended(words: tuple[str, ...], folder: Path, resume: bool) -> tuple[int, str]:
    """Run a command to its end; a run that was killed before it wrote anything begins anew."""
    process = started(words, folder, resume)
    _, said = process.communicate()
    text = said.decode(errors="replace").strip()
    if resume and process.returncode == 2 and nothing(text):
        return ended(words, folder, False)
    return process.returncode, text.splitlines()[-1] if text else ""


def waited(process: subprocess.Popen[bytes], folder: Path) -> bool:
    """Wait until a command has begun to work; return whether it does."""
    while process.poll() is None:
        if any(folder.rglob(".torchdlo.lock")):
            return True
        time.sleep(0.01)
    return False


def killed(words: tuple[str, ...], folder: Path, resume: bool, after: float) -> bool:
    """Start a command and kill it some seconds after it began to work; return whether it was still at that."""
    for lock in folder.rglob(".torchdlo.lock"):  # of the one that was killed
        lock.unlink()
    process = started(words, folder, resume)
    if waited(process, folder):
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(after)
    still = process.poll() is None
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    _, said = process.communicate()
    if resume and process.returncode == 2 and nothing(said.decode(errors="replace")):
        return killed(words, folder, False, after)
    return still


def nothing(said: str) -> bool:
    """Return whether a command says that there is nothing to go on from."""
    return "found none" in said or "no checkpoint" in said


def signature(folder: Path) -> dict[str, str]:
    """Return hashes of what a run wrote, without times; reports show them."""
    return {
        str(file.relative_to(folder)): hashlib.sha256(plain(file).encode()).hexdigest()[:16]
        for file in sorted(folder.rglob("*"))
        if file.is_file() and file.suffix not in (".html", ".png") and "tensorboard" not in file.parts
    }


def plain(file: Path) -> str:
    """Return what counts of a file."""
    if file.suffix == ".json" and file.name != "checkpoint.json":
        return json.dumps(timeless(json.loads(file.read_text())), sort_keys=True)
    if file.suffix == ".csv":
        rows = list(csv.DictReader(file.read_text().splitlines()))
        return json.dumps([{k: v for k, v in row.items() if k not in TIMES} for row in rows])
    if file.name == "policy.pt":
        import torch

        return json.dumps(timeless(torch.load(file, weights_only=True)), sort_keys=True)
    if file.name in ("checkpoint.pt", "checkpoint.json"):
        return ""  # how far it is says how long it took
    return hashlib.sha256(file.read_bytes()).hexdigest()


def timeless(value: Any) -> Any:
    """Return plain data without times."""
    if hasattr(value, "tolist"):
        return [str(value.dtype), value.tolist()]
    if isinstance(value, dict):
        return {str(k): timeless(v) for k, v in value.items() if k not in TIMES}
    if isinstance(value, (list, tuple)):
        return [timeless(v) for v in value]
    if isinstance(value, str) and value.startswith("{"):
        return timeless(json.loads(value))
    return value


def matrix(name: str, words: tuple[str, ...], kills: int, folder: Path, rng: random.Random) -> dict[str, Any]:
    """Return how runs of a command that were killed came out."""
    shutil.rmtree(folder, ignore_errors=True)
    process = started(words, folder / "whole", False)
    works, begun = waited(process, folder / "whole"), time.monotonic()
    _, said = process.communicate()
    whole, code, text = time.monotonic() - begun, process.returncode, said.decode(errors="replace").strip()[-500:]
    if code or not works:
        return {"seconds": round(whole, 1), "failed": text}
    right = signature(folder / "whole")
    found: dict[str, Any] = {"seconds": round(whole, 1), "kills": 0, "runs": 0, "equal": 0, "other": []}
    while found["kills"] < kills:
        run, moments = folder / f"run_{found['runs']}", []
        for k in range(min(CHAIN, kills - found["kills"])):
            moment = rng.uniform(0.0, whole)
            if not killed(words, run, k > 0, moment):
                break
            moments.append(round(moment, 1))
        if not moments:  # it was at its end before the moment came
            shutil.rmtree(run, ignore_errors=True)
            continue
        code, text = ended(words, run, True)
        found["kills"] += len(moments)
        found["runs"] += 1
        left = [str(f.relative_to(run)) for f in run.rglob(".*")]
        now = signature(run) if not code else {}
        if now == right and not left:
            found["equal"] += 1
            shutil.rmtree(run)
        else:
            differ = sorted(k for k in {*right, *now} if right.get(k) != now.get(k))
            found["other"].append({"moments": moments, "code": code, "said": text, "differ": differ, "left": left})
        print(f"{name}: {found['kills']} kills, {found['equal']} of {found['runs']} runs equal", flush=True)
    return found


def main() -> None:
    """Run the matrix and save it."""
    parser = Parser(__file__, description=__doc__)
    parser.add_argument("--commands", default="", help="some of them, with commas; all if not given")
    parser.add_argument("--kills", type=count, default=20, help="of each command")
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    parser.add_argument("--out", default="runs/kill_matrix", help="folder for the runs and kill_matrix.json")
    given = parser.parse_args()
    rope = recording(Path(given.out).resolve() / "rope")
    known = commands(rope, films(rope, Path(given.out).resolve() / "films"))
    names = given.commands.split(",") if given.commands else list(known)
    if wrong := [name for name in names if name not in known]:
        parser.error(f"{', '.join(wrong)}: expected some of {', '.join(known)}")
    rows: dict[str, Any] = {}
    for name in names:
        rng = random.Random(f"{given.seed} {name}")
        rows[name] = matrix(name, known[name], given.kills, Path(given.out) / name, rng)
        save(str(Path(given.out) / "kill_matrix.json"), {"kills": given.kills, "seed": given.seed, "commands": rows})
    if any(row.get("equal") != row.get("runs") or "failed" in row for row in rows.values()):
        raise SystemExit(1)


if __name__ == "__main__":
    main()
