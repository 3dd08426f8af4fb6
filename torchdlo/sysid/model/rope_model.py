"""The model of a recorded rope: recordings in, simulated markers out, many parameter sets at once.

Its baseline is gravity, an almost inextensible rod, straight or given rest shape, uniform bending and twisting
stiffness, one damping rate, a frictionless table where there is one, buoyancy in a liquid, and clamps that follow the
gripped markers. Effects of the library may be added to it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from torch import Tensor

from torchdlo import scene as scenes
from torchdlo.errors import InputError
from torchdlo.physics import tree
from torchdlo.physics.effects import EFFECTS
from torchdlo.physics.effects.base import Effect, Param
from torchdlo.physics.effects.elastic import Bend, BendFrame, Twist
from torchdlo.physics.effects.external import Damping, Gravity
from torchdlo.physics.effects.fluid import Buoyancy
from torchdlo.physics.effects.parameter_name import ParameterName
from torchdlo.physics.effects.table import Table
from torchdlo.physics.execution import tracing
from torchdlo.physics.linalg import rotation
from torchdlo.physics.linalg.numerics import normalize
from torchdlo.scene import Control, Params, Rope, Scene, State
from torchdlo.sysid.diagnosis import effect_library
from torchdlo.sysid.diagnosis.effect_library import PARAMETERS, Number
from torchdlo.sysid.model import equilibrium, length_projection
from torchdlo.sysid.model.cached_steps import recorded_step
from torchdlo.sysid.model.discretisation import make_mesh
from torchdlo.sysid.model.grip_wrench import ForceWorth, Grip, grip_wrench, grips, packed
from torchdlo.sysid.model.gripper_motion import drive
from torchdlo.sysid.model.marker_observation import Markers
from torchdlo.sysid.model.trial_batch import WINDOW, Start, TrialBatch
from torchdlo.sysid.recordings.recording import Recording, Trial

MAX_SUBSTEP = 5e-3
"""Longest substep [s]; the implicit integrator is stable and accurate to a per cent there."""

_STRETCH = 1e4
"""Axial stiffness [N]: a strain of 1e-4 at 1 N. Real cables are near it, and taut trials stay solvable."""

AHEAD = 0.1
"""How far steps look ahead: real ropes are jerked taut, and what then rings within a substep must die out."""

_PASSES = 2
"""How often a rope is moved to where markers beside it say that it is: its directors, that they sit along, follow."""

_CHUNK = 256
"""Most scenes that run together."""


class RopeModel:
    """A recording's rope on a mesh that has a vertex at every marker."""

    def __init__(
        self,
        recording: Recording,
        *,
        vertices: int | None = None,
        rest: str = "straight",
        effects: Sequence[str] = (),
        substep: float = MAX_SUBSTEP,
        numerical_damping: float = AHEAD,
        clamp_fraction: float = 1.0,
        mass: float | None = None,
        forces: bool = False,
        force_worth: ForceWorth | None = None,
    ) -> None:
        """Prepare the model.

        Args:
            recording: what was measured.
            vertices: about how many vertices; two per marker if not given.
            rest: "straight" or "given".
            effects: names of effects of the library to add to the baseline.
            substep: longest substep [s].
            numerical_damping: see `torchdlo.scene.Scene`.
            clamp_fraction: where clamps hold the rope's direction, see `Mesh.clamp_shares`.
            mass: of the rope [kg], in place of the recording's.
            forces: whether forces at the grippers tell the mass, which then is a number to fit.
            force_worth: what they are worth as readings, which simulations then have behind the markers, see `packed`.
        """
        trial = recording.train[0]
        self.recording, self.rest, self.effects = recording, rest, tuple(effects)
        self.count = trial.markers.shape[1]
        self.mesh = make_mesh(trial, recording.length, vertices)
        self.arclength, self.marker_vertex = self.mesh.arclength, self.mesh.marker_vertex
        self.held, self.clamps = self.mesh.held, self.mesh.clamps
        self.gripped = np.flatnonzero(trial.gripped)
        self.numerical_damping, self.clamp_fraction = numerical_damping, clamp_fraction
        self.mass = recording.mass if mass is None else mass
        for other in (*recording.train, *recording.test):
            same = np.array_equal(other.gripped, trial.gripped)
            if not same or not np.allclose(other.marker_arclength, trial.marker_arclength):
                raise InputError(
                    f"{other.name}.npz: gripped or marker_arclength differ from {trial.name}.npz; "
                    "put trials with other grips into a recording of their own."
                )
        if rest == "given" and recording.rest_positions is None:
            raise InputError(
                "rope.json: rest_positions is missing; expected it for a calibration with the given rest shape."
            )
        self.dt = float(trial.time[1] - trial.time[0])
        measured = [EFFECTS[name] for name in self.effects if EFFECTS[name].kind == "measurement"]
        beside = any(not effect.last for effect in measured)
        felt = None if force_worth is None else next((t for t in recording.train if t.wrench is not None), None)
        self.grips: tuple[Grip, ...] = () if felt is None else grips(self.mesh, felt)
        self.force_worth = force_worth if self.grips else None
        self.markers = Markers(self.marker_vertex, torch.as_tensor(np.array(trial.gripped)), self.dt, beside)
        self.substeps = max(1, int(np.ceil(self.dt / substep - 1e-9)))
        baseline = ["bending_stiffness", "twisting_stiffness", "damping_rate"]
        baseline += ["rest_share", "rest_roll"] if rest == "given" else []
        baseline += ["mass"] if forces else []
        self.numbers = [Number(ParameterName("", n), PARAMETERS[n], float(PARAMETERS[n].scalar)) for n in baseline]
        for name in self.effects:
            self.numbers += effect_library.numbers(name, recording)

    @property
    def readings(self) -> int:
        """Number of readings of a frame: markers, and forces and torques that count."""
        if self.force_worth is None:
            return self.count
        return self.count + len(self.grips) * (1 if self.force_worth[1] is None else 2)

    @property
    def parameters(self) -> list[str]:
        """Names of the numbers to fit."""
        return [n.name for n in self.numbers]

    @property
    def params(self) -> list[Param]:
        """Declarations of the numbers to fit."""
        return [n.param for n in self.numbers]

    @property
    def step(self) -> dict[str, Any]:
        """How the model is stepped, as a model file says it."""
        return {"integrator": "implicit", "twist": "quasistatic", "dt": self.dt, "substeps": self.substeps}

    def guess(self) -> np.ndarray:
        """Return numbers to start from, in the order of `parameters`; effects are off.

        The bending stiffness is the one at which weight bends the rope over a tenth of its length.
        """
        weight = float(self.mass * np.linalg.norm(self.recording.gravity) / self.recording.length)
        bend = max(weight, 1e-4) * (0.1 * self.recording.length) ** 3
        first = {"bending_stiffness": bend, "twisting_stiffness": 0.7 * bend, "mass": self.mass}
        return np.array([first.get(n.name, n.off) for n in self.numbers], dtype=float)

    def motion(self, trials: Sequence[Trial]) -> TrialBatch:
        """Return the grippers' motion of trials, and what was measured."""
        longest = max(len(t.time) for t in trials)
        held, director, measured = [], [], []
        for trial in trials:
            vertices, turns = drive(self.mesh, trial, self.substeps)
            markers = np.where(trial.suspect[:, None, None], np.nan, trial.markers)
            pad = (0, longest - len(trial.time))
            fine = (0, self.substeps * pad[1])
            held.append(np.pad(vertices, (fine, (0, 0), (0, 0)), mode="edge"))
            director.append(np.pad(turns, (fine, (0, 0), (0, 0)), mode="edge"))
            measured.append(np.pad(markers, (pad, (0, 0), (0, 0)), constant_values=np.nan))
        return TrialBatch(
            tuple(t.name for t in trials),
            torch.as_tensor(np.stack(held)),
            torch.as_tensor(np.stack(director)),
            np.stack(measured),
            tuple(len(t.time) for t in trials),
        )

    def measured_twist(self) -> bool:
        """Return whether the grippers' rotation about the rope is measured at every clamp."""
        return all(t.gripper_quaternion is not None for t in self.recording.train)

    def build(self, motion: TrialBatch, start: Start, values: np.ndarray) -> tuple[Scene, Params, State]:
        """Build scenes, one per row of `values` (N, K), `motion` and `start`; all have N trials.

        Markers may be seen late and beside the rope: it begins where they then say that it is.
        """
        number = dict(zip(self.parameters, torch.as_tensor(values).T, strict=True))
        free = ~self.markers.gripped.unsqueeze(-1)
        markers, speed = (torch.as_tensor(x) for x in (start.pos, start.vel))
        if "time_delay" in self.effects:
            markers = markers + free * number["time_delay.delay"].reshape(-1, 1, 1) * speed
        found = self._assembled(motion, markers, speed, number)
        for _ in range(_PASSES if self.markers.beside else 0):
            scene, params, state = found
            here = self.markers.frame(state)
            beside = self.markers.seen(scene, params, [here], late=False)[:, 0] - here[0]
            found = self._assembled(motion, markers - free * beside, speed, number)
        return found

    def _assembled(
        self, motion: TrialBatch, markers: Tensor, speed: Tensor, number: dict[str, Tensor]
    ) -> tuple[Scene, Params, State]:
        """Build scenes that begin with the rope's axis in places (N, M, 3) and with velocities at the markers."""
        pos, vel = (
            torch.as_tensor(CubicSpline(self.mesh.marker_arclength, x.numpy(), axis=1)(self.arclength))
            for x in (markers, speed)
        )
        held = list(self.held)
        pos[:, held] = motion.held[:, 0]
        vel[:, held] = (motion.held[:, 1] - motion.held[:, 0]) / (self.dt / self.substeps)
        rope = Rope(
            pos,
            radius=self.recording.radius or 0.005,
            mass=self.mass,
            # (N, 1): per scene, however many vertices there are.
            bend=number["bending_stiffness"].unsqueeze(-1),
            twist=number["twisting_stiffness"].unsqueeze(-1),
            stretch=_STRETCH,
            velocities=vel,
            rest=self._rest_shape(),
            director=self._first_director(motion),
            rest_director=None if self.rest != "given" else pos.new_tensor([0.0, 0.0, 1.0]),
        )
        scene, params, state = scenes.make(
            [rope],
            self._laws(),
            self._values(number),
            check=False,  # lengths are wrong until they agree
            dt=self.dt / self.substeps,
            substeps=1,
            integrator="implicit",
            twist="quasistatic",
            prescribed_vertices=self.held,
            prescribed_edges=tuple(edge for edge, _ in self.clamps),
            numerical_damping=self.numerical_damping,
            # Measured ropes are seldom slack: stable, and more exact than 0.5 at these steps.
            implicit_weight=0.3,
            # Ropes that are jerked taut need more; others do as well with less.
            constraint_iterations=3 if self.numerical_damping >= AHEAD else 2,
            twist_iterations=4 if self.numerical_damping >= AHEAD else 2,
        )
        params = self._measured_lengths(params, number)
        return scene, params, length_projection.agreeing_state(scene, params, state)

    def _laws(self) -> list[Effect]:
        """Return the effects of the scene."""
        extra = [effect_library.instance(name, self.mesh) for name in self.effects]
        framed = self.rest == "given" or any(e.frame_bending for e in extra)
        table = [Table()] if self.recording.table_height is not None else []
        fluid = [Buoyancy()] if self.recording.fluid_density is not None else []
        return [Gravity(), BendFrame() if framed else Bend(), Twist(), Damping(), *table, *fluid, *extra]

    def _values(self, number: dict[str, Tensor]) -> dict[str, dict[str, Any]]:
        """Return the numbers of the effects: fitted ones with shape (N, 1, C), known ones as they are."""
        numbers: dict[str, dict[str, Any]] = {
            "gravity": {"acceleration": list(self.recording.gravity)},
            "damping": {"rate": number["damping_rate"].reshape(-1, 1, 1)},
        }
        if self.recording.table_height is not None:
            numbers["table"] = {"height": self.recording.table_height}
        if self.recording.fluid_density is not None:
            gravity, density = list(self.recording.gravity), self.recording.fluid_density
            numbers["buoyancy"] = {"density": density, "acceleration": gravity}
        for name in self.effects:
            numbers[name] = dict(effect_library.known(name, self.recording))
            parts: dict[str, list[Tensor]] = {}
            for each in effect_library.numbers(name, self.recording):
                parts.setdefault(each.which.number, []).append(number[each.name])
            numbers[name] |= {key: torch.stack(part, -1).unsqueeze(-2) for key, part in parts.items()}
        return numbers

    def _rest_shape(self) -> Literal["straight"] | Tensor:
        """Return the rest shape at the vertices, flattened on its best plane: markers stand off the rope's axis."""
        points = self.recording.rest_positions
        if self.rest != "given" or points is None:
            return "straight"
        centre = points.mean(0)
        _, _, axes = np.linalg.svd(points - centre)
        flat = (points - centre) @ axes[:2].T
        shape = CubicSpline(self.mesh.marker_arclength, flat, axis=0)(self.arclength)
        return torch.as_tensor(np.pad(shape, ((0, 0), (0, 1))))

    def _first_director(self, motion: TrialBatch) -> Tensor | None:
        """Return the director of the first edge: that of a clamp, if one holds it, else none."""
        edge = self.clamps[0][0] if self.clamps else len(self.held)
        clamped = edge < len(self.held) and self.held[edge] == edge
        return motion.director[:, 0, 0] if clamped else None

    def _commands(self, scene: Scene, state: State, motion: TrialBatch) -> Tensor:
        """Return directors of the held edges, shape (N, S, G, 3).

        Where the grippers' rotation was not measured, the rope is taken to be without twist at the start.
        """
        if self.measured_twist() or not self.clamps:
            return motion.director
        first = scenes.stationary_control(scene, state).director
        place = {vertex: k for k, vertex in enumerate(self.held)}
        edges = [(place[edge], place[edge + 1]) for edge, _ in self.clamps]
        tangent = normalize(torch.stack([motion.held[:, :, b] - motion.held[:, :, a] for a, b in edges], 2))
        angle = rotation.signed_angle(motion.director[:, 0], first, tangent[:, 0])
        return rotation.about(tangent, angle[:, None], motion.director)

    def _measured_lengths(self, params: Params, number: dict[str, Tensor]) -> Params:
        """Put rest lengths as measured along the rope, masses by them, and what hinges at clamps stand for."""
        rods = params.rods
        step = torch.as_tensor(np.diff(self.arclength)).reshape(-1, 1)
        length = torch.cat([step, step.new_ones(1, 1)])
        real = length * rods.rest.edge_mask
        whole = number["mass"].reshape(-1, 1, 1) if "mass" in number else self.mass
        line = whole / real.sum() * real
        mass = 0.5 * (line + torch.roll(line, 1, -2))
        extra = torch.zeros_like(mass)
        extra[..., torch.as_tensor(self.marker_vertex), :] = self.recording.marker_mass or 0.0
        material = tree.replace(rods.material, mass=mass + extra)
        share = torch.as_tensor(self.mesh.clamp_shares(self.clamp_fraction)).unsqueeze(-1)
        rest = tree.replace(rods.rest, length=length, share=share)
        if "rest_share" in number:
            rest = tree.replace(rest, curvature=_turned(rods.rest.curvature, number))
        return tree.replace(params, rods=tree.replace(rods, rest=rest, material=material))

    def simulate(
        self, motion: TrialBatch, start: Start, values: np.ndarray, *, frames: int | None = None
    ) -> np.ndarray:
        """Return simulated markers [m] for every parameter set and trial.

        Args:
            motion: B trials.
            start: their beginnings, B trials or (P B) ones.
            values: parameter sets, shape (P, K).
            frames: how many frames to simulate; all if not given.

        Returns:
            Marker positions, shape (P, B, F, M, 3), NaN from where a simulation failed; if forces count, readings of
            shape (P, B, F, R, 3).
        """
        sets, trials = len(values), len(motion.names)
        out = self.scenes(motion, start, values, np.arange(sets * trials), frames=frames)
        return out.reshape(sets, trials, *out.shape[1:])

    def scenes(
        self, motion: TrialBatch, start: Start, values: np.ndarray, wanted: np.ndarray, *, frames: int | None = None
    ) -> np.ndarray:
        """Return simulated markers [m] of some of the (P B) pairs of parameter sets and trials.

        Args:
            motion: see `simulate`.
            start: likewise.
            values: likewise.
            wanted: indices of the pairs, shape (N,).
            frames: see `simulate`.

        Returns:
            As `simulate`, shape (N, F, M, 3) or (N, F, R, 3).
        """
        trials, total = len(motion.names), frames or motion.markers.shape[1]
        out = np.empty((len(wanted), total, self.readings, 3))
        for rows in np.split(np.arange(len(wanted)), range(_CHUNK, len(wanted), _CHUNK)):
            filled = wanted[np.resize(rows, tracing.batch(len(rows)))]
            trial = filled % trials
            begin = start.pick(trial if len(start.pos) == trials else filled)
            out[rows] = self._read(motion.pick(trial), begin, values[filled // trials], total)[: len(rows)]
            if begin.discretisation_correction is not None:
                out[rows, :, : self.count] += begin.discretisation_correction[: len(rows), :total]
        return out

    def with_forces(
        self, motion: TrialBatch, start: Start, values: np.ndarray, found: Sequence[Grip]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return simulated markers [m] as `simulate`, and what grippers exert on the rope.

        Args:
            motion: see `simulate`.
            start: likewise, for B trials.
            values: likewise.
            found: the grippers.

        Returns:
            Markers (P, B, F, M, 3), and force [N] and torque [N m] (P, B, F, W, 6), NaN in the last frame.
        """
        sets, trials, total = len(values), len(motion.names), motion.markers.shape[1]
        rows = np.arange(sets * trials)
        own, begin = motion.pick(rows % trials), start.pick(rows % trials)
        markers, wrench = self._felt(own, begin, values[rows // trials], total, found)
        if begin.discretisation_correction is not None:
            markers = markers + begin.discretisation_correction[:, :total]
        return (
            markers.reshape(sets, trials, *markers.shape[1:]),
            wrench.reshape(sets, trials, *wrench.shape[1:]),
        )

    def _read(self, motion: TrialBatch, start: Start, values: np.ndarray, frames: int) -> np.ndarray:
        """Return markers (N, F, M, 3) [m], behind them forces if they count, (N, F, R, 3)."""
        if self.force_worth is None:
            return self._run(motion, start, values, frames)
        return packed(*self._felt(motion, start, values, frames, self.grips), self.force_worth)

    def _felt(
        self, motion: TrialBatch, start: Start, values: np.ndarray, frames: int, found: Sequence[Grip]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return markers (N, F, M, 3) and what grippers exert on the rope (N, F, W, 6), NaN in the last frame."""
        wrench = np.full((len(values), frames, len(found), 6), np.nan)

        def keep(force: Tensor, couple: Tensor) -> None:
            places = motion.held[:, : self.substeps * (frames - 1) : self.substeps]
            wrench[:, :-1] = grip_wrench(found, places, force, couple).numpy()

        markers = self._run(motion, start, values, frames, keep)
        return markers, wrench

    @torch.no_grad()
    def _run(
        self,
        motion: TrialBatch,
        start: Start,
        values: np.ndarray,
        frames: int,
        keep: Callable[[Tensor, Tensor], None] | None = None,
    ) -> np.ndarray:
        """Return markers (N, F, M, 3); `keep` is given forces on held vertices (N, F - 1, H, 3) and couples."""
        scene, params, state = self.build(motion, start, values)
        params = tree.map(tree.batch_innermost, params)
        director = self._commands(scene, state, motion)
        count = (frames - 1) * self.substeps + 1
        controls = [*map(Control, _by_step(motion.held, count), _by_step(director, count))]
        step = recorded_step(scene, params, state, controls[0], reactions=keep is not None)
        if start.still is not None and start.still.any():
            resting = equilibrium.come_to_rest(scene, params, state, controls[0])
            resting = self._corrected(step, scene, params, resting, controls, motion)
            state = tree.map(tree.batch_innermost, tree.where(torch.as_tensor(start.still), resting, state))
        seen, force, couple = [self.markers.frame(state)], [], []
        for k, control in enumerate(controls[1:], 1):
            state = step(params, state, control)
            if keep is not None and (k - 1) % self.substeps == 0:
                # A substep is led by the forces where it begins.
                force.append(state.reaction.force)
                couple.append(state.reaction.couple)
            if k % self.substeps == 0:
                seen.append(self.markers.frame(state))
        if keep is not None:
            keep(torch.stack(force, 1), torch.stack(couple, 1))
        return self.markers.seen(scene, params, seen, late=True).numpy()

    def _corrected(
        self,
        step: Callable,
        scene: Scene,
        params: Params,
        state: State,
        controls: Sequence[Control],
        motion: TrialBatch,
    ) -> State:
        """Return a resting state moved, and set in motion, as the markers say in the first tenth of a second."""
        free = np.setdiff1d(np.arange(self.count), self.gripped)
        frames = min(1 + round(WINDOW / self.dt), motion.markers.shape[1], 1 + (len(controls) - 1) // self.substeps)
        shapes = equilibrium.smooth_shapes(self.mesh, free)
        if shapes is None or frames < 4:
            return state
        at, seen, now = list(self.marker_vertex), [], state
        for k, control in enumerate(controls[: (frames - 1) * self.substeps + 1]):
            now = step(params, now, control) if k else state
            if k % self.substeps == 0:
                seen.append(self.markers.frame(now))
        gap = motion.markers[:, :frames] - self.markers.seen(scene, params, seen, late=False).numpy()
        shift, drift = (
            torch.as_tensor(x) for x in equilibrium.explain_gap(gap[:, :, free], shapes[at][free], self.dt, shapes)
        )
        rods = tree.replace(state.rods, pos=state.rods.pos + shift, vel=state.rods.vel + drift)
        return length_projection.agreeing_state(scene, params, tree.replace(state, rods=rods))


def _by_step(x: Tensor, count: int) -> list[Tensor]:
    """Return the first of commands (N, S, V, C) by step, each stored with the batch innermost."""
    stored = x[:, :count].permute(1, 3, 2, 0).contiguous()
    return [tree.logical(each) for each in stored.unbind()]


def _turned(curvature: Tensor, number: dict[str, Tensor]) -> Tensor:
    """Scale integrated curvatures (..., V, 2) and turn them about the rope's axis."""
    share, angle = (number[name].reshape(-1, 1, 1) for name in ("rest_share", "rest_roll"))
    c, s = torch.cos(angle), torch.sin(angle)
    k1, k2 = curvature[..., :1], curvature[..., 1:]
    return share * torch.cat([c * k1 - s * k2, s * k1 + c * k2], -1)
