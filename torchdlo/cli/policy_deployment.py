"""Commands of `torchdlo` that hand policies on: to a student, to other programs, to real arms."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from torchdlo.cli.ending import stopped
from torchdlo.cli.options import OwnTaskOption, RopeModelOption
from torchdlo.cli.policies import quiet_torchrl
from torchdlo.cli.progress import deferred_interrupt, progress
from torchdlo.errors import InputError
from torchdlo.files import check_writable, write_atomically

if TYPE_CHECKING:
    from torchdlo.envs import Task

__all__ = ["deploy", "distill", "export"]


def distill(
    teacher: Annotated[Path, typer.Argument(help="A policy of train, or its folder.", metavar="POLICY")],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Folder. Default: that of the policy, with -cloud.", metavar="DIR"),
    ] = None,
    rounds: Annotated[
        int | None, typer.Option(min=0, help="Rounds of DAgger in cheap steps, before the last one. Default: 2.")
    ] = None,
    count: Annotated[int | None, typer.Option(min=1, help="Episodes of a round. Default: 64.")] = None,
    updates: Annotated[int | None, typer.Option(min=1, help="Steps of learning after a round. Default: 1000.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of everything.")] = 0,
    own: OwnTaskOption = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on after the last round that is there.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print how it went as JSON.")] = False,
) -> None:
    """Teach a policy that sees 384 points of rope and fixtures to do what a policy that sees the state does.

    The points are those of a noisy depth camera that stands elsewhere in each episode.

    [bold]Examples:[/bold]

    torchdlo distill runs/train/wiring_post-hybrid

    torchdlo evaluate runs/train/wiring_post-hybrid-cloud
    """
    from torchdlo.agents.policies import CloudPolicy, load_policy
    from torchdlo.agents.rl.student import Student, teach
    from torchdlo.envs import find_stored

    quiet_torchrl()
    policy = load_policy(teacher)
    if isinstance(policy, CloudPolicy) or not policy.spec.task:
        raise InputError(f"{teacher}: expected a policy of a task that sees the state, found another one.")
    task = find_stored(policy.spec.task, teacher, own)
    folder = teacher if teacher.is_dir() else teacher.parent
    folder = folder if folder.name else folder.resolve()  # the working folder goes by no name
    out = out or folder.with_name(f"{folder.name}-cloud")
    check_writable(out / "student.json")
    given: dict[str, Any] = {"rounds": rounds, "count": count, "updates": updates, "seed": seed}
    plan = Student(**{name: value for name, value in given.items() if value is not None})
    try:
        with progress() as show, deferred_interrupt(show) as callback:
            _, notes = teach(task, policy, folder=out, plan=plan, resume=resume, callback=callback)
    except KeyboardInterrupt:
        raise stopped(f"the rounds that are finished are in {out}", resume=True) from None
    for row in notes["log"]:
        typer.echo(f"round {row['round']}: success {row['success']:.0%} at {row['fidelity']}", err=as_json)
    typer.echo(f"policy: {out / 'policy.pt'}", err=as_json)
    if as_json:
        typer.echo(json.dumps(notes, indent=1))


def export(
    policy: Annotated[Path, typer.Argument(help="A policy of train, or its folder.", metavar="POLICY")],
    kind: Annotated[
        str, typer.Option("--format", help="ONNX needs the package onnx.", metavar="torchscript|onnx")
    ] = "torchscript",
    out: Annotated[Path | None, typer.Option("--out", "-o", help="File to write. Default: beside the policy.")] = None,
) -> None:
    """Write a policy for other programs, from what an environment observes to actions.

    [bold]Example:[/bold]

    torchdlo export runs/train/lifting-hybrid --format onnx
    """
    from torchdlo.agents.policies import CloudPolicy, load_policy
    from torchdlo.agents.policies.export import export as write

    found = load_policy(policy)
    if isinstance(found, CloudPolicy):
        raise InputError(f"{policy}: it sees clouds of points; export takes policies that see the state.")
    out = out or (policy / "policy.pt" if policy.is_dir() else policy).with_suffix(f".{kind}")
    check_writable(out, mark={"onnx": b"pytorch", "torchscript": b"PK"}.get(kind, b"torchdlo"))
    write(found, out, kind)
    typer.echo(f"policy: {out}")


def deploy(
    source: Annotated[
        Path, typer.Argument(help="What optimize or train found: trajectory.json, policy.pt or its folder.")
    ],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="File to write. Default: beside the source.")] = None,
    kind: Annotated[
        str, typer.Option("--format", help="ros2 has the shape of trajectory_msgs.", metavar="csv|json|ros2")
    ] = "csv",
    reset_seed: Annotated[
        int | None,
        typer.Option(min=0, max=10**9, help="Seed of a start that differs from the usual one.", metavar="SEED"),
    ] = None,
    urdf: Annotated[
        Path | None, typer.Option(help="Arms of another kind, which follow the tools' path.", metavar="FILE")
    ] = None,
    tool: Annotated[str | None, typer.Option(help="Link of that arm that is the tool.", metavar="LINK")] = None,
    speed: Annotated[float, typer.Option(help="Share of the joints' greatest speeds to use.")] = 1.0,
    acceleration: Annotated[float, typer.Option(help="Greatest acceleration of a joint in rad/s^2.")] = 10.0,
    own: OwnTaskOption = None,
    rope_model: RopeModelOption = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Play the file in the simulator, at its times.")] = False,
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

    if tool is not None and urdf is None:
        raise InputError(f"--tool {tool}: it is a link of another arm; give --urdf, too.")
    if kind not in deployment.FORMATS:
        raise InputError(f"--format {kind}: expected one of {', '.join(deployment.FORMATS)}.")
    task, what = _source(source, own, rope_model)
    folder = source if source.is_dir() else source.parent
    out = out or folder / ("joints.csv" if kind == "csv" else f"joints-{kind}.json")
    marks = {"csv": b"time,", "json": b"torchdlo", "ros2": b"joint_names"}
    check_writable(out, mark=marks[kind])
    robots = deployment.arms_of(task, urdf, tool)
    seeded = torch.Generator().manual_seed(reset_seed or 0)
    like = what.new_zeros(()) if isinstance(what, torch.Tensor) else None  # in the precision of the search
    moved = task.moved(1, like=like, generator=seeded, variation=reset_seed is not None)
    path, good = deployment.play_motion(task, what, moved)
    motion = deployment.time_scale(task, robots, path, same=urdf is None, share=speed, acceleration=acceleration)
    said: dict[str, Any] = {"task": task.name, "success": good, "slower": motion.slower}
    said |= {"seconds": float(motion.time[-1]), "points": len(motion.time), "reset_seed": reset_seed}
    write_atomically(out, deployment.motion_text(motion, kind, said))
    if dry_run:
        said["dry_run_success"] = deployment.replay_joints(task, robots, motion, moved)
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


def _source(path: Path, own: str | None = None, rope_model: Path | None = None) -> tuple[Task, Any]:
    """Return the task as it was for what was found, and the actions of a trajectory (T, A) or a policy."""
    from torchdlo.agents.policies import CloudPolicy, load_policy
    from torchdlo.agents.trajopt.search_result import load_actions, read_trajectory
    from torchdlo.agents.trajopt.task_problem import trajectory_problem
    from torchdlo.envs import find_stored
    from torchdlo.scene_files import cable

    if path.is_dir() or path.suffix != ".json":
        policy = load_policy(path)
        if isinstance(policy, CloudPolicy):
            raise InputError(f"{path}: it sees clouds of points; deploy the policy of the state that taught it.")
        if rope_model is not None:
            raise InputError("--rope-model: it belongs to trajectories; policies act on the rope of their task.")
        return find_stored(policy.spec.task, path, own), policy
    name = read_trajectory(path)["task"].text()
    rope = None if rope_model is None else cable(rope_model)
    problem = trajectory_problem(path, find_stored(name, path, own), rope)
    return problem.task, problem.full(load_actions(path, problem))
