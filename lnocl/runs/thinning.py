"""Data thinning: the counts of an observation split at random into two halves."""

from __future__ import annotations

import numpy as np

from lnocl.errors import InputError, LnoclWarning, warn
from lnocl.process import ignored_warnings
from lnocl.scene.observation import Observation

# Binomial samples are drawn as 64-bit integers.
MAX_COUNTS = 2.0**62
# A count in single precision is whole to this share of it.
COUNT_ROUNDING = 1e-6


def split_counts(
    observation: Observation, n_splits: int = 1
) -> list[tuple[Observation, Observation]]:
    """Return pairs of halves of an observation, its counts split at random.

    A Poisson count is split binomially, so that its halves are independent Poisson counts of half
    its mean. The fraction of a number that is not whole goes to one of the halves, which keeps
    their variances those of counts to 1/16. The seeds are fixed.

    Raises
    ------
    InputError
        The images hold no counts, or too many in a pixel.

    Warns
    -----
    LnoclWarning
        Images that are not whole counts.
    """
    images = np.where(observation.mask, 0.0, observation.images)
    if not images.any():
        raise InputError(
            "the images hold no counts to hold out; give n_iter, mu and smoothing as numbers"
        )
    if images.max() > MAX_COUNTS:
        raise InputError(
            f"a pixel of {images.max():.3g} electrons is too bright to be split; give n_iter, mu "
            "and smoothing as numbers"
        )
    if not _are_whole(observation):
        warn("the images are not whole counts: they are split as if they were Poisson counts")
    whole = np.floor(images)
    known = {
        "background": observation.background / 2.0,
        "mask": observation.mask,
        "exposure": observation.exposure,
        "offsets": observation.offsets,
    }
    pairs = []
    for seed in range(n_splits):
        rng = np.random.default_rng(seed)
        first = rng.binomial(whole.astype(np.int64), 0.5).astype(np.float64)
        first += (images - whole) * rng.integers(0, 2, images.shape)
        with ignored_warnings(LnoclWarning):  # the whole observation has warned already
            pairs.append(
                (
                    Observation(first, observation.psfs, **known),
                    Observation(images - first, observation.psfs, **known),
                )
            )
    return pairs


def _are_whole(observation: Observation) -> bool:
    """Return whether all counts are whole, as they were before the read noise was added."""
    variance = observation.read_noise**2
    counts = observation.images - (variance if variance.ndim == 3 else variance[:, None, None])
    counts = counts[~observation.mask & (observation.images > 0)]  # negative ones were set to 0
    rounding = COUNT_ROUNDING * np.maximum(abs(counts), 1.0)
    return bool((abs(counts - np.round(counts)) <= rounding).all())
