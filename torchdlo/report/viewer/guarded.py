"""The viewer's server behind a guard: viser itself answers every page and takes every message.

Viser has no place to look at requests and messages, so `websockets.asyncio.server.serve`, which it starts, is replaced
while it starts: it gets a socket that listens already, looks at each request before viser does, and hands on only
messages that the viewer's page has a reason to send, with values in range.
"""

from __future__ import annotations

import contextlib
import io
import logging
import math
import socket
import threading
from collections.abc import Callable, Iterator
from http import HTTPStatus
from typing import Any

from torchdlo.local_server import HEADERS, Guard, drop_log

__all__ = ["Bounds", "checked", "start"]

Bounds = dict[str, tuple[float, float] | None]
"""What a person can set on the page, by its identifier: least and greatest value, or None for a switch."""

_LARGEST = 1 << 14
"""Bytes of a message."""

_STARTING = threading.Lock()


def start(listening: socket.socket, guard: Guard, title: str, bounds: Bounds) -> Any:
    """Return a running `viser.ViserServer`.

    Args:
        listening: where.
        guard: who may talk to it.
        title: what the page is called.
        bounds: what can be set; filled in by the caller when it is there.
    """
    import viser

    with _STARTING, _replaced(listening, guard, bounds, f"viser-v{viser.__version__}"):
        with contextlib.redirect_stdout(io.StringIO()):  # its banner
            server = viser.ViserServer(host=guard.host, port=guard.port, label=title, verbose=False)
    # Any client could have the run published.
    for name in ("ShareUrlRequest", "ShareUrlDisconnect"):
        server._websock_server._incoming_handlers.pop(getattr(viser._messages, name), None)
    return server


def checked(raw: Any, bounds: Bounds) -> bytes | None:
    """Return a message with its values in range, None if it is nothing to hand on.

    Raises:
        ValueError: No page of ours sends that.
    """
    import msgspec

    if not isinstance(raw, bytes):
        raise ValueError("it sent text")
    try:
        said = msgspec.msgpack.decode(raw)
        kind = said["type"]
        if not isinstance(kind, str):
            raise ValueError
        if kind == "ViewerCameraMessage":
            _check_camera(said)
            return raw
        if kind != "GuiUpdateMessage" or said["uuid"] not in bounds or set(said["updates"]) != {"value"}:
            return None
        value, limits = said["updates"]["value"], bounds[said["uuid"]]
        if limits is None:
            if not isinstance(value, bool):
                raise ValueError
        else:
            value = min(max(_number(value), limits[0]), limits[1])
        return msgspec.msgpack.encode(said | {"updates": {"value": value}})
    except (msgspec.MsgspecError, ValueError, TypeError, KeyError, OverflowError, RecursionError):
        raise ValueError("it sent what no page sends") from None


def _check_camera(said: dict[str, Any]) -> None:
    sizes = {"wxyz": 4, "position": 3, "look_at": 3, "up_direction": 3}
    names = ("fov", "near", "far", "image_height", "image_width")
    if set(said) != {"type", *sizes, *names}:
        raise ValueError
    for name, size in sizes.items():
        if len(said[name]) != size:
            raise ValueError
        for value in said[name]:
            _number(value)
    for name in names:
        _number(said[name])


def _number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise ValueError
    return value


@contextlib.contextmanager
def _replaced(listening: socket.socket, guard: Guard, bounds: Bounds, protocol: str) -> Iterator[None]:
    """Let viser serve through `guard` if it starts to within the block."""
    from websockets.asyncio import server as library

    serve, dropped = library.serve, drop_log("viewer")

    def guarded(handler: Any, *args: Any, process_request: Any = None, **options: Any) -> Any:
        if not handler.__module__.startswith("viser."):
            return serve(handler, *args, process_request=process_request, **options)
        options |= {"max_size": _LARGEST, "logger": _quiet(dropped), "sock": listening}
        options |= {"create_connection": _connection(bounds, dropped)}
        return serve(handler, process_request=_doorkeeper(guard, process_request, protocol, dropped), **options)

    library.serve = guarded  # type: ignore[misc, assignment]  # viser takes whatever it finds under this name
    try:
        yield
    finally:
        library.serve = serve  # type: ignore[misc]  # as it was


def _doorkeeper(guard: Guard, theirs: Any, protocol: str, dropped: Callable[[str], None]) -> Callable[..., Any]:
    """Return what looks at a request before viser does."""

    def look(connection: Any, request: Any) -> Any:
        asked = request.headers
        socketed = "websocket" in asked.get_all("Upgrade")
        why = guard.refusal(asked.get_all("Host"), asked.get_all("Origin"))
        path = guard.path(request.path)
        if not why and path is None:
            why = "its address has not the token"
        if not why and socketed and protocol not in ", ".join(asked.get_all("Sec-WebSocket-Protocol")).split(", "):
            why = "it is no page of this viewer"
        if why:
            dropped(why)
            answer = connection.respond(HTTPStatus.FORBIDDEN, f"refused: {why}\n")
        elif socketed:
            return theirs(connection, request)
        else:
            request.path = path
            answer = theirs(connection, request)
        for name, value in HEADERS.items():
            if name not in answer.headers:
                answer.headers[name] = value
        return answer

    return look


def _connection(bounds: Bounds, dropped: Callable[[str], None]) -> type:
    """Return connections whose messages are looked at."""
    from websockets.asyncio.server import ServerConnection
    from websockets.exceptions import ConnectionClosed

    class Connection(ServerConnection):
        async def recv(self, decode: bool | None = None) -> Any:
            """Return the next message that is to be handed on."""
            while True:
                try:
                    raw = await super().recv(decode)
                except ConnectionClosed as error:
                    if error.sent is not None and error.sent.code in (1002, 1003, 1007, 1009):
                        dropped(f"it broke the protocol ({error.sent.reason or error.sent.code})")
                    raise
                try:
                    message = checked(raw, bounds)
                except ValueError as error:
                    dropped(str(error))
                    await self.close(1008, "not understood")
                    continue  # which says that the connection is closed
                if message is not None:
                    return message

    return Connection


def _quiet(dropped: Callable[[str], None]) -> logging.Logger:
    """Return a logger for websockets that says in a line what it would say in a traceback."""

    class OneLine(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            error = record.exc_info[1] if record.exc_info else None
            while error is not None and error.__cause__ is not None:
                error = error.__cause__
            # Browsers open connections that they then have no use for.
            if not isinstance(error, (EOFError, ConnectionError)):
                dropped(f"{record.getMessage()} ({type(error).__name__})" if error else record.getMessage())

    logger = logging.Logger("torchdlo.viewer", logging.ERROR)
    logger.propagate = False
    logger.addHandler(OneLine())
    return logger
