"""What astropy's containers hold, as plain numbers in the units of an observation."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

import numpy as np

from lnocl.errors import InputError

COUNTS = ("electron", "photon", "count")


def as_masked(images: Any) -> Any:
    """Return an `astropy.nddata.NDData`, or a sequence of them, as a masked array or Quantity.

    Several are stacked; their units must be the same. Their uncertainties are not used: the noise
    is Poisson's. Anything else is returned as it is.
    """
    if "astropy.nddata" not in sys.modules:  # then it cannot be one
        return images
    from astropy.nddata import NDData

    if isinstance(images, NDData):
        return _Counts(np.ma.array(images.data, mask=_mask_of(images)), images.unit)
    is_sequence = isinstance(images, Sequence) and not isinstance(images, str)
    if is_sequence and any(isinstance(image, NDData) for image in images):
        units = {image.unit if isinstance(image, NDData) else None for image in images}
        if len(units) > 1:
            raise InputError(
                f"images come in several units ({', '.join(map(str, units))}); give them in one"
            )
        stack = [np.ma.array(image.data, mask=_mask_of(image)) for image in images]
        if len({image.shape for image in stack}) > 1:
            raise InputError("images cannot be read as an array: their shapes differ")
        return _Counts(np.ma.stack(stack), units.pop())
    return images


class _Counts:
    """Numbers with a unit, or none."""

    def __init__(self, value: Any, unit: Any) -> None:
        self.value, self.unit = value, unit


def _mask_of(image: Any) -> Any:
    return np.ma.nomask if getattr(image, "mask", None) is None else image.mask


def plain(name: str, values: Any, per_exposure: bool = False) -> tuple[Any, bool]:
    """Return counts without their unit, and whether they are per unit of exposure time.

    Parameters
    ----------
    name : str
        What they are.
    values : array_like, Quantity or what `as_masked` returns
        Without a unit they are taken as electrons.
    per_exposure : bool, optional
        Whether counts per time may be taken, in seconds.

    Raises
    ------
    InputError
        A unit that is no count.
    """
    unit = getattr(values, "unit", None)
    if unit is None:
        return (values.value if isinstance(values, _Counts) else values), False
    known = count_of(unit)
    if known is None:
        from astropy import units as u

        advice = "; multiply by the gain, electrons per adu" if unit.is_equivalent(u.adu) else ""
        raise InputError(f"{name} in {unit} are no counts: give electrons per pixel{advice}")
    factor, is_rate = known
    if is_rate and not per_exposure:
        raise InputError(f"{name} in {unit} are counts per time; give electrons")
    return values.value * factor, is_rate


def count_of(unit: Any) -> tuple[float, bool] | None:
    """Return how many counts a unit is, and whether per second; None where it is no count.

    Electrons, photons and counts are all taken as counts, per pixel or not.
    """
    from astropy import units as u

    pixels = (u.dimensionless_unscaled, u.pix)
    times = ((u.dimensionless_unscaled, False), (u.s, True))
    for count in (*(getattr(u, name) for name in COUNTS), u.dimensionless_unscaled):
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
    unit = getattr(values, "unit", None)
    if unit is None:
        return values
    from astropy import units as u

    for known in (u.s, u.dimensionless_unscaled):
        if unit.is_equivalent(known):
            return values.to_value(known)
    raise InputError(f"exposure in {unit} is no time: give seconds, or numbers without unit")


def pixels(name: str, values: Any) -> Any:
    """Return lengths in pixels as plain numbers.

    Raises
    ------
    InputError
        A unit that is no pixel.
    """
    unit = getattr(values, "unit", None)
    if unit is None:
        return values
    from astropy import units as u

    if not unit.is_equivalent(u.pix):
        raise InputError(f"{name} in {unit} are no pixels: give pixels, from the WCS of the images")
    return values.to_value(u.pix)


def bare(values: Any) -> Any:
    """Return values without a unit, whatever it is: of PSFs only the shape counts."""
    values = as_masked(values)
    if isinstance(values, _Counts):
        return np.ma.getdata(values.value)
    return getattr(values, "value", values) if hasattr(values, "unit") else values
