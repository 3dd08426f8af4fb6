"""Names of numbers are read in one place, and written as they were."""

from __future__ import annotations

import pytest

from torchdlo.physics.effects.parameter_name import ParameterName, values_of


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("damping_rate", ("", "damping_rate", None)),
        ("air_drag.c_d", ("air_drag", "c_d", None)),
        ("wind.velocity.2", ("wind", "velocity", 2)),
        ("wind.velocity.x", ("wind", "velocity.x", None)),
        ("wind.2", ("wind", "2", None)),
    ],
)
def test_a_name_is_its_parts(text: str, parts: tuple[str, str, int | None]) -> None:
    name = ParameterName(*parts)
    assert ParameterName.parse(text) == name and str(name) == text
    assert name.key == text.removeprefix(f"{name.effect}.") and name.whole.component is None


def test_values_of_one_effect_keep_their_order() -> None:
    values = {"damping_rate": 1, "wind.velocity.0": 2, "air_drag.c_d": 3, "wind.c_d": 4, "windy.c_d": 5}
    assert list(values_of("wind", values).items()) == [("velocity.0", 2), ("c_d", 4)]
    assert values_of("", values) == {"damping_rate": 1} and values_of("stretch", values) == {}
