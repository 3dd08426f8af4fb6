"""The reward language: what it refuses, that what it accepts is finite, and that it computes what it says."""

from __future__ import annotations

import json
import math
import random
import time
from pathlib import Path

import pytest
import torch
from torch import Tensor

from tests.reward_language.attacks import CODE
from torchdlo.errors import InputError
from torchdlo.reward_language import FUNCTIONS, load_reward, parse, reward


def scene(dtype: torch.dtype = torch.float64, batch: int = 2) -> dict[str, Tensor]:
    """A rope, a point and a number of every scene."""
    rng = torch.Generator().manual_seed(0)
    rope, tool = (torch.rand(batch, *shape, generator=rng, dtype=dtype) for shape in ((5, 3), (3,)))
    return {"rope": rope, "tool_0": tool, "length": torch.rand(batch, generator=rng, dtype=dtype)}


def test_there_are_200_attacks() -> None:
    assert len(set(CODE)) == len(CODE) >= 200


@pytest.mark.parametrize("text", CODE, ids=range(len(CODE)))
def test_attacks_are_refused_at_once(text: str) -> None:
    values = scene()
    begun = time.process_time()
    with pytest.raises(InputError) as caught:
        parse(text).evaluate(values)
    assert time.process_time() - begun < 0.05
    assert "\n" not in str(caught.value) and str(caught.value).endswith(".") and len(str(caught.value)) < 800


@pytest.mark.parametrize("given", [None, 1, b"1", ["1"], {}])
def test_what_is_no_text_is_refused(given: object) -> None:
    with pytest.raises(InputError):
        parse(given)  # type: ignore[arg-type]


class Grammar:
    """Draws expressions, most of which have a meaning."""

    def __init__(self, seed: int) -> None:
        self.rng = random.Random(seed)

    def draw(self, kind: str, depth: int) -> str:
        """Return an expression of numbers (N), points (P) or conditions (C)."""
        rng = self.rng
        if rng.random() < 0.03:
            kind = rng.choice("NPC")
        if depth <= 0:
            if kind == "C":
                return f"{self.leaf('N')} < {self.leaf('N')}"
            return self.leaf(kind)
        return rng.choice(getattr(self, f"_{kind.lower()}"))(self, depth - 1)

    def leaf(self, kind: str) -> str:
        rng = self.rng
        number = rng.choice(["0", "1", "-1", "1e6", "-1e6", "1e-6", "0.5", "1e-300", f"{rng.uniform(-9, 9):.3g}"])
        if kind == "N":
            return rng.choice([number, "length", "z(tool_0)", "x(rope)", "time"])
        return rng.choice(["rope", "tool_0", "rope[0]", "rope[1:3]", "rope[-1]", "rope[::2]", f"point(0, 1, {number})"])

    def _call(self, depth: int, gives: str) -> str:
        points = ("xy", "point", "closest")
        bools = ("any", "all")
        names = [n for n in FUNCTIONS if (n in points) == (gives == "P") and (n in bools) == (gives == "C")]
        if gives == "P":
            names += ["mean", "sum", "where"]
        name = self.rng.choice(names)
        kinds = FUNCTIONS[name].takes.replace("A", gives if gives != "C" else "N")
        return f"{name}({', '.join(self.draw(k, depth) for k in kinds)})"

    def _binary(self, depth: int, kinds: str, signs: str) -> str:
        a, b = (self.draw(k, depth) for k in kinds)
        return f"({a} {self.rng.choice(signs)} {b})"

    _n = (
        lambda s, d: s._call(d, "N"),
        lambda s, d: s._call(d, "N"),
        lambda s, d: s._binary(d, "NN", "+-*/"),
        lambda s, d: f"({s.draw('N', d)}) ** {s.rng.choice(['2', '3', '4', '0.5'])}",
        lambda s, d: f"-{s.draw('N', d)}",
    )
    _p = (
        lambda s, d: s._call(d, "P"),
        lambda s, d: s._binary(d, "PP", "+-"),
        lambda s, d: s._binary(d, "PN", "*/"),
        lambda s, d: s.leaf("P"),
    )
    _c = (
        lambda s, d: s._call(d, "C"),
        lambda s, d: s._binary(d, "NN", "<>"),
        lambda s, d: f"({s.draw('C', d)} {s.rng.choice(['and', 'or'])} {s.draw('C', d)})",
        lambda s, d: f"(not {s.draw('C', d)})",
    )


