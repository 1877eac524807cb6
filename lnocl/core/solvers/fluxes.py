"""The likelihood of stars where the extended source is known, and their most likely fluxes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import reduce
from operator import add

import numpy as np
from numpy.typing import NDArray

from lnocl.core.scene.arrays import Array
from lnocl.core.scene.band_matrix import MOST_FADING, BandMatrix, bounded_step
from lnocl.core.scene.forward_model import Model
from lnocl.core.scene.scene import MIN_MODEL, Scene
from lnocl.core.scene.stars import Pixels, StarImages

# A star's flux falls to this share at most in one step.
MAX_FADING = 1.0 - MOST_FADING
# The fit of the fluxes ends where they change by less of their standard error.
FIT_CHANGE = 1e-6
FIT_ROUNDS = 50
# Rounding of the information, relative to its diagonal: a combination of unknowns with less is not
# determined, and the unknowns that have more than this share in it are not either.
UNDETERMINED = 1e-12
UNDETERMINED_SHARE = 1e-4
# A larger relative change of the model in any pixel has the information computed anew.
INFORMATION_CHANGE = 0.01


class StarLikelihood:
    """J_0 as a function of the stars, over the pixels that they may light.

    ``J_0 = sum_j <w_j, m_j - g_j ln m_j>`` but for a constant,
    ``m_j = A_j f + sum_s c_s P_js + b_j``. Its Fisher information is
    ``F = sum_j <D_j, w_j D_j / m_j>``, D the derivatives of the m_j.

    Parameters
    ----------
    images : list of three ndarray of float64, length p
        For each image the g_j, the ``A_j f + b_j`` and the w_j of these pixels, in one dimension.
    """

    def __init__(self, images: list[tuple[Array, Array, Array]]) -> None:
        self._images = images

    @classmethod
    def of_scene(
        cls, scene: Scene, model: Model, diffuse: Array, covered: Sequence[NDArray[np.bool_]]
    ) -> StarLikelihood:
        """Return the likelihood of a scene and its model, over the pixels that are covered.

        `diffuse` holds the ``A_j f + b_j``, shape (p, Ny, Nx).
        """
        images = []
        for where, *arrays in zip(covered, scene.images(), diffuse, model.weights, strict=True):
            g, known, w = (array.ravel() if where.all() else array[where] for array in arrays)
            images.append((g, known, w))
        return cls(images)

    def of_one(self, pixels: Sequence[Pixels], others: Sequence[Array]) -> StarLikelihood:
        """Return the likelihood of one star over its pixels, with the light of others held.

        Parameters
        ----------
        pixels : sequence of pixels, length p
            Of those that this likelihood is over.
        others : sequence of ndarray of float64, length p
            The light of the other stars there.
        """
        return StarLikelihood(
            [
                (image[there], diffuse[there] + light, weights[there])
                for (image, diffuse, weights), there, light in zip(
                    self._images, pixels, others, strict=True
                )
            ]
        )

    def models(self, lights: Iterable[Array]) -> list[Array]:
        """Return the m_j for the light of the stars, not below the guard of divisions."""
        return [
            np.maximum(light + diffuse, MIN_MODEL)
            for (_, diffuse, _), light in zip(self._images, lights, strict=True)
        ]

    def objective(self, models: Sequence[Array]) -> float:
        """Return J_0 over these pixels, but for a constant."""
        return sum(
            float(weights @ (model - image * np.log(model)))
            for (image, _, weights), model in zip(self._images, models, strict=True)
        )

    def gradient(self, stars: Sequence[StarImages], models: Sequence[Array]) -> Array:
        """Return the gradient in the k unknowns of each star, shape (k, n)."""
        gradients = [
            there.products(movable_weights(weights, model) * (1.0 - image / model))
            for (image, _, weights), there, model in zip(self._images, stars, models, strict=True)
        ]
        return np.sum(gradients, axis=0)

    def information(self, stars: Sequence[StarImages], models: Sequence[Array]) -> BandMatrix:
        """Return the Fisher information of the k n unknowns."""
        return reduce(
            add,
            (
                there.information(movable_weights(weights, model) / model)
                for (_, _, weights), there, model in zip(self._images, stars, models, strict=True)
            ),
        )

    def linear_flux(self, lights: Sequence[Array]) -> float:
        """Return the flux of one star of these images by least squares, weighted by the counts."""
        moment = norm = 0.0
        for (image, diffuse, weights), light in zip(self._images, lights, strict=True):
            weighted = weights * light / np.maximum(np.maximum(image, diffuse), MIN_MODEL)
            norm += float(weighted @ light)
            moment += float(weighted @ (image - diffuse))
        return moment / norm if norm > 0 else 0.0


def movable_weights(weights: Array, model: Array) -> Array:
    """Return weights without the pixels where the model is the guard: no star moves it there.

    PSFs with negative pixels make it so; one such pixel would have all of the information.
    """
    return np.where(model > MIN_MODEL, weights, 0.0)


def precision(scene: Scene, model: Array, weights: Array) -> Array:
    """Return one over the variances of the pixels of an image, scaled; 0 at the guard."""
    return scene.scale * movable_weights(weights, model) / np.maximum(model, MIN_MODEL)


def fit_fluxes(scene: Scene, model: Model, diffuse: Array, fluxes: Array) -> Array:
    """Return the star fluxes that minimise J_0, by Fisher scoring from these."""
    if not len(fluxes):
        return fluxes
    covered = [scene.star_field.covered(j) for j in range(scene.n_images)]
    likelihood = StarLikelihood.of_scene(scene, model, diffuse, covered)
    stars = [scene.star_field.images(j, where) for j, where in enumerate(covered)]
    used = list[Array]()
    for _ in range(FIT_ROUNDS):
        models = likelihood.models([each.light(fluxes) for each in stars])
        if differ(models, used):
            information, used = likelihood.information(stars, models), models
        step = best_step(information, likelihood.gradient(stars, models)[0], fluxes)
        fluxes = fluxes + step
        if (abs(step) * np.sqrt(information.diagonal) <= FIT_CHANGE).all():
            break
    return fluxes


def differ(models: Sequence[Array], used: Sequence[Array]) -> bool:
    """Return whether models are so far from those that an information is of, if any."""
    pairs = zip(models, used, strict=False)
    return not used or any((abs(m - u) > INFORMATION_CHANGE * u).any() for m, u in pairs)


def variances(information: Array) -> Array:
    """Return the diagonal of the inverse of the information.

    It is infinite for unknowns without information, and NaN for those that the others can stand in
    for to within rounding, such as the fluxes of two stars at one place.
    """
    diagonal = np.diag(information)
    is_known = diagonal > 0
    roots = np.sqrt(np.where(is_known, diagonal, 1.0))
    values, vectors = np.linalg.eigh(information / roots / roots[:, None])
    is_lost = values < UNDETERMINED
    is_blended = (vectors[:, is_lost] ** 2).sum(axis=1) > UNDETERMINED_SHARE**2
    sums = (vectors[:, ~is_lost] ** 2 / values[~is_lost]).sum(axis=1)
    return np.where(is_known, np.where(is_blended, np.nan, sums / roots**2), np.inf)


def best_step(information: BandMatrix, gradient: Array, fluxes: Array) -> Array:
    """Return the change of the fluxes by Newton's method, none falling by more than nine tenths.

    Where one would, it is that of `lnocl.core.scene.band_matrix.bounded_step`, as in iterations.
    """
    step = -information.solve(gradient)
    if (step >= -MOST_FADING * fluxes).all():
        return step
    return bounded_step(information.solve(np.eye(len(fluxes))), gradient, fluxes)
