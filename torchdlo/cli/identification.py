"""Commands of identification: calibrate, diagnose, design the next experiment; slow imports wait until they run."""

from __future__ import annotations

import shlex
import shutil
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from torchdlo.cli.ending import stopped
from torchdlo.cli.options import ModelOption, RecordingArgument, ResumeOption
from torchdlo.cli.progress import at_work, deferred_interrupt, progress
from torchdlo.errors import InputError
from torchdlo.files import check_writable, write_atomically

if TYPE_CHECKING:
    from torchdlo.sysid.estimation.result import Calibration
    from torchdlo.sysid.recordings.recording import Recording

__all__ = ["calibrate", "design_experiment", "diagnose"]

_QUICK: dict[str, Any] = {"starts": 12, "iterations": 5}
"""What --quick sets unless the options say otherwise."""


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
    method: Annotated[
        str,
        typer.Option(
            help="Of films: gradient fits the stiffness along the rope as well, by the gradient of masks through "
            "rasteriser and physics; auto stays with few numbers, for which differences are quicker.",
            metavar="auto|differences|gradient",
        ),
    ] = "auto",
    quick: Annotated[bool, typer.Option("--quick", help="A rough fit in a fraction of the time.")] = False,
    resume: Annotated[bool, typer.Option("--resume", help="Go on from what is kept beside the model file.")] = False,
) -> None:
    """Fit a rope model to the train trials and judge it on the test trials.

    Ctrl-C stops after the running iteration and keeps the best found so far; of films --resume goes on from its fits.

    [bold]Examples:[/bold]

    torchdlo calibrate my_rope

    torchdlo calibrate my_rope --out runs/my_rope/model.json --starts 16 --seed 1

    torchdlo calibrate my_rope --quick --json | jq .test_mae_mm

    torchdlo calibrate my_rope --model runs/diagnose/my_rope/model.json
    """
    from torchdlo.sysid.recordings.recording import load_recording
    from torchdlo.sysid.recordings.unit_doubts import doubts

    loaded = load_recording(recording)
    _spare_cores(loaded)
    for doubt in doubts(loaded):
        typer.echo(f"check {doubt}", err=True)
    if out is None:
        out = Path("runs") / "calibrate" / recording.resolve().name / "model.json"
    elif out.is_dir() or out.suffix != ".json":
        out = out / "model.json"
    kept = out.with_name("journal" if loaded.filmed else "checkpoint.json")
    _check_outputs(out, kept, resume)
    options: dict[str, Any] = {"starts": starts, "iterations": iterations, "vertices": vertices}
    if quick:
        options = {name: value or _QUICK.get(name) for name, value in options.items()} | {"refined": False}
    options = {name: value for name, value in options.items() if value is not None} | _given(model)
    with at_work(out.parent, *_written(out)):
        result = _run_calibration(
            loaded,
            seed=seed,
            rest=rest,
            method=method,
            checkpoint=kept,
            resume=resume,
            **options,
        )
        _write_outputs(result, loaded, recording, out, quiet=as_json)
        if loaded.filmed:
            shutil.rmtree(kept, ignore_errors=True)
    if as_json:
        from torchdlo.sysid.estimation.result import summary_json

        typer.echo(summary_json(result, recording), nl=False)
    if result.interrupted:
        raise stopped(f"the best so far is in {out}", resume=True)


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
    exclude_effect: Annotated[
        list[str] | None, typer.Option(help="An effect not to look for; may be repeated.", metavar="EFFECT")
    ] = None,
    resume: ResumeOption = False,
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
    from torchdlo.sysid.diagnosis.effect_search import diagnose as search
    from torchdlo.sysid.diagnosis.findings import findings_json, limits_text, model_json, summary
    from torchdlo.sysid.recordings.recording import load_recording
    from torchdlo.sysid.recordings.unit_doubts import doubts

    loaded = load_recording(recording)
    _spare_cores(loaded)
    for doubt in doubts(loaded):
        typer.echo(f"check {doubt}", err=True)
    out = out or Path("runs") / "diagnose" / recording.resolve().name
    names = ("findings.json", "model.json", report.PAGE)
    for name in names:
        check_writable(out / name)
    options: dict[str, Any] = {
        "budget": budget,
        "seed": seed,
        "vertices": vertices,
        "trials": trials,
        "workers": workers,
    }
    options |= _given(model) | {"without": exclude_effect or ()}
    journal = out / "journal"
    with at_work(out, *names):
        try:
            with progress() as show, deferred_interrupt(show) as callback:
                result = search(loaded, **options, callback=callback, journal=journal, resume=resume)
        except KeyboardInterrupt:
            raise stopped(*_begun(journal, "verdict")) from None
        # What cannot be trusted was taken out of it.
        loaded = result.model.recording
        write_atomically(out / "findings.json", findings_json(result, loaded))
        write_atomically(out / "model.json", model_json(result))
        page = report.write_report(result, loaded, out, command=shlex.join(["torchdlo", *sys.argv[1:]]))
        shutil.rmtree(journal, ignore_errors=True)
    typer.echo(summary(result, loaded), err=as_json)
    if limits := limits_text(result):
        typer.echo(limits, err=as_json)
    for trial in result.misleading:
        typer.echo(f"{trial.name} counts up to {trial.time:.2f} s only: {trial.why}", err=as_json)
    for fault in result.data_issues:
        typer.echo(f"data: {fault.trial + ': ' if fault.trial else ''}{fault.message}", err=as_json)
    typer.echo(f"findings: {out / 'findings.json'}\nreport:   {page}", err=as_json)
    if as_json:
        typer.echo(findings_json(result, loaded), nl=False)


