"""A local server that behaves like a model's endpoint, well or badly."""

from __future__ import annotations

import contextlib
import json
import threading
import time
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any


def completion(content: Any, **more: Any) -> bytes:
    """The body of a good response."""
    text = content if isinstance(content, str) or content is None else json.dumps(content)
    body = {
        "id": "1",
        "object": "chat.completion",
        "created": 0,
        "model": "m",
        "choices": [{"index": 0, "finish_reason": "stop", "message": {"role": "assistant", "content": text} | more}],
        "usage": {"prompt_tokens": 90, "completion_tokens": 10, "total_tokens": 100},
    }
    return json.dumps(body).encode()


class Server:
    """Answers one request after the other by its list, the last one for ever."""

    def __init__(self) -> None:
        self.answers: list[Callable[[BaseHTTPRequestHandler], None]] = []
        self.requests: list[dict[str, Any]] = []
        self.headers: list[dict[str, str]] = []
        self.url = ""

    def say(self, body: bytes | Any, status: int = 200, **headers: str) -> None:
        """Answer with a body."""
        body = body if isinstance(body, bytes) else completion(body)

        def answer(handler: BaseHTTPRequestHandler) -> None:
            handler.send_response(status)
            for name, value in {"content-type": "application/json", "content-length": str(len(body))}.items():
                handler.send_header(name, headers.pop(name.replace("-", "_"), value))
            for name, value in headers.items():
                handler.send_header(name.replace("_", "-"), value)
            handler.end_headers()
            handler.wfile.write(body)

        self.answers.append(answer)

    def do(self, answer: Callable[[BaseHTTPRequestHandler], None]) -> None:
        """Answer by a function."""
        self.answers.append(answer)


def flood(handler: BaseHTTPRequestHandler) -> None:
    """Send 100 MB."""
    handler.send_response(200)
    handler.send_header("content-type", "application/json")
    handler.end_headers()
    with contextlib.suppress(OSError):
        for _ in range(100):
            handler.wfile.write(b" " * 1_000_000)


def drip(handler: BaseHTTPRequestHandler) -> None:
    """Send a little now and then."""
    handler.send_response(200)
    handler.send_header("content-type", "application/json")
    handler.end_headers()
    with contextlib.suppress(OSError):
        for _ in range(100):
            handler.wfile.write(b" ")
            handler.wfile.flush()
            time.sleep(0.1)


def drip_headers(handler: BaseHTTPRequestHandler) -> None:
    """Send a line of the header now and then."""
    with contextlib.suppress(OSError):
        handler.wfile.write(b"HTTP/1.1 200 OK\r\n")
        for k in range(100):
            handler.wfile.write(b"x-%d: 1\r\n" % k)
            handler.wfile.flush()
            time.sleep(0.1)


def sleep(handler: BaseHTTPRequestHandler) -> None:
    """Say nothing."""
    time.sleep(3)


def hang_up(handler: BaseHTTPRequestHandler) -> None:
    """Close the connection."""
    handler.connection.close()


def nonsense(handler: BaseHTTPRequestHandler) -> None:
    """Send a stream of events that nobody asked for."""
    handler.send_response(200)
    handler.send_header("content-type", "text/event-stream")
    handler.end_headers()
    with contextlib.suppress(OSError):
        for k in range(50):
            handler.wfile.write(f"data: {{{k}\n\n".encode())


@contextlib.contextmanager
def serving() -> Iterator[Server]:
    """Run a server on a free port of this machine."""
    server = Server()

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            length = int(self.headers.get("content-length", 0))
            server.requests.append(json.loads(self.rfile.read(length)))
            server.headers.append({name.lower(): value for name, value in self.headers.items()})
            answer = server.answers[min(len(server.requests), len(server.answers)) - 1]
            with contextlib.suppress(OSError):
                answer(self)

        def log_message(self, format: str, *args: Any) -> None:
            pass

    http = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    http.daemon_threads = True
    server.url = f"http://127.0.0.1:{http.server_address[1]}/v1"
    thread = threading.Thread(target=http.serve_forever, args=(0.01,), daemon=True)
    thread.start()
    try:
        yield server
    finally:
        http.shutdown()
        http.server_close()
