"""The parts of the file of a result beside its image: declared once, all written and read alike."""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from astropy.io import fits
from numpy.typing import ArrayLike

from lnocl.errors import FileError
from lnocl.io.fitsfile import FitsFile, open_fits
from lnocl.io.selection import has_pixels

# The codes of FITS for the types of numbers.
CODES = {"b1": "L", "u1": "B", "i4": "J", "i8": "K", "f4": "E", "f8": "D"}
# Whose coordinates an image has: those of the extended source, or of the images.
SKY, IMAGES = "sky", "images"
# What is in the unit of the result.
LIGHT = "light"
# Percent of sources that are found at a limit of which there is a map.
COMPLETENESS = 50, 90, 95


class Part(NamedTuple):
    """What is known of a part by its name.

    Attributes
    ----------
    columns : tuple of str
        Those that its table must have, where it is a table.
    pixels : str
        The type of its pixels, where it is an image.
    place : str
        `SKY` or `IMAGES`, where it has coordinates.
    unit : str
        Of an image, `LIGHT` for that of the result.
    """

    columns: tuple[str, ...] = ()
    pixels: str = ""
    place: str = ""
    unit: str = ""


PARTS = {
    "STARS": Part(("x", "y", "flux")),
    "HALOS": Part(("halo", "image", "flux", "flux_error")),
    "HISTORY": Part(("iteration", "objective")),
    "CURVE": Part(("iteration", "rho", "rho_star", "magnitude")),
    "HELDOUT": Part(("smoothing", "iteration", "error")),
    "MODELS": Part(pixels="f4", place=IMAGES, unit="electron"),
    "RESIDUALS": Part(pixels="f4", place=IMAGES),
    # Electrons in one unit of the result, in each image or in each of its pixels.
    "ELECTRONS": Part(pixels="f4"),
    "PSFFIT": Part(("image",)),
    "PSFS": Part(pixels="f8"),
    "PSFERRORS": Part(("from", "to", "error")),
    "DOUBTFUL": Part(pixels="u1", place=SKY),
    "PLAN": Part(("step", "done")),
    "MESSAGES": Part(("message",)),
    "EPOCHS": Part(("label",)),
    # The planes of the extended source, where it has several, and their noise by counts.
    "COMPONENTS": Part(("name", "flux", "flux_error")),
    "NOISE": Part(pixels="f4", place=SKY, unit=LIGHT),
    # One row: the outcome of the run, from which errors and detections begin.
    "ESTIMATE": Part(("digest",)),
    # What was measured, and regions; the standard error and bias of each pixel, and the share of
    # replicas in which it has light; and what it takes to continue.
    "ERRORS": Part(("name", "at", "unit", "note", "value")),
    "REGIONS": Part(("name",)),
    "ERROR": Part(pixels="f8", place=SKY, unit=LIGHT),
    "BIAS": Part(pixels="f8", place=SKY, unit=LIGHT),
    "SHARE": Part(pixels="f8", place=SKY),
    # Of components, each other over the continuum, and its standard error.
    "RATIO": Part(pixels="f8", place=SKY),
    "RATIOERR": Part(pixels="f8", place=SKY),
    "REPLICAS": Part(("replica",)),
    "REPLSUMS": Part(pixels="f8"),
    # Sources and the map of signal-to-noise; curves of limits and their maps.
    "DETECTIONS": Part(("x", "y", "flux")),
    "SIGNAL": Part(pixels="f4", place=SKY),
    "LIMITS": Part(("star", "distance")),
    **{f"LIMIT{each}": Part(pixels="f4", place=SKY, unit=LIGHT) for each in COMPLETENESS},
}


class Column(NamedTuple):
    """A column of a table: numbers, arrays of numbers or text, a row each."""

    name: str
    values: ArrayLike
    unit: str = ""
    comment: str = ""


class Content(NamedTuple):
    """A part that was read: the columns of a table by name, or the pixels of an image."""

    values: Any
    header: fits.Header


def hdu_of(
    name: str, content: Any, places: Mapping[str, fits.Header], unit: str
) -> fits.BinTableHDU | fits.ImageHDU:
    """Return the HDU of a part.

    Parameters
    ----------
    name : str
        That of one of `PARTS`.
    content : ndarray, Table or sequence of Column
        Pixels; or a table, as a structured array, a table of astropy or columns.
    places : mapping of str to astropy.io.fits.Header
        Coordinates, by `SKY` and `IMAGES`.
    unit : str
        That of the result.
    """
    part = PARTS[name]
    if not part.pixels:
        return _table(name, content if isinstance(content, Sequence) else list(_columns(content)))
    hdu = fits.ImageHDU(np.asarray(content, part.pixels), places.get(part.place), name=name)
    if part.unit:
        hdu.header["BUNIT"] = (unit if part.unit == LIGHT else part.unit, "per pixel")
    return hdu


def _columns(table: Any) -> Iterable[Column]:
    for name in getattr(table, "colnames", None) or table.dtype.names:
        unit = getattr(table[name], "unit", None)
        yield Column(name, np.asarray(table[name]), "" if unit is None else str(unit))


def _table(name: str, columns: Sequence[Column]) -> fits.BinTableHDU:
    table = fits.BinTableHDU.from_columns([_column(each) for each in columns], name=name)
    for i, column in enumerate(columns, 1):
        table.header[f"TTYPE{i}"] = (column.name, column.comment)
    return table


def _column(column: Column) -> fits.Column:
    values = np.asarray(column.values)
    if values.dtype.kind == "U":
        values = np.array([ascii_of(text) for text in values.tolist()], str)
        kind = f"{max(values.dtype.itemsize // 4, 1)}A"
        return fits.Column(column.name, kind, array=values)
    kind, shape = CODES[values.dtype.str[1:]], values.shape[1:]
    size = None
    if shape:
        kind, size = f"{np.prod(shape)}{kind}", f"({','.join(map(str, shape[::-1]))})"
    return fits.Column(column.name, kind, column.unit or None, dim=size, array=values)


def ascii_of(text: str) -> str:
    """Return text in ASCII, as FITS needs, with escapes as in Python."""
    return text.encode("unicode_escape").decode("ascii")


def parts_of(file: FitsFile, hdus: Iterable[Any], names: Container[str]) -> dict[str, Content]:
    """Return those of some parts that are among the HDUs of a file.

    Raises
    ------
    FileError
        A table lacks a column.
    """
    found = {}
    for hdu in hdus:
        if hdu.name not in names:
            continue
        part = PARTS[hdu.name]
        if part.pixels and has_pixels(hdu):
            found[hdu.name] = Content(file.pixels(hdu), hdu.header)
        elif part.columns and isinstance(hdu, fits.BinTableHDU):
            table = file.table(hdu)
            for column in part.columns:
                if column not in table:
                    raise no_result(file.path, f"there is no column {hdu.name} {column}")
            found[hdu.name] = Content(table, hdu.header)
    return found


def no_result(path: str, fault: str) -> FileError:
    """Return the error of a file that holds no result."""
    return FileError(
        f"{path} is not a result or truth written by lnocl, such as OUT.fits of lnocl deconvolve: "
        f"{fault}"
    )


def read_parts(path: str, names: Container[str]) -> dict[str, Content]:
    """Return those of some parts that a file has.

    Raises
    ------
    FileError
        The file is missing or damaged.
    """
    with open_fits(path) as file:
        return parts_of(file, file.hdus(), names)
