"""The scaling of the scaled gradient projection method, made from a scene and where it starts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from lnocl.scene.forward_model import Model
from lnocl.scene.observation import Array
from lnocl.scene.scene import LEAST_MODEL, Scene
from lnocl.scene.shifting import Stamp

# What a pixel sees of star and background shifts its scaling by this share. With all of it the
# empty sky takes up noise from the first steps on, without any it is stuck where it is 0: measured
# in docs/sgp.md.
SHIFT = 0.1
# Of the images' mean: what a pixel is taken to see at least.
MIN_BACKGROUND = 2.0**-20

# A star's flux falls to this share at most in one step, so that it never reaches 0 by a step that
# was too long.
MOST_FADING = 0.1
# The fit of the star fluxes ends where they change by less of their standard error.
FIT_CHANGE = 1e-6
FIT_ROUNDS = 50
# What the fluxes changed by, relatively, for their information to be taken anew.
INFORMATION_CHANGE = 0.01


@dataclass(frozen=True)
class Scaling:
    """What steps of the extended source and of the star fluxes are measured with.

    Attributes
    ----------
    shift : ndarray of float64, shape (Ny, Nx)
        z in the scaling ``D = (f + z) / (alpha + mu (f + z))``, ``alpha = sum_j A_j^T w_j``: a
        share of ``alpha / sum_j A_j^T (w_j / (sum_s c_s P_js + b_j))``, what the pixel sees of
        stars and background.
    star_information : ndarray of float64, shape (n, n)
        Fisher information of the star fluxes, ``sum_j <P_js, w_j P_jt / m_j>`` at the start.
    cross_information : list of Stamp
        Fisher information between each star flux and the extended source,
        ``sum_j A_j^T (w_j P_js / m_j)`` at the start.
    """

    shift: Array
    star_information: Array
    cross_information: list[Stamp]

    def star_step(self, fluxes: Array, gradient: Array, coupling: Array) -> Array:
        """Return the change of the star fluxes that follows a step d of the extended source.

        ``-F^-1 (gradient + <cross_information, d>)``: to the fluxes that are best where the step
        leads, to second order, with the information F of the start; none falls by more than nine
        tenths.
        """
        return _star_step(self.star_information, self._inverse, gradient + coupling, fluxes)

    @cached_property
    def _inverse(self) -> NDArray:
        return _inverse(self.star_information)


def _inverse(information: Array) -> NDArray:
    """Return the inverse; of a star that is told from no other, the pseudo-inverse."""
    return np.linalg.pinv(information, hermitian=True)


def _star_step(information: Array, inverse: NDArray, gradient: Array, fluxes: Array) -> Array:
    """Return the change of the fluxes by Newton's method, none falling by more than nine tenths.

    Where it would, the others are those that are best with it held there: the step minimises
    ``<gradient, step> + <step, F step> / 2`` within those bounds, so that it never leads uphill.
    """
    least = (MOST_FADING - 1.0) * fluxes
    step = -inverse @ gradient
    if (step >= least).all():
        return step
    import scipy.optimize  # half a second, for what is seldom needed

    values, vectors = np.linalg.eigh(information)
    kept = values > values.max() * len(fluxes) * np.finfo(np.float64).eps
    root = np.sqrt(values[kept])
    matrix = root[:, None] * vectors[:, kept].T
    target = -(vectors[:, kept].T @ gradient) / root
    return least + scipy.optimize.nnls(matrix, target - matrix @ least)[0]


def prepare(
    scene: Scene, model: Model, extended: Array, star_fluxes: Array
) -> tuple[Array, Scaling]:
    """Return the star fluxes that are best for this extended source, and the scaling of steps.

    The fluxes minimise ``J`` for the extended source as given, whatever fluxes they are sought
    from; so the answer does not hang on those.

    Parameters
    ----------
    scene : Scene
        What is modelled.
    model : Model
        Of the scene.
    extended : ndarray of float64, shape (Ny, Nx)
        Extended source to start from, on the grid and scaled; where it was not observed it is 0.
    star_fluxes : ndarray of float64, shape (n,)
        Where the fluxes are sought from, scaled.
    """
    total_weight = model.adjoint(model.weights)
    observed = np.where(scene.observed(total_weight), extended, 0.0)
    diffuse = model.images(observed, np.zeros_like(star_fluxes))
    fluxes = _fit_stars(model, scene.images(), diffuse, star_fluxes)
    return fluxes, _make_scaling(scene, model, total_weight, diffuse, fluxes)


def _fit_stars(model: Model, images: Array, diffuse: Array, star_fluxes: Array) -> Array:
    """Return the star fluxes that minimise J, by Fisher scoring over the pixels that they light."""
    lit = []
    for arrays, stars in zip(
        zip(images, diffuse, model.weights, strict=True), model.stars, strict=True
    ):
        pixels, stars_there = stars.on_lit_pixels()
        lit.append((*(array.ravel()[pixels] for array in arrays), stars_there))
    n = len(star_fluxes)
    fluxes, step = star_fluxes, np.full_like(star_fluxes, np.inf)
    for _ in range(FIT_ROUNDS if n else 0):
        was_far = (abs(step) > INFORMATION_CHANGE * fluxes).any()
        if was_far:
            information = np.zeros((n, n))
        gradient = np.zeros(n)
        for image, others, weights, stars in lit:
            total = _above_guard(stars.light(fluxes), others)
            moving = _weights_above_guard(weights, total)
            if was_far:
                information += stars.information(moving / total)
            gradient += stars.products(moving * (1.0 - image / total))
        if was_far:
            inverse = _inverse(information)
        step = _star_step(information, inverse, gradient, fluxes)
        fluxes = fluxes + step
        if (abs(step) * np.sqrt(np.diag(information)) <= FIT_CHANGE).all():
            break
    return fluxes


def _above_guard(starlight: Array, others: Array) -> Array:
    """Return the model, in the place of its starlight."""
    starlight += others
    return np.maximum(starlight, LEAST_MODEL, out=starlight)


def _weights_above_guard(weights: Array, total: Array) -> Array:
    """Return weights without the pixels where the model is the guard: no star moves it there.

    PSFs with negative pixels make it so; one such pixel would have all of the information.
    """
    return np.where(total > LEAST_MODEL, weights, 0.0)


def _make_scaling(
    scene: Scene, model: Model, total_weight: Array, diffuse: Array, fluxes: Array
) -> Scaling:
    def what_is_seen() -> Iterator[Array]:
        for light, background in zip(model.starlight(fluxes), model.background, strict=True):
            light += background
            yield np.maximum(light, MIN_BACKGROUND, out=light)

    inverse = model.adjoint(w / seen for w, seen in zip(model.weights, what_is_seen(), strict=True))
    shift = np.divide(total_weight, inverse, out=np.zeros_like(inverse), where=inverse > 0)
    ratios = np.empty(model.shape)
    for ratio, weights, light, others in zip(
        ratios, model.weights, model.starlight(fluxes), diffuse, strict=True
    ):
        total = _above_guard(light, others)
        np.divide(_weights_above_guard(weights, total), total, out=ratio)
    cross_information = []
    for unit in np.eye(scene.n_stars):
        lights = model.starlight(unit)
        seen = model.adjoint(x * light for x, light in zip(ratios, lights, strict=True))
        cross_information.append(Stamp(seen, 0, 0))
    information = sum(
        stars.information(x.ravel()) for x, stars in zip(ratios, model.stars, strict=True)
    )
    return Scaling(SHIFT * np.maximum(shift, 0.0), np.asarray(information), cross_information)
