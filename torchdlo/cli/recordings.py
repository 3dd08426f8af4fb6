"""Commands that look at recordings and convert them; what is slow to import is imported when they run."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from torchdlo.cli.options import RecordingArgument
from torchdlo.cli.progress import progress
from torchdlo.cli.video import print_films
from torchdlo.errors import InputError

if TYPE_CHECKING:
    from torchdlo.sysid.recordings.recording import Recording

__all__ = ["check", "import_deform"]


def check(recording: RecordingArgument) -> None:
    """Check a recording folder and say what is in it.

    Exit code 0 means that the other commands accept it. Shown are also the errors of two
    predictions without any parameter: what a calibrated model has to beat. What can hardly be, such as
    a mass in grams or gravity that points up, is said below.

    [bold]Example:[/bold] torchdlo check my_rope
    """
    from rich.console import Console

    from torchdlo.sysid.recordings.recording import load_recording
    from torchdlo.sysid.recordings.unit_doubts import doubts

    loaded = load_recording(recording)
    console = Console(soft_wrap=True)
    console.print(_rope_line(loaded), highlight=False, markup=False)
    if loaded.filmed:
        print_films(loaded)
    else:
        console.print(_trial_table(loaded))
    for doubt in doubts(loaded):
        console.print(f"check {doubt}", highlight=False, markup=False)


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
        rows[f"error of {name.replace('_', ' ')}"] = partial(error, predict=predict)
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
