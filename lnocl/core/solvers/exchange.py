r"""The light that a star may exchange with a host, an extended source all round it.

A host that is as narrow as the PSF is hardly told from the star, and less where the PSF may be
wider or narrower than it is given. The least squares of `lnocl.core.solvers.near_star` tell how
much: with the extended source known the variance of the star's flux is ``v_0``, else v, and they
would move the flux by d. What star and extended source exchange has the variance

.. math:: v - v_0 + d^2

It is told where it is more than ``v_0``. A host has no more to give than its light
(`lnocl.core.scene.hosts`).
"""

from __future__ import annotations

import numpy as np

from lnocl.core.scene.arrays import Array, Mask
from lnocl.core.scene.estimate import Estimate
from lnocl.core.scene.hosts import light_of_host
from lnocl.core.solvers.fluxes import variances
from lnocl.core.solvers.near_star import NearStar, Surroundings, offsets_from, window_round

# The share of the gradient at which conjugate gradients end.
FINISHED = 1e-2
# The light that may be exchanged is so many standard deviations, and so many times the host's.
DEVIATIONS, MOST = 2.0, 3.0


def exchanged(estimate: Estimate, least: float) -> Array:
    """Return the share of its flux that each star may exchange with a host, shape (n,).

    It is 0 where PSFs are exact, and for stars without a host or that images do not determine.

    Parameters
    ----------
    estimate : Estimate
        What is modelled, and how bright it is.
    least : float
        Smaller shares may be 0: none is computed where a host is too faint for more.
    """
    scene, n_epochs = estimate.scene, estimate.scene.n_epochs
    shares, fluxes = np.zeros(scene.n_stars), estimate.fluxes[: scene.n_stars]
    if not scene.observation.psf_error:
        return shares
    around = Surroundings(estimate, False)
    for first in range(0, scene.n_stars, n_epochs):
        there = slice(first, first + n_epochs)
        is_lit = fluxes[there] > 0
        most = MOST * _of_host(around, first)
        if (is_lit & (least * fluxes[there] < most)).any():
            near = NearStar(around, first, FINISHED)
            light = _exchanged(near, np.isin(near.held, np.arange(first, first + n_epochs)))
            light = np.minimum(light, most)
            np.divide(light, fluxes[there], out=shares[there], where=is_lit)
    return shares


def _of_host(around: Surroundings, star: int) -> float:
    """Return the light of the host of a star, scaled."""
    scene = around.scene
    window, hidden = window_round(around, star)
    sky = around.estimate.part(window.finer(scene.oversample).of(scene.grid))
    return light_of_host(sky, *offsets_from(scene, star, window), around.width, hidden)


def _exchanged(near: NearStar, wanted: Mask) -> Array:
    """Return the light that stars which are fitted may exchange with their host, scaled."""
    unknowns = near.unknowns[wanted, 0]
    is_known = np.isfinite(variances(near.fit.information)[unknowns])
    found, at = np.zeros(len(unknowns)), unknowns[is_known]
    change, _ = near.fit.solve()
    known = near.fit_beside_known.variances(at)
    more = near.fit.variances(at) - known + change[at] ** 2
    found[is_known] = np.where(more > known, DEVIATIONS * np.sqrt(np.maximum(more, 0.0)), 0.0)
    return found
