"""How far the pixels of a PSF made of stars may be off: their noise, and how stars differ."""

from __future__ import annotations

import numpy as np
from astropy.stats import sigma_clipped_stats
from numpy.typing import NDArray
from scipy.ndimage import convolve, gaussian_filter, maximum_filter

from lnocl.core.scene.arrays import Array, Mask
from lnocl.core.scene.noise_check import noise_of
from lnocl.core.scene.psfs import MOST_PSF_ERROR, PSF_ERROR
from lnocl.psf.centring import Pixel
from lnocl.psf.steps import cut_square

# Fourth differences along rows and columns leave noise, and next to nothing of a sampled star.
FOURTH = np.array([1.0, -4.0, 6.0, -4.0, 1.0])
DIFFERENCES = FOURTH[:, None] * FOURTH
# Rounds in which variances are found. Of more pixels every second one is looked at, and so on.
ROUNDS, MOST = 200, 100_000
# Interpolation is right to this share of a peak, which is the noise at least.
LEAST = 1e-6
# Stars differ in proportion to the PSF smoothed over so many pixels, as widths beside the peak do.
SMOOTHED = 1.0
# Noise that neighbours share has up to so many times the variance that they show.
SHARED = 10.0
# Where no star shows a pixel, it is known to this share of the light there and opposite.
GUESSED = 0.2


def of_one(light: Array, bad: Mask, pixel: Pixel, half: int) -> Array:
    r"""Return the scatter of the square round a star, shape (2 half + 1, 2 half + 1).

    Its square is ``a + b S`` with the light S: a is the variance of the darker half of the frame,
    and b is told by what fourth differences leave of the star. No gain is asked for. Of how stars
    differ one star tells nothing; the ``psf_error`` of an observation stands for that.

    Parameters
    ----------
    light : ndarray of float64, shape (ny, nx)
        The frame above its background.
    bad : ndarray of bool, shape (ny, nx)
        True where a pixel is a guess.
    pixel : tuple of int
        Row and column of the star.
    half : int
        Pixels from the middle of the square to its edge.
    """
    square, guessed = cut_square(light, pixel, half), cut_square(bad, pixel, half)
    kernel = DIFFERENCES**2 / (DIFFERENCES**2).sum()
    squares = convolve(square, DIFFERENCES, mode="nearest") ** 2 / (DIFFERENCES**2).sum()
    near = convolve(square, kernel, mode="nearest").clip(0.0)
    good = ~maximum_filter(guessed, 5)
    good[[0, 1, -2, -1]] = good[:, [0, 1, -2, -1]] = False
    design = np.array([np.ones_like(near), near])[:, good]
    found = _variances(squares[good], design, square.max())
    sky, of_light = _raised(found, light, bad)
    variance = sky + of_light * square.clip(0.0)
    return np.sqrt(variance + np.where(guessed, _guess(square), 0.0) ** 2)


def of_several(
    apart: Array, shown: Array, fluxes: Array, psf: Array, light: Array, bad: Mask
) -> Array:
    r"""Return the scatter of a PSF that is the mean of several stars, of its shape.

    Star s with the flux c differs from the PSF K of all by noise and by itself:

    .. math:: a / c_s^2 + b K / c_s + d \bar K^2

    with K smoothed as :math:`\bar K`. The three are the ones above 0 that make the squares of all
    pixels of all stars likeliest. The noise of the mean is that of all stars together. The star
    that the PSF is used for differs as these do, and few stars tell little of it: d is larger by
    (n + 1) / (n - 1).

    Parameters
    ----------
    apart : ndarray of float64, shape (n, k, k)
        How each star, over its flux, differs from the PSF.
    shown : ndarray of float64, shape (n, k, k)
        1 where a star shows the PSF, else 0.
    fluxes : ndarray of float64, shape (n,)
        Of the stars.
    psf : ndarray of float64, shape (k, k)
        The PSF.
    light, bad : ndarray, shape (ny, nx)
        The frame above its background, and where it is bad.
    """
    n, c, positive = len(fluxes), fluxes[:, None, None], psf.clip(0.0)
    wide = gaussian_filter(positive, SMOOTHED)
    weight = (c * shown).sum(axis=0)
    share = np.divide(c * shown, weight, out=np.zeros_like(apart), where=weight > 0)
    forms = [(1.0 / c**2, np.ones_like(psf)), (1.0 / c, positive), (np.ones_like(c), wide**2)]
    of_mean = [(share**2 * noise).sum(axis=0) * form for noise, form in forms]
    used = (shown > 0) & ((shown > 0).sum(axis=0) > 1)
    design = [
        ((1.0 - 2.0 * share) * noise * form + mean)[used]
        for (noise, form), mean in zip(forms, of_mean, strict=True)
    ]
    found = _variances(apart[used] ** 2, np.array(design), psf.max())
    found = _raised(found, light, bad)
    found[2] *= (n + 1) / (n - 1)
    variance = np.tensordot(found, of_mean, axes=1) + found[2] * wide**2
    least = found[0] / fluxes.max() ** 2
    return np.sqrt(np.where(weight > 0, variance, least + _guess(psf) ** 2))


