"""What a machine has of what torchdlo can use, and what to do about what it lacks: `torchdlo doctor`."""

from __future__ import annotations

import json
import platform
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from packaging.requirements import Requirement

__all__ = ["Check", "doctor", "examine"]

_DEVELOPERS = ("dev", "peers")
"""Extras that users do not need."""

_PICTURE = """
import pyvista
plotter = pyvista.Plotter(off_screen=True, window_size=(64, 64))
plotter.add_mesh(pyvista.Sphere(), color="red")
image = plotter.screenshot(return_img=True)
assert len(set(map(tuple, image.reshape(-1, 3)))) > 2, "the picture is empty"
"""


@dataclass(frozen=True)
class Check:
    """One thing that was looked at."""

    name: str
    status: str
    """"ok"; "missing" if it is not there, or "broken" if it is and does not work."""
    found: str
    mend: str = ""
    """What to do about it, "" if it is well."""
    needed: bool = False
    """Whether nothing works without it."""


def examine(said: Callable[[str], None] = lambda name: None) -> list[Check]:
    """Return what was found; what is slow is looked at last.

    Args:
        said: told what is looked at next.
    """
    found = [_python(), *_core()]
    if any(check.needed and check.status != "ok" for check in found):
        return found
    steps = {
        "compiler": _compiler,
        "cache": _cache,
        "kernels": _kernels,
        "compiled steps": _compiled_steps,
        "gpu": _gpu,
        "rendering": _rendering,
        "video": _video,
    }
    for name, look in steps.items():
        said(name)
        found.append(look())
    return [*found, *_extras()]


def doctor(as_json: Annotated[bool, typer.Option("--json", help="Print what was found as JSON.")] = False) -> None:
    """Say what this machine has, and what to do about what it lacks.

    Looked at are the compiler and the kernels (which are built if they were not yet), the folder of compiled code, the
    GPU, pictures without a display, videos, and the optional packages. Exit code 0 unless something is broken without
    which nothing works.

    [bold]Example:[/bold] torchdlo doctor
    """
    checks = examine(lambda name: typer.echo(f"looking at {name}...", err=True))
    failed = any(check.needed and check.status != "ok" for check in checks)
    if as_json:
        typer.echo(json.dumps({"ok": not failed, "checks": [asdict(check) for check in checks]}, indent=1))
    else:
        width = max(len(check.name) for check in checks)
        for check in checks:
            typer.echo(f"{check.status:8}{check.name:{width + 2}}{check.found}")
            if check.mend:
                typer.echo(f"{'':{width + 10}}-> {check.mend}")
    if failed:
        raise typer.Exit(1)


def _python() -> Check:
    version = platform.python_version()
    return Check("python", "ok", f"{version} on {platform.system()} {platform.machine()}", needed=True)


def _requirements() -> Iterator[tuple[str, Requirement]]:
    """Yield the requirements of this package with the extra that they belong to, "" for those without."""
    from importlib import metadata

    from packaging.requirements import Requirement

    for line in metadata.requires("torchdlo") or []:
        requirement = Requirement(line)
        extra = re.search(r"extra == ['\"]([\w-]+)['\"]", line)
        if requirement.name != "torchdlo":
            yield extra[1] if extra else "", requirement


def _state(requirement: Requirement) -> tuple[str, str]:
    """Return how a requirement is met, and a text."""
    from importlib import metadata

    try:
        version = metadata.version(requirement.name)
    except metadata.PackageNotFoundError:
        return "missing", f"no {requirement.name}"
    if requirement.specifier.contains(version, prereleases=True):
        return "ok", f"{requirement.name} {version}"
    return "broken", f"{requirement.name} {version} (tested: {requirement.specifier})"


def _core() -> Iterator[Check]:
    from importlib import metadata

    try:
        requirements = [requirement for extra, requirement in _requirements() if not extra]
    except metadata.PackageNotFoundError:
        yield Check("torchdlo", "missing", "not installed, run from a folder", "pip install .")
        return
    for requirement in requirements:
        status, text = _state(requirement)
        # Other versions were not tested, but may work.
        needed = status == "missing"
        mend = "" if status == "ok" else f"pip install '{requirement.name}{requirement.specifier}'"
        yield Check(requirement.name, status, text, mend, needed or status == "ok")


