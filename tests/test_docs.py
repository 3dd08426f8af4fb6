"""Every tensor field says what it is, in which unit and of which shape; public names have docs."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "torchdlo"
FILES = sorted(PACKAGE.rglob("*.py"))
CORE = [file for file in FILES if file.relative_to(PACKAGE).parts[0] in ("physics", "coupling")]
CORE += [file for file in FILES if file == PACKAGE / "scene.py"]

ARRAYS = re.compile(r"(torch\.)?Tensor( \| None)?|np\.ndarray( \| None)?")


def decorated(node: ast.ClassDef) -> bool:
    """Whether a class is a dataclass or one of our structs."""
    names = {
        name.id if isinstance(name, ast.Name) else getattr(name, "attr", "")
        for decorator in node.decorator_list
        for name in [decorator.func if isinstance(decorator, ast.Call) else decorator]
    }
    return bool(names & {"dataclass", "struct"})


def array_fields(file: Path) -> Iterator[tuple[str, str]]:
    """Name and docstring ("" if absent) of the tensor and array fields of a file's dataclasses."""
    for node in ast.walk(ast.parse(file.read_text())):
        if not isinstance(node, ast.ClassDef) or not decorated(node):
            continue
        for field, after in zip(node.body, [*node.body[1:], None], strict=True):
            if not isinstance(field, ast.AnnAssign):
                continue
            if not ARRAYS.fullmatch(ast.unparse(field.annotation)):
                continue
            doc = ""
            if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
                doc = str(after.value.value)
            yield f"{file.relative_to(ROOT)}:{field.lineno}: {ast.unparse(field.target)}", doc


@pytest.mark.parametrize("file", CORE, ids=lambda f: str(f.relative_to(ROOT)))
def test_tensor_fields_say_unit_and_shape(file: Path) -> None:
    for where, doc in array_fields(file):
        assert doc, f"{where}: no docstring below the field"
        assert re.search(r"\[[^\]]+\]", doc), f"{where}: no unit in [] ([-] if it has none)"
        assert "shape (" in doc, f"{where}: no shape"


def test_the_check_finds_fields() -> None:
    assert sum(1 for file in CORE for _ in array_fields(file)) > 5


def test_recordings_say_shape() -> None:
    found = list(array_fields(PACKAGE / "sysid" / "recordings" / "recording.py"))
    assert len(found) > 5
    for where, doc in found:
        assert "shape (" in doc, where


@pytest.mark.parametrize("file", FILES, ids=lambda f: str(f.relative_to(ROOT)))
def test_public_names_have_docstrings(file: Path) -> None:
    tree = ast.parse(file.read_text())
    assert ast.get_docstring(tree), f"{file.relative_to(ROOT)}: no module docstring"
    for node in tree.body:
        public = isinstance(node, (ast.FunctionDef, ast.ClassDef)) and node.name[0] != "_"
        if public:
            assert ast.get_docstring(node), f"{file.relative_to(ROOT)}:{node.lineno}: {node.name}"


def told(doc: str) -> Iterator[str]:
    """Names in the section "Args" of a docstring."""
    section = re.search(r"^Args:\n((?: +.*\n?|\n)*)", doc, re.MULTILINE)
    for names in re.findall(r"^    (\*{0,2}\w+(?:, \*{0,2}\w+)*):", section[1] if section else "", re.MULTILINE):
        yield from (name.lstrip("*") for name in names.split(", "))


def test_docstrings_tell_of_arguments_that_there_are() -> None:
    seen, wrong = 0, []
    for file in FILES:
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.FunctionDef):
                own = {each.arg for each in ast.walk(node.args) if isinstance(each, ast.arg)}
                names = list(told(ast.get_docstring(node) or ""))
                wrong += [f"{file.relative_to(ROOT)}: {node.name}: {name}" for name in names if name not in own]
                seen += len(names)
    assert seen > 100 and not wrong, wrong


@pytest.mark.parametrize("file", FILES, ids=lambda f: str(f.relative_to(ROOT)))
def test_functions_stay_small(file: Path) -> None:
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            size = (node.end_lineno or node.lineno) - node.lineno + 1
            body = node.body[0]
            # A docstring and the options of a command are not code that one must follow.
            if isinstance(body, ast.Expr) and isinstance(body.value, ast.Constant):
                size -= (body.end_lineno or body.lineno) - body.lineno + 1
            size -= body.lineno - node.lineno
            assert size <= 55, f"{file.relative_to(ROOT)}:{node.lineno}: {node.name} has {size}"


PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


@pytest.mark.parametrize("page", PAGES, ids=lambda f: str(f.relative_to(ROOT)))
def test_pages_import_what_there_is(page: Path) -> None:
    for block in re.findall(r"^```python\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE):
        for node in ast.walk(ast.parse(block)):
            if not isinstance(node, ast.ImportFrom) or not (node.module or "").startswith("torchdlo"):
                continue
            for name in node.names:
                exec(f"from {node.module} import {name.name}", {})


def test_help_shows_what_fields_are() -> None:
    from torchdlo.scene import Control, Rope

    assert "    mass: Mass of the whole rope [kg], spread evenly over its length; or give `density`." in Rope.__doc__
    assert "pos: Positions of the held vertices [m], shape (..., H, 3)." in Control.__doc__
    assert Rope.__doc__.startswith("One rope.")
