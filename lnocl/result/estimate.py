"""The estimate that the callback of `deconvolve` is given."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from lnocl.core.scene.arrays import Array


class Iterating(Protocol):
    """A run, or the two runs of held-out counts: both have an estimate."""

    def extended(self) -> Array:
        """Return the extended source, electrons per pixel, shape (ny, nx)."""

    def star_fluxes(self) -> Array:
        """Return the fluxes of stars, and then of halos, electrons."""

    def is_shown(self) -> NDArray[np.bool_]:
        """Return which of these any image shows."""

    def star_positions(self) -> Array:
        """Return the star positions, pixels, shape (n, 2)."""


class Estimate:
    """The estimate of an iteration, as the callback of `lnocl.deconvolve` gets it.

    An array is fetched from the device when it is first read, and has to be read before the
    callback returns.

    Attributes
    ----------
    extended : ndarray of float64
        Extended source, electrons per pixel.
    star_fluxes : ndarray of float64, shape (n,)
        Electrons.
    star_positions : ndarray of float64, shape (n, 2)
        (x, y) in pixels.

    Examples
    --------
    >>> import numpy as np
    >>> import lnocl
    >>> obs = lnocl.Observation(np.full((8, 8), 4.0), np.ones((1, 1)))
    >>> def show(iteration, estimate):
    ...     print(iteration, estimate.extended.sum().round(6), estimate.star_fluxes.shape)
    >>> options = {"n_iter": 2, "stop": None, "engine": "numpy"}
    >>> result = lnocl.deconvolve(obs, solver="sgm", smoothing=0, callback=show, **options)
    1 256.0 (0,)
    2 256.0 (0,)
    """

    def __init__(self, run: Iterating) -> None:
        self._run: Iterating | None = run

    @cached_property
    def extended(self) -> Array:
        """Extended source, electrons per pixel of it.

        Its shape is the observation's ``sky_shape``: that of the images, times ``oversample``.
        """
        return self._live().extended()

    @cached_property
    def star_fluxes(self) -> Array:
        """Star fluxes, electrons, shape (n,); NaN where no good pixel shows a star."""
        run = self._live()
        return np.where(run.is_shown(), run.star_fluxes(), np.nan)[: len(run.star_positions())]

    @cached_property
    def star_positions(self) -> Array:
        """Star positions, (x, y) in pixels as last refined, shape (n, 2)."""
        return self._live().star_positions().copy()

    def _live(self) -> Iterating:
        if self._run is None:
            raise RuntimeError("read what you need of the estimate before the callback returns")
        return self._run

    def _close(self) -> None:
        self._run = None


Callback = Callable[[int, Estimate], Any]
