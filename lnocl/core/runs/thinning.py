"""Data thinning: the counts of an observation split at random into two halves."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from lnocl.core.scene.arrays import Array
from lnocl.core.scene.observation import Observation
from lnocl.errors import InputError

# Binomial samples are drawn as 64-bit integers.
MAX_COUNTS = 2.0**62
# With the index of an image.
SEED = 0
# Of so many counts each is dealt out by a random bit, in so many rows at once.
BITS, ROWS = 64, 128


def split_counts(observation: Observation) -> tuple[Observation, Observation]:
    """Return two halves of an observation, its counts split at random.

    A Poisson count is split binomially, so that its halves are independent Poisson counts of half
    its mean. The fraction of a number that is not whole goes to one of the halves, which keeps
    their variances those of counts to 1/16. The seed is fixed.

    Raises
    ------
    InputError
        The images hold no counts, or too many in a pixel.
    """
    images = observation.images
    if not images.any():
        raise InputError("the images hold no counts to hold out; give `n_iter` and `stop` None")
    if images.max() > MAX_COUNTS:
        raise InputError(
            f"a pixel of {images.max():.3g} electrons is too bright to be split; give `n_iter` and "
            "`stop` None"
        )
    first = np.empty_like(images)
    with ThreadPoolExecutor() as threads:
        list(threads.map(_deal_out, range(len(images)), images, first))  # which raises its errors
    background = observation.background / 2.0
    return (
        observation.replace(images=first, background=background),
        observation.replace(images=images - first, background=background),
    )


def _deal_out(j: int, image: Array, half: Array) -> None:
    """Write half the counts of image j, which no other image changes."""
    rng = np.random.default_rng((SEED, j))
    for begin in range(0, len(image), ROWS):
        rows = slice(begin, begin + ROWS)
        counts = image[rows].astype(np.uint64)
        bits = rng.integers(2**BITS, size=counts.shape, dtype=np.uint64)
        dealt = np.bitwise_count(bits >> (BITS - np.minimum(counts, BITS))).astype(np.float64)
        many = counts > BITS
        dealt[many] = rng.binomial(counts[many].astype(np.int64), 0.5)
        half[rows] = dealt + (image[rows] - counts) * rng.integers(0, 2, counts.shape)
