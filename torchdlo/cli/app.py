"""The command `torchdlo`: its commands by groups, and what all of them do with errors.

Everything slow to import is imported inside the command that needs it, so that help is quick.
"""

from __future__ import annotations

import sys
from typing import Annotated

import typer

from torchdlo.cli import ending
from torchdlo.cli.agent import plan, propose
from torchdlo.cli.datasets import dataset, learn, sweep
from torchdlo.cli.doctor import doctor
from torchdlo.cli.identification import calibrate, design_experiment, diagnose
from torchdlo.cli.policies import evaluate, train
from torchdlo.cli.policy_deployment import deploy, distill, export
from torchdlo.cli.recordings import check, import_deform
from torchdlo.cli.sample import sample
from torchdlo.cli.scenes import simulate, view
from torchdlo.cli.tasks import optimize, play, tasks
from torchdlo.cli.video import calibrate_camera, film, segment
from torchdlo.errors import InputError
from torchdlo.untrusted.names import check_path, for_terminal

__all__ = ["app", "main"]

app = typer.Typer(
    name="torchdlo",
    help="Differentiable simulation of ropes, cables and wires, calibrated to real ones.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)


def main(args: list[str] | None = None) -> None:
    """Run the command line.

    What is wrong with the input is one line on stderr and exit code 2; Ctrl-C ends it with 130, SIGTERM with 143.
    """
    try:
        with ending.caught(args):
            for argument in sys.argv[1:] if args is None else args:
                check_path(" ".join(argument.split()), "name or option")
            app(args=args)
    except InputError as error:
        typer.echo("error: " + for_terminal(" ".join(str(error).splitlines())), err=True)
        raise SystemExit(2) from None
    except OSError as error:
        typer.echo(f"error: {for_terminal(ending.failed(error))}", err=True)
        raise SystemExit(1) from None


@app.callback(invoke_without_command=True)
def _root(
    version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False,
) -> None:
    if version:
        from torchdlo import __version__

        typer.echo(f"torchdlo {__version__}")
        raise typer.Exit


# Help lists them in this order.
app.command()(check)
app.command("import-deform")(import_deform)
app.command()(calibrate)
app.command()(diagnose)
app.command("design-experiment")(design_experiment)
app.command()(simulate)
app.command()(view)
app.command()(optimize)
app.command()(play)
app.command()(tasks)
app.command()(propose)
app.command()(plan)
app.command()(train)
app.command()(evaluate)
app.command()(distill)
app.command()(export)
app.command()(deploy)
app.add_typer(dataset)
app.command()(learn)
app.command()(sweep)
app.command("calibrate-camera")(calibrate_camera)
app.command()(segment)
app.command()(film)
app.command()(sample)
app.command()(doctor)


if __name__ == "__main__":
    main()
