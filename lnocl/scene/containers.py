"""Quantities, NDData and sequences of them as plain numbers, in the units of an observation."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

import numpy as np

from lnocl.errors import InputError
from lnocl.scene.uncertainties import is_uncertainty, variance_of
from lnocl.scene.units import count_of


class _Numbers:
    """Numbers with their unit, which may be None."""

    def __init__(self, value: Any, unit: Any) -> None:
        self.value, self.unit = value, unit


def _gather(name: str, values: Any, depth: int = 0) -> Any:
    """Return NDData as numbers with a unit, masked where it is, and a sequence with units as one.

    Uncertainties are read by `variances` alone. Anything else is returned as it is.
    """
    if "astropy.units" not in sys.modules:  # then it cannot have any
        return values
    if _is_nddata(values):
        return _Numbers(_masked(name, values), values.unit)
    if not _may_hold_units(values) or depth > 1:  # pairs of lengths are the deepest
        return values
    parts = [_gather(name, part, depth + 1) if _may_hold_units(part) else part for part in values]
    if not any(hasattr(part, "unit") for part in parts):
        return values
    units = {str(getattr(part, "unit", None)): getattr(part, "unit", None) for part in parts}
    if len(units) > 1:
        raise InputError(f"`{name}` come in several units ({', '.join(units)}); give them in one")
    stack = [np.ma.asanyarray(getattr(part, "value", part)) for part in parts]
    if len({part.shape for part in stack}) > 1:
        raise InputError(f"`{name}` cannot be read as an array: their shapes differ")
    return _Numbers(np.ma.stack(stack), *units.values())


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
            f"`{name}` have a mask of shape {np.shape(values.mask)}; their data have {data.shape}"
        )
    return np.ma.array(data, mask=np.asarray(values.mask, bool))


def _split(name: str, values: Any) -> tuple[Any, Any]:
    """Return plain numbers and their unit; the unit is None for plain numbers."""
    values = _gather(name, values)
    unit = getattr(values, "unit", None)
    if unit is None and not isinstance(values, _Numbers):
        return values, None
    _refuse_logarithms(name, unit)
    return values.value, unit


def _refuse_logarithms(name: str, unit: Any) -> None:
    from astropy import units as u

    if not (unit is None or isinstance(unit, u.UnitBase)):
        raise InputError(
            f"`{name}` in {unit} are not linear; give them in linear units, as physical does of a "
            "Magnitude"
        )


def counts(
    name: str, values: Any, has_exposure: bool | None = None, kind: str = "counts per pixel"
) -> tuple[Any, bool]:
    """Return counts without their unit, and whether they are per unit of exposure time.

    Parameters
    ----------
    name : str
        Name of the argument, for messages.
    values : array_like, Quantity, NDData or a sequence of these
        Without a unit they are taken as electrons. All parts of a sequence have the same unit.
    has_exposure : bool, optional
        Whether there are exposures to multiply counts per time by; None where counts per time make
        no sense.
    kind : str, optional
        How messages name them.

    Returns
    -------
    numbers : array_like
        Counts, or counts per unit of exposure time.
    are_rates : bool
        Whether they are per unit of exposure time.

    Raises
    ------
    InputError
        A unit that is not a count; counts per time without exposures.
    """
    numbers, unit = _split(name, values)
    if unit is None:
        return numbers, False
    known = count_of(unit)
    if known is None:
        from astropy import units as u

        digital = {u.adu, u.DN} & set(unit.decompose().bases)
        advice = "multiply by the gain (electrons per adu)" if digital else "give electrons"
        raise InputError(f"`{name}` must be {kind}, not {unit}; {advice}")
    factor, is_rate = known
    if is_rate and not has_exposure:
        advice = "electrons" if has_exposure is None else "`exposure` in seconds with them"
        raise InputError(f"`{name}` in {unit} are counts per time; give {advice}")
    return numbers * factor, is_rate


def variances(name: str, values: Any, are_rates: bool) -> Any:
    """Return the variances of NDData that have uncertainties, None where none has.

    Parameters
    ----------
    name : str
        Name of the argument, for messages.
    values : array_like, Quantity, NDData or a sequence of these
        What `counts` was given.
    are_rates : bool
        Whether they are per unit of exposure time.

    Returns
    -------
    ndarray of float64 or None
        Electrons squared, or these per unit of exposure time squared; of the shape of the values.

    Raises
    ------
    InputError
        Some of several have none; a unit that does not belong to that of the values; as
        `uncertainties.variance_of`.
    """
    parts = values if isinstance(values, (list, tuple)) else [values]
    given = [part.uncertainty if _is_nddata(part) else None for part in parts]
    if not any(is_uncertainty(each) for each in given):
        return None
    if not all(is_uncertainty(each) for each in given):
        raise InputError(f"some of `{name}` have an uncertainty; give all of them one, or none")
    found = []
    for part, each in zip(parts, given, strict=True):
        variance, factor = _squared_counts(name, each, are_rates)
        if variance.shape not in ((), part.data.shape):
            raise InputError(
                f"`{name}` have an uncertainty of shape {variance.shape}; their data have "
                f"{part.data.shape}"
            )
        found.append(np.broadcast_to(factor * variance, part.data.shape))
    return np.array(found if isinstance(values, (list, tuple)) else found[0])


def deviations(name: str, uncertainty: Any) -> Any:
    """Return the standard deviation of an uncertainty, electrons, 0 where it is not known.

    Raises
    ------
    InputError
        A unit that is not one of counts; as `uncertainties.variance_of`.
    """
    variance, factor = _squared_counts(name, uncertainty, False)
    return np.sqrt(factor * variance)


def _squared_counts(name: str, uncertainty: Any, are_rates: bool) -> tuple[Any, float]:
    """Return a variance, and the square of the counts in its unit."""
    variance, unit = variance_of(name, uncertainty)
    known = (1.0, are_rates) if unit is None else count_of(unit**0.5)
    if known is None or known[1] != are_rates:
        raise InputError(
            f"the uncertainty of `{name}` is in {uncertainty.unit}; give it in counts, as `{name}`"
        )
    return variance, known[0] ** 2


def seconds(values: Any) -> Any:
    """Return exposures as plain numbers, times in seconds.

    Raises
    ------
    InputError
        A unit that is not a time.
    """
    return _in_unit("exposure", values, "s", "in seconds or numbers without unit, not in {}")


def pixels(name: str, values: Any) -> Any:
    """Return lengths in pixels as plain numbers.

    Raises
    ------
    InputError
        A unit other than pixels.
    """
    wanted = "in pixels, not in {}; convert them with the WCS of the images"
    return _in_unit(name, values, "pix", wanted)


def _in_unit(name: str, values: Any, wanted: str, words: str) -> Any:
    """Return values as plain numbers in a unit; those without unit stay as they are."""
    numbers, unit = _split(name, values)
    if unit is None or unit.physical_type == "dimensionless":
        return numbers if unit is None else numbers * unit.to("")
    if not unit.is_equivalent(wanted):
        raise InputError(f"`{name}` must be {words.format(unit)}")
    return numbers * unit.to(wanted)


def bare(name: str, values: Any) -> Any:
    """Return values without their unit: of PSFs only the shape counts."""
    return _split(name, values)[0]
