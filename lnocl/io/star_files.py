"""Tables of stars from files, in pixels of an image: by their pixels or their places on the sky."""

from __future__ import annotations

import io
from codecs import BOM_UTF8
from collections.abc import Mapping
from typing import IO

import numpy as np
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.io.registry import identify_format
from astropy.table import Table
from astropy.time import Time
from astropy.utils.xml.iterparser import get_xml_iterator

from lnocl.core.scene import star_tables
from lnocl.core.scene.arrays import Array
from lnocl.errors import FileError, InputError, LnoclError, counted, note, warn
from lnocl.io.fitsfile import open_fits, open_regular
from lnocl.io.fitsread import date_of
from lnocl.io.packed import unpacked
from lnocl.io.sky import celestial_wcs, has_celestial, to_pixels
from lnocl.process import ignored_warnings

# Positions by pixels and by the sky may differ by so many pixels, as catalogues round them.
SAME_PLACE = 1.0
# Most that is read of a table of stars: plain text takes up to a hundred times its size in memory,
# and compressed files unpack to a thousand times theirs.
MAX_ROWS, MAX_MEBIBYTES = 1_000_000, 128


def read_stars(path: str, header: fits.Header, image: str) -> Array:
    """Return the pixel positions of the stars in a table.

    Parameters
    ----------
    path : str
        Any table that astropy reads, with columns of `star_tables.IN_PIXELS` or `ON_SKY`, or with
        a `SkyCoord`. Upper or lower case does not matter. Right ascension and declination are in
        the columns' units, or else in degrees. With columns pmra and pmdec, mas a year, and
        ref_epoch, a year, as Gaia has them, stars are moved to the date of the image.
    header : astropy.io.fits.Header
        Header of the image, whose coordinates ra and dec need.
    image : str
        Its file.

    Raises
    ------
    FileError
        A file that cannot be read, or with more than `MAX_ROWS`.
    InputError
        A table without these columns, or with x and X; coordinates on the sky for an image without
        WCS; those of pixels and of the sky are of different places; no star, or none on the image.

    Warns
    -----
    LnoclWarning
        Stars that lie outside the image, and are left out.
    """
    table = star_tables.once_each(_read_table(path))
    columns = star_tables.find_columns(table.colnames, star_tables.IN_PIXELS)
    of_sky, sky_columns = _coordinates(path, table)
    if of_sky is not None:
        of_sky = _moved(path, of_sky, table, date_of(image, header))
    places: dict[str, Array] = {}  # by the names of their columns
    if columns is not None:
        places[" and ".join(columns[:2])] = star_tables.in_pixels(table, columns, path)
    if of_sky is not None and (columns is None or has_celestial(header)):
        by_sky = to_pixels(of_sky, celestial_wcs(header, image), image)
        places[" and ".join(sky_columns)] = by_sky
    if not places:
        raise InputError(
            f"{path} has neither columns x and y nor ra and dec; it has "
            f"{', '.join(table.colnames) or 'no columns'}: rename two of them"
        )
    names, found = next(iter(places.items()))
    _compare(path, places, image)
    if not len(found):
        raise InputError(f"{path} has no row; give one a star, or leave --stars out for none")
    origin = ", the first pixel 1" if columns is not None and columns.origin else ""
    note("%s: %s, by %s%s", path, counted(len(found), "star"), names, origin)
    return _within(path, found, header, image)


def _within(path: str, positions: Array, header: fits.Header, image: str) -> Array:
    """Return the positions that lie on an image: catalogues hold its surroundings too.

    Raises
    ------
    InputError
        No star does.
    """
    size = np.array([header.get("NAXIS1", np.inf), header.get("NAXIS2", np.inf)])
    lies = ((positions >= -0.5) & (positions < size - 0.5)).all(axis=1)
    n, n_outside = len(positions), int((~lies).sum())
    if n_outside == n:
        raise InputError(f"{path} has no star on {image}: see whether it is of the same field")
    if n_outside:
        warn(f"{n_outside} of {counted(n, 'star')} of {path} lie outside {image} and are left out")
    return np.asarray(positions[lies])


def _coordinates(path: str, table: Table) -> tuple[SkyCoord | None, tuple[str, ...]]:
    """Return the coordinates in a table and the names of their columns; None where it has none."""
    for column in table.itercols():
        if isinstance(column, SkyCoord):
            return column.icrs, (column.info.name,)
    columns = star_tables.find_columns(table.colnames, star_tables.ON_SKY)
    if columns is None:
        return None, ()
    ra, dec = (star_tables.column_numbers(table[name], path, "deg") for name in columns[:2])
    if (abs(dec) > 90).any():
        raise InputError(f"column {columns.second} of {path} has rows beyond 90 degrees")
    return SkyCoord(ra, dec, unit="deg"), columns[:2]


