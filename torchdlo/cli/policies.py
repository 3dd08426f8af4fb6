"""Commands of `torchdlo` that train policies and judge them; what is slow is imported when they run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from torchdlo.cli.ending import stopped
from torchdlo.cli.progress import at_work, deferred_interrupt, progress
from torchdlo.errors import InputError
from torchdlo.files import check_writable, write_atomically

if TYPE_CHECKING:
    from torchdlo.agents.rl.settings import Settings
    from torchdlo.envs import Task

__all__ = ["deploy", "evaluate", "train"]


_WRITTEN = ("result.json", "log.csv", "curve.png", "policy.pt", "checkpoint.pt")
_WRITTEN += ("robust.json", "expert.json", "clone.part", "clone.pt", "tune.part", "stages.json")
"""What training writes."""


def _quiet() -> None:
    """TorchRL tells on stderr of every buffer that it makes."""
    import logging

    import torchrl  # noqa: F401

    logging.getLogger("torchrl").setLevel(logging.WARNING)


def train(
    task: Annotated[str, typer.Argument(help="Name of the task.", metavar="TASK")],
    algo: Annotated[
        str,
        typer.Option(
            help="Hybrid makes a policy out of found trajectories; the others begin with nothing.",
            metavar="ppo|sac|shac|sapo|hybrid",
        ),
    ] = "hybrid",
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            help="Folder for policy.pt, log.csv, curve.png and what is needed to go on. Default: runs/train/TASK-ALGO, "
            "and -SEED if that is not 0.",
            metavar="DIR",
        ),
    ] = None,
    episodes: Annotated[int | None, typer.Option(min=1, help="Budget of episodes. Default: the published one.")] = None,
    minutes: Annotated[float | None, typer.Option(help="Budget of the clock. Default: 60.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of everything.")] = 0,
    count: Annotated[int | None, typer.Option(min=1, help="Episodes that are played at once.")] = None,
    fidelity: Annotated[
        str | None, typer.Option(help="Of training: published, coarse, or such as 1ms/2.", metavar="FIDELITY")
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", help="Another setting, such as rate=1e-3; may be repeated.", metavar="NAME=VALUE"),
    ] = None,
    variation: Annotated[bool, typer.Option(help="Let starts vary.")] = True,
    compiled: Annotated[
        bool, typer.Option("--compiled", help="Compile steps: minutes at first, many times faster with gradients.")
    ] = False,
    trajectory: Annotated[
        list[Path] | None,
        typer.Option(help="hybrid: what optimize found; may be repeated. Default: search one.", metavar="FILE"),
    ] = None,
    without: Annotated[
        list[str] | None,
        typer.Option(help="hybrid: a stage to leave out, robust, clone or tune; may be repeated.", metavar="STAGE"),
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the last checkpoint.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Train a policy that acts on what it sees.

    Ctrl-C keeps the best so far; a run that was stopped or killed goes on with --resume, and ends as if it had never
    stopped.

    [bold]Examples:[/bold]

    torchdlo train wiring_post --trajectory runs/optimize/wiring_post-hybrid/trajectory.json

    torchdlo train lifting --algo ppo --episodes 2000 --minutes 20 --fidelity coarse

    torchdlo evaluate runs/train/wiring_post-hybrid
    """
    from torchdlo.agents.rl.settings import preset
    from torchdlo.envs import find

    _quiet()
    out = out or Path("runs") / "train" / f"{task}-{algo}{f'-{seed}' if seed else ''}"
    for name in ("result.json", "log.csv", "curve.png"):
        if not resume:
            check_writable(out / name, mark=b"torchdlo" if name != "log.csv" else b"episodes")
    given = {"episodes": episodes, "minutes": minutes, "seed": seed, "count": count, "fidelity": fidelity}
    chosen = preset(task, algo, variation=variation, **given, **_read(settings or []))
    made = find(task)
    if algo != "hybrid" and (trajectory or without):
        raise InputError(f"--trajectory and --without: they belong to hybrid, not to {algo}; leave them out.")
    with at_work(out, *_WRITTEN):
        if algo == "hybrid":
            _hybrid(made, chosen, out, trajectory or [], without or [], resume, as_json)
        else:
            _train(made, chosen, out, resume, compiled, as_json)


