"""Reading an expression, and interpreting it on a batch of scenes."""

from __future__ import annotations

import ast
import itertools
import math
import re
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from torchdlo.errors import InputError
from torchdlo.reward_language.functions import FUNCTIONS, bounded, check_size, divide, kind, power, together

__all__ = ["Expression", "parse"]

LETTERS, NODES, DEPTH, CONSTANT = 4000, 300, 30, 1e6
"""Most letters, nodes, nodes within each other, and the greatest magnitude of a constant."""
POWERS = (2, 3, 4, 0.5)
_WORDS = re.compile(r"\w+|[^\w\s]")

_KINDS = {"N": "a number", "P": "a point or a rope", "C": "a condition", "A": "a value"}
_BINARY: dict[type[ast.operator], str] = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.Pow: "**"}
_COMPARE: dict[type[ast.cmpop], tuple[str, Callable[[Tensor, Tensor], Tensor]]] = {
    ast.Lt: ("<", torch.lt),
    ast.LtE: ("<=", torch.le),
    ast.Gt: (">", torch.gt),
    ast.GtE: (">=", torch.ge),
}
_FIELDS: dict[type[ast.AST], tuple[str, ...]] = {
    ast.BinOp: ("left", "right"),
    ast.UnaryOp: ("operand",),
    ast.BoolOp: ("values",),
    ast.Compare: ("left", "comparators"),
    ast.Call: ("args",),
    ast.Subscript: ("value",),
    ast.Constant: (),
    ast.Name: (),
}
"""Nodes that are allowed, and which of their fields hold nodes that are looked at in turn."""


def _refuse(label: str, found: str, mend: str) -> InputError:
    return InputError(f"{label}: {found}; {mend}.")


def parse(text: str, label: str = "expression") -> Expression:
    """Return an expression that can be evaluated.

    Args:
        text: the expression.
        label: what it is, for what is said of it.

    Raises:
        InputError: it is none.
    """
    if not isinstance(text, str):
        raise _refuse(label, f"it is {type(text).__name__}", "write a text such as 'exp(-5 * dist(tool_0, ring_0))'")
    if len(text) > LETTERS:
        raise _refuse(label, f"it has {len(text)} letters", f"write {LETTERS} at most")
    text = text.strip()
    if not text or not all(32 <= ord(c) < 127 for c in text):
        raise _refuse(label, "it is empty or has letters that are not printable ASCII", "write plain ASCII in one line")
    # Python's own parser takes long over what is nested hundreds of times; signs and attributes nest as well.
    if _nesting(text) > 2 * DEPTH or len(_WORDS.findall(text)) > 4 * NODES:
        raise _refuse(label, "it is too long or nested too deeply", f"{NODES} parts, {DEPTH} deep, at most")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            body = ast.parse(text, mode="eval").body
    except (SyntaxError, ValueError, MemoryError, RecursionError, OverflowError):
        raise _refuse(label, "it is no expression", "write one expression, such as '2 * z(ring_0) - 0.1'") from None
    names: set[str] = set()
    _check(body, label, names)
    return Expression(text, frozenset(names), label, body)


def _nesting(text: str) -> int:
    depth = most = 0
    for letter in text:
        depth += (letter in "([{") - (letter in ")]}")
        most = max(most, depth)
    return most


def _check(body: ast.expr, label: str, names: set[str]) -> None:
    """Refuse a tree with a node that is not allowed; collect names."""
    count, waiting = 0, [(body, 1)]
    while waiting:
        node, depth = waiting.pop()
        count += 1
        if count > NODES or depth > DEPTH:
            raise _refuse(label, "it is too long or nested too deeply", f"{NODES} parts, {DEPTH} deep, at most")
        allowed = _FIELDS.get(type(node))
        if allowed is None:
            raise _refuse(
                label, f"it has a {type(node).__name__}", "use numbers, names, + - * / **, comparisons, and, or, calls"
            )
        _CHECKS[type(node)](node, label, names)
        for name in allowed:
            inner = getattr(node, name)
            waiting += [(each, depth + 1) for each in (inner if isinstance(inner, list) else [inner])]


def _check_constant(node: ast.Constant, label: str, names: set[str]) -> None:
    value = node.value
    plain = isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= CONSTANT
    if not plain or node.kind is not None:
        raise _refuse(label, f"it has the constant {str(value)[:20]!r}", f"use numbers up to {CONSTANT:g}")


def _check_name(node: ast.Name, label: str, names: set[str]) -> None:
    names.add(node.id)


def _check_binary(node: ast.BinOp, label: str, names: set[str]) -> None:
    if type(node.op) not in _BINARY:
        raise _refuse(label, f"it has the operator {type(node.op).__name__}", "use + - * / and **")
    if isinstance(node.op, ast.Pow) and _number(node.right) not in POWERS:
        raise _refuse(label, "it has a power that is not 2, 3, 4 or 0.5", "use one of these, or exp")


