"""Positions on the sky: stars from their coordinates, offsets between images from their WCS."""

from __future__ import annotations

import contextlib
import hashlib
import io
import math
from codecs import BOM_UTF8
from collections.abc import Callable, Sequence
from typing import IO, Any

import numpy as np
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.io.registry import identify_format
from astropy.table import Table
from astropy.time import Time
from astropy.utils.xml.iterparser import get_xml_iterator
from astropy.wcs import WCS
from astropy.wcs.utils import pixel_to_pixel

from lnocl.errors import FileError, InputError, LnoclError, counted, note, warn
from lnocl.io.fitsfile import open_fits, open_regular
from lnocl.io.fitsread import read_keyword
from lnocl.io.headers import make_wcs, quiet_log
from lnocl.io.packed import unpacked
from lnocl.process import ignored_warnings
from lnocl.scene import star_tables
from lnocl.scene.arrays import Array
from lnocl.scene.quantities import in_unit
from lnocl.scene.units import parse

# Largest variation of the offset between two images over them, in pixels, from rotation, scale and
# distortion.
MAX_OFFSET_VARIATION = 0.1
# Positions by pixels and by the sky may differ by so many pixels, as catalogues round them.
SAME_PLACE = 1.0
# Keywords with the date of an image, and their formats.
DATES = {"MJD-AVG": "mjd", "MJD-OBS": "mjd", "DATE-OBS": "fits"}
# Most that is read of a table of stars: plain text takes up to a hundred times its size in memory,
# and compressed files unpack to a thousand times theirs.
MAX_ROWS, MAX_MEBIBYTES = 1_000_000, 128
# Points across an image at which the offset is computed.
POINTS = 5


def celestial_wcs(header: fits.Header, path: str, advice: str = "give positions in pixels") -> WCS:
    """Return the celestial coordinates of an image.

    Raises
    ------
    InputError
        An image without celestial coordinates that astropy can use.
    """
    wcs = _find_wcs(header)
    if wcs is None:
        raise InputError(f"{path} has no sky coordinates (WCS) that can be used; {advice}")
    return wcs


def has_celestial(header: fits.Header) -> bool:
    """Return whether an image has celestial coordinates."""
    return _find_wcs(header) is not None


def _find_wcs(header: fits.Header) -> WCS | None:
    with ignored_warnings(), quiet_log():  # of faults that astropy mends
        try:
            wcs = make_wcs(header)
            _ = wcs.pixel_to_world(0, 0).icrs  # those of the Sun are not on the sky
            return wcs
        except Exception:  # astropy may raise any error on a damaged header
            return None


def pixel_scale(header: fits.Header) -> float | None:
    """Return the side of a pixel in arcsec, None where it is unknown.

    It is that of PIXELSCL, of the coordinates, or of PIXSCALE, as in PSFs of Tiny Tim.
    """
    scale = header.get("PIXELSCL")
    if scale is None and "CTYPE1" in header and (wcs := _find_wcs(header)) is not None:
        scale = float(np.sqrt(wcs.proj_plane_pixel_area().to_value("arcsec2")))
    if scale is None and isinstance(scale := header.get("PIXSCALE"), (int, float)):
        scale *= 1e-3 if header.comments["PIXSCALE"].startswith("mas") else 1.0
    if isinstance(scale, (int, float)) and 0 < scale < np.inf:
        return float(scale)
    return None


def oversampling(header: fits.Header) -> float | None:
    """Return how many pixels of a PSF's file make one of the detector's, where OVERSAMP says so."""
    finer = header.get("OVERSAMP")
    return float(finer) if isinstance(finer, (int, float)) and 1 < finer < np.inf else None


def to_sky(positions: Array, header: fits.Header) -> Array:
    """Return right ascension and declination (ICRS, degrees) of pixel positions, shape (n, 2).

    Raises
    ------
    InputError
        An image without celestial coordinates that astropy can use.
    """
    found = (
        celestial_wcs(header, "the image").pixel_to_world(*np.reshape(positions, (-1, 2)).T).icrs
    )
    return np.array([found.ra.deg, found.dec.deg]).T


def parse_sky(texts: Sequence[str]) -> SkyCoord:
    """Return positions RA,DEC (ICRS) with units, or in sexagesimal hours and degrees.

    Raises
    ------
    InputError
        A text that is not such a position.

    Examples
    --------
    >>> from lnocl.io.sky import parse_sky
    >>> parse_sky(["15.25d,-3.5d", "1:01:00,-3:30:00"]).to_string()
    ['15.25 -3.5', '15.25 -3.5']
    """
    return SkyCoord([_parse_sky(text) for text in texts])


