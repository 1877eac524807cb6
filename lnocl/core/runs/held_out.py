"""Iterations and smoothing chosen by held-out counts: cross-validation by data thinning.

Data thinning gives each count to one of two halves of the observation, with probability 1/2. The
halves are independent Poisson observations of the same sky, and are reconstructed side by side.
The sum of their estimates is a reconstruction from all counts: the result, where the errors that
`lnocl.core.runs.assessment` estimates are least.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from lnocl.core.engines.engine import State
from lnocl.core.runs.assessment import assess
from lnocl.core.runs.halves import Halves, Snapshot, pack, unpack
from lnocl.core.runs.outcome import CURVE_DTYPE, Outcome
from lnocl.core.runs.start import Start
from lnocl.core.runs.thinning import split_counts
from lnocl.core.scene.arrays import Array
from lnocl.core.scene.estimate import Estimate
from lnocl.core.scene.penalty import Penalty
from lnocl.errors import InputError, detail, note, warn
from lnocl.process import ignored_notes

# The halves run to this multiple of the chosen iteration, so that the references are resolved.
LENGTH_RATIO = 2
# Where they cannot, the choice is as good down to this multiple; below it is warned, and so many
# times the iterations are named, as the halves end by themselves.
LEAST_RATIO, MORE = 1.25, 10
MIN_ITERATIONS = 10
# Snapshots before this share of the chosen iteration are dropped.
OLDEST_SNAPSHOT = 1.0 / 3.0
# With other penalties than the first the halves run to this multiple of the iteration chosen.
LATER_LENGTH = 1.5

# look(iteration, halves) returns whether to end there.
Look = Callable[[int, Halves], bool]


class HeldOutCounts:
    """The choice of the number of iterations, and of the penalty, by held-out counts.

    With the first penalty the halves start where the reconstruction does; all errors are measured
    with their last estimates. With each other one they start from a third of the iterations chosen
    with the first.

    Parameters
    ----------
    start : Start
        Where the reconstruction starts.
    penalties : sequence of Penalty
        To choose from: each is tried unless the one before was worse than the one before that.
    n_iter : int
        Iterations at most.
    stride : int
        Iterations between two looks at halves, at most.
    within : tuple of slice, optional
        Rows and columns of the sky whose errors count; by default all that images show.

    Raises
    ------
    InputError
        The images hold no counts, or too many in a pixel.
    """

    def __init__(
        self,
        start: Start,
        penalties: Sequence[Penalty],
        n_iter: int,
        stride: int,
        within: tuple[slice, slice] | None = None,
    ) -> None:
        self._start, self._penalties, self._n_iter = start, penalties, n_iter
        ny, nx = start.scene.observation.sky_shape
        self._stride, self._within = stride, within or (slice(ny), slice(nx))
        self._counts = split_counts(start.scene.observation)
        self._curves: list[NDArray[np.void]] = []
        self._first: _First | None = None
        self._best: _Best | None = None
        self._next_look = MIN_ITERATIONS
        self._halves: Halves | None = self._begin()

    def _begin(self) -> Halves:
        """Return halves with the next penalty, where they start."""
        start = self._start.penalised(self._penalties[len(self._curves)])
        starts = [start.of_half(each) for each in self._counts]
        if self._first is None:
            return Halves(starts, self._n_iter, self._stride)
        iteration, *estimates = self._first.origin
        starts = [
            half.at(extended.astype(np.float64), star_fluxes, positions)
            for half, extended, star_fluxes, positions in zip(starts, *estimates, strict=True)
        ]
        last = min(self._n_iter, math.ceil(LATER_LENGTH * self._first.n_iter))
        with ignored_notes():  # of memory, which the first halves have announced
            halves = Halves(starts, last, self._stride, iteration)
        halves.snapshots.append(self._first.origin)
        return halves

    def choose(self, look: Look, save: Callable[[], None]) -> Outcome:
        """Return the reconstruction that held-out counts choose, or that at which `look` ends it.

        Parameters
        ----------
        look : callable
            Is called after each look at the halves.
        save : callable
            Is called where `state` may be saved.

        Raises
        ------
        InputError
            No iteration of the halves is better than their start.
        NotFiniteError, DivergedError
            The objective of a half is not finite, or rises, from the start.

        Warns
        -----
        LnoclWarning
            The chosen iteration is too near `n_iter`; the objective of a half rises.
        """
        while self._halves is not None:
            if self._is_ended(self._halves, look, save):
                halves, penalty = self._halves, self._penalties[len(self._curves)]
                objectives = self._objectives(halves, halves.done)
                return self._outcome(halves.snapshot(), penalty, objectives, "callback")
            is_better = self._judge(self._halves)
            self._halves = None  # the device need not hold those of the next penalty too
            if is_better and len(self._curves) < len(self._penalties):
                self._halves = self._begin()
        best = cast(_Best, self._best)
        penalty = self._penalties[best.trial]
        if len(self._penalties) > 1:
            detail(f"`smoothing` chosen: {penalty.in_words()}, by held-out counts")
        outcome = self._outcome(best.chosen, penalty, best.objectives, "held-out")
        return replace(outcome, curve=np.concatenate(self._curves))

    @property
    def finds_no_end(self) -> bool:
        """Whether the iteration chosen with the first penalty is too near the last to be sure."""
        return LEAST_RATIO * cast(_First, self._first).n_iter > self._n_iter

    def warn_of_no_end(self, instead: Penalty | None) -> None:
        """Name the penalty of the run that is the result instead, or warn that there is none."""
        chosen = cast(_First, self._first).n_iter
        words = (
            f"held-out counts have chosen iteration {chosen} of {self._n_iter}, too near the end"
        )
        if instead is not None:
            note(
                f"{words}: the result has `smoothing` {instead.in_words()} instead, run until the "
                f"objective settled (`n_iter` {MORE * self._n_iter} lets them choose)"
            )
            return
        warn(
            f"{words} to be sure: give `n_iter` {MORE * self._n_iter}, of which they do as many as "
            "they need; if that is too near too, PSF or noise are wrong"
        )

    def _is_ended(self, halves: Halves, look: Look, save: Callable[[], None]) -> bool:
        """Run halves as long as is needed; return whether `look` has ended them before."""
        for iteration in halves:
            is_last = self._first is None and self._judge_when_due(halves)
            if look(iteration, halves):
                return True
            if is_last:
                break
            save()
        return False

    def _judge_when_due(self, halves: Halves) -> bool:
        """Drop snapshots that are too old, where that is due; return whether the end is reached."""
        last = halves.snapshots[-1]
        if last.iteration != halves.done or last.iteration < self._next_look:
            return False
        found = assess(halves.snapshots, last, self._within)
        chosen, best = (halves.snapshots[k].iteration for k in (found.chosen, found.best))
        self._next_look = max(MIN_ITERATIONS, LENGTH_RATIO * chosen)
        oldest = min(OLDEST_SNAPSHOT * chosen, best)
        halves.snapshots = [each for each in halves.snapshots if each.iteration >= oldest]
        return last.iteration >= self._next_look

    def _judge(self, halves: Halves) -> bool:
        """Record the errors of one penalty; return whether they are the least so far."""
        snapshots, trial = halves.snapshots, len(self._curves)
        if not snapshots:
            raise InputError(
                "half of the counts is too little: no iteration betters the start; give `n_iter` "
                "and `stop` None"
            )
        reference = snapshots[-1] if self._first is None else self._first.reference
        found = assess(snapshots, reference, self._within)
        chosen = snapshots[found.chosen]
        if self._first is None:
            # The least squared error is taken to be the noise alone.
            offset = found.noise[found.best] - found.excess[found.best]
            norm = max(found.squared_norm, offset, float(np.finfo(float).tiny))
            distances = [abs(s.iteration - OLDEST_SNAPSHOT * chosen.iteration) for s in snapshots]
            origin = snapshots[int(np.argmin(distances))]
            objectives = halves.objectives(origin.iteration)
            self._first = _First(chosen.iteration, offset, norm, reference, origin, objectives)
        first = self._first
        errors = np.sqrt(np.maximum(found.excess + first.offset, 0.0) / first.squared_norm)
        curve = np.zeros(len(errors), CURVE_DTYPE)
        curve["smoothing"] = self._penalties[trial].smoothing
        curve["iteration"], curve["error"] = [each.iteration for each in snapshots], errors
        self._curves.append(curve)
        error = float(errors.min())
        if self._best is not None and error >= self._best.error:
            return False
        objectives = self._objectives(halves, chosen.iteration)
        self._best = _Best(trial, error, chosen, objectives)
        return True

    def _objectives(self, halves: Halves, last: int) -> Array:
        """Return the objectives from the start up to an iteration of halves."""
        objectives = halves.objectives(last)
        if halves.first == 0:
            return objectives
        return np.concatenate([cast(_First, self._first).objectives, objectives[1:]])

    def _outcome(
        self, snapshot: Snapshot, penalty: Penalty, objectives: Array, stop_reason: str
    ) -> Outcome:
        """Return the sum of both halves' estimates; scaled, it is their mean."""
        start = self._start
        scene = start.scene.penalised(penalty)
        if start.refines:
            scene.move_stars(snapshot.positions.mean(axis=0))
        extended = np.asarray(np.mean(snapshot.extended, axis=0, dtype=np.float64))
        return Outcome(
            setup=start.setup,
            estimate=Estimate.of_scaled(scene, extended, snapshot.star_fluxes.mean(axis=0)),
            objectives=objectives,
            stop_reason=stop_reason,
        )

    def state(self) -> State:
        """Return the arrays that `restore` needs, as they are between iterations."""
        state: State = {}
        if self._halves is not None:
            state = self._halves.state() | {"next_look": np.array([self._next_look])}
        first, best = self._first, self._best
        if first is None or best is None:
            return state
        numbers = first.n_iter, first.offset, first.squared_norm, best.trial, best.error
        curves = [[*curve[name]] for name in ("iteration", "error") for curve in self._curves]
        return {
            **state,
            "trials": np.array(numbers, np.float64),
            "curve_lengths": np.array([len(curve) for curve in self._curves]),
            "curves": np.concatenate(curves),
            "origin_objectives": first.objectives,
            "best_objectives": best.objectives,
            **pack("reference", [first.reference]),
            **pack("origin", [first.origin]),
            **pack("best", [best.chosen]),
        }

    def restore(self, state: State, is_over: bool) -> None:
        """Continue from this state; where the choice is over, no halves are run any more."""
        if "trials" in state:
            self._restore_trials(state)
        if is_over:
            self._halves = None
        else:
            self._next_look, self._halves = int(state["next_look"][0]), self._begin()
            self._halves.restore(state)

    def _restore_trials(self, state: State) -> None:
        chosen, offset, squared_norm, trial, error = state["trials"].tolist()
        rows, end = state["curves"].reshape(2, -1), 0
        for penalty, length in zip(self._penalties, state["curve_lengths"], strict=False):
            curve = np.zeros(length, CURVE_DTYPE)
            curve["smoothing"] = penalty.smoothing
            curve["iteration"], curve["error"] = rows[:, end : end + length]
            self._curves.append(curve)
            end += length
        (reference,), (origin,), (best,) = (
            unpack(name, state) for name in ("reference", "origin", "best")
        )
        objectives = state["origin_objectives"]
        self._first = _First(int(chosen), offset, squared_norm, reference, origin, objectives)
        self._best = _Best(int(trial), error, best, state["best_objectives"])


class _First(NamedTuple):
    """The result of the halves with the first penalty.

    Attributes
    ----------
    n_iter : int
        The iteration chosen.
    offset, squared_norm : float
        The constant that the excess lacks, and the square of the norm of f.
    reference, origin : Snapshot
        The last estimates, and those from which the halves of other penalties start.
    objectives : ndarray of float64
        Up to those.
    """

    n_iter: int
    offset: float
    squared_norm: float
    reference: Snapshot
    origin: Snapshot
    objectives: Array


class _Best(NamedTuple):
    """The best reconstruction so far: which penalty, least error, chosen estimate, objectives."""

    trial: int
    error: float
    chosen: Snapshot
    objectives: Array
