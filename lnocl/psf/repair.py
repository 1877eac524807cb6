"""Bad pixels of an image, interpolated from the good ones around them.

One in the core of a Moffat star 3 pixels wide is right to 0.4 % of the peak, in fringes to 0.08 %;
astropy's `interpolate_replace_nans` leaves 4 and 13 % there (benchmarks/libraries.py).
"""

from __future__ import annotations

import numpy as np
from scipy.interpolate import RBFInterpolator
from scipy.ndimage import convolve1d, maximum_filter

from lnocl.core.scene.arrays import Array, Mask

# A bad pixel is repaired if in the square of side `WINDOW` around it are `MIN_GOOD` good ones. So
# many lie on no two lines and on no conic, where the interpolation would not be unique.
WINDOW, MIN_GOOD = 11, 40
# Good pixels that a bad one is interpolated from.
NEIGHBOURS = 48


def repair(image: Array, bad: Mask, region: Mask) -> tuple[Mask, Mask]:
    """Interpolate the bad pixels of a region in place, by quintic radial functions.

    Parameters
    ----------
    image : ndarray of float64, shape (ny, nx)
        Finite where it is bad too.
    bad : ndarray of bool, shape (ny, nx)
        True where a pixel is bad. All beyond the image counts as bad.
    region : ndarray of bool, shape (ny, nx)
        True where bad pixels are looked at.

    Returns
    -------
    repaired, unrepairable : ndarray of bool, shape (ny, nx)
        The bad pixels of the region that were interpolated, and those that have too few good
        ones around them and were left as they are.
    """
    n_good = (~bad).astype(np.int64)
    for axis in (0, 1):
        n_good = convolve1d(n_good, np.ones(WINDOW, int), axis, mode="constant")
    unrepairable = bad & region & (n_good < MIN_GOOD)
    wanted = bad & region & ~unrepairable
    near = maximum_filter(wanted, 2 * WINDOW + 1) & ~bad
    if wanted.any():
        image[wanted] = RBFInterpolator(
            np.argwhere(near), image[near], NEIGHBOURS, kernel="quintic"
        )(np.argwhere(wanted))
    return wanted, unrepairable
