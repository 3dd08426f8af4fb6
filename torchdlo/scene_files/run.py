"""Running a described scene from its start to its end, and the file that keeps what happened."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchdlo import measures, scene_files
from torchdlo import scene as scenes
from torchdlo.errors import InputError
from torchdlo.files import replace_atomically
from torchdlo.physics import tree
from torchdlo.physics.execution import Execution
from torchdlo.scene_files import frames_checks, limits
from torchdlo.scene_files.json_files import EFFECTS
from torchdlo.untrusted.array_file import ArrayFile

__all__ = ["Frames", "appearance", "load_frames", "run", "save_frames"]

MOST = 2 * 2**30
"""Most that the frames of a run take [bytes]."""
_OLDER = {"material_points": "matter", "constitutive_model": "law", "camera_direction": "look"}
"""What arrays were called in files of version 0.1."""


@dataclass(frozen=True, eq=False)
class Frames:
    """What happened, F moments of it, and what one needs to draw it."""

    time: np.ndarray
    """Moments [s], shape (F,)."""
    pos: np.ndarray
    """Vertex positions [m], shape (F, V, 3)."""
    twist: np.ndarray
    """Twist of edges against their reference frames [rad], shape (F, V)."""
    force: np.ndarray
    """Forces that attachments exert on held vertices, each vertex once [N], shape (F, H, 3)."""
    body_pos: np.ndarray
    """Positions of bodies, those of robots' links last [m], shape (F, K, 3)."""
    body_quat: np.ndarray
    """Orientations of bodies (w, x, y, z) [1], shape (F, K, 4)."""
    material_points: np.ndarray
    """Material points [m], shape (F, P, 3)."""
    rope: np.ndarray
    """Number of the rope that each vertex belongs to, shape (V,)."""
    closed: np.ndarray
    """Whether ropes are closed, shape (R,)."""
    radius: np.ndarray
    """Radii of the edges after vertices [m], shape (V,)."""
    weight: np.ndarray
    """Masses that hang on vertices [kg], shape (V,)."""
    body_shape: np.ndarray
    """Shapes of bodies as in `shapes.SIZES`, shape (K,)."""
    body_size: np.ndarray
    """Their sizes, see there [m or rad], shape (K, 3)."""
    body_motion: np.ndarray
    """"free", "fixed", "kinematic", or "robot" for the links of one, shape (K,)."""
    mesh_vertices: np.ndarray
    """Vertices of all meshes, in the frames of their bodies [m], shape (M, 3)."""
    mesh_faces: np.ndarray
    """Their triangles, shape (T, 3)."""
    mesh_body: np.ndarray
    """The body of each triangle, shape (T,)."""
    constitutive_model: np.ndarray
    """Constitutive model of each material point, shape (P,)."""
    table: np.ndarray
    """Heights of tables that effects hold [m], shape (0,) or (1,)."""
    camera_direction: np.ndarray
    """Direction from the scene to the camera, shape (3,)."""
    joint_force: np.ndarray = field(default_factory=lambda: np.zeros((0, 0, 3)))
    """Forces that joints exert on their ropes [N], shape (F, N, 3); of films that have none, (F, 0, 3)."""
    tension: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    """Tension of the edges after vertices in the last substep [N], shape (F, V). Of this and all that follows there are
    no frames, (0, ...), in films and in files of older versions."""
    curvature: np.ndarray = field(default_factory=lambda: np.zeros((0, 0, 3)))
    """Curvature at vertices, as a vector about which the rope bends [1/m], shape (F, V, 3)."""
    twist_density: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    """Twist at vertices [rad/m], shape (F, V)."""
    bending_moment: np.ndarray = field(default_factory=lambda: np.zeros((0, 0, 3)))
    """Bending moment at vertices [N m], shape (F, V, 3)."""
    contact_force: np.ndarray = field(default_factory=lambda: np.zeros((0, 0, 3)))
    """What contact exerted on vertices, mean over the last step [N], shape (F, V, 3)."""
    body_contact_force: np.ndarray = field(default_factory=lambda: np.zeros((0, 0, 3)))
    """What ropes and particles exerted on bodies, likewise; see `measures.contact_forces` [N], shape (F, K, 3)."""
    kinetic_energy: np.ndarray = field(default_factory=lambda: np.zeros(0))
    """Kinetic energy of ropes, half a substep before positions [J], shape (F,)."""
    gravitational_energy: np.ndarray = field(default_factory=lambda: np.zeros(0))
    """Energy of the ropes' weight, zero at the origin [J], shape (F,)."""
    bending_energy: np.ndarray = field(default_factory=lambda: np.zeros(0))
    """Energy of bending [J], shape (F,)."""
    twisting_energy: np.ndarray = field(default_factory=lambda: np.zeros(0))
    """Energy of twisting [J], shape (F,)."""
    body_kinetic_energy: np.ndarray = field(default_factory=lambda: np.zeros(0))
    """Kinetic energy of free bodies, half a substep before their poses [J], shape (F,)."""
    body_gravitational_energy: np.ndarray = field(default_factory=lambda: np.zeros(0))
    """Energy of their weight, zero at the origin [J], shape (F,)."""
    interrupted: bool = False
    """Whether it was stopped before its end."""
    problem: str = ""
    """What went wrong, "" if nothing did; frames end before it."""


