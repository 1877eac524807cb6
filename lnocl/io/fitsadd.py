"""FITS out: tables and maps that are added to the file of a result."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import IO, Any

import numpy as np
from astropy.io import fits

from lnocl.errors import FileError
from lnocl.io.atomic import update_file
from lnocl.io.fitsfile import FitsFile, open_fits
from lnocl.io.fitsread import wcs_cards
from lnocl.io.fitswrite import Card
from lnocl.io.packed import BLOCK
from lnocl.io.parts import SKY, hdu_of
from lnocl.io.saved_results import SavedResult
from lnocl.io.selection import has_pixels
from lnocl.process import ignored_warnings


def add_parts(
    saved: SavedResult,
    parts: Mapping[str, Any],
    cards: Iterable[Card] = (),
    unit: str = "",
    is_wanted: Callable[[FitsFile, Sequence[Any]], bool] = lambda file, hdus: True,
) -> None:
    """Add parts to the file of a result, or replace those that it has.

    All others are copied byte by byte. What other processes add meanwhile is kept.

    Parameters
    ----------
    saved : SavedResult
        The result, as it was read. Its file is replaced once the new one is complete.
    parts : mapping of str to ndarray, Table or sequence of Column
        Tables and images, as `lnocl.io.parts` declares them, by name.
    cards : iterable of (keyword, value, comment), optional
        Header cards of all.
    unit : str, optional
        That of the result.
    is_wanted : callable, optional
        Whether to add them to the file as it is now, with these HDUs.

    Raises
    ------
    FileError
        The file cannot be read or written, or holds another result now.
    """
    places = {SKY: wcs_cards(saved.header)}
    added = [hdu_of(name, content, places, unit) for name, content in parts.items()]
    for hdu in added:
        hdu.header.extend(cards)
    content = io.BytesIO()
    fits.HDUList([fits.PrimaryHDU(), *added]).writeto(content, checksum=True)

    def write(stream: IO[bytes]) -> None:
        with ignored_warnings(), open_fits(saved.path) as file:  # which were shown once
            hdus = list(file.hdus())
            is_new = is_wanted(file, hdus)
            _refuse_another(saved, file, hdus)
            for k, hdu in enumerate(hdus):
                if not (k and is_new and hdu.name in parts):
                    file.copy(hdu, stream)
        if is_new:
            stream.write(content.getbuffer()[BLOCK:])  # without the empty primary HDU

    update_file(saved.path, write)


def _refuse_another(saved: SavedResult, file: FitsFile, hdus: Sequence[Any]) -> None:
    """Refuse a file whose result is not the one that was read."""
    image = next((hdu for hdu in hdus if has_pixels(hdu)), None)
    stars = next((hdu for hdu in hdus if hdu.name == "STARS"), None)
    if (
        image is None
        or not isinstance(stars, fits.BinTableHDU)
        or not np.array_equal(file.pixels(image), saved.extended, equal_nan=True)
        or not np.array_equal(file.table(stars)["flux"], saved.star_fluxes, equal_nan=True)
    ):
        raise FileError(
            f"{saved.path} holds another result than when it was read, and nothing is added to it: "
            "give the command again"
        )
