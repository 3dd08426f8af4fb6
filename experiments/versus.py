"""Simulated seconds per CPU second of torchdlo and its peers at equal error on the falling rope without damping.

The rope and the peers' runs are those of `experiments/peers.py`; torchdlo takes implicit steps. Its cost per step
does not depend on the step, so that one timing serves the whole curve of error against step. Long steps
stretch edges that should not stretch, so speeds are compared at equal error alone, and where no such edge is more than
a twentieth too long as well.
"""

from __future__ import annotations

import itertools
import json
import math
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).resolve().parent
COUNTS = (400, 200, 160, 120, 100, 80, 60, 40)
"""Steps per second, multiples of 20."""
STRAINS = (math.inf, 0.05)
"""Largest strains of inextensible edges at which speeds are compared."""
BOUNDS = (0.005, 0.01, 0.015, 0.02, 0.03, 0.04)
"""Errors at which speeds are compared [m]."""
ERRORS = ("tip_error_m", "mean_tip_error_m")
"""Error of the tip after 1 s, and its mean over 20 times up to then."""
CLAMPS = {"as held": (0.0, 59.0, 1.0), "exact": (0.5, 58.5, 1.0), "exact, stiff hinge": (1.0, 58.0, 2.0)}
"""Edges behind the origin, edges per length, and stiffness of the hinge at the clamp over that of the others.

Holding vertices 0 and 1 starts curvature in the middle of their edge; with a hinge that stands for half its length
only, at vertex 1."""


def tips(count: int, clamp: tuple[float, float, float]) -> tuple[np.ndarray, float]:
    """Positions of the tip at 20 times up to 1 s [m], shape (20, 3), and the largest strain of an edge."""
    import torch

    from torchdlo import scene
    from torchdlo.physics import tree
    from torchdlo.physics.effects import EFFECTS

    behind, per_length, stiff = clamp
    x = torch.zeros(60, 3)
    x[:, 0] = (torch.arange(60) - behind) / per_length
    rope = scene.Rope(x, radius=0.005, density=1000.0, youngs=1e6)
    effects = [EFFECTS[name]() for name in ("bend", "gravity")]
    choice, params, state = scene.make(
        [rope],
        effects,
        dt=1 / count,
        substeps=1,
        integrator="implicit",
        implicit_weight=0.3,
        prescribed_vertices=(0, 1),
    )
    scaled = torch.ones(60, 1)
    scaled[1] = stiff
    rods = params.rods
    material = tree.replace(rods.material, bend=rods.material.bend * scaled)
    params = tree.replace(params, rods=tree.replace(rods, material=material))
    control, found, strain = scene.stationary_control(choice, state), [], 0.0
    with torch.no_grad():
        for k in range(count):
            state = scene.step(choice, params, state, control)
            if (k + 1) % (count // 20) == 0:
                found.append(state.rods.pos[-1].numpy().copy())
                length = state.rods.pos.diff(dim=0).norm(dim=-1)
                strain = max(strain, float((length * per_length - 1).abs().max()))
    return np.stack(found), strain


def curve(target: np.ndarray, cost: dict[int, float]) -> list[dict[str, Any]]:
    """Errors and speeds of torchdlo by clamp and step."""
    rows = []
    for name, clamp in CLAMPS.items():
        for count in COUNTS:
            path, strain = tips(count, clamp)
            gap = np.linalg.norm(path - target, axis=-1)
            row = {"clamp": name, "dt": 1 / count, "tip_error_m": float(gap[-1]), "mean_tip_error_m": float(gap.mean())}
            row |= {"strain": strain} | {f"speed_{n}": 1 / count / seconds for n, seconds in cost.items()}
            print("  ", {k: f"{v:.3g}" if isinstance(v, float) else v for k, v in row.items()}, flush=True)
            rows.append(row)
    return rows


def peer_rows(results: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Errors and speeds of the peers; with many scenes, one scene's speed times the gain measured at one step."""
    gains: dict[tuple[str, str], float] = {}
    for entry in results:
        chosen = entry["chosen"]
        if "many_per_cpu_s" in chosen:
            many = max(chosen["many_per_cpu_s"], chosen["many_workers_per_cpu_s"])
            gains[entry["peer"], entry["method"]] = max(1.0, many / chosen["one_per_cpu_s"])
    rows = []
    for entry in results:
        for row in entry["curve"]:
            if row["stable"]:
                speed = row["one_per_cpu_s"]
                names = {"peer": entry["peer"], "method": entry["method"], "exact_clamp": entry["exact_clamp"]}
                gain = gains[entry["peer"], entry["method"]]
                rows.append(
                    {
                        **names,
                        **{k: row[k] for k in ("dt", "strain", *ERRORS)},
                        "speed_1": speed,
                        "speed_100": speed * gain,
                    }
                )
    return rows


def fastest(rows: list[dict[str, Any]], speed: str, error: str, bound: float, strain: float) -> float | None:
    """Greatest speed within bounds on an error and on the strain, None if nothing keeps them."""
    return max((row[speed] for row in rows if row[error] <= bound and row["strain"] <= strain), default=None)


def run_peers(python: str) -> list[dict[str, Any]] | None:
    """Results of a fresh run of the peers, None where they are not installed."""
    if subprocess.run([python, "-c", "import elastica, mujoco"], capture_output=True).returncode:
        print(f"{python} has no pyelastica and mujoco: install the extra `peers`, or name an interpreter with --peers")
        return None
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "peers.json"
        subprocess.run([python, str(HERE / "peers.py"), "--json", str(out)], check=True)
        return json.loads(out.read_text())["results"]


def compare(python: str, reused: str, cost: Callable[[int], float]) -> dict[str, Any]:
    """Return curves of everybody, and the ratios at equal error.

    Args:
        python: interpreter with the peers.
        reused: results of an earlier run of peers.py; "" for a new one.
        cost: CPU seconds of one step, of the number of scenes.
    """
    results = json.loads(Path(reused).read_text())["results"] if reused else run_peers(python)
    if results is None:
        return {}
    with np.load(HERE.parent / "tests" / "reference" / "swing.npz", allow_pickle=False) as file:
        target = file["converged"][1:, -1].astype(float)
    # cost(n) is of n scenes at once.
    ours = curve(target, {1: cost(1), 100: cost(100) / 100})
    peers, compared = peer_rows(results), []
    for error, strain, bound in itertools.product(ERRORS, STRAINS, BOUNDS):
        limits = error, bound, strain
        entry: dict[str, Any] = {"error": error, "bound_m": bound, "strain": None if math.isinf(strain) else strain}
        for scenes in (1, 100):
            speed = f"speed_{scenes}"
            entry[f"torchdlo_{scenes}"] = mine = fastest(ours, speed, *limits)
            for peer in ("pyelastica", "mujoco"):
                entry[f"{peer}_{scenes}"] = fastest([r for r in peers if r["peer"] == peer], speed, *limits)
            best = max(entry[f"{p}_{scenes}"] or 0.0 for p in ("pyelastica", "mujoco"))
            entry[f"ratio_{scenes}"] = mine / best if mine and best else None
        compared.append(entry)
    return {"torchdlo": ours, "peers": peers, "compared": compared}
