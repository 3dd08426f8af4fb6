"""A calibrated camera from a film of a printed board: checkerboard or ChArUco, detected and fitted by OpenCV.

The board in the first picture in which it is found gives the world: its origin is the board's first corner, x runs
along the rows of the board, y up along its columns, z out of the board.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from torchdlo.errors import InputError
from torchdlo.vision.camera import Camera, triple
from torchdlo.vision.video_file import film_rate, some_pictures

__all__ = ["Board", "Calibrated", "board_picture", "calibrate_camera", "error_picture"]

_MOST = 40
"""Pictures that are used."""

_FEWEST = 4
"""Pictures that are needed."""

_CORNERS = 6
"""Corners that a picture needs."""


_LARGEST = 1.0
"""Side of a square from which it is not in metres [m]."""

_TILTED = 3.0
"""How far boards have to be turned against each other for the focal length to be known [degrees]: boards that are all
seen from the same side look alike to a longer lens farther away."""

_NARROW, _WIDE = 3.0, 150.0
"""Angles of view along a picture that no camera of ropes has [degrees]: where the focal length is not known."""

_KNOWN, _UNKNOWN = 0.01, 0.1
"""Standard deviation of the focal length, as a share, that fits to films take it to have, and from which it is not
known."""


@dataclass(frozen=True)
class Board:
    """A printed board."""

    columns: int
    """Squares along a row."""
    rows: int
    """Squares along a column."""
    square: float
    """Side of a square [m]."""
    marker: float | None = None
    """Side of a marker [m], of ChArUco; None for a checkerboard."""
    dictionary: str = "DICT_4X4_50"
    """Markers of ChArUco, as OpenCV calls them."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.square) and self.square > 0):
            raise InputError(f"square: expected the side of a square in m, found {self.square:g}.")
        if self.square > _LARGEST:
            raise InputError(f"square: expected the side of a square in m, such as 0.025, found {self.square:g}.")
        if self.marker is not None and not 0 < self.marker < self.square:
            raise InputError(
                f"marker: expected the side of a marker in m, smaller than a square's of {self.square:g}, found "
                f"{self.marker:g}."
            )

    def charuco(self):
        """Return OpenCV's board of markers."""
        import cv2

        number = getattr(cv2.aruco, self.dictionary, None) if self.dictionary.startswith("DICT_") else None
        if number is None:
            raise InputError(
                f"dictionary: expected a name that OpenCV knows, such as DICT_4X4_50, found {self.dictionary}."
            )
        words = cv2.aruco.getPredefinedDictionary(number)
        needed, known = self.columns * self.rows // 2, len(words.bytesList)
        if needed > known:
            raise InputError(
                f"board: expected at most {known} markers, as {self.dictionary} has, found {needed} on {self.columns} "
                f"x {self.rows} squares; choose fewer squares or another --dictionary, such as DICT_4X4_1000."
            )
        return cv2.aruco.CharucoBoard((self.columns, self.rows), self.square, self.marker, words)

    def corners(self) -> np.ndarray:
        """Return the inner corners, row by row as OpenCV orders them, with y up [m], shape (N, 3)."""
        x, y = np.meshgrid(np.arange(self.columns - 1), np.arange(self.rows - 1))
        return np.stack([x.ravel() * self.square, -y.ravel() * self.square, 0.0 * x.ravel()], 1)


@dataclass(frozen=True, eq=False)
class Calibrated:
    """A camera and how well it explains the film."""

    camera: Camera
    error: float
    """Root mean square distance of corners from where the camera has them [px]."""
    pictures: tuple[int, ...]
    """Pictures of the film that were used; the first one gives the world."""
    found: tuple[np.ndarray, ...]
    """Corners in those [px], shape (N, 2) each."""
    modelled: tuple[np.ndarray, ...]
    """Where the camera has them [px], likewise."""
    notes: tuple[str, ...]
    """What a reader should know."""
    picture: np.ndarray
    """The first picture of those, RGB uint8, shape (H, W, 3)."""


