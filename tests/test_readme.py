"""What the README shows works."""

from __future__ import annotations

import re
from pathlib import Path

import torch

ROOT = Path(__file__).parents[1]


def test_examples_of_the_readme_run() -> None:
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    code = "\n".join(blocks).replace("scene.stepper(cable)", "scene.stepper(cable, execution='eager')")
    code = code.replace("torch.zeros(100, 60, 3)", "torch.zeros(4, 60, 3)").replace("expand(200,", "expand(20,")
    found: dict = {}
    exec(compile(code, "README.md", "exec"), found)
    assert found["state"].rods.pos.shape == (4, 60, 3) and torch.isfinite(found["bend"].grad).all()


def test_links_of_the_readme_lead_somewhere() -> None:
    for target in re.findall(r"\]\(([^)#]+)\)", (ROOT / "README.md").read_text()):
        assert target.startswith("http") or (ROOT / target).exists(), target
