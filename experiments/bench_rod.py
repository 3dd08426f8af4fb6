"""Time torchdlo on a falling rope: frames per second, first calls, memory, and other simulators beside it.

The rope is inextensible, 60 vertices and 1 m long (or as many more edges of the same length), 5 mm in radius,
1000 kg/m^3, E = 1e6 Pa. Its first edge is clamped horizontally; it falls and swings under gravity with damping rate
0.5 1/s. A frame is 1 ms in 5 explicit substeps, or 5 ms in 1 implicit one; frames are counted over all scenes.

Every case runs in fresh processes of one thread each that start together. `frames_per_s` is by their CPU time, as if
nothing else used the machine; `frames_per_wall_s` is by the clock.

examples:
  python experiments/bench_rod.py --quick
  python experiments/bench_rod.py --json bench.json --peers /path/to/python-with-pyelastica-and-mujoco
  TORCHDLO_BENCH_ROD_WORKERS=1 python experiments/bench_rod.py --only memory,first
"""

from __future__ import annotations

import contextlib
import math
import multiprocessing
import os
import platform
import queue
import resource
import signal
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from options import Parser, count, save

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
FORWARD, BOTH = "forward", "forward+backward"
PARTS = ("peers", "memory", "first", "rows")
ROLLOUT, SEGMENT = 20, 10
"""Frames of a rollout with gradients, and of one replayed segment where memory is measured."""
EDGE = 1 / 59
"""Length of an edge [m]."""
GOALS = {(1, FORWARD): 1_000, (100, FORWARD): 25_000, (100, BOTH): 8_000}
"""Frames/s by scenes and mode, with 60 vertices in float32 and explicit steps, on two cores."""


@dataclass(frozen=True)
class Case:
    """One thing to time."""

    scenes: int = 100
    """Scenes of all workers together."""
    vertices: int = 60
    mode: str = FORWARD
    dtype: str = "float32"
    compiled: bool = True
    integrator: str = "explicit"
    twist: str = "none"
    """"none" with Bend; "dynamic" or "quasistatic" with BendFrame and Twist."""
    workers: int = 1
    seconds: float = 0.6
    """CPU time of one of five repeats, about [s]."""


def build(case: Case, scenes: int) -> tuple[Any, Any, Any]:
    """Return the scene, its parameters and its initial state."""
    import torch

    from torchdlo import scene
    from torchdlo.physics import tree
    from torchdlo.physics.effects import EFFECTS

    x = torch.zeros(scenes, case.vertices, 3, dtype=getattr(torch, case.dtype))
    x[..., 0] = torch.arange(case.vertices, dtype=x.dtype) * EDGE
    framed = case.twist != "none"
    rope = scene.Rope(x, radius=0.005, density=1000.0, youngs=1e6, shear=1e6 / 3)
    names = ("bend_frame", "twist", "gravity", "damping") if framed else ("bend", "gravity", "damping")
    step = {"dt": 1e-3, "substeps": 5} if case.integrator == "explicit" else {"dt": 5e-3, "substeps": 1}
    held = {"prescribed_vertices": (0, 1), "prescribed_edges": (0,) if framed else ()}
    choices = {"integrator": case.integrator, "twist": case.twist, **step, **held}
    made, params, state = scene.make([rope], [EFFECTS[name]() for name in names], {"damping": {"rate": 0.5}}, **choices)
    return made, tree.map(tree.batch_innermost, params), state


def gradient(step: Callable, made: tuple[Any, Any, Any], frames: int, **replay: Any) -> None:
    """Differentiate the final positions by bending stiffness and initial velocity."""
    import torch

    from torchdlo import scene
    from torchdlo.physics import tree

    choice, params, state = made
    rods = params.rods
    bend, vel = (x.detach().clone().requires_grad_() for x in (rods.material.bend, state.rods.vel))
    params = tree.replace(params, rods=tree.replace(rods, material=tree.replace(rods.material, bend=bend)))
    state = tree.replace(state, rods=tree.replace(state.rods, vel=vel))
    controls = tree.map(lambda c: c.expand(frames, *c.shape), scene.stationary_control(choice, made[2]))
    last, _ = scene.rollout(step, params, state, controls, keep=lambda s: s.time, **replay)
    found = torch.autograd.grad(last.rods.pos.square().sum(), [bend, vel])
    if not all(bool(torch.isfinite(g).all()) for g in found):
        raise ArithmeticError("bench_rod: a gradient is not finite")


