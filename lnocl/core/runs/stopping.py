"""Stopping rules: each looks at a run after every iteration."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from lnocl.core.runs.run import Run
from lnocl.core.scene.arrays import Array
from lnocl.core.scene.steps import CHANGE_WINDOW
from lnocl.errors import warn

if TYPE_CHECKING:
    from lnocl.core.scene.forward_model import Model


class Rule:
    """A rule that ends a run; this one leaves it to go on to its last iteration.

    Attributes
    ----------
    reason : str
        The reason that it gives.
    tolerance : float
        That of the run.
    looks : bool
        Whether it looks at each iteration.
    """

    reason, tolerance, looks = "n_iter", 0.0, False

    def met(self, run: Run) -> bool:
        """Return whether the run should end; asked once after each look at it."""
        return False

    def miss(self, run: Run) -> None:
        """Tell, after the last iteration, that the rule was not met, where that matters."""

    def quantity(self, run: Run) -> str:
        """Return the quantity that decides, for the progress bar."""
        return f"objective {run.objective():.6g}"

    def state(self) -> Array:
        """Return the numbers that `restore` needs."""
        return np.zeros(0)

    def restore(self, state: Array) -> None:
        """Continue from this state."""


class Change(Rule):
    """The relative change of the objective an iteration, its mean over ten, falls below a bound."""

    reason = "change"

    def __init__(self, threshold: float) -> None:
        self.tolerance = threshold

    def met(self, run: Run) -> bool:
        """Return whether the objective has settled."""
        return run.is_settled

    def quantity(self, run: Run) -> str:
        """Return the relative change an iteration."""
        recent = run.engine.objectives()[-1 - CHANGE_WINDOW :]
        change = abs(recent[0] - recent[-1]) / max(len(recent) - 1, 1)
        return f"change {change / (abs(recent[-1]) or 1.0):.2g}"


class Discrepancy(Rule):
    """The data term falls to its expectation for Poisson noise alone.

    ``2 J_0 = sum_j sum_n e(m_j)`` over the observed pixels, with ``e(m)`` the expectation of
    ``2 (g ln(g / m) + m - g)`` for Poisson counts g of mean m: 1 for many counts (Bertero et al.
    2010, Inverse Problems 26, 105004), up to 1.15 for about one, and down to 0 for fewer. The
    expectation is updated at iterations 1, 2, 4, 8 ..., and before the run ends.
    """

    reason, looks = "discrepancy", True

    def __init__(self) -> None:
        self._model: Model | None = None
        self._stars: Array | None = None
        self._expected = 0.0

    def met(self, run: Run) -> bool:
        """Return whether the data are fitted as well as noise allows."""
        if run.done & (run.done - 1) == 0:
            self._expected = self._expect(run)
        if self._discrepancy(run) > 1.0:
            return False
        self._expected = self._expect(run)
        return self._discrepancy(run) <= 1.0

    def miss(self, run: Run) -> None:
        """Warn of a model that does not fit as noise would."""
        self._expected = self._expect(run)
        warn(
            f"the discrepancy was not reached: after {run.done} iterations it is "
            f"{self._discrepancy(run):.3g}, and noise alone has 1; see to PSFs and noise, or raise "
            "`n_iter`"
        )

    def quantity(self, run: Run) -> str:
        """Return the data term over its expectation."""
        return f"discrepancy {self._discrepancy(run):.4g}"

    def state(self) -> Array:
        """Return the expectation."""
        return np.array([self._expected])

    def restore(self, state: Array) -> None:
        """Continue with this expectation."""
        self._expected = float(state[0])

    def _discrepancy(self, run: Run) -> float:
        return 2.0 * run.engine.data_term() * run.scene.scale / self._expected

    def _expect(self, run: Run) -> float:
        from lnocl.core.scene.forward_model import Model

        if self._model is None or self._stars is not run.scene.stars:  # they may have moved
            self._model, self._stars = Model(run.scene), run.scene.stars
        weights = self._model.weights
        extended = run.engine.extended().astype(np.float64)
        means = weights * self._model.images(extended, run.engine.star_fluxes())
        return float(expected_deviance(means * run.scene.scale)[weights > 0].sum())


# Above this mean the expectation is 1 + 1 / (6 m), to a part in ten million.
TABLE_END = 1e3


def expected_deviance(mean: ArrayLike) -> Array:
    """Return ``E[2 (g ln(g / m) + m - g)]`` for Poisson counts g of mean m.

    Parameters
    ----------
    mean : array_like
        m, zero or more.

    Examples
    --------
    >>> from lnocl.core.runs.stopping import expected_deviance
    >>> expected_deviance([1e-3, 1.0, 1e6]).round(3)
    array([0.014, 1.147, 1.   ])
    """
    mean = np.asarray(mean, np.float64)
    least, spline = _deviances()
    few = spline(np.log(np.clip(mean, least, TABLE_END)))
    return np.where(mean > TABLE_END, 1.0 + 1.0 / (6.0 * np.maximum(mean, 1.0)), few)


@cache
def _deviances() -> tuple[float, Any]:
    """Return the least mean of the table, and its spline over the logarithms of the means."""
    import scipy.interpolate
    import scipy.special
    import scipy.stats

    means = np.geomspace(1e-6, TABLE_END, 400)
    counts = np.arange(2000)[:, None]
    terms = scipy.special.xlogy(counts, counts / means) + means - counts
    deviances = 2.0 * (scipy.stats.poisson.pmf(counts, means) * terms).sum(axis=0)
    return float(means[0]), scipy.interpolate.CubicSpline(np.log(means), deviances)


def make_rule(stop: str | float | None) -> Rule:
    """Return the rule of this name; held-out counts have chosen the iteration beforehand."""
    if stop == "discrepancy":
        return Discrepancy()
    if stop is None or stop == "held-out":
        return Rule()
    return Change(float(stop))
