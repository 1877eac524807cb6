r"""Sources whose amounts, and perhaps places, are unknown: images linear in them near an estimate.

.. math:: g_j \approx m_j + \sum_k \eta_k \frac{\partial m_j}{\partial \eta_k}

All least squares of stars and halos begin here: whole images or windows of them, with whatever is
unknown besides (`LinearImage.beside`) and the extended source as a random field
(`lnocl.core.solvers.least_squares`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lnocl.core.scene.arrays import Array
from lnocl.core.scene.estimate import Estimate
from lnocl.core.scene.scene import MIN_MODEL
from lnocl.core.scene.view import View
from lnocl.core.solvers.fluxes import precision
from lnocl.core.solvers.least_squares import LinearImage


class Sources:
    """Some stars and halos of an estimate.

    Parameters
    ----------
    estimate : Estimate
        What is modelled, and how bright it is.
    held : ndarray of int, shape (k,)
        Stars and then halos, as in `Estimate.star_fluxes`.
    moves : bool
        Whether the places of stars are unknown too: one in all epochs.

    Attributes
    ----------
    n : int
        Unknowns: the amounts in the order of `held`, then perhaps all x, and all y.
    unknowns : ndarray of int, shape (n_stars, 1 or 3)
        Those of each star: its flux, and perhaps x and y.
    """

    def __init__(self, estimate: Estimate, held: NDArray[np.int_], moves: bool) -> None:
        self._scene, self._fluxes = estimate.scene, estimate.fluxes
        self.held, self._moves = held, moves
        stars, k = held[held < self._scene.n_stars], len(held)
        places, place = np.unique(stars // self._scene.n_epochs, return_inverse=True)
        each = [np.arange(len(stars)), k + place, k + len(places) + place]
        self.unknowns = np.stack(each if moves else each[:1], axis=1)
        self.n = k + (2 * len(places) if moves else 0)

    def linear(self, view: View, model: Array) -> LinearImage:
        """Return an image near its model m_j, in the window of the view."""
        scene, j = self._scene, view.j
        shown = np.flatnonzero(scene.shown[self.held, j])
        slopes = [view.cut(scene.star_cutout(j, s)) for s in self.held[shown]]
        unknowns = [shown]
        if self._moves:
            stars = shown[shown < len(self.unknowns)]
            moved = [view.cut(scene.star_field.with_slopes(j, s)) for s in self.held[stars]]
            fluxes = self._fluxes[self.held[stars]]
            for axis in (1, 2):
                slopes += [flux * each[axis] for flux, each in zip(fluxes, moved, strict=True)]
                unknowns.append(self.unknowns[stars, axis])
        total = np.maximum(model, MIN_MODEL)
        return LinearImage(
            np.reshape(slopes, (len(slopes), total.size)),
            np.concatenate(unknowns),
            view.counts - total,
            precision(scene, total, view.weights),
        )