def forward(step: Callable, made: tuple[Any, Any, Any], frames: int) -> None:
    """Run without gradients."""
    import torch

    from torchdlo import scene

    choice, params, state = made
    with torch.no_grad():
        control = scene.stationary_control(choice, state)
        for _ in range(frames):
            state = step(params, state, control)
    if not bool(scene.finite(state).all()):
        raise ArithmeticError("bench_rod: a scene is not finite")


def clocked(work: Callable[[], None]) -> tuple[float, float]:
    """CPU and elapsed seconds of a call."""
    cpu, wall = time.process_time(), time.perf_counter()
    work()
    return time.process_time() - cpu, time.perf_counter() - wall


def peak_mb(restart: bool = False) -> float:
    """Largest resident memory of this process so far, or since the last restart where the system can do that."""
    status = Path("/proc/self/status")
    if not status.exists():
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1e6 if sys.platform == "darwin" else 1e3)
    if restart:
        with contextlib.suppress(OSError):
            Path("/proc/self/clear_refs").write_text("5")
    line = next(line for line in status.read_text().splitlines() if line.startswith("VmHWM"))
    return int(line.split()[1]) / 1e3


def work(case: Case, share: int, go: Any, results: Any) -> None:
    """Time a share of a case in this process: put None when ready, wait for `go`, put what was found."""
    import torch

    from torchdlo import scene

    torch.set_num_threads(1)
    made = build(case, share)
    step = scene.stepper(made[0], execution="compiled" if case.compiled else "eager")
    run = forward if case.mode == FORWARD else gradient
    first = clocked(lambda: run(step, made, ROLLOUT))[1]
    once = clocked(lambda: run(step, made, ROLLOUT))[0]
    rounds = max(1, round(case.seconds / max(once, 1e-3)))
    results.put(None)
    go.wait()
    times = [clocked(lambda: [run(step, made, ROLLOUT) for _ in range(rounds)]) for _ in range(5)]
    cpu, wall = (statistics.median(t) / rounds / ROLLOUT for t in zip(*times, strict=True))
    us = 1e6 * cpu / made[0].substeps
    results.put({"first_call_s": first, "cpu": share / cpu, "wall": share / wall, "us": us, "peak_mb": peak_mb()})


def remember(frames: int, go: Any, results: Any) -> None:
    """Measure the memory of one backward pass of 10 scenes with nested replay, first calls not counted."""
    import torch

    from torchdlo import scene

    torch.set_num_threads(1)
    made = build(Case(), 10)
    step = scene.stepper(made[0])
    gradient(step, made, 2 * SEGMENT, segment=SEGMENT, nested=True)
    before = peak_mb(restart=True)
    cpu, _ = clocked(lambda: gradient(step, made, frames, segment=SEGMENT, nested=True))
    results.put({"substeps": 5 * frames, "before_mb": before, "peak_mb": peak_mb(), "cpu_s": cpu})


def receive(jobs: list[Any], results: Any) -> Any:
    """Return what a process reports next; fail if one died instead."""
    while True:
        with contextlib.suppress(queue.Empty):
            return results.get(timeout=1.0)
        if any(job.exitcode for job in jobs):
            raise RuntimeError("bench_rod: a process failed; its message is above")


def start(jobs: list[Any]) -> None:
    """Start processes that never see Ctrl-C, which is for their parent to answer, once they have what they need."""
    came: list[int] = []
    # They inherit the mask; another thread of this process may still take the signal.
    handler = signal.signal(signal.SIGINT, lambda number, _: came.append(number))
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        for job in jobs:
            job.start()
    finally:
        signal.signal(signal.SIGINT, handler)
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
    if came:
        signal.raise_signal(signal.SIGINT)


