"""Gradient and projected step: the twins of kernels/step.cl."""

from __future__ import annotations

import numpy as np

from lnocl.core.reference.decide import SHORTER
from lnocl.core.reference.rows import ComplexArray, irfft_rows, rfft_rows
from lnocl.core.scene.arrays import Array


def gradient_rows(
    row_spectrum: ComplexArray,
    extended: Array,
    previous: Array,
    gradient: Array,
    shift: Array,
    inverse_weight: Array | float,
    mu: float,
    slope: Array | float = 0.0,
    curvature: Array | float = 0.0,
) -> tuple[Array, float, float]:
    """Return the gradient of J in f, ``<D y, s>`` and ``<D y, D y>``.

    The gradient is ``mu f + slope - c``, ``c = sum_j A_j^T (r_j - w_j)``; y is its change from
    `gradient` and s that of f from `previous`. With z the shift,
    ``D = (f + z) a / (1 + (mu + curvature) (f + z) a)``.
    """
    following = mu * extended + slope - irfft_rows(row_spectrum)
    scaling = _shifted_scaling(extended, shift, inverse_weight, mu + curvature)
    change = scaling * (following - gradient)
    return following, float((change * (extended - previous)).sum()), float((change**2).sum())


def _shifted_scaling(
    extended: Array, shift: Array, inverse_weight: Array | float, penalty_weight: Array | float
) -> Array:
    scaled = (extended + shift) * inverse_weight
    return scaled / (1.0 + penalty_weight * scaled)


def step_rows(
    extended: Array,
    gradient: Array,
    shift: Array,
    inverse_weight: Array | float,
    cross_information: Array,
    mu: float,
    alpha: float,
    curvature: Array | float = 0.0,
) -> tuple[Array, ComplexArray, float, float, Array]:
    """Return ``f + d``, its row spectrum and squares, ``<gradient, d>`` and ``<c_s, d>``.

    ``d = P(f - alpha D gradient) - f`` with P the projection on ``f >= 0``, D as in
    `gradient_rows`, and c_s the cross information of star s; Bonettini, Zanella & Zanni (2009),
    Inverse Problems 25, 015002. The last has shape (K, n), of d of each of K skies.
    """
    scaling = _shifted_scaling(extended, shift, inverse_weight, mu + curvature)
    trial = np.maximum(extended - alpha * scaling * gradient, 0.0)
    direction = trial - extended
    slope = float((gradient * direction).sum())
    of_skies = direction.reshape(-1, 1, *direction.shape[-2:])
    coupling = (cross_information * of_skies).sum(axis=(-2, -1))
    return trial, rfft_rows(trial), float((trial**2).sum()), slope, coupling


def shortened(extended: Array, previous: Array) -> tuple[Array, ComplexArray, float]:
    """Return an estimate nearer to the one before it, its row spectrum and squares.

    It is what `step_rows` makes where its last step was refused.
    """
    trial = previous + SHORTER * (extended - previous)
    return trial, rfft_rows(trial), float((trial**2).sum())
