"""Policies that act in tasks: `load_policy(path)` returns one, `policy_module(policy)` makes it a TensorDictModule."""

from torchdlo.agents.policies.cloud_policy import CloudPolicy, CloudSpec
from torchdlo.agents.policies.features import FeatureSpec, Normaliser, task_features
from torchdlo.agents.policies.policy import Policy, PolicySpec, mlp
from torchdlo.agents.policies.policy_files import load_policy, policy_module, save_policy

__all__ = [
    "CloudPolicy",
    "CloudSpec",
    "FeatureSpec",
    "Normaliser",
    "Policy",
    "PolicySpec",
    "load_policy",
    "mlp",
    "policy_module",
    "save_policy",
    "task_features",
]
