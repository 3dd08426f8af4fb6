"""Packages import downwards only, and only the libraries of their floor."""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

pytestmark = pytest.mark.quick

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "torchdlo"

FLOORS = {
    "errors": 0,
    "field_docs": 0,
    "lazy": 0,
    "notices": 0,
    "work_budget": 0.5,
    "cache": 1,
    "untrusted": 0.8,
    "files": 1,
    "local_server": 1,
    "journal": 1.5,
    "physics": 2,
    "coupling": 3,
    "scene": 4,
    "measures": 4.2,
    "vision": 4.5,
    "reward_language": 4,
    "scene_files": 6,
    "envs": 5,
    "sysid": 5,
    "agents": 6,
    "report": 8,
    "cli": 10,
    "__main__": 11,
}
"""Parts of the package by height; an import goes down, so siblings do not import each other."""

TORCH = {"torch"}
ARRAYS = TORCH | {"numpy", "scipy"}
LEARNING = TORCH | {"tensordict", "torchrl"}
ALLOWED = {
    "errors": set(),
    "field_docs": set(),
    "lazy": set(),
    "notices": set(),
    "work_budget": set(),
    "cache": set(),
    "untrusted": {"numpy", "torch"},
    "files": set(),
    "local_server": set(),
    "journal": set(),
    "physics": TORCH | {"triton"},  # comes with the CUDA builds of torch
    "coupling": TORCH | {"pytorch_kinematics", "trimesh"},
    "scene": TORCH,
    "measures": TORCH,
    "vision": ARRAYS | {"kornia", "cv2", "av", "matplotlib"},
    "reward_language": TORCH,
    "scene_files": ARRAYS,
    "sysid": ARRAYS,
    "envs": LEARNING | {"numpy", "gymnasium", "pytorch_kinematics", "trimesh"},
    "agents": LEARNING
    | {
        "cma",
        "numpy",
        "scipy",
        "openai",
        "httpx",
        "httpx2",
        "onnx",
        "pydantic",
        "pyarrow",
        "av",
        "ray",
        "safetensors",
        "tokenizers",
    },
    "report": ARRAYS
    | {"matplotlib", "pyvista", "vtk", "av", "viser", "mitsuba", "pyoidn", "PIL"}
    | {"websockets", "msgspec"},  # come with viser
    "cli": LEARNING | ARRAYS | {"rich", "typer", "av", "cv2", "packaging"},
    "__main__": set(),
    "": TORCH,  # torchdlo/__init__.py
}
"""Libraries that each part may import besides the standard library."""

FILES = sorted(PACKAGE.rglob("*.py"))


def part_of(file: Path) -> str:
    """The part of the package that a file belongs to; "" for torchdlo/__init__.py."""
    first = file.relative_to(PACKAGE).parts[0]
    return "" if first == "__init__.py" else first.removesuffix(".py")


def imports(file: Path) -> Iterator[tuple[int, str]]:
    """Line and absolute name of everything that a file imports, also inside functions."""
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield node.lineno, alias.name
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}:{node.lineno}: relative import; write it out"
            for alias in node.names:
                yield node.lineno, f"{node.module}.{alias.name}"


@pytest.mark.parametrize("file", FILES, ids=lambda f: str(f.relative_to(ROOT)))
def test_imports_go_down(file: Path) -> None:
    own = part_of(file)
    assert own in ALLOWED, f"{own}: give this part a floor and libraries in tests/test_layers.py"
    for line, name in imports(file):
        top, *rest = name.split(".")
        where = f"{file.relative_to(ROOT)}:{line}: {name}"
        if top != "torchdlo":
            allowed = top in sys.stdlib_module_names or top in ALLOWED[own]
            assert allowed, f"{where}: not a library of this floor"
            continue
        other = rest[0] if rest else ""
        if own == "" or other == own or other not in FLOORS:
            continue
        assert FLOORS[other] < FLOORS[own], f"{where}: imports must go down"


def module_of(file: Path) -> str:
    """Dotted name of a file's module."""
    parts = file.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def test_no_module_imports_itself_in_a_circle() -> None:
    modules = {module_of(file): file for file in FILES}
    graph: dict[str, set[str]] = {}
    for module, file in modules.items():
        targets = set()
        for node in ast.parse(file.read_text()).body:  # what runs when the module is imported
            if isinstance(node, ast.Import):
                targets |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                full = {f"{node.module}.{alias.name}" for alias in node.names}
                targets |= {name if name in modules else str(node.module) for name in full}
        graph[module] = (targets & set(modules)) - {module}
    while True:
        leaves = {module for module, targets in graph.items() if not targets}
        if not leaves:
            break
        graph = {m: targets - leaves for m, targets in graph.items() if m not in leaves}
    assert not graph, f"circular imports among {sorted(graph)}"
