"""How steps run is one word."""

from __future__ import annotations

import pytest

from torchdlo import envs
from torchdlo.agents.trajopt.search_result import execution_of
from torchdlo.errors import InputError
from torchdlo.untrusted import Entry


@pytest.mark.parametrize(
    ("choices", "wanted"),
    [
        ({"execution": "eager"}, "eager"),
        ({"compiled": True}, "compiled"),
        ({"compiled": False, "recorded": True}, "recorded"),
        ({"compiled": False}, "eager"),
    ],
)
def test_trajectory_files_say_how_their_steps_ran_also_older_ones(choices: dict, wanted: str) -> None:
    assert execution_of(Entry(choices, "trajectory.json")) == wanted


def test_another_word_is_refused() -> None:
    with pytest.raises(InputError, match="found 'fast'"):
        execution_of(Entry({"execution": "fast"}, "trajectory.json", "choices"))
    with pytest.raises(InputError, match="execution: it is 'fast'; expected one of compiled, recorded, eager"):
        envs.make("coiling", execution="fast")
