"""A model behind an endpoint that speaks the chat completions of OpenAI, such as vLLM, SGLang, llama.cpp or Ollama.

Nothing is sent but to this endpoint: redirects are not followed, and no proxy of the environment is asked. The key is
read from the environment and is neither written down nor shown, not even where a server says it.
"""

from __future__ import annotations

import base64
import json
import os
import queue
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, ClassVar
from urllib.parse import urlsplit

from torchdlo.agents.vlm.conversation import Question, Reply, plain_text
from torchdlo.errors import InputError

__all__ = ["KEY", "Endpoint"]

KEY = "OPENAI_API_KEY"
"""The variable of the environment that holds the key, if the endpoint wants one."""

_AGAIN = (408, 409, 425, 429, 500, 502, 503, 504, 529)
"""What servers say that may do better later."""


_SECRET = 8
"""Letters from which on a key is one: servers without keys are given words such as "none" or "EMPTY"."""
_GRACE = 1.0
"""How long it may take beyond its time until a request is given up from outside [s]."""

_Sent = tuple[int | None, str, float | None, str | None]
"""Status, what went wrong, how long to wait if the server says so [s], and the body if all went well."""


class _TooMuch(Exception):
    """A response is too large, too late or packed."""


@dataclass(frozen=True)
class Endpoint:
    """A model on a server."""

    url: str
    model: str
    seconds: float = 120.0
    """Time for one request [s]."""
    retries: int = 4
    """How often a request is sent again after an error that may pass."""
    backoff: float = 1.0
    """Time before the first of them, doubled for each after it [s]."""
    size: int = 4_000_000
    """Most bytes of a response."""
    answer_tokens: int = 8_000
    """Most tokens of an answer."""
    sleep: Callable[[float], None] = time.sleep
    remote: ClassVar[bool] = True

    def __post_init__(self) -> None:
        parts = urlsplit(self.url)
        if parts.username or parts.password:
            raise InputError(
                f"endpoint: there is a name or password in the address of {plain_text(parts.hostname or '', 80)!r}; "
                f"leave it out, and put the key into {KEY}."
            )
        if parts.scheme not in ("http", "https") or not parts.hostname:
            raise InputError(
                f"endpoint: it is {plain_text(self.url, 80)!r}; expected the address of a server, such as "
                "http://localhost:8000/v1."
            )
        _packages()
        _key()

    @property
    def source(self) -> str:
        """What is written down: model and server."""
        return f"model {plain_text(self.model, 80)} at {urlsplit(self.url).netloc}"

    def reply(self, question: Question, messages: list[dict[str, Any]], digest: str) -> Reply:
        """Return what the model says; errors that may pass are waited for."""
        del digest
        content = [_message(m) for m in messages]
        schema = {"name": question.kind, "schema": question.answer.model_json_schema(), "strict": False}
        form = {"response_format": {"type": "json_schema", "json_schema": schema}}
        # Some servers do not know all of it; answers are checked anyway.
        wanted: list[dict[str, Any]] = [{**form, "temperature": 0, "max_tokens": self.answer_tokens}, form, {}]
        waits = [self.backoff * 2**k for k in range(self.retries)]
        while True:
            status, why, wait, text = self._send(content, wanted[0])
            if text is not None:
                return self._read(text)
            if status in (400, 422) and len(wanted) > 1:
                wanted = wanted[1:]
                continue
            if not waits or (status is not None and status not in _AGAIN):
                raise InputError(f"{self.source}: {why}; check the server, then go on with --resume.")
            self.sleep(min(60.0, wait if wait is not None else waits[0]))
            waits.pop(0)

    def skip(self, count: int) -> None:
        """Do nothing: servers remember nothing."""

    def _send(self, content: list[dict[str, Any]], wanted: dict[str, Any]) -> _Sent:
        """Return what came of a request, in the time that there is for it, whatever the server does with it."""
        found: queue.SimpleQueue[_Sent | Exception] = queue.SimpleQueue()

        def request() -> None:
            try:
                found.put(self._request(content, wanted))
            except Exception as error:  # raised below, where somebody hears of it
                found.put(error)

        # Time-outs of HTTP are for each piece of a response, and there is none for finding a name's address.
        threading.Thread(target=request, daemon=True).start()
        try:
            sent = found.get(timeout=self.seconds + _GRACE)
        except queue.Empty:
            return None, f"it did not end its answer within {self.seconds:g} s", None, None
        if isinstance(sent, Exception):
            raise sent
        status, why, wait, text = sent
        return status, _without_key(why), wait, None if text is None else _without_key(text)

    def _request(self, content: list[dict[str, Any]], wanted: dict[str, Any]) -> _Sent:
        """Return status, what went wrong, how long to wait if the server says so, and the body if all went well."""
        openai, httpx = _packages()
        key = _key() or "none"
        transport = _Capped(httpx, self.size, self.seconds)
        with httpx.Client(transport=transport, follow_redirects=False, timeout=self.seconds) as http:
            client = openai.OpenAI(api_key=key, base_url=self.url, http_client=http, max_retries=0)
            try:
                raw = client.chat.completions.with_raw_response.create(
                    model=self.model,
                    messages=content,
                    extra_headers={"Accept-Encoding": "identity"},
                    **wanted,
                )
                return 200, "", None, raw.http_response.text
            except openai.APIStatusError as error:
                said = plain_text(_without_key(error.response.text), 200)
                return error.status_code, f"it answered {error.status_code}: {said}", _asked(error.response), None
            except openai.APITimeoutError:
                return None, f"it did not answer within {self.seconds:g} s", None, None
            except openai.APIConnectionError as error:
                cause = error.__cause__ or error
                if isinstance(cause, _TooMuch):
                    return 413, str(cause), None, None
                return None, f"there is no connection ({plain_text(str(cause), 120)})", None, None
            except _TooMuch as error:
                return 413, str(error), None, None
            except httpx.TimeoutException:
                return None, f"it did not answer within {self.seconds:g} s", None, None
            except httpx.HTTPError as error:
                return None, f"there is no connection ({plain_text(str(error), 120)})", None, None
            except (openai.OpenAIError, ValueError) as error:
                return 0, f"its answer cannot be read ({plain_text(str(error), 120)})", None, None

    def _read(self, body: str) -> Reply:
        """Return the answer in the body of a response; an empty one if there is none, which is then asked for again."""
        try:
            content = json.loads(body)
            message = content["choices"][0]["message"]
            text = message.get("content") or message.get("refusal") or ""
            if isinstance(text, list):
                text = "".join(str(part.get("text", "")) for part in text)
            used = content.get("usage") or {}
            tokens = used.get("total_tokens") if isinstance(used, dict) else 0
        except (ValueError, KeyError, IndexError, TypeError, AttributeError, RecursionError):
            return Reply(f"(no completion: {plain_text(body, 200)})")
        # What was escaped in the body is plain now.
        return Reply(_without_key(str(text)), tokens if isinstance(tokens, int) and tokens >= 0 else 0)


