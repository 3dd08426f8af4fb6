"""Files are read in one place: elsewhere nothing opens JSON, arrays, tensors or pickles by itself."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

pytestmark = pytest.mark.quick

PACKAGE = Path(__file__).resolve().parents[2] / "torchdlo"
DOOR = PACKAGE / "untrusted"
CALLS = {"json.load", "json.loads", "np.load", "numpy.load", "torch.load", "pickle.load", "pickle.loads", "yaml.load"}
OWN = {
    # What this process or its children wrote just now, or what a hash vouches for.
    "agents/trajopt/search_journal.py",
    "sysid/estimation/result_cache.py",
    "journal.py",
    "local_server.py",
    "report/render/photo.py",
    "report/render/photo_child.py",
    "coupling/bodies/mesh_sdf.py",
    "agents/torch_records.py",
    "agents/distributed/sweep.py",
    "sysid/estimation/checkpoint.py",
    "agents/data/making.py",
    "agents/rl/student.py",
    "agents/rl/training.py",
    "cli/agent.py",
    # Texts of bounded length that are no files.
    "agents/vlm/endpoint.py",
    "report/pages/plan.py",
    "vision/segment_server.py",
}
FILES = sorted(f for f in PACKAGE.rglob("*.py") if DOOR not in f.parents)


@pytest.mark.parametrize("file", FILES, ids=lambda f: str(f.relative_to(PACKAGE)))
def test_readers_of_formats_are_called_in_one_place(file: Path) -> None:
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Call) and ast.unparse(node.func) in CALLS:
            where = f"{file.relative_to(PACKAGE)}:{node.lineno}"
            assert str(file.relative_to(PACKAGE)) in OWN, f"{where}: read it by torchdlo.untrusted"
