"""Shifts and rotations of the image of a star.

A rotated oval of 4.7 x 2.8 pixels is right to 1.4e-4 of its peak; SciPy's splines leave 3.6e-3
(cubic) and 7.6e-4 (quintic) (benchmarks/libraries.py).
"""

from __future__ import annotations

import math

import numpy as np

from lnocl.core.scene.arrays import Array
from lnocl.core.scene.rotation import turned_psf
from lnocl.core.scene.shifting import place
from lnocl.core.scene.transforms import enlarged


def shift(image: Array, by: tuple[float, float]) -> Array:
    """Return an image of a star moved by (rows, columns), wrapped round.

    It is moved as `lnocl.core.scene.shifting.place` moves a PSF: as a sum of Gaussians on its
    pixels.

    Parameters
    ----------
    image : ndarray of float64, shape (ny, nx)
        The star in the middle.
    by : tuple of float
        Pixels.

    Returns
    -------
    ndarray of float64, shape (ny, nx)
        The image moved; its sum stays the same to rounding.
    """
    ny, nx = image.shape
    return place(image, (ny, nx), nx // 2 + by[1], ny // 2 + by[0]).on_grid((ny, nx))


def rotate(image: Array, angle: float) -> Array:
    """Return a square image rotated about its middle, pixel ``n // 2`` of both axes.

    Parameters
    ----------
    image : ndarray of float64, shape (n, n)
        Of odd side; what lies beyond it is 0.
    angle : float
        Degrees from the x axis towards the y axis. Multiples of 90 are exact.

    Returns
    -------
    ndarray of float64, shape (n, n)
        The image rotated, by three shears, each by the phases of a spectrum.
    """
    quarters, rest = _quarters(angle)
    turned = np.rot90(image, -quarters)
    if not rest:
        return turned
    wide = turned_psf(turned, -math.radians(rest))
    return enlarged(wide, (len(image), len(image)), is_centred=True)


def reach(side: int, angle: float) -> int:
    """Return how far from its middle a square of this side reaches before it is rotated.

    Parameters
    ----------
    side : int
        Pixels.
    angle : float
        Degrees.

    Returns
    -------
    int
        Pixels from the middle, along x or y.
    """
    t = math.radians(abs(_quarters(angle)[1]))
    return math.ceil(side // 2 * (math.cos(t) + math.sin(t)) - 1e-9)


def _quarters(angle: float) -> tuple[int, float]:
    """Return quarter turns and the rest of an angle, degrees."""
    quarters = round(angle / 90)
    return quarters, angle - 90 * quarters
