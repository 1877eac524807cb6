"""What FITS headers say, read with care: values, numbers, coordinate systems."""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Iterator
from typing import TYPE_CHECKING

import astropy
from astropy.io import fits

from lnocl.errors import InputError, warn
from lnocl.process import ignored_warnings

if TYPE_CHECKING:
    from astropy.wcs import WCS

# The most that FITS and the SIP convention know of what astropy makes room for.
_LIMITS = (
    (re.compile("WCSAXES[A-Z]?"), 999),
    (re.compile("[AB]P?_ORDER"), 9),
)


def readable(header: fits.Header) -> fits.Header:
    """Return a header without the cards whose value astropy cannot read.

    Warns
    -----
    UserWarning
        A card is left out.
    """
    kept = header.copy()
    for i, card in reversed(list(enumerate(header.cards))):
        try:
            _ = card.value
        except Exception as error:  # whatever a damaged card leads astropy to
            reason = str(error).partition(", ")[0]
            warn(f"a card of the header is left out: {reason}")
            del kept[i]
    return kept


def number(path: str, header: fits.Header, keyword: str) -> float | None:
    """Return the number that a keyword gives; None where it is missing.

    Raises
    ------
    InputError
        The keyword of this file gives no finite number.
    """
    if keyword not in header:
        return None
    value = header[keyword]
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise InputError(f"{keyword} of {path} is {value!r}, no finite number")
    return value


def make_wcs(header: fits.Header, key: str = " ") -> WCS:
    """Return a coordinate system of the first two axes; what astropy says meanwhile is hidden.

    Raises
    ------
    InputError
        A header that claims more axes or coefficients than FITS knows.
    Exception
        Whatever else a damaged header leads astropy to.
    """
    from astropy.wcs import WCS  # a fifth of a second, for headers that have one

    for keyword in header:
        for pattern, most in _LIMITS:
            if pattern.fullmatch(keyword) and not 0 <= header[keyword] <= most:
                raise InputError(f"{keyword} is {header[keyword]}, and {most} at most")
    with ignored_warnings(), quiet_log():
        return WCS(header, key=key, naxis=2)


@contextlib.contextmanager
def quiet_log() -> Iterator[None]:
    """Keep astropy's notes, such as on SIP coefficients, from the terminal."""
    level = astropy.log.level
    astropy.log.setLevel("WARNING")
    try:
        yield
    finally:
        astropy.log.setLevel(level)
