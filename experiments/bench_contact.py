"""What contact costs: a knotted rope in many scenes, and piles of up to 3000 vertices.

Frames are 1 ms in 5 substeps. CPU seconds of one thread are counted, so that other work on the machine matters less;
two cores give twice the frames. Every run ends with `scene.check_state`: no pair was left out for want of room. Of
piles, the part of contact alone is timed too, not compiled: with its pairs looked up once per frame.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from options import Parser, save

EXAMPLES = """examples:
  python experiments/bench_contact.py --json contact.json
  python experiments/bench_contact.py --scenes 100 --sizes ""
"""
SUBSTEPS = 5


def knotted(scenes: int, contact: bool) -> tuple[Any, Any, Any]:
    """A rope of 60 vertices with a loose overhand knot, held at both ends, turned about the vertical in each scene."""
    import torch

    from torchdlo import scene
    from torchdlo.coupling import RodContact
    from torchdlo.physics.effects.elastic import Bend
    from torchdlo.physics.effects.external import Damping, Gravity

    t = torch.linspace(-2.15, 2.15, 4001, dtype=torch.float64)
    x = 0.022 * torch.stack([t**3 - 3 * t, t**4 - 4 * t**2, 0.35 * (t**5 - 10 * t)], -1)
    s = torch.cat([t.new_zeros(1), (x[1:] - x[:-1]).norm(dim=-1).cumsum(0)])
    wanted = torch.linspace(0, 1, 60, dtype=torch.float64) * s[-1]
    k = torch.searchsorted(s, wanted).clamp(1, len(s) - 1)
    share = ((wanted - s[k - 1]) / (s[k] - s[k - 1]))[:, None]
    x = (1 - share) * x[k - 1] + share * x[k]
    a = 2 * math.pi * torch.arange(scenes, dtype=torch.float64)[:, None] / scenes
    turned = [a.cos() * x[:, 0] - a.sin() * x[:, 1], a.sin() * x[:, 0] + a.cos() * x[:, 1], x[:, 2].expand(scenes, 60)]
    rope = scene.Rope(torch.stack(turned, -1).float(), radius=0.004, density=1000.0, bend=1e-4)
    effects = [Bend(), Gravity(), Damping(), *([RodContact(room=64)] if contact else [])]
    return scene.make([rope], effects, dt=1e-3, substeps=SUBSTEPS, prescribed_vertices=(0, 59))


def pile(vertices: int) -> tuple[Any, Any, Any]:
    """A rope coiled on itself in eight turns on a table: its contacts are in proportion to its length."""
    import torch

    from torchdlo import scene
    from torchdlo.coupling import RodContact
    from torchdlo.physics.effects.elastic import Bend
    from torchdlo.physics.effects.external import Damping, Gravity
    from torchdlo.physics.effects.table import Table

    r, edge = 0.005, 0.015
    wide = vertices * edge / (8 * 2 * math.pi)
    a = torch.arange(vertices, dtype=torch.float64) * edge / wide
    x = torch.stack([wide * a.cos(), wide * a.sin(), r + 2 * r * a / (2 * math.pi)], -1).float()
    effects = [Bend(), Gravity(), Damping(), Table(), RodContact(room=6 * vertices)]
    ropes = [scene.Rope(x, radius=r, density=1000.0, bend=1e-6)]
    choice, params, state = scene.make(ropes, effects, dt=1e-3, substeps=SUBSTEPS)
    with torch.no_grad():
        for _ in range(40):
            state = scene.step(choice, params, state, scene.stationary_control(choice, state))
    return choice, params, state


def timed(made: tuple[Any, Any, Any], backward: bool, seconds: float, compiled: bool) -> dict[str, float]:
    """Return CPU seconds per frame, median of five runs after a first one."""
    import torch

    from torchdlo import scene
    from torchdlo.physics import tree

    torch.set_num_threads(1)
    choice, params, state = made
    step, control = (
        scene.stepper(choice, execution="compiled" if compiled else "eager"),
        scene.stationary_control(choice, state),
    )

    def forward(count: int) -> None:
        now = state
        with torch.no_grad():
            for _ in range(count):
                now = step(params, now, control)
        scene.check_state(now)

    def gradient(count: int) -> None:
        bend = params.rods.material.bend.clone().requires_grad_()
        material = tree.replace(params.rods.material, bend=bend)
        learned = tree.replace(params, rods=tree.replace(params.rods, material=material))
        controls = tree.map(lambda c: c.expand(count, *c.shape), control)
        last, _ = scene.rollout(step, learned, state, controls, keep=lambda s: s.rods.pos[..., -1:, :])
        (found,) = torch.autograd.grad(last.rods.pos.square().sum(), bend)
        scene.check_state(last)
        if not bool(torch.isfinite(found).all()):
            raise ArithmeticError("bench_contact: a gradient is not finite")

    def work(count: int) -> None:
        # Gradients of ten frames at a time: what they keep in memory stays small.
        for k in range(0, count, 10) if backward else (0,):
            (gradient if backward else forward)(min(10, count - k) if backward else count)

    start = time.perf_counter()
    work(4)
    first = time.perf_counter() - start
    start = time.process_time()
    work(4)
    count = max(4, min(200, round(4 * seconds / (time.process_time() - start))))
    times = []
    for _ in range(5):
        start = time.process_time()
        work(count)
        times.append((time.process_time() - start) / count)
    return {"cpu_s_per_frame": statistics.median(times), "first_call_s": first}


def contact_alone(made: tuple[Any, Any, Any], seconds: float) -> float:
    """Return CPU seconds per frame of what contact does by itself: it looks once, reacts and checks in each substep."""
    import torch

    from torchdlo import scene
    from torchdlo.coupling import RodContact

    choice, params, state = made
    contact = next(e for e in choice.effects if e.name == "rod_contact")
    parts = {"broad_phase": 1, "solve_contact": SUBSTEPS, "capacity_overflow": SUBSTEPS}
    plain, given = {name: getattr(RodContact, name) for name in parts}, {}

    def watched(name: str):
        return lambda self, *words: given.update({name: words}) or plain[name](self, *words)

    for name in parts:
        setattr(RodContact, name, watched(name))
    with torch.no_grad():
        scene.step(choice, params, state, scene.stationary_control(choice, state))
        total = 0.0
        for name, often in parts.items():
            setattr(RodContact, name, plain[name])
            times, start = [], time.process_time()
            while len(times) < 5 or time.process_time() - start < seconds / 3:
                before = time.process_time()
                plain[name](contact, *given[name])
                times.append(time.process_time() - before)
            total += often * statistics.median(times)
    return total


def worker(case: dict[str, Any]) -> dict[str, Any]:
    """Time one case in this process."""
    made = pile(case["vertices"]) if case["pile"] else knotted(case["scenes"], case["contact"])
    found = timed(made, case["backward"], case["seconds"], case["compiled"])
    if case["pile"]:
        found["contact_cpu_s_per_frame"] = contact_alone(made, case["seconds"])
    return case | found | {"frames_per_s_per_core": case["scenes"] / found["cpu_s_per_frame"]}


def run(case: dict[str, Any]) -> dict[str, Any]:
    """Time one case in a process of its own."""
    root = str(Path(__file__).resolve().parents[1])
    path = os.pathsep.join([root, *filter(None, [os.environ.get("PYTHONPATH")])])
    env = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": path}
    command = [sys.executable, __file__, "--worker", json.dumps(case)]
    done = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"bench_contact: {case} failed:\n{done.stderr[-2000:]}")
    row = json.loads(done.stdout.splitlines()[-1])
    print("  ", {k: round(v, 5) if isinstance(v, float) else v for k, v in row.items()}, flush=True)
    return row


def main() -> None:
    """Measure, print and save."""
    parser = Parser(__file__, description=__doc__, epilog=EXAMPLES)
    parser.flag("smoke", "one small case without compiling, to see that the script runs")
    parser.flag("eager", "do not compile")
    parser.add_argument("--scenes", default="1,10,100", help="numbers of scenes of the knotted rope (%(default)s)")
    parser.add_argument("--sizes", default="300,1000,3000", help="vertices of the piles (%(default)s)")
    parser.add_argument("--seconds", type=float, default=2.0, help="CPU seconds per timing (%(default)s)")
    parser.add_argument("--json", default="", help="file the results go to")
    parser.add_argument("--worker", default="", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        print(json.dumps(worker(json.loads(options.worker))), flush=True)
        return
    base = {"seconds": options.seconds, "pile": False, "contact": True, "backward": False, "vertices": 60, "scenes": 1}
    base["compiled"] = not options.eager
    if options.smoke:
        options.scenes, options.sizes, base = "1", "", base | {"compiled": False, "seconds": 0.02}
    scenes = [int(n) for n in options.scenes.split(",") if n]
    rows = [run(base | {"scenes": n, "backward": b}) for n in reversed(scenes) for b in (False, True)]
    if scenes:
        rows.append(run(base | {"scenes": max(scenes), "contact": False}))
    piles = [run(base | {"pile": True, "vertices": int(n)}) for n in options.sizes.split(",") if n]
    content: dict[str, Any] = {"rows": rows + piles}
    for part in ("", "contact_") if len(piles) > 1 else ():
        x, y = zip(*((math.log(p["vertices"]), math.log(p[part + "cpu_s_per_frame"])) for p in piles), strict=True)
        content[part + "exponent"] = statistics.linear_regression(x, y).slope
        what = "contact in piles" if part else "piles"
        print(f"cost of {what} grows with the vertices to the power {content[part + 'exponent']:.2f}")
    save(options.json, content)


if __name__ == "__main__":
    main()
