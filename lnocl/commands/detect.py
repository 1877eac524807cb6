"""The command ``detect``: sources beside the stars of a result, at a rate of false alarms."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from lnocl.commands import options, pictures
from lnocl.commands.again import RerunOfFile
from lnocl.commands.declared import parameter
from lnocl.commands.messages import MAX_LISTED
from lnocl.commands.parser import Command
from lnocl.errors import counted
from lnocl.process import ignored_notes
from lnocl.result import Result
from lnocl.result.summary import with_error

if TYPE_CHECKING:
    from astropy.table import QTable

    from lnocl.io.frames import Frames
    from lnocl.plotting.significance import SignificanceView
    from lnocl.significance import Significance

SOURCES = (
    parameter(Result.significance, "width", metavar="FWHM"),
    parameter(Result.significance, "false_alarms", metavar="N"),
    parameter(Result.significance, "images_of", metavar="FILTER"),
)
OPTIONS = [
    options.result("the detections and the map of signal-to-noise are added to it"),
    *SOURCES,
    options.table_output("detections too", metavar="TABLE.ecsv"),
    options.PICTURE.but(help="picture of the map with the detections and their numbers"),
    options.OVERWRITE.but(help="replace TABLE and FILE.png if they exist"),
    *options.HOW_MUCH_IS_SAID,
]


def _run(arguments: argparse.Namespace) -> list[str]:
    from lnocl.io.fitsadd import add_parts

    found, again = find(arguments, "detections")
    table, unit = in_unit(found.detections, again.frames), again.frames.unit
    parts = {"DETECTIONS": table, "SIGNAL": found.signal_to_noise}
    add_parts(again.saved, parts, cards(arguments, found, unit), unit)
    view = found.view(signal=found.signal_to_noise)
    lines = _summary_lines(found, table, arguments.images_of)
    return finish(arguments, view, table, "detections", lines)


def find(arguments: argparse.Namespace, content: str) -> tuple[Significance, RerunOfFile]:
    """Return the significance of sources in a result, and what its run was made of."""
    from lnocl.io import atomic, tables
    from lnocl.significance import check_search, significance

    check_search(arguments.width, arguments.false_alarms)

    def check() -> None:
        if arguments.output is not None:
            tables.format_of(arguments.output, content)
            atomic.check_output(arguments.output, arguments.overwrite)
        pictures.check(arguments)

    check()  # before the result is read; then that nothing that it was made of is replaced
    again = RerunOfFile.read(arguments.result, arguments.quiet, check)
    outcome = again.outcome().of_filter(arguments.images_of)
    with ignored_notes():
        return significance(outcome, arguments.width, arguments.false_alarms), again


def in_unit(table: QTable, frames: Frames) -> QTable:
    """Return a table with its fluxes in the unit of the images, and angles on the sky if known."""
    from astropy import units as u

    from lnocl.io import sky

    table, unit = table.copy(), u.Unit(frames.unit)
    for name in table.colnames:
        if name.startswith("flux"):
            table[name] = table[name].value / frames.electrons * unit
    if "x" in table.colnames and len(table) and sky.has_celestial(frames.header):
        places = np.array([table["x"].value, table["y"].value]).T
        table["ra"], table["dec"] = sky.to_sky(places, frames.header).T * u.deg
    if scale := sky.pixel_scale(frames.header):
        separation, at = scale * table["distance"].value * u.arcsec, table.index_column("distance")
        table.add_column(separation, at + 1, "separation")
    return table


def cards(
    arguments: argparse.Namespace, found: Significance, unit: str
) -> list[tuple[str, Any, str]]:
    """Return the header cards that say what was looked for, and the unit of fluxes."""
    from lnocl.io.parts import ascii_of

    return [
        ("SRCWIDTH", found.width, "FWHM of the sources, pixels; 0: points"),
        ("FALSALRM", found.false_alarms, "false alarms expected in the field"),
        ("THRESHOL", found.threshold, "signal-to-noise of detections"),
        ("FLUXUNIT", unit, "unit of fluxes"),
        *([("IMAGESOF", ascii_of(arguments.images_of), "filter")] if arguments.images_of else []),
    ]


def finish(
    arguments: argparse.Namespace,
    view: SignificanceView,
    table: QTable,
    content: str,
    lines: Sequence[str],
) -> list[str]:
    """Write table and picture where they are asked for; return the lines, and what was done."""
    said = [*lines, f"added to {arguments.result}"]
    if arguments.output is not None:
        from lnocl.io.tables import write_table

        table.meta["ORIGIN"] = "x and y begin at 0"
        write_table(table, arguments.output, content, arguments.overwrite)
        said.append(f"written to {arguments.output}")
    if arguments.plot is not None:
        from lnocl.plotting.significance import draw_significance

        said.append(pictures.draw(arguments, draw_significance(view)))
    return said


def _summary_lines(found: Significance, table: QTable, images_of: str | None) -> list[str]:
    """Return a line for the field and one for each of the most significant detections."""
    tested = f" in images of {images_of}" if images_of else ""
    what = f"source {found.width:g} pixels wide" if found.width else "point"
    lines = [
        f"{counted(len(table), 'detection')}{tested} above {found.threshold:.2f} standard "
        f"deviations, which noise exceeds {found.false_alarms:g} times in such a field "
        f"({100 * np.isfinite(found.signal_to_noise).mean():.3g} % of it was tested for a {what})"
    ]
    for k, row in enumerate(table[:MAX_LISTED], 1):
        flux, away = with_error(row["flux"].value, row["flux_error"].value), row["distance"].value
        where = f" at {away:.1f} pixels from star {row['star']}" if row["star"] else ""
        kind = "" if row["kind"] == "point" or found.width else ": the extended source could be it"
        lines.append(
            f"{k}: ({row['x'].value:.2f}, {row['y'].value:.2f}){where}, signal-to-noise "
            f"{row['significance']:.1f}, flux {flux} {row['flux'].unit}{kind}"
        )
    if len(table) > MAX_LISTED:
        lines.append(f"and {len(table) - MAX_LISTED} more in the table DETECTIONS")
    return lines


COMMAND = Command(
    "find sources beside the stars of a result, at a stated rate of false alarms",
    {"": OPTIONS},
    _run,
    "The kind of a detection is point, or extended where the extended source could be it.",
)
