"""Counts and exposures, as quantities and NDData hold them, in the units of an observation."""

from __future__ import annotations

from typing import Any

import numpy as np

from lnocl.core.scene.quantities import is_nddata, split
from lnocl.core.scene.uncertainties import is_uncertainty, variance_of
from lnocl.core.scene.units import count_of
from lnocl.errors import InputError


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
    numbers, unit = split(name, values)
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
    given = [part.uncertainty if is_nddata(part) else None for part in parts]
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
