"""A page that shows a run in three dimensions, to turn, play, pause and scrub."""

from __future__ import annotations

import contextlib
import io
import math
import threading
import time

import numpy as np
from scipy.spatial.transform import Rotation

from torchdlo.errors import InputError
from torchdlo.local_server import Guard, listen
from torchdlo.report.render.run_surfaces import COLORS, bounds, pieces, points_of, spacing
from torchdlo.report.viewer.guarded import Bounds, start
from torchdlo.scene_files.run import Frames

__all__ = ["Viewer"]

_RATE = 30
"""Pictures per second while it plays."""

_PORTS = 100
"""Ports that are tried if some are taken."""

_SPEEDS = (0.05, 2.0)


def _check_viser() -> None:
    try:
        import viser  # noqa: F401
    except ImportError:
        raise InputError("the viewer needs the package viser; install it with pip install 'torchdlo[view]'.") from None


class Viewer:
    """A server of the page. It plays in a thread of its own."""

    def __init__(self, frames: Frames, *, title: str = "torchdlo", host: str = "127.0.0.1", port: int = 8080) -> None:
        """Start serving.

        Args:
            frames: the run.
            title: what the page is called.
            host: address to serve at; this machine only if not given. One that other machines reach has a random token
                in its address.
            port: port to serve at; the next free one if it is taken.
        """
        _check_viser()
        self.frames, self.frame = frames, -1
        self._pieces, self._points = pieces(frames), points_of(frames)
        listening = listen(host, port, tries=_PORTS)
        guard, bounds = Guard.of(listening), Bounds()
        self.server = start(listening, guard, title, bounds)
        self.address = guard.address
        self._stopped = threading.Event()
        self._failed: BaseException | None = None
        self._lock = threading.Lock()
        self._draw()
        gui, last = self.server.gui, len(frames.time) - 1
        self.slider = gui.add_slider("frame", min=0, max=max(last, 1), step=1, initial_value=0)
        self.playing = gui.add_checkbox("play", initial_value=False)
        self.speed = gui.add_slider("speed", min=_SPEEDS[0], max=_SPEEDS[1], step=0.05, initial_value=1.0)
        bounds[self.slider._impl.uuid] = (0, max(last, 1))
        bounds[self.playing._impl.uuid] = None
        bounds[self.speed._impl.uuid] = _SPEEDS
        self._label = gui.add_text("time", initial_value="", disabled=True)
        self.slider.on_update(lambda _: self.show(self._frame_set()))
        self.show(0)
        self._thread = threading.Thread(target=self._run, daemon=True)
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

    def _run(self) -> None:
        try:
            self._play()
        except BaseException as error:
            self._failed = error

    def _play(self) -> None:
        """Move the slider with the clock while it plays; from the end go back to the start."""
        times, at, since = self.frames.time, 0.0, time.monotonic()
        while not self._stopped.wait(1 / _RATE):
            now = time.monotonic()
            if self.playing.value:
                frame, speed = self._frame_set(), float(self.speed.value)
                # Somebody may have moved the slider.
                at = at if int(np.abs(times - at).argmin()) == frame else float(times[frame])
                at += (now - since) * (min(max(speed, _SPEEDS[0]), _SPEEDS[1]) if math.isfinite(speed) else 1.0)
                at = 0.0 if at > times[-1] else at
                self.slider.value = int(np.abs(times - at).argmin())
            since = now

    def _frame_set(self) -> int:
        """Return the frame that the slider stands at."""
        return min(max(int(self.slider.value), 0), len(self.frames.time) - 1)

    def wait(self) -> None:
        """Serve until Ctrl-C, which raises `KeyboardInterrupt`; what goes wrong in its thread is raised here."""
        try:
            self._until_interrupted()
        finally:
            self.stop()
        if self._failed is not None:
            raise self._failed

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
    red, green, blue = (int(color[k : k + 2], 16) for k in (1, 3, 5))
    return red, green, blue