@contextlib.contextmanager
def interrupts() -> Iterator[list[int]]:
    """Yield a list that a Ctrl-C is added to as well as raised: Python drops one that arrives inside a finaliser."""
    seen: list[int] = []

    def note(number: int, _: Any) -> None:
        seen.append(number)
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGINT, note)
    try:
        yield seen
    finally:
        signal.signal(signal.SIGINT, before)


@contextlib.contextmanager
def processes(target: Callable, heads: list[tuple]) -> Iterator[tuple[list[Any], Any, Any]]:
    """Yield a process per tuple of first arguments, not yet started, with their event and queue; none outlives this."""
    context = multiprocessing.get_context("spawn")
    go, results = context.Event(), context.Queue()
    jobs = [context.Process(target=target, args=(*head, go, results), daemon=True) for head in heads]
    try:
        yield jobs, go, results
    finally:
        for job in jobs:
            if job.pid:
                job.terminate()
                job.join()


def gathered(work: Callable, case: Any) -> list[dict[str, Any]]:
    """Return what each of a case's workers measured, with its share of the scenes, all at the same time."""
    workers = min(case.workers, case.scenes)
    shares = [case.scenes // workers + (k < case.scenes % workers) for k in range(workers)]
    with processes(work, [(case, share) for share in shares]) as (jobs, go, results):
        # One compiles, the others find its work.
        for crew in (jobs[:1], jobs[1:]):
            start(crew)
            for _ in crew:
                receive(jobs, results)
        go.set()
        return [receive(jobs, results) for _ in jobs]


def measure(case: Case) -> dict[str, Any]:
    """Return the row of a case, summed over its workers."""
    found = gathered(work, case)
    row = {name: value for name, value in asdict(case).items() if name != "seconds"} | {"workers": len(found)}
    return row | {
        "frames_per_s": sum(f["cpu"] for f in found),
        "frames_per_wall_s": sum(f["wall"] for f in found),
        "us_per_substep": statistics.mean(f["us"] for f in found),
        "peak_mb": sum(f["peak_mb"] for f in found),
        "first_call_s": max(f["first_call_s"] for f in found),
    }


def cases(quick: bool, smoke: bool, workers: int) -> list[Case]:
    """Return what is timed."""
    both = (FORWARD, BOTH)
    if smoke:
        return [Case(2, 6, mode=m, compiled=False, seconds=0.01) for m in both]
    if quick:
        found = [*(Case(100, mode=m, workers=workers) for m in both), Case(1), Case(1, integrator="implicit")]
        return [replace(case, seconds=0.3) for case in found]
    found = [Case(100, mode=m, workers=workers) for m in both]
    for dtype in ("float32", "float64"):
        found += [Case(n, dtype=dtype, mode=m) for n in (1, 10, 100, 1000) for m in both]
        found += [Case(n, dtype=dtype, compiled=False, mode=m) for n in (1, 100) for m in both]
    found += [Case(n, integrator="implicit", mode=m) for n in (1, 100) for m in both]
    found += [Case(100, twist="dynamic", mode=m) for m in both]
    found += [Case(100, integrator="implicit", twist="quasistatic", mode=m) for m in both]
    return found + [Case(scenes, vertices=n) for scenes in (1, 10) for n in (100, 300, 1000, 3000)]


@contextlib.contextmanager
def environment(**values: str) -> Iterator[None]:
    """Set environment variables for a while."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def first_calls(name: str, case: Case) -> list[dict[str, Any]]:
    """Return seconds of the first call without and with gradients, with empty and with filled caches."""
    found = []
    with tempfile.TemporaryDirectory() as folder:
        caches = {"TORCHINDUCTOR_CACHE_DIR": folder + "/inductor", "TORCHDLO_CACHE": folder + "/torchdlo"}
        for temperature in ("cold", "warm"):
            for mode in (FORWARD, BOTH):
                with environment(**caches):
                    row = measure(replace(case, mode=mode, seconds=0.01))
                found.append({"case": name, "cache": temperature, "mode": mode, "seconds": row["first_call_s"]})
    return found


def memory(frames: int) -> dict[str, Any]:
    """Return the memory of a backward pass over so many frames."""
    with processes(remember, [(frames,)]) as (jobs, _, results):
        start(jobs)
        return receive(jobs, results)


def exponents(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Exponent of cost against vertices from 100 to 3000, least squares over the logarithms, by scenes."""
    found = {}
    for scenes in (1, 10):
        part = [r for r in rows if r["scenes"] == scenes and r["vertices"] >= 100]
        if len(part) > 1:
            x, y = ([math.log(r[name]) for r in part] for name in ("vertices", "us_per_substep"))
            found[str(scenes)] = statistics.linear_regression(x, y).slope
    return found


def implicit_cost(scenes: int) -> float:
    """CPU seconds of an implicit step of all scenes."""
    return 1e-6 * measure(Case(scenes, integrator="implicit"))["us_per_substep"]


def jobs(options: Any, content: dict[str, Any]) -> Iterator[tuple[str, float, Callable[[], None]]]:
    """Yield name, expected seconds and work of every part of the run; the work adds to `content`."""
    parts = PARTS if options.only is None else options.only
    if options.quick or options.smoke:
        parts = ["rows"]

    def row(case: Case) -> None:
        content["rows"].append(measure(case))
        content["exponent"] = exponents(content["rows"])

    if "peers" in parts:
        from versus import compare

        def peers() -> None:
            content["peers"] = compare(options.peers or sys.executable, options.peers_json, implicit_cost)

        yield "other simulators", 60 if options.peers_json else 400, peers
    if "memory" in parts:
        for frames in (400, 4000):
            yield f"memory, {frames} frames", frames / 50, lambda f=frames: content["memory"].append(memory(f))
    if "first" in parts:
        slow = Case(100, integrator="implicit", twist="quasistatic")
        for name, case in (("explicit", Case()), ("implicit, one scene", Case(1, integrator="implicit")),
                           ("implicit, quasistatic twist", slow)):  # fmt: skip
            yield f"first calls, {name}", 120, lambda n=name, c=case: content["first_call_s"].extend(first_calls(n, c))
    if "rows" in parts:
        for case in cases(options.quick, options.smoke, options.workers):
            about = 8 + 5 * case.seconds + (15 if case.compiled else 2)
            yield f"{case.scenes} scenes, {case.vertices} vertices, {case.mode}", about, lambda case=case: row(case)


def chosen(text: str) -> list[str]:
    """Read parts to run, separated by commas."""
    parts = text.split(",")
    if not set(parts) <= set(PARTS):
        raise ValueError(text)
    return parts


def main() -> int:
    """Measure, print and save; what was found so far is in the file after every case."""
    from report_rod import show
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    parser = Parser(__file__, description=__doc__)
    parser.flag("quick", "the rows with goals only, at most a minute with warm caches")
    parser.flag("smoke", "two tiny rows: does the script run?")
    parser.add_argument("--json", metavar="FILE", default="", help="file that the results go to")
    parser.add_argument("--workers", type=count, default=2, help="processes that share 100 scenes (default: 2)")
    parser.add_argument("--peers", metavar="PYTHON", default="", help="interpreter with the extra `peers`")
    parser.add_argument("--peers-json", metavar="FILE", default="", help="results of peers.py instead of a new run")
    parser.add_argument("--only", type=chosen, metavar="PARTS", help=f"parts of {','.join(PARTS)} (default: all)")
    options = parser.parse_args()
    content: dict[str, Any] = {
        "machine": {"cores": os.cpu_count(), "cpu": platform.processor() or platform.machine()},
        "versions": {"python": platform.python_version(), "torch": version("torch")},
    } | {name: [] for name in ("rows", "first_call_s", "memory")}
    todo = list(jobs(options, content))
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns) as progress, interrupts() as stopped:
        task = progress.add_task("", total=sum(about for _, about, _ in todo))
        with contextlib.suppress(KeyboardInterrupt):
            for name, about, do in todo:
                if stopped:
                    break
                progress.update(task, description=name)
                do()
                save(options.json, content)
                progress.advance(task, about)
    save(options.json, content)
    show(content, GOALS)
    return 130 if stopped else 0


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    sys.exit(main())
