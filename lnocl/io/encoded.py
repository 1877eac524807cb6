"""Pixels that a file holds packed: in compressed tiles, or through an asinh."""

from __future__ import annotations

import io
import math
import subprocess
import sys
from typing import IO, Any

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from lnocl.errors import FileError, InputError, note, warn
from lnocl.io.headers import number
from lnocl.io.packed import place_of

# Unpacks the image of standard input, and writes its pixels, or why that cannot be done.
PROGRAM = """
import io, sys
import numpy
from astropy.io import fits
try:
    with fits.open(io.BytesIO(sys.stdin.buffer.read())) as hdus:
        pixels = numpy.array(hdus[1].data, numpy.float64)
except Exception as error:
    sys.exit(str(error).partition(chr(10))[0])
sys.stdout.buffer.write(pixels.tobytes())
"""
# The keywords of an asinh of the pixels, as Pan-STARRS has it, and its scale, magnitudes.
ASINH, POGSON = ("BSOFTEN", "BOFFSET"), 2.5 / math.log(10.0)


def unpacked(path: str, hdu: fits.CompImageHDU, content: IO[bytes]) -> NDArray[np.float64]:
    """Return the pixels of an image that is compressed in tiles.

    A process of its own unpacks them: damaged tiles corrupt its memory (so in astropy 8.0).

    Parameters
    ----------
    path : str
        Its file, for messages.
    hdu : astropy.io.fits.CompImageHDU
        The image.
    content : binary stream
        The content of the file.

    Raises
    ------
    FileError
        It is damaged.

    Warns
    -----
    UserWarning
        Tiles that do not match their DATASUM.
    """
    where = place_of(hdu)
    content.seek(where["hdrLoc"])
    tiles = content.read(where["datLoc"] + where["datSpan"] - where["hdrLoc"])
    alone = fits.PrimaryHDU().header.tostring().encode() + tiles
    with fits.open(io.BytesIO(alone), disable_image_compression=True) as hdus:
        rows = hdus[1].header["NAXIS2"]
        verify(hdus[1])
    sides = zip(hdu.shape, hdu.tile_shape, strict=True)
    needed = math.prod(-(-side // tile) if tile > 0 else 0 for side, tile in sides)
    if rows != needed:  # which may be millions of millions
        raise FileError(f"{path} is damaged: it has {rows} tiles, and its shape {needed}")
    command = [sys.executable, "-P", "-W", "ignore", "-c", PROGRAM]
    run = subprocess.run(command, input=alone, capture_output=True, check=False)
    size = math.prod(hdu.shape)
    if run.returncode or len(run.stdout) != 8 * size:
        reason = run.stderr.decode(errors="replace").strip().splitlines()[-1:]
        raise FileError(
            f"{path} is damaged: its tiles cannot be unpacked" + "".join(f": {r}" for r in reason)
        )
    return np.frombuffer(bytearray(run.stdout)).reshape(hdu.shape)


def verify(hdu: Any) -> None:
    """Warn where data do not match their DATASUM."""
    if "DATASUM" in hdu.header and hdu.verify_datasum() == 0:
        warn("the data do not match their DATASUM; the file may be damaged")


def linear(path: str, pixels: NDArray[np.float64], header: fits.Header) -> NDArray[np.float64]:
    """Return pixels as they were before an asinh, where the header tells of one.

    The stacks of Pan-STARRS have ``C = a asinh((L - BOFFSET) / (2 BSOFTEN))``, with ``a = 2.5 /
    ln 10``.

    Parameters
    ----------
    path : str
        Their file, for messages.
    pixels : ndarray of float64
        As the file has them.
    header : astropy.io.fits.Header
        Of the image.

    Raises
    ------
    InputError
        A keyword of the asinh is missing, or not a finite number.

    Examples
    --------
    >>> import numpy as np
    >>> from astropy.io import fits
    >>> from lnocl.io.encoded import linear
    >>> header = fits.Header({"BSOFTEN": 95.0, "BOFFSET": 2.0})
    >>> stored = 1.085736 * np.arcsinh((np.array([12.0]) - 2.0) / (2.0 * 95.0))
    >>> linear("a.fits", stored, header).round(3)
    array([12.])
    """
    softening, offset = (number(path, header, keyword) for keyword in ASINH)
    if softening is None and offset is None:
        return pixels
    if softening is None or offset is None:
        held, lost = ASINH if offset is None else ASINH[::-1]
        raise InputError(
            f"{path} is stored by an asinh: it has {held} in its header, and no {lost}; give its "
            "linear image"
        )
    note("%s: its pixels are stored by an asinh (BSOFTEN), and made linear", path)
    return offset + 2.0 * softening * np.sinh(pixels / POGSON)
