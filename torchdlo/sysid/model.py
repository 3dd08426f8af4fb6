"""The baseline model of a recorded rope: recordings in, simulated markers out, many parameter sets at once.

Gravity, an almost inextensible rod, straight or given rest shape, uniform bending and twisting stiffness, one damping
rate, a frictionless table where there is one, and clamps that follow the gripped markers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from torch import Tensor

from torchdlo import scene as scenes
from torchdlo.errors import InputError
from torchdlo.physics import rotation, tree
from torchdlo.physics.constrain import Lengths, settle
from torchdlo.physics.effect import Effect, Param
from torchdlo.physics.effects.elastic import Bend, BendFrame, Twist
from torchdlo.physics.effects.field import Damping, Gravity
from torchdlo.physics.effects.table import Table
from torchdlo.physics.numerics import normalize
from torchdlo.sysid.mesh import make_mesh
from torchdlo.sysid.recording import Recording, Trial

PARAMETERS: dict[str, Param] = {
    "bending_stiffness": Param(1e-3, 1e-7, 1.0, "N m^2", "log", None, "Uniform bending stiffness EI."),
    "twisting_stiffness": Param(1e-3, 1e-7, 1.0, "N m^2", "log", None, "Uniform twisting stiffness GJ."),
    "damping_rate": Param(0.5, 1e-2, 20.0, "1/s", "log", None, "Rate at which all velocities decay."),
    "rest_share": Param(1.0, 0.0, 2.0, "1", "linear", 0.0, "Share of the given rest shape's curvature that is real."),
    "rest_roll": Param(
        0.0,
        -np.pi,
        np.pi,
        "rad",
        "linear",
        None,
        "Angle from the vertical to the normal of the rest shape's plane, about the first clamp.",
    ),
}
"""Numbers that calibration may fit."""

MAX_SUBSTEP = 5e-3
"""Longest substep [s]; the implicit integrator is stable and accurate to a per cent there."""

_STRETCH = 1e4
"""Axial stiffness [N]: a strain of 1e-4 at 1 N. Real cables are near it, and taut trials stay solvable."""

_AHEAD = 0.1
"""How far steps look ahead: real ropes are jerked taut, and what then rings within a substep must die out."""

_CHUNK = 128
"""Scenes that run together in a compiled step: one size, so that there is one graph."""

_COMPILE_FROM = 10_000
"""Frames in the train trials from which compiling pays off."""


@dataclass(frozen=True, eq=False)
class Motion:
    """Trials of one recording as inputs of the simulation, stacked; short trials are padded with their last frame."""

    names: tuple[str, ...]
    held: Tensor
    """Positions of the held vertices [m], shape (B, F, H, 3)."""
    director: Tensor
    """First directors of the held edges, shape (B, F, G, 3)."""
    markers: np.ndarray
    """Measured markers [m], NaN where not seen, padded or suspect, shape (B, F, M, 3)."""
    frames: tuple[int, ...]
    """True number of frames of each trial."""


@dataclass(frozen=True, eq=False)
class Start:
    """Where trials begin."""

    pos: np.ndarray
    """Marker positions at time 0 [m], shape (B, M, 3)."""
    vel: np.ndarray
    """Marker velocities at time 0 [m/s], shape (B, M, 3)."""


class RopeModel:
    """A recording's rope on a mesh that has a vertex at every marker."""

    def __init__(
        self, recording: Recording, *, vertices: int | None = None, rest: str = "straight", compiled: bool | None = None
    ) -> None:
        trial = recording.train[0]
        self.recording = recording
        self.rest = rest
        self.count = trial.markers.shape[1]
        self.mesh = make_mesh(trial, recording.length, vertices)
        self.arclength, self.marker_vertex = self.mesh.arclength, self.mesh.marker_vertex
        self.held, self.clamps = self.mesh.held, self.mesh.clamps
        self.gripped = np.flatnonzero(trial.gripped)
        for other in (*recording.train, *recording.test):
            if not np.array_equal(other.gripped, trial.gripped) or not np.allclose(
                other.marker_arclength, trial.marker_arclength
            ):
                raise InputError(
                    f"{other.name}.npz: gripped or marker_arclength differ from {trial.name}.npz; "
                    "put trials with other grips into a recording of their own."
                )
        if rest == "given" and recording.rest_positions is None:
            raise InputError(
                "rope.json: rest_positions is missing; expected it for a calibration with the given rest shape."
            )
        self.dt = float(trial.time[1] - trial.time[0])
        frames = sum(len(t.time) for t in recording.train)
        self.compiled = frames >= _COMPILE_FROM if compiled is None else compiled
        self._stepper: tuple[scenes.Scene, Callable] | None = None
        self.substeps = max(1, int(np.ceil(self.dt / MAX_SUBSTEP - 1e-9)))

    @property
    def parameters(self) -> list[str]:
        """Names of the numbers to fit."""
        names = ["bending_stiffness", "twisting_stiffness", "damping_rate"]
        return names + (["rest_share", "rest_roll"] if self.rest == "given" else [])

    def guess(self) -> np.ndarray:
        """Return numbers to start from, in the order of `parameters`.

        The bending stiffness is the one at which weight bends the rope over a tenth of its length.
        """
        weight = self.recording.mass * np.linalg.norm(self.recording.gravity) / self.recording.length
        bend = max(weight, 1e-4) * (0.1 * self.recording.length) ** 3
        known = {"bending_stiffness": bend, "twisting_stiffness": 0.7 * bend}
        return np.array([known.get(name, PARAMETERS[name].default) for name in self.parameters], dtype=float)

    def motion(self, trials: Sequence[Trial]) -> Motion:
        """Return the grippers' motion of trials, and what was measured."""
        longest = max(len(t.time) for t in trials)
        held, director, measured = [], [], []
        for trial in trials:
            vertices = self.mesh.along(trial.markers, trial.gripped)[:, list(self.held)]
            markers = np.where(trial.suspect[:, None, None], np.nan, trial.markers)
            pad = ((0, longest - len(trial.time)),)
            held.append(np.pad(vertices, (*pad, (0, 0), (0, 0)), mode="edge"))
            director.append(np.pad(self.mesh.directors(trial), (*pad, (0, 0), (0, 0)), mode="edge"))
            measured.append(np.pad(markers, (*pad, (0, 0), (0, 0)), constant_values=np.nan))
        return Motion(
            tuple(t.name for t in trials),
            torch.as_tensor(np.stack(held)),
            torch.as_tensor(np.stack(director)),
            np.stack(measured),
            tuple(len(t.time) for t in trials),
        )

    def measured_twist(self) -> bool:
        """Return whether the grippers' rotation about the rope is measured at every clamp."""
        return all(t.gripper_quaternion is not None for t in self.recording.train)

    def build(
        self, motion: Motion, start: Start, values: np.ndarray
    ) -> tuple[scenes.Scene, scenes.Params, scenes.State]:
        """Build scenes, one per row of `values` (N, K), `motion` and `start`; all have N trials."""
        recording, number = self.recording, dict(zip(self.parameters, torch.as_tensor(values).T, strict=True))
        pos, vel = (
            torch.as_tensor(CubicSpline(self.mesh.marker_arclength, x, axis=1)(self.arclength))
            for x in (start.pos, start.vel)
        )
        held = list(self.held)
        pos[:, held] = motion.held[:, 0]
        vel[:, held] = (motion.held[:, 1] - motion.held[:, 0]) / self.dt
        rope = scenes.Rope(
            pos,
            radius=recording.radius or 0.005,
            mass=recording.mass,
            bend=number["bending_stiffness"],
            twist=number["twisting_stiffness"],
            stretch=_STRETCH,
            velocities=vel,
            rest=self._rest_shape(),
            director=self._first_director(motion),
            rest_director=None if self.rest != "given" else pos.new_tensor([0.0, 0.0, 1.0]),
        )
        effects: list[Effect] = [Gravity(), BendFrame() if self.rest == "given" else Bend(), Twist(), Damping()]
        numbers: dict[str, dict[str, Any]] = {
            "gravity": {"acceleration": list(recording.gravity)},
            "damping": {"rate": number["damping_rate"].reshape(-1, 1, 1)},
        }
        if recording.table_height is not None:
            effects.append(Table())
            numbers["table"] = {"height": recording.table_height}
        scene, params, state = scenes.make(
            [rope],
            effects,
            numbers,
            dt=self.dt,
            substeps=self.substeps,
            integrator="implicit",
            twist="quasistatic",
            held_vertices=self.held,
            held_edges=tuple(edge for edge, _ in self.clamps),
            ahead=_AHEAD,
        )
        params = self._measured_lengths(params, number)
        return scene, params, self._agree(scene, params, state)

    def _rest_shape(self) -> str | Tensor:
        """Return the rest shape at the vertices, flattened on its best plane: markers stand off the rope's axis."""
        if self.rest != "given":
            return "straight"
        points = self.recording.rest_positions
        centre = points.mean(0)
        _, _, axes = np.linalg.svd(points - centre)
        flat = (points - centre) @ axes[:2].T
        shape = CubicSpline(self.mesh.marker_arclength, flat, axis=0)(self.arclength)
        return torch.as_tensor(np.pad(shape, ((0, 0), (0, 1))))

    def _first_director(self, motion: Motion) -> Tensor | None:
        """Return the director of the first edge: that of a clamp, if one holds it, else none."""
        clamped = (
            bool(self.clamps)
            and self.clamps[0][0] < len(self.held)
            and self.held[self.clamps[0][0]] == self.clamps[0][0]
        )
        return motion.director[:, 0, 0] if clamped else None

    def _commands(self, scene: scenes.Scene, state: scenes.State, motion: Motion) -> Tensor:
        """Return directors of the held edges, shape (N, F, G, 3).

        Where the grippers' rotation was not measured, the rope is taken to be without twist at the start.
        """
        if self.measured_twist() or not self.clamps:
            return motion.director
        first = scenes.hold(scene, state).director
        place = {vertex: k for k, vertex in enumerate(self.held)}
        edges = [(place[edge], place[edge + 1]) for edge, _ in self.clamps]
        tangent = normalize(torch.stack([motion.held[:, :, b] - motion.held[:, :, a] for a, b in edges], 2))
        angle = rotation.signed_angle(motion.director[:, 0], first, tangent[:, 0])
        return rotation.about(tangent, angle[:, None], motion.director)

    def _measured_lengths(self, params: scenes.Params, number: dict[str, Tensor]) -> scenes.Params:
        """Put rest lengths as measured along the rope, masses by them, and stiff clamps where grippers end."""
        rods = params.rods
        step = torch.as_tensor(np.diff(self.arclength)).reshape(-1, 1)
        length = torch.cat([step, step.new_ones(1, 1)])
        real = length * rods.rest.edge_mask
        line = self.recording.mass / real.sum() * real
        mass = 0.5 * (line + torch.roll(line, 1, -2))
        extra = torch.zeros_like(mass)
        extra[torch.as_tensor(self.marker_vertex)] = self.recording.marker_mass or 0.0
        # A clamp holds the tangent at its end; the hinge there spans only the free half of its length.
        stiff = torch.ones_like(mass)
        free = np.array([v not in self.held for v in range(len(self.arclength))])
        for v in self.held:
            for beside, edge in ((v - 1, v - 1), (v + 1, v)):
                if 0 < v < len(free) - 1 and 0 <= beside < len(free) and free[beside] and not free[2 * v - beside]:
                    stiff[v] = (real[v - 1] + real[v]) / real[edge]
        material = tree.replace(
            rods.material, mass=mass + extra, bend=rods.material.bend * stiff, twist=rods.material.twist * stiff
        )
        rest = tree.replace(rods.rest, length=length)
        if "rest_share" in number:
            rest = tree.replace(rest, curvature=_turned(rods.rest.curvature, number))
        return tree.replace(params, rods=tree.replace(rods, rest=rest, material=material))

    def _agree(self, scene: scenes.Scene, params: scenes.Params, state: scenes.State) -> scenes.State:
        """Return the state with positions and velocities that keep the rope's length."""
        rest, rods = params.rods.rest, state.rods
        free = torch.ones(scene.topology.size, 1)
        free[list(self.held)] = 0.0
        free = free.to(rods.pos)
        active = rest.edge_mask * (1 - (1 - free) * (1 - torch.roll(free, -1, -2)))
        lengths = Lengths(scene.topology, rest.length, torch.zeros_like(rest.length), active, rest.edge_mask)
        pos, vel = settle(lengths, rods.pos, rods.vel, free / params.rods.material.mass)
        lost = ~torch.isfinite(pos).all(-1).all(-1)[:, None, None]
        pos, vel = torch.where(lost, rods.pos, pos), torch.where(lost, rods.vel, vel)
        return tree.replace(
            state, rods=tree.replace(rods, pos=tree.batch_innermost(pos), vel=tree.batch_innermost(vel))
        )

    def simulate(
        self,
        motion: Motion,
        start: Start,
        values: np.ndarray,
        *,
        frames: int | None = None,
        progress: Callable[[int], None] | None = None,
    ) -> np.ndarray:
        """Return simulated markers [m] for every parameter set and trial.

        Args:
            motion: B trials.
            start: their beginnings, B trials or (P B) ones.
            values: parameter sets, shape (P, K).
            frames: how many frames to simulate; all if not given.
            progress: called with the number of scenes that are done.

        Returns:
            Marker positions, shape (P, B, F, M, 3); NaN from where a simulation failed.
        """
        sets, trials = len(values), len(motion.names)
        total = frames or motion.held.shape[1]
        out = np.empty((sets * trials, total, self.count, 3))
        size = _CHUNK if self.compiled else 4 * _CHUNK
        for a in range(0, sets * trials, size):
            rows = np.arange(a, min(a + size, sets * trials))
            filled = np.resize(rows, size) if self.compiled else rows
            trial = filled % trials
            begin = filled if len(start.pos) == sets * trials else trial
            part = Motion((), motion.held[trial], motion.director[trial], motion.markers[:0], ())
            done = self._run(part, Start(start.pos[begin], start.vel[begin]), values[filled // trials], total)
            out[rows] = done[: len(rows)]
            if progress:
                progress(int(rows[-1]) + 1)
        return out.reshape(sets, trials, total, self.count, 3)

    @torch.no_grad()
    def _run(self, motion: Motion, start: Start, values: np.ndarray, frames: int) -> np.ndarray:
        scene, params, state = self.build(motion, start, values)
        params = tree.map(tree.batch_innermost, params)
        at = list(self.marker_vertex)
        if self._stepper is None or self._stepper[0] != scene:
            self._stepper = scene, scenes.stepper(scene, compiled=self.compiled)
        step = self._stepper[1]
        director = self._commands(scene, state, motion)
        seen = [state.rods.pos[:, at]]
        for k in range(1, frames):
            control = scenes.Control(tree.batch_innermost(motion.held[:, k]), tree.batch_innermost(director[:, k]))
            state = step(params, state, control)
            seen.append(state.rods.pos[:, at])
        return torch.stack(seen, 1).numpy()


def _turned(curvature: Tensor, number: dict[str, Tensor]) -> Tensor:
    """Scale integrated curvatures (..., V, 2) and turn them about the rope's axis."""
    share = number["rest_share"].reshape(-1, 1, 1)
    angle = number["rest_roll"].reshape(-1, 1, 1)
    c, s = torch.cos(angle), torch.sin(angle)
    k1, k2 = curvature[..., :1], curvature[..., 1:]
    return share * torch.cat([c * k1 - s * k2, s * k1 + c * k2], -1)
