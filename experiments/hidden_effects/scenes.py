"""Ropes, grippers' motions and markers for recordings whose answer is known, drawn at random."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from laws import Laws
from simulate import Mesh, Rope, Simulator, Track, ramp, settle
from vectors import Array, exponential, multiply, rotate

LEAD = 0.25
"""Time that grippers move before a recording starts [s], so that the rope moves already."""
SPEEDS = {"train_0": 0.6, "train_1": 1.0, "train_2": 0.8, "test_0": 0.7, "test_1": 1.0}
"""Trials, and how fast grippers move, relative to the fastest."""


@dataclass(frozen=True)
class Scene:
    """A rope with its grippers and markers; the motions follow from the seed."""

    rope: Rope
    """The rope."""
    grippers: int
    """1: the other end is free; 2: both ends are held."""
    table: float | None
    """Height of a table [m]."""
    markers: int
    """How many markers there are, two of them on each gripper."""
    grip: float
    """Distance of the two markers on a gripper [m]; the rope is free beyond the inner one."""
    rate: int
    """Frames per second."""
    duration: float
    """Length of a trial [s]."""
    noise: float
    """Standard deviation of the free markers' noise [m]."""
    seed: int
    """Seed of the motions."""
    pace: float = 1.0
    """How fast the grippers move, relative to what is usual."""
    fluid: float | None = None
    """Density of the liquid around the rope [kg/m^3]."""

    @property
    def arclength(self) -> Array:
        """Places of the markers [m], (M,)."""
        inner = np.linspace(self.grip, self.free_end, self.markers - self.grippers)
        return np.concatenate([[0.0], inner, [self.rope.length] * (self.grippers - 1)])

    @property
    def gripped(self) -> Array:
        """Which markers are on grippers, (M,)."""
        held = np.zeros(self.markers, bool)
        held[:2] = True
        held[-2:] |= self.grippers == 2
        return held

    @property
    def free_end(self) -> float:
        """Arclength at which the free rope ends [m]."""
        return self.rope.length - (self.grip if self.grippers == 2 else 0.0)

    @property
    def times(self) -> Array:
        """Times of the frames [s], (F,)."""
        return np.arange(round(self.rate * self.duration) + 1) / self.rate

    def mesh(self, elements: int) -> Mesh:
        """Return a mesh of the free part."""
        return Mesh(elements, self.grip, self.free_end, self.grippers == 2)


def draw(seed: int, *, table: bool = False, grippers: int | None = None, pace: float = 1.0) -> Scene:
    """Return a scene; a fast one has a light rope."""
    rng = np.random.default_rng([seed, 11])
    length = round(float(rng.uniform(0.5, 0.95)), 3)
    density = float(rng.uniform(0.04, 0.1 if pace <= 1 else 0.06))
    bending = float(np.exp(rng.uniform(np.log(1.5e-3), np.log(8e-3))))
    rope = Rope(
        length,
        round(float(rng.uniform(0.003, 0.006)), 4),
        round(density * length, 4),
        round(bending, 5),
        round(bending * float(rng.uniform(0.6, 0.9)), 5),
        round(float(rng.uniform(0.3, 0.8)), 2),
    )
    count = 1 if table else grippers or int(rng.integers(1, 3))
    return Scene(
        rope,
        count,
        0.0 if table else None,
        int(rng.integers(11, 16)),
        round(float(rng.uniform(0.012, 0.018)), 4),
        int(rng.choice([60, 80, 100])),
        3.0,
        round(float(rng.uniform(2e-4, 5e-4)), 6),
        seed,
        pace,
    )


