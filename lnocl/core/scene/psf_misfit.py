r"""How far images are from their models at the stars, as a relative error of the PSFs.

A pixel counts where stars give more than half of its model m, by the square of their share S of it,
so that the sky beside the stars has no part. It counts less where m is below an electron, since few
counts tell nothing:

.. math:: \chi^2 = \sum_j \sum_n w \frac{(g - m)^2}{m}, \qquad
          w = \frac{S^2}{m^2} \frac{m}{m + 1/2}, \qquad
          \kappa^2 = \Bigl(\chi^2 - \sum w\Bigr) \Big/ \sum w \frac{S^2}{m}.

Noise alone leaves ``sum w``, with a variance of ``sum w^2 (2 + 1 / m)``. A PSF with a relative
error kappa in each pixel adds ``kappa^2 S^2`` to the variance m.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from lnocl.core.scene.arrays import Array
from lnocl.core.scene.estimate import Estimate
from lnocl.core.scene.forward_model import Model
from lnocl.core.scene.rings import Rings
from lnocl.core.scene.scene import MIN_MODEL
from lnocl.core.scene.transforms import enlarged

# Pixels count where stars give more than this share of the model: below it, what does not fit is
# more likely the structure of the sky.
DOMINANT = 0.5
# The misfit is told from noise from so many of its standard deviations on; in a ring from so many.
SIGNIFICANT, SIGNIFICANT_IN_RING = 5.0, 2.0
# A mend is tried from fewer on too where kappa is large: in few counts or pixels no error is
# significant, and in many the smoothing of the extended source leaves as many standard deviations,
# but little kappa.
DOUBTFUL, LARGE = 3.0, 0.025


class PsfMisfit(NamedTuple):
    """How far images are from their models at the stars.

    Attributes
    ----------
    squares, expected, variances : ndarray of float64, shape (p,)
        chi squared of each image, what noise alone gives, and its variance.
    norm : float
        ``sum w S^2 / m``.
    in_rings : ndarray of float64
        kappa in each of the `Rings` round the stars; 0 where it is not told from noise.
    """

    squares: Array
    expected: Array
    variances: Array
    norm: float
    in_rings: Array

    @property
    def excess(self) -> Array:
        """Chi squared of each image over its expectation, shape (p,)."""
        return self.squares - self.expected

    @property
    def reduced(self) -> float:
        """Chi squared over its expectation: 1 where there is noise alone."""
        expected = float(self.expected.sum())
        return float(self.squares.sum()) / expected if expected else 1.0

    @property
    def significance(self) -> float:
        """The excess of chi squared in standard deviations of noise."""
        return float(self.excess.sum()) / self._deviation if self._deviation else 0.0

    @property
    def is_doubtful(self) -> bool:
        """Whether a mend is worth a trial: the excess is significant, or three and kappa large."""
        return self.is_significant or (self.significance > DOUBTFUL and self.kappa > LARGE)

    @property
    def is_significant(self) -> bool:
        """Whether the excess is more than noise has, by five standard deviations."""
        return self.significance > SIGNIFICANT

    @property
    def kappa(self) -> float:
        """The relative error of the PSFs that the excess shows."""
        return _kappa(float(self.excess.sum()), self.norm)

    @property
    def hidden(self) -> float:
        """The relative error of PSFs whose excess is one standard deviation of noise."""
        return _kappa(self._deviation, self.norm)

    @property
    def _deviation(self) -> float:
        return math.sqrt(float(self.variances.sum()))


def measure_misfit(estimate: Estimate, model: Model, settled: Estimate) -> PsfMisfit:
    """Return how far the images of a scene are from their models at its stars.

    Parameters
    ----------
    estimate : Estimate
        What is modelled, and how bright it is.
    model : Model
        Of the scene.
    settled : Estimate
        That whose residuals are looked at: the estimate, or a near one that fits better
        (`lnocl.core.solvers.psf_fit.settle`).
    """
    scene, fluxes = estimate.scene, estimate.fluxes
    inside = tuple(map(slice, scene.observation.shape))
    means = model.images(estimate.extended, fluxes)
    found = model.forward(settled.extended) + model.background
    of_images, parts = list[tuple[float, ...]](), list[tuple[Array, ...]]()
    images = zip(
        scene.images(),
        model.starlight(_of_stars(estimate)),
        model.starlight(settled.fluxes),
        model.weights,
        strict=True,
    )
    for j, (counts, light, settled_light, weights) in enumerate(images):
        seen = weights[inside] > 0
        electrons = scene.scale * weights[inside][seen]
        total = np.maximum(means[j][inside][seen], MIN_MODEL)
        # Pixels where PSFs are negative show nothing.
        share = (light[inside][seen] / total).clip(0.0, 1.0)
        squared = np.where(share > DOMINANT, share**2, 0.0)
        residuals = electrons * (counts - found[j] - settled_light)[inside][seen]
        total *= electrons
        weight = squared * total / (total + 0.5)
        left = weight * residuals**2 / total
        rings = Rings(scene.observation.shape, scene.star_field.places[j])
        variance = weight**2 * (2.0 + 1.0 / total)
        of_images.append(tuple(map(np.sum, (left, weight, variance))))
        parts.append((rings.number[seen], left - weight, variance, weight * squared * total))
    number, excess, variance, norm = (np.concatenate(each) for each in zip(*parts, strict=True))
    sums = [np.bincount(number, each) for each in (excess, variance, norm)]
    in_rings = [
        _kappa(e, n) if e > SIGNIFICANT_IN_RING * math.sqrt(v) else 0.0
        for e, v, n in zip(*sums, strict=True)
    ]
    squares, expected, variances = np.transpose(of_images)
    return PsfMisfit(squares, expected, variances, float(norm.sum()), np.array(in_rings))


def smoothing_near_stars(
    estimate: Estimate, model: Model, in_rings: Array, strength: float
) -> Array:
    r"""Return the weight of the edge-preserving term that PSFs of such errors ask for.

    It is `strength` times the standard deviation of the gradient of the data term by the error of
    the PSFs,

    .. math:: \sqrt{\textstyle\sum_j (A_j^2)^T (\kappa S_j / m_j)^2},

    with the squares of the elements of A_j, and for m_j the counts, or stars and background where
    these are more. Where a star does not dominate, it is next to 0.

    Parameters
    ----------
    estimate : Estimate
        What is modelled, and how bright its stars are.
    model : Model
        Of the scene.
    in_rings : ndarray of float64
        kappa in each of the `Rings` round the stars; beyond the last it is that of the last.
    strength : float
        Standard deviations.

    Returns
    -------
    ndarray of float64, of the shape of the extended source
        For `lnocl.core.scene.penalty.Penalty.near_stars`.
    """
    scene = estimate.scene
    ny, nx = scene.observation.shape
    variance = np.zeros(scene.grid)
    images = zip(scene.images(), model.starlight(_of_stars(estimate)), strict=True)
    for j, (counts, light) in enumerate(images):
        background = np.broadcast_to(model.background[j], light.shape)
        total = np.maximum(np.maximum(counts, light + background), MIN_MODEL)
        number = Rings((ny, nx), scene.star_field.places[j]).number
        kappa = enlarged(in_rings[np.minimum(number, len(in_rings) - 1)], light.shape)
        share = (light / total).clip(0.0)
        relative = model.weights[j] * kappa * share
        variance += model.cameras[j].squares(relative**2)
    ny, nx = scene.observation.sky_shape
    deviation = np.sqrt(np.maximum(variance[:ny, :nx], 0.0))
    return np.asarray(strength * deviation)


def _of_stars(estimate: Estimate) -> Array:
    """Return the fluxes, scaled, but 0 for those that the PSFs of the images do not show."""
    return np.where(estimate.scene.through_psfs, estimate.fluxes, 0.0)


def _kappa(excess: float, norm: float) -> float:
    return math.sqrt(max(excess, 0.0) / norm) if norm > 0 else 0.0
