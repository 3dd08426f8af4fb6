"""A replay of trials in three dimensions: a canvas, its data, and a script that needs nothing else."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence

import numpy as np

from torchdlo.sysid.recordings.recording import Recording, Trial
from torchdlo.untrusted import for_html, json_in_html

__all__ = ["STYLE", "replay"]

_TRIALS = 6
"""Most trials in one page."""

_FRAMES = 240
"""Most frames of a trial; more are thinned out."""

_NONE = -32768
"""Stands for a marker that was not seen."""


def replay(recording: Recording, predictions: Mapping[str, Mapping[str, np.ndarray]], order: Sequence[Trial]) -> str:
    """Return the player with trials in this order; `predictions` by layer (before, after) and trial."""
    trials = [_packed(t, [predictions[w][t.name] for w in ("before", "after")]) for t in order[:_TRIALS]]
    content = {
        "trials": trials,
        "gripped": [int(g) for g in order[0].gripped],
        "table": recording.table_height,
    }
    options = "".join(f'<option value="{k}">{for_html(t["name"])}</option>' for k, t in enumerate(trials))
    data = json_in_html(content)
    return _HTML.format(options=options, data=data, script=_SCRIPT)


def _packed(trial: Trial, simulated: Sequence[np.ndarray]) -> dict[str, object]:
    """Return measured and simulated markers of a trial as 16 bit numbers."""
    frames = min(len(trial.time), *(len(s) for s in simulated))
    pick = np.unique(np.linspace(0, frames - 1, min(frames, _FRAMES)).round().astype(int))
    measured = np.where(trial.suspect[:, None, None], np.nan, trial.markers)
    layers = np.stack([x[pick] for x in (measured, *simulated)])
    low, high = (f(trial.markers[pick], axis=(0, 1)) for f in (np.nanmin, np.nanmax))
    centre = 0.5 * (low + high)
    # What a simulation that fails does far away is cut off.
    unit = max(float((high - low).max()), 1e-3) * 2 / 32000
    counts = np.clip(np.nan_to_num((layers - centre) / unit), -32000, 32000).round()
    counts[~np.isfinite(layers)] = _NONE
    apart = np.linalg.norm(layers[1] - layers[0], axis=-1)[:, ~trial.gripped]
    return {
        "name": trial.name,
        # It opens where the baseline is furthest off.
        "worst": int(np.argmax(np.nan_to_num(apart).sum(1))),
        "time": [round(float(t), 4) for t in trial.time[pick]],
        "shape": list(layers.shape[:3]),
        "unit": unit,
        "centre": [float(c) for c in centre],
        "reach": float(np.linalg.norm(high - low)) / 2 or 1.0,
        "data": base64.b64encode(counts.astype("<i2").tobytes()).decode("ascii"),
    }


STYLE = """
.player { background: var(--card); border-radius: 8px; padding: .8rem; }
.player canvas { width: 100%; height: min(62vw, 460px); display: block; touch-action: pan-y; cursor: grab; }
.player .row { display: flex; flex-wrap: wrap; align-items: center; gap: .5rem .8rem; font-size: .92rem; }
.player input[type=range] { flex: 1 1 10rem; min-width: 6rem; accent-color: var(--accent); }
.player button, .player select { font: inherit; color: var(--ink); background: var(--page); cursor: pointer;
  border: 1px solid var(--line); border-radius: 6px; padding: .25rem .7rem; min-height: 2.2rem; }
