"""Scene files of version 1, as entries of version 2: the same scenes under earlier names."""

from __future__ import annotations

from typing import Any

__all__ = ["OLDER", "upgraded"]

OLDER = "torchdlo scene 1"
"""What the entry "format" of such a file says."""
_SCENE = {"matter": "material_points", "holds": "attachments", "look": "camera_direction"}
_PARTS = {"keys": "keyframes", "weights": "hanging_masses", "law": "constitutive_model", "numbers": "parameters"}
_EFFECTS = {"rod_matter": "rod_mpm_coupling", "body_matter": "body_mpm_coupling"}


def upgraded(content: dict[str, Any]) -> dict[str, Any]:
    """Return the entries of a scene of version 1 by their names of today; what does not fit is left for the reader."""
    found = {_SCENE.get(name, name): value for name, value in content.items()}
    for name, value in found.items():
        if name == "effects" and isinstance(value, dict):
            found[name] = {_EFFECTS.get(effect, effect): given for effect, given in value.items()}
        elif isinstance(value, list):
            found[name] = [_part(part) for part in value]
    return found


def _part(part: Any) -> Any:
    return {_PARTS.get(name, name): value for name, value in part.items()} if isinstance(part, dict) else part
