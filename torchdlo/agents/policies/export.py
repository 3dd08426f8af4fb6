"""Policies for other programs: as TorchScript, or as ONNX if there is the package.

What is written takes what an environment observes, as float32: "observation" (N, O), "progress" (N, 1), the share of
the episode that is over, and "start" (N, O), what was observed at the start. It returns "action" (N, A) in metres and
degrees, the middle of what the policy could do. The normaliser is part of it. Observations of another size are refused.
"""

from __future__ import annotations

import io
import warnings
from pathlib import Path

import torch
from torch import Tensor, nn

from torchdlo.agents.policies.policy import Policy
from torchdlo.errors import InputError
from torchdlo.files import write_atomically

__all__ = ["FORMATS", "export"]

FORMATS = ("torchscript", "onnx")
"""Names of formats."""
_INPUTS = ("observation", "progress", "start")


class _Acts(nn.Module):
    """A policy from observations to actions, without anything random."""

    def __init__(self, policy: Policy) -> None:
        super().__init__()
        self.policy = policy

    def forward(self, observation: Tensor, progress: Tensor, start: Tensor) -> Tensor:
        # What is traced checks nothing else: wider observations would be read in the wrong places.
        shape = (progress.shape[0], self.policy.spec.features.size)
        observation, start = observation.reshape(shape), start.reshape(shape)
        action = self.policy.command(self.policy.mean(self.policy.features(observation, progress, start)))
        # An input that nothing depends on would be dropped.
        return action + 0.0 * start[:, :1]


def export(policy: Policy, path: Path, kind: str = "torchscript") -> None:
    """Write a policy as one of `FORMATS`."""
    if kind not in FORMATS:
        raise InputError(f"format: it is {kind!r}; expected one of {', '.join(FORMATS)}.")
    size = policy.spec.features.size
    example = (torch.zeros(2, size), torch.full((2, 1), 0.5), torch.zeros(2, size))
    acts, written = _Acts(policy).eval(), io.BytesIO()
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # tracing is what is wanted: nothing here depends on values
        if kind == "torchscript":
            torch.jit.save(torch.jit.trace(acts, example), written)
        else:
            _onnx(acts, example, written)
    write_atomically(path, written.getvalue())


def _onnx(acts: nn.Module, example: tuple[Tensor, ...], written: io.BytesIO) -> None:
    try:
        import onnx  # noqa: F401
    except ImportError:
        raise InputError("ONNX needs the package onnx; install it with pip install 'torchdlo[export]'.") from None
    torch.onnx.export(
        acts,
        example,
        written,  # type: ignore[arg-type]  # without dynamo, files in memory are taken, too
        input_names=list(_INPUTS),
        output_names=["action"],
        dynamic_axes={name: {0: "episodes"} for name in (*_INPUTS, "action")},
        dynamo=False,
    )
