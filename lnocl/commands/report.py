"""The command ``report``: a result as one page of HTML."""

from __future__ import annotations

import argparse
from collections.abc import Iterator

from lnocl.commands import options
from lnocl.commands.options import option
from lnocl.commands.parser import Command
from lnocl.errors import InputError

OPTIONS = [
    option(
        "result",
        metavar="RESULT",
        is_input=True,
        help="FITS file that lnocl deconvolve has written, with --residuals for all pictures",
    ),
    option("-o", "--output", required=True, metavar="REPORT.html", help="page to write"),
    options.OVERWRITE.but(help="replace REPORT.html if it exists"),
]


def _run(arguments: argparse.Namespace) -> Iterator[str]:
    from lnocl.io import atomic
    from lnocl.studies import reports

    if not arguments.output.lower().endswith((".html", ".htm")):
        raise InputError(
            f"the report is a page of HTML; give it a name ending in .html, not {arguments.output}"
        )
    atomic.check_output(arguments.output, arguments.overwrite)
    page = reports.report(arguments.result)
    atomic.write_text(arguments.output, page, arguments.overwrite)
    yield f"written to {arguments.output}: open it in a browser"


COMMAND = Command(
    "write a result as one page of HTML: whether to trust it, pictures to blink, all its tables",
    {"": OPTIONS},
    _run,
)
