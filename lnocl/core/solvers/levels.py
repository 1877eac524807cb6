r"""The level of the sky in each image, fitted with the rest, and what its error adds to others.

A level that was measured is known to its error. It is taken for the prior of a halo that is flat
and of either sign, beside two that rise by one across the image along x and y: gradients of the sky
are of the order of the noise of a pixel at most. With J_j these shapes, the least squares are

.. math::
    \sum_j \| P_j^{1/2} (g_j - s_j - b_j - J_j \eta_j - a W_j) \|^2
    + \sum_j \eta_j^T \Pi_j \eta_j + (a / \alpha)^2,

over pixels that are dark: where the extended source, for which the level may stand, is not
significant. There stars and halos s_j and the background b_j are all that is known. One over P_j is
the variance of these counts, larger by what PSFs may have wrong near stars.

Sources have wings below the noise, which all together raise the level. So the light of W_j, which
is that of pixels that are not dark, spread over some resolutions, is one more unknown, of any
amount a, of the order of alpha.

The estimate is linear in the counts. A sum of counts less levels, with share q_j of each count, has
the shares ``s_j = J_j q_j`` of the levels. With the covariance C of all unknowns its variance is
that of the counts, and

.. math:: s^T C \, (s - 2 \sum_j (J_j, W_j)^T d_j q_j),

d_j being 1 where a pixel is dark: there counts that are high raise both.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import copy

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, maximum_filter

from lnocl.core.scene.arrays import Array, together
from lnocl.core.scene.counts import means
from lnocl.core.scene.estimate import Estimate
from lnocl.core.scene.forward_model import Model
from lnocl.core.scene.observation import Observation
from lnocl.core.scene.scene import MIN_MODEL, Scene
from lnocl.core.scene.texture import resolution
from lnocl.core.scene.view import View, planes
from lnocl.core.solvers.halos import without

# Smoothed over so many resolutions, the extended source is lit where it is so many times the noise
# above the darkest pixels, and so many resolutions round it.
SMOOTHED, SIGNIFICANT, DARKEST, ROUND = 0.85, 4.0, 0.2, 1.0
# Wings reach over so many resolutions, and hold about this share of the light.
WINGS, SHARE = 4.0, 0.3
# Relative error of the light of stars that is taken for noise.
PSF_ERROR = 0.03


class Levels:
    """The least squares of the levels near an estimate.

    Parameters
    ----------
    estimate : Estimate
        What is modelled, and how bright it is.
    are_fitted : bool
        Whether they are fitted, or else have the errors that they were given with.

    Attributes
    ----------
    change : ndarray of float64, shape (p, 3)
        To add to the background of each image, electrons per pixel: in its middle, and across it
        along x and y. It is 0 where the level is known.
    errors : ndarray of float64, shape (p, 3)
        Their standard errors.
    """

    def __init__(self, estimate: Estimate, are_fitted: bool = True) -> None:
        self._scene = scene = estimate.scene
        self._prior = scene.observation.background_error / scene.scale
        self._free = np.flatnonzero(self._prior)
        # The unknowns are three of each image, and the amount of the wings.
        n = 3 * len(self._free)
        self._places = {
            j: np.append(3 * k + np.arange(3), n) for k, j in enumerate(self._free.tolist())
        }
        self._held: dict[int, tuple[Array, Array]] = {}  # the dark pixels, and the wings
        found, measured = np.zeros((2, n + 1))
        measured[:n:3] = self._prior[self._free] ** 2
        self._covariance = np.diag(measured)
        if are_fitted:
            found, self._covariance = self._fit(estimate.extended, estimate.fluxes)
        deviations = np.sqrt(np.diag(self._covariance))
        self.change, self.errors = np.zeros((2, scene.n_images, 3))
        self.change[self._free] = scene.scale * found[:n].reshape(-1, 3)
        self.errors[self._free] = scene.scale * deviations[:n].reshape(-1, 3)

    def _fit(self, extended: Array, fluxes: Array) -> tuple[Array, Array]:
        """Return the unknowns near an estimate, scaled, and their covariance."""
        scene, model = self._scene, Model(self._scene)
        moments = np.zeros(3 * len(self._places) + 1)
        information = np.zeros((len(moments),) * 2)
        information[-1, -1] = SHARE**-2
        arrays = zip(
            scene.images(), model.forward(extended), model.starlight(fluxes), model.background,
            model.weights, strict=True,
        )  # fmt: skip
        for j, (counts, light, stars, background, weights) in enumerate(arrays):
            if j not in self._places:
                continue
            shapes, at = View(scene, j).levels, self._places[j]
            information[at[:3], at[:3]] += self._prior[j] ** -2
            seen = weights > 0
            if not seen.any():
                continue
            # Without the extended source: it follows the noise, which may not choose the weights.
            known = stars + background
            precision = scene.scale * weights / np.maximum(known, MIN_MODEL)
            is_lit = _lit(scene, j, light, precision)
            wings = gaussian_filter(
                np.where(is_lit, light, 0.0), WINGS * _width(scene, j), mode="constant"
            )
            noise = 1.0 / (1.0 + precision * (PSF_ERROR * stars) ** 2)
            self._held[j] = dark, _ = np.where(is_lit | (weights == 0), 0.0, noise), wings
            shapes = np.append(shapes, wings[None], axis=0)
            weighted = shapes * (dark * precision)
            information[np.ix_(at, at)] += np.einsum("iyx,kyx->ik", weighted, shapes)
            moments[at] += np.einsum("iyx,yx->i", weighted, counts - known)
            # Of counts, in place of the prior of the level.
            steep = np.median(precision[seen] / weights[seen] ** 2) - self._prior[j] ** -2
            information[at[1:3], at[1:3]] += steep
        unit = 1.0 / np.sqrt(np.diag(information))
        covariance = np.linalg.inv(information * unit * unit[:, None]) * unit * unit[:, None]
        return covariance @ moments, covariance

    def variance(self, factors: Sequence[Array]) -> float:
        """Return what levels add to the variance of a sum of counts, scaled; it may be negative.

        Parameters
        ----------
        factors : sequence of ndarray of float64, shape (ny, nx)
            The share of each count of each image in the sum.
        """
        beside = np.zeros(len(self._covariance))
        shares = np.zeros((self._scene.n_images, 3))
        for j, at in self._places.items():
            shapes = View(self._scene, j).levels
            shares[j] = np.einsum("iyx,yx->i", shapes, factors[j])
            if j in self._held:
                dark, wings = self._held[j]
                shapes = np.append(shapes, wings[None], axis=0)
                beside[at] += np.einsum("iyx,yx,yx->i", shapes, dark, factors[j])
        laid = self._laid(shares)
        return float(laid @ self._covariance @ (laid - 2.0 * beside))

    def covariance_of(self, shares: Sequence[Array]) -> Array:
        """Return the covariance of sums of shares (p, 3) of the levels, scaled."""
        laid = np.reshape(list(map(self._laid, shares)), (len(shares), len(self._covariance)))
        return np.asarray(laid @ self._covariance @ laid.T)

    def _laid(self, shares: Array) -> Array:
        return np.append(shares[self._free], 0.0)  # nothing of the wings


def fit_levels(estimate: Estimate) -> Estimate:
    """Return the estimate with levels as they are fitted, and the extended source beside them.

    Parameters
    ----------
    estimate : Estimate
        Its extended source is zero or more.
    """
    scene, change = estimate.scene, Levels(estimate).change
    other = copy(scene)
    other.observation = with_levels(scene.observation, change)
    sky = without(estimate, Model(scene), lights(scene, change))
    return Estimate(other, sky, estimate.star_fluxes)


def with_levels(observation: Observation, change: Array) -> Observation:
    """Return an observation with other levels of its background, which stays 0 or more."""
    rows, columns = (np.arange(n) for n in observation.shape)
    added = np.einsum("ji,iyx->jyx", change, planes(observation, rows[:, None], columns))
    background = np.add(*together(observation.background, added))
    return observation.replace(background=np.maximum(background, 0.0))


def lights(scene: Scene, change: Array) -> Iterator[Array]:
    """Yield the change of the model of each image by other levels, scaled, on the grid."""
    for j, each in enumerate(change / scene.scale):
        yield np.einsum("i,iyx->yx", each, View(scene, j).levels)


def _depths(scene: Scene) -> Array:
    """Return the information of each image on the light of a pixel of it, of any unit."""
    exposures, levels = (
        np.maximum(means(each, scene.observation.mask), MIN_MODEL)
        for each in (scene.observation.exposure, scene.observation.background)
    )
    return np.asarray(exposures**2 / levels)


def _width(scene: Scene, j: int) -> float:
    """Return the resolution, pixels of image j."""
    return float(resolution(scene) / np.sqrt(scene.areas[j]))


def _lit(scene: Scene, j: int, light: Array, precision: Array) -> NDArray[np.bool_]:
    """Return which pixels of an image the extended source lights, by what all images tell."""
    width, seen = _width(scene, j), precision > 0
    smooth = gaussian_filter(light, SMOOTHED * width, mode="nearest")
    area = 4.0 * np.pi * (SMOOTHED * width) ** 2 * _depths(scene).sum() / _depths(scene)[j]
    least = SIGNIFICANT / np.sqrt(np.where(seen, area * precision, np.inf))
    is_lit = seen & (smooth - np.quantile(smooth[seen], DARKEST) > least)
    return np.asarray(maximum_filter(is_lit, 2 * int(np.ceil(ROUND * width)) + 1))
