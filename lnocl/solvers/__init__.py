"""The iterations, and the fit of star fluxes and positions."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from lnocl.solvers.engine import Engine
from lnocl.solvers.sgm import sgm
from lnocl.solvers.sgp import Steps, sgp

Solver = Callable[[Engine, int, Steps], Iterator[int]]
SOLVERS: dict[str, Solver] = {"sgm": sgm, "sgp": sgp}
