"""The command ``plot``: draw the figures from results."""

from __future__ import annotations

import argparse

from lnocl.commands import messages
from lnocl.commands.arguments import Command, add_folder


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "results",
        nargs="+",
        metavar="RESULT",
        help="FITS file that lnocl deconvolve, lnocl demo or examples/hh34_table.py has written",
    )
    parser.add_argument(
        "--truth", metavar="TRUTH", help="FITS file with the true source, of lnocl simulate"
    )
    add_folder(parser, "the figures, PNG files", required=True)


def _run(arguments: argparse.Namespace) -> None:
    from lnocl.studies import figures

    for line in figures.draw(
        arguments.output, arguments.results, arguments.truth, arguments.overwrite
    ):
        messages.say([line])


COMMAND = Command(
    "draw the paper's figures from results: objects, errors, magnitude and profiles",
    _add_arguments,
    _run,
)
