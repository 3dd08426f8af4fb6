"""Pictures of the tasks: the start of each from above and from the side, as docs/tasks.md shows them."""

from __future__ import annotations

import math
from pathlib import Path

from options import Parser

COLORS = ("#1f77b4", "#d95f02")


def outline(body, params, state, k: int) -> list[list[float]]:
    """Return the outline of a body from above: a circle or a rectangle about its middle."""
    import torch

    from torchdlo.physics.linalg.rotation import rotate

    x, y, _ = state.pos[0, k].tolist()
    size = params.size.reshape(-1, params.size.shape[-2], 3)[0, k].tolist()
    if body.shape == "box":
        corners = [[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]
        return [[x + a * size[0] for a, _ in corners], [y + b * size[1] for _, b in corners]]
    if body.shape == "mesh":
        # The shadow of the balls that touch others.
        balls = params.balls.reshape(-1, *params.balls.shape[-2:])[0, k].reshape(-1, 4)[: body.balls]
        centre = rotate(state.quat[0, k].expand(len(balls), 4), balls[:, :3]) + state.pos[0, k]
        t = torch.linspace(0, 2 * math.pi, 40)
        rings = [(c[0] + r * t.cos(), c[1] + r * t.sin()) for c, r in zip(centre, balls[:, 3], strict=True)]
        return [
            [v for r in rings for v in [*r[0].tolist(), math.nan]],
            [v for r in rings for v in [*r[1].tolist(), math.nan]],
        ]
    t, out = [2 * math.pi * i / 60 for i in range(61)], [size[0]]
    if body.shape == "torus":
        ax, ay, az = rotate(state.quat[0, k], state.quat.new_tensor([0.0, 0.0, 1.0])).tolist()
        if abs(az) < 0.5:
            # It stands upright: the shadow of a ring with its axis along (ax, ay).
            long, wide = size[0] + size[1], size[1]
            corners = [[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]
            return [
                [x - a * long * ay + b * wide * ax for a, b in corners],
                [y + a * long * ax + b * wide * ay for a, b in corners],
            ]
        out = [size[0] + size[1], size[0] - size[1]]
    circles = [([x + r * math.cos(a) for a in t], [y + r * math.sin(a) for a in t]) for r in out]
    return [[v for c in circles for v in [*c[0], math.nan]], [v for c in circles for v in [*c[1], math.nan]]]


def draw(name: str, target: Path) -> None:
    """Write the picture of a task."""
    import torch
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from torchdlo.envs import find

    task = find(name)
    scene, params, state = task.start(1, like=torch.zeros((), dtype=torch.float64))
    figure = Figure(figsize=(6, 3.6), dpi=100, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    for k, body in enumerate(scene.bodies):
        if body.shape != "plane":
            axes.plot(*outline(body, params.bodies, state.bodies, k), color="0.4", lw=1.5)
    if state.material_points:
        axes.plot(*state.material_points.pos[0, :, :2].T.tolist(), ".", ms=1, color="#7570b3")
    topology, x = scene.topology, state.rods.pos[0]
    for color, start, count, loop in zip(COLORS * 4, topology.starts, topology.counts, topology.closed, strict=False):
        line = x[[*range(start, start + count), *([start] if loop else [])]]
        axes.plot(line[:, 0], line[:, 1], color=color, lw=4, solid_capstyle="round", alpha=0.8)
    for (bx, by, _), k in zip(task.arms.base, task.arms.vertex, strict=True):
        hx, hy, _ = x[k].tolist()
        axes.plot([bx, hx], [by, hy], ":", color="0.6")
        axes.plot([bx], [by], "s", color="k", ms=8)
        axes.plot([hx], [hy], "v", color="k", ms=7)
    axes.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", title=f"{name}: square: arm, triangle: hand")
    axes.spines[["top", "right"]].set_visible(False)
    target.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(target, pil_kwargs={"lossless": True, "quality": 100, "method": 6})


def main() -> None:
    """Draw the tasks that are asked for."""
    parser = Parser(__file__, description=__doc__)
    parser.add_argument("--tasks", default="", help="names, separated by commas; all if not given")
    parser.add_argument("--out", default="docs/pictures", help="folder of the pictures, task_NAME.webp")
    parser.flag("smoke", "one task: does it run?")
    choices = parser.parse_args()
    from torchdlo.envs import TASKS

    names = [n for n in choices.tasks.split(",") if n] or list(TASKS)
    for name in names[:1] if choices.smoke else names:
        draw(name, Path(choices.out) / f"task_{name}.webp")


if __name__ == "__main__":
    main()
