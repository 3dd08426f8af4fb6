"""What grippers do to a rope: the motion of its held vertices and of its clamps, at every substep.

Between the frames of a recording grippers move smoothly: positions follow modified Akima curves, which do not overshoot
where a marker jumps (Akima 1970, doi:10.1145/321607.321609), and measured rotations follow a rotation spline.
"""

from __future__ import annotations

import numpy as np
from scipy.interpolate import Akima1DInterpolator
from scipy.spatial.transform import Rotation, RotationSpline

from torchdlo.sysid.model.discretisation import Mesh
from torchdlo.sysid.recordings.recording import Trial


def drive(mesh: Mesh, trial: Trial, substeps: int) -> tuple[np.ndarray, np.ndarray]:
    """Return positions of the held vertices [m], (S, H, 3), and first directors of the clamps, (S, G, 3).

    Where the rotation of a clamp is measured, its markers only say where it is: two markers close together tell its
    direction much worse.

    Args:
        mesh: the rope.
        trial: a trial with F frames.
        substeps: substeps per frame; S = (F - 1) substeps + 1.
    """
    held = list(mesh.held)
    pos = mesh.along(trial.markers, trial.gripped)[:, held]
    turns = _rotations(mesh, trial)
    for clamp, rotation in turns.items():
        markers = mesh.runs[clamp]
        at = mesh.marker_arclength[markers]
        centre, axis = trial.markers[:, markers].mean(1), rotation.apply([1.0, 0.0, 0.0])
        for k, vertex in enumerate(held):
            s = mesh.arclength[vertex]
            if at[0] - 1e-9 <= s <= at[-1] + 1e-9:
                pos[:, k] = centre + (s - at.mean()) * axis
    director = mesh.directors(trial)
    time, fine = trial.time, np.linspace(0.0, trial.time[-1], (len(trial.time) - 1) * substeps + 1)
    if substeps > 1:
        pos = Akima1DInterpolator(time, pos, method="makima")(fine)
        turned = Akima1DInterpolator(time, director, method="makima")(fine) if director.shape[1] else director[:1]
        for clamp, rotation in turns.items():
            turned[:, clamp] = RotationSpline(time, rotation)(fine).apply([0.0, 1.0, 0.0])
        director = np.repeat(director[:1], len(fine), 0) if not director.shape[1] else turned
        director = director / np.linalg.norm(director, axis=-1, keepdims=True).clip(1e-12)
    return pos, director


def _rotations(mesh: Mesh, trial: Trial) -> dict[int, Rotation]:
    """Return the measured rotations by the index of their clamp."""
    if trial.gripper_quaternion is None or trial.gripper_marker is None:
        return {}
    where = {int(marker): g for g, marker in enumerate(trial.gripper_marker)}
    return {
        k: Rotation.from_quat(trial.gripper_quaternion[:, where[marker]], scalar_first=True)
        for k, (_, marker) in enumerate(mesh.clamps)
        if marker in where
    }
