"""Ropes that were calibrated: what a model file says, as numbers and effects of a scene."""

from __future__ import annotations

import dataclasses
import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchdlo.envs.assets.rope_material import RopeMaterial
from torchdlo.errors import InputError
from torchdlo.physics import tree
from torchdlo.physics.effects import EFFECTS
from torchdlo.physics.effects.parameter_name import ParameterName
from torchdlo.physics.rod.assembly import frame_curvature
from torchdlo.physics.rod.topology import Topology
from torchdlo.scene_files.schema import RopeSpec, SceneDescription
from torchdlo.untrusted import read_entry

__all__ = ["Modelled", "cable", "with_models"]

_OF_RECORDINGS = tuple(name for name, effect in EFFECTS.items() if effect.kind in ("measurement", "boundary"))
"""Effects of how a rope was measured and clamped, which are not its own."""
_SAME = 0.01
"""Share by which the drawn line may differ in length from the calibrated rope."""


@dataclass(frozen=True, eq=False)
class Modelled:
    """What a model file gives beyond numbers that a scene file can hold."""

    shape: Tensor | None
    """Natural shape in a plane, at the markers [m], shape (M, 3); None for a straight one."""
    share: float
    """Share of that shape's curvature that is real."""
    roll: float
    """Angle from the vertical to the normal of its plane, about the first edge [rad]."""

    def curvature(self, count: int) -> Tensor:
        """Return the natural curvature at evenly spaced vertices [1/m], shape (count, 2)."""
        from scipy.interpolate import CubicSpline

        points = tree.part(self.shape)
        along = torch.cat([points.new_zeros(1), (points[1:] - points[:-1]).norm(dim=-1).cumsum(0)])
        even = torch.linspace(0, float(along[-1]), count, dtype=points.dtype)
        line = torch.as_tensor(CubicSpline(along.numpy(), points.numpy(), axis=0)(even.numpy()))
        topology = Topology((count,), (False,))
        up = line.new_tensor([0.0, 0.0, 1.0]).expand_as(line)
        masks = (line.new_tensor(m).unsqueeze(-1) for m in (topology.edge_mask(), topology.hinge_mask()))
        bent, _ = frame_curvature(topology, line, up, *masks)
        c, s = torch.cos(line.new_tensor(self.roll)), torch.sin(line.new_tensor(self.roll))
        first, second = (self.share * bent / (even[1] - even[0])).unbind(-1)
        return torch.stack([c * first - s * second, s * first + c * second], -1)


def with_models(d: SceneDescription, folder: Path) -> tuple[SceneDescription, Modelled | None]:
    """Return a description in which ropes with a model file have its numbers, and the scene its effects.

    What the description says itself wins. Effects act on all ropes, so all must have the same model.
    """
    names = {r.model for r in d.ropes}
    if names == {None}:
        return d, None
    if len(names) > 1:
        raise InputError(
            "ropes: the effects of a model act on all ropes of a scene; expected the same model for every rope, given "
            f"{', '.join(sorted(n or 'none' for n in names))}."
        )
    path = folder / next(n for n in names if n is not None)
    model, said = _read(path)
    rope, shape = said["rope"], said["rope"].get("rest_positions")
    ropes = tuple(_filled(r, k, path, rope, model.values, said["mesh"]) for k, r in enumerate(d.ropes))
    effects = _effects(d, model, rope, framed=shape is not None)
    twist = d.twist if d.twist != "none" else "quasistatic"
    return dataclasses.replace(d, ropes=ropes, effects=effects, twist=twist), _shape(shape, model.values)


def cable(path: str | Path) -> RopeMaterial:
    """Return what a model file says of a rope, for a task: `envs.make("wiring_post", rope=cable("model.json"))`.

    Left out are twisting, which ropes of tasks do not resist, and what belongs to the recording or to its scene: delay,
    marker offset, clamps, tilt, the table, a liquid.

    Raises:
        InputError: The file is not a model.
    """
    model, said = _read(Path(path))
    rope = said["rope"]
    shape = _shape(rope.get("rest_positions"), model.values)
    curvature = () if shape is None else tuple(map(tuple, shape.curvature(len(tree.part(shape.shape))).tolist()))
    others = (*_OF_RECORDINGS, "tilted_gravity", "table_friction", "fluid_forces", "self_contact")
    effects = tuple(
        (name, tuple((key, tuple(x) if isinstance(x, list) else (x,)) for key, x in numbers.items()))
        for name, numbers in _own(model).items()
        if name not in others
    )
    values = model.values
    return RopeMaterial(
        rope["mass"] / rope["length"], values["bending_stiffness"], values["damping_rate"], effects, curvature
    )


def _read(path: Path) -> tuple[Any, dict[str, Any]]:
    """Return the model of a file, and the file as it is."""
    from torchdlo.sysid.model import model_file

    model = model_file.load(path)
    said = _rope(path)
    if model.options["rest"] == "given" and said["rope"].get("rest_positions") is None:
        raise InputError(f"{path}: rope.rest_positions: is missing; expected the natural shape of the rope.")
    return model, said


