"""Small charts as SVG and HTML, in the colours of the page, so that they suit light and dark and any width."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence

import numpy as np
from matplotlib import colormaps
from matplotlib.image import imsave

from torchdlo.untrusted import for_html

__all__ = ["STYLE", "bars", "heat", "legend", "lines", "ramp", "scale"]

_MAP = "viridis"

STYLE = """
.bars { display: grid; grid-template-columns: max-content 1fr; gap: .55rem .9rem; align-items: center; }
.bars .name { font-size: .94rem; } .bars .all { font-weight: 600; }
.bar { position: relative; height: 1.05rem; margin-right: 4.6rem; }
.bar i { position: absolute; inset: 2px auto 2px 0; border-radius: 0 3px 3px 0; min-width: 1px; }
.bar b { position: absolute; top: 0; font: 500 .8rem/1.05rem system-ui, sans-serif; padding-left: .4rem;
  white-space: nowrap; font-variant-numeric: tabular-nums; background: var(--page); z-index: 1; margin-left: 1px; }
.bar u { position: absolute; top: -2px; bottom: -2px; border-left: 2px dashed var(--floor); }
.before i { background: var(--before); } .after i { background: var(--after); }
.key { display: flex; flex-wrap: wrap; gap: .2rem 1.2rem; font-size: .9rem; color: var(--soft); margin: .4rem 0; }
.key span::before { content: ""; display: inline-block; width: 1.1em; height: .7em; margin-right: .45em;
  border-radius: 2px; background: var(--c); }
