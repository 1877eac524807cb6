"""Wings of PSFs in which noise exceeds the light, as those of the image of a star."""

from __future__ import annotations

import numpy as np

from lnocl.core.scene.arrays import Array
from lnocl.core.scene.rings import Rings

# The noise is that of pixels beyond this share of the way to the nearest edge.
FAR = 0.9
# Rings of fewer pixels do not tell noise from structure.
FEWEST = 6
# Wings are noisy where negative pixels have this share of the light.
NOISY = 1e-3


def are_noisy(psfs: Array) -> bool:
    """Return whether the negative pixels of a PSF have more of its light than rounding leaves."""
    return bool((psfs.clip(max=0.0).sum(axis=(1, 2)) < -NOISY).any())


def without_noise(psfs: Array, oversample: int = 1) -> Array:
    r"""Return PSFs without the noise of their wings, each ring with the light that it had.

    In each ring the deviations from its mean are multiplied by the share of their variance that is
    not noise (a Wiener filter),

    .. math:: K \gets \bar K + \max(0, 1 - \sigma^2 / v)\, (K - \bar K),

    with the mean and the variance v of the ring, and the variance sigma^2 of the deviations near
    the edges. What is negative then is 0, and the rest of its ring as much less bright.

    Parameters
    ----------
    psfs : ndarray of float64, shape (p, ky, kx)
        The PSFs, their middle at ``(ky // 2, kx // 2)``.
    oversample : int
        Pixels of the PSFs to one of the images, along each axis.
    """
    ky, kx = psfs.shape[1:]
    rings = Rings((ky, kx), np.array([(kx // 2, ky // 2)]), oversample)
    pixels = rings.sums(np.ones((ky, kx)))
    y, x = np.ogrid[-(ky // 2) : ky - ky // 2, -(kx // 2) : kx - kx // 2]
    is_far = np.hypot(y, x) > FAR * (min(ky, kx) // 2)
    cleaned = np.empty_like(psfs)
    for psf, clean in zip(psfs, cleaned, strict=True):
        light = rings.sums(psf)
        mean = (light / np.maximum(pixels, 1))[rings.number]
        squares = (psf - mean) ** 2
        noise = squares[is_far].mean() * pixels
        variance = np.maximum(rings.sums(squares), np.finfo(float).tiny)
        share = np.where(pixels < FEWEST, 1.0, 1.0 - noise / variance).clip(0.0)
        clean[:] = np.maximum(mean + share[rings.number] * (psf - mean), 0.0)
        positive = rings.sums(clean)
        rest = np.divide(light, positive, out=np.zeros_like(light), where=positive > 0)
        clean *= rest.clip(0.0)[rings.number]
        clean /= clean.sum()
    return cleaned
