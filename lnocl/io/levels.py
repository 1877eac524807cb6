"""The sky of an image, measured: its level and its noise.

The level is SExtractor's mode, ``2.5 median - 1.5 mean`` of values that are clipped, but of the
means of blocks: their noise is less, so that fainter light is clipped, and few counts are many. In
200 frames with stars, galaxies and gradients, 0.03 to 600 electrons a pixel, it is 4 standard
errors of a mean off where the mode of the pixels is 25 and their median 23
(docs/validation/levels.md).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lnocl.core.scene.arrays import Array, Mask
from lnocl.core.scene.noise_check import noise_of
from lnocl.errors import InputError, detail, note

# Counted electrons of fewer than this a pixel are whole numbers, most of them the same.
FEW = 0.1
# Pixels whose difference is the noise, so far apart that resampling does not correlate them.
LAG = 3
# Sides of blocks whose mode is the level: the first of which there are so many.
SIZES, MIN_BLOCKS = (8, 4, 2, 1), 16
# The mean is so many standard deviations from the median at most where the mode is told from both.
SKEW = 0.3
# Standard error of the mode of Gaussian noise, in those of a mean.
MODE_NOISE = 2.14


def sky_level(j: int, counts: Array, mask: Mask) -> tuple[float, float]:
    """Return the background of image j and its standard error, both electrons per pixel.

    It is the mode of blocks, or the level of the darker half where light fills most of the image.
    The error holds what faint sources are taken to add: the change from smaller blocks. The level
    is negative where too much was subtracted.

    Raises
    ------
    InputError
        No pixel is good.
    """
    bad = mask | ~np.isfinite(counts)
    _refuse_bad(j, bad)
    size = next((size for size in SIZES if _n_blocks(bad, size) >= MIN_BLOCKS), SIZES[-1])
    level, scatter = mode(block_means(counts, bad, size))
    noise = MODE_NOISE * scatter / np.sqrt(_n_blocks(bad, size))
    error = np.hypot(noise, level - mode(block_means(counts, bad, max(size // 2, 1)))[0])
    words = f"mode of {size} x {size} pixels" if size > 1 else "mode of the pixels"
    dark = noise_of(counts, bad, 0.0)
    if dark is not None and dark.is_darker_than(level, dark.variance_apart):
        level, error = dark.mean, np.hypot(error, level - dark.mean)
        words = "where it is dark"
    detail(f"`images[{j}]`: background {level:.6g} +- {error:.2g} electrons per pixel ({words})")
    if level < 0:
        note("`images[%d]`: its sky was subtracted; %.6g electrons are added again", j, -level)
    return float(level), float(error)


def mode(values: Array) -> tuple[float, float]:
    """Return the mode of values, ``2.5 median - 1.5 mean`` of those within 3 sigma, and sigma.

    It is their median where the mean is far from that.
    """
    from astropy.stats import sigma_clipped_stats

    mean, median, scatter = map(float, sigma_clipped_stats(values))
    is_skew = abs(mean - median) > SKEW * scatter
    return (median if is_skew else 2.5 * median - 1.5 * mean), scatter


def block_means(counts: Array, bad: Mask, size: int) -> Array:
    """Return the means of square blocks of pixels of which more than half are good."""
    good = _sums(~bad, size)
    sums = _sums(np.where(bad, 0.0, counts), size)
    return np.asarray((sums / np.maximum(good, 1))[2 * good > size**2])


def _n_blocks(bad: Mask, size: int) -> int:
    return int(np.count_nonzero(2 * _sums(~bad, size) > size**2))


def _sums(pixels: NDArray, size: int) -> Array:
    """Return the sums of square blocks; what does not fill one is left out."""
    ny, nx = (n // size for n in pixels.shape)
    whole = pixels[: ny * size, : nx * size].reshape(ny, size, nx, size)
    return np.asarray(whole.sum(axis=(1, 3), dtype=np.float64))


def _refuse_bad(j: int, bad: Mask) -> None:
    if bad.all():
        raise InputError(
            f"`images[{j}]` has no good pixel to measure its sky; leave the image out, or give "
            "`background` and `read_noise` as numbers"
        )


def sky_noise(j: int, counts: Array, mask: Mask) -> float:
    """Return the sky's noise in excess of Poisson noise in image j, electrons.

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
    detail(f"`images[{j}]`: read noise {noise:.4g} electrons ({words})")
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

    bad = mask | ~np.isfinite(counts)
    _refuse_bad(j, bad)
    _, median, scatter = sigma_clipped_stats(counts[~bad])
    dark = noise_of(counts, bad, 0.0)
    if dark is not None and dark.is_darker_than(median, dark.variance_apart):
        return dark.mean, float(np.sqrt(dark.variance_apart))
    return float(median), float(scatter)


def is_rate(image: Array, exposure: Array | float) -> bool:
    """Return whether an image without unit is of electrons per second, by its noise.

    The variance of counts is at least their mean; in rates it is that over the exposure.

    Parameters
    ----------
    image : ndarray of float64, shape (ny, nx)
        Electrons, or electrons per second.
    exposure : float or ndarray of float64, shape (ny, nx)
        Seconds; pixels without are left out.
    """
    from astropy.stats import sigma_clipped_stats

    seconds = np.broadcast_to(exposure, image.shape)
    good = np.isfinite(image) & (seconds > 0)
    pairs = good[:, LAG:] & good[:, :-LAG]
    if not pairs.any():
        return False
    variance = sigma_clipped_stats((image[:, LAG:] - image[:, :-LAG])[pairs])[2] ** 2 / 2.0
    mean = max(sigma_clipped_stats(image[good])[1], FEW)
    return bool(0 < variance < mean / max(2.0, np.sqrt(seconds[good].mean())))
