"""FITS in: images and PSFs, and their coordinates."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from lnocl.core.scene.arrays import are_colours
from lnocl.core.scene.transforms import enlarged
from lnocl.errors import FileError, InputError, counted, detail, note, warn
from lnocl.io.encoded import linear
from lnocl.io.fitsfile import open_fits
from lnocl.io.headers import finer_cards, make_wcs, readable
from lnocl.io.names import parse_name
from lnocl.io.selection import choose, describe, find, has_pixels, name_of, only
from lnocl.process import ignored_notes, ignored_warnings

if TYPE_CHECKING:
    from astropy.time import Time

# Keywords with the date of an image, and their formats.
DATES = {"MJD-AVG": "mjd", "MJD-OBS": "mjd", "DATE-OBS": "fits"}
# Beginnings of CTYPE3 of cubes whose planes are not of one sky: colours, energies, velocities,
# polarisations.
NOT_EXPOSURES = (
    *("WAVE", "AWAV", "WAVN", "LAMBDA", "FREQ", "ENER", "VRAD", "VOPT", "VELO", "FELO", "ZOPT"),
    *("BETA", "STOKES", "RGB", "COLOR", "COLOUR", "BAND", "FILTER"),
)

_WCS_KEYWORD = re.compile(r"(?:CTYPE|CRPIX|CRVAL|CDELT)1([A-Z]?)")


class Stack(NamedTuple):
    """Images that were read.

    Attributes
    ----------
    data : ndarray of float64, shape (p, ny, nx)
        Pixels, in the units of the files.
    headers : list of astropy.io.fits.Header
        Header of each file.
    sha256 : list of str
        SHA-256 checksum of each file, in hexadecimal.
    shapes : list of tuple of int
        Shape (ny, nx) of each image. Pixels beyond that of a smaller one are NaN.
    paths : sequence of str
        The files.
    """

    data: NDArray[np.float64]
    headers: list[fits.Header]
    sha256: list[str]
    shapes: list[tuple[int, int]]
    paths: Sequence[str] = ()

    @property
    def header(self) -> fits.Header:
        """Header of the first image."""
        return self.headers[0]

    def file_of(self, j: int) -> tuple[str, fits.Header]:
        """Return path and header of the file of image j; a cube has one of all its images."""
        of_file = min(j, len(self.headers) - 1)
        return self.paths[of_file], self.headers[of_file]

    def number(self, name: str, j: int, keyword: str, unit: str = "") -> float | None:
        """Return the number that a keyword has for image j, or None; log it by a name.

        Raises
        ------
        InputError
            The value is not a number.
        """
        path, header = self.file_of(j)
        value = read_keyword(path, header, keyword)
        if value is None:
            return None
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise InputError(
                f"{keyword} of {path} is {value!r}, not a number; give `{name}` as one"
            )
        detail("`images[%d]`: %s %g%s, from %s", j, name.replace("_", " "), value, unit, keyword)
        return float(value)


def read_stack(paths: Sequence[str], may_differ: bool = False, of_one_sky: bool = True) -> Stack:
    """Read images: one FITS file each, or one file with a cube.

    The image of a file is the one named, as in ``FILE[SCI,1]`` (`lnocl.io.names`); else the
    extension SCI, or DET_DIST of a PSF, else the primary HDU, else an image extension that is not
    auxiliary (`lnocl.io.selection.choose`); an extension is named in the log. BSCALE, BZERO
    and BLANK are applied (a blank pixel is NaN), and an asinh of Pan-STARRS is undone
    (`lnocl.io.encoded`). A file may be compressed as a whole (gzip, bzip2, xz), and in tiles (.fz).

    Parameters
    ----------
    paths : sequence of str
        One file with an image (ny, nx) or a cube (p, ny, nx), or p files with an image each; first
        axes of length 1 are left out.
    may_differ : bool
        Whether images in several files may have several shapes.
    of_one_sky : bool
        Whether the planes of a cube are to be images of one sky.

    Returns
    -------
    Stack
        The images, the headers and the checksums of the files.

    Raises
    ------
    FileError
        A file that is missing, damaged, truncated or not FITS, that has no image, or whose image is
        larger than the memory.
    InputError
        An image of another dimension or shape than the others; a cube of colours or energies by its
        CTYPE3; several images in a file that have an equal claim; none that is named.

    Warns
    -----
    LnoclWarning
        Faults of a file that astropy found and mended; data that do not match their DATASUM.
    """
    images, headers, sha256 = zip(*(_read_file(path) for path in paths), strict=True)
    for path, image in zip(paths, images, strict=True):
        expected = image.shape if may_differ else images[0].shape
        _check_shape(path, image.shape, paths[0], expected, alone=len(paths) == 1)
    if images[0].ndim == 3 and len(images[0]) > 1 and of_one_sky:
        _refuse_colours(paths[0], str(headers[0].get("CTYPE3", "")).strip().upper())
    planes = list(images[0].reshape(-1, *images[0].shape[-2:])) if len(images) == 1 else images
    shapes = [(plane.shape[0], plane.shape[1]) for plane in planes]
    shape = max(ny for ny, _ in shapes), max(nx for _, nx in shapes)
    if len(images) == 1:
        data = images[0].reshape(-1, *shape)
    else:
        data = np.stack([enlarged(plane, shape, np.nan) for plane in planes])
    return Stack(data, list(headers), list(sha256), shapes, paths)


def read_single(path: str) -> Stack:
    """Read the one image of a file.

    Raises
    ------
    FileError, InputError
        As `read_stack`; a cube of several images.
    """
    stack = read_stack([path])
    if len(stack.data) > 1:
        raise InputError(
            f"{path} holds {len(stack.data)} images; give a file with one, such as their mean"
        )
    return stack


def read_extension(path: str, name: str) -> NDArray[np.float64] | None:
    """Return the image extension of this name of a file, or None where the file lacks it.

    It has the version of the image, where the path names that or an HDU: ``DQ,2`` beside
    ``FILE[SCI,2]``.

    Raises
    ------
    FileError
        As `read_stack`.
    InputError
        Several extensions have the name.
    """
    try:
        return _read_file(path, name)[0]
    except _NoImageError:
        return None


def read_keyword(path: str, header: fits.Header, keyword: str) -> str | float | None:
    """Return the value of a keyword for an image that was read from a file; None if missing.

    Where the header of the image lacks it, the primary header is read, in which telescopes leave
    the keywords that hold for the whole file.

    Raises
    ------
    FileError
        As `read_stack`.
    """
    if keyword in header or "XTENSION" not in header:  # it is the primary header itself
        return header.get(keyword)
    # Warnings were shown when the image was read.
    with ignored_warnings(), open_fits(parse_name(path).file) as file:
        primary = readable(next(file.hdus()).header)
    return primary.get(keyword)


def date_of(path: str, header: fits.Header) -> Time | None:
    """Return when an image was taken, by its header; None where that does not say."""
    from astropy.time import Time  # which few files need

    for keyword, kind in DATES.items():
        value = read_keyword(path, header, keyword)
        try:
            return Time(value, format=kind, scale="utc")
        except (TypeError, ValueError):
            continue
    return None


class Contents(NamedTuple):
    """What a file holds, its pixels unread.

    Attributes
    ----------
    header, primary : astropy.io.fits.Header
        Of its image, and of its primary HDU.
    extensions : frozenset of str
        Names of its image extensions, in capital letters.
    """

    header: fits.Header
    primary: fits.Header
    extensions: frozenset[str]

    def value(self, keyword: str) -> str:
        """Return the value of a keyword as text: the image's, else the file's, else nothing."""
        return str(self.header.get(keyword, self.primary.get(keyword, ""))).strip()


def read_contents(path: str) -> Contents:
    """Return the contents of an image's file; reading its pixels shows the warnings.

    Raises
    ------
    FileError, InputError
        As `read_stack`.
    """
    name = parse_name(path)
    with ignored_warnings(), open_fits(name.file) as file:
        hdus = list(file.hdus())
        index = find(name, hdus) if name.is_chosen else choose(path, hdus)
        if index is None:
            raise _NoImageError(f"{path} holds no image")
        names = frozenset(name_of(hdu) for hdu in hdus[1:] if has_pixels(hdu))
        return Contents(readable(hdus[index].header), readable(hdus[0].header), names)


def wcs_cards(header: fits.Header) -> fits.Header:
    """Return the cards of every coordinate system of an image, as astropy writes them.

    Parameters
    ----------
    header : astropy.io.fits.Header
        Header of a two-dimensional image or of a cube of them.

    Returns
    -------
    astropy.io.fits.Header
        The primary and the alternate systems of the first two axes, with SIP and other
        distortions that cards can describe. Empty where the image has no coordinates.

    Warns
    -----
    LnoclWarning
        A system that astropy cannot read or that needs tables besides the header (``-TAB``); it
        is left out.
    """
    cards = fits.Header()
    for key in sorted({match[1] for match in map(_WCS_KEYWORD.fullmatch, header) if match}):
        try:
            # Cards that astropy mends on reading are written mended.
            wcs = make_wcs(header, key or " ")
            with ignored_warnings(), ignored_notes("astropy"):
                if key and not wcs.wcs.ctype[0].endswith("-SIP"):
                    wcs.sip = None  # that of the primary system, which astropy gives to all
                cards.update(wcs.to_header(relax=True))
        except Exception as error:
            warn(
                f"the coordinates (WCS{key and ' ' + key}) of the first image cannot be "
                f"copied and are left out: {error}"
            )
    return cards


def sky_header(header: fits.Header, oversample: int) -> fits.Header:
    """Return a header with the coordinates of a sky so many times as fine as the image of this."""
    return header if oversample == 1 else finer_cards(wcs_cards(header), oversample)


class _NoImageError(FileError):
    """A file without an image, or without one of the name that is sought."""


def _read_file(
    path: str, extension: str | None = None
) -> tuple[NDArray[np.float64], fits.Header, str]:
    """Return an image in a file, its header and the checksum; or an extension, without one."""
    name = parse_name(path)
    with open_fits(name.file) as file:
        hdus = list(file.hdus())
        if extension is not None:
            version = name.version
            if name.hdu is not None:
                version = hdus[find(name, hdus)].header.get("EXTVER", 1)
            index = only(name.file, hdus, extension, version)
        elif name.is_chosen:
            index = find(name, hdus)
        else:
            index = choose(path, hdus)
        if index is None:
            raise _NoImageError(f"{path} holds no image")
        if index and extension is None:
            note("%s: the image is %s", path, describe(index, hdus[index]))
        hdu = hdus[index]
        checksum = file.sha256() if extension is None else ""  # which reads all of the file
        pixels = file.pixels(hdu)
        while pixels.ndim > 2 and len(pixels) == 1:
            pixels = pixels[0]
        header = readable(hdu.header)
        return linear(path, pixels, header), header, checksum


def _check_shape(
    path: str, shape: tuple[int, ...], first_path: str, first_shape: tuple[int, ...], alone: bool
) -> None:
    if len(shape) not in (2, 3):
        needed = "two are needed" + ", or three for a cube of images: cut the others" * alone
        raise InputError(f"{path} has an image of {counted(len(shape), 'dimension')}; {needed}")
    if are_colours(shape):
        raise InputError(
            f"{path} has the shape {shape}: its last axis is of colours or channels; give one of "
            "them, as an image of its own"
        )
    if not alone and len(shape) == 3:
        raise InputError(
            f"{path} holds {shape[0]} images, such as integrations; each of several files needs "
            "one: give their mean, or one of them"
        )
    if shape != first_shape:
        raise InputError(
            f"{path} has the shape {shape} and {first_path} {first_shape}; they must be the same"
        )


def _refuse_colours(path: str, kind: str) -> None:
    if kind.startswith(NOT_EXPOSURES):
        raise InputError(
            f"{path} is a cube along {kind}, whose planes are not images of one sky; give one "
            "plane, in a file of its own, or `components` each for a sky of each. If they are "
            "images of one sky, take CTYPE3 out of its header"
        )
