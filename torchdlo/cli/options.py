"""Arguments and options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from torchdlo.physics.execution import Execution

__all__ = [
    "ExecutionOption",
    "ModelOption",
    "OwnTaskOption",
    "PhotoOption",
    "RecordingArgument",
    "ResumeOption",
    "RopeModelOption",
    "execution_choice",
]

RecordingArgument = Annotated[
    Path,
    typer.Argument(help="Recording folder: rope.json, train_*.npz and test_*.npz.", metavar="PATH"),
]
ModelOption = Annotated[
    Path | None,
    typer.Option(
        "--model",
        help="Start from the parameters and effects of this model file, which calibrate or diagnose wrote.",
        metavar="FILE",
    ),
]
RopeModelOption = Annotated[
    Path | None,
    typer.Option(
        "--rope-model", help="What ropes are made of: model.json of a calibration or diagnosis.", metavar="MODEL"
    ),
]
OwnTaskOption = Annotated[
    str | None,
    typer.Option("--task", help="Where the task is, if it is one of your own.", metavar="FILE.py:CLASS"),
]
ExecutionOption = Annotated[
    str | None,
    typer.Option(
        "--execution",
        help="How steps run: compiled takes a minute or more at first and is many times faster then, recorded takes "
        "seconds at first, eager begins at once. Default: compiled for searches, else recorded. A trajectory is played "
        "as it was found.",
        metavar="compiled|recorded|eager",
    ),
]
PhotoOption = Annotated[
    bool,
    typer.Option(
        "--photo",
        help="Draw picture.png, and motion.mp4 with --video, as photographs, which take minutes each.",
    ),
]
ResumeOption = Annotated[bool, typer.Option("--resume", help="Go on from the journal of a search that was stopped.")]


def execution_choice(given: str | None) -> Execution | None:
    """Return how steps are to run, or None where it was not said."""
    from torchdlo.physics.execution import check_execution

    return None if given is None else check_execution(given, "--execution")
