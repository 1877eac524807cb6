"""Whether a model fits its images as well as noise allows: in all, and at each star."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lnocl.scene.observation import Array, Observation

# The core of a star is where its PSF is above this share of its peak; its wings go on to the other.
CORE, WINGS = 0.5, 1e-3
# A misfit is this many times the noise, and as many standard errors above it.
MISFIT, SIGNIFICANCE = 1.5, 5.0


class Fit(NamedTuple):
    """How well a model m fits the counts g of some pixels.

    Attributes
    ----------
    n_pixels : int
        Good pixels.
    square_sum : float
        The sum of ``(g - m)^2 / m``.
    variance : float
        Its variance for Poisson counts, ``sum (2 + 1 / m)``.
    """

    n_pixels: int = 0
    square_sum: float = 0.0
    variance: float = 0.0

    @classmethod
    def of(cls, values: Array, models: Array) -> Fit:
        """Return the fit of pixels with these residuals and models."""
        good = ~np.isnan(values)
        n = int(np.count_nonzero(good))
        inverse = np.divide(1.0, models, out=np.zeros_like(models), where=good)
        return cls(n, float(np.nansum(values**2)), 2.0 * n + float(inverse.sum()))

    def plus(self, other: Fit) -> Fit:
        """Return the fit of these pixels and others."""
        return Fit(
            self.n_pixels + other.n_pixels,
            self.square_sum + other.square_sum,
            self.variance + other.variance,
        )

    @property
    def rms(self) -> float:
        """The rms residual: 1 where only noise is left, less where the model follows the noise."""
        return math.sqrt(self.square_sum / self.n_pixels) if self.n_pixels else math.nan

    @property
    def error(self) -> float:
        """The standard error of the rms by noise, where the model fits."""
        return math.sqrt(self.variance) / self.n_pixels / 2.0 if self.n_pixels else math.nan

    @property
    def is_misfit(self) -> bool:
        """Whether the rms is far above what noise gives."""
        return self.rms > max(MISFIT, 1.0 + SIGNIFICANCE * self.error)


class StarResiduals(NamedTuple):
    """How well a model fits at a star: in the core of its images, and in their wings."""

    core: Fit
    wings: Fit


def residuals(image: Array, mask: NDArray[np.bool_], model: Array) -> Array:
    """Return ``(g - m) / sqrt(m)``, shape (ny, nx); NaN where a pixel is bad, or the model is 0."""
    usable = ~mask & (model > 0)
    noise = np.sqrt(np.maximum(model, 0.0))
    return np.divide(image - model, noise, out=np.full_like(model, np.nan), where=usable)


def judge(
    observation: Observation, models: Iterable[Array], positions: Array
) -> tuple[Fit, list[StarResiduals]]:
    """Return how well a model fits all good pixels, and at each star in all images together.

    Parameters
    ----------
    observation : Observation
        The p images and their PSFs.
    models : iterable of ndarray of float64, shape (ny, nx)
        The m_j.
    positions : ndarray of float64, shape (n, 2)
        (x, y) of the stars, pixels.
    """
    overall, at_stars = Fit(), [StarResiduals(Fit(), Fit()) for _ in positions]
    for j, model in enumerate(models):
        values = residuals(observation.images[j], observation.mask[j], model)
        overall = overall.plus(Fit.of(values, model))
        psf, offset = observation.psfs[j], observation.offsets[j]
        for s, position in enumerate(positions):
            found = _fit_at(psf, position + offset, values, model)
            at_stars[s] = StarResiduals(*map(Fit.plus, at_stars[s], found))
    return overall, at_stars


def _fit_at(psf: Array, position: Array, values: Array, model: Array) -> tuple[Fit, Fit]:
    """Return the fit in the core and in the wings of a star in one image."""
    from astropy.nddata import NoOverlapError, overlap_slices

    middle = tuple(np.round(position[::-1]).astype(int))
    try:
        there, of_psf = overlap_slices(model.shape, psf.shape, middle)
    except NoOverlapError:  # the star is in other images alone
        return Fit(), Fit()
    share = psf[of_psf] / psf.max()
    is_core, is_wing = share > CORE, (share > WINGS) & (share <= CORE)
    values, model = values[there], model[there]
    return Fit.of(values[is_core], model[is_core]), Fit.of(values[is_wing], model[is_wing])
