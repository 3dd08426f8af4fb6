"""Time ropes that touch themselves, bodies and matter, beside published figures.

Three scenes with a rope of radius 1 cm, edges of 2 cm and 1 g per vertex, heavily damped, in frames of 1 ms of 5
substeps:

- coiling: inextensible, 60 vertices, self-contact, friction; falls over a fixed cone.
- lifting: 30 vertices, E = 5e3 Pa, self-contact, friction; over two free open rings on a plane.
- gathering: 45 vertices on an elastoplastic ball of material points, 6.4 mm apart on a grid of 1 cm.

Published: frames per second of DLO-Lab on one L40S GPU, summed over environments, of its tasks of these names; those
have robots too, and gathering two rigid bodies more. Ours are frames per second of CPU time, summed over processes of
one thread each that start together. A cell that is below the published one is marked.

examples:
  python experiments/bench_coupled.py --quick
  python experiments/bench_coupled.py --only coiling --scenes 1,100 --json coupled.json
"""

from __future__ import annotations

import math
import os
import statistics
import sys
from dataclasses import asdict, dataclass, replace
from typing import Any

from bench_rod import BOTH, FORWARD, clocked, forward, gathered, gradient, peak_mb
from options import Parser, count, save

PUBLISHED = {
    ("coiling", FORWARD): (90.85, 873.73, 4349.98, 8566.86),
    ("coiling", BOTH): (32.49, 344.25, 1465.67, 3015.49),
    ("lifting", FORWARD): (50.03, 418.94, 1736.94, 2625.83),
    ("lifting", BOTH): (12.10, 53.37, 153.30, 245.21),
    ("gathering", FORWARD): (32.31, 175.79, 365.86, 422.92),
    ("gathering", BOTH): (8.24, 52.00, 184.28, 300.56),
}
"""Frames per second with 1, 10, 50 and 100 scenes."""
SCENES = (1, 10, 50, 100)
SCENARIOS = ("coiling", "lifting", "gathering")
ROLLOUT = 4
"""Frames of one roll-out."""


@dataclass(frozen=True)
class Case:
    """One cell of the table."""

    scenario: str
    scenes: int
    mode: str
    dtype: str = "float32"
    compiled: bool = True
    workers: int = 2
    seconds: float = 1.0
    """CPU time of one of three repeats, about [s]."""


def straight(scenes: int, vertices: int, dtype: Any, first: tuple[float, float, float]) -> Any:
    """Positions of a rope along x, moved by up to 2 cm in y from scene to scene."""
    import torch

    x = torch.zeros(scenes, vertices, 3, dtype=dtype) + torch.tensor(first, dtype=dtype)
    x[..., 0] += 0.02 * torch.arange(vertices, dtype=dtype)
    x[..., 1] += 0.02 * torch.rand(scenes, 1, generator=torch.Generator().manual_seed(0), dtype=dtype)
    return x


def build(case: Case, scenes: int) -> tuple[Any, Any, Any]:
    """Return the scene, its parameters and its initial state."""
    import torch

    from torchdlo import scene
    from torchdlo.coupling import BodyContact, RodBody, RodContact, RodMpmCoupling
    from torchdlo.coupling.mpm.constitutive_models import Plastic
    from torchdlo.coupling.mpm.particles import Grid, ParticleBlock, assemble, fill_ball
    from torchdlo.physics import tree
    from torchdlo.physics.effects.elastic import Bend
    from torchdlo.physics.effects.external import Damping, Gravity

    dtype = getattr(torch, case.dtype)
    rope = {"radius": 0.01, "density": 0.001 / (0.02 * math.pi * 0.01**2)}
    effects, numbers = [Gravity(), Bend(), Damping(), RodContact()], {"damping": {"rate": 30.0}}
    choices = {"dt": 1e-3, "substeps": 5}
    if case.scenario == "coiling":
        cone = scene.RigidBody("cone", (0.12, 0.3), (0, 0, 0.075), motion="fixed", mu_s=0.7, mu_k=0.7)
        x, more = straight(scenes, 60, dtype, (-0.6, 0.105, 0.06)), {"bodies": [cone], "prescribed_vertices": (0, 1)}
        effects, stiff = [*effects, RodBody()], 1e3
    elif case.scenario == "lifting":
        like = {"quat": (0.5, 0.5, 0.5, 0.5), "density": 120.0, "mu_s": 0.6, "mu_k": 0.6}  # upright, open to -y
        size = (0.045, 0.012, 1.5 * math.pi)
        rings = [scene.RigidBody("ring", size, (x, 0.11, 0.06), **like) for x in (0.53, 0.67)]
        bodies = [*rings, scene.RigidBody("plane", motion="fixed", mu_s=0.6, mu_k=0.6)]
        x, more = straight(scenes, 30, dtype, (0.3, 0.1, 0.06)), {"bodies": bodies, "prescribed_vertices": (4, 25)}
        effects, stiff = [*effects, RodBody(), BodyContact()], 5e3
    else:
        x = straight(scenes, 45, dtype, (-0.15, 0.02, 0.145))
        ball = fill_ball((0.25, 0.02, 0.07), 0.05, 0.0064, x)
        blob = ParticleBlock(ball.expand(scenes, *ball.shape), Plastic(), 0.0064**3)
        grid = Grid((-0.2, -0.2, 0.0), (0.8, 0.25, 0.3), 0.01, window=(20, 20, 20))
        more = {"material_points": assemble([blob], grid), "prescribed_vertices": (1, 43)}
        effects, stiff = [*effects, RodMpmCoupling(room=16)], 1e3
    made, params, state = scene.make([scene.Rope(x, youngs=stiff, **rope)], effects, numbers, **choices, **more)
    return made, tree.map(tree.batch_innermost, params) if case.scenario != "gathering" else params, state