def _check_unary(node: ast.UnaryOp, label: str, names: set[str]) -> None:
    if not isinstance(node.op, ast.USub | ast.UAdd | ast.Not):
        raise _refuse(label, f"it has the operator {type(node.op).__name__}", "use -, + or not")


def _check_compare(node: ast.Compare, label: str, names: set[str]) -> None:
    wrong = [type(op).__name__ for op in node.ops if type(op) not in _COMPARE]
    if wrong:
        raise _refuse(label, f"it compares by {wrong[0]}", "use <, <=, > or >=")


def _check_call(node: ast.Call, label: str, names: set[str]) -> None:
    if not isinstance(node.func, ast.Name) or node.func.id not in FUNCTIONS:
        called = node.func.id if isinstance(node.func, ast.Name) else type(node.func).__name__
        raise _refuse(label, f"it calls {called[:40]}", f"the functions are {', '.join(FUNCTIONS)}")
    function = FUNCTIONS[node.func.id]
    several = node.func.id in _SEVERAL and len(node.args) > 1
    if node.keywords or not (several or len(node.args) == len(function.takes)):
        raise _refuse(
            label, f"{node.func.id} has {len(node.args)} arguments", f"it takes {len(function.takes)}, without names"
        )


def _check_subscript(node: ast.Subscript, label: str, names: set[str]) -> None:
    at = node.slice
    parts = [at.lower, at.upper, at.step] if isinstance(at, ast.Slice) else [at]
    whole = [None if p is None else _number(p) for p in parts]
    fine = all(p is None or (isinstance(v, int) and abs(v) <= CONSTANT) for p, v in zip(parts, whole, strict=True))
    if not fine or (len(whole) == 3 and whole[2] is not None and whole[2] < 1):
        raise _refuse(label, "it has an index that is no whole number", "use constants, as in rope[0] or rope[2:-2]")


def _pass(node: ast.AST, label: str, names: set[str]) -> None:
    pass


_SEVERAL = ("min", "max", "sum", "mean")
"""Functions of one list, or of several numbers."""
_CHECKS: dict[type[ast.AST], Callable] = {
    ast.BinOp: _check_binary,
    ast.UnaryOp: _check_unary,
    ast.BoolOp: _pass,
    ast.Compare: _check_compare,
    ast.Call: _check_call,
    ast.Subscript: _check_subscript,
    ast.Constant: _check_constant,
    ast.Name: _check_name,
}


def _number(node: ast.expr) -> int | float | None:
    """Return the value of a constant with its sign, None if it is none."""
    sign = 1
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        sign, node = -1, node.operand
    value = node.value if isinstance(node, ast.Constant) else None
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return None
    return sign * value


@dataclass(frozen=True)
class Expression:
    """An expression whose every part is allowed. `parse` makes it."""

    text: str
    names: frozenset[str]
    """Names that the scene has to have."""
    label: str = field(compare=False)
    _body: ast.expr = field(repr=False, compare=False)

    def evaluate(self, scene: Mapping[str, Tensor]) -> Tensor:
        """Return the value in each scene of a batch, with gradients, shape (B,); bool if it is a condition.

        Args:
            scene: names with their values, shapes (B,), (B, 3) or (B, N, 3).
        """
        missing = sorted(self.names - scene.keys())
        if missing:
            raise _refuse(self.label, f"there is no {missing[0][:40]}", f"this scene has {', '.join(sorted(scene))}")
        values = {name: _lifted(scene[name]) for name in self.names}
        like = next(iter(scene.values()))
        found = _Run(self.label, values, like).value(self._body)
        if found.shape[-2:] != (1, 1):
            raise _refuse(self.label, f"it gives {kind(found)}", "make one number of it by mean, sum, min, max or norm")
        return found.expand(len(like), 1, 1).reshape(-1)


def _lifted(x: Tensor) -> Tensor:
    """Return a value of a scene in the shape (B, N, C)."""
    if x.dim() == 1:
        return x[:, None, None]
    return x.unsqueeze(-2) if x.dim() == 2 else x


