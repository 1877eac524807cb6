"""Pixels of an image that no source made: cosmic rays, and the flat tops of saturated stars."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np
from scipy import ndimage

from lnocl.core.scene.arrays import Array, Mask
from lnocl.core.scene.shifting import ENDLESS, MovablePsf

# The pairs of pixels on both sides of one: beside it, above and below, and across.
DIRECTIONS = ((0, 1), (1, 0), (1, 1), (1, -1))
# The pixels beside a cosmic ray have less than this share of a star's light there, by so many
# standard deviations.
SHARE, CLEAR = 0.3, 4.0
# The charge of a cosmic ray spreads to those beside it that are above the sky by so many.
SPREAD = 2.0
# Where in its pixel a star may lie, along each axis.
PLACES = (-0.5, -0.25, 0.0, 0.25, 0.5)
# So many adjoining pixels, or so many in all with the largest value of the frame, are a flat top,
# if they are above the sky by so many standard deviations, and have so many steps of the values.
ADJOINING, REPEATED, ABOVE, STEPS = 4, 3, 10.0, 50
# And if as many times more pixels have that value as those of the last tenth below it would give.
PILED = 4.0


def sharp_pixels(
    light: Array, noise: Array, bad: Mask, psfs: Sequence[Array], are_counts: bool = False
) -> Mask:
    r"""Return where an image is sharper than its PSF: cosmic rays and hot pixels.

    Light that comes through the PSF P has, on both sides of a pixel n along a direction d, at least
    the share that a star at the worst place s in its pixel has,

    .. math:: \rho_d = \min_s \frac{P_{n + d - s} + P_{n - d - s}}{P_{n - s}}

    A pixel is sharp where the light is less than 0.3 of that along one of four directions, by four
    standard deviations. Sharp pixels are taken out, and those beside them are looked at again.

    Parameters
    ----------
    light, noise : ndarray of float64, shape (ny, nx)
        Light above the sky and its standard deviation, infinite where it is not known.
    bad : ndarray of bool, shape (ny, nx)
        Of these pixels, and of those beside them along a direction, nothing is said.
    psfs : sequence of ndarray of float64, shape (ky, kx)
        One, or several of which the sharpest counts in each direction; their peaks are at (ky // 2,
        kx // 2).
    are_counts : bool, optional
        Whether the image is of whole counts, each of which may be a photon.
    """
    shares = np.min([_least_shares(psf) for psf in psfs], axis=0)
    sharp, is_bright = np.zeros(bad.shape, bool), light > SPREAD * noise
    light = light.clip(0.0)  # beside a hole all is sharp
    while True:
        is_known = ~(bad | sharp) & np.isfinite(noise)
        variance = np.where(is_known, noise, 0.0) ** 2 + (light if are_counts else 0.0)
        new = np.zeros(bad.shape, bool)
        for direction, share in zip(DIRECTIONS, shares, strict=True):
            pair, expected = _beside(light, direction), share * light
            error = np.sqrt(_beside(variance, direction) + share**2 * variance)
            are_known = is_known & (_beside(is_known.astype(float), direction) == 2)
            new |= are_known & (pair < SHARE * expected) & (expected - pair > CLEAR * error)
        if not new.any():
            return sharp
        sharp |= new | (ndimage.binary_dilation(new, np.ones((3, 3))) & is_bright)


def _beside(values: Array, direction: tuple[int, int]) -> Array:
    """Return the sum of the two pixels on both sides of each along a direction."""
    (ny, nx), (dy, dx) = values.shape, direction
    padded = np.pad(values, 1)
    after = padded[1 + dy : 1 + dy + ny, 1 + dx : 1 + dx + nx]
    return np.asarray(after + padded[1 - dy : 1 - dy + ny, 1 - dx : 1 - dx + nx])


def _least_shares(psf: Array) -> Array:
    """Return the least share of its brightest pixel that a star has beside it, by direction."""
    movable, shares = MovablePsf(psf, ENDLESS), []
    for y, x in product(PLACES, PLACES):
        star = movable.at(x, y).add_to(np.zeros((3, 3)), (-1, -1), ENDLESS)
        shares.append([_beside(star, each)[1, 1] / star[1, 1] for each in DIRECTIONS])
    return np.min(shares, axis=0).clip(0.0)


def flat_tops(pixels: Array, significance: Array, bad: Mask) -> Mask:
    """Return where an image is flat at its top, as saturated stars are.

    These are four or more adjoining pixels of one value that none beside them exceeds, and three or
    more anywhere with the largest value of the image, where more of them have it than counts have
    by chance.

    Parameters
    ----------
    pixels : ndarray of float64, shape (ny, nx)
        As the image has them.
    significance : ndarray of float64, shape (ny, nx)
        Their light above the sky over its noise.
    bad : ndarray of bool, shape (ny, nx)
        Which pixels are bad.
    """
    values = np.where(bad, -np.inf, pixels)
    good = values[~bad]
    step = 1.0 if (good == np.round(good)).all() else 0.0
    top = (values == ndimage.maximum_filter(values, 3)) & ~bad & (significance > ABOVE)
    top &= values - np.median(good) >= STEPS * step
    labels, n = ndimage.label(top, np.ones((3, 3)))
    is_large = np.bincount(labels.ravel(), minlength=n + 1) >= ADJOINING
    is_large[0] = False
    flat = is_large[labels]
    largest = values.max()
    at_most = top & (values == largest)
    tenth = 0.1 * (largest - np.median(good))
    n_below = np.count_nonzero((good >= largest - tenth) & (good < largest))
    by_chance = PILED * (n_below + 1) * step / tenth if tenth > 0 else np.inf
    if np.count_nonzero(at_most) >= max(REPEATED, by_chance):
        flat |= at_most
    return flat
