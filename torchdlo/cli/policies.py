"""Commands of `torchdlo` that train policies and judge them; what is slow is imported when they run."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from torchdlo.cli.ending import stopped
from torchdlo.cli.options import ExecutionOption, execution_choice
from torchdlo.cli.progress import at_work, deferred_interrupt, progress
from torchdlo.errors import InputError
from torchdlo.files import check_writable, write_atomically
from torchdlo.untrusted import parse_json, read_entry

if TYPE_CHECKING:
    from torchdlo.agents.rl.settings import TrainingSettings
    from torchdlo.envs import Task
    from torchdlo.physics.execution import Execution

__all__ = ["evaluate", "train"]


_WRITTEN = (
    "result.json",
    "log.csv",
    "curve.png",
    "report.html",
    "policy.pt",
    "checkpoint.pt",
    "robust.json",
    "expert.json",
    "clone.part",
    "clone.pt",
    "tune.part",
    "stages.json",
)
"""What training writes."""


def quiet_torchrl() -> None:
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
            help="Folder for policy.pt, report.html, log.csv, curve.png and what is needed to go on. Default: "
            "runs/train/TASK-ALGO, and -SEED if that is not 0.",
            metavar="DIR",
        ),
    ] = None,
    episodes: Annotated[int | None, typer.Option(min=1, help="Budget of episodes. Default: the published one.")] = None,
    minutes: Annotated[
        float | None, typer.Option(help="Budget of the clock. Default: 60, and 180 for gathering by hybrid.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of everything.")] = 0,
    count: Annotated[int | None, typer.Option(min=1, help="Episodes that are played at once.")] = None,
    fidelity: Annotated[
        str | None,
        typer.Option(help="Of training, but for hybrid: published, coarse, or such as 1ms/2.", metavar="FIDELITY"),
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", help="Another setting, such as rate=1e-3; may be repeated.", metavar="NAME=VALUE"),
    ] = None,
    variation: Annotated[bool, typer.Option(help="Let starts vary; hybrid always does.")] = True,
    device: Annotated[
        str | None, typer.Option(help="Where to train; hybrid on the CPU only. Default: cpu.", metavar="cpu|cuda")
    ] = None,
    execution: ExecutionOption = None,
    trajectory: Annotated[
        list[Path] | None,
        typer.Option(help="hybrid: what optimize found; may be repeated. Default: search one.", metavar="FILE"),
    ] = None,
    without: Annotated[
        list[str] | None,
        typer.Option(help="hybrid: a stage to leave out, robust, clone or tune; may be repeated.", metavar="STAGE"),
    ] = None,
    address: Annotated[
        str | None,
        typer.Option(help="ppo, sac: Ray cluster whose processes play: auto, local, or HOST:PORT.", metavar="ADDRESS"),
    ] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, help="With --address: how many processes; they share the count. Default: 2.")
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
    from torchdlo.agents.rl.settings import check_belonging, training_preset
    from torchdlo.envs import find, short_name

    quiet_torchrl()
    out = out or Path("runs") / "train" / f"{short_name(task)}-{algo}{f'-{seed}' if seed else ''}"
    for name in ("result.json", "log.csv", "curve.png", "report.html"):
        if not resume:
            check_writable(out / name, mark=b"torchdlo" if name != "log.csv" else b"episodes")
    given = {"episodes": episodes, "minutes": minutes, "seed": seed, "count": count, "fidelity": fidelity}
    given["device"] = device
    if workers is not None and address is None:
        raise InputError("--workers: it says how many processes of a Ray cluster play; give --address, too.")
    given["collectors"] = None if address is None else workers or 2
    more = _read(settings or [])
    chosen = training_preset(task, algo, variation=variation, **given, **more)
    check_belonging(algo, more)
    made, how = find(task), execution_choice(execution)
    if algo != "hybrid" and (trajectory or without):
        raise InputError(f"--trajectory and --without: they belong to hybrid, not to {algo}; leave them out.")
    if algo == "hybrid" and execution is not None:
        raise InputError("--execution: stages of hybrid choose it themselves; leave it out.")
    with at_work(out, *_WRITTEN):
        if algo == "hybrid":
            _hybrid(made, chosen, out, trajectory or [], without or [], resume, as_json)
        else:
            _train(made, chosen, out, resume, how, as_json, address)


_OPTIONS = {
    "algorithm": "--algo",
    "collectors": "--address and --workers",
    "variation": "--no-variation",
    **{name: f"--{name}" for name in ("episodes", "minutes", "seed", "count", "fidelity", "device")},
}
"""Settings that have options of their own."""


def _read(pairs: list[str]) -> dict[str, Any]:
    """Return settings of NAME=VALUE, with values as in JSON."""
    found = {}
    for pair in pairs:
        name, equals, value = pair.partition("=")
        if not equals:
            raise InputError(f"--set {pair}: expected NAME=VALUE, such as rate=1e-3.")
        if name in _OPTIONS:
            raise InputError(f"--set {pair}: {name} has an option; give {_OPTIONS[name]} instead.")
        try:
            found[name] = parse_json(value, where=f"--set {name}")
        except InputError:
            found[name] = value
        if isinstance(found[name], list):
            found[name] = tuple(found[name])
    return found


def _train(
    task: Task,
    settings: TrainingSettings,
    out: Path,
    resume: bool,
    execution: Execution | None,
    as_json: bool,
    address: str | None,
) -> None:
    from torchdlo.agents.rl.results import prepare_training, train_json, train_result
    from torchdlo.agents.rl.training import train as loop
    from torchdlo.report.figures.learning_curve import training_png
    from torchdlo.report.pages.training_page import training_html

    trainer, played = prepare_training(task, settings, execution=execution, address=address)
    try:
        with progress() as show, deferred_interrupt(show) as callback:
            found = loop(trainer, played, settings, folder=out, resume=resume, callback=callback)
    finally:
        played.close()
    result = train_result(task, settings, found)
    write_atomically(out / "result.json", train_json(result))
    if found.rows:
        write_atomically(out / "curve.png", training_png({f"{task.name}, {settings.algorithm}": found.rows}))
    write_atomically(out / "report.html", training_html(result))
    told = result["best_batch"]
    best = f"best batch: success {told['success']:.0%}, return {told['return']:.4g}" if told else "no batch by a policy"
    typer.echo(f"{task.name}: {found.episodes} episodes, {best}", err=as_json)
    typer.echo(f"policy: {out / 'policy.pt'}\nlog:    {out / 'log.csv'}\npage:   {out / 'report.html'}", err=as_json)
    if as_json:
        typer.echo(train_json(result), nl=False)
    if found.interrupted:
        raise stopped("the best so far is kept", resume=True)


def _hybrid(
    task: Task,
    settings: TrainingSettings,
    out: Path,
    trajectories: list[Path],
    without: list[str],
    resume: bool,
    as_json: bool,
) -> None:
    from torchdlo.agents.rl.hybrid_stages import STAGES, plan_of, train_hybrid
    from torchdlo.report.pages.training_page import hybrid_html

    other = sorted(set(without) - set(STAGES))
    if other:
        raise InputError(f"--without {', '.join(other)}: expected some of {', '.join(STAGES)}.")
    spent = None
    if not trajectories and not (resume and (out / "expert.json").exists()):
        file, spent = _searched(task, settings, out)
        trajectories = [file]
    stages = [name for name in STAGES if name not in without]
    choices: dict[str, Any] = {"plan": plan_of(task.name), "stages": stages, "resume": resume, "search_notes": spent}
    try:
        with progress() as show, deferred_interrupt(show) as callback:
            _, notes = train_hybrid(task, trajectories, settings, folder=out, callback=callback, **choices)
    except KeyboardInterrupt:
        raise stopped(f"what is done is kept in {out}", resume=True) from None
    shown = ("search", *STAGES)
    for name in shown:
        if name in notes:
            told = f"{notes[name]['episodes']} episodes, {notes[name]['cpu_seconds']:.0f} CPU s"
            ended = notes[name].get("ended")
            told += f"; the budget of {ended} ended it" if ended else ""
            typer.echo(f"{name + ':':8}{told}", err=as_json)
    write_atomically(out / "report.html", hybrid_html(notes, shown))
    if set(stages) != {"robust"} or (out / "clone.pt").is_file():
        typer.echo(f"policy: {out / 'policy.pt'}", err=as_json)
    typer.echo(f"page:   {out / 'report.html'}", err=as_json)
    if as_json:
        typer.echo(json.dumps(notes, indent=1))


def _searched(task: Task, settings: TrainingSettings, out: Path) -> tuple[Path, dict[str, Any]]:
    """Return the file of a trajectory that is searched now, or was before with the same seed, and what that used."""
    from torchdlo.agents.trajopt.presets import search_preset
    from torchdlo.agents.trajopt.search import optimize
    from torchdlo.agents.trajopt.search_result import result_json, trajectory_json
    from torchdlo.agents.trajopt.task_problem import TaskProblem

    file = out / "search" / "trajectory.json"
    result = file.with_name("result.json")
    if file.exists() and result.exists():
        known = read_entry(result, "a result of a search")
        if known["settings"]["seed"].whole() == settings.seed:
            typer.echo(f"search: {file} is taken, which was searched before with this seed", err=True)
            seconds = known["seconds"].number(low=0)  # files do not say those of the CPU
            return file, _search_notes(known["episodes"].whole(), seconds, seconds)
    problem, chosen = TaskProblem(task), search_preset(task.name, "hybrid", seed=settings.seed, episodes=1200)
    journal, late = out / "search" / "journal", list[str]()
    until, busy = time.monotonic() + 60 * settings.minutes, time.process_time()
    with progress() as show, deferred_interrupt(show) as callback:

        def told(*message: Any) -> None:
            callback(*message)
            if time.monotonic() > until:
                late.append(f" within {settings.minutes:g} minutes")
                raise KeyboardInterrupt

        found = optimize(problem, chosen, journal=journal, resume=journal.exists(), callback=told)
    if found.interrupted and not late:
        raise stopped(f"what was searched is kept in {out / 'search'}", resume=True)
    if not bool(found.outcome.success[0]):
        said = f"the search found no trajectory that succeeds{''.join(late)}"
        raise InputError(f"{task.name}: {said}; give one with --trajectory, another --seed or more --minutes.")
    write_atomically(file, trajectory_json(found, problem))
    write_atomically(result, result_json(found, problem, chosen))
    return file, _search_notes(found.episodes, found.seconds, time.process_time() - busy)


def _search_notes(episodes: int, seconds: float, busy: float) -> dict[str, Any]:
    """Return what a search used as stages of the hybrid say it."""
    return {"episodes": episodes, "seconds": round(seconds, 1), "cpu_seconds": round(busy, 1), "log": []}


def evaluate(
    policies: Annotated[
        list[Path], typer.Argument(help="Files of policies, or folders of train; several seeds of one task.")
    ],
    starts: Annotated[int, typer.Option(min=1, help="Episodes of each policy in each protocol.")] = 15,
    protocol: Annotated[
        list[str] | None,
        typer.Option(
            help="one: from the one start; varied: from unseen starts; disturbed: those with other friction. Of "
            "policies of learn: varied, paraphrased (instructions that no data set has), swapped (those of another "
            "task) or blanked (black pictures). May be repeated.",
            metavar="NAME",
        ),
    ] = None,
    task: Annotated[
        list[str] | None,
        typer.Option(
            help="Of policies of learn: a task; all that it has learned if none is named. Of others: where the task of "
            "your own is, as FILE.py:CLASS.",
            metavar="NAME",
        ),
    ] = None,
    reset_seed: Annotated[
        int,
        typer.Option(
            min=0, max=10**9, help="Seed of the unseen starts: another one for starts that no judgement has seen."
        ),
    ] = 0,
    perturb: Annotated[
        bool,
        typer.Option(
            "--perturb",
            help="Write robustness.json instead: success under other friction, stiffness and starts, and under noise.",
        ),
    ] = False,
    trajectory: Annotated[
        Path | None,
        typer.Option(help="With --perturb: what optimize found, replayed and followed beside them.", metavar="FILE"),
    ] = None,
    film: Annotated[bool, typer.Option("--film", help="Write best.mp4 and worst.mp4 of the last protocol.")] = False,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder for evaluation.json and films.", metavar="DIR")
    ] = None,
    execution: ExecutionOption = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the results as JSON.")] = False,
) -> None:
    """Judge policies at the published fidelity, from starts that no training has seen.

    Policies of learn, which see, are judged with looks that they have not seen either.

    [bold]Examples:[/bold]

    torchdlo evaluate runs/train/lifting-hybrid

    torchdlo evaluate runs/dlo4/policy.pt --protocol varied --protocol paraphrased

    torchdlo evaluate runs/train/lifting-hybrid runs/train/lifting-hybrid-1 --protocol disturbed --film

    torchdlo evaluate runs/train/lifting-hybrid --perturb --trajectory runs/searches/lifting-hybrid-0/trajectory.json
    """
    from torchdlo.agents.policies import CloudPolicy
    from torchdlo.agents.rl.evaluate import PROTOCOLS
    from torchdlo.agents.rl.evaluate import evaluate_policies as judge
    from torchdlo.agents.rl.results import evaluation_summary, load_policies
    from torchdlo.envs import find_stored

    quiet_torchrl()
    if len(policies) == 1 and _sees(policies[0]):
        said = f"{policies[0]}: it is a policy of learn, and {{}} for those of train; leave it out."
        _refuse(said, film=film, execution=execution, perturb=perturb, trajectory=trajectory)
        _evaluate_seeing(policies[0], task or [], starts, protocol or ["varied"], reset_seed, out, as_json)
        return
    if len(task or []) > 1:
        raise InputError("--task: policies of train have one task; give it once, or leave it out.")
    given = task[0] if task else None
    names = protocol or ["one", "varied"]
    other = sorted(set(names) - set(PROTOCOLS))
    if other:
        raise InputError(f"--protocol {', '.join(other)}: expected some of {', '.join(PROTOCOLS)}.")
    first = policies[0] if policies[0].is_dir() else policies[0].parent
    out = out or first
    if trajectory and not perturb:
        raise InputError("--trajectory: it is compared with policies under perturbations; give --perturb as well.")
    if perturb:
        said = "--perturb: it has protocols of its own, and {} not for it; leave it out."
        _refuse(said, film=film, protocol=protocol, execution=execution)
        _perturb(policies, given, trajectory, starts, reset_seed, out, as_json)
        return
    check_writable(out / "evaluation.json")
    if film:
        from torchdlo.report.render.video_writer import check_video

        for name in ("best.mp4", "worst.mp4"):
            check_video(out / name)
    found, name = load_policies(policies)
    own, how = find_stored(name, policies[0], given), execution_choice(execution)
    if any(isinstance(policy, CloudPolicy) for policy in found):
        _judge_student(policies, found, own, starts, reset_seed, out, film or bool(protocol or execution), as_json)
        return
    with progress() as show, deferred_interrupt(show) as callback:
        how_many: dict[str, Any] = {"starts": starts, "protocols": names, "seed": reset_seed}
        results, plays = judge(found, own, callback=callback, execution=how, **how_many)
    content = json.dumps({"generator": "torchdlo evaluate", "files": [str(p) for p in policies]} | results, indent=1)
    write_atomically(out / "evaluation.json", content + "\n")
    typer.echo(evaluation_summary(results), err=as_json)
    typer.echo(f"results: {out / 'evaluation.json'}", err=as_json)
    if film:
        for file in _films(own, plays[names[-1]], out):
            typer.echo(f"film:    {file}", err=as_json)
    if as_json:
        typer.echo(content)


def _refuse(sentence: str, **options: object) -> None:
    """Refuse options that were given and would be passed over; the sentence has a place for "X is" or "X, Y are"."""
    given = [f"--{name}" for name, value in options.items() if value]
    if given:
        raise InputError(sentence.replace("{}", f"{', '.join(given)} {'is' if len(given) == 1 else 'are'}"))


def _sees(policy: Path) -> bool:
    """Return whether a file holds a policy of learn."""
    from torchdlo.agents.policies.chunk_policy import is_chunk_policy

    return policy.suffix == ".pt" and is_chunk_policy(policy)


def _evaluate_seeing(
    policy: Path, tasks: list[str], starts: int, protocols: list[str], seed: int, out: Path | None, as_json: bool
) -> None:
    """Judge a policy that sees, and write what it came to beside it."""
    from torchdlo.agents.data.painting import TaskPainter
    from torchdlo.agents.policies.chunk_rollout import evaluate_chunk_policy as judge

    file = (out or policy.parent) / "evaluation.json"
    check_writable(file)
    with progress() as show, deferred_interrupt(show) as callback:
        found = judge(policy, tasks, TaskPainter(), episodes=starts, seed=seed, conditions=protocols, callback=callback)
    content = json.dumps({"generator": "torchdlo evaluate"} | found, indent=1)
    write_atomically(file, content + "\n")
    for name, rows in found["tasks"].items():
        typer.echo(f"{name}: " + ", ".join(f"{kind} {row['success']:.0%}" for kind, row in rows.items()), err=as_json)
    typer.echo("mean: " + ", ".join(f"{kind} {x:.0%}" for kind, x in found["mean"].items()), err=as_json)
    typer.echo(f"results: {file}", err=as_json)
    if as_json:
        typer.echo(content)


def _judge_student(
    paths: list[Path],
    found: list[Any],
    task: Task,
    starts: int,
    seed: int,
    out: Path,
    other: bool,
    as_json: bool,
) -> None:
    """Judge a policy of clouds by cameras."""
    from torchdlo.agents.rl.student import judge_student

    if len(found) > 1 or other:
        raise InputError(
            f"{paths[0]}: it sees clouds of points, and is judged alone, from unseen starts, by cameras; leave out "
            "other policies, --protocol, --film and --execution."
        )
    with progress() as show, deferred_interrupt(show) as callback:
        results = judge_student(found[0], task, starts=starts, seed=seed, callback=callback)
    content = json.dumps({"generator": "torchdlo evaluate", "files": [str(p) for p in paths]} | results, indent=1)
    write_atomically(out / "evaluation.json", content + "\n")
    for name, row in results["conditions"].items():
        low, high = row["interval"]
        typer.echo(
            f"{task.name}, {name}: success {row['success']:.0%} of {row['episodes']} episodes (95 % interval {low:.0%} "
            f"to {high:.0%})",
            err=as_json,
        )
    typer.echo(f"results: {out / 'evaluation.json'}", err=as_json)
    if as_json:
        typer.echo(content)


def _perturb(
    policies: list[Path],
    given: str | None,
    trajectory: Path | None,
    starts: int,
    seed: int,
    out: Path,
    as_json: bool,
) -> None:
    """Judge policies, and the trajectory and the experts behind them, under perturbations."""
    from torchdlo.agents.policies import CloudPolicy
    from torchdlo.agents.rl import robustness
    from torchdlo.agents.rl.expert import candidate_experts, load_expert
    from torchdlo.agents.rl.results import load_policies
    from torchdlo.agents.trajopt.search_result import check_scene, load_actions
    from torchdlo.agents.trajopt.task_problem import TaskProblem
    from torchdlo.envs import find_stored

    check_writable(out / "robustness.json")
    found, name = load_policies(policies)
    if any(isinstance(policy, CloudPolicy) for policy in found):
        raise InputError(f"{policies[0]}: it sees clouds of points; leave out --perturb, cameras are what is varied.")
    task, actors = find_stored(name, policies[0], given), {}
    if trajectory is not None:
        check_scene(trajectory)  # the policies' is the one in which all are compared
        problem = TaskProblem(task, execution="eager")
        actors["trajectory replayed"] = robustness.replaying(problem.full(load_actions(trajectory, problem)))
        for expert in candidate_experts(task, [trajectory])[:1]:
            actors["its path followed"] = robustness.following(expert)
    for policy, path in zip(found, policies, strict=True):
        folder = (path if path.is_dir() else path.parent).resolve()
        if (folder / "expert.json").exists():
            actors[f"expert of {folder.name}"] = robustness.following(load_expert(folder / "expert.json", task))
        name = f"policy {folder.name}" + ("" if path.is_dir() or path.name == "policy.pt" else f"/{path.name}")
        actors[name] = robustness.policy_acting(policy)
    with progress() as show, deferred_interrupt(show) as callback:
        results = robustness.perturbed(actors, task, starts=starts, seed=seed, callback=callback)
    content = json.dumps({"generator": "torchdlo evaluate", "files": [str(p) for p in policies]} | results, indent=1)
    write_atomically(out / "robustness.json", content + "\n")
    typer.echo(robustness.table(results), err=as_json)
    typer.echo(f"results: {out / 'robustness.json'}", err=as_json)
    if as_json:
        typer.echo(content)


def _films(task: Task, plays: dict[str, Any], out: Path) -> list[Path]:
    """Film the best and the worst episode; each is played again alone, in its scene and with its actions."""
    import torch

    from torchdlo.agents.rl.evaluate import judged_episode
    from torchdlo.report.render.episode_film import film
    from torchdlo.report.render.video_writer import write_video

    success, returns = plays["success"].flatten(), plays["returns"].flatten()
    order = sorted(range(len(success)), key=lambda k: (bool(success[k]), float(returns[k])))
    files = []
    for name, k in {"best.mp4": order[-1], "worst.mp4": order[0]}.items():
        with torch.no_grad():
            made, actions = judged_episode(task, plays, k)
            frames, _ = film(made.task, actions, made=made)
        with progress() as show, deferred_interrupt(show) as callback:
            write_video(frames, out / name, speed=0.5, callback=callback)
        files.append(out / name)
    return files
