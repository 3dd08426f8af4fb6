"""Overlaps of masks count where nothing hides the rope, and what hides it is found without help."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from torchdlo.report.pages.films_page import _shown, overlay_png
from torchdlo.sysid.estimation.result import Overlay
from torchdlo.sysid.recordings.recording import load_recording
from torchdlo.sysid.video.filming import centre_line, film_recording
from torchdlo.sysid.video.footage import views_of
from torchdlo.sysid.video.overlay import hidden_area, mask_overlaps
from torchdlo.vision.camera import looking_at
from torchdlo.vision.film import FilmLook

SAMPLE = Path(__file__).parents[2] / "torchdlo" / "data" / "sample_rope"


@pytest.fixture(scope="module")
def behind_a_bar(tmp_path_factory: pytest.TempPathFactory) -> tuple[SimpleNamespace, np.ndarray]:
    """The sample rope behind an upright bar, as a problem, and its true places (1, T, M, 3)."""
    camera = looking_at("a", [0.15, -1.35, 1.0], [0.0, 0.0, 0.88], focal=650.0)
    out = tmp_path_factory.mktemp("films") / "rope"
    known = load_recording(SAMPLE)
    film_recording(known, [camera], out, FilmLook(noise=1.0, bar=(0.47, 0.0, 0.51, 1.0)), trials=1, seconds=1.0)
    recording = load_recording(out)
    trial = recording.train[0]
    views, _ = views_of(recording, recording.train)
    line, place = centre_line(known.train[0], known.length)
    sims = CubicSpline(place, line[: len(trial.time)], axis=1)(trial.marker_arclength)
    step = float(trial.time[1] - trial.time[0])
    spines, model = SimpleNamespace(views=views, step=step), SimpleNamespace(recording=recording)
    return SimpleNamespace(trials=recording.train, spines=spines, model=model), sims[None]


def test_a_bar_in_front_of_the_rope_is_found(behind_a_bar) -> None:
    own, sims = behind_a_bar
    hidden = hidden_area(own, 0, sims, np.zeros(8))
    columns = np.flatnonzero(hidden.any(0))
    assert abs(columns[0] - 0.47 * 640) < 6 and abs(columns[-1] - 0.51 * 640) < 6
    (share, edges), *_ = mask_overlaps(own, sims, np.zeros(8))
    assert share > 0.9 and edges > 0.97


def test_a_wrong_rope_hides_nothing(behind_a_bar) -> None:
    own, sims = behind_a_bar
    assert not hidden_area(own, 0, sims + np.array([0.0, 0.0, 0.05]), np.zeros(8)).any()


def test_rectangles_that_are_left_out_of_masks_are_hidden(behind_a_bar) -> None:
    own, sims = behind_a_bar
    file = own.model.recording.path / "segment.json"
    file.write_text(json.dumps({"hue": [100, 180], "ignore": [[0.0, 0.0, 0.25, 0.5]]}))
    assert hidden_area(own, 0, sims + np.array([0.0, 0.0, 0.05]), np.zeros(8)).sum() == 160 * 240
    file.unlink()


def test_pictures_show_the_ropes_with_a_margin() -> None:
    picture = np.full((480, 640), 200, np.uint8)
    rope = np.stack([np.linspace(200, 400, 9), np.full(9, 100.0)], 1)
    sides, ends = _shown(Overlay("t", "test", picture, rope + np.array([0, 20]), rope))
    assert sides == pytest.approx((148.8, 451.2)) and ends == pytest.approx((48.8, 171.2))
    # What is not in the picture, or not known, does not count; without any rope all of it is shown.
    away = np.concatenate([rope, [[9e3, 9e3], [np.nan, np.nan]]])
    assert _shown(Overlay("t", "test", picture, away, away))[0] == pytest.approx((148.8, 451.2))
    lost = Overlay("t", "test", picture, away[-2:], away[-2:])
    assert _shown(lost) == ((-0.5, 639.5), (-0.5, 479.5))
    assert overlay_png([lost]).startswith(b"\x89PNG")