def calibrate_camera(
    path: Path, board: Board, *, name: str = "a", callback: Callable[[str, int, int, str], None] | None = None
) -> Calibrated:
    """Fit a camera to a film of a board.

    Args:
        path: the film.
        board: what was printed.
        name: of the camera.
        callback: told (stage, pictures done, in all, message).

    Raises:
        InputError: The film cannot be read, or shows the board too rarely.
    """
    import cv2

    report = callback or (lambda *_: None)
    fps, model = film_rate(path)[0], board.corners()
    seen, picture = _seen(path, board, report)
    height, width = picture.shape[:2]
    objects = [model[at].astype(np.float32)[:, None] for _, at, _ in seen]
    images = [corners.astype(np.float32)[:, None] for *_, corners in seen]
    try:
        # Its stubs do not know that what is to be found may be None.
        fitted = cv2.calibrateCameraExtended(objects, images, (width, height), None, None)  # type: ignore[call-overload]
    except cv2.error:
        raise InputError(
            f"{path}: expected pictures of a board that tell where the camera is, but those {len(seen)} in which it "
            "was found do not; film all of it, from several sides."
        ) from None
    error, matrix, lens, turns, shifts = fitted[:5]
    normals = np.array([cv2.Rodrigues(r)[0][:, 2] for r in turns])
    unsure = float(fitted[5].ravel()[0] / matrix[0, 0])
    _check_focal(path, normals, unsure, float(matrix[0, 0]), width)
    report("fitting the camera", 1, 1, f"{error:.2f} px")
    modelled = tuple(
        cv2.projectPoints(o, r, t, matrix, lens)[0][:, 0] for o, r, t in zip(objects, turns, shifts, strict=True)
    )
    rotation = cv2.Rodrigues(turns[0])[0]
    camera = Camera(
        name,
        width,
        height,
        float(matrix[0, 0]),
        float(matrix[1, 1]),
        float(matrix[0, 2]),
        float(matrix[1, 2]),
        tuple(map(triple, rotation)),
        triple(shifts[0].ravel()),
        tuple(map(float, lens.ravel()[:5])),
        fps,
    )
    return Calibrated(
        camera,
        float(error),
        tuple(k for k, *_ in seen),
        tuple(i[:, 0] for i in images),
        modelled,
        tuple(_notes(float(error), unsure, images, width, height)),
        picture,
    )


def _seen(
    path: Path, board: Board, report: Callable[[str, int, int, str], None]
) -> tuple[list[tuple[int, np.ndarray, np.ndarray]], np.ndarray]:
    """Return pictures of a film in which a board is found, and the first one itself, RGB (H, W, 3).

    Of each are its number, the numbers of corners, and where those are [px], (N, 2).
    """
    import cv2

    find = _charuco_finder(board) if board.marker is not None else _checkerboard_finder(board)
    model = board.corners()
    tried, pictures = some_pictures(path, 3 * _MOST)
    seen: list[tuple[int, np.ndarray, np.ndarray]] = []
    first = np.empty((0, 0, 3), np.uint8)
    for done, (k, picture) in enumerate(pictures):
        at, corners = find(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY))
        if len(at) >= _CORNERS and _flat(model[at]):
            first = first if seen else picture
            seen.append((k, at, corners))
        report("finding the board", done + 1, tried, f"in {len(seen)} pictures")
    if len(seen) < _FEWEST:
        kind = "checkerboard" if board.marker is None else f"ChArUco board ({board.dictionary})"
        raise InputError(
            f"{path}: expected a {kind} of {board.columns} x {board.rows} squares in at least {_FEWEST} pictures, "
            f"found it in {len(seen)} of {tried}; check the numbers of squares, and film it large and sharp."
        )
    if len(seen) > _MOST:
        seen = [seen[k] for k in np.linspace(0, len(seen) - 1, _MOST).round().astype(int)]
    return seen, first


def _flat(points: np.ndarray) -> bool:
    """Return whether points of a board (N, 3) tell its place: not if all of them, or all but one, are on a line."""
    rest = [np.delete(points[:, :2], k, 0) for k in range(len(points))]
    return min(np.linalg.svd(x - x.mean(0), compute_uv=False)[1] for x in rest) > 1e-6 * np.ptp(points)


def _check_focal(path: Path, normals: np.ndarray, unsure: float, focal: float, width: int) -> None:
    """Refuse boards, with these normals (N, 3), from which no focal length [px] follows."""
    mean = normals.mean(0) / np.linalg.norm(normals.mean(0))
    spread = float(np.degrees(np.arccos(np.clip(normals @ mean, -1, 1)).max()))
    angle = 2 * math.degrees(math.atan(0.5 * width / focal))
    if spread < _TILTED or not _NARROW < angle < _WIDE or not unsure < _UNKNOWN:
        raise InputError(
            f"{path}: expected a board that is tilted to several sides, found one from which no focal length follows "
            f"(the fit says {focal:.0f} px); tilt it by 20 to 40 degrees."
        )


