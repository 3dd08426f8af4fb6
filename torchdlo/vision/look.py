"""What scenes look like: paints of all things, lights and small errors of the cameras, fixed or drawn from a seed."""

from __future__ import annotations

import colorsys
import math
from collections.abc import Callable
from dataclasses import dataclass

import torch

from torchdlo.errors import InputError

__all__ = ["PATTERNS", "Look", "Paint", "draw_look"]

PATTERNS = ("plain", "wood", "speckled", "checked", "woven", "twisted")
"""How two colours make a surface; "twisted" is for ropes: strands that wind round it."""

Color = tuple[float, float, float]
"""Red, green and blue as on a screen, 0 to 1."""


@dataclass(frozen=True)
class Paint:
    """What a surface looks like before light falls on it."""

    color: Color
    second: Color = (0.0, 0.0, 0.0)
    """The other colour of a pattern."""
    pattern: str = "plain"
    """One of `PATTERNS`."""
    scale: float = 10.0
    """Repeats per metre, for ropes along them [1/m]."""
    angle: float = 0.0
    """How a pattern is turned about z [rad]."""
    strands: int = 3
    """Strands of a twisted rope [1]."""
    gloss: float = 0.1
    """How much it shines [1]."""
    seed: int = 0
    """Of what is irregular in it, below 2^20 [1]."""

    def __post_init__(self) -> None:
        if self.pattern not in PATTERNS:
            raise InputError(f"paint: the pattern is {self.pattern!r}; expected one of {', '.join(PATTERNS)}.")

    def numbers(self) -> tuple[float, ...]:
        """Return it as the renderer reads it, 12 numbers; colours are linear in light."""
        twisted = self.pattern == "twisted"
        turn = (float(self.strands), 0.0) if twisted else (math.cos(self.angle), math.sin(self.angle))
        pattern = float(PATTERNS.index(self.pattern))
        return (*linear(self.color), *linear(self.second), self.gloss, pattern, self.scale, *turn, float(self.seed))


def linear(color: Color) -> Color:
    """Return the light of a colour of the screen (IEC 61966-2-1)."""
    r, g, b = (c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in color)
    return r, g, b


def _hex(text: str) -> Color:
    return int(text[1:3], 16) / 255, int(text[3:5], 16) / 255, int(text[5:7], 16) / 255


def _rope(one: str, two: str) -> Paint:
    return Paint(_hex(one), _hex(two), "twisted", scale=28.0, gloss=0.06)


@dataclass(frozen=True)
class Look:
    """What a scene looks like. Things of a kind take the paints in turn."""

    ropes: tuple[Paint, ...] = (
        _rope("#d9622b", "#a13f14"),
        _rope("#2f7fb8", "#1b4f78"),
        _rope("#5fa03f", "#3a6a25"),
        _rope("#a8487a", "#6f2a4e"),
    )
    bodies: tuple[Paint, ...] = (
        Paint(_hex("#4f8a8b"), gloss=0.2),
        Paint(_hex("#f2b134"), gloss=0.2),
        Paint(_hex("#8f6fb1"), gloss=0.2),
        Paint(_hex("#c0504d"), gloss=0.2),
    )
    particles: tuple[Paint, ...] = (Paint(_hex("#3f86c4"), gloss=0.25), Paint(_hex("#c9a868")))
    table: Paint = Paint(_hex("#d9c3a0"), _hex("#b08a5e"), "wood", scale=6.0, gloss=0.05, seed=1)
    shells: Paint = Paint(_hex("#eceae6"), gloss=0.25)
    joints: Paint = Paint(_hex("#4b5158"), gloss=0.2)
    fingers: Paint = Paint(_hex("#2e3236"), gloss=0.15)
    key_direction: tuple[float, float, float] = (-0.45, -0.35, 1.0)
    """To the light that casts shadows."""
    key: Color = (1.02, 0.97, 0.88)
    """Its light [1]."""
    fill_direction: tuple[float, float, float] = (0.9, -0.5, 0.45)
    fill: Color = (0.16, 0.17, 0.19)
    sky: Color = (0.34, 0.36, 0.40)
    """Light from above [1]; `ground`: from below."""
    ground: Color = (0.15, 0.14, 0.13)
    wall: tuple[Color, Color] = ((0.62, 0.66, 0.70), (0.42, 0.45, 0.48))
    """What is behind all else, above and below [1]."""
    floor: Color = (0.20, 0.20, 0.21)
    """Floor of the room below the table [1]."""
    softness: float = 0.10
    """Width of the light over its distance, by which edges of shadows are soft [1]."""
    aside: tuple[tuple[float, ...], ...] = ()
    """By how much each camera is turned about its x, y, z [rad] and moved along them [m], and the logarithm of the
    factor of its focal length [1]; none: not at all."""

    def lights(self, floor_height: float) -> tuple[float, ...]:
        """Return its lights as the renderer reads them, 32 numbers.

        Args:
            floor_height: height of the floor of the room [m].
        """
        lamps = (*self.key_direction, *self.key, *self.fill_direction, *self.fill, *self.sky, *self.ground)
        return (*lamps, *self.wall[0], *self.wall[1], *self.floor, floor_height, self.softness, 6.0, 0.0, 0.0)


