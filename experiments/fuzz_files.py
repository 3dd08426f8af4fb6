"""Damaged files of every kind, and what reading them ends in: a value, the input error, or else, which is a fault.

    python experiments/fuzz_files.py --cases 10000 --out runs/fuzz.json

Cases are numbered: a kind and a number are the same file always. Sound files are damaged in their structure (entries of
JSON, arrays of archives) and in their bytes. Told are counts, the slowest case, and by how much memory rose at most.
"""

from __future__ import annotations

import copy
import io
import json
import pickle
import random
import resource
import sys
import tempfile
import time
import traceback
import warnings
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch
from options import Parser, count, save

from torchdlo.errors import InputError

SLOW = 5.0
"""No case takes longer [s]."""
LARGE = 1e9
"""No case takes more memory [bytes]."""


@dataclass(frozen=True)
class Kind:
    """A kind of file."""

    name: str
    """What it is called in a folder."""
    sound: Callable[[Path], None]
    """Writes a sound one into a folder, with all that belongs to it."""
    read: Callable[[Path], Any]
    """Reads the folder."""


@dataclass
class Tally:
    """What cases of a kind ended in."""

    values: int = 0
    refused: int = 0
    faults: list[str] = field(default_factory=list)
    slowest: float = 0.0
    """Processor time of the slowest case [s]."""
    memory: float = 0.0
    """By how much the largest memory of the process rose [bytes]."""


HOSTILE: tuple[Any, ...] = (
    *(None, True, False, 0, -1, 1, 5.7, 1e12, 1e308, -1e308, 1e-320, 10**18, 2**63 - 1, -0.0),
    *("", "x", "$\\foo$", "\x1b[2J", "\ud800", "<!--<script>", "../../etc/passwd", "/dev/zero", "a" * 3000, "NaN"),
    *([], {}, [[]], [{}], [None], [1e308] * 3, [[1, 2], [3]], {"": {}}, [0] * 5000, [[[[[[1]]]]]]),
)
RAW = ("NaN", "Infinity", "-Infinity", "1e999", "9" * 401, "9" * 5000, "[" * 5000, "-", "1.", '{"a":1,"a":2}', "nul")
"""Texts in the place of a value of JSON."""


