"""What is claimed of the benchmark comes from stored rows; answers are sealed; recordings that hide nothing differ."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import binom

FOLDER = Path(__file__).parents[1] / "experiments" / "hidden_effects"
sys.path[:0] = [str(FOLDER), str(FOLDER.parent)]

import cases  # noqa: E402
import claims  # noqa: E402
import make  # noqa: E402
import seal  # noqa: E402


def row(kind: str, **fields: object) -> dict:
    """A row that is right."""
    named = [] if kind == "null" else ["air_drag"]
    base = {"recording": "r0", "case": f"{kind}-air_drag-10-1", "kind": kind, "truth": named, "ratio": 10.0}
    return base | {"verdict": "effects", "named": named, "sets": [named], "right": True, "in_set": True} | fields


def test_bounds_are_those_of_clopper_and_pearson() -> None:
    assert claims.bound(0, 60, upper=True) == pytest.approx(1 - 0.05 ** (1 / 60))
    high, low = claims.bound(3, 20, upper=True), claims.bound(17, 20, upper=False)
    assert binom.cdf(3, 20, high) == pytest.approx(0.05) and binom.sf(16, 20, low) == pytest.approx(0.05)
    assert claims.bound(4, 4, upper=True) == 1.0 and claims.bound(0, 4, upper=False) == 0.0


def test_tables_count_stored_rows() -> None:
    rows = [
        row("single"),
        row("single", right=False, named=[], sets=[], in_set=False),
        row("null", case="null-3-links"),
    ]
    rows += [row("null", case="null-grid-4", named=["wind"], right=False)]
    stored = [claims.Stored("a run", "as it was.", rows, {"ranges that hold the truth": "1 of 2"})]
    table = claims.rates(stored)
    assert "| hidden effect named first, gap about 10 times the noise | 1 of 2 (≥ 3%) | 90 % |" in table
    assert "| nothing hidden, an effect named | 1 of 2 (≤ 97%) | 1 of 60 |" in table
    assert "| ranges that hold the truth | 1 of 2 | 85 to 95 % |" in table and "*a run*: as it was." in table
    assert "| `air_drag` |  |  | 1 of 2 |  |" in claims.power(stored)
    assert "| grid, exact rod | 0 of 1 | 1 |" in claims.nothing(stored)
    assert "| plain, links in MuJoCo | 1 of 1 | 0 |" in claims.nothing(stored)
    assert "1 of 2 single effects" in claims.sentence(stored)


def test_pages_are_filled_between_their_marks_only() -> None:
    stored = [claims.Stored("a run", "", [row("single"), row("null")], {})]
    page = "- a\n  <!-- claims: sentence -->\n  old\n  <!-- end of claims: sentence -->\n- b\n"
    new = claims.filled(page, stored)
    assert "old" not in new and new.startswith("- a\n  <!-- claims: sentence -->\n  Of 2 blinded") and "\n- b\n" in new
    assert claims.filled(new, stored) == new
    with pytest.raises(SystemExit, match="the mark <!-- end of claims: power --> is missing"):
        claims.filled("<!-- claims: power -->", stored)


def test_readme_and_docs_say_what_is_stored() -> None:
    stored = claims.load(FOLDER / "stored")
    for path in claims.PAGES:
        assert claims.filled(path.read_text(), stored) == path.read_text(), f"run claims.py: {path}"


def test_an_answer_that_was_changed_after_it_was_sealed_is_refused(tmp_path: Path) -> None:
    answers, out = tmp_path / "answers", tmp_path / "out"
    answers.mkdir()
    for name in ("ra", "rb"):
        (answers / f"{name}.json").write_text(json.dumps({"answer": [name]}))
    (out / "rb").mkdir(parents=True)
    (out / "rb" / "findings.json").write_text("{}")
    first = seal.seal(answers, out, ["ra", "rb"])
    # What was diagnosed before cannot be sealed any more.
    assert seal.kept(answers, out, "ra") and not seal.kept(answers, out, "rb")
    assert seal.seal(answers, out, ["ra", "rb"]) == first
    (answers / "ra.json").write_text(json.dumps({"answer": []}))
    with pytest.raises(SystemExit, match="changed after it had been sealed"):
        seal.kept(answers, out, "ra")


def test_recordings_that_hide_nothing_differ_in_at_least_five_ways() -> None:
    nulls = cases.subset("mismatch")
    assert len(nulls) >= 60 and len({c.name for c in nulls}) == len(nulls)
    assert len({c.variant for c in nulls}) >= 6 and {c.simulator for c in nulls} == {"", "links"}
    assert not any(c.effects for c in nulls)


def test_gaps_come_in_stretches_and_are_as_many_as_said() -> None:
    lost = make.gaps(np.random.default_rng(0), (400, 30))
    assert lost.mean() == pytest.approx(make.LOST, rel=0.1) and not lost[0].any()
    begun = np.diff(lost.astype(int), axis=0) == 1
    assert lost.sum() / begun.sum() > 0.9 * make.TOGETHER


def test_hinges_of_a_chain_lose_energy_alike_or_each_by_itself() -> None:
    links = pytest.importorskip("links", exc_type=ImportError)
    assert links.losses("", 3, 9) == 0.0 and links.losses("implicit", 3, 9) == links.LOSS
    own = links.losses("joints", 3, 900)
    assert own.mean() == pytest.approx(links.LOSS, rel=0.1) and own.std() > 0.5 * links.LOSS
