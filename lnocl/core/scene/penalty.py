"""The penalty on the estimate, beside the data term of the objective."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from numbers import Real
from typing import Any, cast

import numpy as np

from lnocl.core.scene.arrays import Array, together
from lnocl.core.scene.counts import mean_exposure
from lnocl.core.scene.detector import psfs_on_detector
from lnocl.core.scene.observation import Observation
from lnocl.core.scene.star_prior import StarPrior
from lnocl.errors import InputError

# A larger weight leaves nothing of the data term of images at unit mean.
MAX_WEIGHT = 2.0**64

# The weight of the edge-preserving term in units of the noise of the gradient of the data term:
# docs/validation/sgp.md.
SMOOTHING = 0.1

# To which Python compares an integer of any size without making a float of it.
MAX_FLOAT = sys.float_info.max


@dataclass(frozen=True)
class Penalty:
    """``mu / 2 sum F^2 + smoothing sum psi(F - F')``, over pixels, and over pairs of neighbours.

    F is the extended source in electrons, at one exposure: the unit of time has no part in it.

    ``psi(t) = sqrt(t^2 + delta^2) - delta`` is the hypersurface potential (Charbonnier et al. 1997,
    IEEE Trans. Image Process. 6, 298): steps far below delta are smoothed as by a quadratic term,
    while of an edge far above it only the height counts, so that it stays sharp.

    Attributes
    ----------
    mu : float
        Weight of the Tikhonov term, per electron, zero or more.
    smoothing : float
        Weight of the edge-preserving term, zero or more. It has no unit.
    edges : tuple of float
        delta in each sky, in the unit of the extended source; empty: three times its mean, roughly.
    near_stars : ndarray of float64, of the shape of the extended source, or None
        Weight of the edge-preserving term beside `smoothing` in each pixel; a pair of pixels has
        the mean of both. None: 0 everywhere.
    shares : tuple of float
        With several skies that by which `smoothing` is multiplied in each; empty for 1.
    spectral : float
        That by which `smoothing` is multiplied between each pixel of one sky and that of the next,
        such as the slices of a cube; zero or more.
    stars : StarPrior or None
        Of star fluxes, electrons, which the objective leaves out.
    exposure : float or None
        That of F. None: the mean of the observation's, of which tiles have each their own.

    Raises
    ------
    InputError
        A weight that is not a number, negative or not finite.
    """

    mu: float = 0.0
    smoothing: float = 0.0
    edges: tuple[float, ...] = ()
    near_stars: Array | None = field(default=None, compare=False)
    shares: tuple[float, ...] = ()
    spectral: float = 0.0
    stars: StarPrior | None = field(default=None, compare=False)
    exposure: float | None = None

    def __post_init__(self) -> None:
        weights: dict[str, Any] = {"mu": self.mu, "smoothing": self.smoothing}
        weights["spectral_smoothing"] = self.spectral
        for name, weight in weights.items():
            if not (isinstance(weight, Real) and _is_weight(cast(float, weight))):
                raise InputError(
                    f"`{name}` must be a number, finite and not negative; {weight!r} was given"
                )

    def in_words(self) -> str:
        """Return the weight of the edge-preserving term as a message has it."""
        if self.near_stars is None:
            return f"{self.smoothing:.3g}"
        most = self.smoothing + self.near_stars.max()
        return f"{self.smoothing:.3g}, and {most:.3g} at the stars, where PSFs may be wrong"


def recommend_smoothing(observation: Observation) -> float:
    """Return the weight of the edge-preserving term that suits the noise of an observation.

    It is `SMOOTHING` times the standard deviation of the gradient of the data term by the noise of
    the counts, ``sqrt(sum_j <e_j^2 / g_j> sum K_j^2)``, e_j the exposures over their mean, < > the
    mean over the observed pixels, K_j as these see it. With several skies it is that of the first.
    """
    return float(recommend_smoothings(observation)[0])


def recommend_smoothings(observation: Observation) -> Array:
    """Return that weight for each sky: ``w_jk^2`` is in the sum, w_jk that of sky k in image j."""
    relative = observation.exposure / mean_exposure(observation)
    variances = np.divide(*together(relative**2, np.maximum(observation.images, 1.0)))
    variance = np.ma.masked_array(variances, observation.mask).mean(axis=(1, 2))
    squares = (psfs_on_detector(observation) ** 2).sum(axis=(1, 2))
    told = np.asarray(variance * squares)
    mixes = observation.components if observation.component_names else np.ones((len(told), 1))
    return np.asarray(SMOOTHING * np.sqrt(told @ mixes**2))


def _is_weight(number: float) -> bool:
    try:
        return 0 <= float(number) <= MAX_FLOAT
    except OverflowError:  # of whole numbers
        return False
