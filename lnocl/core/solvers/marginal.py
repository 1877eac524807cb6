r"""Star fluxes with the extended source marginalised, whatever iteration a run ended with.

What lies under the core of a star belongs to it or to the extended source: the counts hardly tell,
and early iterations leave it to the star, with a hole in the extended source. Each star takes a
step of Newton to where the least squares of `lnocl.core.solvers.near_star` have it,

.. math:: c_s \gets \max(c_s + \Delta c_s, 0),

in which the extended source is expected to go on under the star as it falls round it
(`lnocl.core.scene.texture`). It takes the light that the same step gives it in the core of the
star, but no more than the star has lost or won. Of what PSFs may have wrong their pixels are free.
Their shapes are held, as they are fitted before (`lnocl.core.runs.psf_posterior`): the errors of
stars (`lnocl.core.solvers.star_errors`) have these, with what they would move fluxes by.
"""

from __future__ import annotations

import numpy as np

from lnocl.core.scene.estimate import Estimate
from lnocl.core.scene.texture import core
from lnocl.core.solvers.fluxes import variances
from lnocl.core.solvers.near_star import NearStar, Surroundings, offsets_from

# The share of the gradient at which conjugate gradients end.
FINISHED = 1e-4


def marginal(estimate: Estimate) -> Estimate:
    """Return the estimate after that step, the positions held.

    Parameters
    ----------
    estimate : Estimate
        Its extended source is zero or more.

    Returns
    -------
    Estimate
        That after the step. A star without light, or that the images do not determine, stays.
    """
    scene, star_fluxes = estimate.scene, estimate.star_fluxes
    around = Surroundings(estimate, False, holds_shapes=True)
    after, fluxes = estimate.sky.copy(), star_fluxes.copy()
    n_epochs = scene.observation.n_epochs
    for first in range(0, scene.n_stars, n_epochs):
        # The star in all epochs that show it; one without light in any, or not determined, stays.
        star = first + np.flatnonzero(scene.is_shown[first : first + n_epochs])
        if not (star_fluxes[star] > 0).any():
            continue
        near = NearStar(around, first, FINISHED)
        at = [int(np.flatnonzero(near.held == s)[0]) for s in star]
        is_free = np.isfinite(variances(near.fit.information)[at]) & (star_fluxes[star] > 0)
        if not is_free.any():
            continue
        change, (x, *_) = near.fit.solve()
        moved = np.maximum(star_fluxes[star] + change[at] * scene.unit, 0.0)
        fluxes[star] = np.where(is_free, moved, star_fluxes[star])
        there = near.places(scene)
        away = np.hypot(*offsets_from(scene, first, near.window))
        of_core = core(np.maximum(away - near.hidden, 0.0) / near.resolution)
        light = of_core * (near.expected + near.source.of(x)) * scene.unit
        light = np.maximum(light, -after[there])
        lost = float((star_fluxes[star] - fluxes[star]).mean()) * scene.share_shown(first)
        whole = float(light.sum())  # of which some is taken, not less than nothing, nor more
        after[there] += light * (np.clip(lost / whole, 0.0, 1.0) if whole else 0.0)
    return Estimate(scene, after, fluxes)
