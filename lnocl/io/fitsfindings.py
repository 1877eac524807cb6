"""FITS out and in: detections and limits of a result, in its file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from astropy.io import fits
from astropy.table import QTable, Table

from lnocl.io.fitsadd import add_hdus
from lnocl.io.fitsfile import open_fits
from lnocl.io.saved_results import SavedResult
from lnocl.scene.arrays import Array

# The extensions: sources and the map of signal-to-noise; curves of limits and their maps.
DETECTIONS, SIGNAL = "DETECTIONS", "SIGNAL"
LIMITS, LIMIT = "LIMITS", "LIMIT"
COMPLETENESS = 50, 90, 95


def write_findings(
    saved: SavedResult,
    name: str,
    table: QTable,
    maps: Mapping[str, tuple[Array, str]],
    cards: Sequence[tuple[str, Any, str]],
) -> None:
    """Add a table and maps of the sky to the file of a result, or replace those it has.

    Parameters
    ----------
    saved : SavedResult
        The result.
    name : str
        Of the table.
    table : QTable
        Its columns.
    maps : mapping of str to (ndarray of float64, str)
        Each map by its name, shape (ny, nx), and its unit.
    cards : sequence of (str, value, str)
        Header cards of all.

    Raises
    ------
    FileError
        The file cannot be read or written, or holds another result now.
    """
    columns = [_column(table, each) for each in table.colnames]
    added: list[fits.BinTableHDU | fits.ImageHDU] = [
        fits.BinTableHDU.from_columns(columns, name=name)
    ]
    for key, (values, _) in maps.items():
        added.append(fits.ImageHDU(np.asarray(values, np.float32), name=key))
    unit = next((str(table[each].unit) for each in table.colnames if each.startswith("flux")), "")
    for hdu in added:
        hdu.header.extend([*cards, ("FLUXUNIT", unit, "unit of fluxes")])
    add_hdus(saved, added, {key: unit for key, (_, unit) in maps.items()})


def _column(table: QTable, name: str) -> fits.Column:
    """Return a column of a table; FITS has no name for the unit of electrons that astropy takes."""
    column = table[name]
    values = np.asarray(column)
    kind = {"f": "D", "i": "K"}.get(values.dtype.kind, f"{max(values.dtype.itemsize // 4, 1)}A")
    unit = getattr(column, "unit", None)
    return fits.Column(name, kind, None if unit is None else str(unit), array=values)


class Findings(NamedTuple):
    """Detections and limits that a file has.

    Attributes
    ----------
    detections, limits : Table or None
        As `lnocl.significance.Significance` has them; None where the file has none.
    signal, limit : ndarray of float64, shape (ny, nx), or None
        The signal-to-noise of a source at each place, and the flux found with a probability of a
        half.
    threshold, width : float
        Of the signal-to-noise, and of the sources, pixels of the images.
    unit : str
        Of fluxes.
    """

    detections: Table | None
    limits: Table | None
    signal: Array | None
    limit: Array | None
    threshold: float
    width: float
    unit: str


def read_findings(path: str) -> Findings | None:
    """Return the detections and limits that a file has; None without either.

    Raises
    ------
    FileError
        The file is missing or damaged.
    """
    tables, maps, cards, unit = {}, {}, fits.Header(), ""
    with open_fits(path) as file:
        for hdu in file.hdus():
            if hdu.name in (DETECTIONS, LIMITS) and isinstance(hdu, fits.BinTableHDU):
                tables[hdu.name] = _table(hdu)
                cards = hdu.header
                unit = str(cards.get("FLUXUNIT", ""))
            if hdu.name in (SIGNAL, f"{LIMIT}{COMPLETENESS[0]}"):
                maps[hdu.name] = file.pixels(hdu)
    if not tables:
        return None
    return Findings(
        tables.get(DETECTIONS),
        tables.get(LIMITS),
        maps.get(SIGNAL),
        maps.get(f"{LIMIT}{COMPLETENESS[0]}"),
        float(cards.get("THRESHOL", np.nan)),
        float(cards.get("SRCWIDTH", 0.0)),
        unit,
    )


def _table(hdu: fits.BinTableHDU) -> Table:
    """Return the columns of a table without units, of which astropy would not know electrons."""
    columns = {}
    for name in hdu.columns.names:
        values = np.asarray(hdu.data[name])
        columns[name] = np.char.strip(values) if values.dtype.kind in "SU" else values
    return Table(columns)