.player button:focus-visible, .player canvas:focus-visible { outline: 2px solid var(--accent); }
.player output { font-variant-numeric: tabular-nums; color: var(--soft); min-width: 9rem; }
.player label { color: var(--c); font-weight: 600; }
"""

_HTML = """<div class="player" id="player">
<canvas tabindex="0" aria-label="Replay of a trial; drag to turn it, space to play"></canvas>
<div class="row"><button type="button" id="play" aria-label="Play">Play</button>
<input type="range" id="at" min="0" value="0" aria-label="Time">
<output id="now"></output></div>
<div class="row"><select id="trial" aria-label="Trial">{options}</select>
<select id="speed" aria-label="Speed"><option value="1">full speed</option><option value="0.5">1/2</option>
<option value="0.25" selected>1/4</option><option value="0.1">1/10</option></select>
<span><button type="button" data-turn="0,0">front</button> <button type="button" data-turn="1.5708,0">side</button>
<button type="button" data-turn="0,1.5708">top</button></span>
<label style="--c:var(--ink)"><input type="checkbox" data-layer="0" checked> measured</label>
<label style="--c:var(--before)"><input type="checkbox" data-layer="1" checked> baseline</label>
<label style="--c:var(--after)"><input type="checkbox" data-layer="2" checked> with what was found</label></div>
</div>
<script type="application/json" id="motion">{data}</script>
<script>{script}</script>"""

_SCRIPT = """
(function () {
  "use strict";
  const all = JSON.parse(document.getElementById("motion").textContent);
  const box = document.getElementById("player"), canvas = box.querySelector("canvas");
  const pen = canvas.getContext("2d"), at = document.getElementById("at"), now = document.getElementById("now");
  const play = document.getElementById("play"), layers = [true, true, true];
  let trial = null, values = null, playing = false, clock = 0, last = 0, yaw = 0.5, pitch = 0.25, speed = 0.25;

  function load(k) {
    trial = all.trials[k];
    const raw = atob(trial.data), bytes = new Uint8Array(raw.length);
    for (let i = 0; i < raw.length; i++) bytes[i] = raw.charCodeAt(i);
    values = new DataView(bytes.buffer);
    at.max = trial.time.length - 1;
    at.value = trial.worst;
    clock = trial.time[trial.worst];
    draw();
  }
  function point(layer, frame, marker) {
    const [, frames, markers] = trial.shape, i = 6 * ((layer * frames + frame) * markers + marker);
    const p = [0, 2, 4].map(function (k) { return values.getInt16(i + k, true); });
    return p[0] === -32768 ? null : p.map(function (v) { return v * trial.unit; });
  }
  function project(p, view) {
    const x = p[0] * view.cy + p[1] * view.sy, y = -p[0] * view.sy + p[1] * view.cy;
    return [view.x + view.s * x, view.y - view.s * (p[2] * view.cp + y * view.sp)];
  }
  function look() {
    const w = canvas.clientWidth, h = canvas.clientHeight, ratio = window.devicePixelRatio || 1;
    if (canvas.width !== Math.round(w * ratio) || canvas.height !== Math.round(h * ratio)) {
      canvas.width = Math.round(w * ratio);
      canvas.height = Math.round(h * ratio);
    }
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, w, h);
    return { x: w / 2, y: h / 2, s: 0.46 * Math.min(w, h) / trial.reach, cy: Math.cos(yaw), sy: Math.sin(yaw),
      cp: Math.cos(pitch), sp: Math.sin(pitch), w: w, h: h };
  }
  function curve(points) {
    // A smooth line through the markers (Catmull and Rom 1974).
    pen.beginPath();
    let open = false;
    for (let i = 0; i < points.length; i++) {
      const p = points[i];
      if (!p) { open = false; continue; }
      if (!open) { pen.moveTo(p[0], p[1]); open = true; continue; }
      const a = points[i - 1], before = points[i - 2] || a, after = points[i + 1] || p;
      pen.bezierCurveTo(a[0] + (p[0] - before[0]) / 6, a[1] + (p[1] - before[1]) / 6,
        p[0] - (after[0] - a[0]) / 6, p[1] - (after[1] - a[1]) / 6, p[0], p[1]);
    }
    pen.stroke();
  }
  function ground(view, colour) {
    // Level lines below the rope, at the table where there is one.
    const reach = trial.reach, step = Math.pow(10, Math.floor(Math.log10(reach)));
    const z = all.table === null ? -reach : all.table - trial.centre[2], n = Math.ceil(reach / step);
    pen.strokeStyle = colour;
    pen.lineWidth = 1;
    pen.beginPath();
    for (let k = -n; k <= n; k++) {
      for (const ends of [[[k * step, -n * step, z], [k * step, n * step, z]],
        [[-n * step, k * step, z], [n * step, k * step, z]]]) {
        const [a, b] = ends.map(function (p) { return project(p, view); });
        pen.moveTo(a[0], a[1]);
        pen.lineTo(b[0], b[1]);
      }
    }
    pen.stroke();
  }
  function draw() {
    const style = getComputedStyle(document.documentElement), view = look(), frame = Number(at.value);
    const colours = ["--ink", "--before", "--after"].map(function (c) { return style.getPropertyValue(c).trim(); });
    const markers = trial.shape[2], size = [0, 0, 0], count = [0, 0, 0];
    ground(view, style.getPropertyValue("--line").trim());
    for (let layer = 2; layer >= 0; layer--) {
      const seen = [];
      for (let m = 0; m < markers; m++) {
        const p = point(layer, frame, m), q = point(0, frame, m);
        seen.push(p && project(p, view));
        if (p && q && layer && !all.gripped[m]) {
          size[layer] += Math.pow(p[0] - q[0], 2) + Math.pow(p[1] - q[1], 2) + Math.pow(p[2] - q[2], 2);
          count[layer] += 1;
        }
      }
      if (!layers[layer]) continue;
      pen.strokeStyle = pen.fillStyle = colours[layer];
      pen.lineWidth = 2.5;
      if (layer) { curve(seen); continue; }
      seen.forEach(function (p, m) {
        if (!p) return;
        pen.beginPath();
        if (all.gripped[m]) pen.rect(p[0] - 4, p[1] - 4, 8, 8); else pen.arc(p[0], p[1], 3.2, 0, 7);
        pen.fill();
      });
    }
    const gaps = [1, 2].map(function (k) { return count[k] ? (1e3 * Math.sqrt(size[k] / count[k])).toFixed(1) : "-"; });
    now.textContent = trial.time[frame].toFixed(2) + " s, distance " + gaps[0] + " \\u2192 " + gaps[1] + " mm";
  }
  function seek(t) {
    let k = 0;
    while (k < trial.time.length - 1 && trial.time[k + 1] <= t) k++;
    at.value = k;
  }
  function tick(stamp) {
    if (!playing) return;
    clock += speed * Math.min(stamp - last, 100) / 1e3;
    last = stamp;
    if (clock > trial.time[trial.time.length - 1]) clock = trial.time[0];
    seek(clock);
    draw();
    requestAnimationFrame(tick);
  }
  function toggle() {
    playing = !playing;
    play.textContent = playing ? "Pause" : "Play";
    play.setAttribute("aria-label", play.textContent);
    if (playing) { clock = trial.time[Number(at.value)]; last = performance.now(); requestAnimationFrame(tick); }
  }
  play.addEventListener("click", toggle);
  at.addEventListener("input", function () { clock = trial.time[Number(at.value)]; draw(); });
  document.getElementById("trial").addEventListener("change", function (e) { load(Number(e.target.value)); });
  document.getElementById("speed").addEventListener("change", function (e) { speed = Number(e.target.value); });
  box.querySelectorAll("[data-layer]").forEach(function (b) {
    b.addEventListener("change", function () { layers[Number(b.dataset.layer)] = b.checked; draw(); });
  });
  box.querySelectorAll("[data-turn]").forEach(function (b) {
    b.addEventListener("click", function () { [yaw, pitch] = b.dataset.turn.split(",").map(Number); draw(); });
  });
  canvas.addEventListener("pointerdown", function (e) { canvas.setPointerCapture(e.pointerId); });
  canvas.addEventListener("pointermove", function (e) {
    if (!e.buttons) return;
    yaw -= e.movementX * 0.01;
    pitch = Math.max(-1.5708, Math.min(1.5708, pitch + e.movementY * 0.01));
    draw();
  });
  canvas.addEventListener("keydown", function (e) {
    const steps = { ArrowLeft: -1, ArrowRight: 1 };
    if (e.key === " ") toggle();
    else if (e.key in steps) { at.value = Number(at.value) + steps[e.key]; at.dispatchEvent(new Event("input")); }
    else return;
    e.preventDefault();
  });
  window.addEventListener("resize", draw);
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  load(0);
})();
"""
