"""Positions of stars in tables, whose columns catalogues name in many ways."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from lnocl.core.scene.arrays import Array
from lnocl.core.scene.units import parse
from lnocl.errors import InputError


class Columns(NamedTuple):
    """A pair of columns with positions.

    Attributes
    ----------
    first, second : str
        Their names: x and y, or right ascension and declination.
    origin : int
        The number of the first pixel, 0 or 1.
    """

    first: str
    second: str
    origin: int = 0


# In order of choice, in small letters: those of lnocl, photutils, and SExtractor, which counts
# pixels from 1.
IN_PIXELS = (
    Columns("x", "y"),
    Columns("x_centroid", "y_centroid"),
    Columns("xcentroid", "ycentroid"),
    Columns("x_fit", "y_fit"),
    Columns("x_peak", "y_peak"),
    Columns("xwin_image", "ywin_image", 1),
    Columns("xpsf_image", "ypsf_image", 1),
    Columns("x_image", "y_image", 1),
)
# Those of most catalogues, Gaia among them; VizieR, where a _ begins what it has computed; and
# SExtractor.
ON_SKY = (
    Columns("ra", "dec"),
    Columns("ra_icrs", "de_icrs"),
    Columns("_raj2000", "_dej2000"),
    Columns("raj2000", "dej2000"),
    Columns("alphawin_j2000", "deltawin_j2000"),
    Columns("alpha_j2000", "delta_j2000"),
)


def find_columns(names: Iterable[str], choices: Iterable[Columns]) -> Columns | None:
    """Return the first of some pairs of columns that a table has, as it spells them, or None.

    Raises
    ------
    InputError
        As `spelled`.

    Examples
    --------
    >>> from lnocl.core.scene.star_tables import IN_PIXELS, find_columns
    >>> find_columns(["NUMBER", "X_IMAGE", "Y_IMAGE"], IN_PIXELS)
    Columns(first='X_IMAGE', second='Y_IMAGE', origin=1)
    """
    names = list(names)
    for choice in choices:
        if pair := spelled(names, *choice[:2]):
            return choice._replace(first=pair[0], second=pair[1])
    return None


def spelled(names: Iterable[str], *wanted: str) -> list[str] | None:
    """Return the names of columns, wanted in small letters, as a table has them; None without one.

    Raises
    ------
    InputError
        The table has two that differ in upper and lower case alone.
    """
    found = [[name for name in names if name.lower() == each] for each in wanted]
    if not all(found):
        return None
    for first, *others in found:
        if others:
            raise InputError(
                f"the table of stars has columns {first} and {others[0]}, either of which may be "
                "meant; delete or rename one"
            )
    return [first for (first,) in found]


def once_each(rows: Any) -> Any:
    """Return a table with each star once: those of lnocl have a row for each of several epochs."""
    is_own = {"variation_error", "images_of", "core_rms"} & {*rows.colnames}
    return rows[rows["epoch"] == 0] if is_own and "epoch" in rows.colnames else rows


def in_pixels(table: Any, columns: Columns, name: str) -> Array:
    """Return positions (x, y), pixels, 0-based, shape (n, 2).

    Parameters
    ----------
    table : astropy.table.Table
        The table.
    columns : Columns
        A pair of its columns, in pixels.
    name : str
        Its name, for messages.

    Raises
    ------
    InputError
        As `column_numbers`.
    """
    x, y = (column_numbers(table[each], name, "pixel") for each in columns[:2])
    return np.array([x, y]).T - columns.origin


def positions(table: Any, name: str = "stars") -> Array:
    """Return the positions (x, y) that a table has in pixels, 0-based, shape (n, 2).

    Raises
    ------
    InputError
        A table without them; as `column_numbers`.
    """
    columns = find_columns(table.colnames, IN_PIXELS)
    if columns is None:
        raise InputError(
            f"the table {name} has no columns x and y, in pixels; it has "
            f"{', '.join(table.colnames) or 'no columns'}: rename two, or convert RA and Dec with "
            "world_to_pixel of astropy.wcs"
        )
    return in_pixels(once_each(table), columns, name)


def column_numbers(column: Any, name: str, unit: str) -> Array:
    """Return the numbers of a column, shape (n,), in a unit which it has where it names none.

    Raises
    ------
    InputError
        A column of texts, of other quantities, of several numbers in a row, or with rows that are
        masked or not finite.
    """
    where = f"column {column.info.name} of {name}"
    try:
        values = np.array(getattr(column, "unmasked", column), float)
        values = values * parse(str(column.unit or unit)).to(parse(unit))
    except (TypeError, ValueError) as error:
        raise InputError(f"{where} is not a position: {error}") from None
    if values.ndim != 1:
        raise InputError(f"{where} has several numbers in a row")
    if not np.isfinite(values).all() or np.any(getattr(column, "mask", False)):
        raise InputError(f"{where} has rows without a number")
    return values
