"""The process that draws a photograph: reads what is to be seen from one file, writes the picture to another."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np


def _mesh(mi: Any, name: str, part: dict[str, np.ndarray]) -> Any:
    """Return a mesh with smooth normals, and colours at its corners if it has them."""
    if "colors" in part:
        color = {"type": "mesh_attribute", "name": "vertex_color"}
    else:
        color = {"type": "rgb", "value": part["color"].tolist()}
    bsdf = {
        "type": "twosided",
        "material": {"type": "principled", "base_color": color, "roughness": float(part["rough"]), "specular": 0.4},
    }
    properties = mi.Properties()
    properties["mesh_bsdf"] = mi.load_dict(bsdf)
    mesh = mi.Mesh(name, len(part["vertices"]), len(part["faces"]), has_vertex_normals=True, props=properties)
    if "colors" in part:
        mesh.add_attribute("vertex_color", 3, part["colors"].astype(np.float32).ravel())
    values = mi.traverse(mesh)
    values["vertex_positions"] = part["vertices"].astype(np.float32).ravel()
    values["vertex_normals"] = part["normals"].astype(np.float32).ravel()
    values["faces"] = part["faces"].astype(np.uint32).ravel()
    if "colors" in part:
        values["vertex_color"] = part["colors"].astype(np.float32).ravel()
    values.update()
    return mesh


def _scene(mi: Any, given: dict[str, np.ndarray]) -> dict[str, Any]:
    turn = mi.ScalarTransform4f()
    reach, floor = float(given["reach"]), given["floor"].tolist()
    width, height = given["size"].tolist()
    lamp = (np.array(floor) + reach * np.array([-0.9, -0.6, 1.5])).tolist()
    look = {"origin": given["place"].tolist(), "target": given["target"].tolist(), "up": given["up"].tolist()}
    wood = {"type": "bitmap", "bitmap": mi.Bitmap(given["wood"].astype(np.float32)), "raw": True}
    scene = {
        "type": "scene",
        "integrator": {
            "type": "aov",
            "aovs": "albedo:albedo,normal:sh_normal",
            "image": {"type": "path", "max_depth": 6, "hide_emitters": False},
        },
        "sensor": {
            "type": "perspective",
            "fov": float(given["angle"]),
            "fov_axis": "y",
            "near_clip": 0.001,
            "to_world": turn.look_at(**look),
            "film": {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}},
            "sampler": {"type": "independent", "sample_count": int(given["samples"])},
        },
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.26, 0.28, 0.31]}},
        "lamp": {
            "type": "rectangle",
            "to_world": turn.look_at(origin=lamp, target=floor, up=[0, 1, 0]).scale(0.2 * reach),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [30.0, 27.5, 24.0]}},
        },
        "floor": {
            "type": "rectangle",
            "to_world": turn.translate(floor).scale(reach),
            "material": {"type": "principled", "base_color": wood, "roughness": 0.45, "specular": 0.3},
        },
    }
    for k in range(int(given["count"])):
        part = {name.split(".")[1]: value for name, value in given.items() if name.startswith(f"{k}.")}
        scene[f"part{k}"] = _mesh(mi, f"part{k}", part)
    for k, place in enumerate(given.get("grains", ())):
        color = {"type": "rgb", "value": given["grain_colors"][k].tolist()}
        ball = {"type": "sphere", "center": place.tolist(), "radius": float(given["grain"])}
        scene[f"grain{k}"] = ball | {"material": {"type": "diffuse", "reflectance": color}}
    return scene


def _developed(light: np.ndarray) -> np.ndarray:
    """Return what a screen shows, with a shoulder so that light parts do not burn out (Narkowicz 2015)."""
    x = 0.8 * np.maximum(light, 0)
    x = np.clip(x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14), 0, 1)
    return (255 * np.where(x > 0.0031308, 1.055 * x ** (1 / 2.4) - 0.055, 12.92 * x) + 0.5).astype(np.uint8)


def main(variant: str, source: str, target: str) -> None:
    """Draw one photograph."""
    import mitsuba as mi
    import pyoidn

    mi.set_variant(variant)
    given = dict(np.load(source))
    found = np.array(mi.render(mi.load_dict(_scene(mi, given)))).astype(np.float32)
    layers = [np.ascontiguousarray(found[..., k : k + 3]) for k in (0, found.shape[-1] - 6, found.shape[-1] - 3)]
    light = pyoidn.denoise(layers[0], albedo=np.clip(layers[1], 0, 1), normal=layers[2], hdr=True)
    np.save(target, _developed(np.asarray(light)))


def attempt(variant: str) -> None:
    """Draw a ball, to see whether a variant works."""
    import mitsuba as mi

    mi.set_variant(variant)
    film = {"type": "hdrfilm", "width": 8, "height": 8}
    camera = {"type": "perspective", "film": film, "sampler": {"type": "independent", "sample_count": 1}}
    parts = {"camera": camera, "light": {"type": "constant"}, "ball": {"type": "sphere", "center": [0, 0, 3]}}
    seen = np.array(mi.render(mi.load_dict({"type": "scene", "integrator": {"type": "path"}, **parts})))
    if not np.isfinite(seen).all():
        raise SystemExit(1)


if __name__ == "__main__":
    if sys.argv[1] == "--try":
        attempt(sys.argv[2])
    else:
        main(*sys.argv[1:])
