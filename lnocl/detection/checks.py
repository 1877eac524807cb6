"""Images and PSFs as a caller gives them."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lnocl.core.scene.arrays import Array, booleans, numbers, values_and_mask
from lnocl.core.scene.quantities import bare
from lnocl.errors import InputError

# Values beyond this have no finite variance in float64.
LARGEST = 1e150


def read_image(
    name: str, image: ArrayLike, mask: ArrayLike | None
) -> tuple[Array, NDArray[np.bool_]]:
    """Return a float64 copy with NaN in bad pixels, and a mask, True where a pixel is bad."""
    given, masked = values_and_mask(name, image)
    pixels = numbers(name, given)
    if pixels.ndim != 2 or pixels.size == 0:
        raise InputError(f"{name} has shape {pixels.shape}; give one image, (ny, nx)")
    bad = ~np.isfinite(pixels) | masked
    if mask is not None:
        more = booleans("mask", mask)
        if more.shape != pixels.shape:
            raise InputError(f"`mask` has shape {more.shape}; the {name} has {pixels.shape}")
        bad |= more
    pixels[bad] = np.nan
    if (np.abs(pixels) > LARGEST).any():
        raise InputError(f"{name} holds values beyond {LARGEST:g}; give it in another unit")
    return pixels, bad


def read_psf(psf: ArrayLike) -> Array:
    """Return a PSF of unit sum."""
    light = numbers("psf", bare("psf", psf))
    if light.ndim != 2 or not light.size or not np.isfinite(light).all() or not light.sum() > 0:
        raise InputError(
            f"`psf` of shape {light.shape} must be one image of finite numbers with a positive sum"
        )
    return np.asarray(light / light.sum())
