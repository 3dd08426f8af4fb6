"""Public names and JSON keys are words of the field, and each class has a name of its own."""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "torchdlo"
FILES = sorted(PACKAGE.rglob("*.py"))

OLD = set(
    """
    matter rod_matter body_matter held_vertices held_edges rehearsal rehearsed searched highest solved_after newton
    settling slopes graded agility foresee survey shortfall astray finer trust health idle vary said
    describe RodMatter BodyMatter Solid Blob Medium Law Hold Key Seen World Outcome Cable Bench Probe Floor Contest
    Gesture Rig Fault Saved Rehearsal react reacts settles alter crash holds without_slope fault faults
    """.split()
)
"""What names of version 0.1 were called that have a word of the field today."""
OLD_FILES = {
    "scene_files/older.py",
    "agents/trajopt/search_result.py",
    "sysid/model/model_file.py",
    "scene_files/run.py",
}
"""Where files of version 0.1 are read, so that their keys are named."""


def named(file: Path) -> Iterator[tuple[str, int]]:
    """Public functions, classes, fields, methods, and keys of dictionaries that are written out, with their lines."""
    tree = ast.parse(file.read_text())
    yield file.stem, 1
    for node in tree.body:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)) and node.name[0] != "_":
            yield node.name, node.lineno
            for member in node.body if isinstance(node, ast.ClassDef) else []:
                if isinstance(member, ast.FunctionDef):
                    yield member.name, member.lineno
                elif isinstance(member, ast.AnnAssign) and isinstance(member.target, ast.Name):
                    yield member.target.id, member.lineno
    if str(file.relative_to(PACKAGE)) in OLD_FILES:
        return
    for node in ast.walk(tree):
        for key in node.keys if isinstance(node, ast.Dict) else []:
            if isinstance(key, ast.Constant) and isinstance(key.value, str):
                yield key.value, key.lineno


def public(kind: type) -> Iterator[tuple[str, Path]]:
    """Names of the public functions or classes of all modules."""
    for file in FILES:
        for node in ast.parse(file.read_text()).body:
            if isinstance(node, kind) and node.name[0] != "_":
                yield node.name, file


def test_public_names_and_keys_are_words_of_the_field() -> None:
    wrong = [f"{file.relative_to(ROOT)}:{line}: {name}" for file in FILES for name, line in named(file) if name in OLD]
    assert not wrong, "\n".join(wrong)


def test_options_of_the_command_line_are_words_of_the_field() -> None:
    gone = r"--(idle|vary|double|without|names|every|rope)(?![\w-])"
    for file in [*(PACKAGE / "cli").glob("*.py"), *(ROOT / "docs").glob("*.md"), ROOT / "README.md"]:
        found = re.findall(rf"torchdlo [a-z].*{gone}", file.read_text())
        assert not found, f"{file.relative_to(ROOT)}: {found}"


def test_no_two_public_classes_have_one_name() -> None:
    where = defaultdict(list)
    for name, file in public(ast.ClassDef):
        where[name].append(str(file.relative_to(ROOT)))
    twice = {name: files for name, files in where.items() if len(files) > 1}
    assert not twice, twice


def test_no_two_modules_have_one_name() -> None:
    names = [file.stem for file in FILES if not file.stem.startswith("__")]
    twice = sorted({name for name in names if names.count(name) > 1})
    assert not twice, twice


def test_most_public_functions_have_more_than_one_word() -> None:
    names = [name for name, _ in public(ast.FunctionDef)]
    share = sum("_" not in name for name in names) / len(names)
    assert share <= 0.45, f"{share:.1%} of public functions are one word"


def test_the_glossary_names_what_is_there() -> None:
    text = (ROOT / "docs" / "glossary.md").read_text()
    for name in re.findall(r"`((?:physics|coupling|sysid|envs|agents|scene_files)/[\w/]+(?:\.py)?)`", text):
        assert (PACKAGE / name).exists(), name
