r"""Light of the extended source without the bias of its estimate.

An estimate that is positive and starts flat holds light where there is none, and lacks it where it
is smoother than the sky. What it lacks or has too much is in the residuals. They are seen back in
the sky and added to it,

.. math:: \tilde f = f + \frac{\sum_j A_j^T w_j (g_j - m_j) / A_j 1}{\sum_j A_j^T w_j},

which may be negative. Its sum over a region larger than the resolution is nearly that of the sky,
whatever f is: the counts less background and stars, where the PSFs leave the light in the region.
The noise of the sum over shares q of pixels is that of counts alone,

.. math:: \sum_j \Big\langle \Big( \frac{w_j}{A_j 1} A_j \frac{q}{\sum_i A_i^T w_i} \Big)^2,
    \operatorname{var} g_j \Big\rangle.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import cast

import numpy as np
from numpy.typing import NDArray

from lnocl.core.scene.arrays import Array
from lnocl.core.scene.camera import adjoints_of, images_of, is_flat
from lnocl.core.scene.components import Mixing
from lnocl.core.scene.detector import on_sky, psfs_on_detector
from lnocl.core.scene.estimate import Estimate
from lnocl.core.scene.forward_model import Model
from lnocl.core.scene.observation import Observation
from lnocl.core.scene.transforms import enlarged
from lnocl.core.solvers.levels import Levels

# A pseudo-inverse holds this, relatively, for 0.
NOTHING = 1e-9
# A pixel is well seen of whose light good pixels have this share of what they have of the best one:
# in the corner of an image a quarter is left.
SEEN = 0.2


class Light:
    """The light of an extended source, and the noise of its sums.

    Parameters
    ----------
    estimate : Estimate
        What is modelled, and how bright it is.
    levels : Levels, optional
        Those of the background, where they are not known.
    """

    def __init__(self, estimate: Estimate, levels: Levels | None = None) -> None:
        self._estimate, self._levels = estimate, levels
        self._scene = scene = estimate.scene
        self._map = Model(scene)
        total = self._map.adjoint(self._map.weights)
        if is_flat(total):
            self._per_weight = np.broadcast_to(1.0 / total[:1, :1], total.shape)
        else:
            observed = scene.observed(total)
            self._per_weight = np.divide(1.0, total, out=np.zeros(scene.grid), where=observed)

    @property
    def observed(self) -> NDArray[np.bool_]:
        """Where an image sees the sky well, shape (ny, nx)."""
        ny, nx = self._scene.observation.sky_shape
        if is_flat(self._per_weight):
            return np.ones((ny, nx), bool)
        found = np.zeros((ny, nx), bool)
        for camera, weights in zip(self._map.cameras, self._map.weights, strict=True):
            seen = adjoints_of([camera], [(weights > 0) * 1.0], np.ones((1, 1)))[0]
            found |= seen[:ny, :nx] > SEEN * seen.max()
        return found

    def _left(self) -> Iterator[Array]:
        """Yield ``(g_j - m_j) / A_j 1``, scaled."""
        each = zip(self._scene.images(), self._estimate.models(), self._map.of_ones, strict=True)
        for image, model, ones in each:
            image -= model
            yield _over(image, ones)

    def sky(self) -> Array:
        r"""Return :math:`\tilde f`, electrons per pixel, shape (ny, nx) of the observed sky."""
        scene, (ny, nx) = self._scene, self._scene.observation.sky_shape
        left = (w * each for w, each in zip(self._map.weights, self._left(), strict=True))
        change = self._map.adjoint(left) * self._per_weight * scene.unit
        return np.asarray((self._estimate.sky + change)[:ny, :nx])

    def flux(self, shares: Array, star_flux_errors: Array) -> tuple[float, float]:
        """Return the sum of `sky` times shares of its pixels, and its standard error, electrons.

        What stars are in error there the extended source is too, with the other sign. The photons
        of a star, which scatter its flux and the sum alike, have no part in it. A halo is in error
        by the share of it that the sum takes for light of the sky, and so is a level of the
        background (`lnocl.core.solvers.levels`).

        Parameters
        ----------
        shares : ndarray of float64, shape (ny, nx)
            The share of each pixel of the observed sky that is summed.
        star_flux_errors : ndarray of float64, shape (n_fluxes,)
            Standard errors of the stars and halos, electrons.
        """
        scene, (ny, nx) = self._scene, shares.shape
        inside, star_fluxes = self._inside(shares), self._estimate.fluxes
        errors = np.where(scene.is_shown, star_flux_errors, 0.0)
        of_counts, variances = 0.0, np.zeros(3)  # of the background, of all but stars, of stars
        factors = list(self._factors(shares))
        for j, (factor, image) in enumerate(zip(factors, scene.images(), strict=True)):
            stars = scene.star_field.light(j, np.where(inside, star_fluxes, 0.0))
            image -= stars
            for k in range(scene.n_stars + j, scene.n_fluxes, scene.n_images):
                halo = scene.star_cutout(j, k)
                errors[k] *= np.vdot(factor[halo.window(factor.shape)], halo.values)
            # A count estimates its variance; both are per relative exposure, which is the weight.
            noise = _quotient(factor, self._map.weights[j])
            background = np.broadcast_to(self._map.background[j], image.shape)
            parts = background, image, stars
            variances += [np.einsum("yx,yx,yx", noise, factor, each) for each in parts]
            image -= background
            if not inside.all():
                image -= scene.star_field.light(j, np.where(inside, 0.0, star_fluxes))
            of_counts += float(np.einsum("yx,yx", factor, image))
        of_sky = np.einsum("yx,yx", shares, self._estimate.sky[:ny, :nx])
        of_sky -= np.einsum("yx,yx", self._map.adjoint(factors), self._estimate.sky)
        least, rest, photons = variances * scene.unit**2 / scene.scale
        of_stars = (errors[inside] ** 2).sum() - photons
        of_levels = 0.0 if self._levels is None else self._levels.variance(factors) * scene.unit**2
        error = np.sqrt(max(max(rest, least) + of_levels, 0.0) + max(of_stars, 0.0))
        return float(of_sky + of_counts * scene.unit), float(error)

    def _factors(self, shares: Array) -> Iterator[Array]:
        """Yield what each count is multiplied by in a sum over shares q of pixels.

        It is ``w_j A_j (q / sum_i A_i^T w_i) / A_j 1``, as the sum of `sky` is, turned round, that
        of q f less the light of f in the counts, and more the counts.
        """
        laid = enlarged(shares, self._scene.grid) * self._per_weight
        for weights, seen, ones in zip(
            self._map.weights, images_of(self._map.cameras, laid), self._map.of_ones, strict=True
        ):
            if is_flat(seen) and is_flat(weights) and isinstance(ones, float):
                value = np.array(weights[0, 0] * seen[0, 0] / ones)
                yield np.broadcast_to(value, seen.shape)
            else:
                yield _over(weights * seen, ones)

    def _inside(self, shares: Array) -> NDArray[np.bool_]:
        """Return which stars lie in pixels that are summed, as all halos are taken to."""
        (ny, nx), scene = shares.shape, self._scene
        x, y = np.floor(on_sky(scene.stars, scene.oversample) + 0.5).astype(int).T
        inside = (x >= 0) & (x < nx) & (y >= 0) & (y < ny)
        inside[inside] = shares[y[inside], x[inside]] > 0
        return np.append(inside, np.ones(scene.n_halos, bool))


class LightOfComponents:
    r"""The light of several skies, from that of what each filter shows.

    With U the pseudo-inverse of the filters' weights w, and F_g the light of the sky that filter g
    shows,

    .. math:: F_k = \sum_g U_{kg} F_g, \qquad \operatorname{cov}(F_k, F_l) =
        \sum_g U_{kg} U_{lg} \left[ \operatorname{var} F_g
        + \sum_m F_m^2 \operatorname{var} w_{gm} \right].

    Parameters
    ----------
    estimate : Estimate
        What is modelled.
    lights : sequence of Light
        That of each of its parts.
    """

    def __init__(self, estimate: Estimate, lights: Sequence[Light]) -> None:
        self._estimate, self._lights = estimate, lights
        self._mixing = cast(Mixing, estimate.scene.mixing)

    def sky(self) -> Array:
        """Return the skies, electrons per pixel, shape (K, ny, nx)."""
        pairs = zip(self._lights, self._estimate.parts, strict=True)
        left = [light.sky() - part.estimate.observed_sky for light, part in pairs]
        return self._estimate.observed_sky + self._mixing.components(left)

    def flux(self, shares: Array, star_flux_errors: Array) -> tuple[Array, Array]:
        """Return that of `Light.flux` of each sky, shapes (K,), where filters tell it."""
        fluxes, covariance = self.covariance(shares, star_flux_errors)
        return fluxes, np.sqrt(np.diag(covariance))

    def covariance(self, shares: Array, star_flux_errors: Array) -> tuple[Array, Array]:
        """Return the sums of `Light.flux` of each sky, (K,), and their covariances, (K, K)."""
        found = fluxes_of_filters(self._estimate, self._lights, shares, star_flux_errors)
        return of_components(self._estimate.scene.observation, *found.T)


def fluxes_of_filters(
    estimate: Estimate, lights: Sequence[Light], shares: Array, star_flux_errors: Array
) -> Array:
    """Return that of `Light.flux` of what each filter shows, shape (G, 2), where they tell skies.

    What one filter alone shows tells no component.
    """
    if (mixing := estimate.scene.mixing) is not None:
        shares = shares * mixing.told_by(np.array([light.observed for light in lights]))
    pairs = zip(lights, estimate.parts, strict=True)
    return np.array([light.flux(shares, star_flux_errors[part.fluxes]) for light, part in pairs])


def of_components(observation: Observation, sums: Array, errors: Array) -> tuple[Array, Array]:
    """Return that of `LightOfComponents.covariance` for sums of what each filter shows, (G,).

    Where there is one sky it is its own.
    """
    mixing = observation.mixing
    if mixing is None:
        return sums, np.diag(errors**2)
    fluxes, each = mixing.undone @ sums, observation.component_errors
    most = [each[images].max(axis=0) for images in mixing.images]
    of_weights = np.square(most) @ fluxes**2
    return fluxes, mixing.undone * (errors**2 + of_weights) @ mixing.undone.T


def pixel_noise(estimate: Estimate) -> Array:
    r"""Return the noise of each sky by the counts that it is seen in, electrons, (K, ny, nx).

    It is that of the light of a pixel as the mean over the area of the PSFs; NaN where none is
    seen. With U the pseudo-inverse of the weights of filters g, its square is

    .. math:: \sum_g U_{kg}^2 \Big/ \sum_{j \in g} A_j^T \frac{e_j}{m_j \sum K_j^2}.
    """
    observation = estimate.scene.observation
    ny, nx = observation.sky_shape
    areas = 1.0 / (psfs_on_detector(observation) ** 2).sum(axis=(1, 2))
    variances = []
    for part in estimate.parts:
        scene, models = part.estimate.scene, part.estimate.models()
        model = Model(scene)
        pairs = zip(areas[list(part.images)], model.weights, models, strict=True)
        told = model.adjoint(
            np.divide(area * weights, each, out=np.zeros(each.shape), where=each > 0)
            for area, weights, each in pairs
        )
        is_seen = scene.observed(told)[:ny, :nx] & (told[:ny, :nx] > 0)
        told = told[:ny, :nx] * (scene.scale / scene.unit**2)
        variances.append(np.divide(1.0, told, out=np.full((ny, nx), np.nan), where=is_seen))
    undone = np.ones((1, 1)) if observation.mixing is None else observation.mixing.undone
    squares = undone**2 * (abs(undone) > NOTHING * abs(undone).max())
    terms = (
        (square * of for square, of in zip(row, variances, strict=True) if square)
        for row in squares
    )
    noise = np.sqrt([sum(each) for each in terms])
    return np.asarray(noise / observation.oversample**2)


def _over(image: Array, ones: Array | float) -> Array:
    """Return an image over that of a sky of ones; 0 where that is dark."""
    if isinstance(ones, float):
        image /= ones
        return image
    return np.divide(image, ones, out=np.zeros_like(image), where=ones > 0)


def _quotient(factor: Array, weights: Array) -> Array:
    """Return a factor over weights, 0 where these are."""
    if is_flat(weights) and weights[0, 0] > 0:
        return factor / weights[0, 0] if weights[0, 0] != 1.0 else factor
    return np.divide(factor, weights, out=np.zeros(factor.shape), where=weights > 0)
