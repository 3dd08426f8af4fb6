"""Colours become masks in uneven light; masks made elsewhere are read; wrong ones are taken out or refused."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.vision.scenes import front, hanging
from torchdlo.errors import InputError
from torchdlo.vision.camera import looking_at
from torchdlo.vision.film import Film, FilmLook, film, rope_coverage
from torchdlo.vision.mask_health import check_masks
from torchdlo.vision.segment import (
    Ranges,
    background_masks,
    color_masks,
    load_film,
    load_ranges,
    matted,
    ranges_of,
    save_masks,
    save_ranges,
)
from torchdlo.vision.video_file import read_video, write_video

COLORS = [(25, 150, 60), (200, 30, 30), (30, 60, 200), (238, 112, 12)]


def swinging(frames: int = 12, **look) -> Film:
    """A rope that swings a little."""
    time = np.linspace(0, 1, 31)
    points = hanging(31) + 0.1 * np.sin(5 * time)[:, None, None] * np.array([1.0, 0.0, 0.2])
    return film(front(), time, points, 0.007, FilmLook(**look), frames=frames)


@pytest.fixture(scope="module")
def plain() -> Film:
    return swinging()


@pytest.mark.parametrize("color", COLORS)
def test_colours_are_found_where_the_rope_is(color: tuple[int, int, int]) -> None:
    seen = swinging(2, color=color)
    found = color_masks(seen.pictures, ranges_of(color))
    both, either = (found & seen.masks).sum(), (found | seen.masks).sum()
    assert both / either > 0.8


def test_a_grey_rope_is_refused() -> None:
    with pytest.raises(InputError, match="stands out"):
        ranges_of((230, 230, 228))


def test_background_differences_find_the_rope(plain: Film) -> None:
    empty = np.full_like(plain.pictures[0], 195)
    found = background_masks(plain.pictures[:1], empty, 60, Ranges())
    assert (found & plain.masks[:1]).sum() / plain.masks[:1].sum() > 0.9


def test_masks_come_as_npz_as_png_files_and_as_a_film(plain: Film, tmp_path: Path) -> None:
    save_masks(plain.masks, tmp_path / "a.npz")
    write_video(tmp_path / "a.mp4", (255 * plain.masks).astype(np.uint8), 30.0)
    (tmp_path / "a").mkdir()
    for k, mask in enumerate(plain.masks):
        cv2.imwrite(str(tmp_path / "a" / f"{k:03d}.png"), 255 * mask.astype(np.uint8))
    for name, least in (("a.npz", 1.0), ("a", 1.0), ("a.mp4", 0.97)):
        masks, _ = load_film(tmp_path / name)
        assert masks.dtype == bool and masks.shape == plain.masks.shape
        assert (masks & plain.masks).sum() / (masks | plain.masks).sum() >= least
    write_video(tmp_path / "colour.mp4", plain.pictures, 30.0)
    pictures, fps = load_film(tmp_path / "colour.mp4")
    assert pictures.shape == plain.pictures.shape and pictures.dtype == np.uint8 and fps == pytest.approx(30)


def test_files_of_a_folder_are_read_by_their_numbers(tmp_path: Path) -> None:
    for k in range(12):
        cv2.imwrite(str(tmp_path / f"{k}.png"), np.repeat(np.arange(12) == k, 3)[None].repeat(9, 0) * np.uint8(255))
    masks, _ = load_film(tmp_path)
    assert masks[:, 0, ::3].argmax(1).tolist() == list(range(12))


def test_ranges_are_written_and_read_and_wrong_ones_refused(tmp_path: Path) -> None:
    path = tmp_path / "segment.json"
    save_ranges(ranges_of(COLORS[1]), path)
    assert load_ranges(path) == ranges_of(COLORS[1])
    for text, message in (('{"hue": [0, 400]}', "from 0 to 360"), ("[", "JSON"), ('{"colour": 1}', "unknown")):
        path.write_text(text)
        with pytest.raises(InputError, match=message):
            load_ranges(path)


def test_good_masks_pass(plain: Film) -> None:
    good, issues = check_masks(plain.masks, "film")
    assert good.all() and not issues


@pytest.mark.parametrize(
    ("kind", "spoil"),
    [
        ("empty", lambda m: m.__setitem__(5, False)),
        ("area", lambda m: m[5, :150, :300].__setitem__(np.s_[:], True)),
        ("frozen", lambda m: m.__setitem__(5, m[4])),
        ("elsewhere", lambda m: m.__setitem__(5, np.roll(m[5], (90, 120), (0, 1)))),
    ],
)
def test_wrong_frames_are_left_out(plain: Film, kind: str, spoil) -> None:
    masks = plain.masks.copy()
    spoil(masks)
    good, issues = check_masks(masks, "film")
    assert not good[5] and good.sum() == len(masks) - 1 and [i.kind for i in issues] == [kind]
    assert "frame 5" in issues[0].text


@pytest.mark.parametrize("at", [(5,), (5, 6)])
def test_repeats_that_a_codec_has_changed_are_left_out(plain: Film, at: tuple[int, ...]) -> None:
    masks, rng = plain.masks.copy(), np.random.default_rng(0)
    for k in at:
        masks[k] = masks[k - 1]
        edge = np.argwhere(masks[k] & ~np.roll(masks[k], 1, 0))
        masks[k][tuple(rng.permutation(edge)[:7].T)] = False
    assert tuple(np.flatnonzero(~check_masks(masks, "film")[0])) == at


@pytest.mark.parametrize("coloured", [False, True])
def test_repeats_of_a_rope_that_swings_are_left_out_while_its_grippers_rest(plain: Film, coloured: bool) -> None:
    masks, pictures, resting = plain.masks.copy(), plain.pictures.copy(), np.zeros(len(plain.masks), bool)
    for k in (5, 6, 9):
        masks[k], pictures[k] = masks[k - 1], pictures[k - 1]
    shown = {"pictures": pictures} if coloured else {}
    assert np.flatnonzero(~check_masks(masks, "film", moving=resting, **shown)[0]).tolist() == [5, 6, 9]
    # At rest, pictures are alike, and nothing is wrong with them.
    masks[:7], pictures[:7] = masks[0], pictures[0]
    assert np.flatnonzero(~check_masks(masks, "film", moving=resting, **shown)[0]).tolist() == [9]
    # Masks of a rope that turns round may be alike where pictures are not.
    pictures[9, 0, 0] ^= 1
    assert check_masks(masks, "film", moving=resting, pictures=pictures)[0].all()


def test_second_blobs_and_ropes_that_leave_the_picture_are_said(plain: Film) -> None:
    masks = plain.masks.copy()
    masks[:, 20:60, 20:60] = True
    assert [i.kind for i in check_masks(masks, "film")[1]] == ["blobs"]
    assert [i.kind for i in check_masks(np.roll(plain.masks, 250, 2), "film")[1]][-1] == "edge"


def test_a_camera_that_slips_is_found(plain: Film) -> None:
    pictures = plain.pictures.copy()
    pictures[8:] = np.roll(pictures[8:], (7, 15), (1, 2))
    good, issues = check_masks(plain.masks, "film", pictures=pictures)
    assert good[:8].all() and not good[8:].any() and issues[-1].kind == "slip"
    assert check_masks(plain.masks, "film", pictures=plain.pictures)[0].all()


@pytest.mark.parametrize("far", [0, 15])
def test_grippers_that_move_are_not_a_camera_that_slips(plain: Film, far: int) -> None:
    # The whole picture correlates with what is dark and moves in it: a shift that is none of the camera's.
    pictures = plain.pictures.copy()
    for k, picture in enumerate(pictures):
        way = 2 * min(k, 8)
        for x in (60, 500):
            picture[60 + way : 80 + way, x + 2 * way : x + 2 * way + 40] = 70
    pictures[8:] = np.roll(pictures[8:], (far // 2, far), (1, 2))
    issues = check_masks(plain.masks, "film", pictures=pictures)[1]
    assert ("slip" in {i.kind for i in issues}) == bool(far)


@pytest.mark.parametrize(
    ("masks", "message"),
    [
        (np.zeros((9, 20, 30), bool), "never visible"),
        (np.ones((9, 20, 30), bool), "background has the rope's colour"),
        (np.repeat(np.eye(30, dtype=bool)[None, :20], 9, 0), "at least half"),
    ],
)
def test_masks_that_say_nothing_are_refused(masks: np.ndarray, message: str) -> None:
    with pytest.raises(InputError, match=message):
        check_masks(masks, "film")


def _uneven(path: Path) -> None:
    import av

    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30)
        stream.width = stream.height = 64
        stream.pix_fmt = "yuv420p"
        stream.codec_context.time_base = stream.time_base = __import__("fractions").Fraction(1, 1000)
        time = 0
        for k in range(20):
            frame = av.VideoFrame.from_ndarray(np.full((64, 64, 3), 10 * k, np.uint8), format="rgb24")
            frame.pts, time = time, time + (20 if k % 3 else 47)
            frame.time_base = stream.time_base
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda p: None, "nothing there"),
        (lambda p: p.write_bytes(b""), "empty file"),
        (lambda p: p.write_bytes(b"not a film" * 100), "can be decoded"),
        (_uneven, "constant frame rate"),
    ],
)
def test_films_that_cannot_be_read_are_refused(tmp_path: Path, make, message: str) -> None:
    make(tmp_path / "x.mp4")
    with pytest.raises(InputError, match=message) as caught:
        read_video(tmp_path / "x.mp4")
    assert str(tmp_path / "x.mp4") in str(caught.value)


def test_edges_of_masks_are_where_half_a_pixel_is_covered(tmp_path: Path) -> None:
    camera = looking_at("a", [0.0, -1.0, 0.0], [0.0, 0.0, 0.0], size=(320, 240), focal=400.0)
    x = np.linspace(-0.3, 0.3, 61)
    line = np.stack([x, 0 * x, 0.08 * np.sin(9 * x)], 1)
    cover = rope_coverage(camera, line, 0.006)[..., None]
    picture = (cover * np.array([25, 150, 60]) + (1 - cover) * np.array([196, 194, 190])).round().astype(np.uint8)
    write_video(tmp_path / "film.mp4", np.stack([picture] * 6), 30.0)
    stored, _ = read_video(tmp_path / "film.mp4")
    found, true = color_masks(stored, ranges_of((25, 150, 60)))[-1], cover[..., 0] > 0.5
    # Ranges of colours alone come to 0.9: the film has hue at half of its size.
    assert (found & true).sum() / (found | true).sum() > 0.93
    assert found.sum() == pytest.approx(true.sum(), rel=0.05)


def test_a_mask_stays_where_there_is_no_contrast() -> None:
    mask = np.zeros((40, 60), bool)
    mask[15:22, 10:50] = True
    assert (matted(np.full((40, 60, 3), 90, np.uint8), mask) == mask).all()
    assert not matted(np.full((40, 60, 3), 90, np.uint8), mask & False).any()
