r"""Fluxes that a threshold finds with some probability.

The score of a source of signal-to-noise s is normal about s, and its own counts add ``gamma s`` to
its unit variance, gamma the skewness of the score. A maximum is looked for in two dimensions, so
that it is higher by ``1 / s`` on average. With the value u that the threshold stands for at a
place, the source is found with probability p where

.. math:: s + 1 / s - u = \Phi^{-1}(p) \sqrt{1 + \gamma s}.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.special

from lnocl.core.scene.arrays import Array

# Rounds of the two fixed points; a value is found to 1e-3 of it.
ROUNDS, EXACT = 30, 1e-3
# A source that is found has at least this signal-to-noise.
LEAST = 1.0


def values_at(threshold: float, rarity: Callable[[Array], Array], n: int) -> Array:
    """Return the values at n places whose Gaussian values, `rarity`, are a threshold."""
    values = np.full(n, threshold)
    for _ in range(ROUNDS):
        ratio = (threshold / np.maximum(rarity(values), 0.1)).clip(0.5, 2.0)
        values *= ratio
        if (abs(ratio - 1.0) < EXACT).all():
            break
    return values


def needed(values: Array, skewness: Array, probability: float) -> Array:
    """Return the signal-to-noise of sources that exceed values with this probability."""
    quantile = float(scipy.special.ndtri(probability))
    found = values.copy()
    for _ in range(ROUNDS):
        found = values - 1.0 / found + quantile * np.sqrt(1.0 + skewness * found)
        found = np.maximum(found, LEAST)
    return found
