"""The command line: the entry and the table of its subcommands; nothing numerical."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from lnocl import loading
from lnocl.commands import (
    batch,
    bench,
    deconvolve,
    demo,
    detect,
    devices,
    environment,
    errors,
    limit,
    messages,
    plot,
    psf,
    report,
    running,
    selftest,
    simulate,
    stars,
)
from lnocl.commands.parser import Parser

# In the order of the help.
COMMANDS = {
    "deconvolve": deconvolve.COMMAND,
    "batch": batch.COMMAND,
    "errors": errors.COMMAND,
    "detect": detect.COMMAND,
    "limit": limit.COMMAND,
    "psf": psf.COMMAND,
    "stars": stars.COMMAND,
    "plot": plot.COMMAND,
    "report": report.COMMAND,
    "demo": demo.COMMAND,
    "simulate": simulate.COMMAND,
    "bench": bench.COMMAND,
    "devices": devices.COMMAND,
    "selftest": selftest.COMMAND,
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