_MOVING = ("time", "pos", "twist", "force", "body_pos", "body_quat", "material_points", "joint_force")
"""What `_seen` returns, by the names of `Frames`."""

_ENERGIES = (
    *("kinetic_energy", "gravitational_energy", "bending_energy", "twisting_energy"),
    *("body_kinetic_energy", "body_gravitational_energy"),
)
_MEASURED = (
    *("tension", "curvature", "twist_density", "bending_moment", "contact_force", "body_contact_force"),
    *_ENERGIES,
)
"""What `_measured` returns, by the names of `Frames`."""
_OPTIONAL = ("joint_force", *_MEASURED)
"""Arrays that a file may lack."""
_FEW = 50
"""Steps that are not worth recording."""


def _seen(scene: scenes.Scene, state: scenes.State) -> list[np.ndarray]:
    rods, none = state.rods, state.rods.pos.new_zeros(0, 4)
    bodies = (state.bodies.pos, state.bodies.quat) if state.bodies else (none[:, :3], none)
    # Pictures need no more digits, and there are many points.
    material_points = (state.material_points.pos if state.material_points else none[:, :3]).to(torch.float32)
    joined = none[:, :3] if scene.joints is None else scenes.joint_forces(scene, state)[0]
    found = (state.time[0, 0], rods.pos, rods.twist[:, 0], state.reaction.force, *bodies, material_points, joined)
    return [x.cpu().numpy().copy() for x in found]


def _measured(
    made: scene_files.Simulation, state: scenes.State, last: tuple[scenes.State, scenes.Control] | None
) -> list[np.ndarray]:
    """Return what mechanics says of a state.

    Args:
        made: what is run.
        state: it, now.
        last: the state before the last step, and the control of the step; None at the start, before all contact.
    """
    given, pos = (made.scene, made.params, state), state.rods.pos
    force, body_force = torch.zeros_like(pos), pos.new_zeros(len(made.scene.bodies), 3)
    if last is not None and any(e.is_contact for e in made.scene.effects):
        # Contact is found with the motion that it allows, so the step is made once more.
        push = measures.contact_forces(made.scene, made.params, *last)
        force, body_force = push.force, push.body_force
    tension, twist = (measure(*given)[..., 0] for measure in (measures.tension, measures.twist))
    along = tension, measures.curvature(*given), twist, measures.bending_moment(*given), force, body_force
    energies = (getattr(measures, name)(*given) for name in _ENERGIES)
    # Seven digits are enough to look at, and there are many vertices.
    return [x.to(torch.float32).cpu().numpy() for x in along] + [x.cpu().numpy().copy() for x in energies]


def appearance(
    scene: scenes.Scene, params: scenes.Params, meshes: Mapping[int, tuple[Tensor, Tensor]], robots: int = 0
) -> dict[str, np.ndarray]:
    """Return what stays the same in pictures, by the names of `Frames`; of a batch, of its first scene.

    Args:
        scene: the scene.
        params: its parameters.
        meshes: vertices [m] and triangles of bodies that are meshes, by the number of the body.
        robots: how many of the bodies, the last ones, are links of robots.
    """
    counts, own = scene.topology.counts, len(scene.bodies) - robots
    vertices, faces, owner, start = [np.zeros((0, 3))], [np.zeros((0, 3), int)], [np.zeros(0, int)], 0
    for k, (corners, triangles) in meshes.items():
        vertices.append(corners.numpy())
        faces.append(triangles.numpy() + start)
        owner.append(np.full(len(triangles), k))
        start += len(corners)
    groups = scene.material_points.groups if scene.material_points else ()
    heights = [v["height"].reshape(-1)[:1].numpy() for n, v in params.effects.items() if n.startswith("table")]
    radius = params.rods.material.radius
    return {
        "rope": np.repeat(np.arange(len(counts)), counts),
        "closed": np.array(scene.topology.closed, bool),
        "radius": radius.reshape(-1, radius.shape[-2])[0].numpy(),
        "weight": np.zeros(sum(counts)),
        "body_shape": np.array([b.shape for b in scene.bodies], str),
        "body_size": tree.part(params.bodies).size.reshape(-1, len(scene.bodies), 3)[0].numpy()
        if scene.bodies
        else np.zeros((0, 3)),
        "body_motion": np.array([b.motion if k < own else "robot" for k, b in enumerate(scene.bodies)], str),
        "mesh_vertices": np.concatenate(vertices),
        "mesh_faces": np.concatenate(faces),
        "mesh_body": np.concatenate(owner),
        "constitutive_model": np.repeat([g.law.name for g in groups] or np.zeros(0, str), [g.count for g in groups]),
        "table": heights[0] if heights else np.zeros(0),
    }


