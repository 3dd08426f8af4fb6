"""Which attachments have which vertices and edges of ropes at what times: one may take over what another lets go."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchdlo import scene as scenes
from torchdlo.coupling.common.pose import Pose
from torchdlo.coupling.robot.attachment import Grasp, Hands, carry_attachments, close_hands
from torchdlo.errors import InputError
from torchdlo.physics import tree
from torchdlo.scene_files.schema import Attachment, SceneDescription

__all__ = ["Holds", "check_holds", "holds_of", "numbered"]


@dataclass(frozen=True)
class HeldParts:
    """Vertices or edges that attachments name, which may name one of them at different times."""

    slots: tuple[int, ...]
    """The scene's slots, each once, in the order in which they are named first."""
    owners: tuple[int, ...]
    """The attachment of each time one is named."""
    places: tuple[int, ...]
    """Where in `slots` each named one is."""

    @property
    def named(self) -> tuple[int, ...]:
        """Slots as they are named."""
        return tuple(self.slots[k] for k in self.places)

    def spread(self, values: Tensor) -> Tensor:
        """Return values of slots (..., H, C) for all that are named."""
        return values[..., list(self.places), :]

    def chosen(self, values: Tensor, firm: Tensor) -> tuple[Tensor, Tensor]:
        """Return values and grips of slots from those of all that are named, of which one holds a slot, if any.

        Args:
            values: of all that are named, shape (..., N, C).
            firm: 1 for those whose attachment holds, 0 for others, shape (..., N, 1).
        """
        if len(self.slots) == len(self.places):
            return values, firm
        rows = [[float(place == k) for place in self.places] for k in range(len(self.slots))]
        first = [[float(n == self.places.index(k)) for n in range(len(self.places))] for k in range(len(self.slots))]
        held = firm.new_tensor(rows) * firm.transpose(-1, -2)
        total = held.sum(-1, keepdim=True)
        return torch.where(total > 0, held, firm.new_tensor(first)) @ values, total


@dataclass(frozen=True)
class _Named:
    """What `close_hands` asks of a scene."""

    prescribed_vertices: tuple[int, ...]
    prescribed_edges: tuple[int, ...]


@dataclass(frozen=True)
class Holds:
    """All attachments of a scene."""

    vertices: HeldParts
    edges: HeldParts
    hands: Hands

    def firm(self, d: SceneDescription, like: Tensor) -> Tensor:
        """Return which attachments hold in every step [1], shape (T, K, 1); they close and let go between steps."""
        steps = torch.arange(max(1, round(d.duration / d.dt)), dtype=torch.float64)[:, None]
        since, until = (
            steps.new_tensor([_step(getattr(h, name), d.dt) for h in d.attachments]) for name in ("close", "release")
        )
        return ((since <= steps) & (steps < until)).to(like)[..., None]

    def close(self, still: scenes.Control, tools: Pose, closed: Tensor, last: Grasp | None = None) -> Grasp:
        """Return how all that attachments name sits in their tools; arguments are those of `close_hands`.

        Args:
            still: `scene.stationary_control`.
            tools: where the attachments are, shapes (K, 3) and (K, 4).
            closed: which of them hold from now on, shape (K, 1).
            last: how parts sat until now.
        """
        named = _Named(self.vertices.named, self.edges.named)
        now = tree.replace(still, pos=self.vertices.spread(still.pos), director=self.edges.spread(still.director))
        return close_hands(named, self.hands, now, tools, closed, last)

    def carry(self, held: Grasp, tools: Pose) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
        """Return positions, directors and grips of the scene's held parts when attachments are at these poses."""
        pos, director, firm = carry_attachments(self.hands, held, tools)
        pos, vertices = self.vertices.chosen(pos, firm["vertices"])
        director, edges = self.edges.chosen(director, firm["edges"])
        return pos, director, {"vertices": vertices, "edges": edges}


def _step(time: float | None, dt: float) -> float:
    """Return the step at whose beginning a time is, to the nearest; the same for letting go and taking over."""
    return math.inf if time is None else math.ceil(time / dt - 0.5)


def holds_of(d: SceneDescription, counts: Sequence[int]) -> Holds:
    """Return who holds what; ropes have `counts` vertices and lie one after the other."""
    vertices, edges = (_parts(d, counts, part) for part in ("vertices", "edges"))
    return Holds(vertices, edges, Hands(len(d.attachments), vertices.owners, edges.owners))


_ONE = {"vertices": "vertex", "edges": "edge"}


def _parts(d: SceneDescription, counts: Sequence[int], part: str) -> HeldParts:
    slots: dict[int, int] = {}
    owners, places, earlier = [], [], dict[int, list[int]]()
    for k, held in enumerate(d.attachments):
        if not held.vertices:
            raise InputError(f"attachments[{k}].vertices: is empty; expected at least one.")
        if not 0 <= held.rope < len(counts):
            raise InputError(f"attachments[{k}].rope: expected 0 to {len(counts) - 1}, given {held.rope}.")
        count = counts[held.rope] - (part == "edges" and not d.ropes[held.rope].closed)
        for number in getattr(held, part):
            here = numbered(number, count, f"attachments[{k}].{part}")
            slot = sum(counts[: held.rope]) + here
            for other in earlier.setdefault(slot, []):
                _check_turns(d, other, k, f"{_ONE[part]} {here} of rope {held.rope}")
            earlier[slot].append(k)
            owners.append(k)
            places.append(slots.setdefault(slot, len(slots)))
    return HeldParts(tuple(slots), tuple(owners), tuple(places))


def _check_turns(d: SceneDescription, one: int, other: int, what: str) -> None:
    if one == other:
        raise InputError(f"attachments[{one}]: it names {what} twice; expected each once.")
    a, b = d.attachments[one], d.attachments[other]
    since = max(a.close, b.close)
    until = min(_end(a), _end(b))
    if since < until:
        span = f"from {since:g} s on" if until == math.inf else f"from {since:g} to {until:g} s"
        raise InputError(
            f"attachments[{other}]: it holds {what} {span}, and so does attachments[{one}]; let one go (release) "
            "before the other takes it (close)."
        )


def _end(hold: Attachment) -> float:
    return math.inf if hold.release is None else hold.release


def numbered(number: int, count: int, place: str) -> int:
    """Return a number of `count`, of which negative ones count from the end."""
    if not -count <= number < count:
        raise InputError(f"{place}: expected {-count} to {count - 1}, given {number}.")
    return number % count


def check_holds(d: SceneDescription) -> None:
    """Refuse attachments that cannot be."""
    for k, hold in enumerate(d.attachments):
        if d.clamp == "vertex" and (hold.close > 0 or hold.release is not None):
            raise InputError(
                f"attachments[{k}]: it is closed or released during the run, and clamp 'vertex' makes the rope stiffer "
                "where it is held; use clamp 'edge'."
            )
        if hold.robot is not None and not 0 <= hold.robot < len(d.robots):
            raise InputError(
                f"attachments[{k}].robot: expected the number of a robot, 0 to {len(d.robots) - 1}, given {hold.robot}."
                if d.robots
                else f"attachments[{k}].robot: there is no robot in the scene."
            )
        if hold.robot is not None and hold.keyframes:
            raise InputError(
                f"attachments[{k}].keyframes: the robot moves what it holds; put the keyframes into the robot."
            )
        if hold.close < 0:
            raise InputError(f"attachments[{k}].close: expected a time from 0 on, given {hold.close:g}.")
        if hold.release is not None and hold.release < hold.close:
            raise InputError(
                f"attachments[{k}].release: expected a time from {hold.close:g} s on, when it closes, given "
                f"{hold.release:g}."
            )
