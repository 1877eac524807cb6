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

from collections.abc import Sequence
from copy import copy
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from lnocl.core.scene.arrays import Array, Mask
from lnocl.core.scene.detector import on_sky
from lnocl.core.scene.estimate import Estimate
from lnocl.core.scene.psfs import PSF_ERROR
from lnocl.core.scene.texture import Texture
from lnocl.core.solvers.fluxes import variances
from lnocl.core.solvers.least_squares import LeastSquares, LinearImage
from lnocl.core.solvers.near_star import NearStar, Surroundings, brightest, offsets_from
from lnocl.core.solvers.psf_errors import CORRELATED, NARROWEST

# So many points are found, at most.
MOST_POINTS = 3
# Points are tried at these distances from a star, resolutions, so many to one at first: nearer ones
# are part of it, and of those farther off a PSF takes no light (docs/validation/psf_error.md).
NEAREST, FARTHEST, STEPS = 0.5, 3.0, 2.0
# Over so many resolutions within the farthest, PSFs take ever less of a point: maps find more.
FADING = 1.0
# Standard errors that a point has where it is tried, and beside what the extended source may be
# there, as of detections; each of its steps is so many pixels at most.
SIGNIFICANT, CLEAR, MOVED, N_STEPS = 5.0, 3.0, 1.0, 2
# So many are tried at once, as each has images.
AT_ONCE = 64
# The share of the gradient at which conjugate gradients end, and the information of what is free.
FINISHED, FREE = 1e-2, 1e-9


class Companion(NamedTuple):
    """A point beside a star.

    Attributes
    ----------
    place : ndarray of float64, shape (2,)
        (x, y), pixels of the images.
    flux : float
        Electrons.
    errors : ndarray of float64, shape (3,)
        Standard errors of flux, x and y.
    significance : float
        By how many standard errors it is brighter than the mirrored place, beside all that the PSF
        may have wrong.
    """

    place: Array
    flux: float
    errors: Array = np.zeros(3)
    significance: float = 0.0


def companions(
    estimate: Estimate,
    likely: Sequence[Companion] = (),
    raised: Array | None = None,
    least: float = SIGNIFICANT,
) -> tuple[Estimate, list[Companion]]:
    """Return points beside the stars, and the estimate that has them as stars too.

    Parameters
    ----------
    estimate : Estimate
        That of a run with the stars that are known.
    likely : sequence of Companion
        Further points to try then, the likeliest first; their errors need not be known.
    raised : ndarray of float64, shape (n_shapes,), optional
        As of `lnocl.core.solvers.halos.halo_errors`; halos are known by default.
    least : float
        How significant a point must be.
    """
    now = beside = estimate = _doubted(estimate)
    scene, found, points = estimate.scene, list[Companion](), list[Companion]()
    width = Surroundings(estimate, False).width
    if width < NARROWEST:  # samples do not hold its shape
        return beside, found
    stars = brightest(estimate)
    while stars and len(points) < MOST_POINTS:
        around = Surroundings(now, False, raised)
        likeliest = max((_likeliest(around, star) for star in stars), key=lambda each: each[-1])
        if likeliest.significance <= max(least, SIGNIFICANT):
            break
        points = [*points, likeliest]
        if tried := _with_points(estimate, points, width, raised):
            now, points = beside, found = tried
        else:  # beside another, not found yet, it may be clear
            now = holding(estimate, points, width)
    for point in likely:
        away = [np.hypot(*(point.place - each.place)) for each in found]
        is_new = all(np.array(away) * scene.oversample > NEAREST * width)
        if is_new and (tried := _with_points(estimate, [*found, point], width, raised)):
            beside, found = tried
    return beside, found


