"""What the package offers by name, and what importing it costs."""

from __future__ import annotations

import ast
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

import torchdlo

pytestmark = pytest.mark.quick

PACKAGE = Path(torchdlo.__file__).parent
PACKAGES = sorted({file.parent for file in PACKAGE.rglob("*.py")})


def named(folder: Path) -> str:
    return ".".join(("torchdlo", *folder.relative_to(PACKAGE).parts))


def python(code: str) -> str:
    return subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout


def test_importing_the_package_imports_nothing_else():
    code = """
import sys, time, torch
before, begun = set(sys.modules), time.process_time()
import torchdlo
print(time.process_time() - begun)
print(*sorted(name for name in set(sys.modules) - before if name.partition(".")[0] not in sys.stdlib_module_names))
"""
    seconds, found = python(code).split("\n", 1)
    assert float(seconds) < 0.1
    assert set(found.split()) <= {"torchdlo", "torchdlo.lazy"}


def test_scenes_that_are_not_compiled_do_not_import_the_compiler():
    code = """
import sys, torch
before = set(sys.modules)
from torchdlo import Rope, stationary_control, make_scene, step
from torchdlo.coupling import BodyContact, RodBody, RodContact, RodMpmCoupling
from torchdlo.physics.effects import Bend, Gravity
x = torch.zeros(8, 3)
x[:, 0] = torch.linspace(0, 0.3, 8)
scene, params, state = make_scene([Rope(x, radius=0.005, density=1000.0, bend=1e-4)], [Gravity(), Bend(), RodContact()])
step(scene, params, state, stationary_control(scene, state))
print(*sorted({name.partition(".")[0] for name in set(sys.modules) - before} - set(sys.stdlib_module_names)))
print(*[name for name in ("torch._dynamo", "torch._inductor") if name in sys.modules])
"""
    tops, compiler = python(code).split("\n", 1)
    assert set(tops.split()) <= {"torchdlo", "torch", "sympy", "mpmath"}  # torch itself takes the last two
    assert not compiler.split()


@pytest.mark.parametrize("folder", PACKAGES, ids=named)
def test_packages_say_their_public_names(folder: Path):
    assert (folder / "__init__.py").is_file(), f"{folder}: no __init__.py, so that no wheel has it"
    package = importlib.import_module(named(folder))
    if not hasattr(package, "__all__"):  # inner packages hold modules, whose names are theirs
        assert named(folder).count(".") > 1 and package.__doc__
        return
    assert package.__all__ and len(set(package.__all__)) == len(package.__all__)
    for name in package.__all__:
        assert getattr(package, name) is not None
        assert name in dir(package)


@pytest.mark.parametrize("folder", PACKAGES, ids=named)
def test_type_checkers_see_the_names_that_are_lazy(folder: Path):
    tree = ast.parse((folder / "__init__.py").read_text())
    if not any(isinstance(node, ast.Call) and ast.unparse(node.func) == "lazy.attach" for node in ast.walk(tree)):
        return
    (block,) = (node for node in tree.body if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING")
    seen = {alias.asname or alias.name: node.module for node in block.body for alias in node.names}
    package = importlib.import_module(named(folder))
    assert set(seen) == set(package.__all__)
    for node in block.body:
        for alias in node.names:
            own = getattr(package, alias.asname or alias.name)
            module = importlib.import_module(node.module)
            assert own is getattr(module, alias.name)


def test_a_name_that_is_not_there_is_an_attribute_error():
    with pytest.raises(AttributeError, match="module 'torchdlo' has no attribute 'knot'"):
        torchdlo.knot  # noqa: B018
