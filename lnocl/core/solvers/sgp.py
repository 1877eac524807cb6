"""The scaled gradient projection method."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, cast

import numpy as np

from lnocl.core.solvers.engine import Engine
from lnocl.errors import refuse_not_finite

if TYPE_CHECKING:
    from lnocl.core.scene.star_prior import StarPrior
    from lnocl.core.solvers.scaling import Scaling

# Bonettini, Zanella & Zanni (2009), Inverse Problems 25, 015002: the line search shortens a step by
# the first factor until the objective falls by at least the second of what the slope promises.
# Steps stay within the bounds.
SHORTER = 0.4
SUFFICIENT = 1e-4
ALPHA_BOUNDS = 1e-5, 1e5
# The step is the smallest of so many Barzilai-Borwein steps: docs/validation/sgp.md.
N_LENGTHS = 2
# A step that was shortened so often is lost in rounding.
MAX_SHORTENINGS = 12


@dataclass
class Steps:
    """The step lengths that the scaled gradient projection method keeps between iterations.

    Attributes
    ----------
    alpha : float
        The last step.
    lengths : list of float
        The last Barzilai-Borwein steps.
    has_iterated : bool
        Whether an iteration was done.
    """

    alpha: float = 1.0
    lengths: list[float] = field(default_factory=lambda: [ALPHA_BOUNDS[1]] * N_LENGTHS)
    has_iterated: bool = False


def sgp(
    engine: Engine, n_iter: int, steps: Steps | None = None, prior: StarPrior | None = None
) -> Iterator[int]:
    """Iterate the scaled gradient projection method, yielding the number of iterations done.

    ``f <- f + share d``, ``d = P(f - alpha D grad J) - f``, P the projection on ``f >= 0`` and D
    the shifted scaling of `lnocl.core.solvers.scaling` (Bonettini, Zanella & Zanni 2009, Inverse
    Problems 25, 015002). alpha is the smaller of the last two steps of Barzilai and Borwein (1988,
    IMA J. Numer. Anal. 8, 141), their second, in the metric of D. The star fluxes follow the
    extended source, by `Scaling.star_step`. The share is 1, shortened until the objective falls
    enough, or rises by no more than rounding. The method ends early where no step lowers the
    objective any more. With a prior of star fluxes its term is part of the objective here, not of
    that which the engine records.
    """
    steps = steps or Steps()
    engine.ratio()
    engine.correct()
    for iteration in range(1, n_iter + 1):
        change_step, change_change = engine.gradient()
        if steps.has_iterated:
            length = _barzilai_borwein(change_step, change_change, steps.alpha)
            steps.lengths = [*steps.lengths[1:], length]
            steps.alpha = min(steps.lengths)
        steps.has_iterated = True
        if not _descend(engine, steps.alpha, prior):
            return
        yield iteration


def _barzilai_borwein(change_step: float, change_change: float, alpha: float) -> float:
    """Return the next alpha from ``<D y, s>`` and ``<D y, D y>``; longer where J bends down."""
    step = change_step / change_change if min(change_step, change_change) > 0 else 10.0 * alpha
    return float(np.clip(step, *ALPHA_BOUNDS))


def _descend(engine: Engine, alpha: float, prior: StarPrior | None) -> bool:
    """Step along the projected gradient as far as the objective falls; return whether it fell."""
    objective, fluxes, gradient = engine.objective(), engine.star_fluxes(), engine.star_gradient()
    before = 0.0
    if prior is not None:
        before, gradient = prior.value(fluxes), gradient + prior.gradient(fluxes)
    slope, coupling = engine.step(alpha, 1.0)
    refuse_not_finite(objective, slope, *gradient, *coupling)
    scaling = cast("Scaling", engine.scaling)
    change = scaling.star_step(fluxes, gradient, coupling)
    if slope + gradient @ change >= 0:  # following the extended source would lead uphill
        change = scaling.star_step(fluxes, gradient, np.zeros_like(coupling))
    slope += float(gradient @ change)
    share, rounding = 1.0, engine.rounding * abs(objective)
    for _ in range(MAX_SHORTENINGS):
        engine.set_star_fluxes(fluxes + share * change)
        engine.ratio()
        engine.correct()  # perhaps in vain, but the device need not wait
        trial_objective = engine.objective()
        if prior is not None:
            trial_objective += prior.value(fluxes + share * change) - before
        if trial_objective <= objective + SUFFICIENT * share * slope + rounding:
            return True
        engine.forget_objective()
        share *= SHORTER
        engine.step(alpha, share)
    refuse_not_finite(trial_objective)  # however short the step
    engine.step(alpha, 0.0)
    engine.set_star_fluxes(fluxes)
    return False
