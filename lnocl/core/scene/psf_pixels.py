"""Pixels of PSFs that are free, within what is known of them."""

from __future__ import annotations

import numpy as np

from lnocl.core.scene.arrays import Array
from lnocl.core.scene.smooth_field import SmoothField

# Errors of PSFs are correlated over this, pixels of the images.
CORRELATED = 0.6


class PsfPixels:
    r"""Corrections of PSFs G, pixel by pixel.

    .. math:: D = \delta - G \sum \delta, \qquad \delta = s \, C^{1/2} x, \qquad x \sim N(0, 1)

    with the scatter s of the PSF, correlated over C; no light is won or lost.

    Parameters
    ----------
    psfs : ndarray of float64, shape (p, ky, kx)
        The given PSFs.
    scatter : ndarray of float64, shape (p, ky, kx)
        The standard deviations of their pixels.
    oversample : int
        Pixels of the PSFs to one of the images, along each axis.
    """

    def __init__(self, psfs: Array, scatter: Array, oversample: int) -> None:
        self._psfs, self._scatter = psfs, scatter
        self.shape = psfs.shape[1:]
        self._smooth = SmoothField(self.shape, CORRELATED * oversample)

    def correction(self, j: int, field: Array) -> Array:
        """Return the correction of PSF j, shape (ky, kx)."""
        change = self._scatter[j] * self._smooth.apply(field)
        return np.asarray(change - change.sum() * self._psfs[j])

    def adjoint(self, j: int, image: Array) -> Array:
        """Return the transpose of `correction`, applied to an image (ky, kx)."""
        return self._smooth.apply(self._scatter[j] * (image - (self._psfs[j] * image).sum()))
