"""Commands of `torchdlo` that run scenes; like all of them they import what is slow only when they run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from torchdlo.files import check_writable, write_atomically
from torchdlo.progress import deferred_interrupt, progress

__all__ = ["simulate"]

_INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells have it."""


def simulate(
    scene: Annotated[Path, typer.Argument(help="Scene file, see docs/scenes.md.", metavar="SCENE")],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Folder for frames.npz and shapes.png. Default: runs/simulate/NAME."),
    ] = None,
    every: Annotated[int, typer.Option(min=1, help="Steps per kept frame.")] = 10,
    compiled: Annotated[
        bool, typer.Option("--compiled", help="Compile the step: a minute at first, then many times faster.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print a summary as JSON.")] = False,
) -> None:
    """Run a scene file, and keep its frames and a picture of the shapes.

    Ctrl-C stops and keeps the frames so far.

    [bold]Example:[/bold] torchdlo simulate lift.json --out runs/lift
    """
    from torchdlo.describe import read
    from torchdlo.errors import InputError
    from torchdlo.report.motion import motion_png
    from torchdlo.run import run, save_frames

    described = read(scene)
    out = out or Path("runs") / "simulate" / scene.stem
    for name in ("frames.npz", "shapes.png"):
        check_writable(out / name)
    try:
        with progress() as show, deferred_interrupt(show) as callback:
            frames = run(described, every=every, compiled=compiled, callback=callback)
    except KeyboardInterrupt:
        typer.echo("interrupted before there was a result; nothing was written", err=True)
        raise typer.Exit(_INTERRUPTED) from None
    except ValueError as error:
        raise InputError(f"{scene}: {error}") from None
    save_frames(frames, described, out / "frames.npz")
    picture = motion_png(frames.time, frames.pos, frames.rope, frames.body_pos, title=scene.stem)
    write_atomically(out / "shapes.png", picture)
    typer.echo(f"{scene}: {len(frames.time)} frames, {frames.time[-1]:g} s", err=as_json)
    typer.echo(f"frames:  {out / 'frames.npz'}\npicture: {out / 'shapes.png'}", err=as_json)
    if as_json:
        summary = {
            "frames": len(frames.time),
            "time": float(frames.time[-1]),
            "interrupted": frames.interrupted,
            "problem": frames.problem,
            "files": [str(out / "frames.npz"), str(out / "shapes.png")],
        }
        typer.echo(json.dumps(summary, indent=1))
    if frames.problem:
        typer.echo(f"error: {frames.problem}", err=True)
        raise typer.Exit(1)
    if frames.interrupted:
        raise typer.Exit(_INTERRUPTED)
