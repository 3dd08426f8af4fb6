"""Tensors as the C++ kernels want them that work on blocks of scenes: one array (rows, scenes) per number."""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from torchdlo.coupling.bodies import shape_sdf
from torchdlo.coupling.bodies.dynamics import PredictedBodyMotion
from torchdlo.physics.kernels import cuda, native

_OPTIONS = ("-fno-math-errno", "-fno-trapping-math", "-Wno-psabi")
_operators = torch.library.Library("torchdlo", "FRAGMENT")
_KINDS = {torch.float32: "float", torch.float64: "double"}


def _constant(ask: Callable) -> Callable:
    """Let compilers take what a function returns as a constant: `torch.compiler.assume_constant_result`.

    That one imports the compiler, which takes a second and is of no use in steps that are not compiled.
    """
    ask._dynamo_marked_constant = True  # type: ignore[attr-defined]  # a mark that no stub knows
    return ask


def kernel(
    name: str, what: str, *options: str, gpu: bool = False
) -> tuple[Callable, Callable[[str, torch.dtype], bool]]:
    """Return what finds a function of a C++ kernel by its name and the dtype of its numbers, and `ready`.

    Args:
        name: of the source file, beside this one.
        what: what it does, in words of the user.
        options: what the compiler is told besides the usual.
        gpu: whether it works on CUDA devices, too; see `on_gpu`.
    """

    @functools.cache
    def library() -> ctypes.CDLL | None:
        return native.library(native.COUPLING / f"{name}.cpp", *_OPTIONS, *options)

    native.KERNELS[name] = library

    def function(what: str, dtype: torch.dtype) -> Callable:
        return getattr(library(), f"{name}_{_KINDS[dtype]}_{what}")

    @_constant
    def ready(device: str, dtype: torch.dtype) -> bool:
        """Return whether the kernel works for tensors of a kind of device and a dtype."""
        if gpu and device == "cuda" and cuda.ready(native.COUPLING / f"{name}.cpp", options, dtype):
            return True
        return native.works_on(device, what) and dtype in _KINDS and library() is not None

    return function, ready


def on_gpu(
    name: str, what: str, sizes: ctypes.Structure, arrays: Sequence, like: Tensor, scenes: int, *options: str
) -> None:
    """Run an entry of a kernel on the device of a tensor.

    Args:
        name: of the source file.
        what: of the entry.
        sizes: its sizes; addresses in it are those of `numbers`.
        arrays: what `fields` returns, and addresses.
        like: a tensor with its dtype, on its device.
        scenes: how many there are.
        options: those of `kernel`.
    """
    launch = cuda.launcher(native.COUPLING / f"{name}.cpp", options, like.dtype, what == "back", like.device)
    addresses = [at for x in arrays for at in (x if isinstance(x, ctypes.Array) else [x])]
    cuda.run(launch, f"{name}_{what}", sizes, addresses, scenes, like)


def uses_gpu(like: Tensor) -> bool:
    """Return whether what works on CUDA devices is to work on a tensor."""
    return like.is_cuda


def numbers(values: Sequence[int], like: Tensor) -> int:
    """Return the address of whole numbers that stay in the memory of a tensor's device."""
    given = tuple(values)
    return cuda.integers(given, like.device).data_ptr() if uses_gpu(like) else integers(given)


def operator(schema: str, run: Callable, empty: Callable, save=None, backward=None, gpu: bool = False) -> None:
    """Register an operator `torch.ops.torchdlo.NAME` that runs a kernel.

    Args:
        schema: its name, inputs and outputs; tensors come to it contiguous.
        run: what it does.
        empty: what makes outputs of the right shapes for the compiler.
        save: see `setup_context` of `torch.library.register_autograd`.
        backward: its derivative; None if it has none.
        gpu: whether `run` works on CUDA devices, too.
    """
    name = schema.partition("(")[0]
    _operators.define(schema, tags=(torch.Tag.needs_contiguous_strides,))
    for device in ("CPU", "CUDA") if gpu else ("CPU",):
        _operators.impl(name, run, device)
    _operators.impl(name, empty, "Meta")
    if backward is not None:
        torch.library.register_autograd(f"torchdlo::{name}", backward, setup_context=save, lib=_operators)


@functools.cache
def integers(numbers: tuple[int, ...]) -> int:
    """Return the address of whole numbers that stay in memory."""
    return ctypes.addressof(_kept(numbers))


