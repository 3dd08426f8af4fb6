"""Which second camera would test what films from where cameras stand cannot: places around a motion, ranked.

Of a motion as it was filmed, small doses of every effect and small changes of every number are seen from each place
beside the cameras at hand. A place is worth what the effect is that it shows worst, compared with the best place for
that effect: what the motion does not show from anywhere decides nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from torchdlo.physics.effects import EFFECTS
from torchdlo.sysid.diagnosis import effect_library
from torchdlo.sysid.diagnosis.detection_limit import DetectionLimit
from torchdlo.sysid.estimation.levenberg_marquardt import ParameterSpace
from torchdlo.sysid.model.rope_model import RopeModel
from torchdlo.sysid.recordings.recording import Recording
from torchdlo.sysid.video.filmed_problem import FilmedProblem
from torchdlo.sysid.video.view_information import (
    CameraInformation,
    ExpectedInformation,
    MotionVariations,
    SimulatedTrials,
    camera_information,
    camera_places,
    doses_of,
    told,
    varied,
)
from torchdlo.vision.camera import Camera

__all__ = [
    "SecondView",
    "ViewPlace",
    "added_rows",
    "effect_notes",
    "limit_text",
    "number_notes",
    "place_rows",
    "rank_places",
    "second_view",
    "second_view_json",
    "visible",
]

HORIZON = 0.6
"""Share of each trial that is looked at, its beginning: over longer times what doses change is not linear any more."""

_TRIALS = 4
"""Most trials that are looked at."""

_NUDGE = 0.02
"""Steps of finite differences of starts, in standard deviations of their priors."""

_GAIN = 2.0
"""Times by which a place has to lower a detection limit to be worth a sentence."""

_NARROWER = 1.5
"""Times by which a place has to narrow a range likewise, and how wide that is at least: see `_WIDE`."""

_WIDE = 0.01
"""Standard deviation of a logarithm from which a range is worth narrowing."""

_SILENT = 0.42
"""Standard deviation of a logarithm from which a number is not testable: its range spans a factor of four."""

_TEXT = 4
"""Most effects in a sentence."""

_NORMAL = 1.645
"""Half a 90 % range in standard deviations."""


@dataclass(frozen=True, eq=False)
class ViewPlace:
    """A place of one more camera, and what films would tell with it."""

    camera: Camera
    """The camera there."""
    where: str
    """The same in words."""
    told: ExpectedInformation
    """By the cameras at hand and this one."""
    limits: dict[str, DetectionLimit]
    """By effect: from which size on it would be named."""
    pixel: float
    """Length that a pixel is worth at the rope [m]."""
    worst: str | None
    """The effect that stays farthest from what the best place for it shows; None if none counts."""
    regret: float
    """Times by which its detection limit is above that of the best place for it."""


@dataclass(frozen=True, eq=False)
class SecondView:
    """Places around a motion, best first."""

    cameras: tuple[Camera, ...]
    """Those at hand that see the rope."""
    now: ExpectedInformation | None
    """What they tell; None if there are none."""
    limits: dict[str, DetectionLimit]
    """From which size on effects are named by them."""
    places: tuple[ViewPlace, ...]
    """One more camera, best first."""
    effects: tuple[str, ...]
    """Effects by which places are ranked; none if numbers alone count."""
    level: float
    """What an effect has to change to be named, root mean square per reading [m]."""
    rope: np.ndarray
    """Some shapes of the rope, for a picture [m], shape (S, M, 3)."""
    space: ParameterSpace
    """Numbers of the rope."""
    radius: float | None
    """Radius of the rope [m]."""

    @property
    def best(self) -> ViewPlace:
        """Return the best place."""
        return self.places[0]


def rank_places(
    recording: Recording,
    motion: MotionVariations,
    cameras: Sequence[Camera],
    lens: Camera,
    *,
    level: float | None = None,
    named: Sequence[str] = (),
) -> SecondView | None:
    """Return places of one more camera, best first; None if from none all of the rope is seen.

    Args:
        recording: the rope.
        motion: trials with what numbers and doses of effects change.
        cameras: at hand.
        lens: camera whose lens and sensor the new one has.
        level: what an effect has to change to be named [m]; what readings get wrong if not given.
        named: effects that count; those that show from somewhere if not given.
    """
    mine = [info for info in (camera_information(c, motion) for c in cameras) if info.weight > 0]
    now = told(mine, motion) if mine else None
    lowest = -math.inf if recording.table_height is None else recording.table_height + 0.05
    found: list[tuple[CameraInformation, str, ExpectedInformation]] = []
    for camera, where in camera_places(lens, motion.rope.reshape(-1, 3), lowest):
        info = camera_information(camera, motion)
        if info.whole:
            found.append((info, where, told([*mine, info], motion)))
    if not found:
        return None
    if level is None:
        level = now.noise if now is not None else float(np.median([t.noise for _, _, t in found]))
    limits = [t.limits(level, recording) for _, _, t in found]
    doses = [t.doses(level) for _, _, t in found]
    effects = named or [n for n in dict.fromkeys(limits[0]) if any(part[n].hardest is not None for part in limits)]
    least = {n: min(part[n] for part in doses) for n in effects if n in doses[0]}
    places = []
    for (info, where, each), own, times in zip(found, limits, doses, strict=True):
        regret = {n: times[n] / value for n, value in least.items() if 0 < value < math.inf}
        worst = max(regret, key=lambda n: regret[n], default=None)
        places.append(
            ViewPlace(info.camera, where, each, own, info.pixel, worst, regret[worst] if worst is not None else 1.0)
        )
    places.sort(key=lambda p: (round(math.log(p.regret), 2), p.told.score))
    shown = motion.rope[:, :: max(1, motion.rope.shape[1] // 6)].reshape(-1, *motion.rope.shape[2:])
    return SecondView(
        tuple(info.camera for info in mine),
        now,
        {} if now is None else now.limits(level, recording),
        tuple(places),
        tuple(least),
        level,
        shown,
        motion.space,
        recording.radius,
    )


def second_view(
    own: FilmedProblem,
    raw: np.ndarray,
    *,
    names: Sequence[str] = (),
    ranked: Sequence[str] = (),
    level: float | None = None,
    cameras: Sequence[Camera] | None = None,
    lens: Camera | None = None,
    report: Callable[[int, int], None] = lambda *_: None,
) -> SecondView | None:
    """Return where one more camera would show what a fitted model's films do not; None of ropes at rest.

    Args:
        own: the fitted problem.
        raw: coordinates of its numbers, shape (N,).
        names: effects to try; none for numbers alone.
        ranked: those of them that count, see `rank_places`.
        level: likewise.
        cameras: at hand; those of the films if not given.
        lens: camera like which the new one is; the first one at hand if not given.
        report: told how many groups of effects are done, and in all.
    """
    if own.trials[0].still or not own.free:
        return None
    values = own.space.to_values(raw)
    count = len(own.trials)
    rows = np.unique(np.linspace(0, count - 1, min(_TRIALS, count)).round().astype(int))
    frames = max(3, int(HORIZON * own.motion.markers.shape[1]))
    begin = own.begin(own.offset[None]) if own.offset.shape[1] else own.start
    numbers = dict(zip(own.model.parameters, map(float, own.full(values[None])[0]), strict=True))
    run = SimulatedTrials(
        own.model.recording, own.model.effects, own.options, numbers, own.motion.pick(rows), begin.pick(rows), frames
    )
    units = dict(zip(own.space.names, own.space.units, strict=True))
    motion = varied(run, {own.model.parameters[k]: float(units[own.model.parameters[k]]) for k in own.free})
    # Trials whose simulation fails tell nothing.
    kept = np.flatnonzero(motion.sound)
    if not len(kept):
        return None
    if len(kept) < len(rows):
        rows, motion = rows[kept], motion.picked(kept)
        frames = motion.rope.shape[1]
        run = replace(run, motion=own.motion.pick(rows), begin=begin.pick(rows), frames=frames)
    if own.offset.shape[1]:
        motion = replace(motion, starts=_starts(own, values, rows, frames))
    if names:
        motion = doses_of(run, motion, names, report)
    films = [view.camera for view in own.spines.views]
    cameras = films if cameras is None else cameras
    return rank_places(own.model.recording, motion, cameras, lens or films[0], level=level, named=ranked)


def _starts(own: FilmedProblem, values: np.ndarray, rows: np.ndarray, frames: int) -> np.ndarray:
    """Return what numbers of starts change, (J, B, T, M, 3), of the trials (B,) among all."""
    moving = own.offset.shape[1]
    offsets = np.repeat(own.offset[None], moving + 1, 0)
    offsets[1:] += _NUDGE * np.eye(moving)[:, None]
    sims = own.simulate(np.repeat(values[None], moving + 1, 0), frames, offsets)[:, rows]
    change = (sims[1:] - sims[0]) / _NUDGE
    change[:, own.start.at_rest[rows]] = 0.0
    return change


def visible(recording: Recording, model: RopeModel, without: Sequence[str]) -> list[str]:
    """Return the effects that films of a recording may show: how markers are measured is not among them."""
    names = [n for n in effect_library.library() if n not in without and EFFECTS[n].kind != "measurement"]
    return [n for n in names if effect_library.applicable(n, recording, model.mesh)]


def limit_text(limit: DetectionLimit, size: float | None = None) -> str:
    """Return from which size on an effect is named, in words; where it shows least if no size is given."""
    size = limit.hardest if size is None else size
    if size is None:
        return "cannot be seen"
    until = EFFECTS[limit.name].params[limit.number].scale == "reciprocal"
    unit = "" if limit.unit == "1" else f" {limit.unit}"
    return f"{'up to' if until else 'from'} {size:.2g}{unit}"


def effect_notes(view: SecondView) -> list[str]:
    """Return which effects these films cannot test, and which second view would, in words."""
    if view.now is None:
        return []
    best, before = view.best, view.now.doses(view.level)
    blind, lower = _gained(view, before, best)
    out = []
    if blind:
        would = "; ".join(f"{_words(n)} {limit_text(best.limits[n])}" for n in blind[:_TEXT])
        out.append(
            f"Where they show least, these films cannot test {_listed(blind[:_TEXT])}: one more camera, {best.where}, "
            f"would let them be named ({would})."
        )
    if lower:
        would = "; ".join(
            f"{_words(n)} {limit_text(best.limits[n])} instead of {limit_text(view.limits[n])}" for n in lower[:_TEXT]
        )
        out.append(f"One more camera, {best.where}, would lower what can be named where it shows least: {would}.")
    other = {n: p for p in reversed(view.places) for part in _gained(view, before, p) for n in part}
    if not out and other:
        would = "; ".join(
            f"{_words(n)} {limit_text(p.limits[n])} (now {limit_text(view.limits[n])}), {p.where}"
            for n, p in list(other.items())[:_TEXT]
        )
        out.append(
            "The best place of one more camera would not halve the size from which an effect can be named; others "
            f"would, where it shows least: {would}."
        )
    elif not out:
        out.append(
            "No second camera would halve the size from which an effect can be named: what these films do not show, "
            "another motion may (design-experiment proposes one)."
        )
    never = [n for n, limit in view.limits.items() if all(_unseen(p.limits, n) for p in view.places) and _none(limit)]
    if never:
        more = f" and {len(never) - _TEXT} more" if len(never) > _TEXT else ""
        out.append(f"From no place would this motion show {_listed(never[:_TEXT])}{more}.")
    return [*out, *thin_note(view)]


def _gained(view: SecondView, before: Mapping[str, float], place: ViewPlace) -> tuple[list[str], list[str]]:
    """Return which effects can be named from a place alone, and of which it lowers limits by much, most first."""
    after = place.told.doses(view.level)
    gain = {n: before[n] / after[n] for n in view.effects if after[n] > 0 and n in view.limits}
    order = [n for n in sorted(gain, key=lambda n: -gain[n]) if place.limits[n].hardest is not None]
    blind = [n for n in order if view.limits[n].hardest is None]
    return blind, [n for n in order if gain[n] >= _GAIN and n not in blind]


def number_notes(view: SecondView) -> list[str]:
    """Return which range of a parameter one more camera would narrow, in words; nothing if it would not much."""
    if view.now is None:
        return []
    best = view.best
    said = [
        f"that of the {_words(name)} from {_range(view.space, name, wide)} to "
        f"{_range(view.space, name, best.told.deviations[name])}"
        for name, wide in view.now.deviations.items()
        if wide > _NARROWER * best.told.deviations[name] and wide > _WIDE * _unit(view.space, name)
    ]
    out = [f"One more camera, {best.where}, would narrow ranges: {'; '.join(said)}.", *thin_note(view)] if said else []
    least = {n: min(p.told.deviations[n] for p in view.places) for n in view.space.names}
    lost = [n for n, wide in least.items() if _open(view.space, n) and wide > _SILENT]
    if lost:
        out.append(f"From no place would these motions tell the {_listed(lost)}: another motion may.")
    return out


def thin_note(view: SecondView) -> list[str]:
    """Return that the rope is too thin in pictures from the best place."""
    if view.radius is None or 2 * view.radius / view.best.pixel >= 2.0:
        return []
    wide = 2 * view.radius / view.best.pixel
    return [f"From there the rope is {wide:.1f} px thick: take a longer lens or more pixels."]


def second_view_json(view: SecondView, most: int = 20) -> dict[str, Any]:
    """Return places and what they add, for JSON."""

    def limits(found: Mapping[str, DetectionLimit]) -> dict[str, Any]:
        return {
            n: {"number": x.number, "unit": x.unit, "easiest": x.easiest, "hardest": x.hardest}
            for n, x in found.items()
        }

    return {
        "level_m": view.level,
        "ranked_by": list(view.effects),
        "cameras_at_hand": [c.name for c in view.cameras],
        "now": None
        if view.now is None
        else {"standard_deviations": view.now.deviations, "detection_limits": limits(view.limits)},
        "places": [
            {
                "place": p.where,
                "position": list(_eye(p.camera)),
                "camera": {
                    "rotation": p.camera.rotation,
                    "translation": p.camera.translation,
                    "fx": p.camera.fx,
                    "width": p.camera.width,
                    "height": p.camera.height,
                },
                "worst_effect": p.worst,
                "times_the_best_limit": p.regret,
                "standard_deviations": p.told.deviations,
                "detection_limits": limits(p.limits),
            }
            for p in view.places[:most]
        ],
    }


def place_rows(view: SecondView) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Return heads and rows of a table of places, best first; the cameras at hand last."""
    names = view.space.names
    heads = ("place", "worst effect", "times the best limit", *map(_words, names))
    rows = [
        (
            p.where,
            "" if p.worst is None else _words(p.worst),
            "" if p.worst is None else f"{p.regret:.2f}",
            *(_range(view.space, n, p.told.deviations[n]) for n in names),
        )
        for p in view.places
    ]
    if view.now is not None:
        now, best = view.now.doses(view.level), view.best.told.doses(view.level)
        gain = {n: now[n] / best[n] for n in view.effects if best[n] > 0}
        worst = max(gain, key=lambda n: gain[n], default=None)
        said = ("", "") if worst is None else (_words(worst), f"{max(gain[worst], 1.0):.2f}")
        ranges = (_range(view.space, n, view.now.deviations[n]) for n in names)
        rows.append(("the cameras at hand alone", *said, *ranges))
    return heads, rows