@pytest.mark.slow
def test_ten_thousand_expressions_are_finite_with_their_gradients_or_refused() -> None:
    grammar, accepted = Grammar(0), 0
    for k in range(10_000):
        values = scene(torch.float32 if k % 2 else torch.float64)
        values["time"] = values["length"] * 0  # where many functions have no derivative
        if k % 3 == 0:
            values["rope"] = values["rope"] * 0
        values = {name: x.requires_grad_() for name, x in values.items()}
        text = grammar.draw("NNNC"[k % 4], k % 5)
        text = f"mean({text})" if k % 4 < 3 else text
        try:
            found = parse(text).evaluate(values)
        except InputError as error:
            assert str(error).endswith("."), text
            continue
        accepted += 1
        assert found.shape == (2,) and bool(torch.isfinite(found.double()).all()), text
        if found.requires_grad:
            for gradient in torch.autograd.grad(found.sum(), list(values.values()), allow_unused=True):
                assert gradient is None or bool(torch.isfinite(gradient).all()), text
    assert accepted > 5_000


ARGUMENTS = {
    "N": ["z(rope)", "length", "y(rope) + 0.1"],
    "P": ["rope", "tool_0", "rope[1:] - tool_0"],
    "C": ["x(rope) < 0.5"],
    "A": ["rope", "xy(rope) + tool_0"],
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_derivatives_agree_with_finite_differences(name: str) -> None:
    takes = FUNCTIONS[name].takes
    given = [ARGUMENTS[kind][takes[:k].count(kind) % len(ARGUMENTS[kind])] for k, kind in enumerate(takes)]
    if name == "dist":
        given = ["rope[1:]", "tool_0"]
    text = f"{name}({', '.join(given)})"
    text = f"where({text}, 1, 0)" if takes == "C" else text
    probe = f"norm(mean({text} - tool_0))" if name in ("xy", "point", "closest", "where") else f"mean({text})"
    probe = f"norm({probe})" if name in ("mean", "sum") else probe
    expression, values = parse(probe + " + 0 * length"), scene()

    def at(rope: Tensor, tool: Tensor, length: Tensor) -> Tensor:
        return expression.evaluate({"rope": rope, "tool_0": tool, "length": length})

    assert torch.autograd.gradcheck(at, [x.clone().requires_grad_() for x in values.values()])


@pytest.mark.parametrize("sign", ["+", "-", "*", "/"])
def test_operators_derive_like_finite_differences(sign: str) -> None:
    expression = parse(f"mean((x(rope) {sign} length) ** 3) ** 0.5")
    values = scene()

    def at(rope: Tensor, tool: Tensor, length: Tensor) -> Tensor:
        return expression.evaluate({"rope": rope + 1, "tool_0": tool, "length": length})

    assert torch.autograd.gradcheck(at, [x.clone().requires_grad_() for x in values.values()])


def test_values_are_those_of_the_formulas() -> None:
    v = scene()
    rope, tool, length = v["rope"], v["tool_0"], v["length"]
    apart = (rope - tool[:, None]).norm(dim=-1)
    expected = {
        "min(dist(rope, tool_0))": apart.amin(-1),
        "nearest(rope, tool_0)": apart.amin(-1),
        "z(closest(rope, tool_0))": rope[torch.arange(2), apart.argmin(-1), 2],
        "2 * exp(-5 * length) / 4 - 1": 0.5 * (-5 * length).exp() - 1,
        "max(z(rope[1:3]))": rope[:, 1:3, 2].amax(-1),
        "x(rope[-1]) ** 2": rope[:, -1, 0] ** 2,
        "sum(z(rope[0]), length, 3)": rope[:, 0, 2] + length + 3,
        "dot(rope[0], tool_0)": (rope[:, 0] * tool).sum(-1),
        "norm(xy(tool_0))": tool[:, :2].norm(dim=-1),
        "where(length > 0.5, 1, 2)": torch.where(length > 0.5, 1.0, 2.0),
        "clamp(length, 0.2, 0.3)": length.clamp(0.2, 0.3),
        "2 * (length > 0.5)": 2.0 * (length > 0.5),
        "dist(mean(rope), point(0, 0, 1))": (rope.mean(1) - torch.tensor([0.0, 0, 1])).norm(dim=-1),
        "chamfer(rope, rope)": 0 * length,
        "length / 0": length / 1e-6,
        "sqrt(-length)": 0 * length,
    }
    for text, value in expected.items():
        torch.testing.assert_close(parse(text).evaluate(v), value, msg=text, check_dtype=False)
    assert parse("0.1 < length < 2 and not any(z(rope) > 2)").evaluate(v).tolist() == (length > 0.1).tolist()


def test_every_scene_of_a_batch_is_as_alone() -> None:
    v = scene(batch=3)
    expression = parse("mean(nearest(rope, tool_0)) + max(z(rope)) * length")
    alone = [expression.evaluate({name: x[k : k + 1] for name, x in v.items()}) for k in range(3)]
    torch.testing.assert_close(expression.evaluate(v), torch.cat(alone))


def test_numbers_of_a_constant_are_those_of_every_scene() -> None:
    assert parse("3").evaluate(scene(batch=4)).tolist() == [3.0] * 4


def test_sentences_say_what_to_write() -> None:
    with pytest.raises(InputError, match=r"gives a list of 5 numbers; make one number of it by mean"):
        parse("z(rope)").evaluate(scene())
    with pytest.raises(InputError, match=r"there is no ring_0; this scene has length, rope, tool_0"):
        parse("z(ring_0)").evaluate(scene())
    with pytest.raises(InputError, match=r"use dot or norm for points"):
        parse("norm(tool_0 * tool_0)").evaluate(scene())


def test_files_hold_rewards(tmp_path: Path) -> None:
    file = tmp_path / "reward.json"
    file.write_text(json.dumps({"reward": {"near": "-length", "up": "z(tool_0)"}, "success": "length < 2"}))
    found, v = load_reward(file), scene()
    assert list(found.evaluate(v)) == ["near", "up"]
    assert found.succeeded(v).all()
    assert found.plain() == json.loads(file.read_text())


@pytest.mark.parametrize(
    "content",
    ["", "[]", "{}", '{"reward": {}}', '{"reward": {"a": 1}}', '{"reward": {"a": "1"}, "more": 1}', '{"reward": "1"}',
     '{"reward": {"a b": "1"}}', '{"reward": {"a": "eval(1)"}}', "[" * 50_000, '{"reward": {"a": "1"}, "success": 3}'],
)  # fmt: skip
def test_files_that_hold_none_are_refused(tmp_path: Path, content: str) -> None:
    file = tmp_path / "reward.json"
    file.write_text(content)
    with pytest.raises(InputError, match=r"\.$"):
        load_reward(file)


def test_success_is_a_condition() -> None:
    with pytest.raises(InputError, match="write a condition"):
        reward({"a": "1"}, "length").succeeded(scene())


def test_magnitudes_end() -> None:
    tower = "(" * 8 + "length" + " * 1e6)" * 8
    x = torch.tensor([1.0], requires_grad=True)
    found = parse(tower).evaluate({"length": x})
    assert found.item() == pytest.approx(1e12)
    (slope,) = torch.autograd.grad(found.sum(), x)
    assert math.isfinite(slope.item())


def test_the_page_has_all_functions() -> None:
    page = (Path(__file__).parents[2] / "docs" / "reward_language.md").read_text()
    for name, function in FUNCTIONS.items():
        assert f"| `{name}(" in page and f"| {function.doc} |" in page, name