def errors_beside(
    estimate: Estimate, raised: Array | None = None, is_meant: Mask | bool = True
) -> Array:
    """Return the standard errors of points beside the brightest stars, beside all PSFs' errors.

    They are those where points are tried, electrons, and those where points are fitted with their
    places and have to stand against the extended source; the latter are over the former as is
    typical of each distance from a star. A share follows that falls from 1 to 0 where PSFs take
    ever less of a point's light. All have the shape (3, Ny, Nx) on the grid of the sky; 0 far off,
    and NaN where a point is part of a star.

    Parameters
    ----------
    estimate : Estimate
        That of a run with the stars that are known.
    raised : ndarray of float64, shape (n_shapes,), optional
        As of `companions`.
    is_meant : ndarray of bool, shape (n_stars,), or bool, optional
        Which stars have points beside them.
    """
    estimate = _doubted(estimate)
    scene, errors = estimate.scene, np.zeros((3, *estimate.scene.grid))
    around = Surroundings(estimate, False, raised)
    if around.width < NARROWEST:
        return errors
    for star in brightest(estimate, is_meant):
        near = NearStar(around, star, FINISHED)
        distance = _places(around, near, star)[0]
        y, x = np.nonzero((distance > NEAREST) & (distance <= FARTHEST))
        tried, ratios = _points(near, estimate, (y, x))[1], []
        rows, columns = offsets_from(scene, star, near.window)
        rings = np.round(STEPS * distance[y, x])
        for k in np.unique(rings):
            ring = np.flatnonzero(rings == k)
            i = ring[np.argsort(tried[ring])[len(ring) // 2]]
            place = scene.stars[star] + np.array([columns[x[i]], rows[y[i], 0]]) / scene.oversample
            point = Companion(place, SIGNIFICANT * tried[i] * scene.unit)
            beside = Surroundings(holding(estimate, [point], around.width), True, raised)
            fitted = NearStar(beside, scene.n_stars, FINISHED)
            error = step_of(fitted, scene.n_stars, scene.n_epochs)[1]
            if np.isfinite(error):
                ratios.append((distance[y[i], x[i]], error / tried[i]))
        if ratios:
            ratio = np.interp(distance[y, x], *np.transpose(sorted(ratios)))
            values = np.where(distance <= NEAREST, np.nan, np.zeros((3, *distance.shape)))
            share = np.minimum((FARTHEST - distance[y, x]) / FADING, 1.0)
            values[:, y, x] = scene.unit * tried, scene.unit * tried * ratio, share
            there = (slice(None), *near.places(scene))
            errors[there] = np.maximum(errors[there], values)
    return errors


def _doubted(estimate: Estimate) -> Estimate:
    """Return an estimate whose PSFs, but for exact ones, are known no better than by default."""
    scene = copy(estimate.scene)
    error = scene.observation.psf_error
    error = max(error, PSF_ERROR) if error else 0.0
    scene.observation = scene.observation.replace(psf_error=error)
    return Estimate(scene, estimate.sky, estimate.star_fluxes)


def _places(around: Surroundings, near: NearStar, star: int) -> tuple[Array, Mask]:
    """Return distances from a star in its window, resolutions, and where points are first tried."""
    distance = np.hypot(*offsets_from(around.scene, star, near.window)) / near.resolution
    is_tried, step = np.zeros(distance.shape, bool), round(near.resolution / STEPS)
    is_tried[::step, ::step] = True
    return distance, is_tried & (distance > NEAREST) & (distance <= FARTHEST)


def _likeliest(around: Surroundings, star: int) -> Companion:
    """Return the likeliest point beside a star, its errors not known."""
    near, scene = NearStar(around, star, FINISHED), around.scene
    rows, columns = offsets_from(scene, star, near.window)
    distance, is_tried = _places(around, near, star)
    is_allowed, step = (distance > NEAREST) & (distance <= FARTHEST), round(near.resolution / STEPS)
    y, x = np.nonzero(is_tried)
    if not len(y):
        return Companion(scene.stars[star], 0.0, np.zeros(3), -np.inf)
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
    flux = max(float(fluxes[at]) * scene.unit, 0.0)
    return Companion(place, flux, np.zeros(3), float(one_sided[best]))


def _points(
    near: NearStar, estimate: Estimate, at: tuple[NDArray[np.int_], ...]
) -> tuple[Array, Array]:
    """Return fluxes and errors of points at rows and columns of the sky in a window, scaled."""
    scatters = np.zeros((len(near.images), *near.window.shape))
    if near.psfs is not None:
        scatters = near.psfs.pixels(near.window.shape).scatter
    extended = near.source.images_of(near.expected + estimate.part(near.places(estimate.scene)))
    prior, images = near.prior.copy(), list[LinearImage]()
    prior[near.level, near.level] = FREE
    for image, light, scatter in zip(near.images, extended, scatters, strict=True):
        noise = 1.0 + image.precision * (2.0 * np.pi * (CORRELATED * scatter) ** 2)
        images.append(image._replace(left=image.left + light, precision=image.precision / noise))
    beside = LeastSquares(images, [], prior, 0, 0.0)
    now = beside.invert(beside.moments(np.array([each.left for each in images])))
    fluxes, errors = np.zeros((2, len(at[0])))
    for first in range(0, len(at[0]), AT_ONCE):
        few = slice(first, first + AT_ONCE)
        y, x = (each[few] for each in at)
        points = np.zeros((len(y), *near.expected.shape))
        points[np.arange(len(y)), y, x] = 1.0
        shares, (told, score) = np.zeros((len(prior), len(y))), np.zeros((2, len(y)))
        for image, seen in zip(images, near.source.images_of(points), strict=True):
            weighted = (seen * image.precision).reshape(len(y), -1)
            shares[image.unknowns] += image.slopes @ weighted.T
            told += (weighted * seen.reshape(len(y), -1)).sum(axis=1)
            score += weighted @ image.left.ravel()
        told = np.maximum(told - (shares * beside.invert(shares)).sum(axis=0), FREE)
        fluxes[few], errors[few] = (score - now @ shares) / told, told**-0.5
    return fluxes, errors


def _with_points(
    estimate: Estimate, points: Sequence[Companion], width: float, raised: Array | None
) -> tuple[Estimate, list[Companion]] | None:
    """Return the estimate with points instead of what it holds there, and the points as they fit.

    None where one of them is not clear, or has come too near to a star.
    """
    fitted = list(points)
    n, n_epochs = estimate.scene.n_stars, estimate.scene.n_epochs
    for is_last in [False] * (N_STEPS - 1) + [True]:
        for k in range(len(points)):
            now = holding(estimate, fitted, width)
            point = _fitted(now, n + k * n_epochs, fitted[k], raised, is_last)
            if point is None:
                return None
            fitted[k] = point
    away = [np.hypot(*(each.place - estimate.scene.stars).T).min() for each in fitted]
    if min(away) * estimate.scene.oversample < NEAREST * width:
        return None
    return holding(estimate, fitted, width), fitted


def holding(estimate: Estimate, points: Sequence[Companion], width: float) -> Estimate:
    """Return an estimate that has points as stars, instead of what it holds there."""
    scene, n_epochs = estimate.scene, estimate.scene.n_epochs
    places = np.array([each.place for each in points])
    without = Texture(estimate.sky, on_sky(places, scene.oversample), width).mean
    added = np.repeat([each.flux for each in points], n_epochs)
    fluxes = np.insert(estimate.star_fluxes, [scene.n_stars] * len(added), added)
    for place in places:
        scene = scene.with_star(place)
    return Estimate(scene, without, fluxes)


def _fitted(
    estimate: Estimate, first: int, point: Companion, raised: Array | None, is_last: bool
) -> Companion | None:
    """Return a point, the star `first`, after a step to where it fits; None where it has no light.

    Its flux is the mean over epochs. It has errors after the last step, where it is to be clear.
    """
    near = NearStar(Surroundings(estimate, True, raised), first, FINISHED)
    change, change_error, step = step_of(near, first, estimate.scene.n_epochs, not is_last)
    flux, at = point.flux + change * estimate.scene.unit, near.unknowns[0, 1:]
    if flux <= 0 or not np.isfinite(variances(near.fit.information)[at]).all():
        return None
    errors = point.errors
    if is_last:
        error = change_error * estimate.scene.unit
        if flux < CLEAR * error:
            return None
        errors = np.array([error, *np.sqrt(near.fit.variances(at))])
    place = point.place + step[at].clip(-MOVED, MOVED)
    return Companion(place, flux, errors, point.significance)


def step_of(
    near: NearStar, first: int, n_epochs: int, is_rough: bool = False
) -> tuple[float, float, Array]:
    """Return how the flux of a star changes, in the mean of its epochs from `first` on.

    That is the change, scaled, and its error, minus and plus infinity where no epoch determines it;
    and the changes of all unknowns. Rough errors, and weights of epochs, take fields as known.
    """
    direct = variances(near.fit.information)
    at = near.unknowns[np.isin(near.held, np.arange(first, first + n_epochs)), 0]
    at = at[np.isfinite(direct[at])]
    if not len(at):
        return -np.inf, np.inf, np.zeros(near.n)
    change, _ = near.fit.solve()
    weights = 1.0 / (direct[at] if is_rough else near.fit.variances(at))
    mean = float((weights * change[at]).sum() / weights.sum())
    return mean, float(weights.sum() ** -0.5), change
