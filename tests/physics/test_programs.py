"""Recorded graphs do in loops what torch does."""

import math
import threading

import pytest
import torch

from torchdlo.physics.execution import programs, tracing
from torchdlo.physics.execution.graph_reading import UnknownGraphError, read


def _numbers(*shape, dtype=torch.float64, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype)


def _graph(step, *inputs):
    graph, _ = torch._C._create_graph_by_tracing(
        lambda *x: tuple(step(*x)), inputs, lambda _: "", True, False, None, []
    )
    torch._C._jit_pass_dce(graph)
    return graph


def _made(step, *inputs):
    """Return a program, and what it says its operations are."""
    with torch.no_grad():
        graph = _graph(step, *inputs)
    own = read(graph, inputs, [])
    return programs.Program(own), [each.what for each in own.operations]


ONE = {
    "neg": lambda x: -x,
    "abs": torch.abs,
    "square": torch.square,
    "power two": lambda x: x**2,
    "root": lambda x: (x * x) ** 0.5,
    "reciprocal": torch.reciprocal,
    "one over": lambda x: 1 / x,
    "round": lambda x: torch.round(3 * x),
    "floor": lambda x: torch.floor(3 * x),
    "sign": torch.sign,
    "one minus": lambda x: 1 - x,
    "clamp": lambda x: x.clamp(-0.3, 0.4),
    "clamp below": lambda x: x.clamp(min=0.1),
    "clamp above": lambda x: x.clamp(max=0.1),
    "sum of two": lambda x: x.sum((0, 2)),
    "largest": lambda x: x.amax(1),
    "least": lambda x: x.amin(-1, keepdim=True),
    "sums": lambda x: x.cumsum(1),
    "rows": lambda x: x.index_select(1, torch.tensor([2, 0, 3, 3])),
    "rows by index": lambda x: x[:, [1, -1]],
    "rows by mask": lambda x: x[:, torch.tensor([True, False, True, True])],
    "turned": lambda x: x.flip(1),
    "joined": lambda x: torch.cat([x[:, :1], x, x[:, 2:]], 1),
    "stacked": lambda x: torch.stack([x, 2 * x], -2),
    "truths as numbers": lambda x: (x > 0) * x + (x <= 0.1).to(x.dtype),
    "where": lambda x: torch.where(x > 0.2, x, torch.zeros_like(x)),
    "where a number": lambda x: torch.where(x > 0.2, 3.0, x),
    "masked": lambda x: x.masked_fill(x.ge(0.5) | x.lt(-0.5) & ~x.eq(0), 0.25),
    "integers": lambda x: x * torch.tensor(3) + 2,
    "reshaped": lambda x: x.transpose(0, 1).reshape(-1, 2) * 2.0,
    "fused": lambda x: torch.add(x, x.transpose(0, 0), alpha=2) - torch.sub(x, x * x, alpha=0.5),
    "largest of many": lambda x: x.repeat(1, 5, 1).amax(1),
    "by torch": lambda x: torch.lerp(x, x * x, x.abs()) + torch.linalg.vector_norm(x, dim=-1, keepdim=True),
    "products": lambda x: (x @ x.transpose(-1, -2)).diagonal(dim1=-2, dim2=-1),
}
NEARLY = {  # torch rounds in another way, and sums in another order
    "sqrt": lambda x: x.abs().sqrt(),
    "power three": lambda x: x**3,
    "sum": lambda x: x.sum(-1, keepdim=True),
    "sum away": lambda x: x.sum(0),
    "sum of many": lambda x: x.repeat(1, 5, 1).sum(1, keepdim=True),
    "between": lambda x: torch.lerp(x, x * x, 0.3) + torch.lerp(x, x * x, 0.7),
    "exp": torch.exp,
    "expm1": torch.expm1,
    "log": lambda x: x.abs().log(),
    "sin": torch.sin,
    "cos": torch.cos,
    "tanh": torch.tanh,
    "asin": lambda x: x.clamp(-1, 1).asin(),
    "power": lambda x: x.abs() ** 1.7,
}


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("name", [*ONE, *NEARLY])
def test_operations_do_what_those_of_torch_do(name, dtype):
    step = {**ONE, **NEARLY}[name]
    bound = 0.0 if name in ONE else 8 * torch.finfo(dtype).eps
    whole = _numbers(5, 4, 6, dtype=dtype)
    for x in (whole[:, :, :3].contiguous(), whole[::2, :, ::2], whole.permute(2, 1, 0), whole[:1].expand(3, 4, 6)):
        program, _ = _made(lambda x: (step(x),), x)
        for given in (x, _numbers(5, 4, 6, dtype=dtype, seed=1).as_strided(x.shape, x.stride())):
            (found,), right = program([given]), step(given)
            torch.testing.assert_close(found, right, rtol=bound, atol=bound, msg=lambda text: f"{name}: {text}")


