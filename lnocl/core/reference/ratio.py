"""Model, ratio and data term: the twin of kernels/ratio.cl."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import xlog1py, xlogy

from lnocl.core.reference.rows import ComplexArray, irfft_rows, rfft_rows
from lnocl.core.scene.arrays import Array
from lnocl.core.scene.scene import MIN_MODEL


def ratio_rows(
    row_spectra: ComplexArray,
    images: Array,
    weights: NDArray[Any] | None,
    background: Array,
    star_images: Array,
    star_fluxes: Array,
) -> tuple[ComplexArray, float, Array]:
    """Return the row spectra of ``r_j - w_j``, the objective's data term, and the star sums.

    ``m_j = A_j f + sum_s c_s P_js + b_j``, ``r_j = w_j g_j / m_j``, ``sum_j <P_js, r_j - w_j>`` and
    ``J_0 = sum w_j (g_j ln(g_j / m_j) + m_j - g_j)``; La Camera et al. (2012), Eq. 7 and 9.
    Of the columns of ``A_j f``, each in `oversample` of them is an image's; the ratios lie there,
    and 0 in the others. Where ``m_j`` is not above `MIN_MODEL`, ``r_j = 0`` and ``m_j = MIN_MODEL``
    in J_0.
    """
    convolved = irfft_rows(row_spectra)
    oversample = convolved.shape[-1] // images.shape[-1]
    excess, objective, star_sums = compare(
        convolved[..., ::oversample], images, weights, background, star_images, star_fluxes
    )
    spread = np.zeros_like(convolved)
    spread[..., ::oversample] = excess
    return rfft_rows(spread), objective, star_sums


def compare(
    seen: Array,
    images: Array,
    weights: NDArray[Any] | None,
    background: Array,
    star_images: Array,
    star_fluxes: Array,
) -> tuple[Array, float, Array]:
    """Return ``r_j - w_j``, the data term and the star sums, from what images see of the sky."""
    model = seen + background
    model += np.einsum("s,sjyx->jyx", star_fluxes, star_images)
    dark = model <= MIN_MODEL  # which NaN is not: it reaches the objective
    model = np.where(dark, MIN_MODEL, model)
    ratio = images / model
    # Near 1 its terms of first order cancel, those of scipy.special.kl_div only the terms
    # themselves; near 0 a ratio is lost in that less 1.
    log = np.where(ratio < 0.5, xlogy(ratio, ratio), xlog1py(ratio, np.maximum(ratio, 0.5) - 1.0))
    divergence = model * (log - (ratio - 1.0))
    excess = np.where(dark, 0.0, ratio) - 1.0
    if weights is not None:
        excess, divergence = weights * excess, weights * divergence
    # Not by einsum, which adds one by one: its rounding is seen in sums of many small terms.
    star_sums = np.array([np.sum(each * excess) for each in star_images])
    return excess, float(divergence.sum()), star_sums