def _parse_sky(text: str) -> SkyCoord:
    ra, _, dec = text.partition(",")
    with contextlib.suppress(ValueError):
        if set(ra) - set("+-.0123456789"):  # degrees, and not hours, would be meant by a number
            return SkyCoord(ra, dec, unit=("hourangle", "deg"))
    raise InputError(
        f"{text!r} is neither X,Y in pixels nor RA,DEC with units, as in 65d,19.5d or "
        "4:20:00,19:30:00"
    )


def to_pixels(coordinates: SkyCoord, wcs: WCS, path: str) -> Array:
    """Return the pixel positions (x, y), 0-based, of positions on the sky, shape (n, 2).

    Raises
    ------
    InputError
        A position outside the projection of the image.
    """
    found = _pixel_to(wcs.world_to_pixel, coordinates).reshape(2, -1).T
    for position, pixels in zip(coordinates.ravel(), found, strict=True):
        if not np.isfinite(pixels).all():
            raise InputError(
                f"the star at RA, Dec {position.to_string(precision=5)} lies in another part of "
                f"the sky than {path}"
            )
    return found


def _pixel_to(convert: Callable[..., Any], *given: Any) -> Array:
    with ignored_warnings():  # of SIP that does not converge far from the image
        return np.array(convert(*given), float)


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
    table = _read_table(path)
    columns = star_tables.find_columns(table.colnames, star_tables.IN_PIXELS)
    of_sky, sky_columns = _coordinates(path, table)
    if of_sky is not None:
        of_sky = _moved(path, of_sky, table, _date(header, image))
    if columns is not None:
        found = star_tables.in_pixels(table, columns, path)
        names: Sequence[str] = columns[:2]
        if of_sky is not None and has_celestial(header):
            _compare(path, found, names, of_sky, sky_columns, header, image)
    elif of_sky is not None:
        found = to_pixels(of_sky, celestial_wcs(header, image), image)
        names = sky_columns
    else:
        raise InputError(
            f"{path} has neither columns x and y nor ra and dec; it has "
            f"{', '.join(table.colnames) or 'no columns'}: rename two of them"
        )
    if not len(found):
        raise InputError(f"{path} has no row; give one a star, or leave --stars out for none")
    origin = ", the first pixel 1" if columns is not None and columns.origin else ""
    note("%s: %s, by %s%s", path, counted(len(found), "star"), " and ".join(names), origin)
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


def _date(header: fits.Header, image: str) -> Time | None:
    """Return when an image was taken, by its header; None where that does not say."""
    for keyword, kind in DATES.items():
        value = read_keyword(image, header, keyword)
        try:
            return Time(value, format=kind, scale="utc")
        except (TypeError, ValueError):
            continue
    return None


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


