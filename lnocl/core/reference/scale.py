"""The split-gradient scaling: the twin of kernels/scale.cl."""

from __future__ import annotations

import numpy as np

from lnocl.core.reference.rows import ComplexArray, irfft_rows, rfft_rows
from lnocl.core.scene.arrays import Array


def scale_rows(
    row_spectrum: ComplexArray,
    extended: Array,
    inverse_weight: Array | float,
    mu: float,
    star_fluxes: Array,
    star_corrections: Array,
    star_weights: Array,
    prior_fluxes: Array,
    prior_precision: Array,
    slope: Array | float = 0.0,
    curvature: Array | float = 0.0,
) -> tuple[Array, ComplexArray, float, Array]:
    """Return the scaled extended source, its row spectrum and sum of squares, and star fluxes.

    ``f <- f (1 + a u) / (1 + (mu + curvature) f a)``, ``u = c + curvature f - slope``, with
    ``c = sum_j A_j^T (r_j - w_j)`` and ``a = 1 / sum_j A_j^T w_j``, 0 where nothing was observed;
    ``c_s`` becomes ``c_s (p_s u_s + q_s c0_s) / (p_s + q_s c_s)``, with its correction u_s, its
    weight p_s, and its prior's flux and precision c0_s and q_s; La Camera et al. (2012), Eq. 9, as
    ``sum_j A_j^T w_j`` is what ``r_j = w_j`` gives. slope and curvature, of the edge-preserving
    term (`smooth`), split its gradient into curvature f and what is left, neither negative.
    A correction ``1 + a u`` that rounding has made negative counts as 0.
    """
    excess = irfft_rows(row_spectrum) + curvature * extended - slope
    correction = np.maximum(1.0 + inverse_weight * excess, 0.0)
    scaled = extended * correction / (1.0 + (mu + curvature) * extended * inverse_weight)
    squares = float((scaled**2).sum())
    known = prior_precision / star_weights
    fluxes = star_fluxes * (star_corrections + known * prior_fluxes) / (1.0 + known * star_fluxes)
    return scaled, rfft_rows(scaled), squares, fluxes
