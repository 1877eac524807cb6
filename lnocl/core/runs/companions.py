r"""Points beside stars that are tried before their light goes to the error of a PSF.

A companion that is not among the stars bends a PSF that is fitted to them. Beside each of the
brightest stars a point is tried at places in the sky, by the least squares of star, level, all that
the PSF may have wrong (`lnocl.core.solvers.psf_errors`), and the point. The errors of the PSF's
pixels count as noise. With the residuals r of an extended source that is a level, their precisions
P, the derivatives J by these unknowns, whose priors have the information Pi, and the point t it has
the flux ``T / F``,

.. math::
    T = t^T P r - t^T P J H^{-1} J^T P r, \quad F = t^T P t - t^T P J H^{-1} J^T P t, \quad
    H = J^T P J + \Pi

What lies on both sides of the star alike is no companion: the flux at the mirrored place is taken
off. Where the rest is largest, in its errors, a point takes the place of the extended source, and
has to stand against that and the PSF's error together (`lnocl.core.solvers.near_star`).
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from copy import copy
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from lnocl.core.runs.guarded_runs import GuardedRuns
from lnocl.core.runs.halos import settle_halos
from lnocl.core.runs.psf_posterior import NARROWEST
from lnocl.core.runs.start import Setup, make_start
from lnocl.core.runs.steady import run_steadily
from lnocl.core.scene.arrays import Array
from lnocl.core.scene.detector import on_sky
from lnocl.core.scene.estimate import Estimate
from lnocl.core.scene.fields import PSF_ERROR
from lnocl.core.scene.texture import Texture
from lnocl.core.solvers.fluxes import variances
from lnocl.core.solvers.least_squares import ROUNDING, LinearImage
from lnocl.core.solvers.near_star import NearStar, Surroundings, offsets_from
from lnocl.core.solvers.psf_errors import CORRELATED
from lnocl.errors import DivergedError, NotFiniteError, counted, note
from lnocl.process import ignored_notes, ignored_warnings

# So many of the brightest stars are looked at, and so many points are found, at most.
MOST_STARS, MOST_POINTS = 4, 3
# Points are tried at these distances from a star, resolutions, so many to one at first: nearer ones
# are part of it, and of those farther off a PSF takes no light (docs/validation/psf_error.md).
NEAREST, FARTHEST, STEPS = 0.5, 3.0, 2.0
# Standard errors that a point has where it is tried, and beside what the extended source may be
# there, as of detections; each of its steps is so many pixels at most.
SIGNIFICANT, CLEAR, MOVED, N_STEPS = 5.0, 3.0, 1.0, 2
# The share of the gradient at which conjugate gradients end, and the information of what is free.
FINISHED, FREE = 1e-3, 1e-9
# Iterations of a run, at most.
N_ITER = 300


def beside_stars(setup: Setup, tick: Callable[[], object] = int) -> Array:
    """Return the places of `companions`, those that a run of a window round the stars shows.

    Parameters
    ----------
    setup : Setup
        The images and the parameters of the runs; one star or more among them.
    tick : callable, optional
        Is called after each iteration.
    """
    runs, places = GuardedRuns(setup), np.zeros((0, 2))
    near = runs.setup_of(setup.observation.psfs_over_images, runs.stars)
    near = replace(near, refine_positions=False)
    with suppress(DivergedError, NotFiniteError), ignored_warnings(), ignored_notes():
        start = settle_halos(make_start(near, runs.penalty))
        found = companions(run_steadily(start, runs.penalty, N_ITER, tick).estimate)
        places = found + (runs.all_stars[runs.held][0] - runs.stars[0])
    if len(places):
        named = " ".join(f"({x:.4g}, {y:.4g})" for x, y in places)
        number = counted(len(places), "point")
        note(f"{number} beside stars held while PSFs are fitted, {named}: name what is a star")
    return places


def companions(estimate: Estimate) -> Array:
    """Return the places of points that are to be held as stars while PSFs are fitted, (n, 2).

    They are (x, y), pixels of the images.

    Parameters
    ----------
    estimate : Estimate
        That of a run with the PSFs as they are given, and with the stars that are known.
    """
    scene, places = copy(estimate.scene), list[Array]()
    error = max(scene.observation.psf_error, PSF_ERROR)  # those that are fitted are doubted
    scene.observation = scene.observation.replace(psf_error=error)
    estimate = Estimate(scene, estimate.sky, estimate.star_fluxes)
    light = estimate.star_fluxes[: scene.n_stars].reshape(-1, scene.n_epochs).sum(axis=1)
    brightest = np.argsort(-light, kind="stable")[:MOST_STARS]
    stars = (scene.n_epochs * brightest[light[brightest] > 0]).tolist()
    while stars and len(places) < MOST_POINTS:
        around = Surroundings(estimate, False)
        if around.width < NARROWEST:  # samples do not hold its shape
            break
        likeliest = (_likeliest(around, star) for star in stars)
        errors, place, flux = max(likeliest, key=lambda each: each[0])
        found = _with_point(estimate, place, flux) if errors > SIGNIFICANT else None
        if found is None:
            break
        estimate = found
        places.append(estimate.scene.stars[-1])
    return np.reshape(places, (-1, 2))


def _likeliest(around: Surroundings, star: int) -> tuple[float, Array, float]:
    """Return how many errors the likeliest point beside a star has, its place and its flux."""
    near, scene = NearStar(around, star, FINISHED), around.scene
    rows, columns = offsets_from(scene, star, near.window)
    distance = np.hypot(rows, columns) / near.resolution
    is_allowed = (distance > NEAREST) & (distance <= FARTHEST)
    step = round(near.resolution / STEPS)
    is_tried = np.zeros(distance.shape, bool)
    is_tried[::step, ::step] = True
    y, x = np.nonzero(is_tried & is_allowed)
    if not len(y):
        return -np.inf, scene.stars[star], 0.0
    fluxes, errors = _points(near, around.estimate, (y, x))
    away = np.stack([columns[x], rows[y, 0]], axis=1)
    _, opposite = KDTree(away).query(-away)
    one_sided = (fluxes - np.maximum(fluxes[opposite], 0.0)) / errors
    best = int(np.argmax(one_sided))
    is_near = np.zeros(distance.shape, bool)  # those between, too
    is_near[tuple(slice(max(at[best] - step + 1, 0), at[best] + step) for at in (y, x))] = True
    y, x = np.nonzero(is_near & is_allowed)
    fluxes, errors = _points(near, around.estimate, (y, x))
    at = int(np.argmax(fluxes / errors))
    place = scene.stars[star] + np.array([columns[x[at]], rows[y[at], 0]]) / scene.oversample
    return float(one_sided[best]), place, float(fluxes[at]) * scene.unit


def _points(
    near: NearStar, estimate: Estimate, at: tuple[NDArray[np.int_], ...]
) -> tuple[Array, Array]:
    """Return fluxes and errors of points at rows and columns of the sky in a window, scaled."""
    n, scatters = len(near.prior), np.zeros((len(near.images), *near.window.shape))
    if near.psfs is not None:
        scatters = near.psfs.pixels(near.window.shape).scatter
    extended = near.source.images_of(near.expected + estimate.part(near.places(estimate.scene)))
    information, moments = np.diag([*np.zeros(n), FREE]), np.zeros(n + 1)
    information[:n, :n] = near.prior
    images = list[LinearImage]()
    levels = near.fields[1].forward(np.ones(1))
    each = zip(near.images, levels, extended, scatters, strict=True)
    for image, flat, light, scatter in each:
        noise = 1.0 + image.precision * (2.0 * np.pi * (CORRELATED * scatter) ** 2)
        weights, left = image.precision / noise, image.left + light
        image = image.beside([flat], np.array([n]))._replace(left=weights * left, precision=weights)
        weighted = image.slopes * weights.ravel()
        information[np.ix_(image.unknowns, image.unknowns)] += weighted @ image.slopes.T
        moments[image.unknowns] += weighted @ left.ravel()
        images.append(image._replace(slopes=weighted))
    units = 1.0 / np.sqrt(np.maximum(np.diag(information), np.finfo(float).tiny))
    scaled = information * units * units[:, None] + ROUNDING * np.eye(n + 1)
    inverse = np.linalg.inv(scaled) * units * units[:, None]
    fluxes, errors = np.zeros((2, len(at[0])))
    for k, (y, x) in enumerate(zip(*at, strict=True)):
        point, shares, told, score = np.zeros(near.expected.shape), np.zeros(n + 1), 0.0, 0.0
        point[y, x] = 1.0
        for image, seen in zip(images, near.source.images_of(point), strict=True):
            shares[image.unknowns] += image.slopes @ seen.ravel()
            told += float(np.vdot(image.precision, seen**2))
            score += float(np.vdot(image.left, seen))
        of_unknowns = inverse @ shares
        told = max(told - float(shares @ of_unknowns), FREE)
        fluxes[k], errors[k] = (score - of_unknowns @ moments) / told, told**-0.5
    return fluxes, errors


def _with_point(estimate: Estimate, place: Array, flux: float) -> Estimate | None:
    """Return the estimate with a point instead of what it holds there; None where it has none."""
    n, n_epochs = estimate.scene.n_stars, estimate.scene.n_epochs
    width = Surroundings(estimate, False).width
    fluxes = np.insert(estimate.star_fluxes, n, [max(flux, 0.0)] * n_epochs)
    for _ in range(N_STEPS):
        scene = estimate.scene.with_star(place)
        without = Texture(estimate.sky, on_sky(place[None], scene.oversample), width).mean
        near = NearStar(Surroundings(Estimate(scene, without, fluxes), True), n, FINISHED)
        at = near.unknowns[np.isin(near.held, np.arange(n, n + n_epochs))]
        at = at[np.isfinite(variances(near.fit.information)[at]).all(axis=1)]
        if not len(at):
            return None
        change, _ = near.fit.solve()
        values = fluxes[n] + change[at[:, 0]] * scene.unit
        weights = 1.0 / near.fit.variances(at[:, 0]) / scene.unit**2
        value = float((weights * values).sum() / weights.sum())
        if value <= 0:
            return None
        place = place + change[at[0, 1:]].clip(-MOVED, MOVED)
        fluxes[n : n + n_epochs] = value
    away = np.hypot(*(place - estimate.scene.stars).T) * scene.oversample / width
    if value * weights.sum() ** 0.5 < CLEAR or (away < NEAREST).any():
        return None
    return Estimate(estimate.scene.with_star(place), without, fluxes)
