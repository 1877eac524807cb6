"""The split-gradient method."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from lnocl.core.solvers.engine import Engine
from lnocl.core.solvers.sgp import Steps

if TYPE_CHECKING:
    from lnocl.core.scene.star_prior import StarPrior


def sgm(
    engine: Engine, n_iter: int, steps: Steps | None = None, prior: StarPrior | None = None
) -> Iterator[int]:
    """Iterate the split-gradient method, yielding the number of iterations done.

    ``c_s <- c_s / p sum_j <P_js, r_j>`` and ``f <- f / (p + mu f) sum_j A_j^T r_j``
    (La Camera et al. 2012, Eq. 9). Without stars and with ``mu = 0`` it is Richardson-Lucy for
    several images. A prior of star fluxes splits likewise, as `StarPrior.after` has it.
    """
    for iteration in range(1, n_iter + 1):
        engine.ratio()
        engine.correct()
        before = None if prior is None else engine.star_fluxes()
        engine.scale()
        if prior is not None and before is not None:
            weights = engine.scene.star_weights
            engine.set_star_fluxes(prior.after(before, engine.star_fluxes(), weights))
        yield iteration
