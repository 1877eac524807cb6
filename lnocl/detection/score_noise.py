r"""How much more than counts alone a score scatters: shared noise, and errors of PSFs near stars.

Noise that neighbours share scatters the darker half of the whole field. Errors e of the PSFs,
relative to them, add ``e^2 X`` to the variance of the score u, where X follows from the light of
the stars (`lnocl.detection.score`). In each ring round the stars e is what the run has found, or
what the ring shows,

.. math:: \Big\langle \frac{u^2}{1 + e^2 X} \Big\rangle = 1,

whichever is more. A ring has few independent values, so that its score follows Student's
distribution, as contrasts near a star do (Mawet, D., et al., 2014, ApJ 792, 97). Each place has a
ring round it, and a prior says that errors are about a tenth at most.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import optimize
from scipy.ndimage import value_indices

from lnocl.core.scene.arrays import Array, darker_noise

if TYPE_CHECKING:
    from lnocl.detection.score import Score

# A field scatters more than counts where it does by so many of its errors.
CLEARLY = 4.0
# Rings are looked at where PSFs that are wrong by so much would add this share of the noise.
POSSIBLE, TELLING = 0.1, 0.1
# What the run has found of the PSFs counts as so many values of a ring.
KNOWN = 10.0
# Rings, a unit wide, begin at so many places in a unit.
STEPS = 4
# The median of squares of a Gaussian.
MEDIAN_SQUARE = 0.4549
# Degrees of freedom that are as many as infinite.
MANY = 1e6


class Noise(NamedTuple):
    """How much more than counts alone the scores scatter.

    Attributes
    ----------
    scatter : ndarray of float64, shape (Ny, Nx)
        Standard deviations over those of counts, 1 or more.
    degrees : ndarray of float64, shape (Ny, Nx)
        Degrees of freedom with which they are known.
    """

    scatter: Array
    degrees: Array


def noise_of(score: Score, rings: Array, empty: NDArray[np.bool_] | None) -> Noise:
    """Return the noise of a score near stars, and of its whole field.

    Parameters
    ----------
    score : Score
        The score of a source.
    rings : ndarray of float64, shape (Ny, Nx)
        The radius, in widths of a ring, of that round a star that each place lies in.
    empty : ndarray of bool, shape (Ny, Nx), or None
        Where no structure was found; None where it is not known yet, so that medians stand for
        means.
    """
    values = score.values
    is_empty = score.is_tested if empty is None else score.is_tested & empty
    independent = 1.0 / float((score.correlation**2).sum())
    shared = _shared(values[is_empty], independent)
    scatter = shared * np.sqrt(1.0 + score.of_psfs)
    degrees = np.full(values.shape, MANY)
    is_near = (POSSIBLE**2 * score.starlit > TELLING) & score.is_tested
    told_by = is_near & is_empty
    outwards = np.argsort(rings[told_by])
    radius, lights = rings[told_by][outwards], score.starlit[told_by][outwards]
    squares = (values[told_by][outwards] / shared) ** 2
    steps = np.round(STEPS * np.where(is_near, rings, -1.0)).astype(int)
    for k, there in value_indices(steps, ignore_value=-STEPS).items():
        ring = slice(*np.searchsorted(radius, (k / STEPS - 0.5, k / STEPS + 0.5)))
        square = _error_in(squares[ring], lights[ring], empty is None)
        shares = lights[ring] / (1.0 + square * lights[ring])
        told = independent * float((shares**2).sum()) + 2.0 / max(square, POSSIBLE**2) ** 2
        light = score.starlit[there]
        total = 1.0 + np.maximum(square * light, score.of_psfs[there])
        scatter[there] = shared * np.sqrt(total)
        degrees[there] = np.minimum(KNOWN + (total / light) ** 2 * told, MANY)
    return Noise(scatter, degrees)


def _shared(values: Array, independent: float) -> float:
    """Return how much more than counts a whole field scatters, by its darker half."""
    if not values.size:
        return 1.0
    found = darker_noise(values)
    return found if found > 1.0 + CLEARLY / math.sqrt(independent * values.size) else 1.0


def _error_in(squares: Array, light: Array, by_median: bool) -> float:
    """Return the square of the PSFs' relative error that a ring shows."""
    middle, expected = (np.median, MEDIAN_SQUARE) if by_median else (np.mean, 1.0)

    def excess(square: float) -> float:
        return float(middle(squares / (1.0 + square * light))) - expected

    if not squares.size or excess(0.0) <= 0:
        return 0.0
    high = 1.0 / light.max()
    while excess(high) > 0:
        high *= 4.0
    return float(optimize.brentq(excess, 0.0, high))
