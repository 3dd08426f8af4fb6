"""Local pages answer this machine's own pages only; a bad client is dropped, and the server stays."""

from __future__ import annotations

import http.client
import json
import logging
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from torchdlo.errors import InputError
from torchdlo.local_server import Guard, drop_log, listen

LOCAL = Guard("127.0.0.1", 8080)
OPEN = Guard("0.0.0.0", 8080, "secret")


@pytest.mark.parametrize("host", ["127.0.0.1:8080", "localhost:8080", "LOCALHOST:8080", "[::1]:8080"])
def test_this_machine_is_let_in(host: str) -> None:
    assert not LOCAL.refusal([host], []) and not LOCAL.refusal([host], [f"http://{host}"], changes=True)


@pytest.mark.parametrize(
    ("hosts", "origins"),
    [
        (["evil.example:8080"], []),
        (["localhost"], []),
        (["localhost:8081"], []),
        (["127.0.0.1:8080.evil.example"], []),
        ([], []),
        (["localhost:8080", "localhost:8080"], []),
        (["localhost:8080"], ["http://evil.example"]),
        (["localhost:8080"], ["null"]),
        (["localhost:8080"], ["http://127.0.0.1:8080"]),
        (["localhost:8080"], ["https://localhost:8080"]),
        (["localhost:8080"], ["http://localhost:8080", "http://evil.example"]),
    ],
)
def test_others_are_not(hosts: list[str], origins: list[str]) -> None:
    assert LOCAL.refusal(hosts, origins)


def test_a_server_that_others_reach_wants_its_token() -> None:
    assert OPEN.path("/secret/") == "/" and OPEN.path("/secret/a?b") == "/a?b" and OPEN.path("/secret?b") == "/?b"
    for path in ("/", "/secre", "/secrets/", "/a/secret/", "secret2", "//secret/"):
        assert OPEN.path(path) is None
    assert not OPEN.refusal(["any.name:8080"], ["http://any.name:8080"], changes=True)
    assert OPEN.refusal(["any.name:8080"], ["http://evil.example"])
    with listen("0.0.0.0", 0) as one, listen("0.0.0.0", 0) as two, listen("127.0.0.1", 0) as three:
        tokens = [Guard.of(each).token for each in (one, two, three)]
    assert len(tokens[0]) > 20 and tokens[0] != tokens[1] and tokens[2] == ""
    assert tokens[0] not in repr(Guard("0.0.0.0", 1, tokens[0]))


def test_addresses_of_others_and_taken_ports_are_a_sentence() -> None:
    for host in ("192.0.2.1", "evil.example", "", "127.0.0.1.", "fe80::1"):
        with pytest.raises(InputError, match=r"^host .*127\.0\.0\.1") as refused:
            listen(host, 0)
        assert str(refused.value).count("\n") == 0
    with listen("127.0.0.1", 0) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(InputError, match=rf"port {port}: expected a free one"):
            listen("127.0.0.1", port)
        with listen("127.0.0.1", port, tries=50) as other:
            assert port < other.getsockname()[1] < port + 50


def test_the_log_has_a_line_per_client_and_an_end(caplog: pytest.LogCaptureFixture) -> None:
    dropped = drop_log("page")
    with caplog.at_level(logging.WARNING, "torchdlo"):
        for k in range(100):
            dropped(f"reason {k}\nmore")
    assert len(caplog.records) == 20 and "\n" not in caplog.text.strip().splitlines()[0]
    assert caplog.records[0].getMessage() == "page: a client was dropped: reason 0 more"


# The page of segment


@pytest.fixture
def segment(tmp_path: Path) -> Iterator[Any]:
    pytest.importorskip("cv2")
    from torchdlo.vision.segment import Ranges
    from torchdlo.vision.segment_server import segment_server

    server = segment_server(np.zeros((3, 8, 8, 3), np.uint8), Ranges(), tmp_path / "segment.json")
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True)
    thread.start()
    yield server
    server.shutdown()
    server.server_close()
    thread.join()


def post(server: Any, path: str, body: bytes) -> int:
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=60)
    connection.request("POST", path, body, {"Origin": server.address.rstrip("/")})
    status = connection.getresponse().status
    connection.close()
    return status


def test_values_that_are_none_are_refused_and_the_page_stays(segment: Any, capfd: pytest.CaptureFixture[str]) -> None:
    deep = b"[" * 4000 + b"]" * 4000
    for value in (b"1e999", b"-1e999", b"NaN", b'"x"', b"[]", b"{}", b"null", deep):
        for path in ("/pick", "/mask", "/save"):
            for body in (b'{"frame": %s, "x": 0.5, "y": 0.5, "ranges": {}}', b'{"frame": 0, "x": %s, "y": 0.5}', b"%s"):
                assert post(segment, path, body % value) in (200, 400), (path, body % value)
    for frame in (10**30, -(10**30), 1e6):
        assert post(segment, "/pick", json.dumps({"frame": frame, "x": 0.5, "y": 0.5}).encode()) == 200
    for bad in (b"\x00\xff\n\n", b"GET / HTTP/1.1\r\n\r\n", b"POST /save HTTP/1.1\r\nContent-Length: 5\r\n", b""):
        with socket.create_connection(("127.0.0.1", segment.server_port)) as client:
            client.sendall(bad)
    assert post(segment, "/pick", b'{"frame": 0, "x": 0.5, "y": 0.5}') == 200
    assert "Traceback" not in capfd.readouterr().err


def test_a_full_disk_is_said_on_the_page(segment: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("torchdlo.vision.segment_server.save_ranges", full)
    assert post(segment, "/save", b'{"ranges": {"hue": [0, 10]}}') == 500
