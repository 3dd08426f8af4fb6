"""Photographs of hanging wires, calibrated and diagnosed: https://github.com/qj25/adapteddlo_muj, arXiv:2310.00911.

The folder holds `hanging_wires.npz` (traced centre lines, weights and the authors' fits) and the photographs black0.jpg,
red0.jpg and white0.jpg, 1000 x 1333 pixels. A wire of 1.5 m hangs in a loop between two level clamps 0.12 m apart. Its
camera is made from the tracings, which are known in pixels and in metres; it is taken to look level at the wires from
afar.

    python experiments/hanging_wires.py FOLDER --out runs/wires
"""

from __future__ import annotations

import argparse
import json
import shutil
import time
from pathlib import Path

import numpy as np

from torchdlo.errors import InputError
from torchdlo.sysid.calibration.calibrate import calibrate
from torchdlo.sysid.diagnosis.effect_search import diagnose
from torchdlo.sysid.diagnosis.findings import findings
from torchdlo.sysid.recordings.recording import load_recording
from torchdlo.vision.camera import Camera, save_cameras

WIRES = {"black": 0.0025, "red": 0.0025, "white": 0.0025}
"""Names, and radii as they appear [m]."""
RANGES = {
    "black": {"value": [0.0, 0.42]},
    "red": {"hue": [330.0, 25.0], "saturation": [0.45, 1.0], "value": [0.15, 1.0]},
}
"""Colours, as `torchdlo segment` writes them; the white one only has its colour in rope.json."""
CLAMPS = [[0.40, 0.03, 0.63, 0.16], [0.325, 0.16, 0.52, 0.33]]
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
    np.savez(
        out / "train_0.npz", time=[0.0], markers=held[None], marker_arclength=arclength, gripped=np.ones(4, bool)
    )
    shutil.copy(folder / f"{name}0.jpg", out / "train_0.a.jpg")
