"""FITS out: tables and maps that are added to the file of a result."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from typing import IO, Any

import numpy as np
from astropy.io import fits

from lnocl.errors import FileError
from lnocl.io.atomic import update_file
from lnocl.io.fitsfile import FitsFile, open_fits
from lnocl.io.fitsread import wcs_cards
from lnocl.io.packed import BLOCK
from lnocl.io.saved_results import SavedResult
from lnocl.io.selection import has_pixels
from lnocl.process import ignored_warnings


def add_hdus(
    saved: SavedResult,
    added: Sequence[fits.BinTableHDU | fits.ImageHDU],
    maps: Mapping[str, str],
    is_wanted: Callable[[FitsFile], bool] = lambda file: True,
) -> None:
    """Add HDUs to the file of a result, or replace those of the same names.

    All others are copied byte by byte. What other processes add meanwhile is kept.

    Parameters
    ----------
    saved : SavedResult
        The result, as it was read. Its file is replaced once the new one is complete.
    added : sequence of HDU
        Each with a name.
    maps : mapping of str to str
        The unit of each that is a map of the sky, which gets the coordinates of the result.
    is_wanted : callable, optional
        Whether to add them to the file as it is now.

    Raises
    ------
    FileError
        The file cannot be read or written, or holds another result now.
    """
    for hdu in added:
        if hdu.name in maps:
            hdu.header.extend(wcs_cards(saved.header))
            hdu.header["BUNIT"] = (maps[hdu.name], "per pixel")
    content = io.BytesIO()
    fits.HDUList([fits.PrimaryHDU(), *added]).writeto(content, checksum=True)
    names = {hdu.name for hdu in added}

    def write(stream: IO[bytes]) -> None:
        with ignored_warnings(), open_fits(saved.path) as file:  # which were shown once
            is_new = is_wanted(file)
            hdus = list(file.hdus())
            _refuse_another(saved, file, hdus)
            for k, hdu in enumerate(hdus):
                if not (k and is_new and hdu.name in names):
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
        or not np.array_equal(file.columns(stars)["flux"], saved.star_fluxes, equal_nan=True)
    ):
        raise FileError(
            f"{saved.path} holds another result than when it was read, and nothing is added to it: "
            "give the command again"
        )
