"""Reading robot descriptions (URDF): joints, limits, and collision shapes made of primitives.

Only what kinematics and contact need is read. Blocks such as <transmission>, <gazebo> and <visual>, meshes, masses and
calibrations are passed over. http://wiki.ros.org/urdf/XML
"""

from __future__ import annotations

import difflib
import math
import re
import xml.etree.ElementTree as xml
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchdlo.errors import InputError
from torchdlo.untrusted import one_line, read_text

_LARGEST_FILE = 16 * 2**20
"""Largest file [bytes]."""
_CURE = "give its path, or its text"
_MOST_JOINTS = 500
"""Most joints of a robot."""
_LARGEST = 1e6
"""Largest number of a file [m or rad]."""
MOVING = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic"}
"""Kinds of joints that move, and how."""


@dataclass(frozen=True, eq=False)
class Joint:
    """What ties a link to the one before it."""

    name: str
    kind: str
    """"revolute", "prismatic" or "fixed"."""
    parent: str
    child: str
    origin: Tensor
    """Pose of the joint in the frame of its parent, rigid transform in float64 [-, m], shape (4, 4)."""
    axis: tuple[float, float, float]
    """Unit axis in the joint's frame."""
    lower: float
    """Least position [rad or m]."""
    upper: float
    """Greatest position [rad or m]."""
    velocity: float
    """Greatest speed [rad/s or m/s]."""
    mimics: str = ""
    """The joint that it follows, "" if it is commanded itself."""
    factor: float = 1.0
    """Its position over that joint's."""
    offset: float = 0.0
    """Its position where that joint's is 0 [rad or m]."""


@dataclass(frozen=True, eq=False)
class CollisionShape:
    """A solid that stands for a link in contact."""

    link: str
    kind: str
    """"box", "sphere", "cylinder" or "capsule", as in `shapes.SIZES`."""
    size: tuple[float, ...]
    """Half lengths; or a radius; or a radius and a half height or half length of the segment [m]."""
    origin: Tensor
    """Pose in the frame of its link, rigid transform in float64 [-, m], shape (4, 4)."""


@dataclass(frozen=True)
class UrdfModel:
    """What a file says, parents before children."""

    name: str
    links: tuple[str, ...]
    joints: tuple[Joint, ...]
    shapes: tuple[CollisionShape, ...]


def near(name: str, known: tuple[str, ...] | list[str]) -> str:
    """Return a hint at the known name that is most like a wrong one, or the list of them."""
    like = difflib.get_close_matches(name, known, 1)
    return f"did you mean {like[0]!r}?" if like else f"known are {', '.join(known)}"


def read_urdf(source: str | Path) -> UrdfModel:
    """Read a URDF file, or URDF text that begins with "<"."""
    inline = isinstance(source, str) and source.lstrip().startswith("<")
    where = "urdf" if inline else str(source)
    try:
        text = str(source) if inline else read_text(source, "a URDF file", most=_LARGEST_FILE, cure=_CURE)
        root = xml.fromstring(re.sub(r"<\?xml.*?\?>", "", text))
    except (xml.ParseError, UnicodeEncodeError) as error:
        raise InputError(f"{where}: is not complete XML ({error}); is the file cut, or a xacro macro?") from None
    if root.tag != "robot":
        raise InputError(f"{where}: expected <robot> around everything, found <{root.tag}>; is it a URDF file?")
    count = len(root.findall("joint"))
    if count > _MOST_JOINTS or len(root.findall("link")) > _MOST_JOINTS + 1:
        raise InputError(f"{where}: has {count} joints; expected at most {_MOST_JOINTS}, in one tree of links.")
    links = tuple(_named(where, e) for e in root.findall("link"))
    joints = [_joint(where, e, links) for e in root.findall("joint")]
    for what, names in (("link", links), ("joint", [j.name for j in joints])):
        twice = sorted({n for n in names if list(names).count(n) > 1})
        if twice:
            raise InputError(f"{where}: {what} {twice[0]!r} is there twice; give each {what} its own name.")
    _check_mimics(where, joints)
    shapes = [s for e in root.findall("link") for s in _shapes(where, e)]
    return UrdfModel(root.get("name", "robot"), links, _ordered(where, links, joints), tuple(shapes))


def _named(where: str, element: xml.Element) -> str:
    name = element.get("name")
    if not name:
        raise InputError(f"{where}: a <{element.tag}> has no name; give it one.")
    return name


def _numbers(where: str, element: xml.Element | None, key: str, count: int, default: float | None) -> list[float]:
    """Return the numbers of an attribute; the default for a missing one, if there is a default."""
    text = None if element is None else element.get(key)
    if text is None and default is not None:
        return [default] * count
    try:
        values = [float(x) for x in (text or "").split()]
    except ValueError:
        values = []
    if len(values) != count or not all(abs(value) <= _LARGEST for value in values):
        said = one_line(repr(text), 60)
        raise InputError(f"{where}: {key} is {said}; expected {count} finite number(s) up to {_LARGEST:g}.")
    return values


