"""FITS out: images and results, with the commands that make them again."""

from __future__ import annotations

import os
import shlex
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from types import MappingProxyType
from typing import Any

import numpy as np
from astropy.io import fits
from numpy.typing import ArrayLike

from lnocl.io.atomic import whole_file
from lnocl.io.headers import finer_cards
from lnocl.io.parts import IMAGES, SKY, Column, ascii_of, hdu_of

# A HISTORY card holds 72 characters; the last one may be needed for a backslash and a space.
HISTORY_WIDTH = 70

Card = tuple[str, str | int | float, str]


def write_result(
    path: str,
    extended: ArrayLike,
    stars: ArrayLike,
    star_fluxes: ArrayLike,
    parts: Mapping[str, Any] = MappingProxyType({}),
    *,
    star_columns: Sequence[Column] = (),
    unit: str = "electron",
    wcs: fits.Header | None = None,
    transforms: ArrayLike = (),
    oversample: int = 1,
    cards: Iterable[Card] = (),
    commands: Iterable[Sequence[str]] = (),
    overwrite: bool = False,
) -> None:
    """Write a result, or a truth: the file is there complete, or not at all.

    The primary HDU holds the extended source, the table ``STARS`` the columns x, y, flux and any
    others given. Other HDUs hold the parts. All have CHECKSUM and DATASUM.

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
    parts : mapping of str to ndarray, Table or sequence of Column, optional
        Further tables and images, as `lnocl.io.parts` declares them, by name; None is left out.
    star_columns : sequence of Column, optional
        Further columns of the table of stars.
    unit : str, optional
        Unit of extended source and fluxes.
    wcs : astropy.io.fits.Header, optional
        Cards of the coordinate systems of the images, from `fitsread.wcs_cards`.
    transforms : array_like, shape (p, 2, 3), optional
        Maps from the sky to the images, pixels. Where they are not all the same, no coordinate
        system holds for all of a cube: it has the cards of `place_cards` instead, as the primary
        header has beside its own.
    oversample : int, optional
        Pixels of the extended source to one of the images, along each axis.
    cards : iterable of (keyword, value, comment), optional
        Further cards of the primary header.
    commands : iterable of sequence of str, optional
        Shell commands that repeat the run, as words; the HISTORY lines spell them out.
    overwrite : bool, optional
        Whether an existing file may be replaced.

    Raises
    ------
    FileError
        The file cannot be written, or exists and must not be overwritten.
    """
    coordinates = fits.Header() if wcs is None else wcs
    is_shared = not np.any(np.asarray(transforms).reshape(-1, 2, 3) - np.eye(2, 3))
    places = [] if is_shared else place_cards(transforms)
    of_sky = coordinates if oversample == 1 else finer_cards(coordinates, oversample)
    header = of_sky.copy()
    header["BUNIT"] = (unit, "per pixel")
    if oversample > 1:
        header["OVERSAMP"] = (oversample, "pixels of this image to one of the frames")
    header["DATE"] = (datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%S"), "UTC, file written")
    _add_provenance(header, [*cards, *places], (), commands)
    x, y = np.asarray(stars, np.float64).reshape(-1, 2).T
    of_stars = [
        Column("x", x, "pix", "column, 0-based"),
        Column("y", y, "pix", "row, 0-based"),
        Column("flux", np.asarray(star_fluxes, np.float64), column_unit(unit), unit),
        *star_columns,
    ]
    where = {SKY: of_sky, IMAGES: coordinates if is_shared else fits.Header(places)}
    hdus = [fits.PrimaryHDU(np.asarray(extended, np.float64), header)]
    contents = {"STARS": of_stars, **parts}.items()
    hdus += [hdu_of(name, each, where, unit) for name, each in contents if each is not None]
    with whole_file(path, overwrite) as stream:
        fits.HDUList(hdus).writeto(stream, checksum=True)


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
        (f"OFF{'XY'[axis]}{j + 1}", float(offset), "offset of the image, pixels")
        for (j, axis), offset in np.ndenumerate(maps[:, :, 2])
    ]
    if (maps[:, :, :2] == np.eye(2)).all():
        return cards
    return cards + [
        (f"R{a + 1}{b + 1}_{j + 1}", float(value), "rotation of the image")
        for (j, a, b), value in np.ndenumerate(maps[:, :, :2])
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
    for word, value in zip(words, [*words[1:], ""], strict=True):
        for i, piece in enumerate(_shell_pieces(word)):
            gap = " " if line and i == 0 else ""
            kept = f"{piece} {value}" if word.startswith("--") else piece  # on one line
            if line and len(line + gap + kept) > HISTORY_WIDTH:
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
