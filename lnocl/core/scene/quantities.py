"""Quantities, NDData and sequences of them as plain numbers, in a unit that is asked for.

What has a unit becomes plain numbers here and nowhere else: `lnocl.core.scene.arrays` takes no
unit.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

import numpy as np

from lnocl.errors import InputError

# What messages advise where values are in a wrong unit.
ADVICE = {"pix": "; convert them with the WCS of the images"}
SPELLED = {"pix": "pixels", "deg": "degrees", "s": "seconds"}


class _Numbers:
    """Numbers with their unit, which may be None."""

    def __init__(self, value: Any, unit: Any) -> None:
        self.value, self.unit = value, unit


def split(name: str, values: Any) -> tuple[Any, Any]:
    """Return plain numbers and their unit; the unit is None for plain numbers.

    Raises
    ------
    InputError
        A unit that is not linear; parts of a sequence in units of several kinds.
    """
    values = _gather(name, values)
    unit = getattr(values, "unit", None)
    if unit is None and not isinstance(values, _Numbers):
        return values, None
    _refuse_logarithms(name, unit)
    return values.value, unit


def in_unit(name: str, values: Any, wanted: Any) -> Any:
    """Return values as plain numbers in a unit; those without a unit stay as they are.

    Parameters
    ----------
    name : str
        Name of the argument, for messages.
    values : array_like, Quantity, NDData or a sequence of these
        What has no dimension is taken as numbers, 5 % as 0.05.
    wanted : str or astropy.units.UnitBase
        The unit; "" for plain numbers. Angles are those of `astropy.coordinates` too.

    Raises
    ------
    InputError
        A unit of another kind; as `split`.
    """
    numbers, unit = split(name, values)
    if unit is None:
        return numbers
    if unit.physical_type == "dimensionless":
        return numbers * unit.to("")
    if not unit.is_equivalent(wanted):
        kind = f"in {SPELLED.get(wanted, wanted)}" if wanted else "numbers without a unit"
        raise InputError(f"`{name}` must be {kind}, not in {unit}{ADVICE.get(wanted, '')}")
    return numbers * unit.to(wanted)


def bare(name: str, values: Any) -> Any:
    """Return values without their unit: of PSFs only the shape counts."""
    return split(name, values)[0]


def _gather(name: str, values: Any, depth: int = 0) -> Any:
    """Return NDData as numbers with a unit, masked where it is, and a sequence with units as one.

    Uncertainties are read by `containers.variances` alone. Anything else is returned as it is.
    """
    if "astropy.units" not in sys.modules:  # then it cannot have any
        return values
    if is_nddata(values):
        return _Numbers(_masked(name, values), values.unit)
    if not _may_hold_units(values) or depth > 1:  # pairs of lengths are the deepest
        return values
    parts = [_gather(name, part, depth + 1) if _may_hold_units(part) else part for part in values]
    if not any(hasattr(part, "unit") for part in parts):
        return values
    unit = _unit_of_all(name, [getattr(part, "unit", None) for part in parts])
    stack = [np.ma.asanyarray(_value_in(part, unit)) for part in parts]
    if len({part.shape for part in stack}) > 1:
        raise InputError(f"`{name}` cannot be read as an array: their shapes differ")
    return _Numbers(np.ma.stack(stack), unit)


def _unit_of_all(name: str, units: Sequence[Any]) -> Any:
    """Return the first of some units, in which all of them can be."""
    for each in units:
        _refuse_logarithms(name, each)
    first = units[0]
    if any((each is None) != (first is None) for each in units) or not all(
        each is None or each.is_equivalent(first) for each in units
    ):
        named = ", ".join(dict.fromkeys(map(str, units)))
        raise InputError(f"`{name}` come in several units ({named}); give them in one")
    return first


def _value_in(part: Any, unit: Any) -> Any:
    if not hasattr(part, "unit"):
        return part
    return part.value if part.unit in (None, unit) else part.value * part.unit.to(unit)


def _may_hold_units(values: Any) -> bool:
    return is_nddata(values) or (isinstance(values, Sequence) and not isinstance(values, str))


def is_nddata(values: Any, kind: str = "NDData") -> bool:
    """Return whether values are of a class of astropy.nddata, or one of it, such as a CCDData."""
    if "astropy.nddata" not in sys.modules:  # then they cannot be
        return False
    from astropy import nddata

    return isinstance(values, getattr(nddata, kind))


def coordinates(values: Any) -> list[Any]:
    """Return the WCS of each NDData of a sequence, or of one, as it is; None where it has none."""
    several = values if isinstance(values, (list, tuple)) else [values]
    return [each.wcs if is_nddata(each) else None for each in several]


def _masked(name: str, values: Any) -> Any:
    data = np.ma.asanyarray(values.data)
    if values.mask is None:
        return data
    if np.shape(values.mask) not in ((), data.shape):
        raise InputError(
            f"`{name}` have a mask of shape {np.shape(values.mask)}; their data have {data.shape}"
        )
    return np.ma.array(data, mask=np.asarray(values.mask, bool))


def _refuse_logarithms(name: str, unit: Any) -> None:
    from astropy import units as u

    is_linear = unit is None or (isinstance(unit, u.UnitBase) and not unit.is_equivalent(u.mag))
    if not is_linear:
        raise InputError(
            f"`{name}` in {unit} are not linear; give them in linear units, as physical does of a "
            "Magnitude"
        )
