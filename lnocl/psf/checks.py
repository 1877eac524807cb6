"""Checks of the arguments that a PSF is made from."""

from __future__ import annotations

import math
import operator

import numpy as np
from numpy.typing import ArrayLike

from lnocl.errors import InputError
from lnocl.psf.centring import Array, Mask
from lnocl.scene.observation import numbers, unmasked, values_and_mask

MIN_SIZE = 3
# Values beyond this have no finite variance in float64.
LARGEST = 1e150


def _read(frame: ArrayLike, mask: ArrayLike | None) -> tuple[Array, Mask]:
    """Return a float64 copy with NaN where it is bad, and where that is."""
    given, masked = values_and_mask("frame", frame)
    pixels = numbers("frame", given)
    if pixels.ndim != 2 or pixels.size == 0:
        raise InputError(f"frame has shape {pixels.shape}; give one image, (ny, nx)")
    bad = ~np.isfinite(pixels) | masked
    if mask is not None:
        more = unmasked("mask", mask)
        if more.dtype != np.bool_:
            raise InputError(
                f"mask is of type {more.dtype}; give booleans, True where a pixel is bad"
            )
        if more.shape != pixels.shape:
            raise InputError(f"mask has shape {more.shape}; the frame has {pixels.shape}")
        bad |= more
    pixels[bad] = np.nan
    if (np.abs(pixels) > LARGEST).any():
        raise InputError(f"frame holds values beyond {LARGEST:g}; give it in another unit")
    return pixels, bad


def _one_number(name: str, value: object) -> float:
    array = numbers(name, value)  # type: ignore[arg-type]
    if array.ndim or not np.isfinite(array):
        raise InputError(f"{name} is {value!r}; give one finite number")
    return float(array)


def _saturation(saturation: float | None) -> float:
    if saturation is None:
        return math.inf
    level = _one_number("saturation", saturation)
    if level <= 0:
        raise InputError(f"saturation must be positive; {level:g} was given")
    return level


def _size(size: int | None) -> int | None:
    if size is None:
        return None
    try:
        side = operator.index(size)
    except TypeError:
        side = 0
    if side < MIN_SIZE or isinstance(size, bool | np.bool_):
        raise InputError(f"size must be a whole number of {MIN_SIZE} or more; {size!r} was given")
    return side


def _angle(rotate: float) -> float:
    """Return the angle in [-180, 180], degrees."""
    return math.remainder(_one_number("rotate", rotate), 360)