def _extras() -> Iterator[Check]:
    from importlib import metadata

    try:
        found = list(_requirements())
    except metadata.PackageNotFoundError:
        return
    for extra in sorted({extra for extra, _ in found if extra} - set(_DEVELOPERS)):
        states = [_state(requirement) for own, requirement in found if own == extra]
        worst = next((status for status in ("broken", "missing") if status in [s for s, _ in states]), "ok")
        mend = "" if worst == "ok" else f"pip install 'torchdlo[{extra}]'"
        yield Check(f"extra {extra}", worst, ", ".join(text for _, text in states), mend)


def _compiler() -> Check:
    from torchdlo.physics.kernels import native

    found = native.compiler()
    if found is None:
        mend = "install g++ (apt install g++, or dnf install gcc-c++), or set CXX to a C++ compiler; all works without"
        return Check("compiler", "missing", "no C++ compiler that works, so slower tensor operations", mend)
    return Check("compiler", "ok", f"{' '.join(found.words)} {found.version}")


def _cache() -> Check:
    from torchdlo import cache

    wished, used = cache.wanted_folder(), cache.cache_folder()
    if used == wished:
        return Check("cache", "ok", str(used))
    mend = f"{wished}: {cache.privacy_problem(wished)}; mend that, or set TORCHDLO_CACHE to a folder of your own"
    return Check("cache", "broken", f"{used} in its place" if used else "no private folder", mend)


def _kernels() -> Check:
    from torchdlo import scene  # noqa: F401 (its modules name their kernels)
    from torchdlo.physics.kernels import native

    loaded = {name: load() is not None for name, load in sorted(native.KERNELS.items())}
    lost = [name for name, well in loaded.items() if not well]
    if not lost:
        return Check("kernels", "ok", f"{len(loaded)} built and loaded")
    if native.compiler() is None:
        return Check("kernels", "missing", "tensor operations take their place", "install a C++ compiler, see above")
    mend = "look at the warning above, or set CXX to another compiler; all works without, but slower"
    return Check("kernels", "broken", f"not built or loaded: {', '.join(lost)}", mend)


def _compiled_steps() -> Check:
    from torchdlo.physics.kernels import native

    if native.compiler() is None:
        return Check("compiled steps", "missing", "steps run without", "install a C++ compiler, see above")
    if not native.python_header().is_file():
        mend = "install the headers of Python (apt install python3-dev)"
        return Check("compiled steps", "missing", f"no {native.python_header()}; steps run without", mend)
    return Check("compiled steps", "ok", "torch.compile has what it needs")


def _gpu() -> Check:
    import torch

    if torch.cuda.is_available():
        names = {torch.cuda.get_device_name(k) for k in range(torch.cuda.device_count())}
        from torchdlo.physics.kernels import cuda

        ends = "contact in explicit steps is compiled for it" if cuda.works() else "contact by slower tensor operations"
        return Check("gpu", "ok", f"{', '.join(sorted(names))}; {ends}")
    built = torch.version.cuda or torch.version.hip
    reason = "no device that torch can use" if built else "this torch is built for the CPU"
    return Check("gpu", "missing", f"{reason}; all runs on the CPU", "see pytorch.org for a build for your device")


def _rendering() -> Check:
    from importlib import metadata

    try:
        version = metadata.version("pyvista")
    except metadata.PackageNotFoundError:
        return Check("rendering", "missing", "no pyvista, so no pictures", "pip install 'torchdlo[view]'")
    # Drivers that are missing may end the process.
    try:
        done = subprocess.run([sys.executable, "-c", _PICTURE], capture_output=True, text=True, timeout=120)
    except subprocess.TimeoutExpired:
        done = None
    if done is not None and done.returncode == 0:
        return Check("rendering", "ok", f"pyvista {version} draws without a display")
    lines = ["no picture within 120 s"]
    if done is not None:
        lines = done.stderr.strip().splitlines() or [f"ended with code {done.returncode}"]
    mend = "install a software OpenGL (apt install libgl1 libegl1 libosmesa6)"
    return Check("rendering", "broken", lines[-1], mend)


def _video() -> Check:
    from torchdlo.report.render.video_writer import CODECS

    try:
        import av
    except ImportError:
        return Check("video", "missing", "no av, so no videos", "pip install 'torchdlo[view]'")
    codecs = [name for name in CODECS if name in av.codecs_available]
    program = shutil.which("ffmpeg")
    also = f"; ffmpeg at {program}" if program else ""
    if not codecs:
        return Check("video", "broken", f"av {av.__version__} without H.264{also}", "pip install --force-reinstall av")
    return Check("video", "ok", f"av {av.__version__} with {', '.join(codecs)}{also}")
