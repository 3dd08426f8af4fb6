"""Exported policies act as they do here."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from torchdlo.agents.policies import FeatureSpec, Policy, PolicySpec, save_policy
from torchdlo.agents.policies.export import export
from torchdlo.cli import app
from torchdlo.errors import InputError


def made(memory: bool = True) -> Policy:
    centers = ((0.0, 0.1, 0.0), (0.2, 0.0, 0.0))
    features = FeatureSpec(8, (0, 3), centers, (1,), (1,) if memory else (), waves=2)
    policy = Policy(PolicySpec(features, 3, hidden=(16,), task="coiling", reach=0.01, turns=3, squash=False))
    policy.normaliser.update(torch.randn(50, features.width))
    return policy


def inputs(count: int) -> tuple[torch.Tensor, ...]:
    return torch.randn(count, 8), torch.rand(count, 1), torch.randn(count, 8)


@pytest.mark.parametrize("memory", [True, False])
def test_torchscript_acts_the_same(tmp_path: Path, memory: bool):
    policy, given = made(memory), inputs(5)
    export(policy, tmp_path / "policy.ts")
    read = torch.jit.load(str(tmp_path / "policy.ts"))
    torch.testing.assert_close(read(*given), policy.act(*given))
    # Features are picked by their places: these would be found in wider observations, too.
    with pytest.raises(RuntimeError, match="invalid for input of size"):
        read(torch.randn(5, 9), given[1], torch.randn(5, 9))


def test_onnx_acts_the_same(tmp_path: Path):
    reference = pytest.importorskip("onnx.reference")
    policy, given = made(), inputs(5)
    export(policy, tmp_path / "policy.onnx", "onnx")
    session = reference.ReferenceEvaluator(str(tmp_path / "policy.onnx"))
    names = ("observation", "progress", "start")
    (action,) = session.run(None, {name: x.numpy() for name, x in zip(names, given, strict=True)})
    torch.testing.assert_close(torch.from_numpy(action), policy.act(*given), rtol=1e-4, atol=1e-7)


def test_the_command_writes_it_and_says_what_is_wrong(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    save_policy(made(), tmp_path / "policy.pt")
    with pytest.raises(SystemExit) as done:
        app.main(["export", str(tmp_path)])
    assert done.value.code in (0, None)
    assert (tmp_path / "policy.torchscript").stat().st_size > 1000
    with pytest.raises(SystemExit) as done:
        app.main(["export", str(tmp_path), "--format", "caffe"])
    assert done.value.code == 2
    assert "expected one of torchscript, onnx" in capsys.readouterr().err
    with pytest.raises(InputError, match="expected one of"):
        export(made(), tmp_path / "x", "caffe")
