"""Noise as the classes of astropy.nddata hold it, and its part beyond that of the source."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lnocl.core.scene.arrays import Array, numbers
from lnocl.core.scene.quantities import is_nddata
from lnocl.errors import InputError, counted, detail

# A gain that follows from the errors leaves them below the noise of the counts by so much.
ROUNDING = 0.05


class OtherNoiseError(InputError):
    """A map of noise that the images contradict."""


def is_uncertainty(values: Any) -> bool:
    """Return whether values are an uncertainty of astropy.nddata."""
    return is_nddata(values, "NDUncertainty")


def variance_of(name: str, uncertainty: Any) -> tuple[Array, Any]:
    """Return the variance, 0 where it is not known, and its unit, which may be None.

    Parameters
    ----------
    name : str
        What has the uncertainty, for messages.
    uncertainty : astropy.nddata.NDUncertainty
        A StdDevUncertainty, VarianceUncertainty or InverseVariance.

    Raises
    ------
    InputError
        It is of another class, or has negative values.
    """
    from astropy.nddata import VarianceUncertainty

    if (numbers(f"the uncertainty of {name}", uncertainty.array, copy=False) < 0).any():
        raise InputError(f"the uncertainty of {name} has negative values; give 0 or more")
    try:
        with np.errstate(divide="ignore", over="ignore"):
            found = uncertainty.represent_as(VarianceUncertainty)
    except TypeError:
        raise InputError(
            f"{name} has an uncertainty of the class {type(uncertainty).__name__}; make it a "
            "StdDevUncertainty, VarianceUncertainty or InverseVariance, or leave it out"
        ) from None
    variance = numbers(name, found.array, copy=False)
    return np.where(np.isfinite(variance), variance, 0.0), found.unit


def without_source(
    variance: Array,
    counts: Array,
    mask: NDArray[np.bool_],
    words: tuple[str, str] = ("the uncertainty", "`read_noise`"),
) -> Array:
    """Return the standard deviation of all noise but that of the source's counts.

    Parameters
    ----------
    variance, counts : ndarray of float64, shape (p, ny, nx)
        The variance of all noise, electrons squared, and the images, electrons.
    mask : ndarray of bool, shape (p, ny, nx)
        Where neither is needed.
    words : tuple of str
        What messages call the noise, and noise without that of the source.

    Raises
    ------
    InputError
        The variance is less than the counts in most pixels.
    """
    rest = np.where(mask, 0.0, variance - np.where(mask, 0.0, counts.clip(0.0)))
    for j, (left, bad) in enumerate(zip(rest, mask, strict=True)):
        n_below = int((left < -ROUNDING * counts[j].clip(0.0)).sum())
        if n_below > 0.5 * (~bad).sum():
            raise OtherNoiseError(
                f"{words[0]} of `images[{j}]` is less than the noise of its counts in most pixels; "
                f"see to gain and exposure, or give it as {words[1]} if it leaves the source out"
            )
        median = np.sqrt(np.median(left[~bad].clip(0.0))) if not bad.all() else 0.0
        detail(
            "`images[%d]`: noise apart from that of its counts %.3g electrons in the median; %s "
            "whose error is less than the noise of its counts %s none",
            j,
            median,
            counted(n_below, "pixel"),
            "has" if n_below == 1 else "have",
        )
    return np.asarray(np.sqrt(rest.clip(0.0)))