def places(value: Any, here: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Return the places of all values in others."""
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [here, *(place for key, part in inner for place in places(part, (*here, key)))]


def spoiled_json(text: str, rng: random.Random) -> str:
    """Return JSON with some entries changed, lost, doubled or renamed."""
    content, raw = json.loads(text), {}
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        *above, last = rng.choice(places(content)[1:] or [((),)])
        at = content
        for key in above:
            at = at[key]
        how = rng.random()
        now = at[last]
        if how < 0.25 and isinstance(now, (int, float)) and not isinstance(now, bool):
            at[last] = rng.choice((now + 1, now - 1, -now, 2 * now, 1.3 * now, 1e-3 * now, 1e3 * now))
        elif how < 0.55:
            at[last] = copy.deepcopy(rng.choice(HOSTILE))
        elif how < 0.7:
            at[last] = f"@raw{len(raw)}@"
            raw[f'"@raw{len(raw)}@"'] = rng.choice(RAW)
        elif how < 0.8:
            del at[last]
        elif isinstance(at, list):
            at.extend(copy.deepcopy(at) * rng.choice((1, 30)))
        else:
            at[rng.choice((f"{last}s", "", "\x00", "format", "name"))] = at.pop(last)
        if not isinstance(content, (dict, list)) or not content:
            break
    written = json.dumps(content)
    for name, instead in raw.items():
        written = written.replace(name, instead)
    return written


def spoiled_bytes(content: bytes, rng: random.Random) -> bytes:
    """Return bytes with some flipped, cut, doubled, put in or overwritten."""
    found = bytearray(content)
    for _ in range(rng.choice((1, 1, 2, 5, 20))):
        at = rng.randrange(len(found) + 1)
        how = rng.random()
        if how < 0.4 and at < len(found):
            found[at] ^= 1 << rng.randrange(8)
        elif how < 0.5:
            del found[at:]
        elif how < 0.6:
            del found[at : at + rng.randrange(1, 64)]
        elif how < 0.75:
            found[at:at] = rng.randbytes(rng.randrange(1, 9))
        elif how < 0.85:
            found[at : at + 8] = rng.choice((bytes(8), b"\xff" * 8, b"\x7f" + b"\xff" * 7))
        else:
            other = rng.randrange(len(found) + 1)
            found[at:at] = found[other : other + rng.randrange(1, 200)]
        if not found:
            break
    return bytes(found)


def spoiled_archive(content: bytes, rng: random.Random) -> bytes:
    """Return an .npz with arrays changed, lost, renamed, of other types, or with headers that lie."""
    with np.load(io.BytesIO(content)) as found:
        arrays: dict[str, Any] = {name: found[name].copy() for name in found.files}
    lies: dict[str, bytes] = {}
    for _ in range(rng.choice((1, 1, 2))):
        name = rng.choice(sorted(arrays))
        array, how = arrays[name], rng.random()
        if how < 0.35 and array.size and array.dtype.kind in "fiu":
            extreme = (np.nan, np.inf, 1e300, -1, 0) if array.dtype.kind == "f" else (0, 1, 10**9, 127)
            flat = array.reshape(-1)
            with np.errstate(over="ignore"):
                flat[rng.randrange(flat.size)] = np.array(rng.choice(extreme)).astype(array.dtype)
        elif how < 0.5:
            arrays[name] = (
                array.reshape(rng.choice(((-1,), (1, -1), (-1, 1), (1, 1, -1)))) if array.size else array[None]
            )
        elif how < 0.6:
            arrays[name] = array[: rng.randrange(2)] if array.ndim else array[None]
        elif how < 0.7:
            with np.errstate(all="ignore"), warnings.catch_warnings():
                warnings.simplefilter("ignore")
                kinds = ["U5", bool] if array.dtype.kind == "U" else ["f4", "i8", "u1", "c16", "U3", bool, object]
                arrays[name] = array.astype(rng.choice(kinds))
        elif how < 0.8:
            arrays[rng.choice(("x", "", "../x", "masks", name + "s"))] = arrays.pop(name)
        else:
            shape = rng.choice(
                ("(1000000000000,)", "(-1,)", "(1e3,)", "(True,)", "(10**9,)", "((),)", "(0,999999999999999)")
            )
            head = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}".ljust(117).encode() + b"\n"
            lies[name] = b"\x93NUMPY\x01\x00" + len(head).to_bytes(2, "little") + head + bytes(rng.randrange(64))
    written = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        np.savez(written, **{k: v for k, v in arrays.items() if k not in lies})
        with zipfile.ZipFile(written, "a", zipfile.ZIP_DEFLATED) as archive:
            for name, lie in lies.items():
                archive.writestr(f"{name}.npy", lie)
    return written.getvalue()


def spoiled(path: Path, rng: random.Random) -> bytes:
    """Return the content of a sound file, damaged."""
    content = path.read_bytes()
    if rng.random() < 0.3:
        return spoiled_bytes(content, rng)
    if path.suffix == ".json":
        return spoiled_json(content.decode(), rng).encode(errors="surrogatepass")
    if path.suffix == ".npz":
        return spoiled_archive(content, rng)
    if path.suffix in (".urdf", ".obj", ".off"):
        words = content.decode().split(" ")
        for _ in range(rng.choice((1, 2, 4))):
            at = rng.randrange(len(words))
            words[at] = rng.choice(
                ("1e308", "-1", "nan", "0", "999999999999", "", "&x;", words[rng.randrange(len(words))])
            )
        return " ".join(words).encode()
    return spoiled_bytes(content, rng)


def run(name: str, first: int, cases: int, told: Callable[[int], None] | None = None) -> Tally:
    """Read damaged files of a kind, and return what that ended in."""
    kind, found = KINDS[name], Tally()
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        kind.sound(folder)
        file = folder / kind.name
        sound = file.read_bytes()
        original = folder / f"sound{file.suffix}"
        original.write_bytes(sound)
        kind.read(folder)  # the sound one is read
        for number in range(first, first + cases):
            rng = random.Random(f"{name} {number}")
            file.write_bytes(spoiled(original, rng))
            before, begun = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.process_time()
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    kind.read(folder)
                found.values += 1
            except InputError as error:
                found.refused += 1
                said = str(error)
                if len(said) > 1500 or "\n" in said:
                    found.faults.append(f"{number}: a sentence of {len(said)} letters: {said[:100]!r}")
            except Exception as error:  # this is what is looked for
                line = traceback.extract_tb(error.__traceback__)[-1]
                found.faults.append(
                    f"{number}: {type(error).__name__} {str(error)[:80]!r} at {line.filename}:{line.lineno}"
                )
            took = time.process_time() - begun
            rose = 1024.0 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
            found.slowest, found.memory = max(found.slowest, took), max(found.memory, rose)
            if took > SLOW or rose > LARGE:
                found.faults.append(f"{number}: {took:.1f} s and {rose / 1e6:.0f} MB")
            if told is not None:
                told(number)
    return found


def _text(name: str, content: Any) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        (folder / name).write_text(content if isinstance(content, str) else json.dumps(content))

    return write


def _scene(folder: Path) -> None:
    from torchdlo import scene_files as f

    line = f.RopeSpec(
        ((0.0, 0.0, 0.3), (0.2, 0.0, 0.3)), vertices=6, mass=0.02, bend=1e-4, hanging_masses=(f.HangingMass(-1, 0.01),)
    )
    ring = f.RopeSpec(
        ((0.0, 0.1, 0.3), (0.1, 0.1, 0.3), (0.1, 0.2, 0.3), (0.0, 0.2, 0.3)),
        vertices=8,
        density=1000.0,
        closed=True,
        bend=1e-4,
    )
    f.save(
        f.SceneDescription(
            (line, ring),
            {"gravity": {}, "bend": {}, "damping": {"rate": 0.5}, "rod_body": {}, "rod_contact": {"mu_s": 0.2}},
            bodies=(
                f.BodySpec("plane", motion="fixed"),
                f.BodySpec("box", (0.02, 0.02, 0.02), pos=(0.1, 0.0, 0.1), mass=0.1),
                f.BodySpec("sphere", (0.02,), motion="kinematic", keyframes=(f.Keyframe(0.1, (0.0, 0.0, 0.1)),)),
            ),
            attachments=(f.Attachment((0,), keyframes=(f.Keyframe(0.05, (0.0, 0.0, 0.05)),), release=0.08),),
            duration=0.02,
            integrator="implicit",
        ),
        folder / "scene.json",
    )


def _matter(folder: Path) -> None:
    from torchdlo import scene_files as f

    rope = f.RopeSpec(((0.0, 0.0, 0.05), (0.05, 0.0, 0.05)), vertices=5, mass=0.01, bend=1e-4)
    block = f.ParticleBlockSpec("elastic", (0.02, 0.02, 0.02), 0.01, parameters={"density": 900.0})
    box = f.GridSpec((-0.06, -0.06, -0.06), (0.06, 0.06, 0.06), 0.02)
    described = f.SceneDescription(
        (rope,), {"gravity": {}, "bend": {}}, material_points=(block,), box=box, substeps=20, duration=0.01
    )
    f.save(described, folder / "scene.json")


def _read_scene(folder: Path) -> Any:
    from torchdlo import scene_files

    return scene_files.load(folder / "scene.json")


def _recording(folder: Path) -> None:
    time_, s = np.arange(12) * 0.01, np.linspace(0, 1, 7)
    x = 0.95 * s + 0.01 * np.sin(6 * time_)[:, None]
    markers = np.stack([x, 0.02 * np.sin(np.pi * s) + 0 * x, 0.5 - 0.1 * np.sin(np.pi * s) + 0 * x], -1)
    gripped = np.array([1, 1, 0, 0, 0, 1, 1], bool)
    quaternion = np.tile([1.0, 0, 0, 0], (12, 2, 1))
    arrays = {"time": time_, "markers": markers, "marker_arclength": s, "gripped": gripped}
    arrays |= {"gripper_quaternion": quaternion, "gripper_marker": np.array([0, 6]), "suspect": np.zeros(12, bool)}
    for name in ("train_1", "test_1"):
        np.savez_compressed(folder / f"{name}.npz", **arrays)
    rope = {"length": 1.0, "radius": 0.004, "mass": 0.05, "gravity": [0, 0, -9.81], "table_height": 0.0}
    rope |= {
        "marker_noise_std": 1e-4,
        "rest_positions": markers[0].tolist(),
        "closed": False,
        "notes": "n",
        "color": [1, 2, 3],
    }
    (folder / "rope.json").write_text(json.dumps(rope))


def _read_recording(folder: Path) -> Any:
    from torchdlo.sysid import load_recording

    for name in ("sound.npz", "sound.json"):
        (folder / name).exists() and (folder / name).replace(folder / f".{name}")
    try:
        return load_recording(folder)
    finally:
        for name in ("sound.npz", "sound.json"):
            (folder / f".{name}").exists() and (folder / f".{name}").replace(folder / name)


def _model(folder: Path) -> None:
    arclength = np.linspace(0, 1, 11)
    wind = {"velocity.0": 1.0, "velocity.1": 0.0, "velocity.2": 0.0, "c_d": 1.0}
    content = {
        "format": "torchdlo-model",
        "version": 3,
        "rope": {"length": 1.0, "mass": 0.05, "radius": 0.004, "gravity": [0, 0, -9.81], "rest_positions": None},
        "parameters": {"bending_stiffness": 1e-3, "twisting_stiffness": 1e-3, "damping_rate": 0.5},
        "effects": {
            "air_drag": {"c_d": 1.1},
            "wind": wind,
        },
        "options": {"vertices": 11, "rest": "straight", "numerical_damping": 0, "clamp_fraction": 0.5, "substep": 1e-3},
        "mesh": {"arclength": arclength.tolist(), "marker_vertex": [0, 5, 10]},
        "step": 0.01,
    }
    points = [[x, 0.1 * x * x, 0.0] for x in np.linspace(0, 1, 5).tolist()]
    content["rope"]["rest_positions"] = points
    (folder / "model.json").write_text(json.dumps(content))


def _read_model(folder: Path) -> Any:
    from torchdlo.scene_files import RopeSpec, SceneDescription, assemble, cable

    cable(folder / "model.json")
    rope = RopeSpec(((0.0, 0.0, 0.0), (1.0, 0.0, 0.0)), model="model.json")
    described = SceneDescription((rope,), {}, duration=0.01, integrator="implicit")
    try:
        return assemble(described, folder=folder)
    except ValueError as error:  # what a scene says of itself; commands name the file before it
        raise InputError(str(error)) from None


def _trajectory(folder: Path) -> None:
    from torchdlo.agents.trajopt.task_problem import TaskProblem
    from torchdlo.envs import find

    problem = TaskProblem(find("lifting"), execution="eager")
    actions = np.full((problem.horizon, problem.width), 0.01)
    tool = np.zeros((problem.horizon, problem.task.arms.count, 3)).tolist()
    choices = {"double": False, "execution": "compiled", "rope": None, "grasps": None}
    choices |= {"fidelity": {"step": 0.002, "substeps": 1, "integrator": "implicit"}}
    content = {"generator": "torchdlo optimize", "task": "lifting", "choices": choices, "return": 1.0, "success": True}
    (folder / "trajectory.json").write_text(json.dumps(content | {"actions": actions.tolist(), "tool": tool}))


def _read_trajectory(folder: Path) -> Any:
    from torchdlo.agents.data.demonstrators import trajectory_demonstrator
    from torchdlo.agents.trajopt.search_result import load_actions
    from torchdlo.agents.trajopt.task_problem import TaskProblem, trajectory_problem
    from torchdlo.envs import find

    path, task = folder / "trajectory.json", find("lifting")
    return (
        load_actions(path, TaskProblem(task, execution="eager")),
        trajectory_problem(path, task).choices,
        trajectory_demonstrator(task, path),
    )


def _read_checkpoint(folder: Path) -> Any:
    from torchdlo.sysid.estimation import checkpoint

    # The hash of all of our files takes longer than all else.
    with mock.patch.object(checkpoint, "program", lambda: "program"):
        return checkpoint.Checkpoint(folder / "checkpoint.json", _Measured(), {}, True)


@dataclass
class _Measured:
    path: Path = Path()
    length: float = 1.0


def _checkpoint(folder: Path) -> None:
    from torchdlo.sysid.estimation.checkpoint import Checkpoint

    made = Checkpoint(folder / "checkpoint.json", _Measured(), {}, False)
    made.keep("straight", np.array([1e-3, 2e-3, 0.5]))


def _cameras(folder: Path) -> None:
    from torchdlo.vision.camera import looking_at, save_cameras

    save_cameras(
        [looking_at("a", (1.0, 1.0, 1.0), (0.0, 0.0, 0.0), size=(64, 48), focal=60.0)], folder / "cameras.json"
    )


def _read_cameras(folder: Path) -> Any:
    from torchdlo.vision.camera import load_cameras

    return load_cameras(folder / "cameras.json")


def _read_ranges(folder: Path) -> Any:
    from torchdlo.vision.segment import load_ranges

    return load_ranges(folder / "ranges.json")


def _read_reward(folder: Path) -> Any:
    from torchdlo.reward_language import load_reward

    return load_reward(folder / "reward.json")


def _read_grasps(folder: Path) -> Any:
    from torchdlo.agents.vlm.grasp_proposal import load_grasps

    return load_grasps(folder / "proposal.json", "lifting")


def _read_conversation(folder: Path) -> Any:
    from torchdlo.agents.vlm.recorded import load_recorded

    return load_recorded(folder / "conversation.json")


def _frames(folder: Path) -> None:
    from torchdlo import scene_files as f
    from torchdlo.scene_files.run import run as simulate
    from torchdlo.scene_files.run import save_frames

    rope = f.RopeSpec(((0.0, 0.0, 0.3), (0.2, 0.0, 0.3)), vertices=6, mass=0.02, bend=1e-4)
    body = f.BodySpec("box", (0.02, 0.02, 0.02), pos=(0.1, 0.0, 0.1), motion="fixed")
    described = f.SceneDescription((rope,), {"gravity": {}, "bend": {}}, bodies=(body,), duration=0.02)
    save_frames(simulate(described), folder / "frames.npz", described)


def _read_frames(folder: Path) -> Any:
    from torchdlo.report.render.run_surfaces import bounds, pieces, points_of
    from torchdlo.scene_files.run import load_frames

    frames = load_frames(folder)
    return bounds(frames), pieces(frames), points_of(frames)


def _archive(folder: Path) -> None:
    texts = {
        "index": [{"name": "lifting-gd-0", "task": "lifting", "method": "gd", "seed": 0}],
        "lifting-gd-0/result": {"task": "lifting", "settings": {"method": "gd", "seed": 0}, "curve": [{"best": 1.0}]},
        "lifting-gd-0/trajectory": {"task": "lifting", "return": 1.0},
    }
    arrays = {k: np.frombuffer(json.dumps(v).encode(), np.uint8) for k, v in texts.items()}
    np.savez_compressed(folder / "searches.npz", **arrays, **{"lifting-gd-0/actions": np.zeros((4, 3))})


def _read_archive(folder: Path) -> Any:
    from torchdlo.agents.trajopt.stored import load_trajectory, read_searches

    return load_trajectory("lifting", "gd", 0, folder / "searches.npz"), list(read_searches(folder / "searches.npz"))


def _read_masks(folder: Path) -> Any:
    from torchdlo.vision.segment import load_film

    return load_film(folder / "masks.npz")


def _policy(folder: Path) -> None:
    from torchdlo.agents.policies.features import FeatureSpec
    from torchdlo.agents.policies.policy import Policy, PolicySpec
    from torchdlo.agents.policies.policy_files import save_policy as write

    torch.manual_seed(0)
    write(Policy(PolicySpec(FeatureSpec(4), 3, hidden=(8,))), folder / "policy.pt")


def _read_policy(folder: Path) -> Any:
    from torchdlo.agents.policies.policy_files import load_policy

    return load_policy(folder / "policy.pt", notes=True)


def _chunk_policy(folder: Path) -> None:
    from torchdlo.agents.policies.chunk_policy import ChunkPolicy, NetworkShape, save_policy

    torch.manual_seed(0)
    shape = NetworkShape(1, ("a",), 8, 3, chunk=2, width=8, channels=(8,), layers=1, heads=1)
    save_policy(folder / "chunk.pt", ChunkPolicy(shape), {"tasks": ["lifting"]})


def _read_chunk_policy(folder: Path) -> Any:
    from torchdlo.agents.policies.chunk_policy import load_policy

    return load_policy(folder / "chunk.pt")


def _expert(folder: Path) -> None:
    from torchdlo.agents.rl.expert import Expert, save_expert
    from torchdlo.envs import find

    task = find("lifting")
    shape = (task.horizon, task.arms.count, 3)
    gain = torch.zeros(*shape, len(task.reset_noise), 2)
    save_expert(Expert(torch.zeros(shape), gain, "here"), folder / "expert.json", task, {})


def _read_expert(folder: Path) -> Any:
    from torchdlo.agents.rl.expert import load_expert
    from torchdlo.envs import find

    return load_expert(folder / "expert.json", find("lifting"))


def _pickle(folder: Path) -> None:
    frames = [[[0.1 * k + 0.01 * t + axis for k in range(6)] for axis in range(3)] for t in range(5)]
    (folder / "0.pkl").write_bytes(pickle.dumps(frames))


def _read_pickle(folder: Path) -> Any:
    from torchdlo.sysid.recordings.import_deform import read_positions

    return read_positions(folder / "0.pkl")


ROBOT = """<?xml version="1.0"?> <robot name="r"> <link name="a"/> <link name="b"> <collision> <origin xyz="0 0 1"
rpy="0 0 0"/> <geometry> <box size="1 2 3"/> </geometry> </collision> </link> <link name="c"> <collision> <geometry>
<cylinder radius="0.1" length="0.5"/> </geometry> </collision> </link> <joint name="j" type="revolute"> <parent
link="a"/> <child link="b"/> <axis xyz="0 0 1"/> <limit lower="-1" upper="1" velocity="2" effort="1"/> </joint> <joint
name="k" type="prismatic"> <parent link="b"/> <child link="c"/> <origin xyz="0 0 1" rpy="0.1 0.2 0.3"/> <limit
lower="0" upper="1" velocity="2" effort="1"/> <mimic joint="j" multiplier="1" offset="0"/> </joint> </robot>"""


def _read_robot(folder: Path) -> Any:
    from torchdlo.coupling.robot import urdf

    return urdf.read_urdf(folder / "r.urdf")


def _mesh(name: str) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        import trimesh

        trimesh.creation.box((0.1, 0.1, 0.1)).export(folder / name)

    return write


def _read_mesh(name: str) -> Callable[[Path], Any]:
    def read(folder: Path) -> Any:
        from torchdlo.coupling.bodies.mesh_sdf import load_mesh

        return load_mesh(folder / name, cells=4, balls=4, cache=folder / "cache")

    return read


ANSWERS = [{"kind": "plan", "response": "{}", "tokens": 3}, {"kind": "grasp", "response": {"a": 1}}]
CONVERSATION = {"source": "a model", "exchanges": ANSWERS}
RANGES = {"generator": "torchdlo segment", "hue": [0, 30], "saturation": [0.2, 1], "value": [0.2, 1], "close": 3}
REWARD = {"reward": {"near": "-dist(tool_0, ring_0)", "up": "0.5 * 2"}, "success": "dist(tool_0, ring_0) < 0.01"}

KINDS: dict[str, Kind] = {
    "scene": Kind("scene.json", _scene, _read_scene),
    "scene of material points": Kind("scene.json", _matter, _read_scene),
    "rope.json": Kind("rope.json", _recording, _read_recording),
    "trial": Kind("train_1.npz", _recording, _read_recording),
    "model": Kind("model.json", _model, _read_model),
    "trajectory": Kind("trajectory.json", _trajectory, _read_trajectory),
    "checkpoint": Kind("checkpoint.json", _checkpoint, _read_checkpoint),
    "cameras": Kind("cameras.json", _cameras, _read_cameras),
    "colour ranges": Kind("ranges.json", _text("ranges.json", RANGES), _read_ranges),
    "reward": Kind("reward.json", _text("reward.json", REWARD), _read_reward),
    "grasps": Kind("proposal.json", _text("proposal.json", {"task": "lifting", "grasps": [3, None]}), _read_grasps),
    "conversation": Kind("conversation.json", _text("conversation.json", CONVERSATION), _read_conversation),
    "frames": Kind("frames.npz", _frames, _read_frames),
    "archive of searches": Kind("searches.npz", _archive, _read_archive),
    "masks": Kind(
        "masks.npz", lambda f: np.savez_compressed(f / "masks.npz", masks=np.zeros((3, 8, 9), bool)), _read_masks
    ),
    "policy": Kind("policy.pt", _policy, _read_policy),
    "policy of pictures": Kind("chunk.pt", _chunk_policy, _read_chunk_policy),
    "expert": Kind("expert.json", _expert, _read_expert),
    "DEFORM pickle": Kind("0.pkl", _pickle, _read_pickle),
    "URDF": Kind("r.urdf", _text("r.urdf", ROBOT), _read_robot),
    "mesh .stl": Kind("m.stl", _mesh("m.stl"), _read_mesh("m.stl")),
    "mesh .obj": Kind("m.obj", _mesh("m.obj"), _read_mesh("m.obj")),
    "mesh .ply": Kind("m.ply", _mesh("m.ply"), _read_mesh("m.ply")),
    "mesh .off": Kind("m.off", _mesh("m.off"), _read_mesh("m.off")),
    "mesh .glb": Kind("m.glb", _mesh("m.glb"), _read_mesh("m.glb")),
}


def main() -> int:
    """Run all kinds and say what they ended in."""
    parser = Parser("fuzz_files.py", description=__doc__)
    parser.add_argument("--cases", type=count, default=200, help="files of each kind")
    parser.add_argument("--first", type=int, default=0, help="number of the first")
    parser.add_argument("--kind", action="append", choices=list(KINDS), help="only this kind; may be repeated")
    parser.add_argument("--out", default="", help="JSON with all counts and faults")
    given = parser.parse_args()
    torch.set_num_threads(1)
    rows: dict[str, Any] = {}
    for name in given.kind or KINDS:
        found = run(name, given.first, given.cases)
        rows[name] = vars(found)
        print(
            f"{name:26} {found.values:6} values {found.refused:6} refused {len(found.faults):4} faults, slowest "
            f"{found.slowest:.2f} s, memory up to +{found.memory / 1e6:.0f} MB",
            flush=True,
        )
        for fault in found.faults[:5]:
            print(f"    {fault}", flush=True)
        save(given.out, {"cases": given.cases, "first": given.first, "kinds": rows})
    return 1 if any(row["faults"] for row in rows.values()) else 0


if __name__ == "__main__":
    sys.exit(main())
