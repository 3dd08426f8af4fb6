"""Conversations that are replayed: what a model said in another run, or what somebody wrote by hand."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from torchdlo.agents.vlm.conversation import Question, Reply, plain_text
from torchdlo.errors import InputError
from torchdlo.untrusted import read_json

__all__ = ["RecordedConversation", "load_recorded"]

_SIZE = 50_000_000
"""Most bytes of a file."""


@dataclass(eq=False)
class RecordedConversation:
    """A conversation that is replayed in its order.

    Answers that say which request they are for, by its hash, answer no other; those that say none, as written by hand,
    answer any request of their kind.
    """

    source: str
    answers: list[dict[str, Any]]
    where: str
    _next: int = field(default=0)
    remote: ClassVar[bool] = False

    def reply(self, question: Question, messages: list[dict[str, Any]], digest: str) -> Reply:
        """Return the next answer."""
        del messages
        number = self._next + 1
        if self._next >= len(self.answers):
            raise InputError(
                f"{self.where}: it holds {len(self.answers)} answers, and there is a request for {question.kind} more; "
                "record a longer conversation."
            )
        found = self.answers[self._next]
        if found["kind"] != question.kind:
            raise InputError(
                f"{self.where}: answer {number} is one for {plain_text(found['kind'], 40)}, and the request is for "
                f"{question.kind}; replay it with the task and options with which it was recorded."
            )
        if found["sha256"] not in (None, digest):
            raise InputError(
                f"{self.where}: answer {number} is one to another request; replay it with the task, options and "
                "version with which it was recorded, or remove its request_sha256 to take it anyway."
            )
        self._next += 1
        return Reply(found["text"], found["tokens"])

    def skip(self, count: int) -> None:
        """Leave out answers that a run that goes on has read already."""
        self._next = count


def load_recorded(path: Path) -> RecordedConversation:
    """Return the conversation in a file, or in the folder of a run.

    A file is {"source": who said it, "exchanges": [{"kind", "response", "request_sha256" if wanted}]}; responses are
    texts, or objects for short.
    """
    try:
        if path.is_dir():
            files = sorted((path / "exchanges").glob("*.json"))
            said = [_read(file) for file in files]
            source = said[0]["source"] if said else ""
            rows = [row for row in said if row["response"] is not None]  # the last one may have been sent in vain
        else:
            content = _read(path)
            source, rows = content["source"], content["exchanges"]
        answers = [
            {
                "kind": str(row["kind"] if "kind" in row else row["request"]["kind"]),
                "text": row["response"] if isinstance(row["response"], str) else json.dumps(row["response"]),
                "sha256": row.get("request_sha256"),
                "tokens": int(row.get("tokens", 0)),
            }
            for row in rows
        ]
        if not answers or not isinstance(source, str):
            raise ValueError
    except InputError:
        raise
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError):
        raise InputError(
            f'{path}: expected a conversation, {{"source": "...", "exchanges": '
            '[{"kind": "plan", "response": "..."}]}, or the folder of a run.'
        ) from None
    label = plain_text(source, 120)
    return RecordedConversation(label if label.startswith("recorded: ") else f"recorded: {label}", answers, str(path))


def _read(file: Path) -> Any:
    return read_json(file, "a conversation", most=_SIZE)