def _key() -> str:
    """Return the key, "" if there is none."""
    key = os.environ.get(KEY, "").strip()
    if not (key.isascii() and key.isprintable()):
        raise InputError(f"{KEY}: it holds letters that no key has; set it to the key alone.")
    return key


def _without_key(text: str) -> str:
    """Return a text in which the key does not stand, whatever a server put there."""
    key = _key()
    return text.replace(key, "***") if len(key) >= _SECRET else text


def _message(message: dict[str, Any]) -> dict[str, Any]:
    """Return a message as the protocol has it; pictures go along as data."""
    if not message["pictures"]:
        return {"role": message["role"], "content": message["text"]}
    parts: list[dict[str, Any]] = [{"type": "text", "text": message["text"]}]
    for picture in message["pictures"]:
        data = base64.b64encode(picture.png).decode()
        parts.append({"type": "text", "text": f"Picture: {picture.name}"})
        parts.append({"type": "image_url", "image_url": {"url": f"data:image/png;base64,{data}"}})
    return {"role": message["role"], "content": parts}


def _asked(response: Any) -> float | None:
    """Return how long a server asks to wait [s]."""
    try:
        return max(0.0, float(response.headers["retry-after"]))
    except (KeyError, ValueError):
        return None


def _packages() -> tuple[Any, Any]:
    """Return the packages for the protocol, and for HTTP; say so if they are missing."""
    try:
        import openai
    except ImportError:
        raise InputError(
            "a model behind an endpoint needs the package openai; install it with pip install 'torchdlo[vlm]'."
        ) from None
    try:
        import httpx2 as httpx  # what openai 3 is made with
    except ImportError:
        import httpx  # type: ignore[no-redef]
    return openai, httpx


def _Capped(httpx: Any, size: int, seconds: float) -> Any:
    """Return a transport that reads so many bytes of a response, for so many seconds."""

    class Stream(httpx.SyncByteStream):
        def __init__(self, inner: Any, until: float) -> None:
            self.inner, self.until = inner, until

        def __iter__(self) -> Iterator[bytes]:
            read = 0
            for chunk in self.inner:
                read += len(chunk)
                if read > size:
                    raise _TooMuch(f"its answer is larger than {size} bytes")
                if time.monotonic() > self.until:
                    raise _TooMuch(f"it did not end its answer within {seconds:g} s")
                yield chunk

        def close(self) -> None:
            self.inner.close()

    class Transport(httpx.BaseTransport):
        def __init__(self) -> None:
            self.inner = httpx.HTTPTransport()

        def handle_request(self, request: Any) -> Any:
            until = time.monotonic() + seconds
            response = self.inner.handle_request(request)
            if response.headers.get("content-encoding", "identity") not in ("", "identity"):
                response.close()
                raise _TooMuch("its answer is packed, which it was asked not to be")
            return httpx.Response(
                response.status_code,
                headers=response.headers,
                stream=Stream(response.stream, until),
                extensions=response.extensions,
            )

        def close(self) -> None:
            self.inner.close()

    return Transport()
