"""Polishing: ways are gone faster, never further than tools go, and what comes out is no worse."""

from __future__ import annotations

import dataclasses

import torch

from torchdlo.agents.trajopt.polish import hurried, polish, variants
from torchdlo.envs import find


def test_a_hurried_way_leads_to_the_same_place_in_less_time():
    way = torch.full((10, 1, 3), 0.002)
    fast = hurried(way, 0.5)
    torch.testing.assert_close(fast.sum(0), way.sum(0))
    torch.testing.assert_close(fast[:5], torch.full((5, 1, 3), 0.004))
    assert not fast[5:].any()


def test_variants_begin_as_the_way_does_and_have_its_length():
    way = torch.randn(40, 2, 3, generator=torch.Generator().manual_seed(0)) * 0.002
    found = variants(way, 30, 0.01, torch.Generator().manual_seed(1))
    assert found.shape == (30, 40, 2, 3) and torch.equal(found[0], way)
    assert torch.isfinite(found).all() and len({x.sum().item() for x in found}) > 25
    # Some go straight up at full speed to the end, all tools alike.
    up = torch.tensor([0.0, 0.0, 0.01])
    assert sum(bool((x[-1] == up).all()) for x in found) >= 3


def test_what_comes_out_is_no_worse_than_what_went_in():
    task = dataclasses.replace(find("lifting"), horizon=4, frame_skip=2)
    actions = torch.zeros(2, 4, 12)
    actions[1, :, 2] = 0.002
    nothing = polish(task, actions, rounds=1, count=1)
    found = polish(task, actions, rounds=2, count=6)
    assert found.episodes == 24 and found.actions.shape == actions.shape
    assert (found.returns >= nothing.returns - 1e-4).all()