def _rope(path: Path) -> dict[str, Any]:
    """Return what a file says of the rope and its mesh, checked."""
    from torchdlo.sysid.model.discretisation import MOST_VERTICES

    found = read_entry(path, "a model file")
    rope, mesh = found["rope"], found["mesh"]
    rope["length"].number(1e-6, 1e4, "m")
    rope["mass"].number(1e-12, 1e5, "kg")
    rope["gravity"].numbers(3, most=1e3)
    if "radius" in rope:
        rope["radius"].number(1e-9, 1e3, "m")
    if "rest_positions" in rope:
        rope["rest_positions"].numbers(None, 3, most=1e4)
        if len(rope["rest_positions"].value) < 3:
            raise rope["rest_positions"].wrong("at least 3 positions")
    arclength = mesh["arclength"].numbers(None, most=1e4)
    if not 2 <= len(arclength) <= MOST_VERTICES or any(b <= a for a, b in itertools.pairwise(arclength)):
        raise mesh["arclength"].wrong(f"2 to {MOST_VERTICES} numbers that rise")
    return found.object()


def _shape(points: Any, values: dict[str, float]) -> Modelled | None:
    """Return the natural shape through measured points, None for none."""
    if points is None:
        return None
    roll, share = (values.get(name, usual) for name, usual in (("rest_roll", 0.0), ("rest_share", 1.0)))
    return Modelled(_flat(torch.tensor(points, dtype=torch.float64)), share, roll)


def _filled(
    r: RopeSpec, k: int, path: Path, rope: dict[str, Any], values: dict[str, float], mesh: dict[str, Any]
) -> RopeSpec:
    points = torch.tensor(r.points, dtype=torch.float64).reshape(-1, 3)
    length = float((points[1:] - points[:-1]).norm(dim=-1).sum())
    if r.closed or abs(length - rope["length"]) > _SAME * rope["length"]:
        what = "a closed rope" if r.closed else f"{length:.4g} m"
        raise InputError(
            f"ropes[{k}].points: expected an open line as long as the rope of {path}, {rope['length']:g} m, given "
            f"{what}."
        )
    usual = {
        "vertices": len(mesh["arclength"]),
        "mass": rope["mass"],
        "bend": values["bending_stiffness"],
        "twist": values["twisting_stiffness"],
    }
    alone = {f.name: f.default for f in dataclasses.fields(RopeSpec)}
    missing = {name: value for name, value in usual.items() if getattr(r, name) == alone[name]}
    if r.radius == alone["radius"] and rope.get("radius"):
        missing["radius"] = rope["radius"]
    if r.density is not None:
        missing.pop("mass", None)
    # So that the points may be the corners of the calibrated length to the last bit.
    scaled = (points[0] + (points - points[0]) * (rope["length"] / length)).tolist()
    return dataclasses.replace(r, points=tuple(map(tuple, scaled)), **missing)


def _effects(d: SceneDescription, model: Any, rope: dict[str, Any], *, framed: bool) -> dict[str, dict[str, Any]]:
    """Return the model's effects with those of the scene put over them."""
    found: dict[str, dict[str, Any]] = {
        "gravity": {"acceleration": rope["gravity"]},
        "bend_frame" if framed or any(EFFECTS[name].frame_bending for name in model.effects) else "bend": {},
        "twist": {},
        "damping": {"rate": model.values["damping_rate"]},
    }
    found |= {name: numbers for name, numbers in _own(model).items() if name not in _OF_RECORDINGS}
    if "tilted_gravity" in found:
        found["tilted_gravity"].setdefault("acceleration", rope["gravity"])
    if "table_friction" in found:
        # The table belongs to the scene.
        rub = found.pop("table_friction")
        if "table" in d.effects:
            found["table_friction"] = rub | d.effects["table"]
    if "rod_contact" in d.effects:
        # Ropes of the scene meet themselves already.
        found.pop("self_contact", None)
    if "fluid_forces" in found:
        # So does the liquid.
        drag = found.pop("fluid_forces")
        if "density" in d.effects.get("buoyancy", {}):
            found["fluid_forces"] = drag | {"density": d.effects["buoyancy"]["density"]}
    return found | d.effects


def _own(model: Any) -> dict[str, dict[str, Any]]:
    """Return the numbers of a model's effects, vectors as lists."""
    found: dict[str, dict[str, Any]] = {name: {} for name in model.effects}
    for key, value in model.values.items():
        name = ParameterName.parse(key)
        if not name.effect:
            continue
        if name.component is None:
            found[name.effect][name.number] = value
        else:
            found[name.effect].setdefault(name.number, []).append(value)
    return found


def _flat(points: Tensor) -> Tensor:
    """Return points in their best plane, as (x, y, 0): markers stand off the rope's axis."""
    centred = points - points.mean(0)
    _, _, axes = torch.linalg.svd(centred)
    return torch.nn.functional.pad(centred @ axes[:2].T, (0, 1))
