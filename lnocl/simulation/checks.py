"""Checks of numbers, quantities and shapes that the simulation shares."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from astropy import units as u

from lnocl.core.scene.arrays import Array, number_in
from lnocl.errors import InputError

MIN_SIZE = 32


def numbers(name: str, value: Any, unit: u.UnitBase) -> Array:
    """Return a quantity, or a text such as "30 min", as finite numbers in a unit."""
    try:
        with np.errstate(over="ignore"):
            array = np.asarray(u.Quantity(value).to_value(unit), np.float64)
    except (TypeError, ValueError, u.UnitsError):
        raise InputError(
            f"`{name}` must be a quantity in {unit} or a unit of its kind; {value} was given"
        ) from None
    if not np.isfinite(array).all():
        raise InputError(f"`{name}` must be finite; {value} was given")
    return array


def number(name: str, value: Any, unit: u.UnitBase, minimum: float = -math.inf) -> float:
    """Return a quantity as one finite number in a unit, the minimum or more."""
    array = numbers(name, value, unit)
    if array.ndim or array < minimum:
        bound = "" if minimum == -math.inf else f", {minimum:g} or more"
        raise InputError(f"`{name}` must be one number{bound}; {value} was given")
    return float(array)


def positive(name: str, value: Any, unit: u.UnitBase) -> float:
    """Return a quantity as one finite number in a unit, more than 0."""
    value_in_unit = number(name, value, unit)
    if value_in_unit <= 0:
        raise InputError(f"`{name}` must be positive; {value} was given")
    return value_in_unit


def check_share(name: str, value: float) -> None:
    """Refuse a number outside (0, 1]."""
    number_in(name, value, "in (0, 1]", lambda given: 0 < given <= 1)


def check_shape(shape: Any, minimum: int = MIN_SIZE) -> tuple[int, int]:
    """Return a shape (ny, nx); refuse sides that are odd or below a minimum."""
    if np.shape(shape) != (2,):
        raise InputError(f"shape must be (ny, nx); {shape} was given")
    ny, nx = shape
    for n in (ny, nx):
        if not isinstance(n, (int, np.integer)) or n % 2 or n < minimum:
            raise InputError(
                f"the image is {nx} x {ny} pixels; sides must be whole, even and {minimum} or more"
            )
    return int(ny), int(nx)
