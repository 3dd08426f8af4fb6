"""The command line: `torchdlo`, or `python -m torchdlo`."""

from __future__ import annotations

__all__ = ["main"]


def main(args: list[str] | None = None) -> None:
    """Run the command line; see `torchdlo.cli.app.main`."""
    from torchdlo.cli import ending

    # Importing the commands takes a moment, in which somebody may stop them.
    with ending.caught(args):
        from torchdlo.cli.app import main as run

        run(args)
