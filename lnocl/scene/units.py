"""What astropy's containers and headers hold, in the units of an observation."""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np

from lnocl.errors import InputError
from lnocl.process import ignored_warnings

COUNTS = ("electron", "photon", "count")

# Units that headers have in other words than astropy's.
UNIT_WORDS = {
    r"\s+per\s+": "/",
    r"\b(electron|count|photon|ct|pixel)s\b": r"\1",
    r"\bcts\b": "ct",
    r"\bcps\b": "ct/s",
    r"\be-": "electron",
    r"^e\b": "electron",
    r"\bdn\b": "adu",
    r"\bsec(onds?)?\b": "s",
    r"\bdegrees?\b": "deg",
}


def parse(text: str) -> Any:
    """Return the unit that a header or a table names, in upper or lower case; None for no text.

    An `astropy.units.UnrecognizedUnit` where it is none.
    """
    from astropy import units as u

    if not text.strip():
        return None
    words = text.strip().lower()
    for pattern, replacement in UNIT_WORDS.items():
        words = re.sub(pattern, replacement, words)
    unit = _parse_as_written(words)
    # Of others, such as MJy, the case matters.
    return _parse_as_written(text.strip()) if isinstance(unit, u.UnrecognizedUnit) else unit


def _parse_as_written(text: str) -> Any:
    from astropy import units as u

    with ignored_warnings():  # of ways to write that FITS discourages
        try:
            unit = u.Unit(text, parse_strict="silent")
            # "1," is a structure; -1 and 1e400 are no sizes.
            if isinstance(unit, u.UnitBase) and 0 < unit.decompose().scale < np.inf:
                return unit
        except Exception:  # whatever a text leads astropy to
            pass
    return u.UnrecognizedUnit(text)


class _Counts:
    """Numbers with a unit, or none."""

    def __init__(self, value: Any, unit: Any) -> None:
        self.value, self.unit = value, unit


def _gather(name: str, values: Any, depth: int = 0) -> Any:
    """Return NDData as numbers with a unit, masked where it is, and a sequence with units as one.

    Uncertainties are not used: the noise is Poisson's. Anything else is returned as it is.
    """
    if "astropy.units" not in sys.modules:  # then it cannot have any
        return values
    if _is_nddata(values):
        return _Counts(_masked(name, values), values.unit)
    if not _may_hold_units(values) or depth > 1:  # pairs of lengths are the deepest
        return values
    parts = [_gather(name, part, depth + 1) if _may_hold_units(part) else part for part in values]
    if not any(hasattr(part, "unit") for part in parts):
        return values
    units = {str(getattr(part, "unit", None)): getattr(part, "unit", None) for part in parts}
    if len(units) > 1:
        raise InputError(f"{name} come in several units ({', '.join(units)}); give them in one")
    stack = [np.ma.asanyarray(getattr(part, "value", part)) for part in parts]
    if len({part.shape for part in stack}) > 1:
        raise InputError(f"{name} cannot be read as an array: their shapes differ")
    return _Counts(np.ma.stack(stack), *units.values())


def _may_hold_units(values: Any) -> bool:
    return _is_nddata(values) or (isinstance(values, Sequence) and not isinstance(values, str))


def _is_nddata(values: Any) -> bool:
    if "astropy.nddata" not in sys.modules:
        return False
    from astropy.nddata import NDData

    return isinstance(values, NDData)


def _masked(name: str, values: Any) -> Any:
    data = np.ma.asanyarray(values.data)
    if values.mask is None:
        return data
    if np.shape(values.mask) not in ((), data.shape):
        raise InputError(
            f"{name} have a mask of shape {np.shape(values.mask)}; their data have {data.shape}"
        )
    return np.ma.array(data, mask=np.asarray(values.mask, bool))


def plain(name: str, values: Any, has_exposure: bool | None = None) -> tuple[Any, bool]:
    """Return counts without their unit, and whether they are per unit of exposure time.

    Parameters
    ----------
    name : str
        What they are.
    values : array_like, Quantity, NDData or a sequence of these
        Without a unit they are taken as electrons. Of several the units must be the same.
    has_exposure : bool, optional
        Whether there are exposures to multiply counts per time by; None: that makes no sense.

    Raises
    ------
    InputError
        A unit that is no count; counts per time without exposures.
    """
    values = _gather(name, values)
    unit = getattr(values, "unit", None)
    if unit is None:
        return (values.value if isinstance(values, _Counts) else values), False
    known = count_of(unit)
    if known is None:
        from astropy import units as u

        digital = {u.adu, u.DN} & set(unit.decompose().bases)
        advice = "; multiply by the gain (electrons per adu)" if digital else " per pixel"
        raise InputError(f"{name} in {unit} are no counts: give electrons{advice}")
    factor, is_rate = known
    if is_rate and not has_exposure:
        advice = "electrons" if has_exposure is None else "exposure in seconds with them"
        raise InputError(f"{name} in {unit} are counts per time; give {advice}")
    return values.value * factor, is_rate


def count_of(unit: Any, counts: Sequence[str] = COUNTS) -> tuple[float, bool] | None:
    """Return how many counts a unit is, and whether per second; None where it is no count.

    Electrons, photons and counts are all taken as counts, per pixel or not.
    """
    from astropy import units as u

    pixels = (u.dimensionless_unscaled, u.pix)
    times = ((u.dimensionless_unscaled, False), (u.s, True))
    for count in (*(getattr(u, name) for name in counts), u.dimensionless_unscaled):
        for pixel in pixels:
            for time, is_rate in times:
                known = count / pixel / time
                if unit.is_equivalent(known):
                    return float(unit.to(known)), is_rate
    return None


def seconds(values: Any) -> Any:
    """Return exposures as plain numbers, times in seconds.

    Raises
    ------
    InputError
        A unit that is no time.
    """
    values = _gather("exposure", values)
    unit = getattr(values, "unit", None)
    if unit is None:
        return values.value if isinstance(values, _Counts) else values
    from astropy import units as u

    for known in (u.s, u.dimensionless_unscaled):
        if unit.is_equivalent(known):
            return values.value * unit.to(known)
    raise InputError(f"exposure in {unit} is no time: give seconds, or numbers without unit")


def pixels(name: str, values: Any) -> Any:
    """Return lengths in pixels as plain numbers.

    Raises
    ------
    InputError
        A unit that is no pixel.
    """
    values = _gather(name, values)
    unit = getattr(values, "unit", None)
    if unit is None:
        return values.value if isinstance(values, _Counts) else values
    from astropy import units as u

    if not unit.is_equivalent(u.pix):
        raise InputError(f"{name} in {unit} are no pixels: give pixels, from the WCS of the images")
    return values.value * unit.to(u.pix)


def bare(name: str, values: Any) -> Any:
    """Return values without a unit, whatever it is: of PSFs only the shape counts."""
    values = _gather(name, values)
    return getattr(values, "value", values) if hasattr(values, "unit") else values
