"""Kernels for CUDA devices: the C++ sources of the CPU's, compiled by the NVRTC that torch's CUDA builds bring along.

A source takes part if it ends in entries by `KERNEL`, see simt.h. It is compiled once per machine and kind of GPU and
kept in the private folder of `torchdlo.cache`. No compiler has to be installed.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from torch import Tensor

from torchdlo import cache, notices
from torchdlo.physics.kernels import native

SHARED = 48 * 1024
"""Memory of a warp that is fast [bytes]; what needs more stands with the rest."""
SCRATCH = 512 * 2**20
"""Memory for all warps together [bytes], about."""
_LANES = 32
"""Threads of a warp, which works on one scene at a time."""
_WARPS = 32
"""Warps per multiprocessor at most."""
_FIELDS = 176
"""Arrays that a kernel can have, as in simt.h."""
_NUMBERS = {torch.float32: "float", torch.float64: "double"}


class Fields(ctypes.Structure):
    """Addresses of arrays, as in simt.h."""

    _fields_ = (("at", ctypes.c_void_p * _FIELDS),)


class Room(ctypes.Structure):
    """Memory of warps, as in simt.h."""

    _fields_ = (("far", ctypes.c_void_p), ("each", ctypes.c_int64), ("nearby", ctypes.c_int64))


Launch = Callable[[str, ctypes.Structure, Fields, Room, int, int], None]
"""Runs an entry, by its name, with sizes, arrays and memory, so many warps, and bytes of fast memory for each."""


def works() -> bool:
    """Return whether there are CUDA devices, and what compiles for them."""
    return _nvrtc() is not None


@functools.cache
def _nvrtc() -> ctypes.CDLL | None:
    if not torch.version.cuda or not torch.cuda.is_available():
        return None
    # torch brings it along and has told the loader where it is.
    for name in (f"libnvrtc.so.{torch.version.cuda.partition('.')[0]}", "libnvrtc.so"):
        try:
            return ctypes.CDLL(name)
        except OSError:
            continue
    notices.once("nvrtc", "libnvrtc was not found: slower tensor operations are used for contact on GPUs.")
    return None


def compiled(nvrtc: ctypes.CDLL, source: Path, kind: str, options: Sequence[str]) -> bytes:
    """Return the machine code of a source file for a kind of GPU ("sm_90").

    Raises:
        RuntimeError: with what the compiler says.
    """
    folders = [f"-I{each}" for each in sorted({source.parent, native.RODS})]
    words = [f"--gpu-architecture={kind}", "--std=c++17", "--device-as-default-execution-space", "-DSIMT"]
    given = [word.encode() for word in (*words, *folders, *options)]
    program = ctypes.c_void_p()
    nvrtc.nvrtcCreateProgram(ctypes.byref(program), source.read_bytes(), source.name.encode(), 0, None, None)
    failed = nvrtc.nvrtcCompileProgram(program, len(given), (ctypes.c_char_p * len(given))(*given))
    what = "ProgramLog" if failed else "CUBIN"
    size = ctypes.c_size_t()
    getattr(nvrtc, f"nvrtcGet{what}Size")(program, ctypes.byref(size))
    found = ctypes.create_string_buffer(size.value)
    getattr(nvrtc, f"nvrtcGet{what}")(program, found)
    nvrtc.nvrtcDestroyProgram(ctypes.byref(program))
    if failed:
        raise RuntimeError(f"{source.name} could not be compiled for {kind} ({found.value.decode(errors='replace')})")
    return found.raw


@functools.cache
def _code(source: Path, options: tuple[str, ...], kind: str) -> bytes | None:
    """Return the machine code of a source, from the private folder if it is there; None, with one warning, if none."""
    nvrtc, folder = _nvrtc(), cache.cache_folder()
    if nvrtc is None or folder is None:
        return None
    texts = [source, *(header for each in sorted({source.parent, native.RODS}) for header in sorted(each.glob("*.h")))]
    parts = [str(torch.version.cuda), kind, *options, *(text.read_text("utf-8") for text in texts)]
    target = folder / f"{source.stem}-{hashlib.sha256(chr(0).join(parts).encode()).hexdigest()[:16]}.cubin"
    try:
        with cache.file_lock(target.with_suffix(".lock")):
            if not cache.is_sound(target):
                fresh = target.with_suffix(".new")
                fresh.write_bytes(compiled(nvrtc, source, kind, options))
                cache.seal_file(fresh, target)
            return target.read_bytes()
    except (RuntimeError, OSError) as error:
        message = native.last_line(str(error))
        notices.once("cuda", f"{source.name} for GPUs: {message}: slower tensor operations are used.")
        return None


def definitions(dtype: torch.dtype, options: Sequence[str], derive: bool) -> tuple[str, ...]:
    """Return what a compiler is told of a source: what it is told anyhow, its numbers, and whether to derive."""
    return (*options, f"-DNUMBER={_NUMBERS[dtype]}", f"-DDERIVE={int(derive)}")


def ready(source: Path, options: Sequence[str], dtype: torch.dtype) -> bool:
    """Return whether a source works on CUDA devices, for numbers of a dtype."""
    if dtype not in _NUMBERS or _nvrtc() is None:
        return False
    major, minor = torch.cuda.get_device_capability()
    return _code(source, definitions(dtype, options, False), f"sm_{major}{minor}") is not None


def _check(cuda: ctypes.CDLL, failed: int, what: str) -> None:
    if failed:
        name = ctypes.c_char_p()
        cuda.cuGetErrorString(failed, ctypes.byref(name))
        raise RuntimeError(f"CUDA kernel {what}: {(name.value or b'unknown error').decode()}")


def _enter(cuda: ctypes.CDLL, device: torch.device) -> None:
    """Let this thread use the context of torch; one in which torch has not worked yet has none."""
    context = ctypes.c_void_p()
    _check(cuda, cuda.cuCtxGetCurrent(ctypes.byref(context)), "context")
    if not context:
        _check(cuda, cuda.cuDevicePrimaryCtxRetain(ctypes.byref(context), device.index or 0), "context")
        _check(cuda, cuda.cuCtxSetCurrent(context), "context")


@functools.cache
def launcher(source: Path, options: tuple[str, ...], dtype: torch.dtype, derive: bool, device: torch.device) -> Launch:
    """Return what runs the entries of a source, or its derivatives, on a device; only where it is `ready`."""
    cuda, module = ctypes.CDLL("libcuda.so.1"), ctypes.c_void_p()
    cuda.cuLaunchKernel.argtypes = [ctypes.c_void_p, *[ctypes.c_uint] * 7, *[ctypes.c_void_p] * 3]
    major, minor = torch.cuda.get_device_capability(device)
    code = _code(source, definitions(dtype, options, derive), f"sm_{major}{minor}")
    if code is None:
        raise RuntimeError(f"{source.name}: there is no kernel for {torch.cuda.get_device_name(device)}")
    with torch.cuda.device(device):
        _enter(cuda, device)
        _check(cuda, cuda.cuModuleLoadData(ctypes.byref(module), code), source.name)

    @functools.cache
    def function(entry: str) -> ctypes.c_void_p:
        found = ctypes.c_void_p()
        _check(cuda, cuda.cuModuleGetFunction(ctypes.byref(found), module, entry.encode()), entry)
        return found

    def launch(entry: str, sizes: ctypes.Structure, fields: Fields, room: Room, blocks: int, shared: int) -> None:
        given = (ctypes.c_void_p * 3)(*(ctypes.addressof(x) for x in (sizes, fields, room)))
        with torch.cuda.device(device):
            stream = torch.cuda.current_stream().cuda_stream
            _enter(cuda, device)
            run = function(entry)
            _check(cuda, cuda.cuLaunchKernel(run, blocks, 1, 1, _LANES, 1, 1, shared, stream, given, None), entry)

    return launch


def _fields(addresses: Sequence[int | None]) -> Fields:
    fields = Fields()
    fields.at[: len(addresses)] = list(addresses)
    return fields


_memories: dict[tuple[Launch, str, tuple], tuple[int, int]] = {}


def _memory(launch: Launch, entry: str, sizes: ctypes.Structure, like: Tensor) -> tuple[int, int]:
    """Return how much memory a warp takes of what is fast, and else [bytes]; the kernel itself tells."""
    # Addresses say nothing of it, and are others in every call.
    key = launch, entry, tuple(getattr(sizes, name) for name, kind, *_ in sizes._fields_ if kind is not ctypes.c_void_p)
    if key not in _memories:
        told = torch.zeros(2, dtype=torch.int64, device=like.device)
        launch(f"{entry}_memory", sizes, _fields([told.data_ptr()]), Room(None, 0, 0), 1, 0)
        near, far = told.tolist()
        _memories[key] = near, far
    return _memories[key]


def run(
    launch: Launch, entry: str, sizes: ctypes.Structure, addresses: Sequence[int | None], scenes: int, like: Tensor
) -> None:
    """Run an entry of a source.

    Args:
        launch: what `launcher` returned.
        entry: its name.
        sizes: the struct of its sizes; addresses in it are those of the device.
        addresses: of its arrays.
        scenes: how many there are.
        like: a tensor on the device.
    """
    if scenes == 0:
        return
    near, far = _memory(launch, entry, sizes, like)
    spare = near if near > SHARED else 0
    each = max(16, far + spare)
    most = _WARPS * (torch.cuda.get_device_properties(like.device).multi_processor_count if like.is_cuda else 1)
    blocks = max(1, min(scenes, most, SCRATCH // each))
    scratch = torch.empty(blocks * each, dtype=torch.uint8, device=like.device)
    launch(entry, sizes, _fields(addresses), Room(scratch.data_ptr(), each, spare), blocks, near - spare)


@functools.cache  # recorded graphs read them for good
def integers(numbers: tuple[int, ...], device: torch.device) -> Tensor:
    """Return whole numbers on a device, which stay there."""
    return torch.tensor(numbers, dtype=torch.int64, device=device)
