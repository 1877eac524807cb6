"""The command ``limit``: how faint a source beside the stars of a result would have been found."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

import numpy as np

from lnocl.commands import detect, options
from lnocl.commands.options import option
from lnocl.commands.parser import Command
from lnocl.errors import warn
from lnocl.process import ignored_notes

if TYPE_CHECKING:
    from astropy.table import QTable

    from lnocl.significance import Significance

# Probabilities of being found at which sources are put in.
PUT_IN = 0.5, 0.9
# A share that is found is not the stated one where it is as rare as this.
RARE = 1e-3

OPTIONS = [
    options.result("curves and maps of the limits are added to it"),
    *detect.SOURCES,
    option(
        "--injections",
        type=int,
        default=100,
        metavar="N",
        help="sources that are put into the images to check the limits, half of them at that of "
        "50 %%, half at that of 90 %%; 0 for none (default: %(default)s)",
    ),
    option(
        "--seed",
        type=int,
        default=0,
        metavar="S",
        needs=("injections",),
        help="of these sources, 0 or more (default: %(default)s)",
    ),
    options.table_output("curves too", metavar="TABLE.ecsv"),
    options.PICTURE.but(help="picture of the map of the limits and of their curves"),
    options.OVERWRITE.but(help="replace TABLE and FILE.png if they exist"),
    options.QUIET,
    options.VERBOSE,
]


def _run(arguments: argparse.Namespace) -> list[str]:
    from lnocl.io.fitsadd import add_parts
    from lnocl.io.parts import COMPLETENESS
    from lnocl.significance import check_injections

    check_injections(arguments.injections or 1, arguments.seed)
    found, again = detect.find(arguments, "limits")
    frames = again.frames
    curves = found.contrast_curves([each / 100 for each in COMPLETENESS])
    table = detect.in_unit(curves, frames)
    maps = {f"LIMIT{each}": found.limit(each / 100) / frames.electrons for each in COMPLETENESS}
    cards = detect.cards(found, frames.unit)
    add_parts(again.saved, {"LIMITS": table, **maps}, cards, frames.unit)
    lines = _summary_lines(found, table, maps["LIMIT50"], frames.unit)
    with ignored_notes():
        lines += _checked(found, arguments)
    return detect.finish(arguments, found, table, "limits", lines, curves)


def _summary_lines(found: Significance, table: QTable, limit: np.ndarray, unit: str) -> list[str]:
    """Return a line for the whole field, and one for each star."""
    what = f"source {found.width:g} pixels wide" if found.width else "point"
    lines = [
        f"a {what} of {np.nanmedian(limit):.4g} {unit} is found with a probability of 50 % (median "
        f"of the field), at {found.false_alarms:g} false alarms in the field"
    ]
    stars = np.unique(table["star"])
    for star in stars[stars > 0][: detect.MAX_LISTED]:
        rows = table[table["star"] == star]
        if not np.isfinite(rows["magnitudes50"].value).any():
            lines.append(f"star {star} has no light, and nothing is faint beside it")
            continue
        shown = rows[np.unique(np.round(np.geomspace(1, len(rows), 4)).astype(int)) - 1]
        limits = ", ".join(
            f"{row['magnitudes50'].value:.2f} at {row['distance'].value:.1f}" for row in shown
        )
        lines.append(f"star {star}: magnitudes below it, at pixels from it: {limits}")
    return lines


def _checked(found: Significance, arguments: argparse.Namespace) -> list[str]:
    """Put sources in, and return how many of them are found."""
    from scipy.stats import binom

    lines = []
    numbers = (arguments.injections + 1) // 2, arguments.injections // 2
    for n, share in zip(numbers, PUT_IN, strict=True):
        if not n:
            continue
        sources = found.inject(n, share, arguments.seed, not arguments.quiet)
        k = int(sources["found"].sum())
        error = np.sqrt(share * (1.0 - share) / n)
        lines.append(
            f"of {n} sources put in at the limit of {100 * share:g} %, {k} are found: "
            f"{100 * k / n:.0f} +- {100 * error:.0f} %"
        )
        if binom.cdf(k, n, share) < RARE:
            warn(
                f"the limit of {100 * share:g} % is too faint: of {n} sources put in {k} are found;"
                " trust only the limits that injections show"
            )
    return lines


COMMAND = Command(
    "say how faint a source beside the stars of a result would have been found",
    {"": OPTIONS},
    _run,
    "The limits are checked by sources that are put into the images, which are deconvolved again.",
)
