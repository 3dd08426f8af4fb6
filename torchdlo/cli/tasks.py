"""Commands of the manipulation tasks: list, play, optimise; what is slow to import is imported when they run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from torchdlo.cli.ending import stopped
from torchdlo.cli.options import ExecutionOption, PhotoOption, ResumeOption, RopeModelOption, execution_choice
from torchdlo.cli.progress import at_work, deferred_interrupt, progress
from torchdlo.cli.scenes import check_files, draw, remove_older
from torchdlo.errors import InputError
from torchdlo.files import check_writable, write_atomically

__all__ = ["optimize", "play", "tasks"]


def tasks(as_json: Annotated[bool, typer.Option("--json", help="Print the list as JSON.")] = False) -> None:
    """List the manipulation tasks: what there is to do, with how many arms, in how many actions.

    [bold]Example:[/bold] torchdlo tasks --json
    """
    from torchdlo.envs import list_tasks

    rows = list_tasks()
    if as_json:
        typer.echo(json.dumps(rows, indent=1))
        return
    for row in rows:
        arms = "1 arm" if row["arms"] == 1 else f"{row['arms']} arms"
        typer.echo(f"{row['name']:<12} {row['what']} ({arms}, {row['actions']} actions of {row['seconds']:g} s)")


def play(
    task: Annotated[str, typer.Argument(help="Name of the task, or FILE.py:CLASS for your own.", metavar="TASK")],
    trajectory: Annotated[
        Path | None,
        typer.Option(help="What optimize found. Default: the scripted demonstration.", metavar="FILE"),
    ] = None,
    no_op: Annotated[bool, typer.Option("--no-op", help="Do nothing: all actions are zero.")] = False,
    reset_seed: Annotated[
        int | None,
        typer.Option(
            min=0, max=10**9, help="Seed of a reset with noise; without it, the nominal start.", metavar="SEED"
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Folder for frames.npz and pictures. Default: runs/play/TASK.", metavar="DIR"),
    ] = None,
    video: Annotated[bool, typer.Option("--video", help="Write motion.mp4, too.")] = False,
    picture: Annotated[bool, typer.Option("--picture", help="Write picture.png, too: start, middle and end.")] = False,
    photo: PhotoOption = False,
    speed: Annotated[float, typer.Option(min=0.001, help="Seconds of the episode per second of the video.")] = 0.5,
    arms: Annotated[bool, typer.Option(help="Show the arms.")] = True,
    rope_model: RopeModelOption = None,
    execution: ExecutionOption = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print how it went as JSON.")] = False,
) -> None:
    """Play an episode of a task, say what it earns, and keep frames to look at. Ctrl-C stops and keeps those so far.

    [bold]Examples:[/bold]

    torchdlo play wrapping --video

    torchdlo play coiling --trajectory runs/optimize/coiling-hybrid/trajectory.json --picture

    torchdlo play my_tasks.py:Reaching --no-op

    torchdlo view runs/play/wrapping
    """
    from torchdlo.agents.trajopt.script import script
    from torchdlo.envs import short_name
    from torchdlo.report.render.episode_film import film, outcome_of
    from torchdlo.scene_files import cable
    from torchdlo.scene_files.run import save_frames

    if no_op and trajectory is not None:
        raise InputError("--no-op and --trajectory: expected one of them, or neither for the scripted demonstration.")
    files = check_files(out or Path("runs") / "play" / short_name(task), video=video, picture=picture, photo=photo)
    played = script(
        task,
        trajectory,
        None if rope_model is None else cable(rope_model),
        no_op=no_op,
        reset_seed=reset_seed,
        execution=execution_choice(execution),
    )
    with progress() as show, deferred_interrupt(show) as callback:
        frames, went = film(played.task, played.actions, made=played.episode, arms=arms, callback=callback)
    remove_older(files)
    save_frames(frames, files["frames"])
    drawn = draw(frames, files, task, speed, photo) and went is not None
    said = outcome_of(went) | {"files": [str(file) for file in files.values() if file.exists()]}
    how = "failed" if said["failed"] else "success" if said["success"] else "no success"
    earned = "interrupted" if went is None else f"return {said['return']:.4g}, {how}"
    missed = f"; do not trust it: {said['missed']}" if said["missed"] else ""
    typer.echo(f"{task}: {earned}{missed}", err=as_json)
    typer.echo("\n".join(said["files"]), err=as_json)
    if as_json:
        typer.echo(json.dumps(said, indent=1))
    if not drawn:
        raise stopped("what is done so far is kept")


def optimize(
    task: Annotated[str, typer.Argument(help="Name of the task, or FILE.py:CLASS for your own.", metavar="TASK")],
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
        int | None, typer.Option(min=1, help="Budget; an episode counts once, with its gradient or without.")
    ] = None,
    population: Annotated[int | None, typer.Option(min=1, help="Trajectories per iteration.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the search.")] = 0,
    robust: Annotated[
        bool, typer.Option("--robust", help="Play each trajectory from several starts that grow apart.")
    ] = False,
    rope_model: RopeModelOption = None,
    grasps: Annotated[
        Path | None,
        typer.Option(help="What hands hold: proposal.json of propose, if not what the task says.", metavar="FILE"),
    ] = None,
    reward: Annotated[
        Path | None,
        typer.Option(help="Reward of expressions, if not the task's; see docs/reward_language.md.", metavar="FILE"),
    ] = None,
    dtype: Annotated[str, typer.Option(help="Precision of the physics.", metavar="float32|float64")] = "float32",
    execution: ExecutionOption = None,
    resume: ResumeOption = False,
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

    torchdlo optimize lifting --grasps runs/propose/lifting-candidate/proposal.json --reward reward.json
    """
    from torchdlo.agents.trajopt.presets import search_preset
    from torchdlo.agents.trajopt.search import Robust
    from torchdlo.agents.trajopt.search import optimize as search
    from torchdlo.agents.trajopt.search_journal import remove_journal
    from torchdlo.agents.trajopt.search_result import result_json, search_summary, trajectory_json
    from torchdlo.agents.trajopt.task_problem import task_problem
    from torchdlo.envs import short_name
    from torchdlo.report.figures.learning_curve import learning_png
    from torchdlo.scene_files import cable

    out = out or Path("runs") / "optimize" / f"{short_name(task)}-{method}{f'-{seed}' if seed else ''}"
    names = ("result.json", "trajectory.json", "curve.png")
    for name in names:
        check_writable(out / name)
    steps: dict[str, Any] = {"execution": execution_choice(execution) or "compiled"}
    steps |= {"double": _is_double(dtype)} | _judged(task, grasps, reward)
    chosen = task_problem(task, None if rope_model is None else cable(rope_model), **steps)
    given = {"episodes": episodes, "population": population, "robust": Robust() if robust else None, "seed": seed}
    settings = search_preset(task, method, **given)
    with at_work(out, *names):
        try:
            with progress() as show, deferred_interrupt(show) as callback:
                found = search(chosen, settings, journal=out / "journal", resume=resume, callback=callback)
        except KeyboardInterrupt:
            raise stopped(f"there was no result yet, and what is done is kept in {out / 'journal'}", True) from None
        result = result_json(found, chosen, settings)
        write_atomically(out / "trajectory.json", trajectory_json(found, chosen))
        write_atomically(out / "result.json", result)
        write_atomically(out / "curve.png", learning_png({f"{task}, seed {seed}": {method: [found.curve]}}))
        if not found.interrupted:
            remove_journal(out / "journal")
    typer.echo(search_summary(found, task), err=as_json)
    typer.echo(f"result:     {out / 'result.json'}\ntrajectory: {out / 'trajectory.json'}", err=as_json)
    typer.echo(f"curve:      {out / 'curve.png'}", err=as_json)
    if as_json:
        typer.echo(result, nl=False)
    if found.interrupted:
        raise stopped("the best so far is kept", resume=True)


def _judged(task: str, grasps: Path | None, reward: Path | None) -> dict[str, Any]:
    """Return what hands hold and what earns, as files say."""
    found: dict[str, Any] = {}
    if grasps is not None:
        from torchdlo.agents.vlm.grasp_proposal import load_grasps
        from torchdlo.envs import find

        found["grasps"] = load_grasps(grasps, find(task).name)
    if reward is not None:
        from torchdlo.reward_language import load_reward

        found["reward"] = load_reward(reward)
    return found


def _is_double(dtype: str) -> bool:
    """Return whether a name is that of double precision, and refuse one that is of none."""
    if dtype not in ("float32", "float64"):
        raise InputError(f"--dtype: expected float32 or float64, given {dtype!r}.")
    return dtype == "float64"