def _compare(
    path: str,
    positions: Array,
    names: Sequence[str],
    of_sky: SkyCoord,
    sky_names: Sequence[str],
    header: fits.Header,
    image: str,
) -> None:
    """Refuse positions that are another image's, by the coordinates beside them."""
    by_sky = to_pixels(of_sky, celestial_wcs(header, image), image)
    away = np.hypot(*(by_sky - positions).T)
    for row in np.flatnonzero(away > SAME_PLACE)[:1]:
        raise InputError(
            f"{path} has its star in row {row} at {positions[row][0]:.2f}, {positions[row][1]:.2f} "
            f"by {' and '.join(names)}, which {image} has at {by_sky[row][0]:.2f}, "
            f"{by_sky[row][1]:.2f} by {' and '.join(sky_names)}: delete the columns that are wrong"
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


def read_angles(path: str) -> tuple[Array, str]:
    """Return the angles in a file, one for each image, and its SHA-256 checksum.

    Parameters
    ----------
    path : str
        FITS, with an image of one dimension, in the angle of its BUNIT or else in degrees; or text
        with a number a line.

    Raises
    ------
    FileError
        The file cannot be read, or holds something else.
    """
    try:
        with open_regular(path) as stream:
            content = stream.read(MAX_MEBIBYTES * 2**20)
    except (OSError, ValueError) as error:
        raise FileError(f"{path} cannot be read: {getattr(error, 'strerror', error)}") from error
    if content.startswith(b"SIMPLE"):
        with open_fits(path) as file:
            images = [hdu for hdu in file.hdus() if len(getattr(hdu, "shape", ()) or ()) == 1]
            values = np.array(images[0].data, np.float64) if images else np.zeros(0)
            if unit := parse(str(images[0].header.get("BUNIT", ""))) if images else None:
                values = in_unit("angle", values * unit, "deg")
    else:
        try:
            values = np.array(content.decode("ascii").split(), np.float64)
        except ValueError as error:
            raise FileError(f"{path} must hold numbers alone, an angle a line") from error
    if not (values.size and np.isfinite(values).all()):
        raise FileError(f"{path} must hold a finite angle for each image")
    return values, hashlib.sha256(content).hexdigest()


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


def finest(
    headers: Sequence[fits.Header], paths: Sequence[str], shapes: Sequence[tuple[int, int]]
) -> int:
    """Return which image has the smallest pixels: the first, unless others differ over an image.

    Raises
    ------
    InputError
        An image without sky coordinates, or whose pixels have no area by them.
    """
    scales = []
    for header, path in zip(headers, paths, strict=True):
        wcs = celestial_wcs(header, path, "leave align out")
        with np.errstate(invalid="ignore"):
            area = float(wcs.proj_plane_pixel_area().to_value("arcsec2"))
        if not 0.0 < area < math.inf:
            raise InputError(f"the pixels of {path} have no area by its WCS; leave align out")
        scales.append(math.sqrt(area))
    smallest = int(np.argmin(scales))
    change = (scales[0] / scales[smallest] - 1.0) * math.hypot(*shapes[smallest]) / 2.0
    return smallest if change > MAX_OFFSET_VARIATION else 0


def transforms(
    headers: Sequence[fits.Header],
    paths: Sequence[str],
    shapes: Sequence[tuple[int, int]],
    of_sky: int = 0,
) -> Array:
    """Return the map from one image, by default the first, to each, shape (p, 2, 3), pixels.

    It is a shift, the mean over that image of ``pixel_j(sky(pixel)) - pixel``, where this is the
    same all over the image within a tenth of a pixel; else the nearest rotation, with or without a
    flip, and shift; with a scale where that leaves more.

    Raises
    ------
    InputError
        An image without sky coordinates; one that shows another part of the sky than that one;
        one that no rotation, scale and shift brings within a tenth of a pixel.
    """
    all_wcs = [
        celestial_wcs(header, path, "leave align out")
        for header, path in zip(headers, paths, strict=True)
    ]
    found = [
        np.eye(2, 3)
        if j == of_sky
        else _transform(all_wcs[of_sky], wcs, paths[of_sky], path, shapes[of_sky], shape)
        for j, (wcs, path, shape) in enumerate(zip(all_wcs, paths, shapes, strict=True))
    ]
    return np.array(found)


def _transform(
    first: WCS,
    wcs: WCS,
    first_path: str,
    path: str,
    first_shape: tuple[int, int],
    shape: tuple[int, int],
) -> Array:
    (ny, nx), size = first_shape, np.array(shape[::-1])
    x, y = np.meshgrid(np.linspace(0, nx - 1, POINTS), np.linspace(0, ny - 1, POINTS))
    moved = _pixel_to(pixel_to_pixel, first, wcs, x, y)
    # NaN is where a projection has no pixel.
    meets = np.isfinite(moved).all() and (moved.max(axis=(1, 2)) > -0.5).all()
    if not (meets and (moved.min(axis=(1, 2)) < size - 0.5).all()):
        raise InputError(
            f"{path} shows another part of the sky than {first_path}, by its sky coordinates; "
            "leave one of them out"
        )
    change = moved - (x, y)
    mean = change.mean(axis=(1, 2))
    if abs(change - mean[:, None, None]).max() <= MAX_OFFSET_VARIATION:
        return np.column_stack([np.eye(2), mean])
    middle = np.array([nx - 1, ny - 1]) / 2.0
    points = np.array([x, y]).reshape(2, -1) - middle[:, None]
    there = moved.reshape(2, -1) - (middle + mean)[:, None]
    u, stretches, v = np.linalg.svd(there @ points.T)
    for scale in (1.0, stretches.sum() / (points**2).sum()):
        nearest = scale * (u @ v)
        left = abs(there - nearest @ points).max()
        if left <= MAX_OFFSET_VARIATION:
            return np.column_stack([nearest, middle + mean - nearest @ middle])
    turn = "mirrored"
    if np.linalg.det(u @ v) > 0:
        turn = f"rotated by {rotation_angle(nearest):z.2f} degrees and scaled by {scale:.4f}"
    raise InputError(
        f"{path} is {turn} relative to {first_path}, and after rotation, scale and shift pixels "
        f"are up to {left:.2g} off: images are never resampled; cut them to where it is less"
    )


def rotation_angle(transform: Array) -> float:
    """Return by how many degrees a map turns, from the x axis towards the y axis."""
    return float(np.degrees(np.arctan2(transform[1, 0], transform[0, 0])))
