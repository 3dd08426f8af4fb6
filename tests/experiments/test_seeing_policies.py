"""What the documentation says of the policy that sees is what was measured, and its file can be read."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from torchdlo.agents.policies.chunk_policy import load_policy
from torchdlo.agents.rl.evaluate import wilson_interval

ROOT = Path(__file__).parents[2]
STORED = json.loads((ROOT / "experiments/seeing_policies.json").read_text())["policies"]
OWN = next(row for row in STORED.values() if row.get("weights"))


def test_the_table_holds_what_was_measured():
    text = (ROOT / "docs/datasets.md").read_text()
    head, *lines = re.search(r"\| task \| varied \|.*?(?=\n\n)", text, re.DOTALL)[0].splitlines()
    names = [word.strip() for word in head.strip("| ").split("|")][1:-1]
    shares = []
    for line in lines[1:-1]:
        task, *cells = (word.strip() for word in line.strip("| ").split("|"))
        for name, cell in zip(names, cells, strict=False):
            episodes = OWN["tasks"][task][name]["episodes"]
            hits = sum(row["success"] for row in episodes)
            low, high = wilson_interval(hits, len(episodes))
            assert cell == f"{100 * hits / len(episodes):.0f} % ({100 * low:.0f} to {100 * high:.0f})"
            shares += [hits / len(episodes)] * (name == "varied")
    assert len(shares) == 6
    assert f"{100 * sum(shares) / 6:.0f} % of 15 unseen starts" in (ROOT / "README.md").read_text()


def test_the_file_holds_the_policy_of_the_table():
    policy, about = load_policy(ROOT / "experiments" / OWN["weights"])
    assert set(about["tasks"]) == set(OWN["tasks"])
    assert sum(p.numel() for p in policy.parameters()) == about["parameters"] == pytest.approx(7.5e6, rel=0.01)