@pytest.mark.parametrize("name", ["add", "sub", "mul", "div", "minimum", "maximum", "atan2"])
def test_numbers_are_broadcast(name):
    operator = getattr(torch, name)
    x, y, z = _numbers(3, 5, 2), _numbers(5, 1, seed=1), _numbers(3, 1, 1, seed=2)
    program, whats = _made(lambda *given: (operator(given[0], given[1]), operator(given[2], given[0])), x, y, z)
    assert whats == [name, name]
    bound = 1e-15 if name == "atan2" else 0.0
    for found, right in zip(program([x, y, z]), (operator(x, y), operator(z, x)), strict=True):
        torch.testing.assert_close(found, right, rtol=bound, atol=0)


def test_what_is_not_a_number_stays():
    x = torch.tensor([math.nan, 1.0, -math.inf, math.inf], dtype=torch.float64)
    y = x.flip(0).contiguous()

    def step(x, y):
        return x.clamp(-1, 1), torch.minimum(x, y), torch.maximum(x, y), x.amax(0), torch.where(x > 0, x, y), x + y

    program, _ = _made(step, x, y)
    for found, right in zip(program([x, y]), step(x, y), strict=True):
        torch.testing.assert_close(found, right, rtol=0, atol=0, equal_nan=True)


def test_loops_are_all_that_a_step_of_known_operations_is():
    def step(x, y):
        z = torch.where((x > 0) & (y < 1), x.square() * y, -x)
        return z.transpose(0, 1)[1:], torch.cat([z, y]).sum(1, keepdim=True), x

    x, y = _numbers(4, 3), _numbers(4, 3, seed=1)
    program, whats = _made(step, x, y)
    assert "torch" not in whats and len(whats) == 11, whats
    first = program([x, y])
    again = program([y, x])
    for found, right in ((first, step(x, y)), (again, step(y, x))):
        for a, b in zip(found, right, strict=True):
            # What a call made is not changed by the next one.
            assert torch.equal(a, b) and a.stride() == b.stride()
    assert first[2] is x


def test_torch_does_what_there_is_no_loop_for():
    def step(x, i):
        z = torch.linalg.cross(x * 2, x.flip(0))
        return z + 1, x.gather(0, i), torch.sort(z, 0)[0] * z, i + 1, x[:0]

    x, i = _numbers(4, 3), torch.tensor([[0, 1, 2], [3, 0, 0]])
    program, whats = _made(step, x, i)
    assert whats.count("torch") == 4, whats
    for given in ((x, i), (_numbers(4, 3, seed=3), 3 - i)):
        for found, right in zip(program(given), step(*given), strict=True):
            assert torch.equal(found, right)


def test_constants_stay_as_they_are():
    table = torch.arange(12, dtype=torch.float64)[3:]

    def step(x):
        return x + table[1:4] * torch.ones(3, dtype=torch.float64), table[2:5]

    x = _numbers(3)
    program, whats = _made(step, x)
    assert whats == ["add"]
    for given in (x, 2 * x):
        assert all(torch.equal(a, b) for a, b in zip(program([given]), step(given), strict=True))


def test_random_numbers_are_drawn_anew():
    x = _numbers(1000)
    program, _ = _made(lambda x: (x + torch.rand(1000, dtype=torch.float64), torch.randn_like(x)), x)
    (a, b), (c, d) = program([x]), program([x])
    assert not torch.equal(a, c) and not torch.equal(b, d)


def test_parts_of_one_tensor_may_be_given():
    whole = _numbers(40)
    x, y = whole[3:12].view(3, 3), whole[12:21].view(3, 3)
    program, _ = _made(lambda x, y: (x[1:] * y[:2], y.t()), x, y)
    for found, right in zip(program([x, y]), (x[1:] * y[:2], y.t()), strict=True):
        assert torch.equal(found, right)


def _masked_in_place(x):
    mask = x > 0
    mask &= x < 1
    return mask, mask * x


def _into_given(x):
    out = torch.empty_like(x)
    torch.mul(x, 2, out=out)
    return (out,)


class _Doubled(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x):
        return 2 * x

    @staticmethod
    def backward(ctx, grad):
        return 2 * grad


@torch.jit.script
def _scripted(x):
    if bool(x.sum() > 0):
        return x * 2
    return x * 3


