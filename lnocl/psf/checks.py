"""Checks of the arguments that a PSF is made from."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from lnocl.errors import InputError
from lnocl.psf.centring import Mask
from lnocl.scene.arrays import Array, booleans, numbers, values_and_mask, whole
from lnocl.scene.quantities import in_unit

MIN_SIZE = 3
# Values beyond this have no finite variance in float64.
LARGEST = 1e150


def read_frame(frame: ArrayLike, mask: ArrayLike | None) -> tuple[Array, Mask]:
    """Return a float64 copy with NaN in bad pixels, and a mask, True where a pixel is bad."""
    given, masked = values_and_mask("frame", frame)
    pixels = numbers("frame", given)
    if pixels.ndim != 2 or pixels.size == 0:
        raise InputError(f"frame has shape {pixels.shape}; give one image, (ny, nx)")
    bad = ~np.isfinite(pixels) | masked
    if mask is not None:
        more = booleans("mask", mask)
        if more.shape != pixels.shape:
            raise InputError(f"`mask` has shape {more.shape}; the frame has {pixels.shape}")
        bad |= more
    pixels[bad] = np.nan
    if (np.abs(pixels) > LARGEST).any():
        raise InputError(f"frame holds values beyond {LARGEST:g}; give it in another unit")
    return pixels, bad


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


def whole_size(size: int | None) -> int | None:
    """Return the side of the PSF, pixels; None where the largest is to be taken."""
    return None if size is None else whole("size", size, MIN_SIZE)


def wrapped_angles(rotate: Sequence[float]) -> list[float]:
    """Return the angles in [-180, 180], degrees."""
    given = in_unit("rotate", rotate, "deg")
    angles = [math.remainder(one_number("rotate", angle), 360) for angle in given]
    if not angles:
        raise InputError("`rotate` holds no angle; give one or more")
    return angles
