"""The iterations, and the fit of star fluxes and positions."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Literal

from lnocl.core.scene.star_prior import StarPrior
from lnocl.core.solvers import sgm, sgp
from lnocl.core.solvers.engine import Engine

Solver = Callable[[Engine, int, sgp.Steps, StarPrior | None], Iterator[int]]
SolverName = Literal["sgp", "sgm"]
SOLVERS: dict[SolverName, Solver] = {"sgm": sgm.sgm, "sgp": sgp.sgp}
