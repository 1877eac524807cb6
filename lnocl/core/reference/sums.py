"""The objective and the star corrections: the twin of kernels/sums.cl."""

from __future__ import annotations

import numpy as np

from lnocl.core.scene.arrays import Array


def collect_sums(
    objective: float,
    squares: float,
    smoothness: float,
    star_sums: Array,
    star_weights: Array,
    mu: float,
) -> tuple[float, Array]:
    """Return the objective, ``J_0 + mu / 2 sum f^2 +`` smoothness, and the star corrections.

    A star's correction is ``1 + sum_j <P_js, r_j - w_j> / sum_j <P_js, w_j>``; one that negative
    PSF pixels have made negative counts as 0.
    """
    return objective + 0.5 * mu * squares + smoothness, np.maximum(
        1.0 + star_sums / star_weights, 0.0
    )
