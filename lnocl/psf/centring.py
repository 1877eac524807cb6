"""Where a star is in a frame: its brightest pixel, and the centre of its light.

photutils' `centroid_2dg` finds centres as well, to 0.007 pixels in noise of a hundredth of the
peak, but is no dependency; its other centroids are 1.5 to 80 times worse (benchmarks/libraries.py).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy import optimize
from scipy.ndimage import maximum_filter, median_filter

from lnocl.core.scene.arrays import Array, Mask
from lnocl.errors import InputError

# Places in an image, row before column.
Pixel = tuple[int, int]
Point = tuple[float, float]

# Pixels that the centre may lie away from the star's position.
SEARCH = 16
# Pixels around the position among which the fit starts at the brightest one.
NEAR = 5
# The narrowest Gaussian that is fitted, pixels.
MIN_SIGMA = 0.3
# Pixels, and sigmas of the star, that the fitted square reaches from its middle.
MARGIN, WIDTHS = 4, 5
# By how much a star lowers chi squared at least; the best Gaussian in noise lowers it by 10 to 30.
MIN_IMPROVEMENT = 50
# Good pixels that a Gaussian of four parameters and a constant are fitted to, at least.
MIN_PIXELS = 9


def brightest(pixels: Array, bad: Mask) -> Pixel:
    """Return the brightest pixel after a median filter of 3 x 3 good pixels.

    Parameters
    ----------
    pixels : ndarray of float64, shape (ny, nx)
        The frame, finite where it is bad too.
    bad : ndarray of bool, shape (ny, nx)
        True where a pixel counts for nothing.

    Returns
    -------
    tuple of int
        Row and column.
    """
    smooth = median_filter(pixels, 3)
    around = np.pad(np.where(bad, np.nan, pixels), 1, constant_values=np.nan)
    y, x = np.nonzero(maximum_filter(bad, 3))
    windows = np.stack([around[y + i, x + j] for i in range(3) for j in range(3)], axis=1)
    has_good = np.isfinite(windows).any(axis=1)
    smooth[y, x] = -np.inf
    if has_good.any():
        smooth[y[has_good], x[has_good]] = np.nanmedian(windows[has_good], axis=1)
    iy, ix = np.unravel_index(int(smooth.argmax()), smooth.shape)
    return int(iy), int(ix)


def fit_gaussian(light: Array, bad: Mask, start: Pixel, level: float) -> tuple[Point, float]:
    """Return centre and sigma of the circular Gaussian and constant that fit the star best.

    Parameters
    ----------
    light : ndarray of float64, shape (ny, nx)
        The star above its background, interpolated where it is bad.
    bad : ndarray of bool, shape (ny, nx)
        True where a pixel is left out of the fit.
    start : tuple of int
        Row and column of the star's position, to `NEAR` pixels.
    level : float
        The background that was subtracted, for the messages.

    Returns
    -------
    centre : tuple of float
        Row and column.
    sigma : float
        Pixels.

    Raises
    ------
    InputError
        Where nothing is above the background, or no star is within `SEARCH` pixels of the start.
    """
    around = _square(start, SEARCH)
    peak = light[around].max()
    if peak <= 0:
        raise InputError(
            f"nothing within {SEARCH} pixels of the star is above the background {level:g}; "
            "give another position or a lower background"
        )
    near = _square(start, NEAR)
    row, column = brightest(light[near], np.zeros_like(bad[near]))
    first = near[0].start + row, near[1].start + column
    area = int((light[near] >= light[first] / 2).sum())
    sigma = math.sqrt(area / (2 * math.pi * math.log(2)))
    square = _square(first, MARGIN + math.ceil(WIDTHS * sigma))
    good = np.zeros_like(bad)
    good[square] = ~bad[square]
    y, x = np.nonzero(good)
    found = _fit(y, x, light[good] / peak, first, sigma)
    if found is None or max(abs(found[0] - start[0]), abs(found[1] - start[1])) > SEARCH:
        raise InputError(
            f"no star is found within {SEARCH} pixels of ({start[1]}, {start[0]}); give its "
            "position, or another background"
        )
    # Digits beyond these are rounding of the slopes: a centred star stays where it is.
    return (round(found[0], 6), round(found[1], 6)), found[2]


def _square(pixel: Pixel, half: int) -> tuple[slice, slice]:
    y, x = (slice(max(i - half, 0), i + half + 1) for i in pixel)
    return y, x


def _fit(
    y: NDArray[np.int_], x: NDArray[np.int_], light: Array, first: Pixel, sigma: float
) -> tuple[float, float, float] | None:
    """Return row, column and sigma of the best Gaussian; None where noise would fit as well."""
    if len(light) < MIN_PIXELS:
        return None

    def residuals(parameters: Array) -> Array:
        height, row, column, sigma, constant = parameters
        square = ((y - row) ** 2 + (x - column) ** 2) / max(sigma, MIN_SIGMA) ** 2
        return np.asarray(height * np.exp(-square / 2) + constant - light)

    start = np.array([light.max(), *first, sigma, 0.0])
    with np.errstate(all="ignore"):
        fitted = optimize.least_squares(residuals, start, method="lm", xtol=1e-7)
        left = float(np.var(fitted.fun))
    height, row, column, sigma, _ = map(float, fitted.x)
    improvement = len(light) * (float(np.var(light)) - left)
    if not (height > 0 and improvement > MIN_IMPROVEMENT * left):
        return None
    return row, column, max(sigma, MIN_SIGMA)
