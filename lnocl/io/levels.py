"""The sky of an image, measured: its level and its noise.

The sigma-clipped median is 2 standard errors of the mean off on an empty sky, 7 under a jet, and 17
under 40 stars in 128 x 128 pixels; SExtractor's mode, by photutils, is 4, 1 and 9 off. But it is
1.5 means below 0 where most pixels have no count (benchmarks/libraries.py).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lnocl.errors import InputError, note
from lnocl.scene.arrays import Array
from lnocl.scene.noise_check import noise_of

Mask = NDArray[np.bool_]

# Counted electrons of fewer than this a pixel are whole numbers, most of them the same.
FEW = 0.1
# Pixels whose difference is the noise, so far apart that resampling does not correlate them.
LAG = 3


def sky_level(j: int, counts: Array, mask: Mask) -> tuple[float, float]:
    """Return the background of image j and its standard error, both electrons per pixel.

    It is the median of `clipped_sky`, whose error is ``sqrt(pi / 2)`` that of a mean. It is
    negative where too much was subtracted.

    Raises
    ------
    InputError
        No pixel is good.
    """
    median, scatter = clipped_sky(j, counts, mask)
    n_pixels = np.count_nonzero(~mask & np.isfinite(counts))
    error = scatter * np.sqrt(np.pi / 2.0 / n_pixels)
    note(
        f"`images[{j}]`: background {median:.6g} +- {error:.2g} electrons per pixel, scatter "
        f"{scatter:.3g} (sigma-clipped median)"
    )
    if median < 0:
        note("`images[%d]`: its sky was subtracted; %.6g electrons are added again", j, -median)
    return median, float(error)


def sky_noise(j: int, counts: Array, mask: Mask) -> float:
    """Return the noise that the sky of image j has beside that of its counts, electrons.

    It is that of pixels three apart in the darker half of the image, where the clipped scatter is
    more: sources that fill a frame scatter too.

    Raises
    ------
    InputError
        No pixel is good.
    """
    median, scatter = clipped_sky(j, counts, mask)
    dark, words = noise_of(counts, mask | ~np.isfinite(counts), 0.0), "sigma-clipped scatter"
    if dark is not None and dark.variance_apart < scatter**2:
        median, scatter = dark.mean, np.sqrt(dark.variance_apart)
        words = "pixels three apart, where it is dark"
    noise = float(np.sqrt(max(scatter**2 - max(median, 0.0), 0.0)))
    note(f"`images[{j}]`: read noise {noise:.4g} electrons ({words})")
    return noise


def clipped_sky(j: int, counts: Array, mask: Mask) -> tuple[float, float]:
    """Return the sigma-clipped median and scatter of the good pixels of image j.

    Where light fills most of the image they are those of its darker half, by blocks.

    Raises
    ------
    InputError
        No pixel is good.
    """
    from astropy.stats import sigma_clipped_stats

    good = counts[~mask & np.isfinite(counts)]
    if good.size == 0:
        raise InputError(
            f"`images[{j}]` has no good pixel to measure its sky; leave the image out, or give "
            "`background` and `read_noise` as numbers"
        )
    _, median, scatter = sigma_clipped_stats(good)
    dark = noise_of(counts, mask | ~np.isfinite(counts), 0.0)
    if dark is not None and dark.is_darker_than(median, dark.variance_apart):
        return dark.mean, float(np.sqrt(dark.variance_apart))
    return float(median), float(scatter)


def is_rate(image: Array, seconds: float) -> bool:
    """Return whether an image without unit is of electrons per second, by its noise.

    The variance of counts is at least their mean; in rates it is that over the exposure.

    Parameters
    ----------
    image : ndarray of float64, shape (ny, nx)
        Electrons, or electrons per second.
    seconds : float
        The exposure.
    """
    from astropy.stats import sigma_clipped_stats

    good = np.isfinite(image)
    pairs = good[:, LAG:] & good[:, :-LAG]
    if not pairs.any():
        return False
    variance = sigma_clipped_stats((image[:, LAG:] - image[:, :-LAG])[pairs])[2] ** 2 / 2.0
    mean = max(sigma_clipped_stats(image[good])[1], FEW)
    return bool(0 < variance < mean / max(2.0, np.sqrt(seconds)))