RARE = {
    "in place by an operator": _masked_in_place,
    "into a tensor": _into_given,
    "of a function": lambda x: (_Doubled.apply(x) + 1,),
    "scripted": lambda x: (_scripted(x),),
    "chosen by a mask": lambda x: (x[x > 0].sum(), (x > 0).nonzero() * 1, torch.where(x > 0)[0]),
    "masks": lambda x: ((x > 0).amax(-1), (x > 0).amin(0), (x > 0).sign(), (x > 0) ^ (x > 1), (x > 0).all()),
    "bounds of masks": lambda x: ((x > 0).clamp(min=x > 1), (x > 0).clamp_max(x > 1)),
    "integers": lambda x: ((3 * x).long()[:, [1, 0]], (3 * x).long().flip(1), (x > 0).long().sum(1)),
    "halves": lambda x: (x.half()[:, [1, 0]] + 1,),
    "masks of bytes": lambda x: (x[:, torch.tensor([1, 0, 1], dtype=torch.uint8)],),
    "sums of a type": lambda x: (x.sum(dtype=x.dtype), x.sum(1, dtype=torch.float64), x.mean(0)),
    "of one number": lambda x: ((2 * x[0, 0]).sum(0), (2 * x[0, 0]).cumsum(0), (2 * x[0, 0]).amax(0), x[0, 0].flip(0)),
    "bounds that are none": lambda x: (x.clamp(min=math.nan), x.clamp(max=x / 0 * 0), torch.clamp_min(x, x * math.nan)),
    "conjugated": lambda x: (torch.fft.fft(x).conj().imag + 1, torch.view_as_real(torch.fft.fft(x).conj() * 2)),
    "powers": lambda x: (2.0**x, x.abs() ** x, x**0, x**-2, x.abs() ** -0.5),
    "rounded": lambda x: (x.round(decimals=1), torch.div(x, 0.3, rounding_mode="floor")),
    "constants": lambda x: (torch.zeros_like(x), torch.full_like(x, 2.0), x.new_tensor([1.0, 2.0])),
    "five dimensions": lambda x: (x[:, None, :, None, None].expand(4, 2, 3, 2, 2).permute(4, 1, 0, 3, 2) * x[0, 0],),
    "one row in place of all": lambda x: ((2 * x)[:1].expand(4, 3),),
    "many operations": lambda x: (
        torch.einsum("ij,kj->ik", x, x),
        torch.softmax(x, -1),
        x.roll(1, 0),
        x.std(),
        x.max(1)[1],
    ),
}


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", RARE)
def test_rare_operations_are_done_by_torch_or_torch_script(name):
    step = RARE[name]
    x = _numbers(4, 3)
    recorded = tracing.record(step, x.clone())
    for given in (x, _numbers(4, 3, seed=1), _numbers(4, 3, seed=2) + 2):
        for found, right in zip(recorded(given.clone()), step(given.clone()), strict=True):
            torch.testing.assert_close(found, right, equal_nan=True)


def test_what_is_given_back_and_what_was_captured_may_change():
    factor = torch.ones(3, dtype=torch.float64)
    recorded = tracing.record(lambda x: (torch.zeros_like(x), x * factor, x * (2 * factor)), _numbers(3))
    x = _numbers(3)
    recorded(x)[0].add_(1)
    factor.fill_(5)
    zeros, once, twice = recorded(x)
    assert not zeros.any() and torch.equal(once, x) and torch.equal(twice, 2 * x)


@pytest.mark.parametrize(
    "step", [lambda x: (x.add_(1),), lambda x: (x * x.sum().item(),), lambda x: (x[: int(x.abs().sum())],)]
)
def test_graphs_that_no_program_can_follow_are_left_to_torch_script(step):
    x = _numbers(5)
    with torch.no_grad():
        graph = _graph(step, x.clone())
    try:
        read(graph, [x.clone()], [])
    except UnknownGraphError:
        assert programs.program(graph, [x.clone()], []) is None
    else:  # the tracer took numbers for constants: the same with TorchScript
        assert torch.equal(
            programs.program(graph, [x], [])([x])[0], torch._C._create_function_from_graph("f", graph)(x)[0]
        )
    recorded = tracing.record(step, x.clone())
    assert torch.equal(recorded(x.clone())[0], step(x.clone())[0])


def test_threads_do_not_disturb_each_other():
    def step(x):
        for _ in range(30):
            x = torch.sin(x) + x * 0.5
        return (x,)

    given = [_numbers(200, 41, seed=k) for k in range(4)]
    program, _ = _made(step, given[0])
    right, wrong = [step(x)[0] for x in given], []

    def use(k):
        for _ in range(20):
            if not torch.allclose(program([given[k]])[0], right[k], rtol=1e-12):
                wrong.append(k)

    threads = [threading.Thread(target=use, args=(k,)) for k in range(4)]
    for each in threads:
        each.start()
    for each in threads:
        each.join()
    assert not wrong


def test_inputs_may_be_stored_in_other_ways():
    calls = []

    def step(x, y):
        calls.append(None)
        return x * y, x.sum(0)

    x, y = _numbers(4, 3), _numbers(4, 3, seed=1)
    recorded = tracing.record(step, x, y)
    for a, b in ((x, y), (x.t().contiguous().t(), y), (_numbers(4, 6)[:, ::2], y)):
        found = recorded(a, b)
        assert torch.equal(found[0], a * b) and torch.equal(found[1], a.sum(0))
    assert len(calls) == 1
