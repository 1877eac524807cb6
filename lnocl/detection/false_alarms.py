r"""How often noise alone exceeds a value somewhere in a field, and what a value of counts is worth.

A field of unit variance and curvature Lambda exceeds a high value u, over an area A with an edge of
length L, in about

.. math::
    E(u) = \Bigl( \frac{u}{(2 \pi)^{3/2}} \int_A \sqrt{\det \Lambda}
           + \frac{1}{4 \pi} \int_L \sqrt{\lambda} \Bigr) e^{-u^2 / 2}

places, lambda the curvature along the edge (the Euler characteristic of its excursion set: Adler,
R. J., Taylor, J. E., "Random Fields and Geometry", 2007, chapter 12; the last term is left out, as
it is less than that of noise at one place). Sums of few counts are skewed: a saddlepoint
approximation (Lugannani, R., Rice, S., 1980, Adv. Appl. Probab. 12, 475) says which Gaussian value
is as rare.
"""

from __future__ import annotations

import math

import numpy as np
import scipy.special
from scipy import optimize
from scipy.interpolate import RegularGridInterpolator

from lnocl.core.scene.arrays import Array

# Values that are worth translating, at most and at least.
LOWEST, HIGHEST = 1.0, 1e4
# The range of skewness in the table; what is less skewed counts as Gaussian.
GAUSSIAN, MOST = 1e-3, 100.0
# Tilts in the table, and the largest exponent in them.
N_TILTS, LARGEST = 400, 300.0
# A Gaussian value in the table is this or more.
LEAST = 1e-3
# Rarer probabilities, and fewer places in a field without noise, are lost in rounding.
RAREST = 1e-300
# Of the profile what is above this share of its peak matters.
FAINT = 1e-4


def threshold(alarms: float, cells: float, edge: float = 0.0) -> float:
    """Return the value that noise exceeds in so many places of a field, on average.

    Parameters
    ----------
    alarms : float
        Expected number of places.
    cells : float
        The integral of ``sqrt(det Lambda)`` over the field.
    edge : float, optional
        The integral of ``sqrt(lambda)`` along its edge.
    """

    def excess(u: float) -> float:
        of_area, of_edge = cells * u * (2.0 * math.pi) ** -1.5, edge / (4.0 * math.pi)
        return math.log(max((of_area + of_edge) / alarms, RAREST)) - u * u / 2.0

    if excess(1.0) <= 0:  # where the number falls, from 1 on
        return 1.0
    return float(optimize.brentq(excess, 1.0, HIGHEST))


class Rarity:
    """The Gaussian values that are as rare as those of sums of counts with a profile.

    Parameters
    ----------
    profile : ndarray of float64
        Weights of the counts, of any shape.
    """

    def __init__(self, profile: Array) -> None:
        weights = profile.ravel()
        weights = weights[abs(weights) > FAINT * abs(weights).max()]
        # Of one count a pixel.
        skewness = float((weights**3).sum() / (weights**2).sum() ** 1.5)
        if skewness <= 0:
            self._table = None
            return
        skews = np.geomspace(GAUSSIAN, MOST, 26)
        values = np.geomspace(LOWEST, HIGHEST, 80)
        rows = [
            _gaussian_values(weights, (skewness / each) ** 2, values) for each in skews.tolist()
        ]
        self._table = RegularGridInterpolator((np.log(skews), np.log(values)), np.log(rows))

    def __call__(self, values: Array, skewness: Array) -> Array:
        """Return the Gaussian values for values of unit variance and their skewness."""
        out = np.array(values, np.float64)
        is_high = (values > LOWEST) & (skewness > GAUSSIAN)
        if self._table is None or not is_high.any():
            return out
        at = np.log(np.clip(skewness[is_high], GAUSSIAN, MOST))
        out[is_high] = np.exp(self._table((at, np.log(np.minimum(values[is_high], HIGHEST)))))
        return out


def _gaussian_values(weights: Array, level: float, values: Array) -> Array:
    """Return the Gaussian values as rare as these, of weights with so many counts a pixel.

    Each tilt t of the distribution has the value whose saddlepoint it is.
    """
    scaled = weights / math.sqrt(level * float((weights**2).sum()))
    # A value grows faster than its tilt, far faster where counts are few.
    tilts = np.geomspace(1e-3 * LOWEST, HIGHEST, N_TILTS)
    tilts = tilts[tilts * scaled.max() < LARGEST]
    grown = np.expm1(tilts[:, None] * scaled)
    cumulants = level * (grown - tilts[:, None] * scaled).sum(axis=1)
    slopes = level * (grown @ scaled)
    curvatures = level * ((grown + 1.0) @ scaled**2)
    roots = np.sqrt(2.0 * (tilts * slopes - cumulants))
    found = roots + np.log(tilts * np.sqrt(curvatures) / roots) / roots
    found = np.maximum(found, LEAST)  # near the mean it may be negative
    return np.exp(np.interp(np.log(values), np.log(slopes), np.log(found)))


def of_student(values: Array, degrees: Array) -> Array:
    """Return the Gaussian values as rare as these of Student's distribution.

    What is rarer than a number holds has the logarithm of its density for its rarity.
    """
    sizes = np.abs(values)
    tail = scipy.special.stdtr(degrees, -sizes)
    far = np.sqrt(degrees * np.log1p(sizes**2 / degrees))
    rare = np.maximum(tail, RAREST)
    return np.asarray(np.sign(values) * np.where(tail > RAREST, -scipy.special.ndtri(rare), far))
