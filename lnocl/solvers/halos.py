r"""Amounts of halos with the extended source not known, and their standard errors.

A sky that is positive and free follows the noise. It takes up the light above the lower envelope of
the counts, which smooth halos lose: 1 to 20 % of theirs, with more iterations more. So after the
last iteration halos take steps of Newton to where least squares have them,

.. math:: a_{kj} \gets \max(a_{kj} + \Delta a_{kj}, 0),

in which the extended source is expected to be dark but where it is significant. It loses what the
halos win. The least squares are those of stars (`lnocl.solvers.star_errors`), but of the whole
grid: of all halos, of the stars, and of the extended source, of the covariance that
`lnocl.scene.texture` expects.

For standard errors the variance of each halo takes conjugate gradients of its own. Of many images
those of a few are computed, and tell by how much the extended source raises the variances of the
others.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, maximum_filter

from lnocl.scene.apertures import FWHM
from lnocl.scene.arrays import Array
from lnocl.scene.forward_model import Model, model_images
from lnocl.scene.scene import MIN_MODEL, Scene
from lnocl.scene.texture import Texture, resolution
from lnocl.solvers.fluxes import variances
from lnocl.solvers.least_squares import LeastSquares, LinearImage, SourceError

# Conjugate gradients end at this share of the gradient, or after so many steps. The error of a
# variance is of second order in it.
FINISHED, N_STEPS = 0.02, 100
# Steps at most; they end where all are less than this share of the noise of counts.
STEPS, SETTLED = 4, 0.1
# Images of a halo whose variances are computed.
MOST_IMAGES = 4
# More stars are taken as known, the faintest of them.
MOST_STARS = 4
# The extended source is significant where its light in a resolution is so many times the noise, and
# so many resolutions round it.
SIGNIFICANT, ROUND = 7.0, 0.5
# What halos win the extended source loses within so many resolutions.
SPREAD = 3.0


class _Joint:
    """The least squares of halos, stars and extended source near an estimate.

    Parameters
    ----------
    scene : Scene
        What is modelled, with the stars where they are.
    sky : ndarray of float64, shape (Ny, Nx)
        Extended source on the grid, electrons per pixel.
    star_fluxes : ndarray of float64, shape (n_fluxes,)
        Those of stars and halos, electrons.
    is_lit : ndarray of bool, shape (Ny, Nx), optional
        Where the extended source is expected; elsewhere it is expected to be dark.
    """

    def __init__(
        self,
        scene: Scene,
        model: Model,
        sky: Array,
        star_fluxes: Array,
        is_lit: NDArray[np.bool_] | None = None,
    ) -> None:
        n = scene.n_stars
        brightest = np.argsort(-star_fluxes[:n], kind="stable")[:MOST_STARS]
        fitted = np.append(np.sort(brightest), np.arange(n, scene.n_fluxes))
        self.first, extended = len(fitted) - scene.n_halos, sky / scene.unit
        expected = extended if is_lit is None else np.where(is_lit, extended, 0.0)
        texture = Texture(expected, scene.shown_stars, resolution(scene))
        if is_lit is not None:  # nor are stars taken to be on light that is not significant
            texture.amplitude[~is_lit] = 0.0
        source = SourceError(model.forward, model.adjoint, texture.amplitude, texture.width)
        fluxes = star_fluxes / scene.unit
        images = []
        unexpected = model.forward(extended - expected)
        models = model_images(scene, extended, fluxes)
        arrays = zip(scene.images(), models, model.weights, unexpected, strict=True)
        for j, (counts, mean, weights, less) in enumerate(arrays):
            shown = np.flatnonzero(scene.shown[fitted, j])
            slopes = np.array([scene.star_image(j, s).ravel() for s in fitted[shown]])
            total = np.maximum(mean, MIN_MODEL)
            precision = np.where(total > MIN_MODEL, scene.scale * weights / total, 0.0)
            images.append(LinearImage(slopes, shown, counts - total + less, precision))
        self.fit = LeastSquares(images, [source], np.zeros(len(fitted)), N_STEPS, FINISHED)

    def change(self) -> Array:
        """Return the changes of the halos to where they are least, scaled."""
        return self.fit.solve(np.zeros(len(self.fit.information)))[0][self.first :]


def marginal_halos(scene: Scene, sky: Array, star_fluxes: Array) -> tuple[Array, Array]:
    """Return the extended source and the fluxes after such steps, the stars held.

    Parameters
    ----------
    scene : Scene
        What is modelled, with the stars where they are.
    sky : ndarray of float64, shape (Ny, Nx)
        Extended source on the grid, electrons per pixel, zero or more.
    star_fluxes : ndarray of float64, shape (n_fluxes,)
        Those of stars and halos, electrons.
    """
    model, fluxes = Model(scene), star_fluxes.copy()
    halos = fluxes[scene.n_stars :]  # a view
    for _ in range(STEPS):
        is_lit = _significant(scene, model, sky / scene.unit, fluxes / scene.unit)
        joint = _Joint(scene, model, sky, fluxes, is_lit)
        information = np.diag(joint.fit.information)[joint.first :]
        change = np.where(information > 0, joint.change(), 0.0) * scene.unit
        change = np.maximum(change, -halos)
        halos += change
        sky = _without(scene, model, sky, np.append(np.zeros(scene.n_stars), change))
        if (abs(change) * np.sqrt(information) < SETTLED * scene.unit).all():
            break
    return sky, fluxes


def _significant(scene: Scene, model: Model, extended: Array, fluxes: Array) -> NDArray[np.bool_]:
    """Return where the extended source is far above the noise of all images, and round there."""
    models = model_images(scene, extended, fluxes)
    # A pixel of an image has the noise of all pixels of the sky in it.
    precisions = [
        np.where(mean > MIN_MODEL, area * scene.scale * w / np.maximum(mean, MIN_MODEL), 0.0)
        for mean, w, area in zip(models, model.weights, scene.areas, strict=True)
    ]
    width = resolution(scene)
    # The light in a resolution over its noise: both are nearly flat over one.
    smooth = gaussian_filter(extended, width / FWHM, mode="wrap")
    precision = np.maximum(model.adjoint(precisions), 0.0)
    area = 4.0 * np.pi * (width / FWHM) ** 2
    is_lit = smooth * np.sqrt(area * precision) > SIGNIFICANT
    return np.asarray(maximum_filter(is_lit, 2 * int(np.ceil(ROUND * width)) + 1, mode="wrap"))


def _without(scene: Scene, model: Model, sky: Array, fluxes: Array) -> Array:
    """Return the extended source less light that halos won, or with what they lost.

    It changes by a share of itself, smoothed, so that it is dark where it was.
    """
    weighted = (w * light for w, light in zip(model.weights, model.starlight(fluxes), strict=True))
    total = model.adjoint(model.weights)
    seen = scene.observed(total)
    won = np.divide(model.adjoint(weighted), total, out=np.zeros(sky.shape), where=seen)
    width = SPREAD * resolution(scene)
    won, light = (gaussian_filter(each, width, mode="wrap") for each in (won, sky))
    share = np.divide(won, light, out=np.zeros(sky.shape), where=light > 0)
    return np.asarray(sky * (1.0 - np.clip(share, -1.0, 1.0)))


def halo_errors(scene: Scene, sky: Array, star_fluxes: Array) -> Array:
    """Return the standard errors of halos, in the unit of fluxes, shape (n_halos,).

    Parameters
    ----------
    scene : Scene
        What is modelled, with the stars where they are.
    sky : ndarray of float64, shape (Ny, Nx)
        Extended source on the grid, electrons per pixel.
    star_fluxes : ndarray of float64, shape (n_fluxes,)
        Those of stars and halos, electrons.

    Returns
    -------
    ndarray of float64, shape (n_halos,)
        NaN where the images do not determine a halo.
    """
    joint, p = _Joint(scene, Model(scene), sky, star_fluxes), scene.n_images
    found = variances(joint.fit.information)[joint.first :].reshape(-1, p)
    some = np.unique(np.linspace(0, p - 1, MOST_IMAGES).round().astype(int))
    for k, halo in enumerate(found):
        known = [j for j in some.tolist() if np.isfinite(halo[j])]
        wholes = joint.fit.variances([joint.first + k * p + j for j in known])
        raised = [whole / halo[j] for whole, j in zip(wholes, known, strict=True)]
        halo *= max(float(np.median(raised)), 1.0) if raised else np.nan
        halo[known] = wholes
    errors = np.sqrt(np.where(np.isfinite(found), found, np.nan)).ravel()
    return errors * scene.unit
