"""The iterations, and the fit of star fluxes and positions."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from lnocl.solvers import sgm, sgp
from lnocl.solvers.engine import Engine

Solver = Callable[[Engine, int, sgp.Steps], Iterator[int]]
SOLVERS: dict[str, Solver] = {"sgm": sgm.sgm, "sgp": sgp.sgp}
