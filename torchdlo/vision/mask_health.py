"""Whether masks can be trusted: frames that are wrong are taken out and said; what leaves too little is refused."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchdlo.errors import InputError

__all__ = ["Issue", "check_masks", "frames_text"]

_JUMP = 0.35
"""Change of area from the frames around, as a share, that a rope does not show."""

_FEW = 0.5
"""Share of frames that have to be left."""

_SLIP = 6.0
"""Shift of the still background from which the camera has slipped [px]."""

_MOVED = 0.1
"""Change of a mask from one frame to the next, as a share of its area, of a rope that moves: about a quarter pixel."""

_CODED, _EVEN, _CAUGHT_UP = 0.02, 0.75, 1.5
"""Change of a mask, as a share of its area, that a codec makes in a picture that is repeated; that of the last step
before it, as a share of the one before, of a rope that does not turn back, which has a half; and times as far as before
from which the rope has caught up after it."""

_CLEAR = 0.1
"""Response of a phase correlation from which a shift is taken for one."""

_ALIKE = 0.7
"""Difference of two pictures of the background after a shift, over that before, below which it has shifted."""


@dataclass(frozen=True)
class Issue:
    """One thing that is wrong with the masks of one camera."""

    kind: str
    """empty, area, frozen, elsewhere, edge, slip, dropped, blobs."""
    text: str
    """What was found, and what was done about it."""


def frames_text(rows: np.ndarray) -> str:
    """Return frames (F,) bool in words."""
    at = np.flatnonzero(rows)
    runs = np.split(at, np.flatnonzero(np.diff(at) > 1) + 1)
    told = [str(r[0]) if len(r) == 1 else f"{r[0]} to {r[-1]}" for r in runs[:4]]
    more = f" and {len(runs) - 4} more stretches" if len(runs) > 4 else ""
    return f"frame{'s' if len(at) > 1 else ''} {', '.join(told)}{more}"


def check_masks(
    masks: np.ndarray, where: str, *, pictures: np.ndarray | None = None, moving: np.ndarray | None = None
) -> tuple[np.ndarray, list[Issue]]:
    """Return which frames can be trusted, (F,) bool, and what is wrong with others.

    Args:
        masks: shape (F, H, W) bool.
        where: name of the file, which sentences begin with.
        pictures: what they were made from, RGB (F, H, W, 3) uint8, for the background, if at hand.
        moving: frames before which the grippers have moved, so that equal masks are repeated ones, shape (F,) bool;
            all if not given. Of others equal ones are repeated if the rope moves before and after them, and
            pictures, if at hand, are equal as well.

    Raises:
        InputError: Too little is left.
    """
    count = len(masks)
    good, issues = np.ones(count, bool), []

    def leave(rows: np.ndarray, kind: str, text: str) -> None:
        rows = rows & good
        if rows.any():
            good[rows] = False
            issues.append(Issue(kind, f"{text} in {frames_text(rows)}: left out"))

    area = masks.reshape(count, -1).sum(1).astype(float)
    if not area.any():
        raise InputError(
            f"{where}: the rope is never visible: all masks are black; set its colour with torchdlo segment, or check "
            "that it stands out from what is behind it."
        )
    if np.median(area) > 0.25 * masks[0].size:
        raise InputError(
            f"{where}: masks cover {np.median(area) / masks[0].size:.0%} of the picture: the background has the rope's "
            "colour; set its ranges with torchdlo segment, or hang a sheet of another colour behind it."
        )
    leave(area < 0.1 * np.median(area[area > 0]), "empty", "the rope is not seen")
    usual = _smooth(np.where(good, area, np.nan))
    leave(np.abs(area / np.maximum(usual, 1.0) - 1) > _JUMP, "area", "the area of the mask jumps")
    leave(_elsewhere(masks, good), "elsewhere", "the mask jumps away and back")
    leave(_repeated(masks, area, pictures, moving), "frozen", "the picture is the one before")
    blobs = _blobs(masks, good)
    if blobs:
        issues.append(Issue("blobs", blobs))
    edge = good & (masks[:, [0, -1]].any((1, 2)) | masks[:, :, [0, -1]].any((1, 2)))
    if edge.any():
        text = f"the rope leaves the picture in {frames_text(edge)}: what is out of it does not count"
        issues.append(Issue("edge", text))
    if pictures is not None and count > 2:
        slipped = _slip(pictures, masks)
        if slipped is not None:
            at, far = slipped
            rows = np.arange(count) >= at
            leave(rows, "slip", f"the background has shifted by {far:.0f} px, as if the camera had slipped,")
    if good.sum() < max(min(count, 5), _FEW * count):
        kinds = ", ".join(dict.fromkeys(i.text for i in issues if i.kind not in ("edge", "blobs")))
        raise InputError(
            f"{where}: expected at least half of its {count} frames to be usable, found {int(good.sum())} ({kinds}); "
            "film again or set the colour with torchdlo segment."
        )
    return good, issues


def _repeated(
    masks: np.ndarray, area: np.ndarray, pictures: np.ndarray | None, moving: np.ndarray | None
) -> np.ndarray:
    """Return frames (F,) bool that are the ones before, though something moves; `area` is that of masks [px], (F,)."""
    changed = np.array([0, *(np.count_nonzero(a != b) for a, b in zip(masks[1:], masks[:-1], strict=True))])
    same = changed == 0
    same[0] = False
    shifts = changed > _MOVED * np.maximum(area, 1.0)
    coded = changed <= _CODED * area
    coded[0] = False
    coded = _between(coded, shifts, changed)
    if moving is None:
        return same | coded
    out = (same | coded) & moving
    run = np.flatnonzero(_between(same & ~moving, shifts))
    equal = [pictures is None or np.array_equal(pictures[k], pictures[k - 1]) for k in run]
    out[run[equal]] = True
    return out


def _between(rows: np.ndarray, shifts: np.ndarray, changed: np.ndarray | None = None) -> np.ndarray:
    """Return those of frames (F,) bool before and after whose run the rope moves: one at rest has equal ones, too.

    Where pixels that change (F,) are given, it moves evenly before them, or farther after them than before: one that
    turns back does neither.
    """
    out, at = np.zeros(len(rows), bool), np.flatnonzero(rows)
    for run in np.split(at, np.flatnonzero(np.diff(at) > 1) + 1):
        if not len(run) or run[0] < 2 or run[-1] + 1 >= len(rows):
            continue
        before, after = run[0] - 1, run[-1] + 1
        if changed is not None:
            even = before > 1 and changed[before] > _EVEN * changed[before - 1]
            if not (even or changed[after] > _CAUGHT_UP * changed[before]):
                continue
        out[run] = shifts[before] and shifts[after]
    return out


def _smooth(values: np.ndarray, reach: int = 4) -> np.ndarray:
    """Return running medians of values (F,), NaN left out."""
    padded = np.pad(values, reach, constant_values=np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1)
    known = np.isfinite(windows).any(1)
    out = np.full(len(values), np.nanmedian(values) if np.isfinite(values).any() else 0.0)
    out[known] = np.nanmedian(windows[known], 1)
    return out


def _elsewhere(masks: np.ndarray, good: np.ndarray) -> np.ndarray:
    """Return frames whose mask lies far from where those before and after lie, which agree, (F,) bool."""
    out = np.zeros(len(masks), bool)
    trusted = np.flatnonzero(good)
    if len(trusted) < 5:
        return out
    centre = np.array([[c.mean() for c in np.nonzero(masks[k])] for k in trusted])
    step = np.linalg.norm(centre[1:-1] - 0.5 * (centre[:-2] + centre[2:]), axis=1)
    apart = np.linalg.norm(centre[2:] - centre[:-2], axis=1)
    usual = max(3.0, 8 * float(np.median(step)))
    out[trusted[1:-1][(step > usual) & (step > 1.5 * apart)]] = True
    return out


def _blobs(masks: np.ndarray, good: np.ndarray) -> str:
    """Return what is to be said of second blobs, "" if there are none."""
    import cv2

    rows = np.flatnonzero(good)
    if not len(rows):
        return ""
    second = []
    for k in rows[:: max(1, len(rows) // 12)]:
        kernel = np.ones((9, 9), np.uint8)
        joined = cv2.dilate(masks[k].astype(np.uint8), kernel)
        count, label = cv2.connectedComponents(joined)
        area = np.bincount(label[masks[k]], minlength=count)[1:] if count > 1 else np.zeros(1)
        largest = np.sort(area)[::-1]
        second.append(largest[1] / largest[0] if len(largest) > 1 else 0.0)
    share = float(np.median(second))
    if share > 0.05:
        return (
            f"a second blob has {share:.0%} of the area of the first: a part of the rope may be hidden, or two are seen"
        )
    return ""


def _slip(pictures: np.ndarray, masks: np.ndarray) -> tuple[int, float] | None:
    """Return from which frame on the still background is shifted, and by how many pixels; None if it is not."""
    import cv2

    def grey(k: int) -> np.ndarray:
        small = cv2.resize(pictures[k], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        return cv2.cvtColor(small, cv2.COLOR_RGB2GRAY).astype(np.float32)

    def fine(picture: np.ndarray) -> np.ndarray:
        """Return what is neither noise nor shade."""
        return cv2.GaussianBlur(picture, (0, 0), 1.5) - cv2.GaussianBlur(picture, (0, 0), 8)

    still = ~cv2.dilate(np.asarray(masks.any(0), np.uint8), np.ones((25, 25), np.uint8)).astype(bool)
    still = still[::2, ::2][: grey(0).shape[0], : grey(0).shape[1]]
    if still.mean() < 0.2:
        return None
    window = cv2.GaussianBlur(still.astype(np.float32), (0, 0), 4)
    first = grey(0)
    texture = float((first - cv2.GaussianBlur(first, (0, 0), 6))[still].std())

    def shift(k: int) -> np.ndarray:
        """Return by how much a picture is shifted against the first [px], NaN where that is not clear."""
        now = grey(k)
        (dx, dy), response = cv2.phaseCorrelate((first - first.mean()) * window, (now - first.mean()) * window)
        if response <= _CLEAR:
            return np.full(2, np.nan)
        # Along a bar, and of grippers that move, any shift correlates: a true one makes pictures alike.
        away = np.array([[1, 0, -dx], [0, 1, -dy]], np.float32)
        back = cv2.warpAffine(now, away, now.shape[::-1], borderMode=cv2.BORDER_REFLECT)
        apart, left = (float(np.abs(fine(first - x))[still].mean()) for x in (now, back))
        return 2 * np.array([dx, dy]) if left < _ALIKE * apart else np.zeros(2)

    last = len(pictures) - 1
    ends = np.array([shift(k) for k in (last, last - 1, last - 2)])
    # A camera that has slipped stays where it is: all pictures at the end agree.
    same = np.isfinite(ends).all() and np.abs(ends - ends[0]).max() < 2.0
    if texture < 1.0 or not same or np.linalg.norm(ends[0]) < _SLIP:
        return None
    low, high = 0, last
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if np.linalg.norm(shift(middle)) >= _SLIP else (middle, high)
    return high, float(np.linalg.norm(ends[0]))
