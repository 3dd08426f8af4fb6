"""Gradients of pictures are those of finite differences, and masks of a rope with a soft spot are met by them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.sysid.test_films import SAMPLE, view_of_sample
from torchdlo.errors import InputError
from torchdlo.sysid.calibration.calibrate import calibrate
from torchdlo.sysid.model.trial_batch import Start
from torchdlo.sysid.recordings.recording import load_recording
from torchdlo.sysid.video.filmed_problem import FilmedProblem, filmed_problem
from torchdlo.sysid.video.filming import film_recording
from torchdlo.sysid.video.footage import views_of
from torchdlo.sysid.video.overlay import drawn_masks
from torchdlo.sysid.video.picture_gradient import descend, picture_loss, simulated, with_profile
from torchdlo.vision.film import FilmLook


@pytest.fixture(scope="module")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> FilmedProblem:
    """A tenth of a second of the sample rope, as masks; read only."""
    out = tmp_path_factory.mktemp("gradient") / "rope"
    film_recording(
        load_recording(SAMPLE), [view_of_sample(fps=80.0)], out, FilmLook(noise=0.0), masks=True, trials=1, seconds=0.08
    )
    recording = load_recording(out)
    views, _ = views_of(recording, recording.train)
    return filmed_problem(recording, recording.train, views, options={"vertices": 21})


@pytest.mark.parametrize("resting", [False, True])
def test_the_gradient_is_that_of_finite_differences(filmed: FilmedProblem, resting: bool) -> None:
    begin = replace(filmed.start, still=np.full(1, resting))
    own = replace(filmed, start=begin, offset=np.zeros((1, 0)))
    numbers = torch.as_tensor(own.model.guess())
    numbers[0] = 1e-2  # of a soft rope hardly anything shows so soon but what is rounded off
    cameras = torch.zeros(len(own.spines.nuisances.names), dtype=torch.float64)
    bend = torch.ones(len(own.model.arclength), dtype=torch.float64, requires_grad=True)
    loss = picture_loss(own, numbers, cameras, bend=bend, converged=True)
    (gradient,) = torch.autograd.grad(loss, bend)
    assert gradient.isfinite().all() and (gradient != 0).sum() > 10
    way = gradient / gradient.norm()
    errors = []
    with torch.no_grad():
        for step in (1e-5, 3e-6):  # larger ones move edges of tubes across pixels, where the loss has kinks
            down, up = (picture_loss(own, numbers, cameras, bend=bend + k * way, converged=True) for k in (-step, step))
            found = float(up - down) / (2 * step)
            errors.append(abs(found / float(gradient.norm()) - 1))
    assert min(errors) < 1e-5, errors


def test_it_moves_as_fits_do(filmed: FilmedProblem) -> None:
    row = filmed.model.guess()
    expected = filmed.simulate(np.concatenate([row, np.zeros(len(filmed.spines.nuisances.names))])[None])[0]
    with torch.no_grad():
        found = simulated(filmed, torch.as_tensor(row)).numpy()
    assert np.abs(found - expected).max() < 1e-9


def test_markers_have_no_masks_to_follow() -> None:
    with pytest.raises(InputError, match="gradient for films only"):
        calibrate(load_recording(SAMPLE), method="gradient")


@pytest.mark.slow
def test_masks_of_a_rope_with_a_soft_spot_are_met(tmp_path: Path) -> None:
    out = tmp_path / "rope"
    options = {"masks": True, "trials": 1, "seconds": 0.08}
    film_recording(load_recording(SAMPLE), [view_of_sample(fps=80.0)], out, FilmLook(noise=0.0), **options)
    recording = load_recording(out)
    views, _ = views_of(recording, recording.train)
    plain = filmed_problem(recording, recording.train, views, options={"vertices": 21})
    plain.start = Start(plain.start.pos, plain.start.vel, np.ones(1, bool))
    plain.offset = np.zeros((1, 0))
    own = with_profile(plain)
    place = np.linspace(0, 1, 16)
    soft = -1.2 * np.exp(-0.5 * ((place - 0.4) / 0.1) ** 2)
    count = len(plain.free)
    own.fixed[0] = 6e-3
    truth = np.concatenate([own.fixed[list(own.free)], np.zeros(len(own.spines.nuisances.names))])
    start = truth.copy()
    truth[count : count + 16] = soft
    # Films of the true rope, by the same rasteriser.
    sims = own.simulate(truth[None])[0]
    frames = np.arange(len(views[0].good[0]))
    drawn = drawn_masks(own, 0, sims[0], 0 * truth[len(own.free) :], frames, views[0].half_width, 0) > 0.5
    packed = np.packbits(drawn.reshape(len(drawn), -1), axis=1)
    own.spines.views = (replace(views[0], packed=(packed,)),)
    losses = []
    descend(own, own.space.to_raw(start), 8, lambda *said: losses.append(float(said[3])))
    assert losses[-1] < 0.25 * losses[0]
