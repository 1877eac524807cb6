"""The penalty and the number of iterations of a run, and the curve that chose them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lnocl.runs.saved import FLOAT, UNBOUNDED, Saved, is_whole
from lnocl.scene.observation import Array
from lnocl.scene.penalty import Penalty

CURVE_DTYPE = np.dtype(
    [
        ("mu", np.float64),
        ("smoothing", np.float64),
        ("iteration", np.int64),
        ("error", np.float64),
    ]
)

EMPTY_CURVE = np.zeros(0, CURVE_DTYPE)


@dataclass
class Choice:
    """The penalty and the number of iterations, chosen by held-out counts or by the caller.

    Attributes
    ----------
    penalty : Penalty
        On the extended source.
    n_iter : int
        Iterations.
    curve : ndarray, fields ``mu``, ``smoothing``, ``iteration`` and ``error``
        Estimated relative error of the extended source, ``||f - truth|| / ||truth||``.
    """

    penalty: Penalty
    n_iter: int
    curve: NDArray[np.void]

    @classmethod
    def take(cls, saved: Saved, low: Array, high: Array) -> Choice:
        """Return the choice that a checkpoint holds.

        Parameters
        ----------
        saved : Saved
            The arrays of the checkpoint.
        low, high : ndarray of float64, shape (3,)
            Bounds of mu, smoothing and the number of iterations.

        Raises
        ------
        FileError
            It is out of bounds, or its curve is.
        """
        mu, smoothing, n_iter = saved.take("choice", FLOAT, (3,), low, high).tolist()
        saved.refuse_unless(is_whole(n_iter), f"choice holds {n_iter:g} iterations")
        return cls(Penalty(mu, smoothing), int(n_iter), take_curve(saved, "curve", int(high[2])))


def rows_of(curve: NDArray[np.void]) -> Array:
    """Return a curve as plain numbers, a row for each field."""
    return np.array([curve[name] for name in CURVE_DTYPE.names or ()], np.float64)


def take_curve(saved: Saved, name: str, n_iter: int) -> NDArray[np.void]:
    """Return the curve whose `rows_of` a checkpoint holds.

    Raises
    ------
    FileError
        No selection of so many iterations has such a curve.
    """
    low, high = np.array([[0.0, 0.0, 1.0, 0.0], [UNBOUNDED, UNBOUNDED, n_iter, UNBOUNDED]])
    shape = len(low), range(2**31)
    rows = saved.take(name, FLOAT, shape, low[:, None], high[:, None])
    saved.refuse_unless(is_whole(rows[2]), f"{name} holds parts of iterations")
    curve = np.zeros(rows.shape[1], CURVE_DTYPE)
    for name, row in zip(CURVE_DTYPE.names or (), rows, strict=True):
        curve[name] = row
    return curve
