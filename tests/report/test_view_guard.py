"""The viewer answers its own page only, takes values in range, and no client ends it."""

from __future__ import annotations

import http.client
import logging
import socket
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from tests.report import browser
from torchdlo.scene_files import RopeSpec, SceneDescription
from torchdlo.scene_files.run import run

pytest.importorskip("viser", reason="the viewer needs the extra view")
import msgspec
import viser
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from torchdlo.report.viewer.guarded import checked
from torchdlo.report.viewer.server import Viewer

VERSION = f"viser-v{viser.__version__}"


@pytest.fixture(scope="module")
def frames() -> Any:
    rope = RopeSpec(((0.0, 0.0, 0.5), (0.4, 0.0, 0.5)), vertices=5, mass=0.03, bend=1e-3)
    return run(SceneDescription((rope,), {"bend": {}, "gravity": {}}, duration=0.05))


@pytest.fixture(scope="module")
def viewer(frames: Any) -> Iterator[Viewer]:
    made = Viewer(frames, title="a run", port=18200)
    yield made
    made.stop()


@pytest.fixture(scope="module")
def open_viewer(frames: Any) -> Iterator[Viewer]:
    made = Viewer(frames, host="0.0.0.0", port=18300)
    yield made
    made.stop()


def port(viewer: Viewer) -> int:
    return viewer.server.get_port()


def dial(viewer: Viewer, path: str = "/", **options: Any) -> Any:
    own = f"127.0.0.1:{port(viewer)}"
    options = {"subprotocols": [VERSION], "origin": f"http://{own}", "open_timeout": 60} | options
    return connect(f"ws://{own}{path}", max_size=None, compression=None, **options)


