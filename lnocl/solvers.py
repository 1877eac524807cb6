"""The iterations, written once over whatever engine they are handed."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

from lnocl.observation import Array


class Engine(Protocol):
    """The verbs of an iteration; estimates are on the grid and scaled, as in `lnocl.scene`."""

    def start(self, extended: Array, star_fluxes: Array) -> None:
        """Begin from this estimate."""

    def ratio(self) -> None:
        """Make the ratios of the estimate; record its objective."""

    def correct(self) -> None:
        """Back-project the ratios to the correction."""

    def scale(self) -> None:
        """Scale the estimate by its correction."""

    def extended(self) -> Array:
        """Return the extended source."""

    def star_fluxes(self) -> Array:
        """Return the star fluxes."""

    def objectives(self) -> Array:
        """Return the objectives recorded so far."""


def sgm(engine: Engine, n_iter: int) -> Iterator[int]:
    """Iterate the split-gradient method, yielding the number of iterations done.

    ``c_s <- c_s / p sum_j <P_js, r_j>`` and ``f <- f / (p + mu f) sum_j A_j^T r_j``
    (La Camera et al. 2012, Eq. 9). Without stars and with ``mu = 0`` it is Richardson-Lucy for
    several images.
    """
    for iteration in range(1, n_iter + 1):
        engine.ratio()
        engine.correct()
        engine.scale()
        yield iteration


SOLVERS = {"sgm": sgm}
