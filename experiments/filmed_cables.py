"""Real cables seen by virtual cameras: parameters from films of measured markers, against those from the markers.

    python experiments/filmed_cables.py RECORDING [RECORDING ...] --out runs/filmed_cables

RECORDING is a folder with markers as `torchdlo import-deform` writes it. The cable is drawn through its measured
markers by `torchdlo film` (noise, blur, a camera that is written down wrongly) and calibrated from the films of a few
train trials alone, with the grippers' markers; the same trials are calibrated from their markers. Both models are
judged by the markers of the test trials, each from the start that its first tenth of a second shows. What is done is
kept in --out, so that the script can be stopped and started again.
"""

from __future__ import annotations

import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from options import Parser, count, save

from torchdlo.files import write_atomically
from torchdlo.sysid.calibration.calibrate import calibrate
from torchdlo.sysid.estimation.evaluation import predict
from torchdlo.sysid.estimation.result import model_json
from torchdlo.sysid.model import model_file
from torchdlo.sysid.recordings.metrics import average, mean_absolute_error
from torchdlo.sysid.recordings.recording import Recording, load_recording, save_recording
from torchdlo.sysid.video.filming import film_recording
from torchdlo.vision.camera import Camera, looking_at
from torchdlo.vision.film import FilmLook


def shortened(recording: Recording, trials: int, seconds: float) -> Recording:
    """Return the recording with a few train trials, evenly picked, and the beginning of each."""
    picked = np.linspace(0, len(recording.train) - 1, min(trials, len(recording.train))).round().astype(int)
    cut = []
    for k in picked:
        trial = recording.train[k]
        frames = int(np.searchsorted(trial.time, seconds + 1e-9))
        names = ("time", "markers", "suspect", "gripper_quaternion")
        cut.append(replace(trial, **{n: getattr(trial, n)[:frames] for n in names if getattr(trial, n) is not None}))
    return replace(recording, train=tuple(cut))


def cameras_of(recording: Recording, number: int) -> list[Camera]:
    """Return cameras that see all of the motion, from the sides on which it is widest."""
    points = np.concatenate([t.markers.reshape(-1, 3) for t in recording.trials("all")])
    points = points[np.isfinite(points).all(1)]
    middle, size = 0.5 * (points.max(0) + points.min(0)), np.ptp(points, axis=0)
    away = 650.0 / 240.0 * 0.62 * float(max(size[2], 0.75 * max(size[0], size[1]))) + 0.5 * float(min(size[:2]))
    sides = [np.array([0.0, -1.0, 0.25]), np.array([1.0, -0.2, 0.25])]
    if size[1] > size[0]:
        sides = [np.array([1.0, 0.0, 0.25]), np.array([0.2, -1.0, 0.25])]
    return [
        looking_at("ab"[k], (middle + away * sides[k]).tolist(), middle.tolist(), focal=650.0, fps=30.0)
        for k in range(number)
    ]


def judged(recording: Recording, path: Path) -> dict[str, Any]:
    """Return the errors of a model at the markers of the test trials [mm]."""
    given = model_file.load(path)
    model = given.model(recording)
    found = predict(model, recording.test, given.start(model))
    errors = {t.name: 1e3 * mean_absolute_error(found[t.name], t) for t in recording.test}
    mean = 1e3 * average(mean_absolute_error, [found[t.name] for t in recording.test], recording.test)
    return {"test_mae_mm": mean, "by_trial": errors}


def one(path: Path, out: Path, options: Any) -> dict[str, Any]:
    """Return what films and markers of a recording say; what is there already is not done again."""
    recording = load_recording(path)
    few = shortened(recording, options.trials, options.seconds)
    tests = replace(recording, test=recording.test[: options.tests])
    row: dict[str, Any] = {"recording": path.name}
    for kind in ("markers", "films"):
        done = out / f"{kind}.json"
        if not done.is_file():
            begun = time.process_time()
            if kind == "films":
                folder = out / "filmed"
                if not folder.is_dir():
                    source = out / "source"
                    if not source.is_dir():
                        save_recording(replace(few, test=few.test[:1]), source)
                    look = FilmLook(noise=4.0, seed=options.seed)
                    made = cameras_of(few, options.cameras)
                    radius = few.radius or options.radius
                    film_recording(
                        load_recording(source), made, folder, look, radius=radius, off=1.0, seconds=options.seconds
                    )
                fitted = calibrate(load_recording(folder), seed=options.seed, vertices=options.vertices)
            else:
                fitted = calibrate(few, seed=options.seed, vertices=options.vertices, rest=options.rest)
            used = time.process_time() - begun
            write_atomically(out / f"{kind}_model.json", model_json(fitted))
            result = {"parameters": fitted.parameters, "notes": fitted.notes, "cpu_s": used}
            save(str(done), result | judged(tests, out / f"{kind}_model.json"))
        row[kind] = json.loads(done.read_text())
    row["ratio"] = row["films"]["test_mae_mm"] / row["markers"]["test_mae_mm"]
    return row


def main() -> None:
    """Run what is left."""
    parser = Parser(__file__, description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("recordings", nargs="+", type=Path)
    parser.add_argument("--out", type=Path, default=Path("runs/filmed_cables"))
    parser.add_argument("--trials", type=count, default=4, help="train trials")
    parser.add_argument("--seconds", type=float, default=2.0, help="of each that are used")
    parser.add_argument("--tests", type=count, default=100, help="most test trials")
    parser.add_argument("--cameras", type=int, choices=(1, 2), default=1)
    parser.add_argument("--radius", type=float, default=0.004, help="of the cable as it is drawn, if not known [m]")
    parser.add_argument("--vertices", type=count, default=None)
    parser.add_argument("--rest", choices=("auto", "straight"), default="straight", help="shape at rest, of markers")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    for path in options.recordings:
        out = options.out / path.name
        out.mkdir(parents=True, exist_ok=True)
        row = one(path, out, options)
        print(
            f"{row['recording']}: markers of the test trials {row['films']['test_mae_mm']:.2f} mm off with the model "
            f"from films, {row['markers']['test_mae_mm']:.2f} mm with that from markers ({row['ratio']:.2f} times)",
            flush=True,
        )


if __name__ == "__main__":
    main()
