"""Pixels of an image that no source made: cosmic rays, and the flat tops of saturated stars."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lnocl.core.scene.arrays import Array, Mask
from lnocl.core.scene.cores import core
from lnocl.core.scene.remembered import remembered
from lnocl.core.scene.shifting import ENDLESS, MovablePsf
from lnocl.core.scene.transforms import enlarged

# The pairs of pixels on both sides of one: beside it, above and below, and across.
DIRECTIONS = ((0, 1), (1, 0), (1, 1), (1, -1))
# The pixels beside a cosmic ray have less than this share of a star's light there, by so many
# standard deviations.
SHARE, CLEAR = 0.3, 4.0
# The charge of a cosmic ray spreads to those beside it that are above the sky by so many.
SPREAD = 2.0
# A core is what is connected to a PSF's peak above this share of it; light beyond it that may be as
# much as this share of a sharp pixel makes that. So many adjoining bad pixels may hide a source, at
# most so many times as bright as what lies beside them.
CORE, RING, HIDING, HIDDEN = 0.1, 0.5, 5, 1e3
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
    return _sharp(light, noise, bad, shares, are_counts, np.zeros_like)


def _sharp(
    light: Array,
    noise: Array,
    bad: Mask,
    shares: Array,
    are_counts: bool,
    but: Callable[[Mask], Mask],
) -> Mask:
    """Return sharp pixels by the share of light beside them, but those that `but` leaves out."""
    sharp, is_bright = np.zeros(bad.shape, bool), light > SPREAD * noise
    light = light.clip(0.0)  # beside a hole all is sharp
    while True:
        is_known = ~(bad | sharp) & np.isfinite(noise)
        variance = np.where(is_known, noise, 0.0) ** 2 + (light if are_counts else 0.0)
        # Of others not even dark neighbours would tell.
        at = np.nonzero(is_known & (light > CLEAR * np.sqrt(variance)))
        of_light, of_variance, of_known = (np.pad(each, 1) for each in (light, variance, is_known))
        inside = np.add(at, 1)
        is_sharp = np.zeros(len(at[0]), bool)
        for direction, share in zip(DIRECTIONS, shares, strict=True):
            pair, expected = _pair(of_light, inside, direction), share * light[at]
            pair_variance = _pair(of_variance, inside, direction)
            error = np.sqrt(pair_variance + share**2 * variance[at])
            are_known = _pair(of_known.astype(np.int8), inside, direction) == 2
            is_sharp |= are_known & (pair < SHARE * expected) & (expected - pair > CLEAR * error)
        new = np.zeros(bad.shape, bool)
        new[at] = is_sharp
        new &= ~but(new)
        if not new.any():
            return sharp
        sharp |= new | (ndimage.binary_dilation(new, np.ones((3, 3))) & is_bright)


def cosmic_rays(light: Array, noise: Array, bad: Mask, psfs: Sequence[Array]) -> Mask:
    """Return where an image is sharper than its PSF, as `sharp_pixels`, and is no ring of a star.

    A pixel is left out where something brighter, farther from it than the core of a PSF, may shed
    half its light there. A large group of bad pixels is taken to hide a star that the brightest
    pixel beside it is the wing of. The PSFs may be narrower than those given, by about 0.7, as the
    squares of the shares are.

    Parameters
    ----------
    light, noise, bad, psfs
        As for `sharp_pixels`; PSFs are of one shape. The image may be of whole counts.
    """
    holes, _ = ndimage.label(bad, np.ones((3, 3)))
    n_pixels = np.bincount(holes.ravel())
    hiding = 1 + np.flatnonzero(n_pixels[1:] >= HIDING)
    beside = ndimage.maximum_filter(holes, 3)  # of each hole, and the pixels beside it
    rises = [_rise(psfs, math.sqrt(n / math.pi)) for n in n_pixels[hiding]]
    lobes = np.max([_lobes(psf, max(light.shape)) for psf in psfs], axis=0)
    half = lobes.shape[0] // 2

    def is_shed(new: Mask) -> Mask:
        """Return which of new sharp pixels may be light of something brighter."""
        sources = np.where(new | bad, 0.0, light.clip(0.0))
        for k, rise in zip(hiding, rises, strict=True):
            sources[holes == k] = rise * sources[beside == k].max()
        padded, shed = np.pad(sources, half), np.zeros(bad.shape, bool)
        for y, x in np.argwhere(new):
            there = padded[y : y + 2 * half + 1, x : x + 2 * half + 1]
            shed[y, x] = (there * lobes).max() > RING * light[y, x]
        return shed

    shares = np.min([_least_shares(psf) for psf in psfs], axis=0) ** 2 / 2.0
    return _sharp(light, noise, bad, shares, True, is_shed)


def _rise(psfs: Sequence[Array], radius: float) -> float:
    """Return how many times as bright as light at a radius a star may be in its middle."""
    least = 1.0
    for psf in psfs:
        y, x = np.indices(psf.shape) - np.reshape(np.array(psf.shape) // 2, (2, 1, 1))
        least = min(least, float(psf[np.hypot(y, x) <= radius + 1.0].min() / psf.max()))
    return 1.0 / max(least, 1.0 / HIDDEN)


def _lobes(psf: Array, most: int) -> Array:
    """Return the light of a PSF beyond its core over its peak, as sources see it that shed it.

    Shape (n, n), at most `most` pixels to each side; each value is the largest of the next pixels.
    """
    side, shown = 2 * max(psf.shape) + 3, 2 * min(max(psf.shape) // 2 + 1, most) + 1
    whole = enlarged(psf / psf.max(), (side, side), is_centred=True)
    of_core = ndimage.binary_dilation(core(whole, CORE), np.ones((3, 3)))
    beyond = ndimage.maximum_filter(np.where(of_core, 0.0, whole), 3)[::-1, ::-1]
    return enlarged(beyond, (shown, shown), is_centred=True)


def _pair(padded: NDArray[Any], at: NDArray[Any], direction: tuple[int, int]) -> NDArray[Any]:
    """Return the sums of the two pixels on both sides of some along a direction."""
    (y, x), (dy, dx) = at, direction
    return np.asarray(padded[y + dy, x + dx] + padded[y - dy, x - dx])


@remembered(2**17)  # each star asks for that of its PSF
def _least_shares(psf: Array) -> Array:
    """Return the least share of its brightest pixel that a star has beside it, by direction."""
    movable, shares, at = MovablePsf(psf, ENDLESS), [], np.ones((2, 1), int)
    for y, x in product(PLACES, PLACES):
        star = movable.at(x, y).add_to(np.zeros((3, 3)), (-1, -1), ENDLESS)
        shares.append([_pair(star, at, each)[0] / star[1, 1] for each in DIRECTIONS])
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
