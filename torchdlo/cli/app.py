"""The command `torchdlo`: check, convert, calibrate to and diagnose recordings of real ropes.

Everything slow to import is imported inside the command that needs it, so that help is quick.
"""

from __future__ import annotations

import shlex
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from torchdlo.cli.commands import design_experiment, optimize, play, simulate, tasks, view
from torchdlo.cli.progress import deferred_interrupt, progress
from torchdlo.errors import InputError
from torchdlo.files import check_writable, write_atomically

if TYPE_CHECKING:
    from torchdlo.sysid.estimation.result import Calibration
    from torchdlo.sysid.recordings.recording import Recording

__all__ = ["app", "main"]

app = typer.Typer(
    name="torchdlo",
    help="Differentiable simulation of ropes, cables and wires, calibrated to real ones.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)

_QUICK = {"starts": 12, "iterations": 5}
"""What --quick sets unless the options say otherwise."""
_INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells have it."""

RecordingArgument = Annotated[
    Path,
    typer.Argument(help="Recording folder: rope.json, train_*.npz and test_*.npz.", metavar="PATH"),
]


ModelOption = Annotated[
    Path | None,
    typer.Option(
        "--model",
        help="Start from the numbers and effects of this model file, which calibrate or diagnose wrote.",
        metavar="FILE",
    ),
]


def main(args: list[str] | None = None) -> None:
    """Run the command line; what is wrong with the input is one line on stderr and exit code 2."""
    try:
        app(args=args)
    except InputError as error:
        typer.echo("error: " + " ".join(str(error).splitlines()), err=True)
        raise SystemExit(2) from None
    except OSError as error:
        typer.echo(f"error: {error}", err=True)
        raise SystemExit(1) from None


@app.callback(invoke_without_command=True)
def _root(
    version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False,
) -> None:
    if version:
        from torchdlo import __version__

        typer.echo(f"torchdlo {__version__}")
        raise typer.Exit


@app.command()
def check(recording: RecordingArgument) -> None:
    """Check a recording folder and say what is in it.

    Exit code 0 means that the other commands accept it. Shown are also the errors of two
    predictions without any parameter: what a calibrated model has to beat.

    [bold]Example:[/bold] torchdlo check my_rope
    """
    from rich.console import Console

    from torchdlo.sysid.recordings.recording import load_recording

    loaded = load_recording(recording)
    console = Console(soft_wrap=True)
    console.print(_rope_line(loaded), highlight=False, markup=False)
    console.print(_trial_table(loaded))


@app.command("import-deform")
def import_deform(
    path: Annotated[
        Path,
        typer.Argument(help="Checkout of github.com/roahmlab/DEFORM, or one cable's folder in it."),
    ],
    out: Annotated[
        Path,
        typer.Argument(help="New folder; gets one recording folder per cable (dlo1, dlo2, ...)."),
    ],
    cable: Annotated[
        list[str] | None,
        typer.Option(help="Convert only this cable, for instance DLO1; may be repeated."),
    ] = None,
    mass: Annotated[
        float | None,
        typer.Option(help="Mass between the outer markers in kg; known for DLO1, DLO2 and DLO4."),
    ] = None,
) -> None:
    """Convert the public DEFORM motion-capture data into recording folders.

    The data carry no licence, so torchdlo does not ship them: get your own checkout first.
    Pickle files are read as plain lists of numbers; anything else in them is refused, not run.

    [bold]Example:[/bold] torchdlo import-deform DEFORM recordings --cable DLO1 --cable DLO4
    """
    from torchdlo.sysid.recordings.import_deform import MASSES, find_cables, read_cable
    from torchdlo.sysid.recordings.recording import check_new_folder, save_recording

    cables = find_cables(path)
    for name in cable or []:
        if name not in cables:
            raise InputError(f"{path}: expected a cable {name}, found {', '.join(cables)}.")
    if not cable and mass is None and len(cables) > 1:
        skipped = [name for name in cables if name not in MASSES]
        if skipped:
            typer.echo(f"left out (give --cable and --mass): {', '.join(skipped)}", err=True)
        cable = [name for name in cables if name in MASSES]
    targets = {name: out / name.lower() for name in cable or cables}
    for target in targets.values():
        check_new_folder(target)
    with progress() as callback:
        recordings = {name: read_cable(cables[name], mass=mass, callback=callback) for name in targets}
    for name, target in targets.items():
        save_recording(recordings[name], target)
        n_train, n_test = len(recordings[name].train), len(recordings[name].test)
        straight = recordings[name].rest_positions is None
        rest = "no rest shape in train_DEFORM.py, taken as straight" if straight else "rest shape"
        typer.echo(f"{target}: {n_train} train and {n_test} test trials, {rest}")


@app.command()
def calibrate(
    recording: RecordingArgument,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Model file to write; calibration.json, report.html and report.png go beside it. "
            "Default: runs/calibrate/NAME/model.json.",
            metavar="DIR/model.json",
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the random starts.")] = 0,
    starts: Annotated[int | None, typer.Option(min=1, help="Number of starts, run as one batch.")] = None,
    iterations: Annotated[int | None, typer.Option(min=1, help="Iterations of the fit.")] = None,
    vertices: Annotated[int | None, typer.Option(min=3, help="Vertices of the simulated rope.")] = None,
    rest: Annotated[
        str,
        typer.Option(
            help="Rest shape: straight, given (rest_positions of rope.json), or auto: whichever predicts the train "
            "trials better.",
            metavar="auto|straight|given",
        ),
    ] = "auto",
    model: ModelOption = None,
    quick: Annotated[bool, typer.Option("--quick", help="A rough fit in a fraction of the time.")] = False,
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the checkpoint beside the model file.")] = False,
) -> None:
    """Fit a rope model to the train trials and judge it on the test trials.

    Ctrl-C stops after the running iteration and keeps the best found so far.

    [bold]Examples:[/bold]

    torchdlo calibrate my_rope

    torchdlo calibrate my_rope --out runs/my_rope/model.json --starts 16 --seed 1

    torchdlo calibrate my_rope --quick --json | jq .test_mae_mm

    torchdlo calibrate my_rope --model runs/diagnose/my_rope/model.json
    """
    from torchdlo.sysid.recordings.recording import load_recording

    loaded = load_recording(recording)
    if out is None:
        out = Path("runs") / "calibrate" / recording.resolve().name / "model.json"
    elif out.is_dir() or out.suffix != ".json":
        out = out / "model.json"
    _check_outputs(out, resume)
    options: dict[str, Any] = {"starts": starts, "iterations": iterations, "vertices": vertices}
    if quick:
        options = {name: value or _QUICK.get(name) for name, value in options.items()}
    options = {name: value for name, value in options.items() if value is not None} | _given(model)
    result = _run_calibration(
        loaded, seed=seed, rest=rest, checkpoint=out.with_name("checkpoint.json"), resume=resume, **options
    )
    _write_outputs(result, loaded, recording, out, quiet=as_json)
    if as_json:
        from torchdlo.sysid.estimation.result import summary_json

        typer.echo(summary_json(result, recording), nl=False)
    if result.interrupted:
        raise typer.Exit(_INTERRUPTED)


@app.command()
def diagnose(
    recording: RecordingArgument,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            help="Folder for findings.json, model.json and report.html. Default: runs/diagnose/NAME.",
            metavar="DIR",
        ),
    ] = None,
    budget: Annotated[str, typer.Option(help="How much work to do.", metavar="fast|full")] = "fast",
    as_json: Annotated[bool, typer.Option("--json", help="Print the findings as JSON.")] = False,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the random starts.")] = 0,
    vertices: Annotated[int | None, typer.Option(min=3, help="Vertices of the simulated rope.")] = None,
    trials: Annotated[
        int | None, typer.Option(min=1, help="Most train trials to use, evenly picked; fast takes 8, full 16.")
    ] = None,
    workers: Annotated[int | None, typer.Option(min=1, help="Processes; one per core if not given.")] = None,
    model: ModelOption = None,
    without: Annotated[list[str] | None, typer.Option(help="An effect not to look for.", metavar="EFFECT")] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on from the journal of a search that was stopped.")
    ] = False,
) -> None:
    """Find what the model lacks: name the missing effect, add it, and show the gap shrink.

    The baseline is calibrated first; every effect of the library is then tried on what it leaves over, and kept only if
    it closes the gap on trials that were not used. Ctrl-C stops after the running step; --resume goes on from there.

    [bold]Examples:[/bold]

    torchdlo diagnose my_rope

    torchdlo diagnose my_rope --out runs/my_rope --resume

    torchdlo diagnose my_rope --model runs/my_rope/model.json --out runs/my_rope_2
    """
    from torchdlo.report.pages import diagnosis as report
    from torchdlo.sysid.diagnosis.findings import findings_json, model_json, summary
    from torchdlo.sysid.diagnosis.search import diagnose as search
    from torchdlo.sysid.recordings.recording import load_recording

    loaded = load_recording(recording)
    out = out or Path("runs") / "diagnose" / recording.resolve().name
    names = ("findings.json", "model.json", report.PAGE)
    for name in names:
        check_writable(out / name)
    options = {"budget": budget, "seed": seed, "vertices": vertices, "trials": trials, "workers": workers}
    options |= _given(model) | {"without": without or ()}
    journal = out / "journal"
    try:
        with progress() as show, deferred_interrupt(show) as callback:
            result = search(loaded, **options, callback=callback, journal=journal, resume=resume)
    except KeyboardInterrupt:
        typer.echo(f"interrupted before there was a verdict; --resume goes on from {journal}", err=True)
        raise SystemExit(_INTERRUPTED) from None
    # What cannot be trusted was taken out of it.
    loaded = result.model.recording
    write_atomically(out / "findings.json", findings_json(result, loaded))
    write_atomically(out / "model.json", model_json(result))
    page = report.write_report(result, loaded, out, command=shlex.join(["torchdlo", *sys.argv[1:]]))
    shutil.rmtree(journal, ignore_errors=True)
    typer.echo(summary(result, loaded), err=as_json)
    for fault in result.health:
        typer.echo(f"data: {fault.trial + ': ' if fault.trial else ''}{fault.said}", err=as_json)
    typer.echo(f"findings: {out / 'findings.json'}\nreport:   {page}", err=as_json)
    if as_json:
        typer.echo(findings_json(result, loaded), nl=False)


app.command("design-experiment")(design_experiment)
app.command()(simulate)
app.command()(view)
app.command()(optimize)
app.command()(play)
app.command()(tasks)


def _run_calibration(recording: Recording, **options: Any) -> Calibration:
    # Imported before the bar starts: a first import of torch takes seconds.
    from torchdlo.sysid.calibration.calibrate import calibrate as fit

    try:
        with progress() as show, deferred_interrupt(show) as callback:
            return fit(recording, workers=None, callback=callback, **options)
    except KeyboardInterrupt:
        typer.echo("interrupted before there was a result; nothing was written", err=True)
        raise SystemExit(_INTERRUPTED) from None


def _given(model: Path | None) -> dict[str, Any]:
    """Return the option of a search that starts from a model file."""
    if model is None:
        return {}
    from torchdlo.sysid.model import model_file

    return {"given": model_file.load(model)}


def _check_outputs(out: Path, resume: bool) -> None:
    """Refuse before the work what could not be written after it."""
    from torchdlo.report.pages import calibration as report

    for name in (out.name, "calibration.json", "checkpoint.json", report.PAGE, report.PICTURE):
        check_writable(out.with_name(name))
    checkpoint = out.with_name("checkpoint.json")
    if resume and not checkpoint.is_file():
        raise InputError(
            f"{checkpoint}: expected the checkpoint of an earlier calibration to resume, "
            "found none; leave out --resume."
        )


def _write_outputs(result: Calibration, recording: Recording, given: Path, out: Path, *, quiet: bool) -> None:
    from torchdlo.report.pages import calibration as report
    from torchdlo.sysid.estimation.result import model_json, summary_json

    command = shlex.join(["torchdlo", *sys.argv[1:]])
    write_atomically(out, model_json(result))
    write_atomically(out.with_name("calibration.json"), summary_json(result, given))
    page, _ = report.write_report(result, recording, out.parent, command=command)
    typer.echo(report.verdict(result, recording), err=quiet)
    typer.echo(f"model:  {out}\nreport: {page}", err=quiet)


def _rope_line(recording: Recording) -> str:
    radius = "unknown" if recording.radius is None else f"{recording.radius * 1e3:g} mm"
    table = "none" if recording.table_height is None else f"at {recording.table_height:g} m"
    rest = "straight" if recording.rest_positions is None else "given"
    return (
        f"{recording.path}: length {recording.length:g} m, mass {recording.mass * 1e3:g} g, "
        f"radius {radius}, rest shape {rest}, table {table}"
    )


def _trial_table(recording: Recording) -> Any:
    import numpy as np
    from rich.table import Table

    from torchdlo.sysid.recordings.metrics import average, mean_absolute_error
    from torchdlo.sysid.recordings.trivial_predictors import BASELINES

    splits = {"train": recording.train, "test": recording.test}

    def pooled(trials: Any, pick: Callable[[Any], Any]) -> str:
        return f"{np.mean(np.concatenate([pick(trial).ravel() for trial in trials])):.1%}"

    def error(trials: Any, predict: Callable[..., Any]) -> str:
        predicted = [predict(trial, recording) for trial in trials]
        return f"{average(mean_absolute_error, predicted, trials) * 1e3:.1f} mm"

    rows: dict[str, Callable[[Any], str]] = {
        "trials": lambda trials: str(len(trials)),
        "frames": lambda trials: str(sum(len(t.time) for t in trials)),
        "rate": lambda trials: _span([1 / float(np.median(np.diff(t.time))) for t in trials], "Hz"),
        "duration": lambda trials: _span([t.time[-1] for t in trials], "s"),
        "markers": lambda trials: _span([t.markers.shape[1] for t in trials]),
        "gripped markers": lambda trials: _span([t.gripped.sum() for t in trials]),
        "markers not seen": lambda trials: pooled(trials, lambda t: np.isnan(t.markers[..., 0])),
        "suspect frames": lambda trials: pooled(trials, lambda t: t.suspect),
    }
    for name, predict in BASELINES.items():
        rows[f"error of {name.replace('_', ' ')}"] = lambda trials, p=predict: error(trials, p)
    table = Table(box=None, pad_edge=False)
    table.add_column("")
    for split in splits:
        table.add_column(split, justify="right", no_wrap=True)
    for name, describe in rows.items():
        table.add_row(name, *(describe(trials) for trials in splits.values()))
    return table


def _span(values: list[Any], unit: str = "") -> str:
    low, high = f"{min(values):.4g}", f"{max(values):.4g}"
    return f"{low if low == high else f'{low} to {high}'} {unit}".rstrip()


if __name__ == "__main__":
    main()