def _read(pairs: list[str]) -> dict[str, Any]:
    """Return settings of NAME=VALUE, with values as in JSON."""
    found = {}
    for pair in pairs:
        name, equals, value = pair.partition("=")
        if not equals:
            raise InputError(f"--set {pair}: expected NAME=VALUE, such as rate=1e-3.")
        try:
            found[name] = json.loads(value)
        except ValueError:
            found[name] = value
        if isinstance(found[name], list):
            found[name] = tuple(found[name])
    return found


def _train(task: Task, settings: Settings, out: Path, resume: bool, compiled: bool, as_json: bool) -> None:
    from torchdlo.agents.rl.results import prepared, train_json
    from torchdlo.agents.rl.training import train as loop
    from torchdlo.report.figures.learning_curve import training_png

    trainer, played = prepared(task, settings, compiled=compiled)
    with progress() as show, deferred_interrupt(show) as callback:
        found = loop(trainer, played, settings, folder=out, resume=resume, callback=callback)
    result = train_json(task, settings, found)
    write_atomically(out / "result.json", result)
    if found.rows:
        write_atomically(out / "curve.png", training_png({f"{task.name}, {settings.algorithm}": found.rows}))
    best = f"best batch: success {found.best[0]:.0%}, return {found.best[1]:.4g}" if found.rows else "nothing learned"
    typer.echo(f"{task.name}: {found.episodes} episodes, {best}", err=as_json)
    typer.echo(f"policy: {out / 'policy.pt'}\nlog:    {out / 'log.csv'}\ncurve:  {out / 'curve.png'}", err=as_json)
    if as_json:
        typer.echo(result, nl=False)
    if found.interrupted:
        raise stopped("the best so far is kept", resume=True)


def _hybrid(
    task: Task,
    settings: Settings,
    out: Path,
    trajectories: list[Path],
    without: list[str],
    resume: bool,
    as_json: bool,
) -> None:
    from torchdlo.agents.rl.hybrid import STAGES, Hybrid, hybrid

    other = sorted(set(without) - set(STAGES))
    if other:
        raise InputError(f"--without {', '.join(other)}: expected some of {', '.join(STAGES)}.")
    if not trajectories and not (resume and (out / "expert.json").exists()):
        trajectories = [_searched(task, settings.seed, out)]
    stages = [name for name in STAGES if name not in without]
    plan = Hybrid()
    try:
        with progress() as show, deferred_interrupt(show) as callback:
            _, notes = hybrid(
                task, trajectories, settings, folder=out, plan=plan, stages=stages, resume=resume, callback=callback
            )
    except KeyboardInterrupt:
        raise stopped(f"what is done is kept in {out}", resume=True) from None
    for name in STAGES:
        if name in notes:
            spent = f"{notes[name]['episodes']} episodes, {notes[name]['cpu_seconds']:.0f} CPU s"
            typer.echo(f"{name + ':':8}{spent}", err=as_json)
    typer.echo(f"policy: {out / 'policy.pt'}", err=as_json)
    if as_json:
        typer.echo(json.dumps(notes, indent=1))


def _searched(task: Task, seed: int, out: Path) -> Path:
    """Return the file of a trajectory that is searched now, or was before."""
    from torchdlo.agents.trajopt.presets import preset
    from torchdlo.agents.trajopt.result import result_json, trajectory_json
    from torchdlo.agents.trajopt.search import optimize
    from torchdlo.agents.trajopt.task_problem import TaskProblem

    file = out / "search" / "trajectory.json"
    if file.exists():
        return file
    problem, chosen = TaskProblem(task), preset(task.name, "hybrid", seed=seed, episodes=1200)
    journal = out / "search" / "journal"
    with progress() as show, deferred_interrupt(show) as callback:
        found = optimize(problem, chosen, journal=journal, resume=journal.exists(), callback=callback)
    if not bool(found.outcome.success[0]):
        raise InputError(
            f"{task.name}: the search found no trajectory that succeeds; give one with --trajectory, or another --seed."
        )
    write_atomically(file, trajectory_json(found, problem))
    write_atomically(file.with_name("result.json"), result_json(found, problem, chosen))
    return file


