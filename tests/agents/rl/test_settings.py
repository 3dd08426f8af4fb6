"""Settings of training: what makes no sense is refused in a sentence."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch

pytest.importorskip("torchrl")

from torchdlo.agents.policies import mlp
from torchdlo.agents.rl.evaluate import UNSEEN
from torchdlo.agents.rl.expert import _Arena
from torchdlo.agents.rl.hybrid_stages import _VALIDATION
from torchdlo.agents.rl.settings import ALGORITHMS, EXPECTED, LARGEST_SEED, TrainingSettings, training_preset
from torchdlo.agents.rl.student import Student
from torchdlo.cli import app
from torchdlo.errors import InputError

pytestmark = pytest.mark.quick


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("rate", "fast", "a finite number above 0"),
        ("rate", math.nan, "a finite number above 0"),
        ("rate", True, "a finite number above 0"),
        ("lmbda", 7, "a number from 0 to 1"),
        ("batch", 0, "a whole number from 1 on"),
        ("window", 2.5, "at least 1 action"),
        ("passes", 0, "a whole number from 1 on"),
        ("hidden", 64, "the sizes of layers"),
        ("critic", (64, 0), "the sizes of layers"),
        ("activation", "foo", "one of tanh, relu, elu, silu"),
        ("activation", ["elu"], "one of tanh, relu, elu, silu"),
        ("layer_norm", 1, "true or false"),
        ("minutes", math.nan, "a number above 0"),
        ("episodes", "many", "a whole number from 1 on"),
        ("episodes", 0, "a whole number from 1 on"),
        ("polyak", 1.0, "a number from 0 on, below 1"),
        ("fidelity", 3, "a name"),
    ],
)
def test_what_a_setting_cannot_be_is_said(name: str, value: object, expected: str):
    with pytest.raises(InputError, match=rf"{name} is .*; expected {expected}"):
        training_preset("coiling", "ppo", **{name: value})


def test_seeds_of_training_are_not_those_of_judgements():
    """All that is added to a seed is less than what lies between the largest one and those of judgements."""
    for seed in (LARGEST_SEED + 1, UNSEEN, 2**32 - 1, -1):
        with pytest.raises(InputError, match=r"seed is .*; expected a whole number from 0 to 699999999, as seeds"):
            training_preset("coiling", "ppo", seed=seed)
        with pytest.raises(InputError, match=r"seed is .*; expected a whole number from 0 to 699999999, as seeds"):
            Student(seed=seed)
    assert training_preset("coiling", "ppo", seed=LARGEST_SEED).seed == Student(seed=LARGEST_SEED).seed == LARGEST_SEED
    assert max(_VALIDATION, 104_729 * 20) < UNSEEN - LARGEST_SEED
    # Candidates of a robust path are played from starts of seeds far apart.
    assert _Arena(None, 699, 0.0, None).seed + 10**6 < UNSEEN < 2**60 < _Arena(None, 777, 0.0, None).seed
    torch.Generator().manual_seed(_Arena(None, LARGEST_SEED, 0.0, None).seed + 10**6)


def test_every_setting_has_a_check_that_its_default_passes():
    assert set(EXPECTED) == {f.name for f in dataclasses.fields(TrainingSettings)}
    for algorithm in ALGORITHMS:
        training_preset("gathering", algorithm)
    for name in ("tanh", "relu", "elu", "silu"):
        mlp((2, 3, 1), name)


@pytest.mark.parametrize(
    ("pair", "said"),
    [
        ("seed=3", "--set seed=3: seed has an option; give --seed instead"),
        ("algorithm=sac", "give --algo instead"),
        ("variation=false", "give --no-variation instead"),
        ("collectors=2", "give --address and --workers instead"),
        ("hidden=64", "hidden is 64; expected the sizes of layers"),
        ("rate=nan", "rate is 'nan'; expected a finite number above 0"),
    ],
)
def test_commands_refuse_it_without_a_traceback(
    pair: str, said: str, tmp_path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as done:
        app.main(["train", "coiling", "--algo", "ppo", "--set", pair, "--out", str(tmp_path / "x")])
    assert done.value.code == 2
    assert said in " ".join(capsys.readouterr().err.split())