def _notes(error: float, unsure: float, images: list[np.ndarray], width: int, height: int) -> list[str]:
    notes = []
    if error > 1.0:
        notes.append(f"The error of {error:.1f} px is large: is the board flat, and is its size right?")
    if unsure > _KNOWN:
        notes.append(
            f"The focal length is uncertain by {unsure:.0%}, and fits to films take it to be known to {_KNOWN:.0%}: "
            "film the board again, tilted by 20 to 40 degrees to several sides."
        )
    every = np.concatenate([i[:, 0] for i in images])
    share = np.ptp(every[:, 0]) * np.ptp(every[:, 1]) / (width * height)
    if share < 0.4:
        notes.append(f"The board was seen in {share:.0%} of the picture only: distortion at its edges is uncertain.")
    return notes


def _checkerboard_finder(board: Board) -> Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]:
    import cv2

    inner = (board.columns - 1, board.rows - 1)
    if min(inner) < 3:
        raise InputError(f"board: expected at least 4 x 4 squares, found {board.columns} x {board.rows}.")

    def find(grey: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
        found, corners = cv2.findChessboardCorners(grey, inner, flags=flags)
        if not found:
            return np.zeros(0, int), np.zeros((0, 2))
        stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 1e-3)
        steps = np.linalg.norm(np.diff(corners.reshape(inner[1], inner[0], 2), axis=1), axis=-1)
        reach = max(2, min(11, int(steps.min() / 3)))
        corners = cv2.cornerSubPix(grey, corners, (reach, reach), (-1, -1), stop).reshape(-1, 2)
        # A board turned by half a circle looks the same to the finder: the one that is upright is meant.
        if corners[0, 1] > corners[-1, 1]:
            corners = corners[::-1]
        return np.arange(len(corners)), corners

    return find


def _charuco_finder(board: Board) -> Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]:
    import cv2

    detector = cv2.aruco.CharucoDetector(board.charuco())

    def find(grey: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        corners, ids, *_ = detector.detectBoard(grey)
        if ids is None or len(ids) == 0:
            return np.zeros(0, int), np.zeros((0, 2))
        return np.asarray(ids).reshape(-1), np.asarray(corners).reshape(-1, 2)

    return find


def board_picture(board: Board, dots: int = 100) -> np.ndarray:
    """Return a board to print, grey uint8, with `dots` pixels per square and a white margin of half a square."""
    margin = dots // 2
    if board.marker is not None:
        size = (board.columns * dots, board.rows * dots)
        inner = board.charuco().generateImage(size)
    else:
        y, x = np.indices((board.rows * dots, board.columns * dots)) // dots
        inner = (255 * ((x + y) % 2)).astype(np.uint8)
    return np.pad(inner, margin, constant_values=255)


def error_picture(found: Calibrated) -> bytes:
    """Return a PNG of where corners were found and how far off the camera has them, over the first picture."""
    import io

    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4.4), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.5, 1))
    left.imshow(found.picture, alpha=0.35)
    off = np.concatenate([m - f for m, f in zip(found.modelled, found.found, strict=True)])
    every = np.concatenate(found.found)
    left.scatter(every[:, 0], every[:, 1], s=4, c="#00798c", alpha=0.5, linewidths=0)
    left.quiver(*every.T, *off.T, angles="xy", scale_units="xy", scale=0.05, width=1.5e-3, color="#c4472f")
    left.set(title=f"corners in {len(found.pictures)} pictures; errors 20 times enlarged", xticks=[], yticks=[])
    right.axhline(0, lw=0.5, c="#8592a0")
    right.axvline(0, lw=0.5, c="#8592a0")
    right.scatter(*off.T, s=4, alpha=0.4, c="#c4472f", linewidths=0)
    far = max(0.5, float(np.percentile(np.abs(off), 99.5)))
    right.set(xlim=(-far, far), ylim=(-far, far), aspect="equal", xlabel="error in x [px]", ylabel="error in y [px]")
    right.set_title(f"reprojection error {found.error:.3f} px (root mean square)")
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=130, metadata={"Software": "torchdlo"})
    return buffer.getvalue()
