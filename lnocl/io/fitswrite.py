"""FITS out: images and results, with the commands that make them again."""

from __future__ import annotations

import os
import shlex
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from astropy.io import fits
from numpy.typing import ArrayLike, NDArray

from lnocl.io.atomic import whole_file
from lnocl.io.headers import finer_cards

# A HISTORY card holds 72 characters; the last one may be needed for a backslash and a space.
HISTORY_WIDTH = 70

# The codes of FITS for the types of numbers.
CODES = {"b1": "L", "u1": "B", "i4": "J", "i8": "K", "f4": "E", "f8": "D"}

Card = tuple[str, str | int | float, str]


class StarColumn(NamedTuple):
    """A column of the table of stars."""

    name: str
    values: ArrayLike
    unit: str
    comment: str


def write_result(
    path: str,
    extended: ArrayLike,
    stars: ArrayLike,
    star_fluxes: ArrayLike,
    history: NDArray[np.void] | None = None,
    wcs: fits.Header | None = None,
    cards: Iterable[Card] = (),
    commands: Iterable[Sequence[str]] = (),
    overwrite: bool = False,
    curve: NDArray[np.void] | None = None,
    held_out: NDArray[np.void] | None = None,
    unit: str = "electron",
    star_columns: Sequence[StarColumn] = (),
    cubes: Mapping[str, tuple[ArrayLike, str]] = MappingProxyType({}),
    transforms: ArrayLike = (),
    oversample: int = 1,
    psf_fit: NDArray[np.void] | None = None,
    psfs: ArrayLike | None = None,
    psf_errors: NDArray[np.void] | None = None,
    doubtful: ArrayLike | None = None,
    messages: Sequence[str] = (),
    halos: NDArray[np.void] | None = None,
    estimate: Mapping[str, NDArray[Any]] = MappingProxyType({}),
) -> None:
    """Write a result, or a truth: the file is there complete, or not at all.

    The primary HDU holds the extended source, the table ``STARS`` the columns x, y, flux and any
    others given, the table ``HISTORY`` iteration and objective, the table ``CURVE`` iteration,
    rho, rho_star and magnitude, the table ``HELDOUT`` mu, smoothing, iteration and error, the table
    ``PSFFIT`` parameters of PSFs, ``PSFS`` the PSFs, the table ``HALOS`` the amounts of halos. All
    have CHECKSUM and DATASUM.

    Parameters
    ----------
    path : str
        File to write.
    extended : array_like, shape (ny, nx)
        Extended source, in this unit per pixel of it.
    stars : array_like, shape (n, 2)
        Positions (x, y) in pixels of the images, 0-based.
    star_fluxes : array_like, shape (n,)
        In this unit.
    history : ndarray with fields ``iteration`` and ``objective``, optional
        The objective after each iteration; a truth has no history.
    wcs : astropy.io.fits.Header, optional
        Cards of the coordinate systems of the images, from `fitsread.wcs_cards`.
    cards : iterable of (keyword, value, comment), optional
        Further cards of the primary header.
    commands : iterable of sequence of str, optional
        Shell commands that repeat the run, as words; the HISTORY lines spell them out.
    overwrite : bool, optional
        Whether an existing file may be replaced.
    curve : ndarray with fields ``iteration``, ``rho``, ``rho_star`` and ``magnitude``, optional
        Restoration errors and magnitude of the star, where the truth is known.
    held_out : ndarray with fields ``smoothing``, ``iteration`` and ``error``, optional
        Relative errors that held-out counts estimate, where they were asked.
    unit : str, optional
        Unit of extended source and fluxes.
    star_columns : sequence of StarColumn, optional
        Further columns of the table of stars.
    cubes : mapping of str to (array_like, str), optional
        Further images (p, ny, nx), by the name of their extension, with their unit.
    transforms : array_like, shape (p, 2, 3), optional
        Maps from the sky to these images, pixels. Where they are not all the same, no coordinate
        system holds for all of a cube: it has the cards of `place_cards` instead, as the primary
        header has beside its own.
    oversample : int, optional
        Pixels of the extended source to one of the images, along each axis.
    psf_fit : ndarray with fields ``image`` and those of the parameters, optional
        The parameters of the PSFs that were refined.
    psfs : array_like, shape (p, ky, kx), optional
        The PSFs of the model.
    psf_errors : ndarray with fields ``from``, ``to`` and ``error``, optional
        The relative error of the PSFs in rings round a star.
    doubtful : array_like of bool, shape (ny, nx), optional
        Pixels in which errors of the PSFs may have faked all there is.
    messages : sequence of str, optional
        The messages of the run, a line each: the table ``MESSAGES``.
    halos : ndarray with fields ``halo``, ``image``, ``flux`` and ``flux_error``, optional
        The amounts of halos, electrons of their image.
    estimate : mapping of str to ndarray, optional
        What the run has found, from which all goes on: the columns of the one row of ``ESTIMATE``.

    Raises
    ------
    FileError
        The file cannot be written, or exists and must not be overwritten.
    """
    coordinates = fits.Header() if wcs is None else wcs
    is_shared = not np.any(np.asarray(transforms).reshape(-1, 2, 3) - np.eye(2, 3))
    places = [] if is_shared else place_cards(transforms)
    shared = coordinates if is_shared else fits.Header(places)
    of_sky = coordinates if oversample == 1 else finer_cards(coordinates, oversample)
    header = of_sky.copy()
    header["BUNIT"] = (unit, "per pixel")
    if oversample > 1:
        header["OVERSAMP"] = (oversample, "pixels of this image to one of the frames")
    header["DATE"] = (datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%S"), "UTC, file written")
    _add_provenance(header, [*cards, *places], (), commands)
    hdus = fits.HDUList(
        [
            fits.PrimaryHDU(np.asarray(extended, dtype=np.float64), header),
            _star_table(stars, star_fluxes, unit, star_columns),
            *([] if halos is None else [_table("HALOS", halos)]),
            *([] if history is None else [_table("HISTORY", history)]),
            *([] if curve is None else [_table("CURVE", curve)]),
            *([] if held_out is None else [_table("HELDOUT", held_out)]),
            *(_cube(name, *cube, shared) for name, cube in cubes.items()),
            *([] if psf_fit is None else [_table("PSFFIT", psf_fit)]),
            *([] if psfs is None else [fits.ImageHDU(np.asarray(psfs, np.float64), name="PSFS")]),
            *([] if psf_errors is None else [_table("PSFERRORS", psf_errors)]),
            *([] if doubtful is None else [_flags("DOUBTFUL", doubtful, of_sky)]),
            *([_lines("MESSAGES", "message", messages)] if messages else []),
            *([_row("ESTIMATE", estimate)] if estimate else []),
        ]
    )
    with whole_file(path, overwrite) as stream:
        hdus.writeto(stream, checksum=True)


def write_image(
    path: str,
    image: ArrayLike,
    cards: Iterable[Card] = (),
    overwrite: bool = False,
    notes: Iterable[str] = (),
    commands: Iterable[Sequence[str]] = (),
    others: Mapping[str, ArrayLike] = MappingProxyType({}),
) -> None:
    """Write an image; the same image and cards give the same bytes.

    Parameters
    ----------
    path : str
        File to write.
    image : array_like, shape (ny, nx) or (p, ny, nx)
        Any image, or a cube of them.
    cards : iterable of (keyword, value, comment), optional
        Cards of its header.
    overwrite : bool, optional
        Whether an existing file may be replaced.
    notes : iterable of str, optional
        Steps of the making, in lines of printable ASCII; the HISTORY lines hold them as comments
        of a shell.
    commands : iterable of sequence of str, optional
        Shell commands that repeat the run, as words; the HISTORY lines spell them out.
    others : mapping of str to array_like, optional
        Further images, by the names of their extensions.

    Raises
    ------
    FileError
        The file cannot be written, or exists and must not be overwritten.
    """
    hdu = fits.PrimaryHDU(np.asarray(image, dtype=np.float64))
    _add_provenance(hdu.header, cards, notes, commands)
    hdus = [hdu, *(fits.ImageHDU(np.asarray(each), name=name) for name, each in others.items())]
    for each in hdus:
        each.add_checksum(when="")  # astropy would note the time
    with whole_file(path, overwrite) as stream:
        fits.HDUList(hdus).writeto(stream)


def column_unit(unit: str) -> str:
    """Return a unit for a column: FITS has none for electrons, and astropy would warn of it."""
    return unit.replace("electron", "ct")


def place_cards(transforms: ArrayLike) -> list[Card]:
    """Return the cards of the maps of images, shape (p, 2, 3): OFFX1, OFFY1, OFFX2 ..., pixels.

    Where an image is turned, also R11_1, R12_1, R21_1 ..., the matrices of rotations and flips.
    """
    maps = np.asarray(transforms).reshape(-1, 2, 3)
    cards: list[Card] = [
        (f"OFF{axis}{j}", float(offset), "offset of the image, pixels")
        for j, each in enumerate(maps, 1)
        for axis, offset in zip("XY", each[:, 2], strict=True)
    ]
    if (maps[:, :, :2] == np.eye(2)).all():
        return cards
    return cards + [
        (f"R{a + 1}{b + 1}_{j}", float(each[a, b]), "rotation of the image")
        for j, each in enumerate(maps, 1)
        for a in (0, 1)
        for b in (0, 1)
    ]


def history_lines(words: Sequence[str]) -> list[str]:
    r"""Return a shell command in lines that fit HISTORY cards and can be pasted into a shell.

    All but the last line end in a backslash. Long words are cut into pieces that the shell joins
    again; bytes that FITS does not allow are written as ``$'\ooo'``, which bash, ksh and zsh
    read.

    Parameters
    ----------
    words : sequence of str
        The command and its arguments, as the program gets them.

    Returns
    -------
    list of str
        Printable ASCII, 72 characters a line at most.

    Examples
    --------
    >>> from lnocl.io.fitswrite import history_lines
    >>> history_lines(["lnocl", "deconvolve", "a star.fits", "-o", "naïve.fits"])
    ["lnocl deconvolve 'a star.fits' -o $'na\\303\\257ve.fits'"]
    """
    lines, line = [], ""
    for word in words:
        for i, piece in enumerate(_shell_pieces(word)):
            gap = " " if line and i == 0 else ""
            if line and len(line + gap + piece) > HISTORY_WIDTH:
                lines.append(line + gap + "\\")
                line, gap = "", ""
            line += gap + piece
    return [*lines, line]


def _add_provenance(
    header: fits.Header,
    cards: Iterable[Card],
    notes: Iterable[str],
    commands: Iterable[Sequence[str]],
) -> None:
    """Add the cards, and HISTORY lines with the notes, as comments, and the commands."""
    for keyword, value, comment in cards:
        header[keyword] = (ascii_of(value) if isinstance(value, str) else value, comment)
    for note in notes:
        for line in textwrap.wrap(note, HISTORY_WIDTH - 2):
            header.add_history(f"# {line}")
    for words in commands:
        for line in history_lines(words):
            header.add_history(line)


def _star_table(
    stars: ArrayLike, fluxes: ArrayLike, unit: str, others: Sequence[StarColumn]
) -> fits.BinTableHDU:
    x, y = np.asarray(stars, dtype=np.float64).reshape(-1, 2).T
    columns = [
        StarColumn("x", x, "pix", "column, 0-based"),
        StarColumn("y", y, "pix", "row, 0-based"),
        StarColumn("flux", fluxes, column_unit(unit), unit),
        *others,
    ]
    table = fits.BinTableHDU.from_columns(
        [
            fits.Column(c.name, "D", unit=c.unit, array=np.asarray(c.values, dtype=np.float64))
            for c in columns
        ],
        name="STARS",
    )
    for i, column in enumerate(columns, 1):
        table.header[f"TTYPE{i}"] = (column.name, column.comment)
    return table


def _cube(name: str, images: ArrayLike, unit: str, header: fits.Header) -> fits.ImageHDU:
    hdu = fits.ImageHDU(np.asarray(images, dtype=np.float32), header, name=name)
    if unit:
        hdu.header["BUNIT"] = unit
    return hdu


def _flags(name: str, flags: ArrayLike, header: fits.Header) -> fits.ImageHDU:
    return fits.ImageHDU(np.asarray(flags, dtype=np.uint8), header, name=name)


def _table(name: str, rows: NDArray[np.void]) -> fits.BinTableHDU:
    columns = [
        fits.Column(field, "K" if rows[field].dtype.kind == "i" else "D", array=rows[field])
        for field in rows.dtype.names or ()
    ]
    return fits.BinTableHDU.from_columns(columns, name=name)


def _lines(name: str, column: str, lines: Sequence[str]) -> fits.BinTableHDU:
    texts = np.array([ascii_of(line) for line in lines])
    columns = [fits.Column(column, f"{texts.dtype.itemsize // 4}A", array=texts)]
    return fits.BinTableHDU.from_columns(columns, name=name)


def _row(name: str, values: Mapping[str, NDArray[Any]]) -> fits.BinTableHDU:
    """Return a table of one row, whose columns have arrays of any shape, numbers and texts."""
    columns = []
    for column, value in values.items():
        if value.dtype.kind == "U":
            text = ascii_of(value.item())
            columns.append(fits.Column(column, f"{max(len(text), 1)}A", array=[text]))
            continue
        shape = f"({','.join(map(str, value.shape[::-1]))})" if value.ndim else None
        kind = f"{value.size}{CODES[value.dtype.str[1:]]}"
        columns.append(fits.Column(column, kind, dim=shape, array=value[None]))
    return fits.BinTableHDU.from_columns(columns, name=name)


def ascii_of(text: str) -> str:
    """Return text in ASCII, as FITS needs, with escapes as in Python."""
    return text.encode("unicode_escape").decode("ascii")


def _shell_pieces(word: str) -> list[str]:
    """Return a shell word in quoted pieces that fit a line; written together they are the word."""
    pieces, start, raw = [], 0, os.fsencode(word)
    for end in range(1, len(raw) + 1):
        if end == len(raw) or len(_quote(raw[start : end + 1])) > HISTORY_WIDTH:
            pieces.append(_quote(raw[start:end]))
            start = end
    return pieces or [_quote(raw)]


def _quote(raw: bytes) -> str:
    if all(32 <= byte < 127 for byte in raw):
        return shlex.quote(raw.decode("ascii"))
    escaped = (
        chr(byte) if 32 <= byte < 127 and byte not in b"'\\" else f"\\{byte:03o}" for byte in raw
    )
    return f"$'{''.join(escaped)}'"
