"""The page on which a person sets the colour of a rope: served to this machine alone, until it is saved or stopped.

The server listens on the loopback address and answers only requests that name it as their host and, where they change
something, as their origin (`torchdlo.local_server`): other pages that are open in the browser cannot use it.
"""

from __future__ import annotations

import base64
import json
import sys
from dataclasses import asdict
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from torchdlo.errors import InputError
from torchdlo.local_server import HEADERS, Guard, drop_log, listen
from torchdlo.vision.segment import Ranges, color_masks, ranges_from, ranges_of, save_ranges

__all__ = ["segment_server"]

_LARGEST = 10_000
"""Bytes of a request."""


class SegmentServer(ThreadingHTTPServer):
    """Serves the page; `serve_forever` runs it."""

    daemon_threads = True

    def __init__(self, pictures: np.ndarray, ranges: Ranges, out: Path, port: int) -> None:
        """Listen; see `segment_server`."""
        listening = listen("127.0.0.1", port)
        super().__init__(listening.getsockname(), _Handler, bind_and_activate=False)
        self.socket.close()
        self.socket, self.server_address = listening, listening.getsockname()
        self.server_name, self.server_port = listening.getsockname()[:2]
        self.guard, self.dropped = Guard.of(listening), drop_log("segment")
        self.pictures, self.ranges, self.out = pictures, ranges, out
        self.page = resources.files("torchdlo.vision").joinpath("segment_page.html").read_bytes()

    @property
    def address(self) -> str:
        """What to open."""
        return self.guard.address

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say in one line that a client was dropped."""
        error = sys.exception()
        if not isinstance(error, (ConnectionError, TimeoutError)):
            self.dropped(f"{type(error).__name__}: {error}")


def segment_server(pictures: np.ndarray, ranges: Ranges, out: Path, *, port: int = 0) -> SegmentServer:
    """Return a server of the page.

    Args:
        pictures: RGB (F, H, W, 3) uint8.
        ranges: to begin with.
        out: file that Save writes.
        port: of the server; a free one if 0.
    """
    return SegmentServer(pictures, ranges, out, port)


class _Handler(BaseHTTPRequestHandler):
    server: SegmentServer
    server_version = "torchdlo"
    sys_version = ""
    timeout = 30
    """Seconds that a client may say nothing."""

    def log_message(self, *_: Any) -> None:
        """Stay quiet."""

    def do_GET(self) -> None:
        if not self._trusted(False):
            return
        if self.path == "/":
            self._send(self.server.page, "text/html; charset=utf-8")
        elif self.path == "/state":
            self._json({"frames": len(self.server.pictures), "ranges": asdict(self.server.ranges)})
        else:
            self._json({"error": "nothing here"}, HTTPStatus.NOT_FOUND)

    def do_POST(self) -> None:
        if not self._trusted(True):
            return
        try:
            length = int(self.headers.get("Content-Length", ""))
            if not 0 < length <= _LARGEST:
                raise ValueError("length")
            content = json.loads(self.rfile.read(length))
            answer = {"/mask": self._mask, "/pick": self._pick, "/save": self._save}[self.path](content)
        except InputError as error:
            self._json({"error": str(error)}, HTTPStatus.BAD_REQUEST)
        except OSError as error:
            self._json({"error": f"cannot be written: {error}"}, HTTPStatus.INTERNAL_SERVER_ERROR)
        except (KeyError, TypeError, ValueError, ArithmeticError, RecursionError):
            self._json({"error": "not understood"}, HTTPStatus.BAD_REQUEST)
        else:
            self._json(answer)

    def _mask(self, content: dict[str, Any]) -> dict[str, Any]:
        picture = self._picture(content)
        mask = color_masks(picture[None], ranges_from(content["ranges"], "ranges"))[0]
        return {"picture": _jpeg(_marked(picture, mask)), "text": f"{int(mask.sum())} pixels marked"}

    def _pick(self, content: dict[str, Any]) -> dict[str, Any]:
        picture = self._picture(content)
        x, y = (int(float(content[k]) * n) for k, n in (("x", picture.shape[1]), ("y", picture.shape[0])))
        patch = picture[max(0, y - 2) : y + 3, max(0, x - 2) : x + 3].reshape(-1, 3)
        if not len(patch):
            return {"text": "outside"}
        # The most colourful pixel: ropes are thin, and their edges mix with what is behind.
        color = patch[np.ptp(patch.astype(int), axis=1).argmax()]
        try:
            return {"ranges": asdict(ranges_of(color.tolist()))}
        except InputError:
            return {"text": "this is grey: choose a place with colour"}

    def _save(self, content: dict[str, Any]) -> dict[str, Any]:
        save_ranges(ranges_from(content["ranges"], "ranges"), self.server.out)
        return {"text": f"saved to {self.server.out}"}

    def _picture(self, content: dict[str, Any]) -> np.ndarray:
        pictures = self.server.pictures
        return pictures[min(max(int(content["frame"]), 0), len(pictures) - 1)]

    def _trusted(self, changes: bool) -> bool:
        """Return whether it was this page that asked, for something that changes nothing or also for that."""
        hosts, origins = (self.headers.get_all(name) or [] for name in ("Host", "Origin"))
        why = self.server.guard.refusal(hosts, origins, changes=changes)
        if not why:
            return True
        self.server.dropped(why)
        self.close_connection = True
        self._json({"error": "only this machine's own page may ask"}, HTTPStatus.FORBIDDEN)
        return False

    def _json(self, content: dict[str, Any], status: HTTPStatus = HTTPStatus.OK) -> None:
        self._send(json.dumps(content).encode(), "application/json", status)

    def _send(self, body: bytes, kind: str, status: HTTPStatus = HTTPStatus.OK) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        for name, value in HEADERS.items():
            self.send_header(name, value)
        policy = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"
        self.send_header("Content-Security-Policy", policy + "; connect-src 'self'; frame-ancestors 'none'")
        self.end_headers()
        self.wfile.write(body)


def _marked(picture: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return a picture with the outline of a mask in magenta, and the rest paler."""
    import cv2

    out = np.where(mask[..., None], picture, (0.6 * picture + 80).astype(np.uint8)).astype(np.uint8)
    edge = cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool) & ~mask
    out[edge] = (255, 0, 200)
    return out


def _jpeg(picture: np.ndarray) -> str:
    import cv2

    done, data = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])
    if not done:
        raise ValueError("picture")
    return base64.b64encode(data.tobytes()).decode("ascii")
