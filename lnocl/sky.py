"""Positions on the sky: stars from their coordinates, offsets between images from their WCS."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.table import Table
from astropy.wcs import WCS
from astropy.wcs.utils import pixel_to_pixel
from numpy.typing import NDArray

from lnocl.errors import FileError, InputError
from lnocl.fitsread import quiet_log

# What the offset between two images may differ by over them, in pixels: from rotation, scale and
# distortion.
MOST_TURNED = 0.1
# Points across an image at which the offset is looked at.
POINTS = 5

Pairs = NDArray[np.float64]


def celestial_wcs(header: fits.Header, path: str) -> WCS:
    """Return the celestial coordinates of an image.

    Raises
    ------
    InputError
        An image without celestial coordinates.
    """
    wcs = _find_wcs(header)
    if wcs is None:
        raise InputError(f"{path} has no sky coordinates (WCS); give positions in pixels")
    return wcs


def has_celestial(header: fits.Header) -> bool:
    """Return whether an image has celestial coordinates."""
    return _find_wcs(header) is not None


def _find_wcs(header: fits.Header) -> WCS | None:
    with warnings.catch_warnings(), quiet_log():
        warnings.simplefilter("ignore")  # what astropy mends
        try:
            wcs = WCS(header, naxis=2)
            return wcs if wcs.has_celestial else None
        except Exception:  # whatever a damaged header leads astropy to
            return None


def to_sky(positions: Pairs, header: fits.Header) -> Pairs:
    """Return right ascension and declination (ICRS, degrees) of pixel positions, shape (n, 2)."""
    wcs = _find_wcs(header)
    assert wcs is not None
    found = wcs.pixel_to_world(*np.reshape(positions, (-1, 2)).T).icrs
    return np.array([found.ra.deg, found.dec.deg]).T


def parse_sky(texts: Sequence[str]) -> SkyCoord:
    """Return positions RA,DEC (ICRS): degrees, or hours and degrees in sexagesimal.

    Raises
    ------
    InputError
        No such position.

    Examples
    --------
    >>> from lnocl.sky import parse_sky
    >>> parse_sky(["15.25,-3.5", "1:01:00,-3:30:00"]).to_string()
    ['15.25 -3.5', '15.25 -3.5']
    """
    return SkyCoord([_parse_sky(text) for text in texts])


def _parse_sky(text: str) -> SkyCoord:
    ra, _, dec = text.partition(",")
    try:
        try:
            return SkyCoord(float(ra), float(dec), unit="deg")
        except ValueError:
            return SkyCoord(ra, dec, unit=("hourangle", "deg"))
    except (ValueError, u.UnitsError):
        raise InputError(f"{text!r} is not RA,DEC in degrees, or as hh:mm:ss,dd:mm:ss") from None


def to_pixels(coordinates: SkyCoord, wcs: WCS) -> Pairs:
    """Return the pixel positions (x, y), 0-based, of positions on the sky, shape (n, 2)."""
    return np.array(wcs.world_to_pixel(coordinates), float).reshape(2, -1).T


def read_stars(path: str, header: fits.Header, image: str) -> Pairs:
    """Return the pixel positions of the stars in a table.

    Parameters
    ----------
    path : str
        Any table that astropy reads, with the columns x and y, in pixels and 0-based, or ra and
        dec, in their units or else in degrees. Upper or lower case does not matter.
    header : astropy.io.fits.Header
        Header of the image, whose coordinates ra and dec need.
    image : str
        Its file.

    Raises
    ------
    FileError
        A file that cannot be read.
    InputError
        A table without these columns, or ra and dec for an image without WCS.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            table = Table.read(path)
    except Exception as error:  # astropy raises whatever a file leads its readers to
        reason = str(error).strip().partition("\n")[0]
        raise FileError(f"{path} cannot be read as a table: {reason}") from error
    columns = {name.lower(): table[name] for name in table.colnames}
    if {"x", "y"} <= columns.keys():
        return np.array([_numbers(path, columns[name], u.pix) for name in "xy"]).T
    if not {"ra", "dec"} <= columns.keys():
        raise InputError(f"{path} has neither columns x and y nor ra and dec")
    wcs = celestial_wcs(header, image)
    ra, dec = (_numbers(path, columns[name], u.deg) for name in ("ra", "dec"))
    return to_pixels(SkyCoord(ra, dec, unit="deg"), wcs)


def _numbers(path: str, column: u.Quantity, unit: u.UnitBase) -> Pairs:
    try:
        values = u.Quantity(column, column.unit or unit).to_value(unit).astype(float)
        values = np.ma.filled(values, np.nan)
    except (TypeError, ValueError) as error:
        raise InputError(f"column {column.name} of {path} is no position: {error}") from None
    if not np.isfinite(values).all():
        raise InputError(f"column {column.name} of {path} has rows without a number")
    return values


def offsets(headers: Sequence[fits.Header], paths: Sequence[str], shape: tuple[int, int]) -> Pairs:
    """Return where each image has what the first one has at (0, 0), shape (p, 2), pixels.

    The mean over the image of ``pixel_j(sky(pixel_1)) - pixel_1``.

    Raises
    ------
    InputError
        An image without sky coordinates, or one that is rotated or scaled against the first, by
        so much that the offset is not the same over the image within a tenth of a pixel.
    """
    first, *others = (celestial_wcs(h, path) for h, path in zip(headers, paths, strict=True))
    ny, nx = shape
    x, y = np.meshgrid(np.linspace(0, nx - 1, POINTS), np.linspace(0, ny - 1, POINTS))
    found = [(0.0, 0.0)]
    for wcs, path in zip(others, paths[1:], strict=True):
        moved = np.array(pixel_to_pixel(first, wcs, x, y))
        change = moved - (x, y)
        if not np.isfinite(change).all():
            raise InputError(f"the sky coordinates of {path} and {paths[0]} have nothing in common")
        mean = change.mean(axis=(1, 2))
        if abs(change - mean[:, None, None]).max() > MOST_TURNED:
            raise InputError(_describe_turn(moved, path, paths[0]))
        found.append((float(mean[0]), float(mean[1])))
    return np.array(found)


def _describe_turn(moved: Pairs, path: str, first: str) -> str:
    """Say how an image lies to the first."""
    along_x = moved[:, POINTS // 2, -1] - moved[:, POINTS // 2, 0]
    angle = np.degrees(np.arctan2(along_x[1], along_x[0]))
    along_y = moved[:, -1, POINTS // 2] - moved[:, 0, POINTS // 2]
    mirrored = along_x[0] * along_y[1] - along_x[1] * along_y[0] < 0
    how = "mirrored" if mirrored else f"rotated by {angle:.3g} degrees or scaled"
    return (
        f"{path} is {how} against {first}: images are never resampled; give those of one "
        "orientation and scale together, or have them reduced to one grid"
    )
