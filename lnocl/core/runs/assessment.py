"""The errors of reconstructions of two halves of the counts, each judged by the other.

With A_k and B_k the extended sources of the halves after k iterations, A_L and B_L after the last,
the sum f_k = A_k + B_k is a reconstruction from all counts. But for a constant its squared error is

    ||f_k - f||^2 - ||f||^2 = ||f_k||^2 - 2 <f_k, f>,   <f_k, f> = 2 (<A_k, B_L> + <B_k, A_L>),

as noise of independent halves averages out of these products, and structure that L iterations have
not resolved is small where L is large. The noise alone is ||A_k - B_k||^2. The likelihood of the
held-out half itself, the usual measure, is flat over most of the run and ends it two to four times
too early: docs/validation/sgp.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lnocl.core.runs.halves import Snapshot
from lnocl.core.scene.arrays import Array
from lnocl.errors import refuse_not_finite

# The chosen iteration is the last with an error within a tenth of the least: near a star the
# estimate improves long after the rest. The least squared error is taken to be the noise alone;
# unresolved structure adds as much again and more, so that a tenth is cautious.
ERROR_TOLERANCE = 0.1


class Assessment(NamedTuple):
    """The errors of snapshots, squared.

    Attributes
    ----------
    excess, noise : ndarray of float64
        ``||f_k||^2 - 2 <f_k, f>`` and ``||A_k - B_k||^2`` of each.
    squared_norm : float
        The square of the norm of f.
    best, chosen : int
        The snapshots of the least error, and to choose.
    """

    excess: Array
    noise: Array
    squared_norm: float
    best: int
    chosen: int


def assess(
    snapshots: Sequence[Snapshot], reference: Snapshot, within: tuple[slice, slice]
) -> Assessment:
    """Return the errors of snapshots.

    Parameters
    ----------
    snapshots : sequence of Snapshot
        At least one.
    reference : Snapshot
        A_L and B_L.
    within : tuple of slice
        Rows and columns within which errors are measured.

    Raises
    ------
    NotFiniteError
        Estimates are infinite or not a number.
    """

    def products(a: NDArray[np.floating], b: NDArray[np.floating]) -> Array:
        rows = np.einsum("...yx,...yx->...y", a[..., *within], b[..., *within])
        return np.asarray(rows.sum(axis=-1, dtype=np.float64))

    def product(a: NDArray[np.floating], b: NDArray[np.floating]) -> float:
        return float((products(a, b) * weights).sum())

    a_last, b_last = reference.extended
    weights = np.ones(a_last.shape[:-2])
    if weights.ndim:  # the noise of each sky counts alike, however bright it is
        difference = a_last - b_last
        noise_of = products(difference, difference)
        weights = noise_of.max() / np.maximum(noise_of, np.finfo(np.float32).eps * noise_of.max())
    excess, noise = np.zeros((2, len(snapshots)))
    for k, snapshot in enumerate(snapshots):
        a, b = snapshot.extended
        squares, mixed = product(a, a) + product(b, b), 2.0 * product(a, b)
        noise[k] = max(squares - mixed, 0.0)  # which rounding leaves below it where both are equal
        excess[k] = squares + mixed - 4.0 * (product(a, b_last) + product(b, a_last))
    refuse_not_finite(*excess, *noise)
    best = int(np.argmin(excess))
    allowed = ((1.0 + ERROR_TOLERANCE) ** 2 - 1.0) * noise[best]
    chosen = int(np.flatnonzero(excess <= excess[best] + allowed)[-1])
    return Assessment(excess, noise, 4.0 * product(a_last, b_last), best, chosen)
