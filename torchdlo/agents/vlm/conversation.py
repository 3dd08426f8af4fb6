"""A conversation with a model: questions with pictures, answers that fit a schema, and every exchange on disk.

An answer that does not fit is asked for again, with the reason. What was said already is read from the folder where a
run goes on, so that a run that was stopped asks for nothing twice.
"""

from __future__ import annotations

import hashlib
import json
import re
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, TypeVar

from torchdlo.errors import InputError
from torchdlo.files import write_atomically
from torchdlo.journal import read_json, write_json
from torchdlo.untrusted import one_line

__all__ = ["Conversation", "ConversationBudget", "LanguageModel", "Question", "Reply", "ShownPicture", "plain_text"]

A = TypeVar("A")

_TEXT = 200_000
"""Most letters of an answer that are read."""
_FENCE = re.compile(r"```(?:json|JSON)?\s*\n?(.*?)```", re.DOTALL)


@dataclass(frozen=True)
class ShownPicture:
    """A picture that is shown to a model."""

    name: str
    png: bytes

    @property
    def digest(self) -> str:
        """Its hash."""
        return hashlib.sha256(self.png).hexdigest()


@dataclass(frozen=True)
class Question:
    """What a model is asked."""

    kind: str
    """"grasps", "plan" or "update"."""
    system: str
    text: str
    pictures: tuple[ShownPicture, ...]
    answer: Any
    """The pydantic model that the answer has to fit."""
    facts: Any = None
    """What a stand-in without a model knows; never sent."""


@dataclass(frozen=True)
class Reply:
    """What came back."""

    text: str
    tokens: int = 0
    """Tokens of question and answer, 0 if not said."""


class LanguageModel(Protocol):
    """What answers."""

    source: str
    """What is written down beside everything that comes of it."""
    remote: bool
    """Whether questions are sent to it."""

    def reply(self, question: Question, messages: list[dict[str, Any]], digest: str) -> Reply:
        """Return what it says to messages: {"role", "text", "pictures"} each.

        Raises:
            InputError: there is no answer; one sentence.
        """
        ...

    def skip(self, count: int) -> None:
        """Be told that so many answers were read from the folder of a run that goes on."""
        ...


@dataclass(frozen=True)
class ConversationBudget:
    """What a run may cost."""

    calls: int = 60
    """Requests in all."""
    tokens: int = 2_000_000
    """Tokens in all."""
    again: int = 3
    """How often a question is asked again, with the reason."""


