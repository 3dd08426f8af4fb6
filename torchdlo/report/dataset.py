"""The page of a data set: what is in it, and some of its episodes with their videos and what was done."""

from __future__ import annotations

import base64
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchdlo.agents.data import video_codec
from torchdlo.agents.data.reading import DataSet, json_file
from torchdlo.files import write_atomically
from torchdlo.report.pages.page import STYLE, number, page, table
from torchdlo.untrusted import for_html

__all__ = ["dataset_page", "dataset_summary", "write_page"]

_OWN = """
.episode { background: var(--card); border-radius: 8px; padding: .8rem 1rem; margin: 1rem 0; }
.episode h3 { margin: 0 0 .5rem; } .shots { display: flex; flex-wrap: wrap; gap: .6rem; }
figure { margin: 0; } video { width: 224px; height: 224px; image-rendering: pixelated; background: #000; }
figcaption { color: var(--soft); font-size: .85rem; } svg { width: 100%; height: 90px; }
"""
_SCRIPT = """
<script>
document.querySelectorAll('.episode').forEach(e => {
  const all = [...e.querySelectorAll('video')], first = all[0];
  if (!first) return;
  first.addEventListener('play', () => all.slice(1).forEach(v => { v.currentTime = first.currentTime; v.play(); }));
  first.addEventListener('pause', () => all.slice(1).forEach(v => v.pause()));
  first.addEventListener('seeked', () => all.slice(1).forEach(v => { v.currentTime = first.currentTime; }));
});
</script>
"""
_COLORS = ("#00798c", "#c4472f", "#e09f3e", "#3d348b", "#5a8f3c", "#a04668")


def dataset_summary(data: DataSet) -> dict[str, Any]:
    """Return what is in a set, as plain data."""
    about = data.provenance
    tasks: dict[str, dict[str, Any]] = {}
    rows = about.get("episodes") or [{}] * len(data.episodes)
    for row, own in zip(data.episodes, rows, strict=True):
        found = tasks.setdefault(own.get("task") or row["tasks"][0], {"episodes": 0, "frames": 0, "told": set()})
        found["episodes"] += 1
        found["frames"] += row["length"]
        found["told"] |= set(row["tasks"])
    failures, tried = about.get("failures", {}), about.get("attempts", {})
    for name, found in tasks.items():
        found["told"] = len(found["told"])
        found |= {"attempts": tried.get(name), "failed": failures.get(name)}
    size = sum(file.stat().st_size for file in data.path.rglob("*") if file.is_file())
    return {
        "path": str(data.path),
        "version": data.info["codebase_version"],
        "generator": about.get("generator"),
        "fps": data.fps,
        "episodes": len(data.episodes),
        "frames": data.info["total_frames"],
        "cameras": {name: data.features[name]["shape"] for name in data.cameras},
        "features": {name: list(w["shape"]) for name, w in data.features.items() if w["dtype"] != "video"},
        "bytes": size,
        "tasks": tasks,
    }


def dataset_page(data: DataSet, episodes: Sequence[int]) -> str:
    """Return a page that needs nothing but itself.

    Args:
        data: the set.
        episodes: which ones are shown with their videos.
    """
    found = dataset_summary(data)
    rows = [
        (
            name,
            str(t["episodes"]),
            str(t["frames"]),
            str(t["told"]),
            "-" if t["attempts"] is None else str(t["attempts"]),
            "-" if t["failed"] is None else str(t["failed"]),
        )
        for name, t in found["tasks"].items()
    ]
    heads = ("task", "episodes", "frames", "sentences", "attempts", "failed")
    name = for_html(data.path.resolve().name)
    body = [
        f"<h1>{name}</h1><p class='verdict'>{found['episodes']} episodes, {found['frames']} frames at {data.fps} per "
        f"second, {found['bytes'] / 1e6:.1f} MB.</p>",
        table(heads, rows),
        f"<h2>Columns</h2>{_columns(data)}",
        f"<h2>Episodes</h2><p class='soft'>{len(episodes)} of {found['episodes']} are shown; playing the first camera "
        "plays all.</p>",
    ]
    columns = data.columns()
    body += [_episode(data, k, columns) for k in episodes]
    return page(data.path.resolve().name, STYLE + _OWN, "\n".join(body) + _SCRIPT)


def _columns(data: DataSet) -> str:
    stats = json_file(data.path / "meta/stats.json")
    rows = []
    for name, what in data.features.items():
        own = stats.get(name)
        low, high = ("-", "-") if own is None else (number(np.min(own["min"])), number(np.max(own["max"])))
        rows.append((name, what["dtype"], " x ".join(map(str, what["shape"])), low, high))
    return table(("column", "type", "shape", "least", "greatest"), rows)


def _episode(data: DataSet, k: int, columns: dict[str, np.ndarray]) -> str:
    row = data.episodes[k]
    own = (data.provenance.get("episodes") or [{}] * len(data.episodes))[k]
    shots = []
    for camera in data.cameras:
        with tempfile.TemporaryDirectory(prefix="torchdlo-") as folder:
            file = Path(folder) / "clip.mp4"
            video_codec.concatenate_clips(file, [data.clip(k, camera)], fps=data.fps)
            content = base64.b64encode(file.read_bytes()).decode()
        shots.append(
            f'<figure><video controls muted loop playsinline src="data:video/mp4;base64,{content}"></video>'
            f"<figcaption>{for_html(camera.rpartition('.')[2])}</figcaption></figure>"
        )
    part = slice(row["dataset_from_index"], row["dataset_to_index"])
    curves = ""
    if "action" in columns:
        curves = _curves(columns["action"][part], data.features["action"]["names"])
    facts = [f"{row['length']} frames"]
    facts += [f"return {number(own['return'])}"] if own.get("return") is not None else []
    facts += [str(own[key]) for key in ("task", "actions_from") if own.get(key)]
    return (
        f'<div class="episode"><h3>{k}: {for_html(" / ".join(row["tasks"]))}</h3>'
        f'<p class="soft">{for_html(", ".join(facts))}</p><div class="shots">{"".join(shots)}</div>{curves}</div>'
    )


def _curves(values: np.ndarray, names: Sequence[str] | None) -> str:
    """Return what was done over time as a drawing, the columns that are not 0 throughout."""
    top = float(np.abs(values).max()) or 1.0
    lines, said = [], []
    moving = [c for c in range(values.shape[1]) if np.abs(values[:, c]).max() > 0][: len(_COLORS)]
    for color, c in zip(_COLORS, moving, strict=False):
        x = np.linspace(0, 1000, len(values))
        points = " ".join(f"{a:.1f},{50 - 45 * b / top:.1f}" for a, b in zip(x, values[:, c], strict=True))
        lines.append(f'<polyline fill="none" stroke="{color}" stroke-width="1.5" points="{points}"/>')
        name = names[c] if names else str(c)
        said.append(f'<span style="color:{color}">{for_html(str(name))}</span>')
    drawn = f'<svg viewBox="0 0 1000 100" preserveAspectRatio="none">{"".join(lines)}</svg>'
    return f'{drawn}<p class="soft">action, up to {top:.2g}: {" ".join(said)}</p>'


def write_page(data: DataSet, path: Path, episodes: Sequence[int]) -> None:
    """Write the page to a file."""
    write_atomically(path, dataset_page(data, episodes))
