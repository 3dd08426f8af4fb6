"""Arguments and options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

__all__ = ["ModelOption", "PhotoOption", "RecordingArgument", "ResumeOption", "RopeModelOption"]

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
PhotoOption = Annotated[
    bool,
    typer.Option(
        "--photo",
        help="Draw picture.png, and motion.mp4 with --video, as photographs, which take minutes each.",
    ),
]
ResumeOption = Annotated[bool, typer.Option("--resume", help="Go on from the journal of a search that was stopped.")]