.grid { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 17rem), 1fr)); gap: 1.1rem; }
.maps { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 21rem), 1fr)); gap: 1.1rem; }
figure { margin: 0; } figcaption { font-size: .92rem; margin-bottom: .25rem; }
svg { width: 100%; height: auto; display: block; overflow: visible; }
svg text { fill: var(--soft); font: 11px system-ui, sans-serif; font-variant-numeric: tabular-nums; }
svg .axis { stroke: var(--line); stroke-width: 1; fill: none; }
svg .before { stroke: var(--before); fill: var(--before); } svg .after { stroke: var(--after); fill: var(--after); }
svg path.before, svg path.after { fill: none; stroke-width: 2; stroke-linejoin: round; }
svg .floor { stroke: var(--floor); stroke-width: 1.5; stroke-dasharray: 5 4; }
.ramp { display: flex; align-items: center; gap: .6rem; font-size: .85rem; color: var(--soft); margin: .5rem 0 0; }
.ramp span { flex: 0 1 14rem; height: .7rem; border-radius: 2px; }
"""


def legend(floor: bool = True) -> str:
    """The colours in words."""
    items = [("before", "baseline"), ("after", "with what was found"), *([("floor", "floor")] if floor else [])]
    return f'<div class="key">{"".join(f"<span style=--c:var(--{c})>{w}</span>" for c, w in items)}</div>'


def bars(rows: Sequence[tuple[str, float, float]], floor: float) -> str:
    """Two bars per row, name, before and after, all in one unit, with a mark at the floor; the first row stands out."""
    shown = [v for _, *pair in rows for v in pair if np.isfinite(v)]
    most = max([*shown, floor, 1e-12])
    out = []
    for k, (name, *pair) in enumerate(rows):
        out.append(f'<div class="name{"" if k else " all"}">{for_html(name)}</div><div>')
        for kind, value in zip(("before", "after"), pair, strict=True):
            width = 100 * min(value / most, 1.0) if np.isfinite(value) else 100
            text = f"{value:.2f} mm" if np.isfinite(value) else "failed"
            out.append(
                f'<div class="bar {kind}"><i style="width:{width:.2f}%"></i><u style="left:{100 * floor / most:.2f}%">'
                f'</u><b style="left:{width:.2f}%">{text}</b></div>'
            )
        out.append("</div>")
    return f'<div class="bars">{"".join(out)}</div>'


def lines(
    title: str, unit: str, x: np.ndarray, series: dict[str, np.ndarray], most: float, floor: float | None = None
) -> str:
    """Values over x; `series` by kind (before, after), all from 0 to `most`."""
    left, right, top, bottom, width, height = 34, 8, 8, 34, 300, 170
    good = np.isfinite(x)
    low, high = (float(x[good].min()), float(x[good].max())) if good.any() else (0.0, 1.0)
    span = high - low or 1.0

    def px(v: float) -> float:
        return left + (v - low) / span * (width - left - right)

    def py(v: float) -> float:
        return height - bottom - v / most * (height - bottom - top)

    parts = [f'<path class="axis" d="M{left} {top}V{height - bottom}H{width - right}"/>']
    for tick in scale(most):
        parts.append(f'<text x="{left - 5}" y="{py(tick) + 4:.1f}" text-anchor="end">{tick:g}</text>')
        parts.append(f'<path class="axis" d="M{left - 3} {py(tick):.1f}h3"/>')
    for v, anchor in ((low, "start"), (0.5 * (low + high), "middle"), (high, "end")):
        parts.append(f'<text x="{px(v):.1f}" y="{height - bottom + 14}" text-anchor="{anchor}">{v:.3g}</text>')
    parts.append(
        f'<text x="{(left + width - right) / 2}" y="{height - 4}" text-anchor="middle">{for_html(unit)}</text>'
    )
    if floor is not None and floor <= most:
        parts.append(f'<path class="floor" d="M{left} {py(floor):.1f}H{width - right}"/>')
    for kind, y in series.items():
        both = good & np.isfinite(y)
        points = [(px(float(a)), py(min(float(b), most))) for a, b in zip(x[both], y[both], strict=True)]
        path = "L".join(f"{a:.1f} {b:.1f}" for a, b in points)
        parts.append(f'<path class="{kind}" d="M{path}"/>' if points else "")
        parts += [f'<circle class="{kind}" cx="{a:.1f}" cy="{b:.1f}" r="2.6"/>' for a, b in points]
    return _figure(title, f"0 0 {width} {height}", parts)


def heat(title: str, values: np.ndarray, time: np.ndarray, place: np.ndarray, most: float) -> str:
    """A map of values (F, M) over time and place; places lie at the middle of their rows."""
    left, right, top, bottom, width, height = 40, 6, 4, 34, 420, 250
    step = max(1, -(-len(values) // 400))
    shown = np.flipud(values[::step].T)
    edges = np.concatenate([[place[0]], 0.5 * (place[1:] + place[:-1]), [place[-1]]])
    fine = np.linspace(edges[-1], edges[0], 200)
    row = len(place) - 1 - np.clip(np.searchsorted(edges, fine) - 1, 0, len(place) - 1)
    colours = colormaps[_MAP](np.clip(shown[row] / most, 0, 1))
    colours[..., 3] = np.isfinite(shown[row])
    content = io.BytesIO()
    imsave(content, colours, format="png", metadata={"Software": "torchdlo"})
    data = base64.b64encode(content.getvalue()).decode("ascii")
    w, h = width - left - right, height - top - bottom
    parts = [
        f'<image x="{left}" y="{top}" width="{w}" height="{h}" preserveAspectRatio="none" '
        f'href="data:image/png;base64,{data}"/>',
        f'<path class="axis" d="M{left} {top}V{top + h}H{left + w}"/>',
    ]
    ticks = [v for v in scale(100 * edges[-1]) if v >= 100 * edges[0]]
    for v in np.array(ticks) / 100:
        y = top + h * (1 - (v - edges[0]) / (edges[-1] - edges[0]))
        parts.append(f'<text x="{left - 5}" y="{y + 4:.1f}" text-anchor="end">{100 * v:.0f}</text>')
    for v, anchor in zip(np.linspace(0, time[-1], 5), ("start", *["middle"] * 3, "end"), strict=True):
        parts.append(
            f'<text x="{left + w * v / time[-1]:.1f}" y="{top + h + 14}" text-anchor="{anchor}">{v:.2g}</text>'
        )
    parts.append(f'<text x="{left + w / 2}" y="{height - 4}" text-anchor="middle">time [s]</text>')
    parts.append(
        f'<text transform="translate(10 {top + h / 2}) rotate(-90)" text-anchor="middle">along the rope [cm]</text>'
    )
    return _figure(title, f"0 0 {width} {height}", parts)


def ramp(most: float, unit: str) -> str:
    """What the colours of maps mean."""
    stops = ",".join(
        "#" + "".join(f"{round(255 * c):02x}" for c in colormaps[_MAP](s)[:3]) for s in np.linspace(0, 1, 9)
    )
    bar = f'<span style="background:linear-gradient(90deg,{stops})"></span>'
    return f'<div class="ramp">0 {bar} {most:.3g} {for_html(unit)}</div>'


def scale(most: float) -> list[float]:
    """Return round values from 0 up to `most`, three to six of them."""
    if not most > 0:
        return [0.0]
    rough = most / 3
    power = 10 ** np.floor(np.log10(rough))
    step = max(s * power for s in (1, 2, 5) if s * power <= rough * (1 + 1e-9))
    return [float(f"{k * step:.6g}") for k in range(int(most / step + 1e-9) + 1)]


def _figure(title: str, box: str, parts: list[str]) -> str:
    return (
        f'<figure><figcaption>{for_html(title)}</figcaption><svg viewBox="{box}" role="img" '
        f'aria-label="{for_html(title)}">{"".join(parts)}</svg></figure>'
    )
