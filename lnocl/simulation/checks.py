"""Checks of numbers, quantities and shapes that the simulation shares."""

from __future__ import annotations

from typing import Any

import numpy as np
from astropy import units as u
from numpy.typing import NDArray

from lnocl.errors import InputError

Array = NDArray[np.float64]

MIN_SIZE = 32

# Electrons that one image may hold of all sources and of the sky in a pixel; Poisson deviates are
# 64-bit integers, and float64 counts one by one up to 9e15.
MAX_ELECTRONS = 1e15


def _quantity(name: str, value: Any, unit: u.UnitBase) -> float:
    """Return a finite number in this unit."""
    try:
        with np.errstate(over="ignore"):
            converted = u.Quantity(value).to_value(unit)
    except (TypeError, ValueError, u.UnitsError):
        raise InputError(
            f"{name} must be a quantity in {unit} or the like; {value} was given"
        ) from None
    if np.ndim(converted) != 0 or not np.isfinite(converted):
        raise InputError(f"{name} must be one finite number; {value} was given")
    return float(converted)


def _positive(name: str, value: Any, unit: u.UnitBase) -> float:
    number = _quantity(name, value, unit)
    if number <= 0:
        raise InputError(f"{name} must be positive; {value} was given")
    return number


def _not_negative(name: str, value: Any, unit: u.UnitBase) -> float:
    number = _quantity(name, value, unit)
    if number < 0:
        raise InputError(f"{name} must not be negative; {value} was given")
    return number


def _check_electrons(name: str, number: float) -> None:
    if not number <= MAX_ELECTRONS:
        raise InputError(
            f"{name} would leave {number:.3g} electrons in one image; at most "
            f"{MAX_ELECTRONS:.0e} can be simulated"
        )


def _check_share(name: str, value: float) -> None:
    if not (isinstance(value, (int, float, np.floating)) and 0 < value <= 1):
        raise InputError(f"{name} must be in (0, 1]; {value} was given")


def _check_shape(shape: Any, least: int = MIN_SIZE) -> tuple[int, int]:
    if np.shape(shape) != (2,):
        raise InputError(f"shape must be (ny, nx); {shape} was given")
    ny, nx = shape
    for n in (ny, nx):
        if not isinstance(n, (int, np.integer)) or n % 2 or n < least:
            raise InputError(
                f"the image is {nx} x {ny} pixels; each side must be even and {least} or more"
            )
    return int(ny), int(nx)