def evaluate(
    policies: Annotated[
        list[Path], typer.Argument(help="Files of policies, or folders of train; several seeds of one task.")
    ],
    starts: Annotated[int, typer.Option(min=1, help="Episodes of each policy in each protocol.")] = 15,
    protocol: Annotated[
        list[str] | None,
        typer.Option(
            help="one: from the one start; varied: from unseen starts; disturbed: those with other friction.",
            metavar="one|varied|disturbed",
        ),
    ] = None,
    film: Annotated[bool, typer.Option("--film", help="Write best.mp4 and worst.mp4 of the last protocol.")] = False,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder for evaluation.json and films.", metavar="DIR")
    ] = None,
    compiled: Annotated[bool, typer.Option("--compiled", help="Compile steps instead of recording them.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the results as JSON.")] = False,
) -> None:
    """Judge policies at the published fidelity, from starts that no training has seen.

    [bold]Examples:[/bold]

    torchdlo evaluate runs/train/lifting-hybrid

    torchdlo evaluate runs/train/lifting-hybrid runs/train/lifting-hybrid-1 --protocol disturbed --film
    """
    from torchdlo.agents.rl.evaluate import PROTOCOLS
    from torchdlo.agents.rl.evaluate import evaluate as judge
    from torchdlo.agents.rl.results import load_policies, summary
    from torchdlo.envs import find

    _quiet()
    names = protocol or ["one", "varied"]
    other = sorted(set(names) - set(PROTOCOLS))
    if other:
        raise InputError(f"--protocol {', '.join(other)}: expected some of {', '.join(PROTOCOLS)}.")
    first = policies[0] if policies[0].is_dir() else policies[0].parent
    out = out or first
    check_writable(out / "evaluation.json")
    if film:
        from torchdlo.report.render.video import check_video

        for name in ("best.mp4", "worst.mp4"):
            check_video(out / name)
    found, name = load_policies(policies)
    task = find(name)
    with progress() as show, deferred_interrupt(show) as callback:
        results, plays = judge(found, task, starts=starts, protocols=names, callback=callback, compiled=compiled)
    content = json.dumps({"generator": "torchdlo evaluate", "files": [str(p) for p in policies]} | results, indent=1)
    write_atomically(out / "evaluation.json", content + "\n")
    typer.echo(summary(results), err=as_json)
    typer.echo(f"results: {out / 'evaluation.json'}", err=as_json)
    if film:
        for file in _films(task, plays[names[-1]], out):
            typer.echo(f"film:    {file}", err=as_json)
    if as_json:
        typer.echo(content)


def _films(task: Task, plays: dict[str, Any], out: Path) -> list[Path]:
    """Film the best and the worst episode; each is played again alone, with the actions that were taken."""
    import torch

    from torchdlo.envs.core import episode
    from torchdlo.report.render.episode_film import film
    from torchdlo.report.render.video import write_video

    success, returns = plays["success"].flatten(), plays["returns"].flatten()
    order = sorted(range(len(success)), key=lambda k: (bool(success[k]), float(returns[k])))
    actions, moved = plays["actions"].flatten(0, 1), plays["moved"].flatten(0, 1)
    files = []
    for name, k in {"best.mp4": order[-1], "worst.mp4": order[0]}.items():
        with torch.no_grad():
            made = episode.prepare_at(task, moved[k : k + 1], compiled=False, recorded=True)
            frames, _ = film(task, actions[k], made=made)
        with progress() as show, deferred_interrupt(show) as callback:
            write_video(frames, out / name, speed=0.5, callback=callback)
        files.append(out / name)
    return files


