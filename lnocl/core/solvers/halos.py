r"""Amounts of halos with the extended source not known, and their standard errors.

A sky that is positive and free follows the noise. It takes up the light above the lower envelope of
the counts, which smooth halos lose: 1 to 20 % of theirs, with more iterations more. So after the
last iteration halos take steps of Newton to where least squares have them,

.. math:: a_{kj} \gets \max(a_{kj} + \Delta a_{kj}, 0),

in which the extended source is expected to be dark but where it is significant. It loses what the
halos win. The least squares are those of stars (`lnocl.core.solvers.star_errors`), but of the whole
grid: of all halos, of the stars, and of the extended source, of the covariance that
`lnocl.core.scene.texture` expects.

For standard errors the variance of each halo takes conjugate gradients of its own. Of many images
those of a few are computed, and tell by how much the extended source raises the variances of the
others, and what images far from a star tell of a halo at it (`lnocl.core.solvers.near_star`).
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, maximum_filter

from lnocl.core.scene.apertures import FWHM
from lnocl.core.scene.arrays import Array
from lnocl.core.scene.estimate import Estimate
from lnocl.core.scene.forward_model import Model
from lnocl.core.scene.scene import Scene
from lnocl.core.scene.texture import Texture, hidden_radii, resolution
from lnocl.core.scene.view import View
from lnocl.core.solvers.fluxes import precision, variances
from lnocl.core.solvers.least_squares import LeastSquares, SourceError
from lnocl.core.solvers.sources import Sources

# Conjugate gradients end at this share of the gradient, or after so many steps. The error of a
# variance is of second order in it.
FINISHED, N_STEPS = 0.02, 100
# Steps at most; they end where all are less than this share of the noise of counts.
STEPS, SETTLED = 4, 0.1
# Images of a halo whose variances are computed.
MOST_IMAGES = 4
# Stars that are unknown beside halos: those most like one, so many at least, and further ones of
# which a halo shares so much of the information, at most so many.
LEAST_STARS, SHARED, MOST_STARS = 4, 1e-3, 16
# The extended source is significant where its light in a resolution is so many times the noise, and
# so many resolutions round it.
SIGNIFICANT, ROUND = 7.0, 0.5
# What halos win the extended source loses within so many resolutions.
SPREAD = 3.0


class _Joint:
    """The least squares of halos, stars and extended source near an estimate.

    Parameters
    ----------
    estimate : Estimate
        What is modelled, and how bright it is.
    is_lit : ndarray of bool, shape (Ny, Nx), optional
        Where the extended source is expected; elsewhere it is expected to be dark.
    """

    def __init__(
        self, estimate: Estimate, model: Model, is_lit: NDArray[np.bool_] | None = None
    ) -> None:
        scene, extended = estimate.scene, estimate.extended
        models, views = list(estimate.models()), [View(scene, j) for j in range(scene.n_images)]
        precisions = [
            precision(scene, mean, view.weights) for mean, view in zip(models, views, strict=True)
        ]
        fitted = np.append(_like_halos(scene, precisions), np.arange(scene.n_stars, scene.n_fluxes))
        sources = Sources(estimate, fitted, moves=False)
        expected = extended if is_lit is None else np.where(is_lit, extended, 0.0)
        width = resolution(scene)
        texture = Texture(expected, scene.shown_stars, width, hidden_radii(scene, width))
        if is_lit is not None:  # nor are stars taken to be on light that is not significant
            texture.amplitude[~is_lit] = 0.0
        source = SourceError(model.forward, model.adjoint, texture.amplitude, texture.width)
        # A level that is not known is a halo that is flat, which the prior holds.
        errors = scene.observation.background_error / scene.scale
        levels = sources.n + np.cumsum(errors > 0) - 1
        images = []
        unexpected = model.forward(extended - expected)
        for view, mean, less in zip(views, models, unexpected, strict=True):
            image = sources.linear(view, mean)
            image = image._replace(left=image.left + less)
            free = [view.levels[0]] if errors[view.j] else []
            images.append(image.beside(free, levels[[view.j]]))
        prior = np.append(np.zeros(sources.n), errors[errors > 0] ** -2.0)
        self.first = sources.n - scene.n_halos
        self.halos = slice(self.first, sources.n)
        self.fit = LeastSquares(images, [source], prior, N_STEPS, FINISHED)


def _like_halos(scene: Scene, precisions: list[Array]) -> NDArray[np.int_]:
    """Return the stars of which halos share most of the information that images have of each."""
    n, shape = scene.n_stars, (scene.n_stars, scene.n_halos)
    own, shared, of_halos = np.zeros(n), np.zeros(shape), np.zeros(scene.n_halos)
    for j, of_counts in enumerate(precisions):
        halos = {k: scene.star_image(j, n + k) for k in np.flatnonzero(scene.shown[n:, j]).tolist()}
        for k, halo in halos.items():
            of_halos[k] = np.vdot(halo * of_counts, halo)
        for s in np.flatnonzero(scene.shown[:n, j]).tolist():
            star = scene.star_cutout(j, s)
            there = star.window(scene.image_grid)
            weighted = of_counts[there] * star.values
            own[s] += np.vdot(weighted, star.values)
            for k, halo in halos.items():
                shared[s, k] = np.vdot(weighted, halo[there])
    whole = own[:, None] * of_halos
    shares = np.divide(shared**2, whole, out=np.zeros(shape), where=whole > 0).max(axis=1)
    order = np.argsort(-shares, kind="stable")[:MOST_STARS]
    return np.sort(order[(shares[order] > SHARED) | (np.arange(len(order)) < LEAST_STARS)])


def marginal_halos(estimate: Estimate) -> Estimate:
    """Return the estimate after such steps, the stars held.

    Parameters
    ----------
    estimate : Estimate
        Its extended source is zero or more.
    """
    scene = estimate.scene
    model, dark = Model(scene), np.zeros(scene.n_stars)
    for _ in range(STEPS):
        joint = _Joint(estimate, model, _significant(estimate, model))
        information = np.diag(joint.fit.information)[joint.halos]
        # What a star or another halo can stand in for stays.
        is_told = np.isfinite(variances(joint.fit.information))[joint.halos]
        change = np.where(is_told, joint.fit.solve()[0][joint.halos], 0.0)
        change = np.append(dark, np.maximum(change, -estimate.fluxes[scene.n_stars :]))
        sky = without(estimate, model, model.starlight(change))
        estimate = Estimate(scene, sky, estimate.star_fluxes + change * scene.unit)
        if (abs(change[scene.n_stars :]) * np.sqrt(information) < SETTLED).all():
            break
    return estimate


def _significant(estimate: Estimate, model: Model) -> NDArray[np.bool_]:
    """Return where the extended source is far above the noise of all images, and round there."""
    scene, models = estimate.scene, estimate.models()
    # A pixel of an image has the noise of all pixels of the sky in it.
    precisions = [
        area * precision(scene, mean, w)
        for mean, w, area in zip(models, model.weights, scene.areas, strict=True)
    ]
    width = resolution(scene)
    # The light in a resolution over its noise: both are nearly flat over one.
    smooth = gaussian_filter(estimate.extended, width / FWHM, mode="wrap")
    told = np.maximum(model.adjoint(precisions), 0.0)
    area = 4.0 * np.pi * (width / FWHM) ** 2
    is_lit = smooth * np.sqrt(area * told) > SIGNIFICANT
    return np.asarray(maximum_filter(is_lit, 2 * int(np.ceil(ROUND * width)) + 1, mode="wrap"))


def without(estimate: Estimate, model: Model, lights: Iterable[Array]) -> Array:
    """Return the extended source less light that halos or levels won, or with what they lost.

    It changes by a share of itself, smoothed, so that it is dark where it was. `lights` are those
    that they won in each image, scaled.
    """
    scene, sky = estimate.scene, estimate.sky
    weighted = (w * light for w, light in zip(model.weights, lights, strict=True))
    total = model.adjoint(model.weights)
    seen = scene.observed(total)
    back = model.adjoint(weighted) * scene.unit
    won = np.divide(back, total, out=np.zeros(sky.shape), where=seen)
    width = SPREAD * resolution(scene)
    won, light = (gaussian_filter(each, width, mode="wrap") for each in (won, sky))
    share = np.divide(won, light, out=np.zeros(sky.shape), where=light > 0)
    return np.asarray(sky * (1.0 - np.clip(share, -1.0, 1.0)))


class HaloErrors(NamedTuple):
    """Standard errors of halos.

    Attributes
    ----------
    errors : ndarray of float64, shape (n_halos,)
        In the unit of fluxes; NaN where the images do not determine a halo.
    raised : ndarray of float64, shape (n_shapes,)
        How many times the variance of each shape is that with the extended source known, 1 or more;
        infinite where the images determine it nowhere.
    """

    errors: Array
    raised: Array


def halo_errors(estimate: Estimate) -> HaloErrors:
    """Return the standard errors of halos, with stars and extended source marginalised.

    Parameters
    ----------
    estimate : Estimate
        What is modelled, and how bright it is.
    """
    scene = estimate.scene
    if not scene.n_halos:
        return HaloErrors(np.zeros(0), np.zeros(0))
    joint, p = _Joint(estimate, Model(scene)), scene.n_images
    found = variances(joint.fit.information)[joint.halos].reshape(-1, p)
    some = np.unique(np.linspace(0, p - 1, MOST_IMAGES).round().astype(int))
    factors = np.full(len(found), np.inf)
    for k, halo in enumerate(found):
        known = [j for j in some.tolist() if np.isfinite(halo[j])]
        wholes = joint.fit.variances([joint.first + k * p + j for j in known])
        raised = [whole / halo[j] for whole, j in zip(wholes, known, strict=True)]
        if raised:
            factors[k] = max(float(np.median(raised)), 1.0)
        halo *= factors[k]
        halo[known] = wholes
    errors = np.sqrt(np.where(np.isfinite(found), found, np.nan)).ravel()
    return HaloErrors(errors * scene.unit, factors)
