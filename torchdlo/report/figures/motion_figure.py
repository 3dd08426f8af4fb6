"""The picture of a simulation: shapes of the ropes over time, from the side and from above."""

from __future__ import annotations

import io

import numpy as np
from matplotlib import colormaps
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from torchdlo.untrusted import for_plot

__all__ = ["motion_png"]

_VIEWS = (("x", "z", "from the side"), ("x", "y", "from above"))


def motion_png(time: np.ndarray, pos: np.ndarray, rope: np.ndarray, body_pos: np.ndarray, *, title: str) -> bytes:
    """The picture as PNG; drawn without a display.

    Args:
        time: moments [s], shape (F,).
        pos: vertex positions [m], shape (F, V, 3).
        rope: number of the rope of each vertex, shape (V,).
        body_pos: positions of bodies [m], shape (F, K, 3).
        title: what stands above it.
    """
    figure = Figure(figsize=(11, 5.2), dpi=120, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    chosen = np.unique(np.linspace(0, len(time) - 1, 7).round().astype(int))
    colors = colormaps["viridis_r"](np.linspace(0.05, 1, len(chosen)))
    for axes, (across, up, name) in zip(figure.subplots(1, 2), _VIEWS, strict=True):
        i, j = "xyz".index(across), "xyz".index(up)
        for k, color in zip(chosen, colors, strict=True):
            for number in np.unique(rope):
                line = pos[k, rope == number]
                label = f"{time[k]:.3g} s" if number == 0 else None
                axes.plot(line[:, i], line[:, j], color=color, lw=2, label=label, solid_capstyle="round")
            axes.plot(body_pos[k, :, i], body_pos[k, :, j], "+", color=color)
        axes.set(title=name, xlabel=f"{across} [m]", ylabel=f"{up} [m]", aspect="equal", adjustable="datalim")
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    figure.axes[0].legend(title="after", fontsize=8, frameon=False)
    figure.suptitle(for_plot(title))
    content = io.BytesIO()
    figure.savefig(content, format="png", metadata={"Software": "torchdlo"})
    return content.getvalue()
