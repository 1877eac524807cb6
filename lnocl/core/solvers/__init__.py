"""What an iteration needs beside its kernels: the scaling of steps, and fits of stars and PSFs."""

from __future__ import annotations

from typing import Literal, get_args

SolverName = Literal["sgm", "sgp"]
SOLVERS: tuple[SolverName, ...] = get_args(SolverName)
