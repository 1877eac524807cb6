"""Places at random, of sources that are put into images."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from lnocl.core.scene.arrays import Array


def random_pixels(weights: Array, n: int, rng: np.random.Generator) -> NDArray[np.int_]:
    """Return rows and columns of n pixels at random, each as often as its weight says."""
    chosen = rng.choice(weights.size, n, p=weights.ravel() / weights.sum())
    return np.array(np.unravel_index(chosen, weights.shape)).T


def parted(places: NDArray[np.int_], apart: float) -> Iterator[list[int]]:
    """Yield numbers of places that lie farther apart than given, together all of them."""
    left = np.arange(len(places))
    while left.size:
        taken, free = list[int](), left
        while free.size:
            taken.append(int(free[0]))
            free = free[np.hypot(*(places[free] - places[free[0]]).T) > apart]
        yield taken
        left = np.setdiff1d(left, taken)