def width_error(apart: Array, shown: Array, fluxes: Array, psf: Array, used: Mask) -> float:
    r"""Return the error of the width of a PSF that is the mean of several stars, relative to it.

    Star s is as wide as ``1 + a_s``, by least squares of its flux and a stretch of the PSF. Another
    star differs as these do, and few of them tell little of it: with their shares w of the light

    .. math:: e^2 = e_0^2 \sum_s w_s^2 + \sum_s w_s (a_s - \bar a)^2

    with the error e_0 of a PSF that nothing is known of, as of one star. Noise is part of it. Stars
    whose cores are hidden tell nothing.

    Parameters
    ----------
    apart, shown, fluxes, psf : ndarray of float64
        As of `of_several`.
    used : ndarray of bool, shape (k, k)
        The core, in which stars are fitted.
    """
    y, x = (np.arange(n) - n // 2 for n in psf.shape)
    down, along = np.gradient(psf)
    stretch = -(x * along + y[:, None] * down) - 2.0 * psf
    weights, widths = fluxes / fluxes.sum(), np.zeros(len(fluxes))
    for s, (left, seen) in enumerate(zip(apart, shown, strict=True)):
        there = used & (seen > 0)
        design = np.array([psf[there], stretch[there]]).T
        if len(design) > 2:
            widths[s] = np.linalg.lstsq(design, left[there], rcond=None)[0][1]
    variance = float(weights @ (widths - weights @ widths) ** 2)
    return min(float(np.sqrt(PSF_ERROR**2 * weights @ weights + variance)), MOST_PSF_ERROR)


def _variances(squares: Array, design: Array, peak: float) -> Array:
    """Return the amounts of the rows of a design that make squares of Gaussian noise likeliest.

    Noise is `LEAST` of the peak at least.

    References
    ----------
    C. Fevotte, N. Bertin, J.-L. Durrieu, Neural Computation 21, 793 (2009), for the update, which
    keeps amounts above 0.
    """
    every = squares.size // MOST + 1
    squares, design = squares[::every], design[:, ::every]
    sums, mean = design.sum(axis=1), float(squares.mean()) if squares.size else 0.0
    if not (mean > 0 and (sums > 0).all()):
        return np.zeros(len(design))
    design, squares = design / sums[:, None], squares / mean
    found, least = np.full(len(design), squares.size / len(design)), (LEAST * peak) ** 2 / mean
    for _ in range(ROUNDS):
        variance = np.maximum(found @ design, least)
        found *= np.sqrt((design @ (squares / variance**2)) / (design @ (1.0 / variance)))
    return np.asarray(mean * found / sums)


def _raised(found: Array, light: Array, bad: Mask) -> Array:
    """Return variances a and b, and others, with a as large as where a frame is darkest.

    Neighbours that share their noise, and stars that were moved by interpolation, show less of it.
    """
    noise = noise_of(light, bad, 0.0)
    dark = float(sigma_clipped_stats(light[~bad])[2]) ** 2
    if noise is not None:
        dark = max(noise.variance, noise.variance_apart)
    raised = found.copy()
    if found[0] > 0:
        raised[:2] *= np.clip(dark / found[0], 1.0, SHARED)
    raised[0] = max(found[0], dark)
    return raised


def _guess(light: Array) -> NDArray[np.float64]:
    """Return the scatter of pixels that no star shows."""
    return GUESSED * np.maximum(light, light[::-1, ::-1]).clip(0.0)