def _origin(where: str, element: xml.Element) -> Tensor:
    """Return the transform of an <origin>: fixed-axis roll, pitch, yaw, then the shift."""
    found = element.find("origin")
    x = _numbers(where, found, "xyz", 3, 0.0)
    r, p, y = _numbers(where, found, "rpy", 3, 0.0)
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(a), math.sin(a)) for a in (r, p, y))
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr, x[0]],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr, x[1]],
        [-sp, cp * sr, cp * cr, x[2]],
        [0.0, 0.0, 0.0, 1.0],
    ]
    return torch.tensor(rows, dtype=torch.float64)


def _joint(where: str, element: xml.Element, links: tuple[str, ...]) -> Joint:
    name = _named(where, element)
    here, kind = f"{where}: joint {name!r}", element.get("type", "")
    if kind not in MOVING and kind != "fixed":
        raise InputError(f"{here} is of type {kind!r}; expected one of {', '.join([*MOVING, 'fixed'])}.")
    ends = []
    for role in ("parent", "child"):
        found = element.find(role)
        link = "" if found is None else found.get("link", "")
        if link not in links:
            raise InputError(f"{here} has the {role} link {link!r}, which is not defined; {near(link, links)}.")
        ends.append(link)
    limit, mimic, axis = element.find("limit"), element.find("mimic"), element.find("axis")
    direction = [1.0, 0.0, 0.0] if axis is None or kind == "fixed" else _numbers(here, axis, "xyz", 3, None)
    if kind == "fixed":  # files write the axis 0 0 0, limits upside down and the like, which mean nothing
        limit = None
    size = math.hypot(*direction)
    if size == 0:
        raise InputError(f"{here} has the axis 0 0 0; expected a direction.")
    endless = kind == "continuous" or limit is None
    lower, upper = (
        float("-inf" if low else "inf") if endless else _numbers(here, limit, "lower" if low else "upper", 1, 0.0)[0]
        for low in (True, False)
    )
    if not lower <= upper:
        raise InputError(f"{here} has the limits {lower:g} to {upper:g}; expected lower <= upper.")
    velocity = _numbers(here, limit, "velocity", 1, math.inf)[0] if limit is not None else math.inf
    return Joint(
        name,
        MOVING.get(kind, "fixed"),
        ends[0],
        ends[1],
        _origin(here, element),
        (direction[0] / size, direction[1] / size, direction[2] / size),
        lower,
        upper,
        velocity,
        "" if mimic is None else mimic.get("joint", ""),
        1.0 if mimic is None else _numbers(here, mimic, "multiplier", 1, 1.0)[0],
        0.0 if mimic is None else _numbers(here, mimic, "offset", 1, 0.0)[0],
    )


def _check_mimics(where: str, joints: list[Joint]) -> None:
    leaders = [j.name for j in joints if j.kind != "fixed" and not j.mimics]
    for joint in joints:
        if joint.mimics and joint.mimics not in leaders:
            raise InputError(
                f"{where}: joint {joint.name!r} mimics {joint.mimics!r}, which is no joint that moves by itself; "
                f"{near(joint.mimics, leaders)}."
            )


def _ordered(where: str, links: tuple[str, ...], joints: list[Joint]) -> tuple[Joint, ...]:
    """Return joints from the base outwards; the links have to form one tree."""
    children = [j.child for j in joints]
    bases = [link for link in links if link not in children]
    if len(bases) != 1 or len(set(children)) != len(children):
        raise InputError(
            f"{where}: the joints do not make one tree: links without a parent are {bases}; "
            "give every link but one exactly one joint that has it as its child."
        )
    found: list[Joint] = []
    reached = bases
    while reached:
        found += [j for j in joints if j.parent == reached[0]]
        reached = [*reached[1:], *(j.child for j in joints if j.parent == reached[0])]
    lost = [j.name for j in joints if j not in found]
    if lost:
        raise InputError(f"{where}: the joints do not make one tree: {', '.join(lost)} form a circle.")
    return tuple(found)


def _shapes(where: str, link: xml.Element) -> list[CollisionShape]:
    out = []
    for collision in link.findall("collision"):
        here = f"{where}: collision of link {link.get('name')!r}"
        geometry = collision.find("geometry")
        for element in [] if geometry is None else list(geometry):
            if element.tag == "box":
                size = tuple(0.5 * x for x in _numbers(here, element, "size", 3, None))
            elif element.tag == "sphere":
                size = tuple(_numbers(here, element, "radius", 1, None))
            elif element.tag in ("cylinder", "capsule"):
                radius, length = (_numbers(here, element, key, 1, None)[0] for key in ("radius", "length"))
                size = (radius, 0.5 * length)
            else:
                continue
            if max(size) == 0:
                continue  # stands for no shape
            if min(size) <= 0:
                raise InputError(f"{here}: <{element.tag}> has a size of {min(size):g}; expected positive numbers.")
            out.append(CollisionShape(link.get("name", ""), element.tag, size, _origin(here, collision)))
    return out
