"""What the scripts share: options from the command line, else the environment, else the default; and saving."""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path
from typing import Any, NoReturn

import configargparse


class Parser(configargparse.ArgumentParser):
    """Reads option `--some-thing` of a script `name.py` from TORCHDLO_NAME_SOME_THING as well, see `--help`."""

    def __init__(self, script: str, **choices: Any) -> None:
        self.prefix = f"TORCHDLO_{Path(script).stem.upper()}_"
        super().__init__(
            auto_env_var_prefix=self.prefix, formatter_class=argparse.RawDescriptionHelpFormatter, **choices
        )

    def error(self, message: str) -> NoReturn:
        """Exit with code 2; names what the environment sets, which is easily forgotten."""
        given = [f"{name}={value}" for name, value in sorted(os.environ.items()) if name.startswith(self.prefix)]
        super().error(message + (f" (set in the environment: {', '.join(given)})" if given else ""))

    def flag(self, name: str, text: str) -> None:
        """Add an option that is on or off; `--no-NAME` turns off what the environment turned on."""
        self.add_argument(f"--{name}", action=argparse.BooleanOptionalAction, default=False, help=text)


def count(text: str) -> int:
    """Read a whole number from 1 up."""
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"{text} is given; expected a whole number from 1 up")
    return number


def save(path: str, content: Any) -> None:
    """Write JSON to a file that is complete at all times; nothing if the path is empty."""
    if not path:
        return
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    scratch = target.with_name(f".{os.getpid()}-{target.name}")
    try:
        scratch.write_text(json.dumps(content, indent=1) + "\n")
        os.replace(scratch, target)
    finally:
        scratch.unlink(missing_ok=True)