def _looks(made: scene_files.Simulation, description: scene_files.SceneDescription) -> dict[str, np.ndarray]:
    meshes = {k: (mesh.vertices, mesh.faces) for k, mesh in made.meshes.items()}
    seen = appearance(made.scene, made.params, meshes, len(made.scene.bodies) - len(description.bodies))
    return seen | {"weight": made.weight[:, 0].numpy(), "camera_direction": np.array(description.camera_direction)}


def run(
    description: scene_files.SceneDescription,
    *,
    folder: str | Path = ".",
    frame_stride: int = 10,
    execution: Execution = "recorded",
    callback: Callable[[str, int, int, str], None] | None = None,
) -> Frames:
    """Run a scene and keep a frame of its start and after every `frame_stride` steps.

    A `KeyboardInterrupt` that `callback` raises ends the run, as does a state that is not sound; frames so far are
    returned.

    Args:
        description: the scene.
        folder: where the files that it names are looked for.
        frame_stride: steps per frame.
        execution: how steps run; to compile them is worth it for long runs, to record them from 50 steps on.
        callback: told (stage, steps done, steps in all, message) after every frame.
    """
    limits.check_ranges(description, EFFECTS)
    limits.check_memory(description, frame_stride=frame_stride)
    limits.check_time(description, execution=execution)
    made = scene_files.assemble(description, folder=folder)
    scene, params, state = made.scene, made.params, made.state
    control = made.plan.follow(scene)
    total = max(1, round(description.duration / description.dt))
    step = scenes.stepper(scene, execution="eager" if execution == "recorded" and total <= _FEW else execution)
    with torch.no_grad():
        kept, interrupted, problem = [[*_seen(scene, state), *_measured(made, state, None)]], False, ""
        for k in range(total):
            last = state, control(k, state)
            state = step(params, *last)
            if (k + 1) % frame_stride and k + 1 < total:
                continue
            try:
                scenes.check_state(state)
            except RuntimeError as error:
                problem = f"after {float(state.time):g} s: {error}"
                break
            kept.append([*_seen(scene, state), *_measured(made, state, last)])
            try:
                if callback is not None:
                    callback("simulate", k + 1, total, f"{float(state.time):.3g} s")
            except KeyboardInterrupt:
                interrupted = True
                break
    moving = (np.stack(parts) for parts in zip(*kept, strict=True))
    whole: dict[str, Any] = {**_looks(made, description), "interrupted": interrupted, "problem": problem}
    whole |= zip((*_MOVING, *_MEASURED), moving, strict=True)
    return Frames(**whole)


def save_frames(frames: Frames, path: Path, description: scene_files.SceneDescription | None = None) -> None:
    """Write frames as .npz, with the scene itself as JSON text in "torchdlo_scene", "" if it is not given."""
    arrays: dict[str, Any] = {name: value for name, value in vars(frames).items() if isinstance(value, np.ndarray)}
    for name in _OPTIONAL:
        if not arrays[name].size:
            del arrays[name]
    text = "" if description is None else scene_files.text(description)
    with replace_atomically(path) as temporary:
        np.savez_compressed(temporary, torchdlo_scene=np.array(text), **arrays)


def load_frames(path: str | Path) -> Frames:
    """Read what `save_frames` wrote; `path` may be the folder of the run."""
    path = Path(path)
    file = path / "frames.npz" if path.is_dir() else path
    names = [f.name for f in fields(Frames) if f.type == "np.ndarray"]
    cure = "torchdlo simulate --out writes them"
    with ArrayFile(file, "the frames of a run", most=MOST, cure=cure) as found:
        stored = {name: _OLDER.get(name, name) for name in names}
        stored = {name: name if name in found.headers else older for name, older in stored.items()}
        names = [name for name in names if name not in _OPTIONAL or name in found.headers]
        stored = {name: stored[name] for name in names}
        missing = [name for name in names if stored[name] not in found.headers]
        if missing:
            raise InputError(f"{file}: lacks {', '.join(missing)}; simulate the scene again with this version.")
        frames_checks.check_headers(file, found.headers, stored)
        found.check_size(stored.values())
        arrays: dict[str, Any] = {name: found[stored[name]] for name in names}
    frames_checks.check_values(file, arrays)
    arrays |= {name: frames_checks.none_of(name, arrays) for name in _OPTIONAL if name not in arrays}
    return Frames(**arrays)
