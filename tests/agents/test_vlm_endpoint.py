"""Models behind an endpoint: a real server on this machine that answers well, badly, late, or not at all."""

from __future__ import annotations

import base64
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from pydantic import BaseModel, ConfigDict

from tests.agents import vlm_server
from tests.agents.vlm_server import Server, completion
from torchdlo.agents.vlm.conversation import Conversation, ConversationBudget, Question, ShownPicture
from torchdlo.agents.vlm.endpoint import Endpoint
from torchdlo.agents.vlm.recorded import load_recorded
from torchdlo.errors import InputError


class Answer(BaseModel):
    """What is asked for."""

    model_config = ConfigDict(extra="forbid")
    vertex: int


PICTURE = ShownPicture("the scene", b"\x89PNG torchdlo")
QUESTION = Question("grasps", "You are asked.", "Which vertex?", (PICTURE,), Answer)


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    """Return a server; there is a key for it."""
    monkeypatch.setenv("OPENAI_API_KEY", "sk-very-secret")
    with vlm_server.serving() as found:
        yield found


def small(answer: Answer) -> int:
    """Refuse vertices beyond 9."""
    if answer.vertex > 9:
        raise InputError(f"there is no vertex {answer.vertex}.")
    return answer.vertex


def asked(server: Server, folder: Path | None = None, resume: bool = False, **choices: Any) -> tuple[int, Conversation]:
    """What a conversation of one question comes to."""
    given = {"seconds": 1.0, "retries": 2, "sleep": lambda _: None} | choices
    talk = Conversation(Endpoint(server.url, "m", **given), folder, ConversationBudget(calls=6), resume)
    return talk.ask(QUESTION, small), talk


def goes_on(server: Server, folder: Path) -> None:
    """Check that a run whose server was bad goes on with one that is not."""
    server.answers.clear()
    server.requests.clear()
    server.say({"vertex": 7})
    assert asked(server, folder, resume=True, seconds=10.0)[0] == 7
    assert len(server.requests) == 1


def test_a_good_answer_is_had_at_once(server: Server, tmp_path: Path) -> None:
    server.say({"vertex": 4})
    found, talk = asked(server, tmp_path)
    assert (found, talk.calls, talk.tokens) == (4, 1, 100)
    request = server.requests[0]
    assert request["response_format"]["json_schema"]["schema"] == Answer.model_json_schema()
    picture = request["messages"][1]["content"][2]["image_url"]["url"]
    assert base64.b64decode(picture.removeprefix("data:image/png;base64,")) == PICTURE.png
    assert server.headers[0]["authorization"] == "Bearer sk-very-secret"


def test_the_key_is_written_nowhere(server: Server, tmp_path: Path) -> None:
    server.say(b"your key sk-very-secret is wrong", 401)
    with pytest.raises(InputError) as caught:
        asked(server, tmp_path)
    assert "sk-very-secret" not in str(caught.value) and "it answered 401" in str(caught.value)
    server.answers.clear()
    server.say({"vertex": 4})
    asked(server, tmp_path)
    server.answers.clear()
    server.requests.clear()
    server.say("Your key is sk-very-secret.")
    # As JSON may have it, too.
    server.say(completion("Once more: KEY").replace(b"KEY", b"sk\\u002dvery\\u002dsecret"))
    server.say({"vertex": 4})
    assert asked(server, tmp_path / "echo")[0] == 4
    files = [p for p in tmp_path.rglob("*") if p.is_file()]
    assert len(files) > 3 and not any(b"sk-very-secret" in p.read_bytes() for p in files)
    assert "Your key is ***." in (tmp_path / "echo" / "exchanges" / "001.json").read_text()


@pytest.mark.parametrize("key", ["sk-very-secret\n", "  sk-very-secret"])
def test_blanks_about_a_key_are_left_out(server: Server, monkeypatch: pytest.MonkeyPatch, key: str) -> None:
    monkeypatch.setenv("OPENAI_API_KEY", key)
    server.say({"vertex": 4})
    assert asked(server)[0] == 4 and server.headers[0]["authorization"] == "Bearer sk-very-secret"


@pytest.mark.parametrize("key", ["sk-very-secret\nmore", "sk-very-secr\u00e9t"])
def test_keys_that_are_none_are_not_shown(monkeypatch: pytest.MonkeyPatch, key: str) -> None:
    monkeypatch.setenv("OPENAI_API_KEY", key)
    with pytest.raises(InputError, match=r"^OPENAI_API_KEY: .*\.$") as caught:
        Endpoint("http://localhost:1/v1", "m")
    assert "sk-" not in str(caught.value)


