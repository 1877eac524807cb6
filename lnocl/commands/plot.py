"""The command ``plot``: draw pictures and figures from results."""

from __future__ import annotations

import argparse
from collections.abc import Iterator

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


def _run(arguments: argparse.Namespace) -> Iterator[str]:
    from lnocl.studies import figures

    return figures.draw(arguments.output, arguments.results, arguments.overwrite)


COMMAND = Command(
    "draw a picture of each result, and several beside each other",
    {"": OPTIONS},
    _run,
)
