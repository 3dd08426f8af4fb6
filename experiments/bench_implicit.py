"""What a simulated second with contact costs in implicit and in explicit steps, and how far each is off.

A rope of 60 vertices falls over a fixed cone with friction, in many scenes: `bench_coupled.py` calls it coiling.
Implicit steps are of 2 ms, explicit ones the published 1 ms in 5 substeps. Both are timed by CPU seconds of one thread,
the least of some repeats, from a state in contact; gradients are those of four steps. Steps are recorded forward, and
eager with gradients; with --compiled both are compiled, so that their ratio compares like with like. The error is the
root mean square distance of vertices from those of 40 explicit substeps per millisecond.

examples:
  python experiments/bench_implicit.py --json implicit.json
  python experiments/bench_implicit.py --compiled
  PYTHONPATH=/path/to/another/version python experiments/bench_implicit.py
"""

from __future__ import annotations

import dataclasses
import sys
import time
from typing import Any

from bench_coupled import Case, build
from options import Parser, count, save

IMPLICIT = {"integrator": "implicit", "dt": 2e-3, "substeps": 1}
EXPLICIT = {"integrator": "explicit", "dt": 1e-3, "substeps": 5}
EXACT = {"integrator": "explicit", "dt": 1e-3, "substeps": 40}
STEPS = 4
"""Steps of a gradient."""


def cell(scenes: int, way: dict[str, Any], dtype: str = "float32") -> tuple[Any, Any, Any]:
    """Return the scene, its parameters and its initial state."""
    made, params, state = build(Case("coiling", scenes, "forward", dtype), scenes)
    return dataclasses.replace(made, **way), params, state


def played(made: tuple[Any, Any, Any], seconds: float) -> Any:
    """Return the state after so many seconds, in recorded steps."""
    import torch

    from torchdlo import scene

    choice, params, state = made
    step = scene.stepper(choice, execution="recorded")
    control = scene.stationary_control(choice, state)
    with torch.no_grad():
        for _ in range(round(seconds / choice.dt)):
            state = step(params, state, control)
    scene.check_state(state)
    return state


def least(work: Any, repeats: int) -> float:
    """Return the CPU seconds of some work, after once that does not count."""
    work()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        work()
        times.append(time.process_time() - start)
    return min(times)


def timed(scenes: int, way: dict[str, Any], start: float, repeats: int, compiled: bool) -> dict[str, float]:
    """Return simulated seconds per CPU second, forward and with a gradient, and the ratio of their costs."""
    import torch

    from torchdlo import scene
    from torchdlo.physics import tree

    choice, params, state = cell(scenes, way)
    state = played((choice, params, state), start)
    control = scene.stationary_control(choice, state)
    ways = ("compiled", "compiled") if compiled else ("recorded", "eager")
    recorded, plain = (scene.stepper(choice, execution=way) for way in ways)

    def forward() -> None:
        now = state
        with torch.no_grad():
            for _ in range(STEPS):
                now = recorded(params, now, control)

    def both() -> None:
        pos = state.rods.pos.clone().requires_grad_()
        now = tree.replace(state, rods=tree.replace(state.rods, pos=pos))
        for _ in range(STEPS):
            now = plain(params, now, control)
        (found,) = torch.autograd.grad(now.rods.pos.square().sum(), pos)
        if not bool(torch.isfinite(found).all()):
            raise ArithmeticError("bench_implicit: a gradient is not finite")

    one, other = least(forward, repeats), least(both, max(1, repeats // 2))
    simulated = scenes * STEPS * choice.dt
    return {"forward": simulated / one, "both": simulated / other, "ratio": other / one}


def main() -> int:
    """Measure, print and save."""
    parser = Parser(__file__, description=__doc__)
    parser.add_argument("--scenes", type=count, default=100, help="scenes that are timed (%(default)s)")
    parser.add_argument("--repeats", type=count, default=6, help="of each timing (%(default)s)")
    parser.add_argument("--seconds", type=float, default=0.2, help="time at which errors are told (%(default)s)")
    parser.add_argument("--json", metavar="FILE", default="", help="file that the results go to")
    parser.flag("compiled", "compile steps, half a minute each")
    parser.flag("smoke", "two scenes, no errors")
    options = parser.parse_args()
    import torch

    torch.set_num_threads(1)
    scenes, repeats = (2, 1) if options.smoke else (options.scenes, options.repeats)
    rows: dict[str, dict[str, float]] = {}
    for name, way in (("implicit", IMPLICIT), ("explicit", EXPLICIT)):
        rows[name] = timed(scenes, way, 0.004 if options.smoke else 0.05, repeats, options.compiled)
        line = "{forward:8.2f} simulated s per CPU s, {both:8.2f} with gradients ({ratio:.1f} times)".format(
            **rows[name]
        )
        print(f"{name:10} {scenes} scenes {line}", flush=True)
        save(options.json, rows)
    if options.smoke:
        return 0
    exact = played(cell(1, EXACT, "float64"), options.seconds).rods.pos
    for name, way in (("implicit", IMPLICIT), ("explicit", EXPLICIT)):
        off = (played(cell(1, way, "float64"), options.seconds).rods.pos - exact).square().sum(-1).mean().sqrt()
        rows[name]["error_mm"] = 1e3 * float(off)
        print(f"{name:10} is {rows[name]['error_mm']:.4f} mm off after {options.seconds} s", flush=True)
        save(options.json, rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
