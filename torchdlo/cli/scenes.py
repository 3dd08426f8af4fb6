"""Commands that run and show scenes; what is slow to import is imported when they run."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from torchdlo.cli.ending import stopped
from torchdlo.cli.options import ExecutionOption, PhotoOption, execution_choice
from torchdlo.cli.progress import deferred_interrupt, progress
from torchdlo.errors import InputError
from torchdlo.files import check_writable, write_atomically

if TYPE_CHECKING:
    from torchdlo.scene_files.run import Frames

__all__ = ["check_files", "draw", "simulate", "view"]


def simulate(
    scene: Annotated[Path, typer.Argument(help="Scene file, see docs/scenes.md.", metavar="SCENE")],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Folder for frames.npz and pictures. Default: runs/simulate/NAME."),
    ] = None,
    frame_stride: Annotated[int, typer.Option(min=1, help="Steps per kept frame.")] = 10,
    video: Annotated[bool, typer.Option("--video", help="Write motion.mp4, too.")] = False,
    picture: Annotated[bool, typer.Option("--picture", help="Write picture.png, too: start, middle and end.")] = False,
    photo: PhotoOption = False,
    speed: Annotated[float, typer.Option(min=0.001, help="Seconds of the run per second of the video.")] = 1.0,
    execution: ExecutionOption = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print a summary as JSON.")] = False,
) -> None:
    """Run a scene file, and keep its frames and a picture of the shapes.

    Ctrl-C stops and keeps the frames so far; while the video is made, it stops that.

    [bold]Examples:[/bold]

    torchdlo simulate lift.json --out runs/lift --video

    torchdlo view runs/lift
    """
    from torchdlo.scene_files import read
    from torchdlo.scene_files.run import run, save_frames

    described = read(scene)
    out = out or Path("runs") / "simulate" / scene.stem
    files = check_files(out, video=video, picture=picture, photo=photo)
    how = execution_choice(execution) or "recorded"
    try:
        with progress() as show, deferred_interrupt(show) as callback:
            frames = run(described, folder=scene.parent, frame_stride=frame_stride, execution=how, callback=callback)
    except KeyboardInterrupt:
        raise stopped("there was no result yet, and nothing was written") from None
    except ValueError as error:
        raise InputError(f"{scene}: {error}") from None
    remove_older(files)
    save_frames(frames, files["frames"], described)
    made = draw(frames, files, scene.stem, speed, photo)
    typer.echo(f"{scene}: {len(frames.time)} frames, {frames.time[-1]:g} s", err=as_json)
    for name, file in files.items():
        typer.echo(f"{name + ':':9}{file}" if file.exists() else f"{name + ':':9}none", err=as_json)
    if as_json:
        summary = {
            "frames": len(frames.time),
            "time": float(frames.time[-1]),
            "interrupted": frames.interrupted or not made,
            "problem": frames.problem,
            "files": [str(file) for file in files.values() if file.exists()],
        }
        typer.echo(json.dumps(summary, indent=1))
    if frames.problem:
        typer.echo(f"error: {frames.problem}", err=True)
        raise typer.Exit(1)
    if frames.interrupted:
        raise stopped(f"the frames so far are in {files['frames']}")
    if not made:
        raise stopped("the video was not made")


def check_files(out: Path, *, video: bool, picture: bool, photo: bool) -> dict[str, Path]:
    """Return what is to be written, and refuse before the work what could not be written after it."""
    files = {"frames": out / "frames.npz", "shapes": out / "shapes.png"}
    if picture or photo:
        files["picture"] = out / "picture.png"
    for file in files.values():
        check_writable(file)
    if video:
        from torchdlo.report.render.video_writer import check_video

        files["video"] = out / "motion.mp4"
        check_video(files["video"])
    if photo:
        from torchdlo.report.render.photo import check_photo

        check_photo()
    elif video or picture:
        from torchdlo.report.render.picture import check_renderer

        check_renderer()
    return files


OUTPUTS = ("shapes.png", "picture.png", "motion.mp4")
"""What a run may leave beside its frames."""


def remove_older(files: dict[str, Path]) -> None:
    """Remove what an earlier run left beside the frames, so that all in the folder is of one run."""
    for name in OUTPUTS:
        files["frames"].with_name(name).unlink(missing_ok=True)


def draw(frames: Frames, files: dict[str, Path], title: str, speed: float, photo: bool) -> bool:
    """Write pictures and video; return whether they all were."""
    from torchdlo.report.figures.motion_figure import motion_png

    flat = motion_png(frames.time, frames.pos, frames.rope, frames.body_pos, title=title)
    write_atomically(files["shapes"], flat)
    if "picture" in files:
        from torchdlo.report.render.picture import stills_png

        write_atomically(files["picture"], stills_png(frames, photo=photo))
    if "video" not in files:
        return True
    from torchdlo.report.render.video_writer import write_video

    return _finished(lambda callback: write_video(frames, files["video"], speed=speed, photo=photo, callback=callback))


def _finished(work: Callable[[Callable[[str, int, int, str], None]], None]) -> bool:
    """Do work that shows its progress; return whether it was not stopped."""
    try:
        with progress() as show, deferred_interrupt(show) as callback:
            work(callback)
    except KeyboardInterrupt:
        return False
    return True


def view(
    path: Annotated[Path, typer.Argument(help="Folder that simulate wrote, or its frames.npz.", metavar="RUN")],
    port: Annotated[int, typer.Option(min=1, max=65535, help="Port; the next free one if it is taken.")] = 8080,
    host: Annotated[str, typer.Option(help="Address; 0.0.0.0 lets other machines see it, too.")] = "127.0.0.1",
) -> None:
    """Show a run in the browser: turn, play, pause, scrub. Ctrl-C ends it.

    [bold]Example:[/bold] torchdlo view runs/lift
    """
    from torchdlo.report.viewer.server import Viewer
    from torchdlo.scene_files.run import load_frames

    viewer = Viewer(load_frames(path), title=str(path), host=host, port=port)
    typer.echo(f"{path}: open {viewer.address} (Ctrl-C ends it)")
    try:
        viewer.wait()
    except KeyboardInterrupt:
        raise stopped("the page is served no more") from None
