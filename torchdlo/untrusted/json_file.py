"""JSON from strangers: the one reader of it, and entries that say where they are when they are wrong."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from torchdlo.errors import InputError
from torchdlo.untrusted.names import one_line
from torchdlo.untrusted.regular_file import read_text

__all__ = ["DEPTH", "MOST", "Entry", "locate", "parse_json", "read_entry", "read_json"]

MOST = 16 * 2**20
"""Largest file [bytes]: a list of nothing takes some thirty times its text."""
DEPTH = 60
"""Deepest nesting of objects and lists."""
_DIGITS = 400
"""Longest number [letters]."""
_WHOLE = 2**63
"""Whole numbers lie below this."""

_BRACKETS = re.compile(r'"(?:[^"\\]|\\.)*+"?|[\[\]{}]', re.DOTALL)
_TOKENS = re.compile(r'"(?:[^"\\]|\\.)*+"?|[\[\]{},:]|[^\s\[\]{},:"]+', re.DOTALL)


class _Refused(Exception):
    """Something in the text that its place is to be found for."""


def read_json(path: str | Path, what: str, *, cure: str = "", most: int = MOST, finite: bool = True) -> Any:
    """Return the value in a JSON file.

    Args:
        path: the file.
        what: what it is to be, as in "a scene file".
        cure: what to do about a file that is not there.
        most: largest size [bytes].
        finite: whether NaN and infinities, which JSON does not know, are refused.

    Raises:
        MissingFile: There is none.
        InputError: It is not a regular file, too large, or not sound JSON.
    """
    text = read_text(path, what, most=most, cure=cure)
    return parse_json(text, where=one_line(path), what=f"{what} in JSON", finite=finite)


def read_entry(path: str | Path, what: str, *, cure: str = "", most: int = MOST) -> Entry:
    """Return the whole of a JSON file as an entry, see `read_json`."""
    return Entry(read_json(path, what, cure=cure, most=most), one_line(path), "", what)


def parse_json(text: str, *, where: str, what: str = "JSON", finite: bool = True) -> Any:
    """Return the value of a text; `where` begins the sentence that says what is wrong with it."""
    _check_depth(text, where, what)

    def constant(name: str) -> float:
        if finite:
            raise _Refused
        return float(name)

    try:
        return json.loads(
            text, object_pairs_hook=_object, parse_int=_whole, parse_float=_float, parse_constant=constant
        )
    except json.JSONDecodeError as error:
        raise InputError(
            f"{where}: expected {what}, but line {error.lineno}, column {error.colno} is not JSON ({error.msg}); mend "
            "that place, or copy the file again if it is cut."
        ) from None
    except (_Refused, RecursionError):
        _explain(text, where, what, finite)


def _check_depth(text: str, where: str, what: str) -> None:
    if text.count("[") + text.count("{") <= DEPTH:
        return
    depth = 0
    for found in _BRACKETS.finditer(text):
        letter = found[0]
        if letter in ("[", "{"):
            depth += 1
            if depth > DEPTH:
                raise InputError(
                    f"{where}: {_line(text, found.start())}: expected {what} with at most {DEPTH} objects and lists in "
                    "each other, found more; it is another kind of file, or damaged."
                )
        elif letter in ("]", "}"):
            depth -= 1


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        raise _Refused
    return found


def _whole(text: str) -> int:
    if len(text) > 20 or not -_WHOLE <= int(text) < _WHOLE:
        raise _Refused
    return int(text)


def _float(text: str) -> float:
    value = float(text) if len(text) <= _DIGITS else math.inf
    if math.isinf(value):
        raise _Refused
    return value


def _line(text: str, at: int) -> str:
    start = text.rfind("\n", 0, at) + 1
    return f"line {text.count(chr(10), 0, start) + 1}, column {at - start + 1}"


def _explain(text: str, where: str, what: str, finite: bool) -> NoReturn:
    """Say where the first number or name is that the reader does not take."""
    for at, token, place in _walk(text):
        if isinstance(place, _Twice):
            raise InputError(
                f"{where}: {_line(text, at)}: expected {what} that names each entry once, found {place.name} twice; "
                "remove one."
            )
        here = f"{where}: {place + ': ' if place else ''}{_line(text, at)}"
        if token in ("NaN", "Infinity", "-Infinity") and finite:
            raise InputError(f"{here}: expected a finite number, found {token}; give a number.")
        if token[0] in "-0123456789":
            try:
                value = (_float if re.search("[.eE]", token) else _whole)(token)
            except _Refused:
                value = None
            except ValueError:
                continue
            if value is None:
                whole = not re.search("[.eE]", token)
                limit = "a whole number below 2^63 in size" if whole else "a finite number of at most 400 letters"
                found = token if len(token) <= 40 else f"{token[:10]}... with {len(token)} letters"
                raise InputError(f"{here}: expected {limit}, found {found}; write it as 1.5e3 is, in SI units.")
    raise InputError(f"{where}: expected {what}, found something else; is the file damaged?")


@dataclass(frozen=True)
class _Twice:
    name: str


def _walk(text: str) -> Iterator[tuple[int, str, Any]]:
    """Yield position, text and place, as ropes[0].mass, of every token that is no bracket of sound JSON."""
    stack: list[list[Any]] = []
    """Of each open bracket: names so far or None, the current name or index."""
    for found in _TOKENS.finditer(text):
        token = found[0]
        if token == "{":
            stack.append([set(), None])
        elif token == "[":
            stack.append([None, 0])
        elif token in ("]", "}"):
            if stack:
                stack.pop()
        elif token == ",":
            if stack:
                stack[-1][1] = None if stack[-1][0] is not None else stack[-1][1] + 1
        elif token == ":":
            continue
        elif stack and stack[-1][0] is not None and stack[-1][1] is None:
            try:
                name = json.loads(token)
            except ValueError:
                name = token
            stack[-1][1] = name
            if name in stack[-1][0]:
                yield found.start(), token, _Twice(locate(_places(stack)))
            stack[-1][0].add(name)
        else:
            yield found.start(), token, locate(_places(stack))


def _places(stack: list[list[Any]]) -> list[Any]:
    return [here for _, here in stack if here is not None]


def locate(places: list[Any]) -> str:
    """Return names and indices as one place, such as ropes[0].mass."""
    said = "".join(f"[{p}]" if isinstance(p, int) else f".{one_line(p, 60)}" for p in places)
    return said.removeprefix(".")


@dataclass(frozen=True)
class Entry:
    """A value of a JSON file, and where it is: what is asked of it and is not so is one sentence."""

    value: Any
    """The value, as JSON has it."""
    where: str
    """The file."""
    place: str = ""
    """Where in it, such as ropes[0].mass; "" for the whole."""
    what: str = "JSON"
    """What the file is to be."""

    def wrong(self, expected: str, found: str | None = None) -> InputError:
        """Return the sentence."""
        said = _said(self.value) if found is None else found
        if not self.place:
            return InputError(f"{self.where}: expected {self.what}, {expected}, found {said}; is it another file?")
        return InputError(f"{self.where}: {self.place}: expected {expected}, found {said}.")

    def object(self) -> dict[str, Any]:
        """Return an object."""
        if not isinstance(self.value, dict):
            raise self.wrong("an object {...}")
        return self.value

    def __contains__(self, name: str) -> bool:
        """Return whether an object has an entry that is not null."""
        return self.object().get(name) is not None

    def __getitem__(self, key: str | int) -> Entry:
        """Return an entry of an object, or of a list."""
        if isinstance(key, int):
            return Entry(self.items()[key].value, self.where, f"{self.place}[{key}]", self.what)
        if key not in self.object():
            raise InputError(
                f"{self.where}: {self.place + '.' if self.place else ''}{key}: expected this entry in {self.what}, "
                "found none; is it another file, or cut?"
            )
        return self.get(key)

    def get(self, key: str, usual: Any = None) -> Entry:
        """Return an entry of an object, with a value for a missing one."""
        dot = f"{self.place}." if self.place else ""
        return Entry(self.object().get(key, usual), self.where, f"{dot}{one_line(key, 60)}", self.what)

    def items(self, most: int = 10**7) -> list[Entry]:
        """Return the entries of a list."""
        if not isinstance(self.value, list) or len(self.value) > most:
            raise self.wrong("a list [...]" if most == 10**7 else f"a list of at most {most} entries")
        return [Entry(v, self.where, f"{self.place}[{k}]", self.what) for k, v in enumerate(self.value)]

    def text(self, *, most: int = 10**6) -> str:
        """Return a text."""
        if not isinstance(self.value, str) or len(self.value) > most:
            raise self.wrong(f"a text of at most {most} letters")
        return self.value

    def flag(self) -> bool:
        """Return true or false."""
        if not isinstance(self.value, bool):
            raise self.wrong("true or false")
        return self.value

    def whole(self, low: int = -(10**15), high: int = 10**15) -> int:
        """Return a whole number within bounds."""
        if type(self.value) is not int or not low <= self.value <= high:
            raise self.wrong(f"a whole number from {low} to {high}")
        return self.value

    def number(self, low: float = -math.inf, high: float = math.inf, unit: str = "") -> float:
        """Return a finite number within bounds."""
        good = isinstance(self.value, (int, float)) and not isinstance(self.value, bool) and math.isfinite(self.value)
        if not good or not low <= self.value <= high:
            limits = "" if low == -math.inf and high == math.inf else f" from {low:g} to {high:g}"
            raise self.wrong(f"a finite number{limits}{' ' + unit if unit else ''}")
        return float(self.value)

    def numbers(self, *shape: int | None, most: float = 1e12) -> list[Any]:
        """Return nested lists of finite numbers of a shape; None for any length of at least 1."""
        count = f"{'x'.join('n' if n is None else str(n) for n in shape)} numbers up to {most:g} in size"
        if not _is_array(self.value, shape, most):
            raise self.wrong(f"lists of {count}", "other values or lengths")
        return self.value


def _is_array(value: Any, shape: tuple[int | None, ...], most: float) -> bool:
    if not shape:
        return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= most
    if not isinstance(value, list) or not value or (shape[0] is not None and len(value) != shape[0]):
        return False
    inner = shape[1:]
    if inner and inner[0] is None and isinstance(value[0], list):
        inner = (len(value[0]), *inner[1:])  # rows of one length
    return all(_is_array(v, inner, most) for v in value)


def _said(value: Any) -> str:
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, (dict, list)):
        kind = "an object" if isinstance(value, dict) else "a list"
        return f"{kind} of {len(value)} entries" if value else f"an empty {kind.split()[1]}"
    return one_line(f"{value!r}", 60)
