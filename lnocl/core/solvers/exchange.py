r"""The light that a star may exchange with a host, an extended source all round it.

A host that is as narrow as the PSF is hardly told from the star, and less where the PSF may be
wider or narrower than it is given. The least squares of `lnocl.core.solvers.near_star` tell how
much: with the extended source known the variance of the star's flux is ``v_0``, else v, and they
would move the flux by d. What star and extended source exchange has the variance

.. math:: v - v_0 + d^2

It is told where it is more than ``v_0``, and is no more than the light of a host allows. A host
lies all round the star, beyond its core too, and is fainter farther off. A jet is on one side, and
a ring is brighter there.
"""

from __future__ import annotations

import numpy as np

from lnocl.core.scene.arrays import Array, Mask
from lnocl.core.scene.estimate import Estimate
from lnocl.core.scene.texture import CORE, ROUND
from lnocl.core.solvers.fluxes import variances
from lnocl.core.solvers.near_star import CUSP, NearStar, Surroundings, offsets_from, window_round

# The share of the gradient at which conjugate gradients end.
FINISHED = 1e-2
# The light that may be exchanged is so many standard deviations.
DEVIATIONS = 2.0
# How far off a host is fainter, resolutions, and the sectors in which it is looked for.
FAR, SECTORS = 3.0, 8


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
        most = DEVIATIONS * CUSP * _of_host(around, first)
        if (is_lit & (least * fluxes[there] < most)).any():
            near = NearStar(around, first, FINISHED)
            light = _exchanged(near, np.isin(near.held, np.arange(first, first + n_epochs)))
            light = np.minimum(light, most)
            np.divide(light, fluxes[there], out=shares[there], where=is_lit)
    return shares


def _of_host(around: Surroundings, star: int) -> float:
    """Return the light of the extended source that lies all round a star and falls, scaled.

    It is as bright under the star as between core and `ROUND`, by the lower quartile of sectors.
    """
    scene, width = around.scene, around.width
    window, hidden = window_round(around, star)
    rows, columns = offsets_from(scene, star, window)
    distance = (np.hypot(rows, columns) - hidden) / width
    sector = ((np.arctan2(rows, columns) / (2.0 * np.pi) + 0.5) * SECTORS).astype(int) % SECTORS
    sky = around.estimate.part(window.finer(scene.oversample).of(scene.grid))
    is_round, is_far = ((distance > a) & (distance <= b) for a, b in ((CORE, ROUND), (ROUND, FAR)))
    parts = [sky[is_round & (sector == k)] for k in range(SECTORS)]
    means = sorted(float(part.mean()) for part in parts if part.size)
    level = means[len(means) // 4] if means else 0.0
    if is_far.any() and level <= sky[is_far].mean():
        return 0.0
    return level * float(np.count_nonzero(distance <= ROUND))


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