def design_experiment(
    recording: RecordingArgument,
    findings: Annotated[
        Path | None,
        typer.Option(
            help="Folder of a finished diagnosis. Default: runs/diagnose/NAME, unless --effects are given.",
            metavar="DIR",
        ),
    ] = None,
    effects: Annotated[
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
    seed: Annotated[int | None, typer.Option(min=0, help="Seed of the search. Default: 0.")] = None,
    vertices: Annotated[int | None, typer.Option(min=3, help="Vertices of the simulated rope.")] = None,
    workers: Annotated[int | None, typer.Option(min=1, help="Processes; one per core if not given.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the design as JSON.")] = False,
    model: Annotated[
        Path | None,
        typer.Option(
            help="Of films, and with --camera: model file that is taken for true. Default: "
            "runs/calibrate/NAME/model.json.",
            metavar="FILE",
        ),
    ] = None,
    camera: Annotated[
        str,
        typer.Option(
            help="Of a recording with markers: where a camera would have to stand. `nominal` for one of 640 x 480 "
            "pixels, or a cameras.json: its cameras are those at hand. Of films: what the new one is like.",
            metavar="nominal|FILE",
        ),
    ] = "",
    resume: ResumeOption = False,
) -> None:
    """Find the motion of the grippers that tells apart effects which a recording cannot.

    Of a recording with films, or with --camera: find the place of one more camera that shows what those at hand cannot,
    and the motion and the place that tell most of the rope's parameters, or of --effects.

    Ctrl-C stops after the running step; --resume goes on from there.

    [bold]Examples:[/bold]

    torchdlo design-experiment my_rope

    torchdlo design-experiment my_rope --effects wind,tilted_gravity --seconds 4

    torchdlo design-experiment my_rope --camera nominal --effects rest_curvature
    """
    from torchdlo.report.pages import design_page as report
    from torchdlo.sysid.experiment_design import design as designs
    from torchdlo.sysid.recordings.recording import load_recording

    loaded = load_recording(recording)
    asked, name = [n.strip() for n in effects.split(",") if n.strip()], recording.resolve().name
    if loaded.filmed or camera:
        ignored: dict[str, Any] = {"--findings": findings, "--seed": seed, "--vertices": vertices, "--workers": workers}
        ignored |= {"--tip-mass": tip_mass or None, "--resume": resume or None}
        if found := ", ".join(option for option, value in ignored.items() if value is not None):
            raise InputError(f"{recording}: expected none of {found} for films or with --camera, which take no such.")
        path = model or Path("runs") / "calibrate" / name / "model.json"
        out = out or Path("runs") / "design" / name
        return _place_cameras(loaded, path, out, camera, as_json, seconds=seconds, scale=scale, effects=asked)
    if model is not None:
        raise InputError(
            f"{recording}: expected --model for films only, or with --camera; --findings says what to start from."
        )
    if findings is None and not asked:
        findings = Path("runs") / "diagnose" / name
    out = out or Path("runs") / "design" / name
    for file in report.FILES[:-1]:
        check_writable(out / file)
    if (out / "motion.npz").exists() and not (out / "design.json").exists():
        raise InputError(f"{out / 'motion.npz'}: exists without design.json; move it away or choose another --out.")
    options: dict[str, Any] = {"seconds": seconds, "scale": scale, "mass": tip_mass, "seed": seed or 0}
    journal = out / "journal"
    options |= {"vertices": vertices, "workers": workers, "journal": journal, "resume": resume}
    with at_work(out, *report.FILES):
        try:
            with progress() as show, deferred_interrupt(show) as callback:
                design = designs.design_experiment(loaded, asked, findings=findings, callback=callback, **options)
        except KeyboardInterrupt:
            raise stopped(*_begun(journal, "result")) from None
        report.write_design(design, out, command=shlex.join(["torchdlo", *sys.argv[1:]]))
        shutil.rmtree(journal, ignore_errors=True)
    typer.echo(f"{designs.design_summary(design)}\n", err=as_json)
    typer.echo("\n".join(f"- {said}" for said in designs.rationale(design)), err=as_json)
    typer.echo(f"\n{report.design_table(design)}\n", err=as_json)
    typer.echo(f"motion: {out / 'motion.npz'}\nreport: {out / 'report.html'}", err=as_json)
    if as_json:
        typer.echo(designs.design_json(design), nl=False)


def _place_cameras(recording: Recording, model: Path, out: Path, camera: str, as_json: bool, **options: Any) -> None:
    from torchdlo.report.pages import camera_page as report
    from torchdlo.sysid.model import model_file
    from torchdlo.sysid.video import camera_placement
    from torchdlo.vision.camera import load_cameras

    if camera == "nominal":
        options["lens"] = camera_placement.nominal_camera()
    elif camera:
        options["cameras"] = load_cameras(camera)
        options["lens"] = options["cameras"][0]

    for file in report.FILES[:-1]:
        check_writable(out / file)
    if (out / "motion.npz").exists() and not (out / "design.json").exists():
        raise InputError(f"{out / 'motion.npz'}: exists without design.json; move it away or choose another --out.")
    given = model_file.load(model)
    with at_work(out, *report.FILES):
        try:
            with progress() as show, deferred_interrupt(show) as callback:
                design = camera_placement.place_cameras(recording, given, callback=callback, **options)
        except KeyboardInterrupt:
            raise stopped("nothing was written") from None
        report.write_placement(design, out, command=shlex.join(["torchdlo", *sys.argv[1:]]))
    typer.echo(f"{camera_placement.camera_summary(design)}\n", err=as_json)
    typer.echo("\n".join(f"- {said}" for said in camera_placement.recorded_notes(design)), err=as_json)
    if design.recorded is not None:
        typer.echo(f"\nThe recorded motion:\n{report.places_table(design.recorded)}", err=as_json)
    typer.echo(f"\nAnother motion:\n{report.camera_table(design)}\n", err=as_json)
    typer.echo(f"cameras: {out / 'cameras.json'}\nreport:  {out / 'report.html'}", err=as_json)
    if as_json:
        typer.echo(camera_placement.camera_json(design), nl=False)


def _spare_cores(recording: Recording) -> None:
    """Fit to films in one thread: a second one makes that no faster, and costs two thirds as much again."""
    import torch

    if recording.filmed:
        torch.set_num_threads(1)


def _run_calibration(recording: Recording, **options: Any) -> Calibration:
    # Imported before the bar starts: a first import of torch takes seconds.
    from torchdlo.sysid.calibration.calibrate import calibrate as fit

    try:
        with progress() as show, deferred_interrupt(show) as callback:
            return fit(recording, workers=None, callback=callback, **options)
    except KeyboardInterrupt:
        raise stopped(*_begun(options["checkpoint"], "result")) from None


def _begun(journal: Path, what: str) -> tuple[str, bool]:
    """Return what is left of a search that was stopped, and whether it can go on."""
    if journal.exists():
        return f"there was no {what} yet, and what is done is kept in {journal}", True
    return f"there was no {what} yet, and nothing was written", False


def _given(model: Path | None) -> dict[str, Any]:
    """Return the option of a search that starts from a model file."""
    if model is None:
        return {}
    from torchdlo.sysid.model import model_file

    return {"given": model_file.load(model)}


def _written(out: Path) -> tuple[str, ...]:
    """Return the names of what a calibration writes."""
    from torchdlo.report.pages import calibration as report

    return (out.name, "calibration.json", "checkpoint.json", report.PAGE, report.PICTURE)


def _check_outputs(out: Path, kept: Path, resume: bool) -> None:
    """Refuse before the work what could not be written after it."""
    for name in _written(out):
        check_writable(out.with_name(name))
    if resume and not kept.exists():
        raise InputError(
            f"{kept}: expected what an earlier calibration kept, to resume it, found none; leave out --resume."
        )


def _write_outputs(result: Calibration, recording: Recording, given: Path, out: Path, *, quiet: bool) -> None:
    from torchdlo.report.pages import calibration as report
    from torchdlo.sysid.estimation.result import model_json, summary_json

    command = shlex.join(["torchdlo", *sys.argv[1:]])
    write_atomically(out, model_json(result))
    write_atomically(out.with_name("calibration.json"), summary_json(result, given))
    page, _ = report.write_report(result, recording, out.parent, command=command)
    typer.echo(report.calibration_verdict(result, recording), err=quiet)
    for note in result.notes if recording.filmed else ():
        typer.echo(f"note: {note}", err=quiet)
    typer.echo(f"model:  {out}\nreport: {page}", err=quiet)