@dataclass(eq=False)
class Conversation:
    """What is said in a run."""

    model: LanguageModel
    folder: Path | None = None
    """Where exchanges and pictures are kept."""
    budget: ConversationBudget = field(default_factory=ConversationBudget)
    resume: bool = False
    """Whether exchanges that are there already are read."""
    callback: Callable[[str], None] = lambda _: None
    exchanges: list[dict[str, Any]] = field(default_factory=list)
    """All that was said so far."""
    unanswered: dict[str, Any] | None = None
    """What was sent and is not answered; its response is None."""

    @property
    def calls(self) -> int:
        """Requests so far."""
        return len(self.exchanges)

    @property
    def tokens(self) -> int:
        """Tokens so far."""
        return sum(e["tokens"] for e in self.exchanges)

    def ask(self, question: Question, check: Callable[[Any], A]) -> A:
        """Return what `check` makes of the answer.

        Args:
            question: what is asked.
            check: takes the answer as an instance of `question.answer`; raises `InputError` with the reason why it will
                not do.

        Raises:
            InputError: there was no answer, or none that will do.
        """
        said: list[dict[str, Any]] = [
            {"role": "system", "text": question.system, "pictures": ()},
            {"role": "user", "text": question.text, "pictures": question.pictures},
        ]
        reason, tries = "", 0
        while tries <= self.budget.again:
            text, new = self._exchange(question, said)
            # What was said in a run that goes on used up its own tries.
            tries += new
            try:
                return check(_fitting(text, question.answer))
            except InputError as error:
                reason = " ".join(str(error).split())
            self.callback(f"asked again: {reason}")
            said = [
                *said,
                {"role": "assistant", "text": text[:_TEXT], "pictures": ()},
                {
                    "role": "user",
                    "text": f"That will not do: {reason} Answer again, the whole of it, as JSON that fits the schema.",
                    "pictures": (),
                },
            ]
        raise InputError(
            f"{self.model.source}: no answer to the question for {question.kind} would do in {1 + self.budget.again} "
            f"tries; the last reason was: {reason} Use a stronger model, or --resume to ask again."
        )

    def _exchange(self, question: Question, said: list[dict[str, Any]]) -> tuple[str, bool]:
        """Return what the model says, from the folder if it said so before, and whether it was asked."""
        request = {
            "kind": question.kind,
            "messages": [
                {"role": m["role"], "text": m["text"], "pictures": [p.digest for p in m["pictures"]]} for m in said
            ],
            "schema": question.answer.model_json_schema(),
        }
        digest = hashlib.sha256(json.dumps(request, sort_keys=True).encode()).hexdigest()
        number = self.calls + 1
        found = self._recalled(number, digest)
        new = found is None
        if found is not None:
            self.model.skip(number)
        else:
            if number > self.budget.calls or self.tokens >= self.budget.tokens:
                raise InputError(
                    f"{self.model.source}: the budget of {self.budget.calls} calls and {self.budget.tokens} tokens is "
                    f"used up after {self.calls} calls and {self.tokens} tokens; go on with --resume and more of it."
                )
            found = {
                "generator": "torchdlo",
                "number": number,
                "source": self.model.source,
                "request": request,
                "request_sha256": digest,
                "response": None,
                "tokens": 0,
                "seconds": 0.0,
            }
            if self.model.remote:
                # What is sent is written down, whether an answer comes or not.
                self._keep(found, question)
                self.unanswered = found
            begun = time.monotonic()
            reply = self.model.reply(question, said, digest)
            found = found | {"response": reply.text, "tokens": reply.tokens}
            found["seconds"] = round(time.monotonic() - begun, 3)
            self._keep(found, question)
            self.unanswered = None
        self.exchanges.append(found)
        return found["response"], new

    def _file(self, number: int) -> Path | None:
        return None if self.folder is None else self.folder / "exchanges" / f"{number:03d}.json"

    def _recalled(self, number: int, digest: str) -> dict[str, Any] | None:
        file = self._file(number)
        if not self.resume or file is None or not file.is_file():
            return None
        found = read_json(file)
        if found is None or found.get("request_sha256") != digest:
            return None
        return found if isinstance(found.get("response"), str) and isinstance(found.get("tokens"), int) else None

    def _keep(self, found: dict[str, Any], question: Question) -> None:
        file = self._file(found["number"])
        if file is None or self.folder is None:
            return
        for picture in question.pictures:
            write_atomically(self.folder / "pictures" / f"{picture.digest[:16]}.png", picture.png)
        write_json(file, found)


def _fitting(text: str, answer: Any) -> Any:
    """Return an answer as an instance of the model that it has to fit."""
    import pydantic

    content = _json_of(text)
    try:
        return answer.model_validate(content)
    except pydantic.ValidationError as error:
        first = error.errors()[:4]
        said = "; ".join(f"{'.'.join(str(p) for p in e['loc'])[:80] or 'answer'}: {e['msg'][:160]}" for e in first)
        raise InputError(f"it does not fit the schema ({plain_text(said)}).") from None
    except RecursionError:
        raise InputError("it is nested too deeply.") from None


def _json_of(text: str) -> Any:
    """Return the JSON of an answer, which may stand in a fence or among words."""

    def refuse(_: str) -> Any:
        raise ValueError("no number")

    if not text.strip():
        raise InputError("it is empty.")
    text = text[:_TEXT]
    decoder = json.JSONDecoder(parse_constant=refuse)
    fenced = _FENCE.findall(text)
    for part in [*fenced[:3], text]:
        start = re.search(r"[\[{]", part)
        if start is None:
            continue
        try:
            return decoder.raw_decode(part[start.start() :])[0]
        except (ValueError, RecursionError):
            continue
    raise InputError(f"it is not JSON but {plain_text(text, 80)!r}.")


def plain_text(text: str, most: int = 400) -> str:
    """Return one line of a text that may come from anywhere: printable, and not too long."""
    return one_line(text, most)
