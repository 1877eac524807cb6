"""The command ``errors``: errors of a result that is there, by replicas of its run."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from lnocl.commands import bootstrap, options
from lnocl.commands.again import Again
from lnocl.commands.declared import parameter
from lnocl.commands.options import option
from lnocl.commands.parser import Command
from lnocl.errors import note
from lnocl.process import ignored_notes
from lnocl.result import Result

if TYPE_CHECKING:
    from lnocl.io.frames import Frames
    from lnocl.runs.bootstrap import Part

OPTIONS = [
    options.result("its errors are added to it, after those of replicas that it has"),
    parameter(Result.bootstrap, "n", "--bootstrap"),
    option(
        "--regions",
        metavar="FILE",
        is_input=True,
        help="circles, ellipses, boxes, annuli or polygons whose light is measured: a file such as "
        "DS9 writes, in pixels of the extended source or on the sky",
    ),
    option(
        "--profiles",
        metavar="FILE",
        is_input=True,
        help="boxes along whose longer sides light and width are measured, pixel by pixel: such a "
        "file; lnocl plot draws them with their errors",
    ),
    parameter(Result.bootstrap, "seed", metavar="S"),
    options.parallel("replicas"),
    options.OVERWRITE.but(help="begin anew, without the replicas that RESULT.fits has"),
    options.QUIET,
]


def _run(arguments: argparse.Namespace) -> list[str]:
    from lnocl.parallel import check_parallel
    from lnocl.runs.bootstrap import check_number

    check_parallel(arguments.parallel)
    check_number(arguments.bootstrap, arguments.seed)
    again = Again.read(arguments.result, arguments.quiet)
    parts = _parts(arguments, again.frames)
    if not arguments.overwrite:
        bootstrap.check_seed(arguments.result, arguments.seed)
    outcome = again.outcome()
    with ignored_notes():
        lines = bootstrap.add_errors(arguments, outcome, again, parts)
    return [*lines, f"added to {arguments.result}"]


def _parts(arguments: argparse.Namespace, frames: Frames) -> list[Part]:
    """Return the regions and profiles that were given."""
    given = arguments.regions or (), arguments.profiles or ()
    if not any(given):
        return []
    from lnocl.io.regions import read_parts

    if (oversample := frames.observation.oversample) > 1:
        note(
            "`regions` in pixels are in those of the extended source, %d to one of the images",
            oversample,
        )
    return read_parts(*given, frames.header, frames.observation)


COMMAND = Command(
    "add errors of stars, regions and pixels to a result, by replicas of its run",
    {"": OPTIONS},
    _run,
)
