"""An open FITS file: the one place where astropy's errors on a file become ours."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import io
import os
import stat
from collections.abc import Iterator
from dataclasses import dataclass
from typing import IO, Any

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from lnocl.errors import FileError, LnoclError, warn
from lnocl.io.encoded import unpacked, verify
from lnocl.io.packed import BLOCK, Blocks, check_sizes, copy_bytes, fits_content, place_of
from lnocl.process import recorded_warnings


@dataclass
class FitsFile:
    """A FITS file that `open_fits` has opened.

    Parameters
    ----------
    path : str
        Its name.
    stream : binary stream
        The file as it lies on the disk.
    content : binary stream
        Its content, unpacked where it is compressed as a whole.
    hdus : astropy.io.fits.HDUList
        The same, read.
    length : int
        Bytes of the content.
    """

    path: str
    _stream: io.BufferedReader
    _content: IO[bytes]
    _hdus: fits.HDUList
    _length: int

    def hdus(self) -> Iterator[Any]:
        """Yield the HDUs, each after a check that the file holds as much as its header claims.

        Raises
        ------
        FileError
            An HDU of negative size, or beyond the end of the file.

        Warns
        -----
        UserWarning
            The end of the file is not an HDU, and is left out.
        """
        for hdu in self._hdus:
            where = place_of(hdu)
            yield hdu
            end = where["datLoc"] + where["datSpan"]
            if end >= self._length or self._is_empty(end):
                return
            try:
                check_header(self.path, self._content, self._length, end)
            except FileError:
                raise
            except Exception as error:
                warn(f"everything after byte {end} is left out: {error}")
                return

    def _is_empty(self, start: int) -> bool:
        """Return whether the block that starts at this byte is one of zeros, as tapes end in."""
        self._content.seek(start)
        return not self._content.read(BLOCK).strip(b"\0")

    def pixels(self, hdu: Any) -> NDArray[np.float64]:
        """Return the pixels of an image.

        Raises
        ------
        FileError
            An image larger than the memory; damaged tiles.

        Warns
        -----
        UserWarning
            Data that do not match their DATASUM.
        """
        needed = 8 * int(np.prod([int(n) for n in hdu.shape], dtype=object))
        memory = _memory()
        if needed > memory:
            raise FileError(
                f"{self.path} has an image of shape {hdu.shape}, {needed / 2**30:.3g} GiB; "
                f"this machine has {memory / 2**30:.3g} GiB of memory"
            )
        if isinstance(hdu, fits.CompImageHDU):  # in tiles, as fpack leaves it
            return unpacked(self.path, hdu, self._content)
        self._verify(hdu)
        return np.array(hdu.data, dtype=np.float64)

    def table(self, hdu: Any) -> dict[str, NDArray[Any]]:
        """Return the columns of a table, by name: numbers, arrays of them, or text.

        Warns
        -----
        UserWarning
            Data that do not match their DATASUM.
        """
        self._verify(hdu)
        columns = {}
        for name in hdu.columns.names:
            values = np.asarray(hdu.data[name])
            if values.dtype.kind in "SU":
                texts = [_unescaped(str(text).rstrip()) for text in values.ravel().tolist()]
                columns[name] = np.array(texts, str)
            else:
                columns[name] = values.astype(values.dtype.newbyteorder("="))
        return columns

    def numbers(self, table: str, columns: dict[str, NDArray[Any]]) -> dict[str, NDArray]:
        """Return the columns of a table that has one number a row in each, as float64.

        Raises
        ------
        FileError
            A column with several numbers in a row.
        """
        for name, values in columns.items():
            if values.ndim != 1:
                raise FileError(
                    f"{self.path} has several numbers in a row of column {name} of {table}"
                )
        return {name: values.astype(np.float64) for name, values in columns.items()}

    def _verify(self, hdu: Any) -> None:
        where = place_of(hdu)
        if where["datLoc"] + where["datSpan"] > self._length:
            return  # astropy warns of missing padding, and cannot sum without it
        verify(hdu)

    def copy(self, hdu: Any, stream: IO[bytes]) -> None:
        """Copy an HDU as it is, but for the padding that it may lack."""
        where = place_of(hdu)
        self._content.seek(where["hdrLoc"])
        size = where["datLoc"] + where["datSpan"] - where["hdrLoc"]
        stream.write(bytes(copy_bytes(self._content, stream, size)))

    def sha256(self) -> str:
        """Return the checksum of the file, in hexadecimal; call it last."""
        self._stream.seek(0)
        return hashlib.file_digest(self._stream, "sha256").hexdigest()


def _unescaped(text: str) -> str:
    """Return the text that `lnocl.io.parts.ascii_of` has escaped."""
    return text.encode("ascii").decode("unicode_escape")


def check_header(path: str, content: IO[bytes], length: int, start: int) -> None:
    """Refuse a header that claims too much, before astropy counts to it or makes room for it.

    Raises
    ------
    FileError
        The header that starts at this byte has more axes or columns than FITS allows, data that
        are not there or of two sizes, or more rows than the file has bytes.
    Exception
        Any error of astropy on bytes that are not a header.
    """
    content.seek(start)
    header = Blocks(content).header()
    check_sizes(path, header)
    if length < (end := content.tell() + header.data_size):
        raise FileError(f"{path} is truncated: it should have {end} bytes and has {length}")
    # Rows of no bytes are always there, and take as long to read as others.
    if isinstance(rows := header.get("NAXIS2"), (int, float)) and rows > length:
        raise FileError(f"{path} is damaged: it has {rows} rows in {length} bytes")


def open_regular(path: str) -> io.BufferedReader:
    """Open a file to read; devices and pipes may have no end, and are refused.

    Raises
    ------
    OSError, ValueError
        As `open`; the path is a device or a pipe.
    """
    mode = os.stat(path).st_mode
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):  # open refuses a folder
        raise OSError(errno.EINVAL, "it is not a regular file; save its content to one first")
    return open(path, "rb")


@contextlib.contextmanager
def open_fits(
    path: str, complaint: str = "is not a FITS file, or is damaged"
) -> Iterator[FitsFile]:
    """Open a FITS file, and raise all errors while it is open as FileError.

    Parameters
    ----------
    path : str
        File to read.
    complaint : str, optional
        The words after the name of a file that astropy cannot read.

    Yields
    ------
    FitsFile
        Errors that reading it raises are those of the file, but for faults of lnocl itself.

    Raises
    ------
    FileError
        A file that is missing, damaged, not a regular one or not FITS.

    Warns
    -----
    LnoclWarning
        Faults that astropy found and mended.
    """
    try:
        stream = open_regular(path)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise FileError(f"{path} cannot be opened: {reason}") from error
    with stream, recorded_warnings() as caught:
        try:
            with fits_content(path, stream) as content:
                length = content.seek(0, os.SEEK_END)
                check_header(path, content, length, 0)
                content.seek(0)
                with fits.open(content, memmap=False) as hdus:
                    yield FitsFile(path, stream, content, hdus, length)
        except (LnoclError, MemoryError, ImportError, NameError):
            raise  # no file can make the last two
        except Exception as error:
            # astropy may raise any error on a damaged file; its advice is for programmers.
            reason = str(error).partition(". ")[0] or "it ends too early"
            raise FileError(f"{path} {complaint}: {reason}") from error
    for warning in caught:
        warn(f"{path}: {warning.message}")


def _memory() -> float:
    """Return the machine's memory, bytes; infinite where it is not known, as on Windows."""
    if not hasattr(os, "sysconf"):
        return float("inf")
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