def test_words_in_the_place_of_a_key_stay_in_answers(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENAI_API_KEY", "none")
    server.say({"vertex": "none"})
    server.say({"vertex": 4})
    assert asked(server)[0] == 4 and "none" in server.requests[1]["messages"][-2]["content"]


FIXED = [
    ["```json\n{\"vertex\": 3}\n```"],
    ["Sure! Here you are: {\"vertex\": 3} Anything else?"],
    ["no JSON at all", {"vertex": 3}],
    [{"vertex": "many"}, {"vertex": 3}],
    [{"vertex": 3, "code": "import os"}, {"vertex": 3}],
    [{"vertex": 30}, {"vertex": 3}],
    ["", {"vertex": 3}],
    [None, {"vertex": 3}],
    ["{" * 5000, "[" * 100_000, {"vertex": 3}],
    ['{"vertex": NaN}', '{"vertex": 1e999}', {"vertex": 3}],
]  # fmt: skip


@pytest.mark.parametrize("said", FIXED, ids=range(len(FIXED)))
def test_answers_that_do_not_fit_are_asked_for_again(server: Server, said: list[Any]) -> None:
    for each in said:
        server.say(completion(each))
    found, talk = asked(server)
    assert found == 3 and talk.calls == len(said)
    for request in server.requests[1:]:
        assert request["messages"][-1]["content"].startswith("That will not do: ")


def test_the_reason_is_told(server: Server) -> None:
    server.say({"vertex": 30})
    server.say({"vertex": 3})
    asked(server)
    assert "there is no vertex 30." in server.requests[1]["messages"][-1]["content"]
    assert json.loads(server.requests[1]["messages"][-2]["content"]) == {"vertex": 30}


BODIES = [b"", b"<html>busy</html>", b"null", b"[]", b"{}", b'{"choices": []}', b'{"choices": [{"message": 3}]}',
          b"\xff\xfe", b"[" * 100_000, completion(None, refusal="I cannot help with ropes.")]  # fmt: skip


@pytest.mark.parametrize("body", BODIES, ids=range(len(BODIES)))
def test_after_three_times_it_is_one_sentence(server: Server, tmp_path: Path, body: bytes) -> None:
    server.say(body)
    with pytest.raises(InputError) as caught:
        asked(server, tmp_path)
    said = str(caught.value)
    assert "\n" not in said and said.endswith(".") and said.isprintable() and len(said) < 600
    assert len(server.requests) in (3, 4)  # bodies that are no JSON at all may be sent for anew
    goes_on(server, tmp_path)


@pytest.mark.parametrize("status", [429, 500, 503])
def test_errors_that_may_pass_are_waited_for(server: Server, status: int) -> None:
    waited: list[float] = []
    server.say(b"later", status)
    server.say(b"later", status, retry_after="7")
    server.say({"vertex": 5})
    assert asked(server, sleep=waited.append)[0] == 5
    assert waited == [1.0, 7.0]


@pytest.mark.parametrize(
    ("how", "expected"),
    [
        ("flood", "its answer is larger than 100000 bytes"),
        ("drip", "did not end its answer within 0.4 s"),
        ("drip_headers", "did not end its answer within 0.4 s"),
        ("sleep", "did not answer within 0.4 s"),
        ("hang_up", "there is no connection"),
        ("nonsense", "no answer to the question for grasps would do"),
    ],
)
def test_bad_servers_are_one_sentence_soon(server: Server, tmp_path: Path, how: str, expected: str) -> None:
    server.do(getattr(vlm_server, how))
    begun = time.monotonic()
    with pytest.raises(InputError) as caught:
        asked(server, tmp_path, seconds=0.4, size=100_000, retries=1)
    assert expected in str(caught.value) and "\n" not in str(caught.value)
    assert time.monotonic() - begun < 10
    goes_on(server, tmp_path)


@pytest.mark.parametrize(("status", "body"), [(401, b"no"), (404, b"no such model"), (500, b"broken"), (302, b"")])
def test_other_errors_are_one_sentence(server: Server, tmp_path: Path, status: int, body: bytes) -> None:
    server.say(body, status, location="http://127.0.0.1:1/elsewhere")
    with pytest.raises(InputError, match=rf"it answered {status}|cannot be read") as caught:
        asked(server, tmp_path)
    assert "\n" not in str(caught.value)
    assert len(server.requests) == (3 if status == 500 else 1)
    goes_on(server, tmp_path)


def test_servers_without_schemas_are_asked_without(server: Server) -> None:
    for _ in range(2):
        server.say(b'{"error": {"message": "response_format is not supported"}}', 400)
    server.say({"vertex": 2})
    assert asked(server)[0] == 2
    kept = [{"response_format", "max_tokens"} & request.keys() for request in server.requests]
    assert kept == [{"response_format", "max_tokens"}, {"response_format"}, set()]


def test_nobody_there_is_one_sentence() -> None:
    endpoint = Endpoint("http://127.0.0.1:9/v1", "m", seconds=1, retries=1, sleep=lambda _: None)
    with pytest.raises(InputError, match="there is no connection"):
        Conversation(endpoint).ask(QUESTION, small)


@pytest.mark.parametrize("url", ["", "localhost", "file:///etc/passwd", "http://", "ftp://x/", "http://me:pw@x/v1"])
def test_addresses_are_checked(url: str) -> None:
    with pytest.raises(InputError, match=r"^endpoint: .*\.$") as caught:
        Endpoint(url, "m")
    assert "pw" not in str(caught.value)


def test_the_budget_ends_a_run_that_can_go_on(server: Server, tmp_path: Path) -> None:
    for _ in range(4):
        server.say("no JSON")
    server.say({"vertex": 1})
    endpoint = Endpoint(server.url, "m", sleep=lambda _: None)
    with pytest.raises(InputError, match="the budget of 2 calls"):
        Conversation(endpoint, tmp_path, ConversationBudget(calls=2)).ask(QUESTION, small)
    # What was said before is not asked again: five answers in all.
    again = Conversation(endpoint, tmp_path, ConversationBudget(calls=9), resume=True)
    assert again.ask(QUESTION, small) == 1 and again.calls == len(server.requests) == 5
    server.answers[:] = server.answers[:1]
    with pytest.raises(InputError, match="and 150 tokens"):
        Conversation(endpoint, None, ConversationBudget(tokens=150)).ask(QUESTION, small)


def test_what_was_said_is_kept_and_replayed(server: Server, tmp_path: Path) -> None:
    server.say("no JSON")
    server.say({"vertex": 6})
    asked(server, tmp_path)
    kept = [json.loads(p.read_text()) for p in sorted((tmp_path / "exchanges").iterdir())]
    assert [k["response"] for k in kept] == ["no JSON", '{"vertex": 6}']
    assert [p.read_bytes() for p in (tmp_path / "pictures").iterdir()] == [PICTURE.png]
    again = Conversation(load_recorded(tmp_path))
    assert again.ask(QUESTION, small) == 6
    assert again.model.source.startswith("recorded: model m at 127.0.0.1")
    other = Question("grasps", "You are asked.", "Which other vertex?", (PICTURE,), Answer)
    with pytest.raises(InputError, match="answer 1 is one to another request"):
        Conversation(load_recorded(tmp_path)).ask(other, small)


def test_a_run_that_goes_on_asks_nothing_twice(server: Server, tmp_path: Path) -> None:
    server.say({"vertex": 6})
    asked(server, tmp_path)
    found, talk = asked(server, tmp_path, resume=True)
    assert (found, talk.calls, len(server.requests)) == (6, 1, 1)
    (tmp_path / "exchanges" / "001.json").write_text("{")
    assert asked(server, tmp_path, resume=True)[0] == 6 and len(server.requests) == 2


def written(path: Path, rows: list[dict[str, Any]]) -> Path:
    """Return a conversation that somebody wrote."""
    path.write_text(json.dumps({"source": "written by hand, not by a model", "exchanges": rows}))
    return path


def test_conversations_by_hand_are_taken_by_their_order(tmp_path: Path) -> None:
    rows = [{"kind": "grasps", "response": "hm"}, {"kind": "grasps", "response": {"vertex": 8}}]
    talk = Conversation(load_recorded(written(tmp_path / "c.json", rows)))
    assert talk.ask(QUESTION, small) == 8
    assert talk.model.source == "recorded: written by hand, not by a model"
    with pytest.raises(InputError, match="it holds 2 answers"):
        talk.ask(QUESTION, small)
    with pytest.raises(InputError, match="answer 1 is one for plan, and the request is for grasps"):
        Conversation(load_recorded(written(tmp_path / "c.json", [{"kind": "plan", "response": "1"}]))).ask(
            QUESTION, small
        )


@pytest.mark.parametrize(
    "content", ["", "[]", "{}", '{"source": 1, "exchanges": [{}]}', '{"source": "a", "exchanges": []}', "[" * 99_999]
)
def test_files_that_are_no_conversation_are_refused(tmp_path: Path, content: str) -> None:
    file = tmp_path / "c.json"
    file.write_text(content)
    with pytest.raises(InputError, match="expected a conversation"):
        load_recorded(file)
