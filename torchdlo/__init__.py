"""Differentiable simulation of ropes, cables and wires in PyTorch.

What most programs need, and the parts of the package that have the rest. All of it is imported when it is first used:
`import torchdlo` alone imports nothing else.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from torchdlo import lazy

if TYPE_CHECKING:
    from torchdlo import agents, coupling, envs, physics, report, scene, scene_files, sysid
    from torchdlo.envs import make as make_env
    from torchdlo.errors import InputError
    from torchdlo.scene import RigidBody, Rope, check_state, rollout, stationary_control, step, stepper
    from torchdlo.scene import make as make_scene
    from torchdlo.sysid.calibration.calibrate import calibrate
    from torchdlo.sysid.diagnosis.effect_search import diagnose
    from torchdlo.sysid.experiment_design.design import design_experiment
    from torchdlo.sysid.recordings.recording import load_recording

__version__ = "0.1.0"

__getattr__, __dir__ = lazy.attach(
    __name__,
    {
        "InputError": "torchdlo.errors",
        "Rope": "torchdlo.scene",
        "RigidBody": "torchdlo.scene",
        "make_scene": "torchdlo.scene:make",
        "stationary_control": "torchdlo.scene",
        "step": "torchdlo.scene",
        "stepper": "torchdlo.scene",
        "rollout": "torchdlo.scene",
        "check_state": "torchdlo.scene",
        "make_env": "torchdlo.envs:make",
        "load_recording": "torchdlo.sysid.recordings.recording",
        "calibrate": "torchdlo.sysid.calibration.calibrate",
        "diagnose": "torchdlo.sysid.diagnosis.effect_search",
        "design_experiment": "torchdlo.sysid.experiment_design.design",
        "agents": "torchdlo.agents:",
        "coupling": "torchdlo.coupling:",
        "scene_files": "torchdlo.scene_files:",
        "envs": "torchdlo.envs:",
        "physics": "torchdlo.physics:",
        "report": "torchdlo.report:",
        "scene": "torchdlo.scene:",
        "sysid": "torchdlo.sysid:",
    },
)

__all__ = [
    "InputError",
    "RigidBody",
    "Rope",
    "agents",
    "calibrate",
    "check_state",
    "coupling",
    "design_experiment",
    "diagnose",
    "envs",
    "load_recording",
    "make_env",
    "make_scene",
    "physics",
    "report",
    "rollout",
    "scene",
    "scene_files",
    "stationary_control",
    "step",
    "stepper",
    "sysid",
]