def work(case: Case, share: int, go: Any, results: Any) -> None:
    """Time a share of a case in this process: put None when ready, wait for `go`, put what was found."""
    import torch

    from torchdlo import scene

    torch.set_num_threads(1)
    made = build(case, share)
    step = scene.stepper(made[0], execution="compiled" if case.compiled else "eager")
    run = forward if case.mode == FORWARD else gradient
    first = clocked(lambda: run(step, made, ROLLOUT))
    once = clocked(lambda: run(step, made, ROLLOUT))[0]
    rounds = max(1, round(case.seconds / max(once, 1e-3)))
    results.put(None)
    go.wait()
    times = [clocked(lambda: [run(step, made, ROLLOUT) for _ in range(rounds)]) for _ in range(3)]
    cpu, wall = (statistics.median(t) / rounds / ROLLOUT for t in zip(*times, strict=True))
    found = {"first_call_s": first[1], "first_call_cpu_s": first[0], "peak_mb": peak_mb()}
    results.put(found | {"cpu": share / cpu, "wall": share / wall})


def measure(case: Case) -> dict[str, Any]:
    """Return the row of a case, summed over its workers."""
    found = gathered(work, case)
    row = asdict(case) | {"workers": len(found), "published": None}
    if case.scenes in SCENES:
        row["published"] = PUBLISHED[case.scenario, case.mode][SCENES.index(case.scenes)]
    sums = {"frames_per_s": "cpu", "frames_per_wall_s": "wall", "peak_mb": "peak_mb"}
    row |= {name: sum(f[key] for f in found) for name, key in sums.items()}
    return row | {name: max(f[name] for f in found) for name in ("first_call_s", "first_call_cpu_s")}


def shown(row: dict[str, Any]) -> str:
    """Return a row as text."""
    goal = row["published"]
    beside = "" if goal is None else f"{goal:10.0f}  {'missed' if row['frames_per_s'] < goal else 'reached'}"
    head = f"{row['scenario']:10} {row['scenes']:6} {row['mode']:17}"
    return f"{head} {row['dtype']:8} {row['frames_per_s']:10.0f} {beside:19} first call {row['first_call_s']:.0f} s"


def chosen(text: str) -> list[str]:
    """Read scenarios, separated by commas."""
    parts = text.split(",")
    if not set(parts) <= set(SCENARIOS):
        raise ValueError(text)
    return parts


def cases(options: Any) -> list[Case]:
    """Return what is timed."""
    if options.smoke:
        tiny = [Case(s, 2, FORWARD, compiled=False, workers=1, seconds=0.01) for s in options.only]
        return [*tiny, replace(tiny[0], mode=BOTH)]
    scenes = [100] if options.quick else [int(n) for n in options.scenes.split(",")]
    only, dtypes = (["coiling"], ["float32"]) if options.quick else (options.only, options.dtypes.split(","))
    seconds = 0.5 if options.quick else 1.0
    return [
        Case(scenario, n, mode, dtype, not options.eager, options.workers, seconds)
        for scenario in only
        for dtype in dtypes
        for n in scenes
        for mode in (FORWARD, BOTH)
    ]


def main() -> None:
    """Measure, print and save; what was found so far is in the file after every case."""
    parser = Parser(__file__, description=__doc__)
    parser.flag("quick", "coiling with 100 scenes only, at most 90 s with warm caches")
    parser.flag("smoke", "two scenes in eager mode: does the script run?")
    parser.flag("eager", "do not compile")
    parser.add_argument("--json", metavar="FILE", default="", help="file that the results go to")
    parser.add_argument("--only", type=chosen, default=list(SCENARIOS), help="scenarios, separated by commas (all)")
    parser.add_argument("--scenes", default="1,10,50,100", help="numbers of scenes (%(default)s)")
    parser.add_argument("--dtypes", default="float32", help="precisions (%(default)s)")
    parser.add_argument("--workers", type=count, default=2, help="processes that share the scenes (default: 2)")
    options = parser.parse_args()
    rows: list[dict[str, Any]] = []
    print("scenario   scenes mode              dtype      frames/s  published", flush=True)
    for case in cases(options):
        rows.append(measure(case))
        print(shown(rows[-1]), flush=True)
        save(options.json, {"cores": os.cpu_count(), "rows": rows})


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    sys.exit(main())
