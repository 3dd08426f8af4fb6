"""Policies as files: plain data and tensors, without code, and as modules of TorchRL."""

from __future__ import annotations

import io
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch

from torchdlo.agents.policies.cloud_policy import CloudPolicy, CloudSpec
from torchdlo.agents.policies.policy import Policy, PolicySpec
from torchdlo.errors import InputError
from torchdlo.files import write_atomically
from torchdlo.untrusted.tensor_file import check_shapes, read_tensors

__all__ = ["is_finite", "load_policy", "policy_module", "save_policy"]

_GENERATOR = "torchdlo train"


def save_policy(policy: Policy | CloudPolicy, path: Path, notes: dict[str, Any] | None = None) -> None:
    """Write a policy, and plain data about it, to one file."""
    content = {
        "generator": _GENERATOR,
        "kind": "cloud" if isinstance(policy, CloudPolicy) else "state",
        "spec": policy.spec.plain(),
        "state": {k: v.detach().cpu().clone() for k, v in policy.state_dict().items()},
        "notes": notes or {},
    }
    written = io.BytesIO()
    torch.save(content, written)
    write_atomically(path, written.getvalue())


def load_policy(path: Path | str, notes: bool = False) -> Any:
    """Return the policy of a file, or (policy, plain data about it)."""
    path = Path(path)
    what = "a policy of torchdlo train"
    wrong = InputError(f"{path}: expected {what}, found something else.")
    if path.is_dir():
        path = path / "policy.pt"
    content = read_tensors(path, what)
    try:
        if content["generator"] != _GENERATOR:
            raise wrong
        if content.get("kind") == "cloud":
            made: Callable[[], Policy | CloudPolicy] = partial(CloudPolicy, CloudSpec.of(content["spec"]))
        else:
            made = partial(Policy, PolicySpec.of(content["spec"]))
        with torch.device("meta"):  # what the file says of itself may be of any size
            check_shapes(made(), content["state"], str(path), what)
        policy = made()
        policy.load_state_dict(content["state"])
        if not is_finite(policy):
            said = "its weights are not finite: training went astray; train it anew, in smaller steps"
            raise InputError(f"{path}: {said}.")
        said = content["notes"]
    except InputError:
        raise
    except (KeyError, TypeError, ValueError, RuntimeError, AttributeError, IndexError):
        raise wrong from None
    policy.eval()
    return (policy, said) if notes else policy


def is_finite(policy: torch.nn.Module) -> bool:
    """Return whether all weights of a policy, and what it knows of features, are finite."""
    return all(bool(value.isfinite().all()) for value in policy.state_dict().values())


def policy_module(policy: Policy, *, scaled: bool = False) -> Any:
    """Return a policy as a TensorDictModule from "observation", "progress" and "start" to "action".

    It draws actions at random where TorchRL's exploration type is RANDOM, and takes their middle otherwise.

    Args:
        policy: the policy.
        scaled: whether it acts in an environment with `scaled_actions`, from -1 to 1, and not in metres and degrees.
    """
    from tensordict.nn import TensorDictModule
    from torchrl.envs.utils import ExplorationType, exploration_type

    class _Acts(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.policy = policy

        def forward(self, observation: torch.Tensor, progress: torch.Tensor, start: torch.Tensor) -> torch.Tensor:
            features = self.policy.features(observation, progress, start)
            random = exploration_type() == ExplorationType.RANDOM
            action = self.policy.draw(features)[0] if random else self.policy.mean(features)
            return self.policy.command(action, scaled=scaled)

    return TensorDictModule(_Acts(), in_keys=["observation", "progress", "start"], out_keys=["action"])
