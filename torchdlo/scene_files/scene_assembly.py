"""From a description to the scene, its parameters, its first state, and what is commanded."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchdlo import scene as scenes
from torchdlo.coupling import scene_notices
from torchdlo.coupling.bodies.dynamics import RigidBody
from torchdlo.coupling.bodies.mesh_sdf import MeshShape, load_mesh
from torchdlo.coupling.mpm import particles
from torchdlo.coupling.mpm.constitutive_models import ConstitutiveModel, Elastic, Liquid, Plastic, Sand
from torchdlo.coupling.robot import robot_kinematics as robots
from torchdlo.errors import InputError
from torchdlo.physics import tree
from torchdlo.scene_files import limits, motion
from torchdlo.scene_files.checks import check_duration, check_joints, check_keyframes
from torchdlo.scene_files.held_parts import check_holds, holds_of
from torchdlo.scene_files.json_files import EFFECTS, like, read
from torchdlo.scene_files.rope_models import with_models
from torchdlo.scene_files.ropes import hanging_masses, pulling, rope_of, twisted
from torchdlo.scene_files.schema import BodySpec, ParticleBlockSpec, SceneDescription
from torchdlo.untrusted import one_line

__all__ = ["Simulation", "assemble", "build", "load"]

_LAWS: dict[str, type[ConstitutiveModel]] = {law.name: law for law in (Elastic, Plastic, Liquid, Sand)}
_BODY_OWN = ("keyframes", "path", "file", "scale", "cells")
"""Entries of a body that are not fields of `RigidBody`."""


@dataclass(frozen=True, eq=False)
class Simulation:
    """A scene that is ready to run."""

    scene: scenes.Scene
    params: scenes.Params
    state: scenes.State
    plan: motion.ControlPlan
    meshes: dict[int, MeshShape]
    """Meshes of bodies, by the number of the body."""
    weight: Tensor
    """Masses that hang on vertices [kg], shape (V, 1)."""


def load(path: str | Path) -> tuple[scenes.Scene, scenes.Params, scenes.State, scenes.Control]:
    """Return the scene of a file, its parameters, its first state, and the controls of all steps."""
    description = read(path)
    try:
        return build(description, folder=Path(path).parent)
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None


def build(
    description: SceneDescription, *, folder: str | Path = "."
) -> tuple[scenes.Scene, scenes.Params, scenes.State, scenes.Control]:
    """Return the scene, its parameters, its first state, and the controls of all steps, with time as the first axis.

    Args:
        description: what to build.
        folder: where the files that it names are looked for.
    """
    made = assemble(description, folder=folder)
    if made.plan.held is not None:
        late = next(k for k, h in enumerate(description.attachments) if h.close > 0)
        raise InputError(
            f"attachments[{late}].close: how a hold sits that closes during the run depends on the run; use "
            "torchdlo.scene_files.assemble(...).plan.follow(scene), or torchdlo.scene_files.run.run."
        )
    return made.scene, made.params, made.state, made.plan.controls


_STEPPING = (
    *("dt", "substeps", "integrator", "contact", "twist", "constrained"),
    *("constraint_iterations", "twist_iterations", "implicit_weight", "numerical_damping"),
)
"""What a description says of steps, in the words of `scene.Scene`."""


def assemble(description: SceneDescription, *, folder: str | Path = ".") -> Simulation:
    """Return what a description says, ready to run.

    Args:
        description: what to build.
        folder: where the files that it names are looked for.
    """
    folder = Path(folder)
    limits.check_ranges(description, EFFECTS)
    limits.check_memory(description)
    d, modelled = with_models(description, folder)
    dtype = getattr(torch, d.precision)
    ropes = [rope_of(r, k, dtype, modelled) for k, r in enumerate(d.ropes)]
    counts = [r.positions.shape[-2] for r in ropes]
    effects, values = [], {}
    for name, given in d.effects.items():
        kind = EFFECTS[name]
        choices = {k: tuple(v) if isinstance(v, (list, tuple)) else v for k, v in given.items() if k not in kind.params}
        effects.append(kind(**choices))
        values[kind.name] = {k: v for k, v in given.items() if k in kind.params}
    effects += pulling(d, counts)
    meshes = {k: _mesh(b, k, folder) for k, b in enumerate(d.bodies) if b.shape == "mesh"}
    bodies = [_body(b, k, meshes.get(k)) for k, b in enumerate(d.bodies)]
    static = {name: getattr(d, name) for name in _STEPPING}
    check_duration(d)
    check_keyframes(d)
    check_joints(d)
    check_holds(d)
    holds = holds_of(d, counts)
    held: dict[str, Any] = {f"prescribed_{part}": getattr(holds, part).slots for part in ("vertices", "edges")}
    armed = motion.arms(d, folder)
    for arm in armed:
        bodies += robots.solids(arm.robot, arm.joints[0])
    joints = [scenes.RopeJoint(**vars(joint)) for joint in d.joints]
    held |= {"material_points": _matter(d, dtype), "clamp": d.clamp}
    scene, params, state = scenes.make(ropes, effects, values, bodies=bodies, joints=joints, **held, **static)
    weight = hanging_masses(d, counts, state.rods.pos)
    if bool((weight > 0).any()):
        scene_notices.mention_sweeps(scene.settings, bool(scene.bodies))
    material = tree.replace(params.rods.material, mass=params.rods.material.mass + weight)
    params = tree.replace(params, rods=tree.replace(params.rods, material=material))
    scenes.check_step(scene, params)  # with what hangs on ropes
    state = twisted(d, scene, params, state)
    return Simulation(scene, params, state, motion.plan(d, scene, state, armed, holds), meshes, weight)


def _mesh(body: BodySpec, k: int, folder: Path) -> MeshShape:
    if body.file is None:
        raise InputError(f"bodies[{k}].file: is missing; expected the file of the mesh (STL, OBJ, PLY, ...).")
    if body.size:
        raise InputError(f"bodies[{k}].size: a mesh is as large as its file says; use scale.")
    if body.scale <= 0 or body.cells < 4:
        raise InputError(
            f"bodies[{k}]: expected a scale above 0 and at least 4 cells, given {body.scale:g} and {body.cells}."
        )
    return load_mesh(folder / body.file, scale=body.scale, cells=body.cells)


def _body(body: BodySpec, k: int, mesh: MeshShape | None) -> RigidBody:
    given = {name: v for name, v in vars(body).items() if name not in _BODY_OWN}
    if mesh is None:
        if body.file is not None:
            raise InputError(f'bodies[{k}].file: only a mesh has one; give "shape": "mesh".')
        return RigidBody(**given)
    one = body.mass is not None or body.density is not None
    wanted = {name: v for name, v in given.items() if name not in ("shape", "size") and v is not None}
    if not one and body.motion == "free":
        raise InputError(f"bodies[{k}]: give a free body either mass or density.")
    return mesh.solid(**wanted)


def _matter(d: SceneDescription, dtype: torch.dtype) -> tuple:
    """Return what `scene.make` wants as material points; () if there is none."""
    if not d.material_points:
        if d.box is not None:
            raise InputError("box: there are no material points in it; give material_points, or leave out the box.")
        return ()
    if d.box is None:
        raise InputError(
            "box: is missing; expected the region in which material points may be, with low, high and spacing."
        )
    zero = torch.zeros((), dtype=dtype)
    blobs = [_blob(m, k, zero) for k, m in enumerate(d.material_points)]
    fields = {f.name: getattr(d.box, f.name) for f in dataclasses.fields(particles.Grid)}
    return particles.assemble(blobs, particles.Grid(**fields), friction=d.box.friction)


def _blob(m: ParticleBlockSpec, k: int, zero: Tensor) -> particles.ParticleBlock:
    here, law = f"material_points[{k}]", _LAWS[m.constitutive_model]()
    count = {"box": 3, "ball": 1}[m.shape]
    if len(m.size) != count or min(m.size) <= 0:
        raise InputError(
            f"{here}.size: expected {count} numbers above 0 for a {m.shape}, given {one_line(list(m.size), 60)}."
        )
    if not 0 < m.spacing <= 2 * min(m.size):
        raise InputError(f"{here}.spacing: expected more than 0, up to its own size, given {m.spacing:g}.")
    known = [*law.params, "density"]
    for name in m.parameters:
        if name not in known:
            raise InputError(f"{here}.parameters.{name}: there is no such parameter; {like(name, known)}.")
    if m.shape == "box":
        low, high = ([c + s * h for c, h in zip(m.pos, m.size, strict=True)] for s in (-1, 1))
        points = particles.fill_box(low, high, m.spacing, zero)
        volume = 8 * m.size[0] * m.size[1] * m.size[2] / len(points)
    else:
        points, volume = particles.fill_ball(m.pos, m.size[0], m.spacing, zero), m.spacing**3
    return particles.ParticleBlock(points, law, volume, zero.new_tensor(m.vel), dict(m.parameters))
