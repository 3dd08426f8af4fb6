"""Cameras and pictures: what scenes look like, masks of ropes, and a differentiable rasteriser."""

from __future__ import annotations

from typing import TYPE_CHECKING

from torchdlo import lazy

if TYPE_CHECKING:
    from torchdlo.vision.camera import Camera, load_cameras, project, save_cameras
    from torchdlo.vision.rasterizer import rope_masks

__getattr__, __dir__ = lazy.attach(
    __name__,
    {
        "Camera": "torchdlo.vision.camera",
        "load_cameras": "torchdlo.vision.camera",
        "project": "torchdlo.vision.camera",
        "rope_masks": "torchdlo.vision.rasterizer",
        "save_cameras": "torchdlo.vision.camera",
    },
)

__all__ = ["Camera", "load_cameras", "project", "rope_masks", "save_cameras"]
