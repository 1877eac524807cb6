"""The level of the sky beneath the wings of stars, which the median around them takes for sky."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from astropy.stats import mad_std
from scipy.spatial.distance import cdist

from lnocl.core.scene.arrays import Array, Mask
from lnocl.psf.centring import Point

# Wings are those of stars from so many widths on. They are measured in so many parts, of pixels as
# far from the stars, with so many pixels each or more.
FROM, PARTS, FEWEST = 3.0, 24, 16
# The noise is taken for this share of the brightest peak at least.
LEAST = 1e-9
# Of more pixels every second one is looked at, and so on.
MOST = 100_000
# Wings are those of Moffat functions of these radii, in widths, and powers.
RADII, POWERS = (1, 2, 4, 8), (1.0, 1.5, 2.0, 3.0, 6.0)


class Sky(NamedTuple):
    """The sky beneath wings.

    Attributes
    ----------
    level, error : float
        In the unit of the frame.
    nearest : float
        How near the farthest part comes to it: its level above the sky.
    """

    level: float
    error: float
    nearest: float


def distance(shape: tuple[int, ...], stars: list[Point]) -> Array:
    """Return how far each pixel is from the nearest star."""
    y, x = np.ogrid[: shape[0], : shape[1]]
    found = np.full(shape, np.inf)
    for row, column in stars:
        np.minimum(found, np.hypot(y - row, x - column), out=found)
    return found


def fit_sky(
    pixels: Array, bad: Mask, stars: list[Point], peaks: Array, width: float, reach: int
) -> Sky | None:
    """Return the level that wings fall to; None where too few pixels show it.

    Each star has wings in proportion to its peak. Of the functions the one that fits best is taken.

    Parameters
    ----------
    pixels : ndarray of float64, shape (ny, nx)
        The frame.
    bad : ndarray of bool, shape (ny, nx)
        True where a pixel is bad.
    stars : list of tuple of float
        Row and column of each star.
    peaks : ndarray of float64, shape (n,)
        Their peaks.
    width : float
        Their FWHM, pixels.
    reach : int
        Pixels are looked at to so far from the stars.
    """
    nearest = distance(pixels.shape, stars)
    used = np.argwhere(~bad & (nearest >= FROM * width) & (nearest <= reach))
    used = used[:: len(used) // MOST + 1]
    if len(used) < PARTS * FEWEST or not peaks.any():
        return None
    values, distances = pixels[tuple(used.T)], cdist(stars, used) / width
    parts = np.array_split(np.argsort(peaks @ distances**-3.0), PARTS)  # the darkest first
    found = [_clipped(values[part]) for part in parts]
    means = np.array([each.mean() for each in found])
    errors = np.array([each.std() / np.sqrt(each.size) for each in found])
    errors = np.maximum(errors, LEAST * peaks.max())
    best, least = None, np.inf
    for radius in RADII:
        for power in POWERS:
            wings = peaks @ (1.0 + (distances / radius) ** 2) ** -power
            shape = np.array([wings[part].mean() for part in parts])
            design = np.stack([np.ones(PARTS), shape / shape.max()], axis=1) / errors[:, None]
            (level, height), *_ = np.linalg.lstsq(design, means / errors, rcond=None)
            chi2 = float(np.sum((means / errors - design @ (level, height)) ** 2))
            if chi2 < least:
                error = float(np.sqrt(np.linalg.pinv(design.T @ design)[0, 0]))
                best, least = Sky(float(level), error, float(means[0] - level)), chi2
    return best


def _clipped(values: Array) -> Array:
    """Return the values within three standard deviations of their median."""
    return values[abs(values - np.median(values)) <= 3.0 * mad_std(values)]
