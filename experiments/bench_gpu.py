"""Time batches of ropes on a GPU, and compare what it computes with the CPU.

- rope: the falling rope of bench_rod.py, 60 vertices, no contact.
- coiling: the rope of bench_coupled.py that falls over a cone, 60 vertices, self-contact, friction.

Frames are 1 ms in 5 explicit substeps; frames per second are by the clock, summed over the scenes of the batch.

examples:
  python experiments/bench_gpu.py --scenes 1000,10000
  python experiments/bench_gpu.py --only coiling --scenes 10000 --eager --json gpu.json
"""

from __future__ import annotations

import functools
import sys
import time
from typing import Any

import bench_coupled
import bench_rod
from bench_rod import BOTH, FORWARD
from options import Parser, save

SCENARIOS = ("rope", "coiling")
ROLLOUT = 4
"""Frames of one roll-out; gradients keep one state a frame and run the rest again."""


def build(scenario: str, scenes: int, dtype: str, device: str) -> tuple[Any, Any, Any]:
    """Return the scene, its parameters and its initial state on a device."""
    from torchdlo.physics import tree

    if scenario == "rope":
        made = bench_rod.build(bench_rod.Case(scenes, dtype=dtype), scenes)
    else:
        made = bench_coupled.build(bench_coupled.Case("coiling", scenes, FORWARD, dtype=dtype), scenes)
    return made[0], *(tree.map(lambda x: tree.batch_innermost(x.to(device)), part) for part in made[1:])


def difference(scenario: str, device: str, frames: int) -> dict[str, float]:
    """Return how far positions and gradients on a device are from those on the CPU, in double precision [1]."""

    from torchdlo import scene
    from torchdlo.physics import tree

    found = []
    for where in ("cpu", device):
        choice, params, state = build(scenario, 8, "float64", where)
        bend = params.rods.material.bend.clone().requires_grad_()
        rods = tree.replace(params.rods, material=tree.replace(params.rods.material, bend=bend))
        params, control = tree.replace(params, rods=rods), scene.stationary_control(choice, state)
        for _ in range(frames):
            state = scene.step(choice, params, state, control)
        state.rods.pos.square().sum().backward()
        found.append((state.rods.pos.detach().cpu(), bend.grad.cpu()))
    names = ("positions", "gradient")
    return {n: float((b - a).abs().max() / a.abs().max()) for n, a, b in zip(names, *found, strict=True)}


def timed(run: Any, device: str, seconds: float) -> tuple[float, float]:
    """Return seconds of the first call, and of a later one, by the clock."""
    import torch

    def once() -> float:
        start = time.perf_counter()
        run()
        if device != "cpu":
            torch.cuda.synchronize()
        return time.perf_counter() - start

    first, times = once(), [once()]
    while sum(times) < seconds and len(times) < 50:
        times.append(once())
    return first, min(times)


def main() -> None:
    """Measure, print and save; what was found so far is in the file after every case."""
    import torch

    parser = Parser(__file__, description=__doc__)
    parser.flag("smoke", "two scenes on the CPU in eager mode: does the script run?")
    parser.flag("eager", "do not compile")
    parser.flag("check", "compare with the CPU first")
    parser.add_argument("--json", metavar="FILE", default="", help="file that the results go to")
    parser.add_argument("--only", default=",".join(SCENARIOS), help="scenarios, separated by commas (%(default)s)")
    parser.add_argument("--scenes", default="100,1000,10000", help="numbers of scenes (%(default)s)")
    parser.add_argument("--modes", default=f"{FORWARD},{BOTH}", help="what is timed (%(default)s)")
    parser.add_argument("--seconds", type=float, default=3.0, help="time of a case after its first call")
    parser.add_argument("--device", default="cuda", help="where (%(default)s)")
    options = parser.parse_args()
    if options.smoke:
        options.device, options.scenes, options.eager, options.seconds, options.check = "cpu", "2", True, 0.0, True
    if options.device != "cpu" and not torch.cuda.is_available():
        parser.error("there is no CUDA device; give --device cpu to see the script run")
    head = {"device": options.device, "torch": torch.__version__}
    if options.device != "cpu":
        head["gpu"] = torch.cuda.get_device_name()
    rows: list[dict[str, Any]] = []
    for scenario in options.only.split(","):
        if options.check:
            rows.append({"scenario": scenario, "difference": difference(scenario, options.device, 3)})
            print(rows[-1], flush=True)
        for scenes in map(int, options.scenes.split(",")):
            for mode in options.modes.split(","):
                rows.append(measure(scenario, scenes, mode, options))
                print(rows[-1], flush=True)
                save(options.json, head | {"rows": rows})


def measure(scenario: str, scenes: int, mode: str, options: Any) -> dict[str, Any]:
    """Return the row of a case."""
    import torch

    from torchdlo import scene

    made = build(scenario, scenes, "float32", options.device)
    step = scene.stepper(made[0], execution="eager" if options.eager else "compiled")
    run = bench_rod.forward if mode == FORWARD else functools.partial(bench_rod.gradient, segment=1)
    if options.device != "cpu":
        torch.cuda.reset_peak_memory_stats()
    first, later = timed(lambda: run(step, made, ROLLOUT), options.device, options.seconds)
    row = {"scenario": scenario, "scenes": scenes, "mode": mode, "compiled": not options.eager}
    row |= {"frames_per_s": round(scenes * ROLLOUT / later), "first_call_s": round(first, 1)}
    if options.device != "cpu":
        row["peak_mb"] = round(torch.cuda.max_memory_allocated() / 2**20)
    return row


if __name__ == "__main__":
    sys.exit(main())
