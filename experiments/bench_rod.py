"""How fast rods are stepped and differentiated, how cost grows with vertices and memory with the horizon.

The workload is an inextensible rope of 1 m, clamped horizontally at one end, that falls and swings: radius 5 mm,
1000 kg/m^3, E = 1e6 Pa, uniform damping. A frame is 1 ms in 5 explicit substeps. Frames are counted over all scenes.
Every case runs in fresh processes with one thread each; `--workers 2` splits the scenes over two of them, which is how
two cores are used best.

    python experiments/bench_rod.py --quick
    python experiments/bench_rod.py --json rod.json --peers /path/to/python-with-pyelastica-and-mujoco
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import os
import platform
import resource
import subprocess
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path

GOALS = {  # (scenes, mode): frames/s with 60 vertices on two cores
    (1, "forward"): 1_000,
    (100, "forward"): 25_000,
    (100, "forward+backward"): 8_000,
}


@dataclass(frozen=True)
class Case:
    """One row of the table."""

    scenes: int = 100
    vertices: int = 60
    mode: str = "forward"
    dtype: str = "float32"
    compiled: bool = True
    integrator: str = "explicit"
    law: str = "bend"
    """"bend", or "frame": rest curvature and dynamic twist in material frames."""
    workers: int = 1
    seconds: float = 2.0


def build(case: Case, scenes: int):
    """Return a step function, parameters, state and control."""
    import torch

    from torchdlo import scene as sc
    from torchdlo.physics import tree
    from torchdlo.physics.effects.elastic import Bend, BendFrame, Twist
    from torchdlo.physics.effects.field import Damping, Gravity

    dtype = getattr(torch, case.dtype)
    x = torch.zeros(scenes, case.vertices, 3, dtype=dtype)
    x[..., 0] = torch.linspace(0, 1, case.vertices, dtype=dtype)
    # Stiffness falls with the square of the spacing where explicit steps ask for it.
    youngs = 1e6 * min(1.0, (59 / (case.vertices - 1)) ** 4) if case.integrator == "explicit" else 1e6
    rope = sc.Rope(x, radius=5e-3, density=1000.0, youngs=youngs, shear=youngs / 3)
    frame = case.law == "frame"
    effects = [Gravity(), *((BendFrame(), Twist()) if frame else (Bend(),)), Damping()]
    step = {"dt": 1e-3, "substeps": 5} if case.integrator == "explicit" else {"dt": 5e-3, "substeps": 1}
    twist = "quasistatic" if frame else "none"
    scene, params, state = sc.make(
        [rope], effects, held_vertices=(0, 1), integrator=case.integrator, twist=twist, **step
    )
    params = tree.map(tree.batch_innermost, params)
    return sc.stepper(scene, compiled=case.compiled), params, state, sc.hold(scene, state)


def work(case: Case, scenes: int, gate, results) -> None:
    """Measure one case in this process and put (frames, seconds, first call, peak memory) into `results`."""
    import torch

    from torchdlo import scene as sc
    from torchdlo.physics import tree

    torch.set_num_threads(1)
    step, params, state, control = build(case, scenes)
    length = 20

    def forward() -> int:
        nonlocal state
        with torch.no_grad():
            for _ in range(length):
                state = step(params, state, control)
        return length

    def both() -> int:
        bend = params.rods.material.bend.clone().requires_grad_()
        material = tree.replace(params.rods.material, bend=bend)
        learned = tree.replace(params, rods=tree.replace(params.rods, material=material))
        vel = state.rods.vel.clone().requires_grad_()
        start = tree.replace(state, rods=tree.replace(state.rods, vel=vel))
        controls = tree.map(lambda c: c.expand(length, *c.shape), control)
        last, _ = sc.rollout(step, learned, start, controls, keep=lambda s: s.time)
        last.rods.pos.square().sum().backward()
        return length

    run = forward if case.mode == "forward" else both
    begun = time.perf_counter()
    run()
    first = time.perf_counter() - begun
    run()
    gate.wait()
    begun, frames = time.perf_counter(), 0
    while time.perf_counter() - begun < case.seconds:
        frames += run() * scenes
    spent = time.perf_counter() - begun
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    results.put((frames, spent, first, peak, bool(sc.finite(state).all())))


def measure(case: Case) -> dict:
    """Run a case in fresh processes and return its row."""
    context = multiprocessing.get_context("spawn")
    workers = min(case.workers, case.scenes)
    gate, results = context.Barrier(workers), context.Queue()
    shares = [case.scenes // workers + (k < case.scenes % workers) for k in range(workers)]
    jobs = [context.Process(target=work, args=(case, share, gate, results)) for share in shares]
    for job in jobs:
        job.start()
    found = [results.get(timeout=1800) for _ in jobs]
    for job in jobs:
        job.join()
    rate = sum(frames / spent for frames, spent, *_ in found)
    substeps = 5 if case.integrator == "explicit" else 1
    return asdict(case) | {
        "workers": workers,
        "frames_per_s": rate,
        "us_per_substep": 1e6 * max(shares) * workers / rate / substeps,
        "first_call_s": max(f[2] for f in found),
        "peak_mb": sum(f[3] for f in found),
        "finite": all(f[4] for f in found),
    }


def _long(frames: int, queue) -> None:
    import torch

    from torchdlo import scene as sc
    from torchdlo.physics import tree

    torch.set_num_threads(1)
    step, params, state, control = build(Case(vertices=20, compiled=False, dtype="float64"), 4)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    vel = state.rods.vel.clone().requires_grad_()
    start = tree.replace(state, rods=tree.replace(state.rods, vel=vel))
    controls = tree.map(lambda c: c.expand(frames, *c.shape), control)
    last, _ = sc.rollout(step, params, start, controls, segment=8, nested=True, keep=lambda s: s.time)
    last.rods.pos.sum().backward()
    queue.put((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, before))


def memory() -> dict:
    """Return the peak memory of the gradient of 2 000 and of 20 000 substeps, in fresh processes."""
    context, peaks = multiprocessing.get_context("spawn"), {}
    for substeps in (2_000, 20_000):
        queue = context.Queue()
        job = context.Process(target=_long, args=(substeps // 5, queue))
        job.start()
        peaks[substeps], base = queue.get(timeout=3600)
        job.join()
    return {"peak_mb": peaks, "before_mb": base, "ratio": peaks[20_000] / peaks[2_000], "goal": 1.2}


def exponent(rows: list[dict]) -> float:
    """Return the power of the vertex count that the time per frame grows with, from 100 to 3000 vertices."""
    points = sorted((r["vertices"], r["scenes"] / r["frames_per_s"]) for r in rows if r["vertices"] in (100, 3000))
    return math.log(points[-1][1] / points[0][1]) / math.log(points[-1][0] / points[0][0])


def swing(scenes: int, dt: float, seconds: float) -> dict:
    """Time the rope that falls for 1 s with implicit steps, and its tip error against the converged reference."""
    import numpy as np
    import torch

    from torchdlo import scene as sc
    from torchdlo.physics import tree
    from torchdlo.physics.effects.elastic import Bend
    from torchdlo.physics.effects.field import Gravity

    torch.set_num_threads(1)
    data = np.load(Path(__file__).parents[1] / "tests" / "reference" / "swing.npz")
    x = torch.zeros(scenes, 60, 3, dtype=torch.float64)
    x[..., 0] = torch.linspace(0, 1, 60, dtype=torch.float64)
    h = 1 / 59
    # Held: the clamped end, and a vertex behind it for the direction of the clamp.
    rope = sc.Rope(torch.cat([x[:, :1] - torch.tensor([h, 0, 0]), x], -2), radius=5e-3, density=1000.0, youngs=1e6)
    scene, params, state = sc.make(
        [rope], [Gravity(), Bend()], dt=dt, substeps=1, integrator="implicit", held_vertices=(0, 1)
    )
    # The clamp's hinge has only the free half of its length to bend in.
    stiff = torch.ones(61, 1, dtype=torch.float64)
    stiff[1] = 2.0
    material = tree.replace(params.rods.material, bend=params.rods.material.bend * stiff)
    params = tree.map(tree.batch_innermost, tree.replace(params, rods=tree.replace(params.rods, material=material)))
    step, control = sc.stepper(scene), sc.hold(scene, state)

    def fall() -> list:
        s, tips = state, []
        with torch.no_grad():
            for k in range(round(1 / dt)):
                s = step(params, s, control)
                if (k + 1) % round(0.05 / dt) == 0:
                    tips.append(s.rods.pos[0, -1])
        return tips

    tips = torch.stack(fall()).numpy()
    target = data["converged"][1:, -1]
    axis = [0, int(np.argmax(np.ptp(target[:, 1:], axis=0))) + 1]
    error = np.linalg.norm(tips[:, [0, 2]] - target[:, axis], axis=-1)
    begun, runs = time.process_time(), 0
    while time.process_time() - begun < seconds:
        fall()
        runs += 1
    speed = runs * scenes / (time.process_time() - begun)
    return {"name": "torchdlo", "scenes": scenes, "dt": dt, "tip_error_mm": 1e3 * float(error[-1]),
            "mean_tip_error_mm": 1e3 * float(error.mean()), "simulated_s_per_cpu_s": speed}  # fmt: skip


def peers(interpreter: str, quick: bool) -> dict:
    """Run `peers.py` with an interpreter that has them, and our rope beside it."""
    target = Path(os.environ.get("TMPDIR", "/tmp")) / f"peers-{os.getpid()}.json"
    script = Path(__file__).with_name("peers.py")
    subprocess.run([interpreter, str(script), "--json", str(target)] + (["--smoke"] if quick else []), check=True)
    theirs = json.loads(target.read_text())
    target.unlink()
    ours = []
    for scenes in (1, 100):
        for dt in (2e-3, 5e-3, 1e-2):
            code = f"import json, bench_rod; print(json.dumps(bench_rod.swing({scenes}, {dt}, 3.0)))"
            done = subprocess.run(
                [sys.executable, "-c", code], cwd=script.parent, capture_output=True, text=True, check=True
            )
            ours.append(json.loads(done.stdout.splitlines()[-1]))
    return {"ours": ours, "theirs": theirs}


def cases(quick: bool, workers: int) -> list[Case]:
    """Return the rows to measure."""
    both = ("forward", "forward+backward")
    if quick:
        rows = [Case(scenes=100, mode=mode, workers=workers, seconds=1.5) for mode in both]
        return [*rows, Case(scenes=1, seconds=1.0), Case(compiled=False, seconds=1.0)]
    rows = [
        Case(scenes=s, mode=m, dtype=d, compiled=c, workers=workers if s > 1 else 1)
        for d in ("float32", "float64")
        for c in (False, True)
        for s in (1, 10, 100, 1000)
        for m in both
    ]
    rows += [Case(scenes=1, vertices=v, dtype="float64") for v in (30, 100, 300, 1000, 3000)]
    rows += [Case(scenes=s, integrator="implicit", dtype="float64", mode=m) for s in (1, 100) for m in both]
    return [*rows, Case(law="frame", mode="forward"), Case(law="frame", mode="forward+backward")]


def show(rows: list[dict]) -> None:
    """Print the table."""
    from rich.console import Console
    from rich.table import Table

    table = Table(title="frames per second, all scenes together")
    for name in ("scenes", "vertices", "mode", "dtype", "steps", "workers", "frames/s", "us/substep", "first call s",
                 "peak MB", "goal"):  # fmt: skip
        table.add_column(name, justify="left" if name in ("mode", "dtype", "steps") else "right")
    for r in rows:
        goal = GOALS.get((r["scenes"], r["mode"])) if r["vertices"] == 60 and r["integrator"] == "explicit" else None
        if not (r["compiled"] and r["dtype"] == "float32" and r["law"] == "bend"):
            goal = None
        met = "" if goal is None else f"{goal:,} {'met' if r['frames_per_s'] >= goal else 'MISSED'}"
        steps = f"{r['integrator']}, {r['law']}, {'compiled' if r['compiled'] else 'eager'}"
        table.add_row(str(r["scenes"]), str(r["vertices"]), r["mode"], r["dtype"], steps, str(r["workers"]),
                      f"{r['frames_per_s']:,.0f}", f"{r['us_per_substep']:,.0f}", f"{r['first_call_s']:.1f}",
                      f"{r['peak_mb']:,.0f}", met)  # fmt: skip
    Console(width=150).print(table)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="the rows with goals only, about a minute")
    parser.add_argument("--smoke", action="store_true", help="one tiny eager row: does the script run?")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write rows and machine to FILE")
    parser.add_argument("--workers", type=int, default=2, help="processes that share the scenes (default 2)")
    parser.add_argument(
        "--memory", action="store_true", help="also the memory of gradients over 2 000 and 20 000 substeps"
    )
    parser.add_argument(
        "--peers", nargs="?", const=sys.executable, metavar="PYTHON", help="compare with PyElastica and MuJoCo"
    )
    options = parser.parse_args()
    smoke = [Case(scenes=2, vertices=6, compiled=False, seconds=0.1)]
    result = {"machine": platform.processor() or platform.machine(), "cores": os.cpu_count(), "rows": []}
    for case in smoke if options.smoke else cases(options.quick, options.workers):
        result["rows"].append(measure(case))
    show(result["rows"])
    if any(r["vertices"] == 3000 for r in result["rows"]):
        single = [r for r in result["rows"] if r["scenes"] == 1 and r["dtype"] == "float64" and r["mode"] == "forward"]
        result["exponent"] = exponent([r for r in single if r["compiled"] and r["integrator"] == "explicit"])
        print(f"cost against vertex count, 100 to 3000: exponent {result['exponent']:.2f} (goal 1.1)")
    if options.memory:
        result["memory"] = memory()
        print(f"memory of the gradient, 20 000 over 2 000 substeps: {result['memory']['ratio']:.2f} (goal 1.2)")
    if options.peers:
        result["peers"] = peers(options.peers, options.quick)
        for row in result["peers"]["ours"]:
            print(row)
    if options.json:
        scratch = options.json.with_suffix(".tmp")
        scratch.write_text(json.dumps(result, indent=1))
        os.replace(scratch, options.json)


if __name__ == "__main__":
    main()
