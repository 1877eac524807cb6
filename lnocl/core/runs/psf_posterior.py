r"""PSFs as the images show them at their stars: the mean of what they may be.

The least squares at a star (`lnocl.core.solvers.near_star`) have the errors theta of PSFs among
their unknowns, beside the star and the extended source. Those of the brightest stars are solved
together, with one theta. The estimate that they are of is that of a run with one weight of
smoothing, which is made anew with the PSFs of theta, and theta then found again, as long as the
objective falls.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag

from lnocl.core.runs.outcome import Outcome
from lnocl.core.runs.start import Setup
from lnocl.core.scene.arrays import Array
from lnocl.core.scene.cores import fwhm
from lnocl.core.scene.estimate import Estimate
from lnocl.core.solvers.least_squares import Field, LeastSquares, LinearImage
from lnocl.core.solvers.near_star import N_STEPS, NearStar, Surroundings, brightest
from lnocl.core.solvers.psf_errors import (
    N_SHAPES,
    N_SLOPES,
    NARROWEST,
    SHIFT,
    alike,
    cost,
    count,
    with_errors,
)
from lnocl.errors import DivergedError, NotFiniteError
from lnocl.process import ignored_notes, ignored_warnings

# Steps that are tried, at most, and the longest step, and that which no run follows, standard
# deviations of the prior.
MOST_RUNS, MAX_STEP, SHORT = 6, 6.0, 0.3
# What the `psf_error` of PSFs holds is an error of no more than so many times it.
HELD = 2.0
# The standard deviation of a place that is given, pixels.
AWAY = 1.0
# The share of the gradient at which conjugate gradients end.
FINISHED = 1e-2


def settle_psfs(setup: Setup, moves: bool, run: Callable[[Setup], Outcome]) -> tuple[Array, Array]:
    r"""Return theta, shape (n_psfs, N_SHAPES), and the places of the stars.

    Each step is one towards the least of

    .. math:: \min_{f, c} J(f, c; \theta) + \tfrac{1}{2} \theta^T C^{-1} \theta,

    which a run with the PSFs of theta tells, and is halved where that would rise: a PSF and an
    extended source that are both too sharp, or too smooth, take each other's part. After a step
    that lowers it by less than its noise, about its root, further ones would hand the light of
    stars to the extended source.

    Stars are moved that lie farther off than `HELD` times what a PSF may be shifted by. Other
    shifts are left to the positions, and zero points as they are given. So are wings: what is not
    the extended source's is told from it by its smoothness alone, and each round would hand it more
    of them. PSFs narrower than two of their pixels are left, as their samples do not hold their
    shape. No step follows a run that diverges.

    Parameters
    ----------
    setup : Setup
        The images and the parameters of the runs; one star or more among them.
    moves : bool
        Whether stars may be moved.
    run : callable
        Returns the outcome of a run, `lnocl.core.runs.guarded_runs.steady_outcome`.
    """
    observation, share, are_moved = setup.observation, 1.0, True
    of_psfs = dict(zip(alike(observation).tolist(), observation.psfs, strict=True))
    theta, stars = np.zeros((count(observation), N_SHAPES)), setup.stars
    is_sampled = np.array([fwhm(of_psfs[k]) >= NARROWEST for k in range(len(theta))])
    if not is_sampled.any():
        return theta, stars
    with suppress(DivergedError, NotFiniteError), ignored_warnings(), ignored_notes():
        outcome = run(setup)
        least, (found, away) = outcome.objectives[-1], _mean(outcome.estimate, theta, moves)
        for _ in range(MOST_RUNS):
            step = np.where(is_sampled[:, None], found - theta, 0.0)
            step *= min(share, MAX_STEP / max(float(abs(step).max()), MAX_STEP))
            if abs(step).max() < SHORT:
                return (theta + step, stars + away) if share == 1.0 else (theta, stars)
            tried = replace(
                setup,
                stars=stars + away,
                observation=with_errors(observation, theta + step),
                initial_extended=np.maximum(outcome.estimate.observed_sky, 0.0),
                initial_star_fluxes=outcome.star_fluxes[: outcome.scene.n_stars],
            )
            after = run(tried)
            fall = least - after.objectives[-1] - cost(theta + step)
            if fall > 0:
                outcome, theta, stars, least = after, theta + step, tried.stars, least - fall
                if fall < np.sqrt(least):  # the noise of the objective of as many pixels
                    break
                found, away = _mean(outcome.estimate, theta, moves)
                away = away if are_moved else np.zeros_like(away)
            elif away.any():  # as PSFs may be shifted in place of stars
                away, are_moved = np.zeros_like(away), False
            else:
                share /= 2.0
    return theta, stars


def _mean(estimate: Estimate, at: Array, moves: bool) -> tuple[Array, Array]:
    """Return the mean of theta by the brightest stars, and how far all are to be moved, (n, 2).

    PSFs have theta `at` already. Stars with PSFs of their own tell nothing.
    """
    scene, n_psfs = estimate.scene, len(at)
    around, n_epochs = Surroundings(estimate, moves), scene.n_epochs
    away = np.zeros((scene.n_stars // n_epochs, 2))
    nears = [NearStar(around, star, FINISHED) for star in brightest(estimate, scene.owned < 0)]
    if not nears:
        return at, away
    nears = [near for near in nears if near.window.shape == nears[0].window.shape]
    owns = np.cumsum([0, *(near.n for near in nears)])
    images, fields, p = list[LinearImage](), list[Field](), scene.n_images
    for k, (near, first) in enumerate(zip(nears, owns, strict=False)):
        for image in near.images:
            is_own = image.unknowns < near.n
            shift = np.where(is_own, first, owns[-1] - near.n)
            images.append(image._replace(unknowns=image.unknowns + shift))
        fields += [_OfWindow(field, k * p, p, len(nears) * p) for field in near.fields]
    shared = nears[0].prior[nears[0].n :, nears[0].n :]
    prior = block_diag(*(near.prior[: near.n, : near.n] for near in nears), shared)
    if moves:
        of_places = np.concatenate(
            [first + near.unknowns[:, 1:].ravel() for near, first in zip(nears, owns, strict=False)]
        )
        prior[of_places, of_places] += AWAY**-2
    now = np.zeros(len(prior))
    of_psfs = now[owns[-1] : owns[-1] + n_psfs * N_SLOPES].reshape(n_psfs, N_SLOPES)
    of_psfs[:, :N_SHAPES] = at
    change, _ = LeastSquares(images, fields, prior, N_STEPS, FINISHED).solve(now)
    if moves:
        least = HELD * SHIFT * scene.observation.psf_error * max(map(fwhm, scene.observation.psfs))
        for near, first in zip(nears, owns, strict=False):
            moved = _moved(near, estimate, change[first:])
            if np.hypot(*moved) > least / scene.oversample:
                away[near.held[0] // n_epochs] = moved
    found = (now + change)[owns[-1] : owns[-1] + n_psfs * N_SLOPES]
    return np.asarray(found.reshape(n_psfs, N_SLOPES)[:, :N_SHAPES]), away


def _moved(near: NearStar, estimate: Estimate, change: Array) -> Array:
    """Return how far a star is to be moved, (x, y), pixels.

    A star that has lost light to the extended source is moved too far by its flux of before: what
    is linear is the product of both.
    """
    star, n_epochs = int(near.held[0]), estimate.scene.n_epochs
    is_there = near.held // n_epochs == star // n_epochs
    flux = float(estimate.fluxes[near.held[is_there]].sum())
    after = flux + float(change[near.unknowns[is_there, 0]].sum())
    return change[near.unknowns[0, 1:]] * (flux / after if after > 0 else 0.0)


class _OfWindow:
    """A field that is in p of many images, from one on: those of one window."""

    def __init__(self, field: Field, first: int, p: int, n_images: int) -> None:
        self._field, self._there, self._n = field, slice(first, first + p), n_images
        self.at = field.at

    def forward(self, x: Array) -> Iterable[Array]:
        seen = np.array(list(self._field.forward(x)))
        images = np.zeros((self._n, *seen.shape[1:]))
        images[self._there] = seen
        return images

    def adjoint(self, images: Array) -> Array:
        return self._field.adjoint(images[self._there])