class Drive:
    """The grippers' motions in all trials: sums of three sines per coordinate about a pose of rest."""

    def __init__(self, scene: Scene, trials: list[str]) -> None:
        self.scene = scene
        reach = scene.rope.length * np.array([0.11, 0.2, 0.16])
        turn = np.array([0.5, 0.35, 0.35])
        if scene.table is not None:
            reach, turn = scene.rope.length * np.array([0.15, 0.25, 0.0]), np.array([0.0, 0.0, 0.6])
        self.size = np.concatenate([reach, turn])[:, None, None]
        self.rate, self.phase, self.weight = (np.zeros((3, 6, len(trials), scene.grippers)) for _ in range(3))
        for b, name in enumerate(trials):
            rng = np.random.default_rng([scene.seed, 12, list(SPEEDS).index(name)])
            # A free end whips where two held ones do not.
            fastest = (1.3 if scene.grippers == 1 else 1.6) * SPEEDS[name] * scene.pace
            self.rate[:, :, b] = 2 * np.pi * rng.uniform(0.25 * fastest, fastest, (3, 6, scene.grippers))
            self.phase[:, :, b] = rng.uniform(0, 2 * np.pi, (3, 6, scene.grippers))
            self.weight[:, :, b] = rng.uniform(0.4, 1.0, (3, 6, scene.grippers)) / self.rate[:, :, b]
        self.weight /= self.weight.sum(0)

    def __call__(self, times: Array) -> tuple[Array, Array]:
        """Return poses of the clamps where the rope leaves them."""
        sines = np.sin(self.rate[..., None] * times + self.phase[..., None])
        part = self.size[..., None] * (self.weight[..., None] * sines).sum(0) * ramp(times / (2 * LEAD))
        scene = self.scene
        rest, turn = (np.zeros((3, 1, scene.grippers, 1)) for _ in range(2))
        rest[2] = scene.rope.radius if scene.table is not None else 1.0
        if scene.grippers == 2:
            rest[0, 0, :, 0] = np.array([-0.29, 0.29]) * (scene.free_end - scene.grip)
            turn[1, 0, :, 0] = 0.5, -0.5  # the rope leaves downwards at both
        elif scene.table is None:
            turn[1] = np.random.default_rng([scene.seed, 13]).uniform(0.2, 1.2)
        return rest + part[:3], multiply(exponential(part[3:]), exponential(turn + 0 * part[3:]))


def run(scene: Scene, trials: list[str], numbers: list[dict], elements: int, dt: float) -> tuple[Track, Mesh]:
    """Simulate trials, each with laws of its own, with steps of about `dt` [s]; time 0 is the first frame."""
    drive, mesh = Drive(scene, trials), scene.mesh(elements)
    given = Laws(numbers, scene.table, fluid=scene.fluid)
    state = settle(scene.rope, mesh, given, drive)
    step = 1 / scene.rate / np.ceil(1 / scene.rate / dt - 1e-9)
    before = round(LEAD / step)  # whole steps, as LEAD is a multiple of all frames' lengths
    simulator = Simulator(scene.rope, mesh, given, lambda t: drive(t + LEAD), step)
    track, _ = simulator.run(state, (np.arange(before + round(scene.duration / step) + 1) - before) * step)
    return track, mesh


def seen(scene: Scene, trials: list[str], numbers: list[dict], track: Track, mesh: Mesh) -> tuple[Array, Array]:
    """Return markers (B, F, M, 3) [m] as they are seen without noise, and the clamps' orientations (B, F, G, 4)."""
    times, markers, turns = scene.times, [], []
    poses = Drive(scene, trials)(times + LEAD)
    for b, row in enumerate(numbers):
        delay = row.get("time_delay.delay", 0.0)
        offset = np.array([0.0, *(row.get(f"marker_offset.offset.{k}", 0.0) for k in range(2))])
        free = mesh.points(*_at(track, b, times - delay), scene.arclength, offset)
        held = mesh.points(*_at(track, b, times), scene.arclength, np.zeros(3))
        x, q = poses[0][:, b].transpose(0, 2, 1), poses[1][:, b].transpose(0, 2, 1)
        ahead = np.array([scene.grip, -scene.grip])[: scene.grippers]
        axis = rotate(q, np.eye(3)[:, :1, None])
        for g, (outer, inner) in enumerate(((0, 1), (-1, -2))[: scene.grippers]):
            held[..., inner], held[..., outer] = x[..., g], x[..., g] - ahead[g] * axis[..., g]
        markers.append(np.where(scene.gripped, held, free).transpose(1, 2, 0))
        turns.append(q.transpose(1, 2, 0))
    return np.array(markers), np.array(turns)


def _at(track: Track, b: int, times: Array) -> tuple[Array, Array]:
    """Return positions and orientations of a row's nodes at times, (3, F, N) and (4, F, N)."""
    place = np.clip((times - track.time[0]) / (track.time[1] - track.time[0]), 0, len(track.time) - 1)
    low = np.minimum(np.round(place - 1e-6).astype(int), np.floor(place + 1e-6).astype(int))
    low = np.minimum(low, len(track.time) - 2)
    share = (place - low)[:, None, None]
    x = track.x[low, :, b] * (1 - share) + track.x[low + 1, :, b] * share
    q = track.q[low, :, b] * (1 - share) + track.q[low + 1, :, b] * share
    q = q / np.sqrt((q * q).sum(1, keepdims=True))
    return x.transpose(1, 0, 2), q.transpose(1, 0, 2)
