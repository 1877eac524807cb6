"""The light of a host, an extended source that lies all round a star and falls outwards."""

from __future__ import annotations

import numpy as np

from lnocl.core.scene.arrays import Array
from lnocl.core.scene.texture import CORE, ROUND

# Where a host is looked for and where it is fainter, resolutions, each in so many sectors.
RINGS, SECTORS = ((CORE, ROUND), (ROUND, 3.0)), 8


def light_of_host(
    sky: Array, rows: Array, columns: Array, resolution: float, hidden: float
) -> float:
    """Return the light of the host of a star within `ROUND`, in units of the sky.

    It is as bright under the star as in the first of `RINGS`, by the lower quartile of sectors: a
    jet is on one side. Where the second is brighter by that and in the mean, as in a ring, there is
    none.

    Parameters
    ----------
    sky : ndarray of float64, shape (height, width)
        The extended source round the star.
    rows, columns : ndarray of float64, shapes (height, 1) and (width,)
        How far below and right of the star it is, pixels of the sky.
    resolution : float
        Pixels of the sky.
    hidden : float
        The radius round the star in which no image has observed a pixel, in the same.
    """
    distance = (np.hypot(rows, columns) - hidden) / resolution
    sector = ((np.arctan2(rows, columns) / (2.0 * np.pi) + 0.5) * SECTORS).astype(int) % SECTORS
    is_round, is_far = ((distance > a) & (distance <= b) for a, b in RINGS)
    rings = ([sky[ring & (sector == k)] for k in range(SECTORS)] for ring in (is_round, is_far))
    level, far = map(_lower_quartile, rings)
    if is_far.any() and level <= min(far, sky[is_far].mean()):
        return 0.0
    return level * float(np.count_nonzero(distance <= ROUND))


def _lower_quartile(parts: list[Array]) -> float:
    """Return that of the means of parts, 0 without any."""
    means = sorted(float(part.mean()) for part in parts if part.size)
    return means[len(means) // 4] if means else 0.0
