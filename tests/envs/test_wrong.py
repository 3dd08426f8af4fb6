"""What is refused: words say what was given, what was expected and how to mend it."""

from __future__ import annotations

from typing import Any

import pytest

from torchdlo.envs.task import Arms
from torchdlo.errors import InputError

ONE = ((0.0, -0.5, 0.0),)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (
            {"base": (0, -0.5, 0), "vertex": (0,)},
            r"base is \(0, -0.5, 0\); expected a place \(x, y, z\) \[m\] for each arm",
        ),
        ({"base": ((0, -0.5),), "vertex": (0,)}, r"base is \(\(0, -0.5\),\)"),
        ({"base": (), "vertex": ()}, r"base is \(\)"),
        ({"base": ONE, "vertex": 4}, r"vertex is 4; expected a tuple of 1 whole numbers"),
        ({"base": ONE, "vertex": (0, 3)}, r"vertex is \(0, 3\); expected a tuple of 1"),
        ({"base": ONE, "vertex": (0.5,)}, r"vertex is \(0.5,\)"),
        ({"base": ONE, "vertex": (0,), "quat": (0.0, 1.0, 0.0, 0.0)}, r"quat is \(0.0, 1.0, 0.0, 0.0\); expected an"),
        ({"base": ONE, "vertex": (0,), "quat": ((0.0, 1.0, 0.0, 0.0),) * 2}, r"for each of 1 arms"),
    ],
)
def test_arms_that_are_not_one_entry_each_are_refused(given: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        Arms(**given)
    assert Arms(base=[[0, -0.5, 0]], vertex=(0,)).count == 1
