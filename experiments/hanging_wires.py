"""Photographs of hanging wires, calibrated and diagnosed (github.com/qj25/adapteddlo_muj, arXiv:2310.00911).

The folder holds `hanging_wires.npz` (traced centre lines, weights and the authors' fits) and the photographs
black0.jpg, red0.jpg and white0.jpg, 1000 x 1333 pixels. A wire of 1.5 m hangs in a loop between two level clamps
0.12 m apart. Its camera is made from the tracings, which are known in pixels and in metres; it is taken to look level
at the wires from afar.

    python experiments/hanging_wires.py FOLDER --out runs/wires
"""

from __future__ import annotations

import argparse
import json
import shutil
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchdlo.errors import InputError
from torchdlo.report.pages import diagnosis as report
from torchdlo.sysid.calibration.calibrate import calibrate
from torchdlo.sysid.diagnosis.effect_search import diagnose
from torchdlo.sysid.diagnosis.findings import findings
from torchdlo.sysid.recordings.recording import load_recording
from torchdlo.sysid.video.footage import masks_of
from torchdlo.vision.camera import Camera, save_cameras
from torchdlo.vision.spine import curve_vectors, thin

WIRES = {"black": 0.0025, "red": 0.0025, "white": 0.0025}
"""Names, and radii as they appear [m]."""
RANGES = {
    "black": {"value": [0.0, 0.42]},
    "red": {"hue": [330.0, 25.0], "saturation": [0.45, 1.0], "value": [0.15, 1.0]},
}
"""Colours, as `torchdlo segment` writes them; the white one only has its colour in rope.json."""
CLAMPS = [[0.40, 0.03, 0.63, 0.18], [0.325, 0.16, 0.52, 0.33]]
"""Rectangles of the photographs that show clamps and what hangs behind them, as shares."""
SCALE, AWAY, HELD = 1 / 3, 3.0, 0.02
"""Pixels of the photographs over those of the tracings, distance of the camera [m], and length in each clamp [m]."""


def write_recording(folder: Path, name: str, out: Path) -> None:
    """Write the photograph of a wire as a recording of a rope at rest."""
    out.mkdir(parents=True)
    with np.load(folder / "hanging_wires.npz") as data:
        metres, pixels = (data[f"{name}_centreline_{unit}"][0].astype(float) for unit in ("m", "px"))
        line = float(data[f"{name}_mass_per_length"])
        length = float(data["wire_length"])
    per_metre = SCALE * float(np.linalg.norm(np.diff(pixels, axis=0), axis=1).sum())
    per_metre /= float(np.linalg.norm(np.diff(metres, axis=0), axis=1).sum())
    first, last = ([x, 0.0, -y] for x, y in (metres[0], metres[-1]))
    held = np.array([[first[0] - HELD, *first[1:]], first, last, [last[0] + HELD, *last[1:]]])
    arclength = np.array([0.0, HELD, HELD + length, 2 * HELD + length])
    origin = SCALE * (pixels[0] + 0.5) - 0.5 - per_metre * metres[0]
    rows = ((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0))
    focal = per_metre * AWAY
    camera = Camera("a", 1000, 1333, focal, focal, origin[0], origin[1], rows, (0.0, 0.0, AWAY), fps=30.0)
    save_cameras([camera], out / "cameras.json")
    rope = {"length": length + 2 * HELD, "radius": WIRES[name], "mass": line * (length + 2 * HELD)}
    rope |= {"gravity": [0, 0, -9.81], "table_height": None, "marker_noise_std": None}
    if name in RANGES:
        (out / "segment.json").write_text(json.dumps(RANGES[name] | {"ignore": CLAMPS}))
    else:
        rope["color"] = [235, 235, 230]
    (out / "rope.json").write_text(json.dumps(rope))
    np.savez(out / "train_0.npz", time=[0.0], markers=held[None], marker_arclength=arclength, gripped=np.ones(4, bool))
    shutil.copy(folder / f"{name}0.jpg", out / "train_0.a.jpg")


def distances(path: Path, places: np.ndarray, metres: float) -> float:
    """Return the mean distance [m] of a simulated rope in the picture (M, 2) [px] from the mask's centre line.

    Args:
        path: of a recording.
        places: of the rope in its photograph, without what clamps hold [px].
        metres: of a pixel [m].
    """
    recording = load_recording(path)
    mask = masks_of(recording, recording.train[0].films[0])[0][0]
    line = np.stack(np.nonzero(thin(mask))[::-1], 1).astype(float)
    away = curve_vectors(torch.as_tensor(places), torch.as_tensor(line))[0]
    return metres * float(np.linalg.norm(away.numpy(), axis=-1).mean())


def measured(folder: Path, name: str, out: Path) -> dict[str, Any]:
    """Return what a wire's photograph says."""
    path, begun = out / name, time.process_time()
    if not path.exists():
        write_recording(folder, name, path)
    try:
        recording = load_recording(path)
        plain = calibrate(recording)
    except InputError as error:
        return {"refused": str(error)}
    half = time.process_time()
    found = diagnose(recording)
    report.write_report(found, recording, out / f"{name}_report")
    told = findings(found, recording)
    with np.load(folder / "hanging_wires.npz") as data:
        published = [
            float(x) for x in (data[f"{name}_bend_stiffness_adapt"].min(), data[f"{name}_bend_stiffness_adapt"].max())
        ]
    metres = AWAY / recording.train[0].films[0].camera.fx
    return {
        "published_bending_stiffness": published,
        "elastic": {
            "bending_stiffness": plain.parameters["bending_stiffness"],
            "cameras": {k: v["value"] for k, v in plain.parameters.items() if k.startswith("camera")},
            "distance_mm": 1e3 * distances(path, plain.overlays[0].after, metres),
            "left_out_mm": plain.test_mae_mm,
            "cpu_s": half - begun,
        },
        "named": {
            "verdict": told["verdict"],
            "effects": told["effects"],
            "candidates": told["candidates"],
            "bending_stiffness": told["baseline"]["bending_stiffness"],
            "cameras": {k: v["value"] for k, v in told["cameras"].items()},
            "distance_mm": 1e3 * distances(path, found.overlays[0].after, metres),
            "gap": told["gap"],
            "cpu_s": time.process_time() - half,
        },
    }


def main() -> None:
    """Measure all wires; those that are done are not done again."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="with hanging_wires.npz and the photographs")
    parser.add_argument("--out", type=Path, default=Path("runs/wires"))
    parser.add_argument("--wires", nargs="*", default=list(WIRES))
    given = parser.parse_args()
    for name in given.wires:
        file = given.out / f"{name}.json"
        if not file.exists():
            result = measured(given.folder, name, given.out)
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(json.dumps(result, indent=1))
        print(name, file.read_text())


if __name__ == "__main__":
    main()
