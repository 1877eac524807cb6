"""A reconstruction that is made again of other counts."""

from __future__ import annotations

import dataclasses

import numpy as np

from lnocl.core.runs.halos import settle_halos
from lnocl.core.runs.outcome import Outcome, marginalise
from lnocl.core.runs.run import complete_together, make_runs
from lnocl.core.runs.start import make_start
from lnocl.core.scene.arrays import Array
from lnocl.core.scene.penalty import Penalty
from lnocl.core.scene.star_prior import StarPrior
from lnocl.process import ignored_warnings


class RerunWithCounts:
    """Reconstructions like one, of images with the same background, PSFs and bad pixels.

    They are made by as many iterations, from the same start. All use the buffers and programs of
    one run.

    Parameters
    ----------
    outcome : Outcome
        The reconstruction.
    n : int, optional
        As many are made together, at most.
    penalty : Penalty, optional
        By default that of the reconstruction.
    """

    def __init__(self, outcome: Outcome, n: int = 1, penalty: Penalty | None = None) -> None:
        self._outcome = outcome
        with ignored_warnings():  # those of the reconstruction are the same
            start = make_start(outcome.setup, penalty or outcome.scene.penalty)
            self._start = settle_halos(start)
        self._runs = make_runs([self._start] * n, max(len(outcome.objectives) - 1, 1))

    def of(self, *given: tuple[Array, StarPrior | None]) -> list[Outcome]:
        """Return the reconstructions of images with these counts, shape (p, ny, nx), and priors.

        A prior takes the place of that of the reconstruction, where there is one. The next call
        changes the scenes of these reconstructions.

        Raises
        ------
        NotFiniteError, DivergedError
            An objective is not finite, or rises.
        """
        runs, outcome = self._runs[: len(given)], self._outcome
        for run, (counts, prior) in zip(runs, given, strict=True):
            if prior is not None:
                run.scene.star_prior = prior.scaled(run.scene.unit, run.scene.scale)
            run.repeat(self._start, outcome.scene.observation.replace(images=counts))
        with np.errstate(over="ignore", invalid="ignore"):
            complete_together(runs)
        wanted = outcome.is_marginal, outcome.has_marginal_halos, outcome.has_levels
        estimates = (marginalise(run.estimate(), *wanted) for run in runs)
        return [dataclasses.replace(outcome, estimate=estimate) for estimate in estimates]
