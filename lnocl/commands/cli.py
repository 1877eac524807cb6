"""The command line: the entry and the table of its subcommands; nothing numerical."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib import import_module

from lnocl import loading
from lnocl.commands import environment, messages, running
from lnocl.commands.parser import Command, Parser

# The subcommands in the order of the help, each in the module of its name.
NAMES = (
    *("deconvolve", "batch", "errors", "detect", "limit", "psf", "stars", "plot", "report"),
    *("demo", "simulate", "bench", "devices", "selftest"),
)
COMMANDS: dict[str, Command] = {
    name: import_module(f"lnocl.commands.{name}").COMMAND for name in NAMES
}


def make_parser() -> Parser:
    """Return the parser of all subcommands, from which the site has their options."""
    return running.make_parser(COMMANDS)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Parameters
    ----------
    arguments : sequence of str, optional
        Arguments without the program's name; by default those of the process.

    Returns
    -------
    int
        Exit status: 0 done, 1 failed, 2 wrong use, 130 interrupted, 129 (SIGHUP) or 143
        (SIGTERM) terminated.
    """
    loading.end()
    messages.replace_closed_streams()
    environment.prepare()
    return running.run(COMMANDS, sys.argv[1:] if arguments is None else arguments)
