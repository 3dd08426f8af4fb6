"""Commands of `torchdlo` that run and show scenes; like all of them they import what is slow only when they run."""

from __future__ import annotations

import json
import shlex
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from torchdlo.cli.progress import deferred_interrupt, progress
from torchdlo.files import check_writable, write_atomically

if TYPE_CHECKING:
    from torchdlo.scene_files.run import Frames

__all__ = ["design_experiment", "optimize", "play", "simulate", "tasks", "view"]

_INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells have it."""

_Rope = Annotated[
    Path | None,
    typer.Option(help="What ropes are made of: model.json of a calibration or diagnosis.", metavar="MODEL"),
]
_Resume = Annotated[bool, typer.Option("--resume", help="Go on from the journal of a search that was stopped.")]


def simulate(
    scene: Annotated[Path, typer.Argument(help="Scene file, see docs/scenes.md.", metavar="SCENE")],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Folder for frames.npz and pictures. Default: runs/simulate/NAME."),
    ] = None,
    every: Annotated[int, typer.Option(min=1, help="Steps per kept frame.")] = 10,
    video: Annotated[bool, typer.Option("--video", help="Write motion.mp4, too.")] = False,
    picture: Annotated[bool, typer.Option("--picture", help="Write picture.png, too: start, middle and end.")] = False,
    speed: Annotated[float, typer.Option(min=0.001, help="Seconds of the run per second of the video.")] = 1.0,
    compiled: Annotated[
        bool, typer.Option("--compiled", help="Compile the step: a minute at first, then many times faster.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print a summary as JSON.")] = False,
) -> None:
    """Run a scene file, and keep its frames and a picture of the shapes.

    Ctrl-C stops and keeps the frames so far; while the video is made, it stops that.

    [bold]Examples:[/bold]

    torchdlo simulate lift.json --out runs/lift --video

    torchdlo view runs/lift
    """
    from torchdlo.errors import InputError
    from torchdlo.scene_files import read
    from torchdlo.scene_files.run import run, save_frames

    described = read(scene)
    out = out or Path("runs") / "simulate" / scene.stem
    files = _check_files(out, video=video, picture=picture)
    try:
        with progress() as show, deferred_interrupt(show) as callback:
            frames = run(described, folder=scene.parent, every=every, compiled=compiled, callback=callback)
    except KeyboardInterrupt:
        typer.echo("interrupted before there was a result; nothing was written", err=True)
        raise typer.Exit(_INTERRUPTED) from None
    except ValueError as error:
        raise InputError(f"{scene}: {error}") from None
    save_frames(frames, files["frames"], described)
    made = _draw(frames, files, scene.stem, speed)
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
    if frames.interrupted or not made:
        raise typer.Exit(_INTERRUPTED)


def _check_files(out: Path, *, video: bool, picture: bool) -> dict[str, Path]:
    """Return what is to be written, and refuse before the work what could not be written after it."""
    files = {"frames": out / "frames.npz", "shapes": out / "shapes.png"}
    if picture:
        files["picture"] = out / "picture.png"
    for file in files.values():
        check_writable(file)
    if video:
        from torchdlo.report.render.video import check_video

        files["video"] = out / "motion.mp4"
        check_video(files["video"])
    if video or picture:
        from torchdlo.report.render.picture import check_renderer

        check_renderer()
    return files


def _draw(frames: Frames, files: dict[str, Path], title: str, speed: float) -> bool:
    """Write pictures and video; return whether they all were."""
    from torchdlo.report.figures.motion_figure import motion_png

    flat = motion_png(frames.time, frames.pos, frames.rope, frames.body_pos, title=title)
    write_atomically(files["shapes"], flat)
    if "picture" in files:
        from torchdlo.report.render.picture import stills_png

        write_atomically(files["picture"], stills_png(frames))
    if "video" not in files:
        return True
    from torchdlo.report.render.video import write_video

    return _finished(lambda callback: write_video(frames, files["video"], speed=speed, callback=callback))


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
    viewer.wait()


def optimize(
    task: Annotated[str, typer.Argument(help="Name of the task.", metavar="TASK")],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            help="Folder for result.json, trajectory.json and curve.png. Default: runs/optimize/TASK-METHOD, "
            "and -SEED if that is not 0.",
            metavar="DIR",
        ),
    ] = None,
    method: Annotated[
        str,
        typer.Option(help="CMA-ES, gradient descent, or both with a search for contact.", metavar="cmaes|gd|hybrid"),
    ] = "hybrid",
    episodes: Annotated[
        int | None, typer.Option(min=1, help="Budget; an episode counts once, with its slope or without.")
    ] = None,
    population: Annotated[int | None, typer.Option(min=1, help="Trajectories per iteration.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the search.")] = 0,
    robust: Annotated[
        bool, typer.Option("--robust", help="Play each trajectory from several starts that grow apart.")
    ] = False,
    rope: _Rope = None,
    double: Annotated[bool, typer.Option("--double", help="Physics in double precision.")] = False,
    compiled: Annotated[bool, typer.Option(help="Compile the step: slow at first, then many times faster.")] = True,
    recorded: Annotated[
        bool, typer.Option("--recorded", help="Record the step instead: takes seconds, helps where cmaes searches.")
    ] = False,
    resume: _Resume = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Search the trajectory of the tools that earns most in a task.

    Budget, way-points and first steps that are not given are the published ones of the task: up to 20 000 episodes,
    each of which may take some seconds. Ctrl-C keeps the best so far; a search that was stopped or killed goes on with
    --resume, and ends as if it had never stopped. Without it, a search begins anew and what was stopped is lost.

    [bold]Examples:[/bold]

    torchdlo optimize coiling --episodes 600 --out runs/coil

    torchdlo optimize wiring_post --method cmaes --seed 1 --episodes 4000 --population 100

    torchdlo optimize wiring_post --robust --resume
    """
    from torchdlo.agents.trajopt.presets import preset
    from torchdlo.agents.trajopt.result import result_json, summary, trajectory_json
    from torchdlo.agents.trajopt.search import Robust
    from torchdlo.agents.trajopt.search import optimize as search
    from torchdlo.agents.trajopt.search_journal import remove
    from torchdlo.agents.trajopt.task_problem import problem
    from torchdlo.report.figures.learning_curve import learning_png
    from torchdlo.scene_files import cable

    out = out or Path("runs") / "optimize" / f"{task}-{method}{f'-{seed}' if seed else ''}"
    for name in ("result.json", "trajectory.json", "curve.png"):
        check_writable(out / name)
    steps = {"compiled": compiled and not recorded, "recorded": recorded}
    chosen = problem(task, None if rope is None else cable(rope), double=double, **steps)
    given = {"episodes": episodes, "population": population, "robust": Robust() if robust else None, "seed": seed}
    settings = preset(task, method, **given)
    try:
        with progress() as show, deferred_interrupt(show) as callback:
            found = search(chosen, settings, journal=out / "journal", resume=resume, callback=callback)
    except KeyboardInterrupt:
        typer.echo(f"interrupted before there was a result; --resume goes on from {out / 'journal'}", err=True)
        raise typer.Exit(_INTERRUPTED) from None
    result = result_json(found, chosen, settings)
    write_atomically(out / "trajectory.json", trajectory_json(found, chosen))
    write_atomically(out / "result.json", result)
    write_atomically(out / "curve.png", learning_png({f"{task}, seed {seed}": {method: [found.curve]}}))
    if not found.interrupted:
        remove(out / "journal")
    typer.echo(summary(found, task), err=as_json)
    typer.echo(f"result:     {out / 'result.json'}\ntrajectory: {out / 'trajectory.json'}", err=as_json)
    typer.echo(f"curve:      {out / 'curve.png'}", err=as_json)
    if as_json:
        typer.echo(result, nl=False)
    if found.interrupted:
        typer.echo(f"--resume goes on from {out / 'journal'}", err=True)
        raise typer.Exit(_INTERRUPTED)


