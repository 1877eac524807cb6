"""The content of files that are compressed as a whole: of FITS as much as the headers claim."""

from __future__ import annotations

import bz2
import contextlib
import gzip
import lzma
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator
from typing import IO, Any, cast

from astropy.io import fits

from lnocl.errors import FileError
from lnocl.process import ignored_warnings

# Bytes of a block of a FITS file, and those that are copied at once.
BLOCK, PART = 2880, 2**20
# Bytes of the longest header, and of what is unpacked in memory.
MAX_HEADER, IN_MEMORY = 2**23, 2**25
# What unpacks files, by the bytes that they begin with.
UNPACK: dict[bytes, Callable[[Any], Any]] = {
    b"\x1f\x8b\x08": gzip.open,
    b"BZh": bz2.open,
    b"\xfd7zXZ\x00": lzma.open,
}
# Keywords that say how many bytes of data follow. Of two with different values astropy takes one to
# read them and the other to go on.
SIZES = re.compile("BITPIX|NAXIS[0-9]*|[PG]COUNT|GROUPS|TFIELDS")
# Those whose value astropy counts to when it reads a header, and the largest that FITS allows.
COUNTS = ("NAXIS", "TFIELDS")
MAX_COUNT = 999


def unpacked(stream: IO[bytes]) -> IO[bytes]:
    """Return the content of a file that may be compressed as a whole."""
    start = stream.read(6)
    stream.seek(0)
    for signature, unpack in UNPACK.items():
        if start.startswith(signature):
            return cast(IO[bytes], unpack(stream))
    return stream


@contextlib.contextmanager
def fits_content(path: str, stream: IO[bytes]) -> Iterator[IO[bytes]]:
    """Yield the content of a FITS file; of a compressed one as much as its headers claim.

    Raises
    ------
    FileError
        A header claims what no file has, or more than there is room for.
    Exception
        Any error of what unpacks it, on a damaged file.
    """
    content = unpacked(stream)
    if content is stream:
        yield stream
        return
    with tempfile.SpooledTemporaryFile(IN_MEMORY) as copy:
        _copy(path, content, cast(IO[bytes], copy))
        copy.seek(0)
        yield cast(IO[bytes], copy)


def _copy(path: str, content: IO[bytes], copy: IO[bytes]) -> None:
    """Copy the HDUs of a file, and the beginning of what follows them, where it is not zeros."""
    while (start := content.read(BLOCK)).strip(b"\0"):
        blocks = Blocks(content, start)
        try:
            with ignored_warnings():
                header = blocks.header()
        except Exception:  # who reads the copy says what is wrong
            break
        finally:
            copy.write(blocks.taken)
        check_sizes(path, header)
        size = header.data_size
        if size > IN_MEMORY and size >= shutil.disk_usage(tempfile.gettempdir()).free:
            raise FileError(
                f"{path} has {size / 2**30:.3g} GiB of data by its header, for which "
                f"{tempfile.gettempdir()} has no room: name another folder by TMPDIR, or unpack it"
            )
        if copy_bytes(content, copy, size + -size % BLOCK):
            break
    content.read(PART)  # up to the checksum at the end


def copy_bytes(source: IO[bytes], target: IO[bytes], size: int) -> int:
    """Copy so many bytes, and return how many are not there."""
    while size > 0 and (part := source.read(min(size, PART))):
        target.write(part)
        size -= len(part)
    return size


class Blocks:
    """The blocks of a header, of which no more than `MAX_HEADER` bytes are read.

    Parameters
    ----------
    content : binary stream
        The file, after the first of them.
    start : bytes
        What was read of it already.
    """

    def __init__(self, content: IO[bytes], start: bytes = b"") -> None:
        self.taken = bytearray()
        self._content, self._start = content, start

    def header(self) -> fits.Header:
        """Return the header.

        Raises
        ------
        Exception
            Any error of astropy on bytes that are not a header.
        """
        return fits.Header.fromfile(cast(Any, self))

    def read(self, size: int) -> bytes:
        """Return the next block, as astropy asks for it."""
        if len(self.taken) >= MAX_HEADER:
            raise ValueError(f"a header does not end within {MAX_HEADER >> 20} MiB")
        part, self._start = self._start or self._content.read(size), b""
        self.taken += part
        return part


def place_of(hdu: Any) -> dict[str, Any]:
    """Return where the header and the data of an HDU begin, and how long the data are, bytes."""
    # astropy 7 knows it of the table that holds compressed tiles alone.
    return cast(dict[str, Any], hdu.fileinfo() or hdu._bintable.fileinfo())


def check_sizes(path: str, header: fits.Header) -> None:
    """Refuse a header of sizes that no file has, before astropy counts to them.

    Raises
    ------
    FileError
        It has more axes or columns than FITS allows, or data of two sizes or of a negative one.
    """
    sizes: dict[str, Any] = {}
    for card in header.cards:
        keyword = card.keyword.upper()
        if not SIZES.fullmatch(keyword):
            continue
        if keyword in COUNTS and not 0 <= card.value <= MAX_COUNT:
            raise FileError(f"{path} is damaged: {keyword} is {card.value}")
        if sizes.setdefault(keyword, card.value) != card.value:
            raise FileError(
                f"{path} is damaged: {keyword} is both {sizes[keyword]} and {card.value}; delete "
                "the wrong one"
            )
    if header.data_size < 0:
        # This would send astropy round in circles.
        raise FileError(f"{path} is damaged: the size of an extension is negative")
