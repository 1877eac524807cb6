"""Checks of the arguments that a PSF is made from."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from lnocl.core.scene.arrays import numbers
from lnocl.core.scene.quantities import in_unit
from lnocl.errors import InputError

MIN_SIZE = 3


def one_number(name: str, value: object) -> float:
    """Return one finite number."""
    array = numbers(name, value)  # type: ignore[arg-type]
    if array.ndim or not np.isfinite(array):
        raise InputError(f"`{name}` is {value!r}; give one finite number")
    return float(array)


def saturation_level(saturation: float | None) -> float:
    """Return the level from which on a pixel is saturated; infinite by default."""
    if saturation is None:
        return math.inf
    level = one_number("saturation", saturation)
    if level <= 0:
        raise InputError(f"`saturation` must be positive; {level:g} was given")
    return level


def wrapped_angles(rotate: Sequence[float]) -> list[float]:
    """Return the angles in [-180, 180], degrees."""
    given = in_unit("rotate", rotate, "deg")
    angles = [math.remainder(one_number("rotate", angle), 360) for angle in given]
    if not angles:
        raise InputError("`rotate` holds no angle; give one or more")
    return angles
