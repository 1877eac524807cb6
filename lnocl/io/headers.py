"""Values, numbers and coordinate systems of FITS headers that may be damaged."""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING

from astropy.io import fits

from lnocl.errors import InputError, note, warn
from lnocl.process import ignored_notes, ignored_warnings

if TYPE_CHECKING:
    from astropy.wcs import WCS


# Counts that astropy allocates memory for, and the largest that FITS and SIP allow: with an A_ORDER
# of 3000 it takes half a minute.
_NUMBERS = re.compile("(CRPIX|CRVAL|CDELT|CROTA)[0-9]+[A-Z]?|(CD|PC)[0-9]+_[0-9]+[A-Z]?")
_LIMITS = (
    (re.compile("WCSAXES[A-Z]?"), 999),
    (re.compile("[AB]P?_ORDER"), 9),
)

# What was observed, when and with what.
OBSERVED = (
    *("OBJECT", "TARGNAME", "TELESCOP", "INSTRUME", "FILTER", "FILTER1", "FILTER2", "DATE-OBS"),
    *("EXPTIME", "EFFEXPTM"),
)
# The electrons in a count of a converter, in headers of HST: of NICMOS, and of STIS and WFPC2.
CONVERTERS = ("ADCGAIN", "ATODGAIN")
# Distortions of HST that need tables beside the header; they are at most 0.1 pixel.
_TABLED = re.compile("(CPDIS|CPERR|DP|D2IM(DIS|ERR|EXT|ARR)?)[0-9]*([.].*)?")


def readable(header: fits.Header) -> fits.Header:
    """Return a header without the cards whose value astropy cannot read.

    Warns
    -----
    UserWarning
        A card is left out.
    """
    cleaned = header.copy()
    for i, card in reversed(list(enumerate(header.cards))):
        try:
            _ = card.value
        except Exception as error:  # astropy may raise any error on a damaged card
            reason = str(error).partition(", ")[0]
            warn(f"a card of the header is left out: {reason}")
            del cleaned[i]
    return cleaned


def observed_cards(
    header: fits.Header, primary: fits.Header
) -> list[tuple[str, str | int | float, str]]:
    """Return the cards that say what was observed, when and with what, without damaged ones.

    They are those of the image, else those of the primary header of its file.
    """
    cards = [(keyword, header.get(keyword, primary.get(keyword))) for keyword in OBSERVED]
    return [
        (keyword, value, "of the first image")
        for keyword, value in cards
        if isinstance(value, str) or (isinstance(value, (int, float)) and math.isfinite(value))
    ]


def finer_cards(cards: fits.Header, oversample: int) -> fits.Header:
    """Return the cards of `fitsread.wcs_cards` for pixels that are so many times finer.

    With q of them to a pixel, pixel x begins at q x: ``CRPIX <- q (CRPIX - 1/2) + 1/2``,
    ``PC <- PC / q``, and a coefficient of SIP of powers i and j ``A <- A q^(1 - i - j)``. CDELT
    stays, as distortions by TPV come before it.

    Examples
    --------
    >>> from astropy.io import fits
    >>> from lnocl.io.headers import finer_cards
    >>> finer_cards(fits.Header({"CRPIX1": 1.0, "CDELT1": 0.5}), 2)
    CRPIX1  =                  1.5
    CDELT1  =                  0.5
    PC1_1   =                  0.5
    PC2_2   =                  0.5
    """
    finer, q = cards.copy(), oversample
    for keyword, value in cards.items():
        if origin := re.fullmatch("CRPIX[12]([A-Z]?)", keyword):
            finer[keyword] = q * (value - 0.5) + 0.5
            for i, j in ((1, 1), (1, 2), (2, 1), (2, 2)):
                name = f"PC{i}_{j}{origin[1]}"
                if i == j or name in cards:
                    finer[name] = cards.get(name, 1.0) / q
        elif powers := re.fullmatch("[AB]P?_([0-9])_([0-9])", keyword):
            finer[keyword] = value * float(q) ** (1 - int(powers[1]) - int(powers[2]))
    return finer


def number(path: str, header: fits.Header, keyword: str) -> float | None:
    """Return the number that a keyword holds; None where it is missing.

    Raises
    ------
    InputError
        Its value in this file is not a finite number.
    """
    if keyword not in header:
        return None
    value = header[keyword]
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise InputError(f"{keyword} of {path} is {value!r}, not a finite number")
    return value


def make_wcs(header: fits.Header, key: str = " ") -> WCS:
    """Return a coordinate system of the first two axes, without astropy's warnings and notes.

    Distortions in tables beside the header, such as the 0.1 pixel of HST's detectors, are left out.

    Raises
    ------
    InputError
        A header that claims more axes or coefficients than FITS allows, or has texts for numbers.
    Exception
        Any error of astropy on a damaged header.
    """
    from astropy.wcs import WCS  # a fifth of a second, for headers that have one

    for keyword in header:
        if _NUMBERS.fullmatch(keyword) and isinstance(header[keyword], str):
            raise InputError(
                f"{keyword} is the text {header[keyword]!r}; write it as a number, without quotes"
            )
        for pattern, largest in _LIMITS:
            if pattern.fullmatch(keyword) and not 0 <= header[keyword] <= largest:
                raise InputError(f"{keyword} is {header[keyword]}; at most {largest} is allowed")
    if any("LOOKUP" in str(header.get(f"{name}1", "")).upper() for name in ("CPDIS", "D2IMDIS")):
        note("distortions in tables, which are below 0.1 pixel, are left out of coordinates")
        header = header.copy()
        for keyword in [word for word in header if _TABLED.fullmatch(word)]:
            header.remove(keyword, ignore_missing=True, remove_all=True)
    with ignored_warnings(), ignored_notes("astropy"):  # such as on SIP coefficients
        return WCS(header, key=key, naxis=2)