@dataclass(frozen=True, eq=False)
class _Run:
    """One evaluation."""

    label: str
    values: dict[str, Tensor]
    like: Tensor

    def value(self, node: ast.expr) -> Tensor:
        """Return the value of a part, shape (B or 1, N, C)."""
        match node:
            case ast.Constant():
                return self.like.new_tensor(float(node.value)).reshape(1, 1, 1)  # type: ignore[arg-type]
            case ast.Name():
                return self.values[node.id]
            case ast.BinOp():
                return bounded(self._binary(node))
            case ast.UnaryOp():
                return self._unary(node)
            case ast.BoolOp():
                return self._logic(node)
            case ast.Compare():
                return self._compare(node)
            case ast.Call():
                return bounded(self._call(node))
            case ast.Subscript():
                return self._part(node)
        raise AssertionError(f"{type(node).__name__} was not refused")

    def _where(self, what: str) -> str:
        return f"{self.label}: {what}"

    def _numeric(self, x: Tensor) -> Tensor:
        return x.to(self.like.dtype) if x.dtype == torch.bool else x

    def _binary(self, node: ast.BinOp) -> Tensor:
        a = self._numeric(self.value(node.left))
        if isinstance(node.op, ast.Pow):
            return power(a, float(_number(node.right) or 0))
        b, sign = self._numeric(self.value(node.right)), _BINARY[type(node.op)]
        where = self._where(sign)
        together(a, b, where, scale=sign in "*/")
        if (sign == "*" and a.shape[-1] == b.shape[-1] == 3) or (sign == "/" and b.shape[-1] == 3):
            raise InputError(f"{where} is given {kind(a)} and {kind(b)}; use dot or norm for points.")
        if sign == "/":
            return divide(a, b)
        return a + b if sign == "+" else a - b if sign == "-" else a * b

    def _unary(self, node: ast.UnaryOp) -> Tensor:
        x = self.value(node.operand)
        if isinstance(node.op, ast.Not):
            return ~self._condition(x, "not")
        return -self._numeric(x) if isinstance(node.op, ast.USub) else self._numeric(x)

    def _condition(self, x: Tensor, what: str) -> Tensor:
        if x.dtype != torch.bool:
            raise InputError(f"{self._where(what)} is given {kind(x)}; give it a comparison, such as z(ring_0) > 0.1.")
        return x

    def _logic(self, node: ast.BoolOp) -> Tensor:
        what = "and" if isinstance(node.op, ast.And) else "or"
        first, *rest = (self._condition(self.value(each), what) for each in node.values)
        for each in rest:
            together(first, each, self._where(what))
            first = first & each if what == "and" else first | each
        return first

    def _compare(self, node: ast.Compare) -> Tensor:
        values = [self._numeric(self.value(each)) for each in (node.left, *node.comparators)]
        found: Tensor | None = None
        for a, b, op in zip(values, values[1:], node.ops, strict=False):
            sign, compare = _COMPARE[type(op)]
            together(a, b, self._where(sign))
            if a.shape[-1] == 3:
                raise InputError(f"{self._where(sign)} is given points; compare numbers, such as their heights.")
            holds = compare(a, b)
            if found is not None:
                together(found, holds, self._where(sign))
            found = holds if found is None else found & holds
        assert found is not None
        return found

    def _call(self, node: ast.Call) -> Tensor:
        name = node.func.id  # type: ignore[attr-defined]
        function, where = FUNCTIONS[name], self._where(name)
        given = [self.value(each) for each in node.args]
        if name in _SEVERAL and len(given) > 1:
            given = [self._numeric(x) for x in given]
            if any(x.shape[-2:] != given[0].shape[-2:] or x.shape[-2] != 1 for x in given):
                raise InputError(f"{where} is given {', '.join(map(kind, given))}; give it one list, or single values.")
            given = [torch.cat([x.expand(max(map(len, given)), -1, -1) for x in given], -2)]
        kinds = function.takes
        given = [self._argument(x, k, where) for x, k in zip(given, kinds, strict=True)]
        if name not in ("nearest", "closest", "chamfer"):
            for a, b in itertools.combinations(given, 2):
                together(a, b, where, scale=name == "where")
        if name == "where":
            together(given[1], given[2], where)
        found = function.call(*given)
        check_size(found.shape, where)
        return found

    def _argument(self, x: Tensor, wanted: str, where: str) -> Tensor:
        """Return an argument if it is of the kind that is wanted."""
        if wanted == "C":
            return self._condition(x, where.removeprefix(f"{self.label}: "))
        x = self._numeric(x)
        if wanted != "A" and x.shape[-1] != (3 if wanted == "P" else 1):
            raise InputError(f"{where} is given {kind(x)}; it takes {_KINDS[wanted]}.")
        return x

    def _part(self, node: ast.Subscript) -> Tensor:
        x, at = self.value(node.value), node.slice
        count = x.shape[-2]
        if isinstance(at, ast.Slice):
            bounds = [None if p is None else int(_number(p) or 0) for p in (at.lower, at.upper, at.step)]
            found = x[..., slice(*bounds), :]
            if not found.shape[-2]:
                raise InputError(f"{self._where('a slice')} has nothing in it; the list has {count} entries.")
            return found
        k = int(_number(at) or 0)
        if not -count <= k < count:
            raise InputError(f"{self._where(f'[{k}]')} is out of {kind(x)}; use an index from {-count} to {count - 1}.")
        k %= count
        return x[..., k : k + 1, :]
