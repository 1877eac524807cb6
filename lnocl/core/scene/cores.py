"""Cores of PSFs and stars: where they are, and how wide."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from lnocl.core.scene.arrays import Array
from lnocl.core.scene.remembered import remembered

# A core is what is connected to the peak and above this share of it.
CORE = 0.3
# Of several brightest pixels, equal but for rounding, the one nearest to the middle is the peak.
ROUNDING = 1e-6
# Points an axis at which the width of a core is measured, for each pixel.
FINER = 8


def centre(shape: tuple[int, ...]) -> tuple[int, int]:
    """Return row and column of the pixel that a PSF is centred on, ``(ky // 2, kx // 2)``."""
    return shape[0] // 2, shape[1] // 2


def peak(light: Array) -> tuple[int, int]:
    """Return row and column of the brightest pixel, the nearest to the middle of equal ones."""
    y, x = np.nonzero(light >= light.max() - ROUNDING * abs(light.max()))
    nearest = int(np.argmin((y - light.shape[0] // 2) ** 2 + (x - light.shape[1] // 2) ** 2))
    return int(y[nearest]), int(x[nearest])


def core(light: Array, share: float) -> NDArray[np.bool_]:
    """Return the pixels above a share of the peak that are connected to it."""
    from scipy.ndimage import label

    at = peak(light)
    labels, _ = label(light > share * light[at])
    return np.asarray(labels == labels[at])


def centroid(light: Array) -> tuple[float, float]:
    """Return row and column of the centre of light of a core, as far as it is above `CORE`."""
    weights = np.where(core(light, CORE), light - CORE * light[peak(light)], 0.0)
    y, x = np.indices(light.shape)
    total = weights.sum()
    return float((weights * y).sum() / total), float((weights * x).sum() / total)


def off_centre(psf: Array) -> tuple[float, float]:
    """Return how far the core of a PSF lies from its `centre`, pixels along x and y.

    Examples
    --------
    >>> import numpy as np
    >>> from lnocl.core.scene.cores import off_centre
    >>> y, x = np.indices((32, 32)) - 15.5
    >>> dx, dy = off_centre(np.exp(-(x**2 + y**2) / 8))
    >>> round(dx, 2), round(dy, 2)
    (-0.5, -0.5)
    """
    row, column = centroid(psf)
    y, x = centre(psf.shape)
    return column - x, row - y


@remembered(2**17)  # all fits of a run ask for the same few
def fwhm(light: Array) -> float:
    """Return the full width of a core at half its maximum, pixels: of a disc of the same area."""
    from scipy.ndimage import zoom

    half = 2 + math.ceil(1.5 * float(core(light, 0.5).sum()) ** 0.5)
    rows, columns = (slice(max(at - half, 0), at + half + 1) for at in peak(light))
    window = light[rows, columns]
    fine = zoom(window, FINER, order=3, mode="nearest", grid_mode=True)
    return math.sqrt(4.0 / math.pi * float(core(fine, 0.5).sum())) / FINER
