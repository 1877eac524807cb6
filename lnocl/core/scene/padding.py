"""How many unobserved pixels a source that runs over the edge of the images needs."""

from __future__ import annotations

import math

import numpy as np

from lnocl.core.scene.arrays import Array
from lnocl.core.scene.detector import psfs_on_detector
from lnocl.core.scene.halos import rough_halos
from lnocl.core.scene.observation import Observation

# Share of a PSF's light within the radius that is enough for a pad, and the share of the shorter
# side of the images that the pad is at most (benchmarks/frames.py, docs/validation/frames.md).
LIGHT = 0.9
SHARE_OF_SIDE = 0.5
# Light runs over an edge where so many pixels of it together exceed the background by so many times
# their noise: of a million such stretches of noise alone fewer than one does.
STRETCH = 16
MIN_EXCESS = 5.0


def choose_pad(observation: Observation) -> int:
    """Return the pad "auto": the offsets, or `recommend_pad` where light runs over an edge.

    The grid of turned images holds all that is turned.
    """
    shifted = 0 if observation.is_turned else int(np.ceil(abs(observation.offsets).max()))
    return max(shifted, recommend_pad(observation) if runs_over_the_edge(observation) else 0)


def recommend_pad(observation: Observation) -> int:
    """Return the pad that a source running over the edge needs.

    The largest radius within which the PSFs have nine tenths of their light, in whole pixels; at
    most half the shorter side of the images, since light from farther away is smooth.

    Parameters
    ----------
    observation : Observation
        The images and their PSFs.

    Returns
    -------
    int
        Pixels, 1 or more.

    Examples
    --------
    >>> import numpy as np
    >>> import lnocl
    >>> from lnocl.core.scene.padding import recommend_pad
    >>> y, x = np.indices((31, 31)) - 15
    >>> gaussian = np.exp(-(x**2 + y**2) / 18)
    >>> recommend_pad(lnocl.Observation(np.ones((64, 64)), gaussian))
    7
    """
    most = max(1, int(SHARE_OF_SIDE * min(observation.shape)))
    psfs = zip(psfs_on_detector(observation), observation.scales, strict=True)
    return min(max(1, *(math.ceil(_radius(psf, LIGHT) * scale) for psf, scale in psfs)), most)


def runs_over_the_edge(observation: Observation) -> bool:
    """Return whether light runs over the edge of an image.

    It does where the counts of a stretch of 16 of the outermost pixels exceed the background by
    five times their noise.

    Examples
    --------
    >>> import numpy as np
    >>> import lnocl
    >>> from lnocl.core.scene.padding import runs_over_the_edge
    >>> image = np.full((64, 64), 90.0)
    >>> runs_over_the_edge(lnocl.Observation(image, np.ones((1, 1)), background=90.0))
    False
    >>> image[0, 30:34] += 900.0
    >>> runs_over_the_edge(lnocl.Observation(image, np.ones((1, 1)), background=90.0))
    True
    """
    for j, (image, mask) in enumerate(zip(observation.images, observation.mask, strict=True)):
        level = observation.background[j] + rough_halos(observation, j)
        level = np.broadcast_to(level, image.shape)
        rows, columns = observation.good_box(j)
        for edge in (np.s_[rows[0]], np.s_[rows[-1]], np.s_[:, columns[0]], np.s_[:, columns[-1]]):
            good, starts = ~mask[edge], range(0, len(image[edge]), STRETCH)
            excess = np.add.reduceat(np.where(good, image[edge] - level[edge], 0.0), starts)
            variance = np.add.reduceat(np.where(good, image[edge], 0.0), starts)
            if (excess > MIN_EXCESS * np.sqrt(variance)).any():
                return True
    return False


def _radius(psf: Array, share: float) -> int:
    """Return the least whole radius, pixels, that holds this share of a PSF's light."""
    y, x = np.ogrid[: psf.shape[0], : psf.shape[1]]
    r = np.ceil(np.hypot(y - psf.shape[0] // 2, x - psf.shape[1] // 2)).astype(int)
    light = np.cumsum(np.bincount(r.ravel(), weights=psf.ravel()))
    return int(np.argmax(light >= share))