def get(viewer: Viewer, path: str, host: str | None = None) -> tuple[int, bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", port(viewer), timeout=60)
    connection.request("GET", path, headers={"Host": host or f"127.0.0.1:{port(viewer)}"})
    answer = connection.getresponse()
    found = answer.status, answer.read()
    connection.close()
    return found


def wait(condition: Any, seconds: float = 120.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it never came"
        time.sleep(0.01)


def test_pages_with_another_host_get_nothing(viewer: Viewer) -> None:
    assert get(viewer, "/")[0] == 200 and get(viewer, "/", f"localhost:{port(viewer)}")[0] == 200
    for host in ("evil.example", f"evil.example:{port(viewer)}", "localhost", f"127.0.0.1:{port(viewer) + 1}"):
        status, body = get(viewer, "/", host)
        assert status == 403 and b"<html" not in body


def test_web_sockets_of_other_pages_are_refused(viewer: Viewer) -> None:
    for origin in ("http://evil.example", "null", "https://localhost:1", f"http://localhost:{port(viewer)}"):
        with pytest.raises(InvalidStatus) as refused, dial(viewer, origin=origin):
            pass
        assert refused.value.response.status_code == 403
    for protocols in (None, ["viser-v0.0.0"]):
        with pytest.raises(InvalidStatus), dial(viewer, subprotocols=protocols):
            pass
    with dial(viewer) as client:
        assert client.recv(60)


def test_beyond_this_machine_the_address_has_a_token(open_viewer: Viewer) -> None:
    token = open_viewer.address.rstrip("/").rsplit("/", 1)[1]
    assert len(token) > 20
    for path in ("/", "/index.html", f"/{token[:-1]}/", f"/x/{token}/"):
        assert get(open_viewer, path)[0] == 403
    assert get(open_viewer, f"/{token}/", "some.name:80")[0] == 200
    for path in ("/", "/wrong"):
        with pytest.raises(InvalidStatus), dial(open_viewer, path):
            pass
    with dial(open_viewer, f"/{token}") as client:
        assert client.recv(60)


def update(viewer: Viewer, handle: Any, value: Any) -> bytes:
    return msgspec.msgpack.encode({"type": "GuiUpdateMessage", "uuid": handle._impl.uuid, "updates": {"value": value}})


def camera(**other: Any) -> bytes:
    """What a page says first; viser takes none of its values before."""
    said = {"wxyz": [1.0, 0.0, 0.0, 0.0], "position": [0.0] * 3, "look_at": [1.0] * 3, "up_direction": [0.0, 0.0, 1.0]}
    said |= {"fov": 1.0, "near": 0.1, "far": 10.0, "image_height": 9, "image_width": 16}
    return msgspec.msgpack.encode({"type": "ViewerCameraMessage"} | said | other)


def test_values_are_clamped_and_play_goes_on(viewer: Viewer) -> None:
    last = len(viewer.frames.time) - 1
    with dial(viewer) as client:
        client.send(camera())
        for value, shown in ((1e6, last), (-5, 0), (2, 2)):
            client.send(update(viewer, viewer.slider, value))
            wait(lambda shown=shown: viewer.slider.value == shown and viewer.frame == shown)
        for value, taken in ((1e300, 2.0), (-1e300, 0.05)):
            client.send(update(viewer, viewer.speed, value))
            wait(lambda taken=taken: viewer.speed.value == taken)
        client.send(update(viewer, viewer.playing, True))
        client.send(update(viewer, viewer.slider, 1e6))
        wait(lambda: viewer.playing.value)
        before = viewer.frame
        wait(lambda: viewer.frame != before)
        client.send(update(viewer, viewer.playing, False))
        wait(lambda: not viewer.playing.value)
    assert viewer._thread.is_alive() and viewer._failed is None


BAD = [
    "text",
    b"",
    b"\xc1",
    b"\x91" * 2000,
    msgspec.msgpack.encode({"type": "GuiUpdateMessage"}),
    msgspec.msgpack.encode({"type": ["a"]}),
    msgspec.msgpack.encode([1, 2]),
    msgspec.msgpack.encode({"type": "ViewerCameraMessage", "wxyz": "x"}),
    camera(fov=float("nan")),
    camera(position=[0.0, 0.0]),
    camera(owner="x"),
]


def test_a_bad_client_is_dropped_with_one_line_and_the_others_stay(
    viewer: Viewer, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    values = ["x", None, [1], {}, float("nan"), float("inf"), True]
    bad = [*BAD, *(update(viewer, viewer.slider, value) for value in values), update(viewer, viewer.playing, 3)]
    with dial(viewer) as good, caplog.at_level(logging.WARNING, "torchdlo"):
        for message in [*bad, b"x" * (1 << 20)]:
            caplog.clear()
            with dial(viewer) as client:
                client.send(message)
                with pytest.raises(ConnectionClosed):
                    while True:
                        client.recv(60)
            lines = [r.getMessage() for r in caplog.records]
            # The log is told of the first twenty.
            assert len(lines) <= 1 and all(line.startswith("viewer: a client was dropped: it") for line in lines)
        good.send(camera())
        good.send(update(viewer, viewer.slider, 3))
        wait(lambda: viewer.frame == 3)
    with socket.create_connection(("127.0.0.1", port(viewer))) as client:
        client.sendall(b"\x16\x03\x01junk\r\n\r\n")
    assert get(viewer, "/")[0] == 200 and viewer._thread.is_alive()
    said = capfd.readouterr()
    assert "Traceback" not in said.err and not said.out


def test_messages_that_no_page_of_ours_sends_go_no_further() -> None:
    bounds = {"slider": (0.0, 5.0), "switch": None}

    def sent(**content: Any) -> bytes | None:
        return checked(msgspec.msgpack.encode(content), bounds)

    for kind in ("ShareUrlRequest", "ShareUrlDisconnect", "FileTransferStartUpload", "RunJavascriptMessage", "none"):
        assert sent(type=kind) is None
    assert sent(type="GuiUpdateMessage", uuid="other", updates={"value": 1}) is None
    assert sent(type="GuiUpdateMessage", uuid="slider", updates={"min": 1}) is None
    found = sent(type="GuiUpdateMessage", uuid="slider", updates={"value": 7})
    assert msgspec.msgpack.decode(found)["updates"] == {"value": 5.0}


def test_the_run_cannot_be_published(viewer: Viewer) -> None:
    names = {kind.__name__ for kind in viewer.server._websock_server._incoming_handlers}
    assert names and not {"ShareUrlRequest", "ShareUrlDisconnect"} & names


def test_an_address_of_another_machine_is_a_sentence_at_once(frames: Any) -> None:
    from torchdlo.errors import InputError

    with pytest.raises(InputError, match=r"host 192\.0\.2\.1: expected an address of this machine"):
        Viewer(frames, host="192.0.2.1")


def test_what_goes_wrong_while_it_plays_is_not_kept_quiet(frames: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(self: Viewer) -> None:
        raise RuntimeError("broken")

    monkeypatch.setattr(Viewer, "_play", broken)
    with pytest.raises(RuntimeError, match="broken"):
        Viewer(frames, port=18400).wait()


@pytest.mark.slow
def test_a_browser_shows_the_run_also_with_a_token(viewer: Viewer, open_viewer: Viewer) -> None:
    program = browser.find()
    if program is None:
        pytest.skip("no browser at hand: set TORCHDLO_BROWSER")
    for each in (viewer, open_viewer):
        address = each.address.replace(socket.gethostname(), "127.0.0.1")
        with browser.launch(program) as page:
            page._call("Page.navigate", url=address)
            page.wait("location.protocol === 'http:' && document.body?.innerText.includes('speed')")
            wait(lambda each=each: len(each.server.get_clients()) > 0)
            each.slider.value = 4
            page.wait("[...document.querySelectorAll('input')].some(i => i.value === '4')")
    assert np.isfinite(viewer.frames.pos).all()