def deploy(
    source: Annotated[
        Path, typer.Argument(help="What optimize or train found: trajectory.json, policy.pt or its folder.")
    ],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="File to write. Default: beside the source.")] = None,
    kind: Annotated[
        str, typer.Option("--format", help="ros2 has the shape of trajectory_msgs.", metavar="csv|json|ros2")
    ] = "csv",
    reset_seed: Annotated[
        int | None, typer.Option(min=0, help="Seed of a start that differs from the usual one.", metavar="SEED")
    ] = None,
    urdf: Annotated[
        Path | None, typer.Option(help="Arms of another kind, which follow the tools' path.", metavar="FILE")
    ] = None,
    tool: Annotated[str | None, typer.Option(help="Link of that arm that is the tool.", metavar="LINK")] = None,
    speed: Annotated[float, typer.Option(help="Share of the joints' greatest speeds to use.")] = 1.0,
    acceleration: Annotated[float, typer.Option(help="Greatest acceleration of a joint in rad/s^2.")] = 10.0,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Play the file in the simulator.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print what it came to as JSON.")] = False,
) -> None:
    """Write joint positions and velocities for real arms.

    Positions are checked against the limits of the joints; the motion is slowed down evenly where speeds are too great.
    Of a policy, it is what it does in one simulated episode.

    [bold]Examples:[/bold]

    torchdlo deploy runs/optimize/coiling-hybrid/trajectory.json --format ros2 --dry-run

    torchdlo deploy runs/train/lifting-hybrid --reset-seed 3 --speed 0.5
    """
    import torch

    from torchdlo.agents import deployment
    from torchdlo.agents.policies import Policy

    if kind not in deployment.FORMATS:
        raise InputError(f"--format {kind}: expected one of {', '.join(deployment.FORMATS)}.")
    task, what = _source(source)
    folder = source if source.is_dir() else source.parent
    out = out or folder / ("joints.csv" if kind == "csv" else f"joints-{kind}.json")
    marks = {"csv": b"time,", "json": b"torchdlo", "ros2": b"joint_names"}
    check_writable(out, mark=marks[kind])
    robots = deployment.arms_of(task, urdf, tool)
    seeded = torch.Generator().manual_seed(reset_seed or 0)
    moved = task.moved(1, generator=seeded, variation=reset_seed is not None)
    path, good = deployment.played(task, what, moved)
    motion = deployment.timed(task, robots, path, same=urdf is None, share=speed, acceleration=acceleration)
    said: dict[str, Any] = {"task": task.name, "success": good, "slower": motion.slower}
    said |= {"seconds": float(motion.time[-1]), "points": len(motion.time), "reset_seed": reset_seed}
    write_atomically(out, deployment.text(motion, kind, said))
    if dry_run:
        said["dry_run_success"] = deployment.replayed(task, robots, motion.position, moved)
    what_for = "policy" if isinstance(what, Policy) else "trajectory"
    how = "success" if good else "no success"
    typer.echo(
        f"{task.name}: {how} of the {what_for} in the simulation; {said['seconds']:.2f} s, {motion.slower:.2f} times "
        "as long as there",
        err=as_json,
    )
    if dry_run:
        typer.echo(f"dry run: {'success' if said['dry_run_success'] else 'no success'}", err=as_json)
    typer.echo(f"joints: {out}", err=as_json)
    if as_json:
        typer.echo(json.dumps(said | {"file": str(out)}, indent=1))


def _source(path: Path) -> tuple[Task, Any]:
    """Return the task, and the actions of a trajectory (T, A) or a policy."""
    from torchdlo.agents.policies import load
    from torchdlo.agents.trajopt.result import load_actions
    from torchdlo.agents.trajopt.task_problem import TaskProblem
    from torchdlo.envs import find

    if path.is_dir() or path.suffix != ".json":
        policy = load(path)
        return find(policy.spec.task), policy
    try:
        name = json.loads(path.read_text(encoding="utf-8"))["task"]
    except (OSError, ValueError, KeyError, TypeError):
        raise InputError(f"{path}: expected a trajectory of torchdlo optimize, found something else.") from None
    problem = TaskProblem(find(name), compiled=False)
    return problem.task, problem.full(load_actions(path, problem))