_CAMERAS = 6
"""Cameras that have errors of their own."""


def draw_look(generator: torch.Generator, *, strength: float = 1.0) -> Look:
    """Return a look drawn at random; the same for the same state of the generator.

    Colours of ropes differ from that of the table in lightness, so that they can be seen.

    Args:
        generator: where random numbers come from.
        strength: of the errors of cameras: 1 are standard deviations of 1.1 degrees, 8 mm and 2 % of the focal length.
    """

    def number(low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand((), generator=generator, dtype=torch.float64))

    def whole(below: int) -> int:
        return int(torch.randint(below, (), generator=generator))

    dark_table = number(0, 1) < 0.35
    table = _table(number, whole, dark_table)
    ropes = tuple(_strand(number, whole, dark_table) for _ in range(4))
    bodies = tuple(Paint(_color(number, (0.25, 0.85), (0.35, 0.95)), gloss=number(0.0, 0.35)) for _ in range(4))
    shell = _color(number, (0.0, 0.06), (0.7, 1.0)) if whole(4) else _color(number, (0.0, 0.2), (0.15, 0.4))
    joint = _color(number, (0.0, 0.3), (0.15, 0.5))
    angle, steep, bright, warm = number(0, 2 * math.pi), number(0.35, 0.9), number(0.7, 1.3), number(-0.12, 0.12)
    ambient = number(0.7, 1.3)
    other = angle + number(1.8, 4.4)
    wall, floor = _color(number, (0.0, 0.25), (0.3, 0.95)), _color(number, (0.0, 0.3), (0.15, 0.7))
    deviations = torch.tensor([0.02] * 3 + [0.008] * 3 + [0.02], dtype=torch.float64) * strength
    aside = torch.randn(_CAMERAS, 7, generator=generator, dtype=torch.float64).clamp(-2, 2) * deviations
    usual = Look()
    return Look(
        ropes=ropes,
        bodies=bodies,
        particles=tuple(Paint(_color(number, (0.3, 0.8), (0.4, 0.9)), gloss=number(0, 0.3)) for _ in range(2)),
        table=table,
        shells=Paint(shell, gloss=number(0.05, 0.4)),
        joints=Paint(joint, gloss=number(0.05, 0.3)),
        fingers=Paint(_color(number, (0.0, 0.2), (0.1, 0.45)), gloss=number(0.0, 0.3)),
        key_direction=(steep * math.cos(angle), steep * math.sin(angle), 1.0),
        key=(bright * (1 + warm), bright, bright * (1 - warm)),
        fill_direction=(math.cos(other), math.sin(other), number(0.3, 0.9)),
        fill=(number(0.5, 1.6) * usual.fill[0], number(0.5, 1.6) * usual.fill[1], number(0.5, 1.6) * usual.fill[2]),
        sky=_times(ambient, usual.sky),
        ground=_times(ambient, usual.ground),
        wall=(linear(wall), _times(0.7, linear(wall))),
        floor=linear(floor),
        softness=number(0.03, 0.2),
        aside=tuple(tuple(row) for row in aside.tolist()),
    )


_Number = Callable[[float, float], float]


def _color(number: _Number, saturation: tuple[float, float], value: tuple[float, float]) -> Color:
    return colorsys.hsv_to_rgb(number(0, 1), number(*saturation), number(*value))


def _times(share: float, color: Color) -> Color:
    red, green, blue = color
    return share * red, share * green, share * blue


def _strand(number: _Number, whole: Callable[[int], int], light: bool) -> Paint:
    """Return a paint for ropes: light ones if the table is dark, else strong or dark ones."""
    color = _color(number, (0.0, 0.75) if light else (0.6, 1.0), (0.75, 1.0) if light else (0.3, 0.85))
    darker = number(0.45, 0.9)
    second = _times(darker, color)
    pattern = "twisted" if whole(4) else "plain"
    return Paint(color, second, pattern, scale=number(18, 45), strands=2 + whole(3), gloss=number(0.0, 0.2))


def _table(number: _Number, whole: Callable[[int], int], dark: bool) -> Paint:
    pattern = ("plain", "wood", "speckled", "checked", "woven")[whole(5)]
    tint, value = number(0.02, 0.16), (0.12, 0.4) if dark else (0.65, 0.98)
    hue = tint if pattern == "wood" else number(0, 1)
    saturation = number(0.25, 0.55) if pattern == "wood" else number(0.0, 0.3)
    color = colorsys.hsv_to_rgb(hue, saturation, number(*value))
    contrast = number(0.65, 0.92)
    second = _times(contrast, color)
    scale = {"wood": (4, 12), "speckled": (15, 60), "checked": (5, 20), "woven": (80, 200)}.get(pattern, (1, 2))
    angle, gloss = number(0, 2 * math.pi), number(0.0, 0.15)
    return Paint(color, second, pattern, scale=number(*scale), angle=angle, gloss=gloss, seed=whole(1 << 16))
