"""Effects of this floor declare their numbers as those of the rods do."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from torchdlo.coupling import EFFECTS, RodContact
from torchdlo.coupling.common.step_diagnostics import explain_diagnostics
from torchdlo.physics.effects.base import KINDS, Effect

pytestmark = pytest.mark.quick


@pytest.mark.parametrize("name", EFFECTS)
def test_effect_declares_its_numbers_completely(name):
    cls = EFFECTS[name]
    assert issubclass(cls, Effect) and dataclasses.is_dataclass(cls) and cls.__dataclass_params__.frozen
    assert cls.name == name and cls.kind in KINDS and cls.__doc__
    for number, p in cls.params.items():
        assert p.low <= p.default <= p.high and p.low < p.high, number
        assert p.unit and p.doc.endswith(".") and p.scale in ("log", "linear")
        assert p.off is None or p.low <= p.off <= p.high


def test_effects_are_hashable_and_equal_by_their_choices():
    assert hash(RodContact(room=64)) == hash(RodContact(room=64)) and RodContact() != RodContact(sweeps=2)


def test_what_was_missed_is_explained():
    assert explain_diagnostics(torch.zeros(3, 1, 3)) == ""
    assert "12 pairs" in explain_diagnostics(torch.tensor([[[0.0, 0.0, 0.0]], [[12.0, 0.0, 0.0]]]))
    assert "1.5 mm" in explain_diagnostics(torch.tensor([[[0.0, 1.5e-3, 0.0]]]))
    assert "7% shorter" in explain_diagnostics(torch.tensor([[[0.0, 0.0, 0.07, 0.0]]]))
    assert "9% longer" in explain_diagnostics(torch.tensor([[[0.0, 0.0, 0.0, 0.09, 0.0]]]))


@pytest.mark.parametrize("wrong", [{"sweeps": 0}, {"rounds": 0}, {"room": -1}, {"recovery": 0.0}, {"recovery": 1.5}])
def test_choices_that_make_no_sense_are_refused(wrong):
    with pytest.raises(ValueError, match=f"RodContact: {next(iter(wrong))} is"):
        RodContact(**wrong)
