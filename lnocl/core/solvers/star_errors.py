r"""Standard errors of stars whose extended source is not known either.

The joint Fisher information of the stars' fluxes and positions and of the extended source is

.. math:: \begin{pmatrix} J^T P J & J^T P A L \\ L^T A^T P J & 1 + L^T A^T P A L \end{pmatrix},

with J the derivatives of the models ``m_j``, of halos too, whose amounts are unknown, P one over
their variances, A the convolutions, and ``L = a C^(1/2)`` the root of the covariance that the
extended source is expected to have (`lnocl.core.scene.texture`), with a column for its level: what
lies under a star nothing but this tells from it. The variance of a star is a diagonal element of
the inverse. Errors of the PSFs are unknowns too, where these are not exact
(`lnocl.core.solvers.psf_errors`). The extended source is eliminated by its Schur complement, with
conjugate gradients, in a window round each star (`lnocl.core.solvers.near_star`).

A level of the background that is not known adds the square of what it changes in a star.

The same least squares tell how far a star is from where they are least, as the extended source is
not where it is expected or iterations have ended early. The square of that is added. So is the
square of what is of second order in the error e of PSFs, the share e^2 of a flux
(docs/validation/psf_error.md).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lnocl.core.scene.arrays import Array
from lnocl.core.scene.estimate import Estimate
from lnocl.core.solvers.fluxes import variances
from lnocl.core.solvers.halos import halo_errors
from lnocl.core.solvers.levels import Levels
from lnocl.core.solvers.near_star import NearStar, Surroundings

# The share of the gradient at which conjugate gradients end.
FINISHED = 1e-8


def standard_errors(
    estimate: Estimate,
    moves: bool,
    raised: Array | None = None,
    levels: Levels | None = None,
    finished: float = FINISHED,
) -> tuple[Array, Array]:
    """Return the standard errors of stars, with halos and extended source marginalised.

    Parameters
    ----------
    estimate : Estimate
        What is modelled, and how bright it is.
    moves : bool
        Whether positions were fitted too; else they are taken as known.
    raised : ndarray of float64, shape (n_shapes,), optional
        As of `lnocl.core.solvers.halos.halo_errors`, where that is known already.
    levels : Levels, optional
        Those of the background, where they are not known.
    finished : float
        The share of the gradient at which conjugate gradients end.

    Returns
    -------
    errors : ndarray of float64, shape (n, 3)
        Of flux, electrons, x and y, pixels; NaN for positions that were not fitted, and where the
        images do not determine a star.
    covariances : ndarray of float64, shape (n / n_epochs, n_epochs, n_epochs)
        Of the fluxes of each star in its epochs, electrons squared; the variances are the squares
        of the errors.
    """
    if raised is None:
        raised = halo_errors(estimate).raised
    scene, around = estimate.scene, Surroundings(estimate, moves, raised)
    errors = np.full((scene.n_stars, 3), np.nan)
    n_epochs, k = scene.observation.n_epochs, 3 if moves else 1
    covariances = np.full((scene.n_stars // n_epochs, n_epochs, n_epochs), np.nan)
    for s, each in enumerate(covariances):  # a star, which lies there in all epochs
        there = slice(s * n_epochs, (s + 1) * n_epochs)
        near = NearStar(around, there.start, finished)
        wanted = np.isin(near.held, range(there.start, there.stop))
        errors[there, :k], each[...] = _errors_of(near, wanted, levels)
    errors[:, 0] *= scene.unit
    second_order = scene.observation.psf_error**2 * estimate.star_fluxes[: scene.n_stars]
    return add_apart(errors, scene.unit**2 * covariances, second_order)


def add_apart(errors: Array, covariances: Array, more: Array) -> tuple[Array, Array]:
    """Return errors and covariances with errors of fluxes added that epochs do not share, (n,)."""
    fluxes = np.hypot(errors[:, :1], more[:, None])
    n = covariances.shape[-1]
    variances = fluxes.reshape(-1, 1, n) ** 2
    return (
        np.concatenate([fluxes, errors[:, 1:]], axis=1),
        np.where(np.eye(n, dtype=bool), variances, covariances),
    )


def without_source(estimate: Estimate, raised: Array) -> Array:
    """Return how far each star with a PSF of its own would be without an extended source, (n,).

    That is in electrons, and 0 for other stars. Such a PSF may be as wide as the extended source,
    which noise alone makes positive. `raised` is as for `standard_errors`.
    """
    scene, found = estimate.scene, np.zeros(estimate.scene.n_stars)
    for star in np.flatnonzero(scene.owned >= 0).tolist():
        near = NearStar(Surroundings(estimate, False, raised), star, FINISHED)
        seen = near.source.images_of(estimate.part(near.places(scene)))
        found[star] = scene.unit * np.vdot(near.fit.row(int(near.unknowns[0, 0])), seen)
    return found


def _errors_of(
    near: NearStar, wanted: NDArray[np.bool_], levels: Levels | None
) -> tuple[Array, Array]:
    """Return the errors of stars that are fitted, of their fluxes and perhaps x and y.

    And the covariance of their fluxes.
    """
    fit = near.fit
    unknowns = near.unknowns[wanted]
    is_determined = np.isfinite(variances(fit.information))
    errors = np.full(unknowns.shape, np.nan)
    covariance = np.full((len(unknowns),) * 2, np.nan)
    if not is_determined.any():
        return errors, covariance
    change, _ = fit.solve()
    known = is_determined[unknowns]
    at, again = np.unique(unknowns[known], return_inverse=True)
    found = fit.covariance(at)
    if levels is not None:
        shares = [near.level_shares(fit.row(i)) for i in at.tolist()]
        found = found + levels.covariance_of(shares)
    found = found + np.outer(change[at], change[at])
    errors[known] = np.sqrt(np.diag(found))[again]
    of_flux = np.flatnonzero(known[:, 0])
    places = np.searchsorted(at, unknowns[of_flux, 0])
    covariance[np.ix_(of_flux, of_flux)] = found[np.ix_(places, places)]
    return errors, covariance
