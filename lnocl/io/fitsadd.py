"""FITS out: tables and maps that are added to the file of a result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from astropy.io import fits

from lnocl.errors import FileError
from lnocl.io.atomic import whole_file
from lnocl.io.fitsread import wcs_cards


def add_hdus(
    path: str, added: Sequence[fits.BinTableHDU | fits.ImageHDU], maps: Mapping[str, str]
) -> None:
    """Add HDUs to a file, or replace those of the same names.

    Parameters
    ----------
    path : str
        The file; it is replaced once the new one is complete.
    added : sequence of HDU
        Each with a name.
    maps : mapping of str to str
        The unit of each that is a map of the sky, which gets the coordinates of the result.

    Raises
    ------
    FileError
        The file cannot be read or written.
    """
    names = {hdu.name for hdu in added}
    try:
        with fits.open(path, memmap=False) as hdus:
            for hdu in added:
                if hdu.name in maps:
                    hdu.header.extend(wcs_cards(hdus[0].header))
                    hdu.header["BUNIT"] = (maps[hdu.name], "per pixel")
            # As they are: a copy of a table loses the comments of its columns.
            rest = [hdu for hdu in hdus if hdu.name not in names]
            with whole_file(path, overwrite=True) as stream:
                fits.HDUList([*rest, *added]).writeto(stream, checksum=True)
    except OSError as error:
        raise FileError(f"{path} cannot be read again: {error}") from error
