r"""Whether the extended source could be what a place holds, by the least squares of a point there.

A point takes the place of the light of the estimate within a resolution, where the extended source
is expected to go on inwards as it is round it (`lnocl.core.scene.texture`). Flux and error follow
from the least squares of `lnocl.core.solvers.near_star`, with stars near it, halos and the extended
source marginalised.
"""

from __future__ import annotations

import numpy as np

from lnocl.core.scene.arrays import Array
from lnocl.core.scene.estimate import Estimate
from lnocl.core.scene.texture import resolution
from lnocl.core.solvers.companions import Companion, holding
from lnocl.core.solvers.fluxes import variances
from lnocl.core.solvers.near_star import NearStar, Surroundings

# The share of the gradient at which conjugate gradients end.
FINISHED = 1e-4


def point_flux(
    estimate: Estimate,
    place: Array,
    flux: float,
    moves: bool,
    raised: Array,
) -> tuple[float, float]:
    """Return the flux of a point at a place and its standard error, electrons.

    Parameters
    ----------
    estimate : Estimate
        What is modelled, and how bright it is.
    place : ndarray of float64, shape (2,)
        (x, y), pixels of the images.
    flux : float
        About that of the point, electrons.
    moves : bool
        Whether positions of stars are unknown.
    raised : ndarray of float64, shape (n_shapes,)
        As of `lnocl.core.solvers.halos.halo_errors`: halos are unknown too.
    """
    n, n_epochs = estimate.scene.n_stars, estimate.scene.n_epochs
    point = Companion(place, max(flux, 0.0), np.zeros(3), 0.0)
    other = holding(estimate, [point], resolution(estimate.scene))
    near = NearStar(Surroundings(other, moves, raised, holds_shapes=True), n, FINISHED)
    at = np.array([np.flatnonzero(near.held == s)[0] for s in range(n, n + n_epochs)])
    at = at[np.isfinite(variances(near.fit.information)[at])]
    if not len(at):
        return 0.0, np.inf
    change, _ = near.fit.solve()
    values = point.flux + change[at] * estimate.scene.unit
    weights = 1.0 / near.fit.variances(at)
    mean = float((weights * values).sum() / weights.sum())
    return mean, float(weights.sum() ** -0.5) * estimate.scene.unit
