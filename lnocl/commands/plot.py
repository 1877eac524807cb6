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
        is_input=True,
        help="FITS file that lnocl deconvolve or lnocl demo has written, or the truth.fits of "
        "lnocl simulate",
    ),
    *output_folder("the figures, PNG files", required=True),
]


def _run(arguments: argparse.Namespace) -> None:
    from lnocl.studies import figures

    for line in figures.draw(arguments.output, arguments.results, arguments.overwrite):
        messages.say([line])


COMMAND = Command(
    "draw a picture of each result, and several beside each other",
    {"": OPTIONS},
    _run,
)
