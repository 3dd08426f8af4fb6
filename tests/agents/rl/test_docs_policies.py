"""What the page about policies shows works, with a small budget."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

pytest.importorskip("torchrl")
pytest.importorskip("cma")

ROOT = Path(__file__).parents[3]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")
def test_the_tutorial_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "experiments").symlink_to(ROOT / "experiments")
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "policies.md").read_text(), re.DOTALL)
    assert len(blocks) == 2
    code = "\n".join(blocks)
    # A small budget: few episodes, few steps of learning.
    smaller = code.replace("count=128", "count=4, starts=2, rounds=0, final=0, updates=300")
    smaller = smaller.replace("evaluate_policies([policy], task)", "evaluate_policies([policy], task, starts=2)")
    assert smaller.count("=2") >= 2
    exec(compile(smaller, "policies.md", "exec", dont_inherit=True), {"__name__": "page"})
    said = capsys.readouterr().out
    assert "success from unseen starts" in said
    assert "torch.Size([2, 3, 12]) torch.Size([2, 3, 1])" in said


def test_every_algorithm_and_stage_is_on_the_page():
    from torchdlo.agents.rl.hybrid_stages import STAGES
    from torchdlo.agents.rl.settings import ALGORITHMS

    text = (ROOT / "docs" / "policies.md").read_text()
    for name in (*ALGORITHMS, *STAGES):
        assert f"`{name}`" in text
