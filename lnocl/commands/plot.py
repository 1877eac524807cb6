"""The command ``plot``: draw pictures and figures from results."""

from __future__ import annotations

import argparse

from lnocl.commands import messages
from lnocl.commands.options import option, output_folder
from lnocl.commands.parser import Command

OPTIONS = [
    option(
        "results",
        nargs="+",
        metavar="RESULT",
        help="FITS file that lnocl deconvolve, lnocl demo or benchmarks/hh34_table.py has written",
    ),
    *output_folder("the figures, PNG files", required=True),
    option("--truth", metavar="TRUTH", help="FITS file with the true source, of lnocl simulate"),
]


def _run(arguments: argparse.Namespace) -> None:
    from lnocl.studies import figures

    for line in figures.draw(
        arguments.output, arguments.results, arguments.truth, arguments.overwrite
    ):
        messages.say([line])


COMMAND = Command(
    "draw a picture of each result, several beside each other, and the paper's figures where the "
    "truth is given",
    {"": OPTIONS},
    _run,
)
