"""A page that shows a run in three dimensions, to turn, play, pause and scrub."""

from __future__ import annotations

import contextlib
import io
import threading
import time
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from torchdlo.errors import InputError
from torchdlo.report.render.surfaces import COLORS, bounds, pieces, points_of, spacing
from torchdlo.scene_files.run import Frames

__all__ = ["Viewer"]

_RATE = 30
"""Pictures per second while it plays."""


def _viser() -> Any:
    try:
        import viser
    except ImportError:
        raise InputError("the viewer needs the package viser; install it with pip install 'torchdlo[view]'.") from None
    return viser


class Viewer:
    """A server of the page. It plays in a thread of its own."""

    def __init__(self, frames: Frames, *, title: str = "torchdlo", host: str = "127.0.0.1", port: int = 8080) -> None:
        """Start serving.

        Args:
            frames: the run.
            title: what the page is called.
            host: address to serve at; this machine only if not given.
            port: port to serve at; the next free one if it is taken.
        """
        viser = _viser()
        self.frames, self.frame = frames, -1
        self._pieces, self._points = pieces(frames), points_of(frames)
        with contextlib.redirect_stdout(io.StringIO()):  # its banner
            self.server = viser.ViserServer(host=host, port=port, label=title, verbose=False)
        self.address = f"http://{host}:{self.server.get_port()}"
        self._stopped = threading.Event()
        self._lock = threading.Lock()
        self._draw()
        gui, last = self.server.gui, len(frames.time) - 1
        self.slider = gui.add_slider("frame", min=0, max=max(last, 1), step=1, initial_value=0)
        self.playing = gui.add_checkbox("play", initial_value=False)
        self.speed = gui.add_slider("speed", min=0.05, max=2.0, step=0.05, initial_value=1.0)
        self._label = gui.add_text("time", initial_value="", disabled=True)
        self.slider.on_update(lambda _: self.show(int(self.slider.value)))
        self.show(0)
        self._thread = threading.Thread(target=self._play, daemon=True)
        self._thread.start()

    def _draw(self) -> None:
        scene, frames = self.server.scene, self.frames
        scene.set_up_direction("+z")
        self._drawn = [
            scene.add_mesh_simple(
                f"/{p.name}",
                p.at(frames, 0) if p.corners is None else p.corners,
                p.faces,
                color=_rgb(p.color),
                side="double",
            )
            for p in self._pieces
        ]
        self._clouds = [
            scene.add_point_cloud(
                f"/{law}",
                frames.material_points[0, slots],
                _rgb(COLORS[law]),
                precision="float32",
                point_size=spacing(frames.material_points[0, slots]),
                point_shape="circle",
            )
            for law, slots in self._points.items()
        ]
        low, high = bounds(frames)
        middle, span = 0.5 * (low + high), float(np.linalg.norm(high - low))
        for k, height in enumerate(frames.table):
            at = (*middle[:2], float(height))
            scene.add_grid(f"/table {k}", width=3 * span, height=3 * span, cell_size=0.1, position=at)
        look = frames.camera_direction / np.linalg.norm(frames.camera_direction)
        camera = self.server.initial_camera
        camera.look_at, camera.position = middle, middle + 1.6 * span * look

    def show(self, k: int) -> None:
        """Show frame k."""
        with self._lock, self.server.atomic():
            k = min(max(k, 0), len(self.frames.time) - 1)
            for piece, drawn in zip(self._pieces, self._drawn, strict=True):
                if piece.corners is None:
                    drawn.vertices = piece.at(self.frames, k).astype(np.float32)
                else:
                    pos, turn = piece.pose(self.frames, k)
                    drawn.position, drawn.wxyz = pos, np.roll(Rotation.from_matrix(turn).as_quat(), 1)
            for slots, cloud in zip(self._points.values(), self._clouds, strict=True):
                cloud.points = self.frames.material_points[k, slots]
            self._label.value = f"{self.frames.time[k]:.3f} s"
            self.frame = k

    def _play(self) -> None:
        """Move the slider with the clock while it plays; from the end go back to the start."""
        times, at, since = self.frames.time, 0.0, time.monotonic()
        while not self._stopped.wait(1 / _RATE):
            now = time.monotonic()
            if self.playing.value:
                shown = float(times[int(self.slider.value)])
                # Somebody may have moved the slider.
                at = at if int(np.abs(times - at).argmin()) == int(self.slider.value) else shown
                at += (now - since) * float(self.speed.value)
                at = 0.0 if at > times[-1] else at
                self.slider.value = int(np.abs(times - at).argmin())
            since = now

    def wait(self) -> None:
        """Serve until Ctrl-C."""
        try:
            self._until_interrupted()
        except KeyboardInterrupt:
            pass
        finally:
            self.stop()

    def _until_interrupted(self) -> None:
        while self._thread.is_alive():
            self._thread.join(0.5)

    def stop(self) -> None:
        """Stop serving."""
        self._stopped.set()
        self._thread.join()
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()


def _rgb(color: str) -> tuple[int, int, int]:
    return tuple(int(color[k : k + 2], 16) for k in (1, 3, 5))