def tasks(as_json: Annotated[bool, typer.Option("--json", help="Print the list as JSON.")] = False) -> None:
    """List the manipulation tasks: what there is to do, with how many arms, in how many actions.

    [bold]Example:[/bold] torchdlo tasks --json
    """
    from torchdlo.envs import listing

    rows = listing()
    if as_json:
        typer.echo(json.dumps(rows, indent=1))
        return
    for row in rows:
        arms = "1 arm" if row["arms"] == 1 else f"{row['arms']} arms"
        typer.echo(f"{row['name']:<12} {row['what']} ({arms}, {row['actions']} actions of {row['seconds']:g} s)")


def play(
    task: Annotated[str, typer.Argument(help="Name of the task.", metavar="TASK")],
    trajectory: Annotated[
        Path | None,
        typer.Option(help="What optimize found. Default: the way by hand.", metavar="FILE"),
    ] = None,
    idle: Annotated[bool, typer.Option("--idle", help="Do nothing.")] = False,
    vary: Annotated[
        int | None, typer.Option(min=0, help="Seed of a start that differs from the usual one.", metavar="SEED")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Folder for frames.npz and pictures. Default: runs/play/TASK.", metavar="DIR"),
    ] = None,
    video: Annotated[bool, typer.Option("--video", help="Write motion.mp4, too.")] = False,
    picture: Annotated[bool, typer.Option("--picture", help="Write picture.png, too: start, middle and end.")] = False,
    speed: Annotated[float, typer.Option(min=0.001, help="Seconds of the episode per second of the video.")] = 0.5,
    arms: Annotated[bool, typer.Option(help="Show the arms.")] = True,
    rope: _Rope = None,
    compiled: Annotated[
        bool,
        typer.Option(
            "--compiled",
            help="Compile the step instead of recording it: minutes at first. "
            "A trajectory is played with the steps with which it was found.",
        ),
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print how it went as JSON.")] = False,
) -> None:
    """Play an episode of a task, say what it earns, and keep frames to look at. Ctrl-C stops and keeps those so far.

    [bold]Examples:[/bold]

    torchdlo play wrapping --video

    torchdlo play coiling --trajectory runs/optimize/coiling-hybrid/trajectory.json --picture

    torchdlo view runs/play/wrapping
    """
    from torchdlo.agents.trajopt.script import script
    from torchdlo.errors import InputError
    from torchdlo.report.render.episode_film import film, outcome_of
    from torchdlo.scene_files import cable
    from torchdlo.scene_files.run import save_frames

    if idle and trajectory is not None:
        raise InputError("--idle and --trajectory: expected one of them, or neither for the way by hand.")
    files = _check_files(out or Path("runs") / "play" / task, video=video, picture=picture)
    played = script(task, trajectory, None if rope is None else cable(rope), idle=idle, vary=vary, compiled=compiled)
    with progress() as show, deferred_interrupt(show) as callback:
        frames, went = film(played.task, played.actions, made=played.episode, arms=arms, callback=callback)
    save_frames(frames, files["frames"])
    drawn = _draw(frames, files, task, speed) and went is not None
    said = outcome_of(went) | {"files": [str(file) for file in files.values() if file.exists()]}
    how = "failed" if said["failed"] else "success" if said["success"] else "no success"
    earned = "interrupted" if went is None else f"return {said['return']:.4g}, {how}"
    missed = f"; do not trust it: {said['missed']}" if said["missed"] else ""
    typer.echo(f"{task}: {earned}{missed}", err=as_json)
    typer.echo("\n".join(said["files"]), err=as_json)
    if as_json:
        typer.echo(json.dumps(said, indent=1))
    if not drawn:
        raise typer.Exit(_INTERRUPTED)


def design_experiment(
    recording: Annotated[
        Path,
        typer.Argument(help="Recording folder: rope.json, train_*.npz and test_*.npz.", metavar="PATH"),
    ],
    findings: Annotated[
        Path | None,
        typer.Option(
            help="Folder of a finished diagnosis. Default: runs/diagnose/NAME, unless --names are given.",
            metavar="DIR",
        ),
    ] = None,
    names: Annotated[
        str, typer.Option(help="Effects to tell apart, with commas. Default: those that tie in the findings.")
    ] = "",
    seconds: Annotated[float, typer.Option(help="How long the motion lasts.")] = 3.0,
    scale: Annotated[
        float, typer.Option(help="Factor by which it may leave the workspace, and exceed the speeds, of the recording.")
    ] = 1.0,
    tip_mass: Annotated[
        float, typer.Option(help="Known mass in kg that can be hung on the rope's free end, or its middle.")
    ] = 0.0,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            help="Folder for design.json, motion.npz, report.html and design.png. Default: runs/design/NAME.",
            metavar="DIR",
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the search.")] = 0,
    vertices: Annotated[int | None, typer.Option(min=3, help="Vertices of the simulated rope.")] = None,
    workers: Annotated[int | None, typer.Option(min=1, help="Processes; one per core if not given.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the design as JSON.")] = False,
    resume: _Resume = False,
) -> None:
    """Find the motion of the grippers that tells apart effects which a recording cannot.

    Ctrl-C stops after the running step; --resume goes on from there.

    [bold]Examples:[/bold]

    torchdlo design-experiment my_rope

    torchdlo design-experiment my_rope --names wind,tilted_gravity --seconds 4
    """
    from torchdlo.errors import InputError
    from torchdlo.report.pages import design as report
    from torchdlo.sysid.experiment_design import design as designs
    from torchdlo.sysid.recordings.recording import load_recording

    loaded = load_recording(recording)
    asked, name = [n.strip() for n in names.split(",") if n.strip()], recording.resolve().name
    if findings is None and not asked:
        findings = Path("runs") / "diagnose" / name
    out = out or Path("runs") / "design" / name
    for file in report.FILES[:-1]:
        check_writable(out / file)
    if (out / "motion.npz").exists() and not (out / "design.json").exists():
        raise InputError(f"{out / 'motion.npz'}: exists without design.json; move it away or choose another --out.")
    options = {"seconds": seconds, "scale": scale, "mass": tip_mass, "seed": seed}
    journal = out / "journal"
    options |= {"vertices": vertices, "workers": workers, "journal": journal, "resume": resume}
    try:
        with progress() as show, deferred_interrupt(show) as callback:
            design = designs.design_experiment(loaded, asked, findings=findings, callback=callback, **options)
    except KeyboardInterrupt:
        typer.echo(f"interrupted before there was a result; --resume goes on from {journal}", err=True)
        raise typer.Exit(_INTERRUPTED) from None
    report.write_design(design, out, command=shlex.join(["torchdlo", *sys.argv[1:]]))
    shutil.rmtree(journal, ignore_errors=True)
    typer.echo(f"{designs.summary(design)}\n", err=as_json)
    typer.echo("\n".join(f"- {said}" for said in designs.rationale(design)), err=as_json)
    typer.echo(f"\n{report.design_table(design)}\n", err=as_json)
    typer.echo(f"motion: {out / 'motion.npz'}\nreport: {out / 'report.html'}", err=as_json)
    if as_json:
        typer.echo(designs.design_json(design), nl=False)
