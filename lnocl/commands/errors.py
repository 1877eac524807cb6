"""The command ``errors``: errors of a result that is there, by replicas of its run."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from lnocl.commands import options
from lnocl.commands.again import RerunOfFile
from lnocl.commands.declared import parameter
from lnocl.commands.messages import MAX_LISTED
from lnocl.commands.options import option
from lnocl.commands.parser import Command
from lnocl.commands.running import written_as_done
from lnocl.core.scene.apertures import Aperture
from lnocl.errors import FileError, InputError, note
from lnocl.process import ignored_notes
from lnocl.result import Result
from lnocl.result.summary import rounded, with_error

if TYPE_CHECKING:
    from astropy.table import QTable

    from lnocl.core.runs.bootstrap import Bootstrap, Part
    from lnocl.core.runs.outcome import Outcome
    from lnocl.io.fitserrors import Held
    from lnocl.io.frames import Frames

# Names of quantities of stars and halos; others are of regions and profiles.
_OF_STARS = re.compile(r"star \d+( epoch \d+)? (flux|x|y)( in images of .*)?|halo \d+ image \d+")
OPTIONS = [
    options.result("errors are added to it; replicas that it has already count"),
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
    *options.HOW_MUCH_IS_SAID,
]


def _run(arguments: argparse.Namespace) -> list[str]:
    from lnocl.core.runs.bootstrap import check_number
    from lnocl.parallel import check_parallel

    check_parallel(arguments.parallel)
    check_number(arguments.bootstrap, arguments.seed)
    again = RerunOfFile.read(arguments.result, arguments.quiet)
    parts, before = _parts(arguments, again.frames), _replicas_before(arguments)
    outcome = again.outcome()
    with ignored_notes():
        lines = _add_errors(arguments, outcome, again, parts, before)
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


def _add_errors(
    arguments: argparse.Namespace,
    outcome: Outcome,
    again: RerunOfFile,
    parts: Sequence[Part],
    before: Held | None,
) -> list[str]:
    """Add the errors of a result to its file, as replicas are done; return what to say of them.

    Parameters
    ----------
    arguments : Namespace
        Those of ``lnocl errors``.
    outcome : Outcome
        What the run has found.
    again : RerunOfFile
        The file, and what its result was made of.
    parts : list of Aperture or Profile
        Regions and profiles that are measured.
    before : Held or None
        Replicas that the file has.
    """
    from lnocl.core.runs.bootstrap import bootstrap, without_replicas

    seed, frames = arguments.seed, again.frames
    latest: list[Bootstrap] = []

    def write() -> None:
        for found in latest:
            _write(again, found, parts, before)

    earlier = None
    if before is not None and not arguments.overwrite:
        expected = without_replicas(outcome, parts, seed)
        if not _held(expected, frames).is_start_of(before):
            raise _of_others(again.saved.path, before)
        earlier = dataclasses.replace(
            expected, errors=before.errors, of_psfs=before.of_psfs, sums=before.sums
        )
    with written_as_done(write) as write_where_due:

        def look(found: Bootstrap) -> None:
            latest[:] = [found]
            write_where_due()

        n, is_shown = arguments.bootstrap, not arguments.quiet
        found = bootstrap(outcome, n, parts, seed, is_shown, earlier, look, arguments.parallel)
    return _summarise(found, frames)


def _replicas_before(arguments: argparse.Namespace) -> Held | None:
    """Return the replicas that a file has; refuse those of another seed, unless to begin anew.

    Raises
    ------
    FileError, InputError
        As `read_replicas`; or there are such.
    """
    from lnocl.io.fitserrors import read_replicas

    with contextlib.suppress(*[FileError] * arguments.overwrite):  # as damaged ones are replaced
        held = read_replicas(arguments.result)
        if held is not None and held.seed != arguments.seed and not arguments.overwrite:
            raise _of_others(arguments.result, held)
        return held
    return None


def _of_others(path: str, held: Held) -> InputError:
    names = dict.fromkeys(name for name in held.names if not _OF_STARS.fullmatch(name))
    regions = f"the regions {', '.join([*names][:3])}" if names else "no regions"
    return InputError(
        f"{path} has replicas with `seed` {held.seed} of {regions}: give the same `regions`, "
        "`profiles` and `seed`, or take `overwrite` to begin anew"
    )


def _held(found: Bootstrap, frames: Frames) -> Held:
    from lnocl.io.fitserrors import Held

    names = [each.name.strip() for each in found.quantities]
    values = found.values / found.units(frames.electrons)
    return Held(names, values, found.errors, found.of_psfs, found.sums, found.seed)


def _write(
    again: RerunOfFile, found: Bootstrap, parts: Sequence[Part], before: Held | None
) -> None:
    from lnocl.io.fitserrors import write_errors

    frames = again.frames
    quantities = found.to_table(frames.electrons, frames.unit)
    quantities["name"] = [name.strip() for name in quantities["name"]]
    measured = quantities[[each.at is None for each in found.quantities]]
    ratios = {"RATIO": found.ratio_map, "RATIOERR": found.ratio_error_map}
    write_errors(
        again.saved,
        quantities,
        _held(found, frames),
        {
            "REGIONS": _table_of(parts, measured, _n_of_regions(found)),
            "ERROR": found.error_map / frames.electrons,
            "BIAS": found.bias_map / frames.electrons,
            "SHARE": found.share_map,
            **(ratios if len(found.ratio_map) else {}),
        },
        [
            ("NREPL", found.n, "replicas"),
            ("RESOLUT", found.resolution, "FWHM that maps are smoothed to, pixels"),
        ],
        frames.unit,
        before,
    )


def _n_of_regions(found: Bootstrap) -> int:
    """Return how many quantities are of regions, which have one of each component, and ratios."""
    return sum(each.at is None for each in found.quantities) - len(found.stated)


def _table_of(parts: Sequence[Part], measured: QTable, n_rows: int) -> QTable:
    """Return the regions, which are measured last, as a table: name, area, centre and flux.

    Of each region it has a row for each component, and for each ratio.
    """
    from astropy.table import QTable

    of_regions = measured[len(measured) - n_rows :]
    regions = [each for each in parts if isinstance(each, Aperture)]
    means = [
        [each.n_pixels, *(np.average(axis, weights=each.weights) for axis in each.places[::-1])]
        for each in regions
    ]
    each = np.repeat(np.reshape(means, (-1, 3)), n_rows // max(len(regions), 1), axis=0)
    columns = [of_regions["name"], *each.T]
    units = {"x": "pix", "y": "pix"}
    table = QTable(columns, names=("name", "pixels", "x", "y"), units=units)
    table["flux"] = of_regions["value"] - of_regions["bias"]
    for name in ("error", "share", "unit", "note"):
        table[name] = of_regions[name]
    return table


def _summarise(found: Bootstrap, frames: Frames) -> list[str]:
    """Return a line a quantity, first those of regions, which were asked for."""
    table = found.to_table(frames.electrons, frames.unit)
    table = table[[each.at is None for each in found.quantities]]  # profiles are to be drawn
    n_regions = _n_of_regions(found)
    table, n_listed = table[np.roll(np.arange(len(table)), n_regions)], max(MAX_LISTED, n_regions)
    without = n_regions and not len(found.of_psfs)
    of_regions = ", of regions without what PSFs have wrong" if without else ""
    lines = [f"errors by {found.n} replicas{of_regions}, less their bias; in brackets 95 %:"]
    for row in table[:n_listed]:
        note = f"; {row['note']}: do not trust its error" if row["note"] else ""
        if not _OF_STARS.fullmatch(row["name"]) and np.isfinite(row["share"]):
            note = f"; has light in {100 * row['share']:.0f} % of replicas{note}"
        if len(found.of_psfs):
            noise, psf = (rounded(*[row[each]] * 2) for each in ("error_noise", "error_psf"))
            note += f"; of replicas: noise {noise}, PSF {psf}"
        if "error_smoothing" in table.colnames and row["error"] <= row["error_smoothing"]:
            note += "; smoothing changes it by as much as the error"
        low, high = (rounded(row[end], row["error"]) for end in ("low95", "high95"))
        value = with_error(row["value"] - row["bias"], row["error"])
        value = f"{value} {row['unit']}".rstrip()  # a ratio has no unit
        lines.append(f"{row['name']}: {value} ({low} to {high}{note})")
    if len(table) > n_listed:
        lines.append(f"and {len(table) - n_listed} more in the table ERRORS")
    return lines


COMMAND = Command(
    "add errors of stars, regions and pixels to a result, by replicas of its run",
    {"": OPTIONS},
    _run,
    goes_on=": the same command goes on from the replicas that were written",
)
