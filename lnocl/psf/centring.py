"""Where a star is in a frame: its brightest pixel, and the centre of its light."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, median_filter

from lnocl.errors import InputError

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
# Places in an image, row before column.
Pixel = tuple[int, int]
Point = tuple[float, float]

# Pixels that the centre may lie away from where the star was said or seen to be.
SEARCH = 16
# The narrowest and the widest Gaussian fitted, pixels and share of what it is fitted in.
MIN_SIGMA, MAX_SIGMA = 0.8, 1 / 3
MAX_ITERATIONS = 500
FWHM = 2 * math.sqrt(2 * math.log(2))


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
    seen = np.isfinite(windows).any(axis=1)
    smooth[y, x] = -np.inf
    smooth[y[seen], x[seen]] = np.nanmedian(windows[seen], axis=1) if seen.any() else 0.0
    iy, ix = np.unravel_index(int(smooth.argmax()), smooth.shape)
    return int(iy), int(ix)


def fit_gaussian(light: Array, start: Pixel, level: float) -> tuple[Point, float]:
    """Return centre and sigma of the circular Gaussian that fits best by least squares.

    The moments of the light weighted with the Gaussian are those that the Gaussian itself has
    under this weight: its centre, and half its variance.

    Parameters
    ----------
    light : ndarray of float64, shape (ny, nx)
        The star above its background.
    start : tuple of int
        Row and column of a pixel within `SEARCH` pixels of the centre.
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
        Where nothing is above the background, or the fit leaves the square searched.
    """
    around = tuple(slice(max(i - SEARCH, 0), i + SEARCH + 1) for i in start)
    peak = light[around].max()
    if peak <= 0:
        raise InputError(
            f"nothing within {SEARCH} pixels of the star is above the background {level:g}; "
            "give another position or a lower background"
        )
    widest = max(light.shape) * MAX_SIGMA
    area = int((light[around] >= peak / 2).sum())
    sigma = min(max(math.sqrt(area / (2 * math.pi * math.log(2))), MIN_SIGMA), widest)
    y, x = map(float, start)
    for _ in range(MAX_ITERATIONS):
        rows, columns = (_weighted(n, at, sigma) for n, at in zip(light.shape, (y, x), strict=True))
        moments = rows @ light @ columns.T
        if moments[0, 0] <= 0:
            break
        dy, dx = 2 * moments[1, 0] / moments[0, 0], 2 * moments[0, 1] / moments[0, 0]
        y, x = y + dy, x + dx
        if not max(abs(y - start[0]), abs(x - start[1])) <= SEARCH:
            break
        variance = (moments[2, 0] + moments[0, 2]) / (2 * moments[0, 0])
        ratio = variance / sigma**2
        # The new variance is 1 / (1 / variance - 1 / sigma^2), grown by 4 at most.
        ratio = ratio / (1 - ratio) if 0 < ratio < 0.8 else 4.0 if ratio > 0 else 0.25
        new = min(max(sigma * math.sqrt(ratio), MIN_SIGMA), widest)
        if max(abs(dy), abs(dx), abs(new - sigma)) < 1e-9:
            return (y, x), new
        sigma = new
    raise InputError(
        f"no star is found within {SEARCH} pixels of where it should be; give its position, or "
        "another background"
    )


def _weighted(n: int, at: float, sigma: float) -> Array:
    """Return the Gaussian times 1, d and d^2 for the distances d along an axis."""
    d = np.arange(n) - at
    return np.exp(-0.5 * (d / sigma) ** 2) * np.array([np.ones(n), d, d * d])
