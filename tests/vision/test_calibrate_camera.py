"""Boards that were drawn with a known camera give that camera again."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from torchdlo.errors import InputError
from torchdlo.vision import calibrate_camera as calibration
from torchdlo.vision.calibrate_camera import Board, board_picture, calibrate_camera, error_picture
from torchdlo.vision.video_file import read_video, write_video

MATRIX = np.array([[520.0, 0, 310], [0, 525.0, 235], [0, 0, 1]])
BOARDS = [Board(8, 6, 0.03), Board(8, 6, 0.03, 0.022)]


def filmed(board: Board, path: Path, frames: int = 14, tilt: float = 0.45) -> None:
    """A film of the board, turned this way and that by up to `tilt` about each axis [rad]."""
    rng = np.random.default_rng(0)
    flat = board_picture(board, 80)
    pictures = []
    for k in range(frames):
        turn = cv2.Rodrigues(np.array([np.pi, 0, 0]))[0]  # its z axis towards the camera
        turn = cv2.Rodrigues(rng.uniform(-tilt, tilt, 3) * (k > 0))[0] @ turn
        centre = np.array([0.03 * 4, -0.03 * 3, 0.0])
        shift = np.array([*rng.uniform(-0.06, 0.06, 2), 0.42 + 0.1 * rng.random()]) - turn @ centre
        # A pixel of the board's picture is a place on the board: its first inner corner is the origin.
        scale = 0.03 / 80
        place = np.array([[scale, 0, -1.5 * 0.03 + scale / 2], [0, -scale, 1.5 * 0.03 - scale / 2], [0, 0, 1]])
        homography = MATRIX @ np.column_stack([turn[:, 0], turn[:, 1], shift]) @ place
        shown = cv2.warpPerspective(flat, homography, (640, 480), flags=cv2.INTER_AREA, borderValue=150)
        pictures.append(np.repeat(cv2.GaussianBlur(shown, (0, 0), 0.7)[..., None], 3, 2))
    write_video(path, np.stack(pictures), 30.0, quality=10)


@pytest.mark.parametrize("board", BOARDS, ids=["checkerboard", "charuco"])
def test_a_known_camera_is_found_again(board: Board, tmp_path: Path) -> None:
    filmed(board, tmp_path / "board.mp4")
    found = calibrate_camera(tmp_path / "board.mp4", board, name="left")
    camera = found.camera
    assert found.error < 0.3 and camera.name == "left" and (camera.width, camera.height) == (640, 480)
    assert camera.fx == pytest.approx(520, rel=0.01) and camera.fy == pytest.approx(525, rel=0.01)
    assert camera.cx == pytest.approx(310, abs=5) and camera.cy == pytest.approx(235, abs=5)
    # In the first picture the board faces the camera: its z axis points to it.
    assert camera.rotation[2][2] < -0.99 and 0.3 < camera.translation[2] < 0.6
    assert np.array_equal(found.picture, read_video(tmp_path / "board.mp4")[0][found.pictures[0]])
    assert error_picture(found).startswith(b"\x89PNG")


@pytest.mark.parametrize("frames", [6, 14])
def test_a_board_that_is_only_moved_tells_no_focal_length(frames: int, tmp_path: Path) -> None:
    filmed(BOARDS[0], tmp_path / "board.mp4", frames, tilt=0.01)
    with pytest.raises(InputError, match="tilted to several sides, found one from which no focal length follows"):
        calibrate_camera(tmp_path / "board.mp4", BOARDS[0])


def test_a_board_that_is_tilted_little_tells_how_uncertain_the_focal_length_is(tmp_path: Path) -> None:
    filmed(BOARDS[0], tmp_path / "board.mp4", 6, tilt=0.2)
    found = calibrate_camera(tmp_path / "board.mp4", BOARDS[0])
    assert abs(found.camera.fx / 520 - 1) < 0.05
    assert any("The focal length is uncertain by 2%" in note for note in found.notes)


def test_a_film_without_a_board_is_refused(tmp_path: Path) -> None:
    write_video(tmp_path / "grey.mp4", np.full((10, 120, 160), 128, np.uint8), 30.0)
    with pytest.raises(InputError, match="found it in 0 of 10"):
        calibrate_camera(tmp_path / "grey.mp4", BOARDS[0])


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"square": float("inf")}, "square: expected"),
        ({"square": 25.0}, "in m, such as 0.025, found 25"),
        ({"square": 0.025, "marker": 0.03}, "smaller than a square's"),
        ({"columns": 40, "rows": 40, "marker": 0.02}, "at most 50 markers"),
        ({"marker": 0.02, "dictionary": "CORNER_REFINE_NONE"}, "a name that OpenCV knows"),
        ({"marker": 0.02, "dictionary": "DICT_5X5_5000"}, "a name that OpenCV knows"),
    ],
)
def test_boards_that_cannot_be_are_refused(given: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        board_picture(Board(**{"columns": 9, "rows": 6, "square": 0.03} | given), 20)


def test_pictures_with_one_row_of_corners_are_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    filmed(BOARDS[1], tmp_path / "board.mp4", 8)
    find, seen = calibration._charuco_finder(BOARDS[1]), []

    def some(grey: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        at, corners = find(grey)
        seen.append(at)
        if len(seen) > 2:
            return at, corners
        # The second row alone, and with one corner beside it: neither says how the board is tilted.
        rows = np.isin(at, [*range(7, 14), *([0] if len(seen) == 2 else [])])
        return at[rows], corners[rows]

    monkeypatch.setattr(calibration, "_charuco_finder", lambda board: some)
    found = calibrate_camera(tmp_path / "board.mp4", BOARDS[1])
    assert found.pictures == (2, 3, 4, 5, 6, 7) and found.error < 0.3
    monkeypatch.setattr(calibration, "_flat", lambda points: True)
    seen.clear()
    with pytest.raises(InputError, match="from several sides"):
        calibrate_camera(tmp_path / "board.mp4", BOARDS[1])
