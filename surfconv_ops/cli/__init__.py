"""The command line, ``python -m surfconv_ops COMMAND``: one module for each command."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from . import levels
from .common import CommandError

PROGRAM = "python -m surfconv_ops"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command.

    Args:
        arguments: The words after the program's name; None for those of this process.

    Returns:
        The exit status: 0, or 1 where the command could not do its work.
    """
    parser = argparse.ArgumentParser(prog=PROGRAM, description="Tools for SurfConv's users.")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    levels.add_parser(commands)
    chosen = parser.parse_args(arguments)
    try:
        chosen.run(chosen)
    except CommandError as error:
        print(f"{PROGRAM} {chosen.command}: error: {error}", file=sys.stderr)
        return 1
    return 0
