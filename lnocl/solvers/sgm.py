"""The split-gradient method."""

from __future__ import annotations

from collections.abc import Iterator

from lnocl.solvers.engine import Engine
from lnocl.solvers.sgp import Steps


def sgm(engine: Engine, n_iter: int, steps: Steps | None = None) -> Iterator[int]:
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
