"""The command line: `torchdlo`, or `python -m torchdlo`."""

from __future__ import annotations

__all__ = ["main"]


def main(args: list[str] | None = None) -> None:
    """Run the command line; see `torchdlo.cli.app.main`."""
    from torchdlo.cli.app import main as run

    run(args)