def _moved(path: str, of_sky: SkyCoord, table: Table, date: Time | None) -> SkyCoord:
    """Return coordinates at a date, where the table has proper motions as Gaia's do.

    A row without them stays where it is.
    """
    names = star_tables.spelled(table.colnames, "pmra", "pmdec")
    if names is None:
        return of_sky
    of_epoch = star_tables.spelled(table.colnames, "ref_epoch")
    if date is None or of_epoch is None:
        lacking = "the image has no date" if date is None else "there is no column ref_epoch"
        note("%s: its proper motions are not heeded, as %s", path, lacking)
        return of_sky
    motions: list[Array] = [
        np.nan_to_num(np.ma.filled(np.ma.asarray(table[name], float), 0.0)) for name in names
    ]
    epoch = star_tables.column_numbers(table[of_epoch[0]], path, "yr")
    with ignored_warnings():  # that distances are not known
        now = SkyCoord(
            of_sky.ra,
            of_sky.dec,
            pm_ra_cosdec=motions[0] * u.mas / u.yr,
            pm_dec=motions[1] * u.mas / u.yr,
            obstime=Time(epoch, format="jyear"),
        ).apply_space_motion(new_obstime=date)
    farthest = of_sky.separation(now).arcsec.max(initial=0.0)
    note("%s: moved by proper motions to %.2f, by %.3g arcsec at most", path, date.jyear, farthest)
    return SkyCoord(now.ra, now.dec)


def _compare(path: str, places: Mapping[str, Array], image: str) -> None:
    """Refuse positions that are another image's, by the coordinates beside them."""
    away = np.hypot(*np.ptp([*places.values()], axis=0).T)
    for row in np.flatnonzero(away > SAME_PLACE)[:1]:
        here, there = (
            f"{found[row, 0]:.2f}, {found[row, 1]:.2f} by {by}" for by, found in places.items()
        )
        raise InputError(
            f"{path} has its star in row {row} at {here}, which {image} has at {there}: delete the "
            "columns that are wrong"
        )


def _read_table(path: str) -> Table:
    try:
        with open_regular(path) as stream, unpacked(stream) as content, ignored_warnings():
            formats = identify_format("read", Table, path, content, [content], {})
            # A file whose name and content show no other format is plain text.
            kind = formats[0] if formats else "ascii"
            if kind == "fits":
                return _read_fits_table(path)
            _check_length(path, content)
            if content.read(len(BOM_UTF8)) == BOM_UTF8:  # which Excel writes
                content = io.BytesIO(content.read())
            content.seek(0)
            if kind == "votable":
                _check_votable(path, content)
            # Its name would be taken for a table if it held a line break, for an address, ...
            return Table.read(content, format=kind)
    except LnoclError:
        raise
    except Exception as error:  # astropy's readers may raise any error
        reason = getattr(error, "strerror", None) or str(error).strip().partition("\n")[0]
        raise FileError(f"{path} cannot be read as a table: {reason}") from error


def _read_fits_table(path: str) -> Table:
    with open_fits(path, "cannot be read as a table") as file:
        hdus = fits.HDUList(list(file.hdus()))
        if any(hdu.header["NAXIS2"] > MAX_ROWS for hdu in hdus if not hdu.is_image):
            raise _too_large(path)
        return Table.read(hdus, format="fits")


def _check_length(path: str, content: IO[bytes]) -> None:
    """Refuse a table that is too large, before it is unpacked in memory."""
    rows = size = 0
    while block := content.read(2**20):
        size += len(block)
        rows += max(block.count(b"\n"), block.count(b"\r"))
        if rows > MAX_ROWS or size > MAX_MEBIBYTES * 2**20:
            raise _too_large(path)
    content.seek(0)


def _too_large(path: str) -> FileError:
    return FileError(
        f"{path} is too large for a table of stars: at most {MAX_ROWS} rows and, but for FITS, "
        f"{MAX_MEBIBYTES} MiB are read; cut it to the stars of the image"
    )


def _check_votable(path: str, content: IO[bytes]) -> None:
    """Refuse a table that would have astropy read another file, or fetch one."""
    with get_xml_iterator(content) as elements:
        for is_start, tag, attributes, _ in elements:
            if is_start and tag == "STREAM" and "href" in attributes:
                raise FileError(
                    f"{path} has its rows elsewhere, at {attributes['href']}; give a table that "
                    "holds them"
                )
    content.seek(0)
