"""The command ``limit``: how faint a source beside the stars of a result would have been found."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

import numpy as np

from lnocl.commands import detect, options
from lnocl.commands.options import option
from lnocl.commands.parser import Command
from lnocl.errors import in_words, warn
from lnocl.process import ignored_notes

if TYPE_CHECKING:
    from astropy.table import QTable

    from lnocl.significance import Significance

# Probabilities of being found at which sources are put in.
PUT_IN = 0.5, 0.9
# Distances from a star at which limits are said, pixels.
SHOWN = 3, 5, 10, 20, 50, 100, 200, 500, 1000
COLUMNS = "star", "distance", "separation", "threshold", "contrast50", "magnitudes50", "contrast90"
# Sources within so many resolutions of a star are counted apart.
NEAR = 3.0
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
        help="sources that are put into the images to check the limits: half of the flux that is "
        "found with 50 %% probability, half with 90 %%; 0 for none (default: %(default)s)",
    ),
    option(
        "--seed",
        type=int,
        default=0,
        metavar="S",
        needs=("injections",),
        help="seed of these sources, 0 or more (default: %(default)s)",
    ),
    options.table_output("curves too", metavar="TABLE.ecsv"),
    options.PICTURE.but(help="picture of the map of the limits and of their curves"),
    options.OVERWRITE.but(help="replace TABLE and FILE.png if they exist"),
    *options.HOW_MUCH_IS_SAID,
]


def _run(arguments: argparse.Namespace) -> list[str]:
    from lnocl.io.fitsadd import add_parts
    from lnocl.io.parts import COMPLETENESS
    from lnocl.significance import check_injections

    check_injections(arguments.injections or 1, arguments.seed)
    found, again = detect.find(arguments, "limits")
    frames = again.frames
    table = detect.in_unit(found.contrast_curves([each / 100 for each in COMPLETENESS]), frames)
    maps = {f"LIMIT{each}": found.limit(each / 100) / frames.electrons for each in COMPLETENESS}
    cards = detect.cards(arguments, found, frames.unit)
    add_parts(again.saved, {"LIMITS": table, **maps}, cards, frames.unit)
    lines = _summary_lines(found, table, maps["LIMIT50"], frames.unit)
    with ignored_notes():
        lines += _checked(found, arguments)
    view = found.view(frames.unit, limit=maps["LIMIT50"], curves=dict(table.items()))
    return detect.finish(arguments, view, table, "limits", lines)


def _summary_lines(found: Significance, table: QTable, limit: np.ndarray, unit: str) -> list[str]:
    """Return a line for the whole field, and some rows of the curves."""
    what = f"source {found.width:g} pixels wide" if found.width else "point"
    lines = [
        f"a {what} of {np.nanmedian(limit):.4g} {unit} is found with a probability of 50 % (median "
        f"of the field), at {found.false_alarms:g} false alarms in the field"
    ]
    is_lit = np.isfinite(table["contrast50"])
    dark = np.setdiff1d(table["star"], table["star"][is_lit])
    lines += [f"star {star} has no light, and nothing is faint beside it" for star in dark]
    # Rows begin at the inner working angle.
    is_shown = (np.diff(table["star"], prepend=0) > 0) | np.isin(table["distance"].value, SHOWN)
    names = [name for name in COLUMNS if name in table.colnames]
    shown = table[names][is_lit & is_shown & (table["star"] <= detect.MAX_LISTED)]
    for name in names[1:]:
        shown[name].info.format = ".3g"
    return lines + shown.pformat(max_lines=-1, max_width=-1) if len(shown) else lines


def _checked(found: Significance, arguments: argparse.Namespace) -> list[str]:
    """Put sources in, and return how many of them are found."""
    from scipy.stats import binom

    lines, close = [], NEAR * found.resolution
    numbers = (arguments.injections + 1) // 2, arguments.injections // 2
    for n, share in zip(numbers, PUT_IN, strict=True):
        if not n:
            continue
        sources = found.inject(n, share, arguments.seed, not arguments.quiet)
        near = sources[sources["distance"].value < close]
        for some, where in ((sources, ""), (near, f" within {close:.1f} pixels of a star")):
            n, k = len(some), int(some["found"].sum())
            if not n:
                continue
            error = np.sqrt(share * (1.0 - share) / n)
            lines.append(
                f"of {n} sources put in{where} at the limit of {100 * share:g} %, {k} are found: "
                f"{100 * k / n:.0f} +- {100 * error:.0f} %"
            )
            if binom.cdf(k, n, share) < RARE:
                remedy = "trust only the limits that injections show"
                if places := [in_words(place) for place in found.detections.iterrows("x", "y")]:
                    remedy = f"name what is a star of {', '.join(places)} as `stars`, and run again"
                warn(
                    f"the limit of {100 * share:g} % is too faint{where}: of {n} sources put in "
                    f"{k} are found; {remedy}"
                )
    return lines


COMMAND = Command(
    "say how faint a source beside the stars of a result would have been found",
    {"": OPTIONS},
    _run,
    "The limits are checked by sources that are put into the images, which are deconvolved again.",
)
