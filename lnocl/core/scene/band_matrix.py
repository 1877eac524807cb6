"""Symmetric matrices of unknowns that meet only those near them, and steps within bounds."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from lnocl.core.scene.arrays import Array

# Added to the diagonal, as a share of it, where unknowns that nothing tells apart leave the matrix
# singular: where less than this is left of an unknown beside the others.
ROUNDING = 1e-12
# A star's flux falls by this share at most in one step, so that it never reaches 0 by a step that
# was too long; rounds in which steps are brought there, and what is as good as there, as shares of
# the flux and of how far it was pushed.
MOST_FADING = 0.9
N_ROUNDS = 64
NEARLY, PUSHED = 1e-3, 1e-6


class BandMatrix:
    """A symmetric matrix, positive or 0, whose unknowns were put in an order.

    Parameters
    ----------
    band : ndarray of float64, shape (width + 1, m), in Fortran's order
        ``band[d, i]`` is the element of the unknowns at places i and i + d, as LAPACK has them.
    places : ndarray of int, shape (m,)
        The place of each unknown.
    """

    def __init__(self, band: Array, places: NDArray[np.int_]) -> None:
        self.band, self.places = band, places

    def __add__(self, other: BandMatrix) -> BandMatrix:
        return BandMatrix(self.band + other.band, self.places)

    @property
    def diagonal(self) -> Array:
        """The elements of each unknown with itself."""
        return np.asarray(self.band[0, self.places])

    def block(self, unknowns: Sequence[int] | NDArray[np.int_] | slice) -> Array:
        """Return the elements of some of the unknowns, shape (n, n), or with a slice of all."""
        at = self.places[unknowns]
        apart, first = abs(at - at[:, None]), np.minimum(at, at[:, None])
        return np.where(apart < len(self.band), self.band[apart % len(self.band), first], 0.0)

    def scaled(self, units: Array) -> BandMatrix:
        """Return the matrix with each unknown in other units: its rows and columns times these."""
        ordered = np.empty_like(units)
        ordered[self.places] = units
        width = len(self.band)
        if not len(units):
            return self
        padded = np.concatenate([ordered, np.zeros(width - 1)])
        windows = np.lib.stride_tricks.sliding_window_view(padded, width)
        band = self.band * ordered
        band *= windows.T
        return BandMatrix(band, self.places)

    def tied(self, owners: NDArray[np.int_]) -> BandMatrix:
        """Return the matrix ``B^T M B`` of fewer unknowns, of which each of these is one.

        Parameters
        ----------
        owners : ndarray of int, shape (m,)
            The new unknown that each is; all of them have one, or more.
        """
        m, at = len(self.places), owners[np.argsort(self.places)]
        places = np.argsort(np.argsort(np.unique(at, return_index=True)[1]))
        at = places[at]
        lags = [abs(at[d:] - at[: m - d]) for d in range(len(self.band))]
        held = zip(lags, self.band, strict=True)
        width = max(int(lag[elements[: len(lag)] != 0].max(initial=0)) for lag, elements in held)
        band = np.zeros((width + 1, len(places)), order="F")
        for d, (lag, elements) in enumerate(zip(lags, self.band, strict=True)):
            first = np.minimum(at[d:], at[: m - d])
            # An element beside the diagonal stands for two, which here may meet on it.
            values = elements[: m - d] * np.where((lag == 0) & (d > 0), 2.0, 1.0)
            is_there = lag <= width
            np.add.at(band, (lag[is_there], first[is_there]), values[is_there])
        return BandMatrix(band, places)

    def solve(self, x: Array) -> Array:
        """Return the inverse times x, shape (m,) or (m, several).

        Rows of unknowns without information, such as the position of a star of no flux, are 0.

        Raises
        ------
        numpy.linalg.LinAlgError
            The matrix is negative somewhere.
        """
        import scipy.linalg

        if not x.size:
            return x
        factor, units = self._factor
        units = units.reshape(-1, *[1] * (x.ndim - 1))
        ordered = np.empty(x.shape)
        ordered[self.places] = units * x
        solved = scipy.linalg.cho_solve_banded((factor, True), ordered, check_finite=False)
        return np.asarray(units * solved[self.places])

    @cached_property
    def _factor(self) -> tuple[Array, Array]:
        """The factor of Cholesky in units of the diagonal, and these."""
        roots = np.sqrt(self.diagonal)
        units = np.divide(1.0, roots, out=np.zeros_like(roots), where=roots > 0)
        with suppress(np.linalg.LinAlgError):
            factor = self._cholesky(units, 0.0)
            if factor[0].min() >= ROUNDING**0.5:
                return factor, units
        return self._cholesky(units, ROUNDING), units

    def _cholesky(self, units: Array, rounding: float) -> Array:
        import scipy.linalg

        scaled = self.scaled(units).band
        scaled[0] += np.where(scaled[0] > 0, rounding, 1.0)
        factor: Array = scipy.linalg.cholesky_banded(
            scaled, overwrite_ab=True, lower=True, check_finite=False
        )
        return factor


def bounded_step(star_inverse: Array, force: Array, fluxes: Array) -> Array:
    """Return the change of fluxes by Newton's method, none falling by more than nine tenths.

    It minimises ``<force, change> + <change, F change> / 2`` within those bounds, by the method of
    Hildreth (1957, Naval Research Logistics Quarterly 4, 79) from ``-F^-1 force``: a flux that is
    below its bound is pushed there, and pushes the others.
    """
    least = -MOST_FADING * fluxes
    variances, pushes = star_inverse.diagonal(), np.zeros(len(fluxes))
    # Without BLAS, whose rounding depends on the number of threads.
    change, known = -(star_inverse * force).sum(axis=1), np.flatnonzero(variances > 0)
    for _ in range(N_ROUNDS):
        away = abs(np.maximum(least - change, -pushes * variances))[known]
        if (away <= (NEARLY * fluxes + PUSHED * pushes * variances)[known]).all():
            break
        for t in known:
            lift = max((least[t] - change[t]) / variances[t], -pushes[t])
            change += lift * star_inverse[t]
            pushes[t] += lift
    return np.where(pushes > 0, least, np.maximum(change, least))  # without rounding
