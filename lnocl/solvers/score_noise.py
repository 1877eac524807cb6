r"""How much more than counts alone a score scatters: shared noise, and errors of PSFs near stars.

Noise that neighbours share scatters the darker half of the whole field. Errors e of the PSFs,
relative to them, add ``e^2 X`` to the variance of the score u, where X follows from the light of
the stars (`lnocl.solvers.score`). In each ring round the stars e is what the run has found, or what
the ring shows,

.. math:: \Big\langle \frac{u^2}{1 + e^2 X} \Big\rangle = 1,

whichever is more. A ring has few independent values, so that its score follows Student's
distribution, as contrasts near a star do (Mawet, D., et al., 2014, ApJ 792, 97).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from lnocl.scene.arrays import Array
from lnocl.solvers.score import Score

# A Gaussian is one standard deviation below its median in this share of all.
DARKER = 0.1587
# A field scatters more than counts where it does by so many of its errors.
CLEARLY = 4.0
# Rings are looked at where PSFs that are wrong by so much would add this share of the noise.
POSSIBLE, TELLING = 0.1, 0.1
# What the run has found of the PSFs counts as so many values of a ring.
KNOWN = 10.0
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


def noise_of(score: Score, empty: NDArray[np.bool_], rings: NDArray[np.int_]) -> Noise:
    """Return the noise of a score near stars, and of its whole field.

    Parameters
    ----------
    score : Score
        The score of a source.
    empty : ndarray of bool, shape (Ny, Nx)
        Where no structure was found.
    rings : ndarray of int, shape (Ny, Nx)
        The ring round a star that each place lies in.
    """
    values = score.score / np.sqrt(score.variance)
    tested = values[score.is_tested & empty]
    independent = 1.0 / float((score.correlation**2).sum())
    shared = 1.0
    if tested.size:
        shared = float(np.median(tested) - np.quantile(tested, DARKER))
        if shared < 1.0 + CLEARLY / math.sqrt(independent * tested.size):
            shared = 1.0
    scatter = shared * np.sqrt(1.0 + score.of_psfs)
    degrees = np.full(values.shape, MANY)
    near = (POSSIBLE**2 * score.starlit > TELLING) & score.is_tested & empty
    if not near.any():
        return Noise(scatter, degrees)
    y, x = np.nonzero(near)
    light, known = score.starlit[y, x], score.of_psfs[y, x]
    _, ring = np.unique(rings[y, x], return_inverse=True)
    order = np.argsort(ring, kind="stable")
    ends = np.cumsum(np.bincount(ring))[:-1]
    for at in np.split(order, ends):
        square, variance = _error_in((values[y[at], x[at]] / shared) ** 2, light[at], independent)
        total = 1.0 + np.maximum(square * light[at], known[at])
        scatter[y[at], x[at]] = shared * np.sqrt(total)
        told = KNOWN + 2.0 * (total / light[at]) ** 2 / variance
        degrees[y[at], x[at]] = np.minimum(told, MANY)
    return Noise(scatter, degrees)


def _error_in(squares: Array, light: Array, independent: float) -> tuple[float, float]:
    """Return the square of the PSFs' relative error that a ring shows, and its variance.

    The mean of ``u^2 / (1 + e^2 X)`` is 1 for the error e.
    """

    def excess(square: float) -> float:
        return float((squares / (1.0 + square * light)).mean()) - 1.0

    square = 0.0
    if excess(0.0) > 0:
        high = 1.0 / light.max()
        while excess(high) > 0:
            high *= 4.0
        square = float(optimize.brentq(excess, 0.0, high))
    told = independent * float(((light / (1.0 + square * light)) ** 2).sum())
    return square, 2.0 / told
