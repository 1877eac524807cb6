"""What a solver has decided in a run, so far: numbers that a device holds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lnocl.core.scene.arrays import Array

# Why a run has ended: it may go on, its objective has settled, no step lowers that, it is infinite.
PAUSED, SETTLED, STUCK, NOT_FINITE = range(4)
# Iterations over which it has settled, in the mean: a step may be short by chance, ten are not.
CHANGE_WINDOW = 10


@dataclass
class Steps:
    """What a solver has decided so far, as a run keeps it on the device, in this order.

    Attributes
    ----------
    going : float
        Whether it continues, 1 or 0.
    fresh : float
        Whether the last tick has made a new estimate.
    recorded : float
        Objectives recorded: one more than iterations done.
    target : float
        As many end it for now.
    tolerance : float
        It ends where the objective changes by less than this share of itself an iteration, in the
        mean of ten; 0 for never.
    rounding : float
        A rise of the objective, as a share of it, that may be rounding. In double precision it is
        less than the last bit: an objective that stays as it is has not risen.
    reason : float
        Why it ended: `PAUSED`, `SETTLED`, `STUCK` or `NOT_FINITE`.
    alpha : float
        The last step.
    length : float
        The last Barzilai-Borwein step.
    is_first : float
        Whether no step was made yet.
    share : float
        The share of a step that is tried; 0 where none is, as at a start.
    shortened : float
        How often that step was shortened.
    slope : float
        Its slope.
    prior_change : float
        And the change of the term of the stars' prior.
    """

    going: float = 1.0
    fresh: float = 1.0
    recorded: float = 0.0
    target: float = 2.0**24
    tolerance: float = 0.0
    rounding: float = 2.0**-54
    reason: float = PAUSED
    alpha: float = 1.0
    length: float = 1e5
    is_first: float = 1.0
    share: float = 0.0
    shortened: float = 0.0
    slope: float = 0.0
    prior_change: float = 0.0

    def numbers(self) -> Array:
        """Return all of them."""
        return np.array([*vars(self).values()])

    @property
    def done(self) -> int:
        """Iterations done."""
        return int(self.recorded) - 1
