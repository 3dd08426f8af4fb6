"""The recordings in the package, for those who have none yet: `torchdlo sample`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

__all__ = ["FOLDER", "sample"]

FOLDER = Path(__file__).parents[1] / "data" / "sample_rope"
"""A recording of a rope with five trials, made by another simulator."""

FILMS = FOLDER.with_name("sample_film")
"""Films of it."""


def sample(
    out: Annotated[Path, typer.Argument(help="New folder for the recording.", metavar="DIR")],
    film: Annotated[bool, typer.Option("--film", help="Films in place of markers.")] = False,
) -> None:
    """Copy a recording in the package to a folder, to try the other commands and to see the format.

    [bold]Examples:[/bold]

    torchdlo sample rope && torchdlo calibrate rope

    torchdlo sample filmed --film && torchdlo calibrate filmed
    """
    from torchdlo.sysid.recordings.recording import check_new_folder

    check_new_folder(out)
    out.mkdir(parents=True, exist_ok=True)
    for file in (FILMS if film else FOLDER).iterdir():
        (out / file.name).write_bytes(file.read_bytes())
    typer.echo(f"{out}: a recording with {len(list(out.glob('*.npz')))} trials; next: torchdlo calibrate {out}")
