"""What is recorded as a CUDA graph does what the step does; here functions that run again take the place of graphs."""

from __future__ import annotations

from contextlib import contextmanager

import pytest
import torch

from torchdlo import scene as scenes
from torchdlo.physics import tree
from torchdlo.physics.effects.elastic import Bend
from torchdlo.physics.effects.external import Gravity
from torchdlo.physics.execution import graphs

F64 = torch.float64


def test_copies_are_stored_as_what_they_copy():
    dense = torch.rand(3, 5, 4, dtype=F64)
    for x in (dense, dense.permute(2, 0, 1), dense[:1].expand(7, 5, 4), torch.tensor(2.0).expand(6, 1)):
        found = graphs._copied(x)
        assert found.shape == x.shape and torch.equal(found, x) and found.data_ptr() != x.data_ptr()
        assert all(a == b for a, b, n in zip(found.stride(), x.stride(), x.shape, strict=True) if n > 1)


def test_steps_on_the_cpu_run_as_they_are():
    known = graphs.Graphs()
    for k in range(5):
        x = torch.full((2,), float(k))
        assert torch.equal(known(lambda a, b: a + b["x"], (x, {"x": x})), 2 * x)
    assert not known._kept


class _Again:
    """A graph that runs its function again, and writes what it finds to where it was first."""

    def pool(self) -> None:
        return None

    def replay(self) -> None:
        self.run()


def fake(monkeypatch, recording: graphs._Recording, step) -> None:
    """Let a recording's graphs do the step, and its derivative, anew."""

    def forward() -> None:
        leaves = [x.detach().requires_grad_(x.requires_grad) for x in recording.given]
        with torch.enable_grad():
            made, _ = tree.flatten(step(*recording.build(leaves)))
        recording.last = leaves, made
        for old, new in zip(recording.made, made, strict=True):
            old.copy_(new.detach())

    def backward() -> None:
        leaves, made = recording.last
        wanted = [x for x in leaves if x.requires_grad]
        found = iter(torch.autograd.grad([made[k] for k in recording.moved], wanted, recording.by, allow_unused=True))
        for x, old in zip(leaves, recording.found, strict=True):
            new = next(found) if x.requires_grad else None
            if old is not None:
                old.copy_(new)

    recording.forward.run, recording.backward.run = forward, backward


def recorded(monkeypatch, step, inputs) -> graphs._Recording:
    """A recording of a step on the CPU."""

    @contextmanager
    def graph(_, pool=None):
        yield

    monkeypatch.setattr(torch.cuda, "CUDAGraph", _Again)
    monkeypatch.setattr(torch.cuda, "graph", graph)
    leaves, build = tree.flatten(inputs)
    recording = graphs._Recording(step, leaves, build)
    recording.build = build
    fake(monkeypatch, recording, step)
    return recording


def test_gradients_through_several_recorded_steps_are_those_of_the_steps(monkeypatch):
    # The step that was run last has its numbers at hand for the derivative; the others are run again.
    def step(k, x):
        return {"pos": (k * x["pos"]).sin() + x["vel"], "vel": x["vel"] * k, "count": x["count"] + 1}

    k = torch.tensor([0.7, 1.3], dtype=F64, requires_grad=True)
    x = {"pos": torch.rand(3, 2, dtype=F64), "vel": torch.rand(3, 2, dtype=F64), "count": torch.zeros(3)}
    moving = x | {name: x[name].requires_grad_() for name in ("pos", "vel")}
    recording = recorded(monkeypatch, step, (k, moving))
    found = []
    for known in (False, True):
        now = moving
        for _ in range(3):
            if known:
                leaves = tree.leaves((k, now))
                now = recording.rebuild(graphs._Step.apply(recording, *leaves))
            else:
                now = step(k, now)
        both = (now["pos"] * now["vel"]).sum()
        found.append((now, torch.autograd.grad(both, [k, x["pos"], x["vel"]], retain_graph=True)))
        again = torch.autograd.grad(both, [k])[0]
        torch.testing.assert_close(again, found[-1][1][0])
    for name in x:
        assert torch.equal(found[0][0][name], found[1][0][name]), name
    assert not found[1][0]["count"].requires_grad
    for one, other in zip(found[0][1], found[1][1], strict=True):
        torch.testing.assert_close(other, one, rtol=1e-12, atol=1e-14)


def test_numbers_that_were_changed_in_place_are_seen(monkeypatch):
    k = torch.ones(2, dtype=F64)
    recording = recorded(monkeypatch, lambda k, x: (k * x,), (k, torch.ones(2, dtype=F64)))
    with torch.no_grad():
        for factor in (1.0, 2.0, 3.0):
            k.fill_(factor)
            recording.repeat([k, torch.full((2,), 5.0, dtype=F64)])
            assert recording.made[0].tolist() == [5 * factor] * 2


@pytest.mark.gpu
@pytest.mark.compile
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_gpu_graphs_change_nothing(monkeypatch):
    x = torch.zeros(5, 12, 3, dtype=F64)
    x[..., 0] = torch.linspace(0, 0.5, 12, dtype=F64)
    made = scenes.make([scenes.Rope(x, density=1e3, youngs=1e6)], [Gravity(), Bend()], prescribed_vertices=(0, 1))
    choice, params, state = made[0], *(tree.map(lambda t: t.to("cuda"), part) for part in made[1:])
    bend = params.rods.material.bend.clone().requires_grad_()
    params = tree.replace(
        params, rods=tree.replace(params.rods, material=tree.replace(params.rods.material, bend=bend))
    )
    controls = tree.map(lambda c: c.expand(8, *c.shape), scenes.stationary_control(choice, state))
    made_by, recordings, found = graphs._Recording.__init__, [], []

    def counted(self, *given):
        made_by(self, *given)
        recordings.append(self)

    monkeypatch.setattr(graphs._Recording, "__init__", counted)
    for runs in (10**9, graphs.RUNS):
        monkeypatch.setattr(graphs, "RUNS", runs)
        step = scenes.stepper(choice)
        for segment in (1, None):
            last, _ = scenes.rollout(step, params, state, controls, segment=segment, keep=lambda s: s.time)
            (gradient,) = torch.autograd.grad(last.rods.pos.square().sum(), bend)
            found.append((last.rods.pos.detach(), gradient))
    assert len(recordings) >= 2, "nothing was recorded"
    for pos, gradient in found[1:]:
        torch.testing.assert_close(pos, found[0][0], rtol=1e-12, atol=1e-14)
        torch.testing.assert_close(gradient, found[0][1], rtol=1e-10, atol=1e-14)
