"""Units as headers, tables and quantities name them, and the counts that they are."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from lnocl.process import ignored_warnings

COUNTS = ("electron", "photon", "count")

# Names of units in headers that astropy lacks.
ALIASES = {
    "e": "electron",
    "electrons": "electron",
    "photons": "photon",
    "cts": "ct",
    "counts": "ct",
    "cps": "ct / s",
    "pixels": "pix",
    "sec": "s",
    "second": "s",
    "seconds": "s",
    "degree": "deg",
    "degrees": "deg",
}
# Words that cannot be aliases: names of other units, such as siemens, or no names in astropy's
# grammar.
WORDS = {r"\bS\b": "s", r"(?i)\bper\b": "/", r"(?i)\be-": "electron", r"(?i)\bdn\b": "adu"}

# Units of which no number is one of counts, and why, by patterns of their names.
NOT_LIGHT = {
    r"(?i)(\b|[a-z])mags?\b|\bmag\(|\b(dex|dB)\b": "a logarithm; give the image in linear units",
    r"(?i)\bbeam\b": "that of maps of interferometers and dishes in the radio, whose noise is not "
    "that of counts; give an image of counted photons",
}


def refusal(text: str) -> str:
    """Return why an image in the unit that a header names has no counts; nothing where it may.

    Examples
    --------
    >>> from lnocl.core.scene.units import refusal
    >>> refusal("mag"), refusal("MJy/sr")
    ('a logarithm; give the image in linear units', '')
    """
    return next((why for pattern, why in NOT_LIGHT.items() if re.search(pattern, text)), "")


def parse(text: str) -> Any:
    """Return the unit that a header or a table names, in upper or lower case.

    Each word is taken as it is written where it is a unit, such as Mct and mct, else in lower case,
    such as ELECTRONS.

    Parameters
    ----------
    text : str
        As in BUNIT; see `ALIASES` and `WORDS` for names that astropy lacks.

    Returns
    -------
    astropy.units.UnitBase or None
        None for an empty text; an `astropy.units.UnrecognizedUnit` where the text is not a unit, or
        may be two, such as MCT.
    """
    from astropy import units as u

    if not text.strip():
        return None
    words = text.strip()
    for pattern, replacement in WORDS.items():
        words = re.sub(pattern, replacement, words)
    aliases = {name: u.Unit(unit) for name, unit in ALIASES.items()}
    with ignored_warnings(), u.add_enabled_aliases(aliases):  # of spellings that FITS discourages
        unit = _parse(re.sub("[A-Za-z]+", lambda match: _in_its_case(match[0]), words))
    return u.UnrecognizedUnit(text.strip()) if unit is None else unit


def _in_its_case(word: str) -> str:
    """Return a word as it is where it is a unit, else in lower case if that is the only reading."""
    if _parse(word) is not None or _parse(word.lower()) is None:
        return word
    return word if _parse(word.capitalize()) is not None else word.lower()


def _parse(text: str) -> Any:
    """Return the unit of a text; None where it is not one."""
    from astropy import units as u

    try:
        unit = u.Unit(text, parse_strict="silent")
        # "1," is a structure; -1 and 1e400 are not sizes.
        if isinstance(unit, u.UnitBase) and 0 < unit.decompose().scale < np.inf:
            return None if isinstance(unit, u.UnrecognizedUnit) else unit
    except Exception:  # of any kind: the text is anybody's
        pass
    return None


def is_known(unit: Any) -> bool:
    """Return whether a unit measures anything: a number, a per cent, a word do not."""
    from astropy import units as u

    known = isinstance(unit, u.UnitBase) and not isinstance(unit, u.UnrecognizedUnit)
    return known and not unit.is_equivalent(u.dimensionless_unscaled)


def spelled(unit: Any) -> str:
    """Return a unit as FITS spells it, which has no spelling of its own for electrons.

    Examples
    --------
    >>> from lnocl.core.scene.units import parse, spelled
    >>> [spelled(parse(text)) for text in ("ELECTRONS/S", "MJy / sr", "DN", "counts")]
    ['electron/s', 'MJy/sr', 'adu', 'ct']
    """
    return str(unit.to_string()).replace(" ", "")


def count_of(unit: Any, counts: Sequence[str] = COUNTS) -> tuple[float, bool] | None:
    """Return the number of counts in a unit, and whether it is per second.

    Electrons, photons and counts are all taken as counts, per pixel or not; None for other units,
    those of logarithms such as magnitudes among them.
    """
    from astropy import units as u

    if not isinstance(unit, u.UnitBase):
        return None
    pixels = (u.dimensionless_unscaled, u.pix)
    times = ((u.dimensionless_unscaled, False), (u.s, True))
    for count in (*(getattr(u, name) for name in counts), u.dimensionless_unscaled):
        for pixel in pixels:
            for time, is_rate in times:
                known = count / pixel / time
                if unit.is_equivalent(known):
                    return float(unit.to(known)), is_rate
    return None
