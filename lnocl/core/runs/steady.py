"""A run with one weight of smoothing, whose star fluxes are the prior of those that follow.

The extended source may take over the light of a star at almost no price, most of all where the core
of the star is masked. Held-out counts do not notice it: both halves do so alike, and a brighter
source has a smaller relative error. The edge-preserving term keeps the light in the star, whatever
the number of iterations (:doc:`/validation/sgp`). So a run with a fixed weight goes first, until
its objective settles. Its star fluxes, and their errors by the least squares of
`lnocl.core.solvers.near_star`, are a Gaussian prior (`lnocl.core.scene.star_prior`) in the runs
from which held-out counts choose. Where these choose an iteration too near the last, it is the
result.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from lnocl.core.runs.outcome import Outcome
from lnocl.core.runs.run import Run
from lnocl.core.runs.start import Start
from lnocl.core.scene.penalty import Penalty
from lnocl.core.scene.star_prior import StarPrior
from lnocl.process import ignored_notes, ignored_warnings

# Its weight in those that are recommended; that of runs with wrong PSFs too.
STEADY = 3.0
# It ends where the objective falls by less than this share of itself in an iteration.
SETTLED = 1e-5
# The share of the gradient at which the conjugate gradients of errors end.
FINISHED = 1e-2


def steady_penalty(penalties: Sequence[Penalty]) -> Penalty | None:
    """Return that of such a run, with `STEADY` times the recommended weight.

    `penalties` are those to choose from: none, the recommended weight, and multiples of it. Where
    there is nothing to choose there is no such run, and it is None.
    """
    if len(penalties) == 1:
        return None
    return replace(penalties[1], smoothing=STEADY * penalties[1].smoothing)


def run_steadily(
    start: Start, penalty: Penalty, n_iter: int, tick: Callable[[int], object] = int
) -> Outcome:
    """Return the outcome of a run to where it settles.

    Parameters
    ----------
    start : Start
        Where it starts.
    penalty : Penalty
        That of `steady_penalty`.
    n_iter : int
        Iterations at most.
    tick : callable, optional
        Is told how many iterations are done more.
    """
    with ignored_notes(), ignored_warnings():  # the runs that follow say the same
        run = Run(start.penalised(penalty), n_iter, tolerance=SETTLED)
        return run.outcome(run.complete(tick))


def told_prior(outcome: Outcome) -> StarPrior:
    """Return the prior of star fluxes that an outcome tells; nothing of halos."""
    from lnocl.core.solvers.star_errors import standard_errors  # which loads scipy

    scene, fluxes = outcome.scene, outcome.star_fluxes
    errors = np.full(len(fluxes), np.nan)
    for part, levels in zip(outcome.estimate.parts, outcome.levels, strict=True):
        found, _ = standard_errors(part.estimate, outcome.moves, levels=levels, finished=FINISHED)
        errors[part.fluxes[part.fluxes < scene.n_stars]] = found[:, 0]
    return StarPrior.of(fluxes, errors)
