"""What other ways of finding what a model lacks say of the recordings that `torchdlo diagnose` is judged by.

    python experiments/rival_methods.py RECORDING [RECORDING ...] --journals runs/journals --answers runs/hidden/answers

All of them begin with the same calibrated baseline and see the same trials; what a diagnosis simulates is kept in
`--journals`, so that a second run takes seconds. The rivals:

- *calibration alone* names nothing; what it leaves is the gap before.
- *BIC* takes, of the fits of the first round, the one with the least Bayesian information criterion (Schwarz 1978).
- *sparse regression* explains the accelerations that the baseline lacks by a library of terms at the measured states,
  as SINDy does with discrepancies (Kaheman et al. 2019, arXiv:1909.08574); terms are tested one by one beside the
  baseline's own by sign flips of blocks of the train trials, at a false discovery rate of 5 %.
- *residual network* learns the error of the baseline from place, time derivatives and the grippers' motion; it names
  nothing, but may close a gap.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from options import Parser, save
from rival_table import table
from scipy.signal import savgol_filter

from torchdlo.sysid.diagnosis import effect_library
from torchdlo.sysid.diagnosis.effect_search import diagnose
from torchdlo.sysid.diagnosis.error_floor import gap_rms, trial_gaps
from torchdlo.sysid.diagnosis.significance import RATE, benjamini_hochberg, sign_flips
from torchdlo.sysid.diagnosis.verdict import Diagnosis
from torchdlo.sysid.recordings.recording import Recording, Trial, load_recording

SMOOTH = 0.11
"""Time over which motion is smoothed before it is differentiated [s]."""
BLOCK = 0.4
"""Length of blocks whose signs are flipped [s]."""
PLACES = 4
"""Parts of the rope that a mass or a spot may be in."""
EPOCHS, WIDTH = 300, 32


@dataclass(frozen=True)
class Terms:
    """Candidate terms of a trial at its measured states, each (R,), beside what the baseline itself can take up."""

    own: np.ndarray
    """Of the baseline: damping, bending stiffness; shape (R, 2)."""
    groups: dict[str, np.ndarray]
    """By effect, shape (R, K)."""
    lacking: np.ndarray
    """Accelerations that the baseline lacks [m/s^2], shape (R,)."""
    block: np.ndarray
    """Which block each row is of, shape (R,)."""


def bic(result: Diagnosis, recording: Recording) -> str | None:
    """Return the effect with the least BIC among the fits of the first round, None if that is no effect."""
    free = int((~recording.train[0].gripped).sum())
    n = sum(len(t.time) for t in recording.train) * free * 3
    before = gap_rms(trial_gaps([result.predictions["before"][t.name] for t in recording.train], recording.train)) ** 2
    excess, scores = max(before - result.floor.noise**2, 0.0), {None: n * np.log(before)}
    for c in result.candidates[0] if result.candidates else ():
        if c.gain is not None:
            count = len(effect_library.numbers(c.name, recording))
            scores[c.name] = n * np.log(max(before - c.gain * excess, 1e-12)) + count * np.log(n)
    return min(scores, key=scores.__getitem__)


def terms(trial: Trial, predicted: np.ndarray, first: int) -> Terms:
    """Return the terms of a trial whose baseline is known; blocks are counted from `first`."""
    dt = float(trial.time[1] - trial.time[0])
    window = max(5, int(SMOOTH / dt) // 2 * 2 + 1)

    def rate(x: np.ndarray, order: int) -> np.ndarray:
        return savgol_filter(x, window, 3, deriv=order, delta=dt, axis=0)

    s = trial.marker_arclength
    seen = _filled(np.where(trial.suspect[:, None, None], np.nan, trial.markers))

    def along(x: np.ndarray, order: int) -> np.ndarray:
        for _ in range(order):
            x = np.gradient(x, s, axis=1)
        return x

    x, v, a, jerk = (rate(seen, k) for k in range(4))
    tangent = along(x, 1)
    tangent /= np.linalg.norm(tangent, axis=-1, keepdims=True)

    def across(y: np.ndarray) -> np.ndarray:
        return y - (y * tangent).sum(-1, keepdims=True) * tangent

    curvature = along(tangent, 1)
    vn, where = across(v), np.clip((s / s[-1] * PLACES).astype(int), 0, PLACES - 1)
    weight = a + np.array([0.0, 0.0, 9.81])
    stiff, constant = -along(curvature, 2), [np.broadcast_to(e, x.shape) for e in np.eye(3)]

    def placed(y: np.ndarray) -> list[np.ndarray]:
        return [y * (where == k)[:, None] for k in range(PLACES)]

    groups = {
        "air_drag": [-np.linalg.norm(vn, axis=-1, keepdims=True) * vn],
        "tilted_gravity": constant,
        "bending_damping": [-along(along(v, 2), 2)],
        "stiffening_bending": [-along((curvature**2).sum(-1, keepdims=True) * curvature, 2)],
        "point_mass": placed(weight),
        "nonuniform_stiffness": placed(stiff),
        "time_delay": [-jerk],
    }
    free, edge = np.flatnonzero(~trial.gripped), window // 2
    rows = slice(edge, len(x) - edge)

    def flat(y: np.ndarray) -> np.ndarray:
        return across(y)[rows][:, free].ravel()

    count = len(x) - 2 * edge
    block = np.repeat(first + (np.arange(count) * dt / BLOCK).astype(int), 3 * len(free))
    lacking = rate(seen - _filled(predicted), 2)
    return Terms(
        np.stack([flat(-v), flat(stiff)], 1),
        {name: np.stack([flat(y) for y in columns], 1) for name, columns in groups.items()},
        flat(lacking),
        block,
    )


def _filled(x: np.ndarray) -> np.ndarray:
    """Return markers (F, M, 3) with what was not seen in between."""
    x, frames = x.copy(), np.arange(len(x))
    for m in range(x.shape[1]):
        known = np.isfinite(x[:, m, 0])
        for c in range(3):
            x[:, m, c] = np.interp(frames, frames[known], x[known, m, c])
    return x


def regress(recording: Recording, before: dict[str, np.ndarray]) -> list[tuple[str, float, float]]:
    """Return the terms that count, those that explain most of the accelerations first: name, share, rate."""
    parts, first = [], 0
    for trial in recording.train:
        parts.append(terms(trial, before[trial.name], first))
        first = int(parts[-1].block.max()) + 1
    own, left, block = (np.concatenate([getattr(p, k) for p in parts]) for k in ("own", "lacking", "block"))
    q, _ = np.linalg.qr(own / np.linalg.norm(own, axis=0))
    left = left - q @ (q.T @ left)
    names, shares, p = list(parts[0].groups), [], []
    for name in names:
        columns = np.concatenate([part.groups[name] for part in parts])
        columns = columns / (np.linalg.norm(columns, axis=0) + 1e-30)
        columns = columns - q @ (q.T @ columns)
        fit = columns @ np.linalg.lstsq(columns, left, rcond=1e-8)[0]
        shares.append(1 - float(((left - fit) ** 2).sum() / max((left**2).sum(), 1e-30)))
        # Each half of the blocks is tested with what the other one says, as a fit agrees with its own.
        scores = np.zeros(block.max() + 1)
        for half in (0, 1):
            here = block % 2 == half
            found = np.linalg.lstsq(columns[~here], left[~here], rcond=1e-8)[0]
            np.add.at(scores, block[here], left[here] * (columns[here] @ found))
        p.append(sign_flips(scores))
    rates = benjamini_hochberg(p, len(names))
    kept = [(n, s, float(r)) for n, s, r in zip(names, shares, rates, strict=True) if r <= RATE]
    return sorted(kept, key=lambda term: -term[1])


def learned(recording: Recording, before: dict[str, np.ndarray], noise: float) -> dict[str, float]:
    """Return which share of the squared gap above noise a residual network closes, on "train" and "test" trials."""
    torch.manual_seed(0)

    def batch(trials: Sequence[Trial]) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        inputs, errors, known = [], [], []
        for t in trials:
            x, dt = before[t.name], float(t.time[1] - t.time[0])
            v = np.gradient(x, dt, axis=0)
            held = x[:, t.gripped].mean(1, keepdims=True)
            of_held = [
                np.broadcast_to(np.gradient(y, dt, axis=0), x.shape) for y in (held, np.gradient(held, dt, axis=0))
            ]
            place = np.broadcast_to(t.marker_arclength[:, None], (*x.shape[:2], 1))
            state = np.concatenate([x - held, v, np.gradient(v, dt, axis=0), *of_held, place], -1)
            inputs.append(state[:, ~t.gripped])
            error = np.where(t.suspect[:, None, None], np.nan, t.markers - x)[:, ~t.gripped]
            errors.append(error)
            known.append(np.isfinite(error).all(-1))
        flat = [np.concatenate([y.reshape(-1, *y.shape[2:]) for y in z]) for z in (inputs, errors, known)]
        kept = flat[2].astype(bool)
        return *(torch.as_tensor(y[kept], dtype=torch.float32) for y in flat[:2]), torch.as_tensor(kept)

    x, y, _ = batch(recording.train)
    mean, spread, size = x.mean(0), x.std(0) + 1e-6, y.std()
    net = torch.nn.Sequential(
        torch.nn.Linear(x.shape[1], WIDTH),
        torch.nn.Tanh(),
        torch.nn.Linear(WIDTH, WIDTH),
        torch.nn.Tanh(),
        torch.nn.Linear(WIDTH, 3),
    )
    steps = torch.optim.Adam(net.parameters(), 3e-3, weight_decay=0.0)
    for _ in range(EPOCHS):
        rows = torch.randint(len(x), (2048,))
        loss = ((net((x[rows] - mean) / spread) - y[rows] / size) ** 2).mean()
        steps.zero_grad()
        loss.backward()
        steps.step()
    found = {}
    with torch.no_grad():
        for split, trials in (("train", recording.train), ("test", recording.test)):
            x, y, _ = batch(trials)
            old, new = (float((e**2).mean()) for e in (y, y - size * net((x - mean) / spread)))
            found[split] = (old - new) / max(old - noise**2, 1e-12)
    return found


def compare(path: Path, journal: Path, truth: list[str] | None) -> dict[str, Any]:
    """Return what all methods say of one recording."""
    result = diagnose(load_recording(path), workers=1, journal=journal, resume=(journal / "journal.json").exists())
    recording = result.model.recording
    before = result.predictions["before"]
    gaps, noise = result.gaps, result.floor.noise
    found = regress(recording, before)
    return {
        "recording": path.name,
        "hidden": truth,
        "gap_m": gaps[0],
        "diagnose": {
            "verdict": result.verdict,
            "named": result.effects,
            "closed_test": (gaps[0] ** 2 - gaps[1] ** 2) / max(gaps[0] ** 2 - noise**2, 1e-12),
        },
        "bic": bic(result, recording),
        "regression": [{"name": n, "share": s, "false_discovery_rate": r} for n, s, r in found],
        "network": learned(recording, before, noise),
    }


def main() -> None:
    """Compare the methods on recordings and print a table."""
    parser = Parser(__file__, description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("recordings", nargs="+", help="folders of recordings")
    parser.add_argument("--journals", default="runs/journals", help="folder that keeps what is simulated")
    parser.add_argument("--answers", default="", help="folder with NAME.json, whose `answer` says what is hidden")
    parser.add_argument("--out", default="runs/rivals.json")
    config = parser.parse_args()
    rows = []
    for path in map(Path, config.recordings):
        answer = Path(config.answers) / f"{path.name}.json"
        truth = json.loads(answer.read_text())["answer"] if config.answers and answer.exists() else None
        rows.append(compare(path, Path(config.journals) / path.name, truth))
        save(config.out, rows)
        print(f"{path.name}: done", flush=True)
    print(table(rows))


if __name__ == "__main__":
    main()