def added_rows(view: SecondView) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Return heads and rows of a table of what the best place adds, most first."""
    after, before = view.best.told.doses(view.level), {} if view.now is None else view.now.doses(view.level)
    gain = {n: before.get(n, math.inf) / after[n] if after[n] > 0 else 1.0 for n in view.effects}
    rows: list[tuple[str, ...]] = []
    for name in sorted(gain, key=lambda n: -gain[n]):
        then, now = view.best.limits.get(name), view.limits.get(name)
        if then is not None:
            times = f"{gain[name]:.2g}" if math.isfinite(gain[name]) else ""
            rows.append(
                (_words(name), _words(then.number), "" if now is None else limit_text(now), limit_text(then), times)
            )
    return ("effect", "number", "named now", "with the best place", "times less"), rows


def _eye(camera: Camera) -> tuple[float, ...]:
    """Return where a camera is [m]."""
    return tuple(map(float, -np.array(camera.rotation).T @ np.array(camera.translation)))


def _none(limit: DetectionLimit) -> bool:
    return limit.easiest is None


def _unseen(limits: Mapping[str, DetectionLimit], name: str) -> bool:
    return name not in limits or limits[name].easiest is None


def _unit(space: ParameterSpace, name: str) -> float:
    return float(space.units[space.names.index(name)])


def _open(space: ParameterSpace, name: str) -> bool:
    return space.params[space.names.index(name)].scale == "log"


def _range(space: ParameterSpace, name: str, deviation: float) -> str:
    """Return half the width of a 90 % range, in words."""
    param = space.params[space.names.index(name)]
    if param.scale != "log":
        return f"± {_NORMAL * deviation:.2g} {param.unit}"
    if _NORMAL * deviation < 0.5:
        return f"± {100 * _NORMAL * deviation:.2g} %"
    return f"a factor of {math.exp(min(_NORMAL * deviation, 5.0)):.2g}"


def _words(name: str) -> str:
    return name.replace("_", " ")


def _listed(names: Sequence[str]) -> str:
    said = [_words(n) for n in names]
    return said[0] if len(said) == 1 else f"{', '.join(said[:-1])} and {said[-1]}"
