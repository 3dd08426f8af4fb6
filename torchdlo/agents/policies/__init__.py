"""Policies that act in tasks: `load(path)` returns one, `module(policy)` makes it a TensorDictModule."""

from torchdlo.agents.policies.cloud_policy import CloudPolicy, CloudSpec
from torchdlo.agents.policies.features import FeatureSpec, Normaliser, task_features
from torchdlo.agents.policies.files import load, module, save
from torchdlo.agents.policies.policy import Policy, PolicySpec, mlp

__all__ = [
    "CloudPolicy",
    "CloudSpec",
    "FeatureSpec",
    "Normaliser",
    "Policy",
    "PolicySpec",
    "load",
    "mlp",
    "module",
    "save",
    "task_features",
]
