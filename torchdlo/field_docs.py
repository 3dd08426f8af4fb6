"""What stands below the fields of a dataclass, where `help` and editors look for it: in the docstring of the class."""

from __future__ import annotations

import ast
import functools
import inspect
import sys
import textwrap
from typing import TypeVar

__all__ = ["with_field_docs"]

T = TypeVar("T", bound=type)


def with_field_docs(cls: T) -> T:
    """Append to a class's docstring what its source says of the fields; a class without source stays as it is."""
    cls.__doc__ = _Doc(cls.__doc__ or "")  # type: ignore[assignment]  # types look for descriptors there, too
    return cls


class _Doc:
    """A docstring that is made when somebody reads it: reading the source takes a tenth of a second in all."""

    def __init__(self, own: str) -> None:
        self._own = inspect.cleandoc(own)

    def __get__(self, _: object, cls: type) -> str:
        said = _fields(cls.__module__).get(cls.__qualname__, {})
        lines = [textwrap.indent(f"{name}: {' '.join(doc.split())}", "    ") for name, doc in said.items()]
        return "\n\n".join(filter(None, [self._own, "\n".join(["Fields:", *lines]) if lines else ""]))


@functools.cache
def _fields(module: str) -> dict[str, dict[str, str]]:
    """Return what a module's classes say of their fields, by class and field."""
    try:
        parsed = ast.parse(inspect.getsource(sys.modules[module]))
    except (OSError, TypeError, KeyError):
        return {}
    return {node.name: _of_class(node) for node in parsed.body if isinstance(node, ast.ClassDef)}


def _of_class(node: ast.ClassDef) -> dict[str, str]:
    found = {}
    for field, after in zip(node.body, node.body[1:], strict=False):
        if (
            isinstance(field, ast.AnnAssign)
            and isinstance(field.target, ast.Name)
            and isinstance(after, ast.Expr)
            and isinstance(after.value, ast.Constant)
            and isinstance(after.value.value, str)
        ):
            found[field.target.id] = after.value.value
    return found
