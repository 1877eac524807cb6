"""What a solver decides in an iteration: the twins of kernels/decide.cl."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from lnocl.core.scene.arrays import Array
from lnocl.core.scene.band_matrix import bounded_step
from lnocl.core.scene.steps import CHANGE_WINDOW, NOT_FINITE, PAUSED, SETTLED, STUCK, Steps

# Bonettini, Zanella & Zanni (2009), Inverse Problems 25, 015002: the line search shortens a step by
# the first factor until the objective falls by at least the second of what the slope promises.
# Steps stay within the bounds.
SHORTER = 0.4
SUFFICIENT = 1e-4
ALPHA_BOUNDS = 1e-5, 1e5
# A step that was shortened so often is lost in rounding.
MAX_SHORTENINGS = 12


def next_step(steps: Steps, change_step: float, change_change: float) -> tuple[float, float]:
    """Return the next step and Barzilai-Borwein step from ``<D y, s>`` and ``<D y, D y>``.

    A step is the smaller of the last two of Barzilai and Borwein (1988, IMA J. Numer. Anal. 8,
    141), their second, in the metric of D; longer where J bends down. The first is given.
    """
    if steps.is_first:
        return steps.alpha, steps.length
    is_convex = change_step > 0 and change_change > 0
    length = change_step / change_change if is_convex else 10.0 * steps.alpha
    length = float(np.clip(length, *ALPHA_BOUNDS))
    return min(steps.length, length), length


def follow_stars(
    steps: Steps,
    before: Array,
    change: Array,
    star_sums: Array,
    coupling: Array,
    flux_mixes: Array,
    star_inverse: Array,
    prior_fluxes: Array,
    prior_precision: Array,
    slope: float,
    length: Sequence[float],
) -> tuple[Array, Array]:
    """Return star fluxes after a step d of the extended source, and their change by all of it.

    ``-F^-1 (gradient + <cross_information, d>)`` leads to the fluxes that are best where the step
    leads, to second order, with the information F of the start; where it leads uphill it is
    ``-F^-1 gradient``. A step that was shortened has the same change, shortened.

    Parameters
    ----------
    steps : Steps
        Updated.
    before, change : ndarray of float64, shape (n,)
        Fluxes before the step, and their change where it was shortened.
    star_sums : ndarray of float64, shape (n,)
        ``sum_j <P_js, r_j - w_j>`` before the step.
    coupling : ndarray of float64, shape (K, n)
        ``<cross_information_s, d_k>``, d_k the step of each of K skies.
    flux_mixes : ndarray of float64, shape (n, K)
        The share of each sky in the images that show a star: ``d = sum_k flux_mixes_sk d_k``.
    star_inverse : ndarray of float64, shape (n, n)
        ``F^-1``.
    prior_fluxes, prior_precision : ndarray of float64, shape (n,)
        Of the stars' prior; 0 where there is none.
    slope : float
        ``<gradient, d>`` of the extended source.
    length : sequence of float
        That of `next_step`.
    """
    if steps.shortened == 0:
        gradient = prior_precision * (before - prior_fluxes) - star_sums
        for force in (gradient + (flux_mixes.T * coupling).sum(axis=0), gradient):
            change = bounded_step(star_inverse, force, before)
            steps.slope = slope + float(gradient @ change)
            if steps.slope < 0:
                break
        steps.alpha, steps.length = length
        steps.is_first, steps.share = 0.0, 1.0
    moved = steps.share * change
    off = before - prior_fluxes + 0.5 * moved
    steps.prior_change = float((prior_precision * moved * off).sum())
    return before + moved, change


def collect_sums(
    steps: Steps,
    objectives: list[float],
    objective: float,
    squares: float,
    smoothness: float,
    star_sums: Array,
    star_weights: Array,
    mu: float,
) -> Array:
    """Record ``J_0 + mu / 2 sum f^2 +`` smoothness where it is low enough; return star corrections.

    A step is taken where the objective, with the stars' prior, falls by enough, or rises by no more
    than rounding. A star's correction is ``1 + sum_j <P_js, r_j - w_j> / sum_j <P_js, w_j>``; one
    that negative PSF pixels have made negative counts as 0.
    """
    _decide(steps, objectives, objective + 0.5 * mu * squares + smoothness)
    return np.maximum(1.0 + star_sums / star_weights, 0.0)


def _decide(steps: Steps, objectives: list[float], objective: float) -> None:
    if not steps.going:
        steps.fresh = 0.0
        return
    if steps.share > 0:
        allowed = SUFFICIENT * steps.share * steps.slope + steps.rounding * abs(objectives[-1])
        if not objective - objectives[-1] + steps.prior_change <= allowed:
            steps.fresh, steps.share = 0.0, SHORTER * steps.share
            steps.shortened += 1
            if steps.shortened == MAX_SHORTENINGS:
                steps.going = 0.0
                is_finite = math.isfinite(objective) and math.isfinite(steps.slope)
                steps.reason = STUCK if is_finite else NOT_FINITE
            return
    objectives.append(objective)
    steps.recorded, steps.shortened, steps.reason = len(objectives), 0.0, PAUSED
    if not math.isfinite(objective):
        steps.reason = NOT_FINITE
    elif _has_settled(steps, objectives):
        steps.reason = SETTLED
    steps.going = float(steps.reason == PAUSED and steps.recorded < steps.target)
    steps.fresh = 1.0 if steps.share > 0 else steps.going


def _has_settled(steps: Steps, objectives: Sequence[float]) -> bool:
    if len(objectives) <= CHANGE_WINDOW + 1 or not steps.tolerance:
        return False
    first, last = objectives[-1 - CHANGE_WINDOW], objectives[-1]
    return last == 0 or abs(last - first) < steps.tolerance * CHANGE_WINDOW * abs(last)