@functools.cache
def _kept(numbers: tuple[int, ...]) -> ctypes.Array:
    return (ctypes.c_int64 * len(numbers))(*numbers)


def fields(tensors: Sequence[Tensor]) -> ctypes.Array:
    """Return the addresses of all fields of tensors (C, n, B)."""
    at = [t.data_ptr() + k * (t.nbytes // t.shape[0]) for t in tensors for k in range(t.shape[0])]
    return (ctypes.c_void_p * len(at))(*at)


def pack_components(parts: Sequence[Tensor], batch: torch.Size, count: int) -> list[Tensor]:
    """Return tensors (..., n or 1, C) as (C, n, B) each."""
    n = len(batch) + 2
    wide = (x.expand(*batch, count, x.shape[-1]).permute(n - 1, n - 2, *range(n - 2)) for x in parts)
    return [x.reshape(x.shape[0], count, batch.numel()).contiguous() for x in wide]


def join_components(parts: Sequence[Tensor], batch: torch.Size, count: int) -> Tensor:
    """Return tensors (..., n or 1, C) as one, (C in all, n, B)."""
    n = len(batch) + 2
    joined = torch.cat([x.expand(*batch, count, x.shape[-1]).permute(n - 1, n - 2, *range(n - 2)) for x in parts])
    return joined.reshape(joined.shape[0], count, batch.numel())


def unpack_components(x: Tensor, batch: Sequence[int]) -> Tensor:
    """Return (C, n, B) as (..., n, C)."""
    x = x.reshape(*x.shape[:2], *batch)
    return x.permute(*range(2, x.dim()), 1, 0)


def shape_numbers(motion: PredictedBodyMotion) -> list[int]:
    """Return the shapes of bodies by their numbers in the kernels."""
    return [tuple(shape_sdf.SIZES).index(b.shape) for b in motion.bodies]


def shape_sizes(motion: PredictedBodyMotion) -> tuple[Tensor, list[Tensor]]:
    """Return how far in x shapes are from the centres of mass, and four numbers of their sizes, shape (..., K, C).

    The size of a ring ends in cosine and sine of half its arc.
    """
    size = motion.params.size
    if all(b.shape != "ring" for b in motion.bodies):
        none = torch.zeros_like(size[..., 2:])
        return none, [size, none]
    ring = size.new_tensor([[float(b.shape == "ring")] for b in motion.bodies]) > 0
    third, none = size[..., 2:], torch.zeros_like(size[..., 2:])
    third, fourth = torch.where(ring, torch.cos(0.5 * third), third), torch.where(ring, torch.sin(0.5 * third), none)
    return torch.where(ring, shape_sdf.ring_centre(size), none), [size[..., :2], third, fourth]


def alike(motion: PredictedBodyMotion) -> bool:
    """Return whether meshes are the same in all scenes, and not learned."""
    meshed = any(b.shape == "mesh" for b in motion.bodies)
    parts = (motion.params.grid, motion.params.balls)
    return not meshed or all(x.shape[:-2].numel() == 1 and not x.requires_grad for x in parts)


def sampled_grids(motion: PredictedBodyMotion) -> tuple[Tensor, list[int]]:
    """Return the grids of all bodies, shape (K, n), and the cells of each in x, y and z, 0 where there is none."""
    return _rows(motion, motion.params.grid), [n for b in motion.bodies for n in (b.cells or (0, 0, 0))]


def inscribed_balls(motion: PredictedBodyMotion) -> tuple[Tensor, list[int]]:
    """Return the balls within all bodies that stand for meshes, shape (K, 4 P), and how many each has."""
    return _rows(motion, motion.params.balls), [b.balls for b in motion.bodies]


def _rows(motion: PredictedBodyMotion, x: Tensor) -> Tensor:
    """Return what is alike in all scenes, (..., K, n), as (K, n)."""
    if not any(b.shape == "mesh" for b in motion.bodies):
        return x.new_zeros(len(motion.bodies), 0)
    return x.detach().reshape(x.shape[-2:]).contiguous()


def refuse_second_derivative(ctx, *by) -> None:
    """Refuse to differentiate a derivative: what stands in for the backward pass of an operator's backward pass."""
    raise RuntimeError("contact and matter have no second derivative; do not ask for create_graph through them")
