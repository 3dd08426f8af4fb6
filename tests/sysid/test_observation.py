"""Readings of films are lengths: none at the truth, as long as a rope is moved, and undone by the camera's numbers."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from tests.vision.scenes import front, hanging
from torchdlo.sysid.estimation import levenberg_marquardt
from torchdlo.sysid.estimation.observation import FilmView, MarkerObservation, Spines, nuisances, over_time, own_clocks
from torchdlo.sysid.video.filmed_problem import FilmedProblem
from torchdlo.vision.camera import lens, looking_at, project
from torchdlo.vision.film import FilmLook, film, off_camera
from torchdlo.vision.spine import spine

STEP, PLACES = 0.02, 41


def motion() -> np.ndarray:
    """Places of a rope that swings, (1, 1, T, M, 3) [m]."""
    time = np.arange(26) * STEP
    swing = (
        0.12
        * np.sin(6 * time)[:, None, None]
        * np.array([0.6, 0.2, 0.5])
        * np.sin(np.linspace(0, np.pi, PLACES))[:, None]
    )
    return (hanging(PLACES) + swing)[None, None]


def seen(camera, sims: np.ndarray) -> FilmView:
    """What a camera sees of it."""
    masks = film(camera, np.arange(26) * STEP, sims[0, 0], 0.006, FilmLook(exposure=0.0), frames=14).masks
    lines = [spine(m, 48) for m in masks]
    places, tangents = (np.stack(part)[None] for part in zip(*lines, strict=True))
    return FilmView(camera, np.ones((1, 14), bool), places, tangents, 3.2)


@pytest.fixture(scope="module")
def filmed() -> tuple[np.ndarray, FilmView]:
    sims = motion()
    return sims, seen(front(), sims)


def size(found: np.ndarray, target: np.ndarray) -> float:
    """Root mean square of readings that were made [m]."""
    return float(np.sqrt(np.mean(found[np.broadcast_to(np.isfinite(target), found.shape)] ** 2)))


def none(observation) -> np.ndarray:
    return np.zeros((1, len(observation.nuisances.names)))


def test_readings_of_the_truth_are_parts_of_a_pixel(filmed: tuple[np.ndarray, FilmView]) -> None:
    sims, view = filmed
    spines = Spines([view], STEP, 0.7, np.ones(PLACES, bool))
    assert size(spines.read(sims, none(spines)), spines.target) < 4e-4  # a pixel is 1.9 mm


@pytest.mark.parametrize("far", [2e-3, 2e-2])
def test_readings_are_as_long_as_the_rope_is_moved(filmed: tuple[np.ndarray, FilmView], far: float) -> None:
    sims, view = filmed
    spines = Spines([view], STEP, 0.7, np.ones(PLACES, bool))
    # The middle of the rope is level: moved up, it is that far away.
    moved = sims + np.array([0.0, 0.0, far])
    found = np.where(np.isfinite(spines.target), spines.read(moved, none(spines))[0], np.nan)
    across = found[0, 0, 96 + PLACES // 2, 0]
    assert abs(abs(across) - far) < 0.12 * far + 3e-4


def test_what_a_camera_is_off_is_undone_by_its_numbers(filmed: tuple[np.ndarray, FilmView]) -> None:
    sims, view = filmed
    spines = Spines(
        [replace(view, camera=off_camera(view.camera, np.random.default_rng(3)))], STEP, 0.7, np.ones(PLACES, bool)
    )
    space = spines.nuisances

    def simulate(values: np.ndarray) -> np.ndarray:
        return spines.read(np.repeat(sims, len(values), 0), values)

    points = levenberg_marquardt.evaluate(simulate, spines.target, space, np.zeros((1, 8)), 0.7)
    before = points[0].cost
    for points in levenberg_marquardt.improve_points(simulate, spines.target, space, points, iterations=12, whole=0.7):  # noqa: B007, B020
        pass
    assert points[0].cost < 0.03 * before
    true, found = view.camera.start, spines.views[0].camera.start + space.to_values(points[0].raw)[7]
    assert abs(found - true) < 2e-3  # half a frame is 17 ms


def both_late(sims: np.ndarray, late: tuple[float, float]) -> FilmView:
    """Films of the same motion twice, each begun at its own time, and by a camera that does not know of it."""
    views = [seen(front(start=start), sims) for start in late]
    parts = {n: np.concatenate([getattr(v, n) for v in views]) for n in ("good", "places", "tangents")}
    return replace(views[0], camera=front(), **parts, **own_clocks(["train_0", "train_1"]))


def test_each_film_has_a_clock_of_its_own(filmed: tuple[np.ndarray, FilmView]) -> None:
    sims = np.repeat(filmed[0], 2, 1)
    view = both_late(filmed[0], (0.012, 0.0))
    spines = Spines([view], STEP, 0.7, np.ones(PLACES, bool))
    names = spines.nuisances.names
    assert names[-2:] == ("camera_a.clock.train_0", "camera_a.clock.train_1") and view.numbers == 9
    numbers = np.zeros((2, 9))
    numbers[1, 7] = 0.012
    wrong, right = np.where(np.isfinite(spines.target), spines.read(np.repeat(sims, 2, 0), numbers), np.nan)
    ends = spines.priors.start
    error = [np.sqrt(np.nanmean(x[..., :ends, :] ** 2, (1, 2, 3))) for x in (wrong, right)]
    assert error[0][0] > 4 * error[1][0] and error[1].max() < 4e-4
    assert error[0][1] == error[1][1]
    # Picked twice, trials keep their clocks; what is known of a film beforehand is the same as what is fitted.
    again = view.picked(np.array([1, 0, 0]))
    assert again.clock.tolist() == [1, 0, 0] and again.numbers == 9
    known = replace(view, late=np.array([0.012, 0.0]))
    given = Spines([known], STEP, 0.7, np.ones(PLACES, bool)).read(sims, np.zeros((1, 9)))
    assert np.allclose(given[..., :ends, :][:, :, :, :], spines.read(sims, numbers[1:])[..., :ends, :], atol=1e-6)
    assert np.allclose(known.time[0] - known.time[1], 0.012)


def test_first_seconds_end_by_the_clock_of_each_film(filmed: tuple[np.ndarray, FilmView]) -> None:
    view = replace(both_late(filmed[0], (0.0, 0.0)), late=np.array([0.0, 0.1]))
    short = view.shortened(0.2)
    assert short.good.shape == (2, 7) and np.isfinite(short.places).any((2, 3)).sum(1).tolist() == [7, 4]
    spines = Spines([view], STEP, 0.7, np.ones(PLACES, bool))
    assert spines.times.shape == spines.target.shape[:3] and spines.times[1, 0, 0] == pytest.approx(0.1)
    short.good[1, 2] = False
    assert not view.good[1, 2]  # what is found wrong later is so in both


def test_priors_pull_where_nothing_else_does(filmed: tuple[np.ndarray, FilmView]) -> None:
    _, view = filmed
    space = nuisances([view])
    assert len(space.names) == 8 and space.names[-1] == "camera_a.clock" and space.units[-1] == pytest.approx(1 / 60)
    spines = Spines([view], STEP, 0.7, np.ones(PLACES, bool))
    found = spines.read(motion(), space.units[None])
    priors = found[0, 0, :8, -2 * 8 :, 0]
    assert (priors > 0).all() and np.allclose(priors, priors[0, 0])
    assert np.isfinite(spines.target[0, :8, -16:]).all() and np.isnan(spines.target[0, 8:, -16:]).all()


def test_changes_are_those_of_readings(filmed: tuple[np.ndarray, FilmView]) -> None:
    sims, view = filmed
    spines = Spines([view], STEP, 0.7, np.ones(PLACES, bool))
    moved = np.concatenate([sims, sims + 1e-4 * np.array([0.3, 0.2, 0.9]), sims])
    numbers = np.zeros((3, 8))
    numbers[2, 7] = 1e-4
    known = np.isfinite(spines.target)
    exact, fast = (np.where(known, x, 0.0) for x in (spines.read(moved, numbers), spines.changes(moved, numbers)))
    assert np.allclose(fast[0], exact[0], atol=1e-7)
    for k in (1, 2):
        exact_change, fast_change = ((x[k] - x[0])[known] for x in (exact, fast))
        # But for the few points whose neighbour changes, which jump.
        assert np.quantile(np.abs(fast_change - exact_change), 0.95) < 0.02 * np.abs(exact_change).max()


def test_motions_are_read_together_as_they_are_alone(filmed: tuple[np.ndarray, FilmView]) -> None:
    sims, view = filmed
    spines = Spines(
        [view, seen(looking_at("b", (0.9, 1.1, 0.3), (0, 0, -0.2), focal=500.0), sims)],
        STEP,
        0.7,
        np.ones(PLACES, bool),
    )
    rng = np.random.default_rng(0)
    motions = sims + 1e-3 * rng.normal(size=(5, 1, 26, 1, 3))
    numbers = 1e-3 * rng.normal(size=(5, len(spines.nuisances.names)))
    pairs = spines.paired(sims, none(spines))[1]
    alone = [spines.beside(pairs, motions[k : k + 1], numbers[k : k + 1]) for k in range(5)]
    np.testing.assert_allclose(spines.beside(pairs, motions, numbers), np.concatenate(alone), rtol=1e-5, atol=1e-8)
    assert spines.beside(pairs, motions[:0], numbers[:0]).shape == (0, *spines.target.shape)


def test_markers_are_an_observation_too() -> None:
    markers = MarkerObservation(np.zeros((1, 2, 3, 3)), 1.0)
    sims = np.ones((2, 1, 2, 3, 3))
    assert markers.read(sims, np.zeros((2, 0))) is sims and not markers.nuisances.names


def test_interpolation_in_time_is_cubic_and_stays_within_the_motion() -> None:
    time = torch.arange(11, dtype=torch.float64) * 0.1
    sims = (time**2)[None, None, :, None, None].expand(1, 1, 11, 2, 3)
    at = torch.tensor([[[0.0, 0.23, 0.5, 0.77, -1.0, 9.0]]], dtype=torch.float64)
    found = over_time(sims, 0.1, at)[0, 0, :, 0, 0]
    torch.testing.assert_close(found[1:4], at[0, 0, 1:4] ** 2)
    assert float(found[4]) == 0.0 and float(found[5]) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("start", "fps"), [((0.0, 0.0), (30.0, 30.0)), ((0.0, 0.5), (30.0, 30.0)), ((0.5, 0.0), (60.0, 30.0))]
)
def test_readings_of_the_first_seconds_are_within_what_is_simulated(
    start: tuple[float, float], fps: tuple[float, float]
) -> None:
    places, step, lasts, seconds = np.linspace(-0.3, 0.3, PLACES), 0.01, 2.0, 0.7

    def rope(time: np.ndarray) -> np.ndarray:
        level = np.broadcast_to(places, (len(time), PLACES))
        return np.stack([level, 0 * level, 0.3 * np.sin(2 * time)[:, None] + 0 * level], -1)

    views = []
    for name, begin, rate in zip("ab", start, fps, strict=True):
        camera = looking_at(name, [0.0, -1.5, 0.0], [0.0, 0.0, 0.0], fps=rate, start=begin)
        time = begin + np.arange(int((lasts - begin) * rate)) / rate
        pixel = project(lens([camera]), torch.as_tensor(rope(time)))[0].numpy()
        tangent = np.zeros_like(pixel)
        tangent[..., 0] = 1.0
        views.append(FilmView(camera, np.ones((1, len(time)), bool), pixel[None], tangent[None], 3.0))
    spines = Spines(views, step, 0.6, np.ones(PLACES, bool))
    sims = rope(np.arange(round(lasts / step) + 1) * step)[None, None]
    own = FilmedProblem.__new__(FilmedProblem)
    own.spines, own.model = spines, SimpleNamespace(dt=step)
    own.motion = SimpleNamespace(markers=np.zeros((1, sims.shape[2], PLACES, 3)))
    read = spines.read(sims[:, :, : own.frames(seconds)], none(spines))[0, ..., 0]
    seen = np.isfinite(own.target(seconds)[..., : spines.priors.start])
    assert np.abs(read[..., : spines.priors.start][seen]).max() < 2e-4  # a frozen rope is up to 75 mm away
    pictures = sum(int((v.time <= seconds).sum()) for v in views)
    assert seen[:, :, :].any(2).sum() >= pictures / 2 and seen.sum() == pictures * 3 * PLACES
