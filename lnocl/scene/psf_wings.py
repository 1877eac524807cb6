"""Wings of PSFs that noise has made negative, where no light can be."""

from __future__ import annotations

import numpy as np

from lnocl.scene.observation import Array
from lnocl.scene.rings import Rings


def without_negatives(psfs: Array, oversample: int = 1) -> Array:
    """Return PSFs whose negative pixels are 0, and whose rings have the light that they had.

    The positive pixels of a ring are multiplied by ``sum K / sum max(K, 0)``; a ring without light
    in all is 0. So the noise of the wings adds no light to them.

    Parameters
    ----------
    psfs : ndarray of float64, shape (p, ky, kx)
        The PSFs, their middle at ``(ky // 2, kx // 2)``.
    oversample : int
        Pixels of the PSFs to one of the images, along each axis.
    """
    ky, kx = psfs.shape[1:]
    number = Rings((ky, kx), np.array([(kx // 2, ky // 2)]), oversample).number
    repaired = np.maximum(psfs, 0.0)
    for psf, given in zip(repaired, psfs, strict=True):
        sums, positive = (np.bincount(number.ravel(), each.ravel()) for each in (given, psf))
        share = np.divide(sums, positive, out=np.zeros_like(sums), where=positive > 0)
        psf *= share.clip(0.0)[number]
        psf /= psf.sum()
    return repaired
