r"""Test whether a detection is a point or part of the extended source, by least squares.

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
from lnocl.core.solvers.companions import Companion, holding, step_of
from lnocl.core.solvers.near_star import NearStar, Surroundings

# The share of the gradient at which conjugate gradients end.
FINISHED = 1e-4


def point_flux(
    estimate: Estimate, place: Array, flux: float, moves: bool, raised: Array
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
    scene = estimate.scene
    point = Companion(place, max(flux, 0.0))
    other = holding(estimate, [point], resolution(scene))
    around = Surroundings(other, moves, raised, holds_shapes=True)
    near = NearStar(around, scene.n_stars, FINISHED)
    change, error, _ = step_of(near, scene.n_stars, scene.n_epochs)
    return (point.flux + change * scene.unit if error < np.inf else 0.0), error * scene.unit
