"""Iterations and penalty chosen by held-out counts: cross-validation by data thinning.

Data thinning gives each count to one of two halves of the observation, with probability 1/2. The
halves are independent Poisson observations of the same sky, and are reconstructed side by side.
With A_k and B_k their extended sources after k iterations, A_L and B_L after the last, the sum
A_k + B_k is a reconstruction f_k from all counts. But for a constant its squared error is

    ||f_k - f||^2 - ||f||^2 = ||f_k||^2 - 2 <f_k, f>,   <f_k, f> = 2 (<A_k, B_L> + <B_k, A_L>),

as noise of independent halves averages out of these products, and structure that L iterations have
not resolved is small where L is large. The noise alone is ||A_k - B_k||^2. The errors are averaged
over several splits of the counts. The likelihood of the held-out half itself, the usual measure, is
flat over most of the run and ends it two to four times too early: docs/sgp.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lnocl.errors import DivergedError, InputError, LnoclWarning, refuse_not_finite, warn
from lnocl.process import ignored_warnings
from lnocl.runs.choice import CURVE_DTYPE, Choice, rows_of, take_curve
from lnocl.runs.run import Run, Setup
from lnocl.runs.run import most_bytes as most_bytes_of_run
from lnocl.runs.saved import FLOAT, UNBOUNDED, Saved, is_whole
from lnocl.runs.thinning import split_counts
from lnocl.scene.observation import Array, Observation
from lnocl.scene.penalty import Penalty
from lnocl.solvers.engine import State

# The chosen iteration is the last with an error within a tenth of the least: near a star the
# estimate improves long after the rest. The least squared error is taken to be the noise alone;
# unresolved structure adds as much again and more, so that a tenth is cautious.
ERROR_TOLERANCE = 0.1
# The halves run to this multiple of the chosen iteration, so that the references are resolved.
LENGTH_RATIO = 2
MIN_ITERATIONS = 10
# Splits of the counts that are averaged over.
N_SPLITS = 3
# The ratio of one iteration at which the halves are compared to that before.
SPACING = 1.1
# Snapshots before this share of the chosen iteration are dropped.
OLDEST_SNAPSHOT = 1.0 / 3.0
# mu in units of p over the largest value of the extended source, at which the Tikhonov term takes
# half of the brightest pixel.
MU_GRID = 10.0 ** np.arange(-3.0, 0.1, 0.5)
# The weight of the edge-preserving term in units of the noise of the gradient of the data term.
SMOOTHING_GRID = 10.0 ** np.arange(-1.5, 0.6, 0.5)

MAX_CANDIDATES = 1 + max(len(MU_GRID), len(SMOOTHING_GRID))

# The prefix, before a number, of the names under which the state of each half is saved.
HALVES = "halves_"

Snapshot = NDArray[np.float32]
Pair = tuple[Snapshot, Snapshot]
StartRun = Callable[[Observation, Penalty], Run]
PenaltyGrid = Callable[[Observation, float], list[Penalty]]


def mu_grid(smoothing: float) -> PenaltyGrid:
    """Return a function that makes the penalties to choose mu from, given the brightest pixel."""

    def grid(observation: Observation, brightest: float) -> list[Penalty]:
        total = observation.exposure.sum(axis=0).max()
        return [Penalty(mu, smoothing) for mu in MU_GRID * total / brightest]

    return grid


def smoothing_grid(mu: float) -> PenaltyGrid:
    """Return a function that makes the penalties to choose the smoothing from.

    Their unit is the standard deviation of the gradient of the data term by the noise of the
    counts, ``sqrt(sum_j <e_j^2 / g_j> sum K_j^2)``, < > the mean over the observed pixels.
    """

    def grid(observation: Observation, brightest: float) -> list[Penalty]:
        relative = observation.exposure
        if relative.ndim == 1:
            relative = relative[:, None, None]
        variance = np.ma.masked_array(
            relative**2 / np.maximum(observation.images, 1.0), observation.mask
        ).mean(axis=(1, 2))
        squares = (observation.psfs**2).sum(axis=(1, 2))
        noise = float(np.sqrt((variance * squares).sum()))
        return [Penalty(mu, smoothing) for smoothing in SMOOTHING_GRID * noise]

    return grid


class _Trial:
    """The runs on all pairs of halves at one penalty, with snapshots of their extended sources."""

    def __init__(self, runs: Sequence[tuple[Run, Run]]) -> None:
        self._runs = runs
        self.snapshots: list[tuple[int, list[Pair]]] = []

    def advance(self) -> Iterator[int]:
        """Iterate to the next snapshot and yield its iteration, until a run ends.

        Where an objective rises, the trial ends at the last snapshot before that.

        Raises
        ------
        DivergedError
            An objective rises, and no snapshot before that is left.

        Warns
        -----
        LnoclWarning
            An objective rises.
        """
        last = self.iterations[-1] if self.snapshots else 0
        due = _next_snapshot(last)
        try:
            for iteration, *_ in zip(*(run for pair in self._runs for run in pair), strict=False):
                if iteration == due:
                    pairs = [(_flat(a), _flat(b)) for a, b in self._runs]
                    self.snapshots.append((iteration, pairs))
                    due = _next_snapshot(due)
                    yield iteration
        except DivergedError:
            best = min(run.best_iteration() for pair in self._runs for run in pair)
            self.snapshots = [each for each in self.snapshots if each[0] <= best]
            if not self.snapshots:
                raise
            warn(
                f"the objective of a half of the counts rises after iteration {best}: held-out "
                f"counts choose among the iterations up to {self.iterations[-1]}"
            )

    def state(self) -> State:
        """Return the arrays that `restore` needs, right after a snapshot."""
        runs = enumerate(run for pair in self._runs for run in pair)
        state = {f"{HALVES}{k}_{name}": a for k, run in runs for name, a in run.state().items()}
        state["snapshot_iterations"] = np.array(self.iterations)
        state["snapshots"] = np.array([pairs for _, pairs in self.snapshots])
        return state

    def restore(self, saved: Saved) -> None:
        """Continue from the state in a checkpoint.

        Raises
        ------
        FileError
            The trial cannot have such a state.
        """
        runs, states = [run for pair in self._runs for run in pair], []
        for k, run in enumerate(runs):
            with saved.part(f"{HALVES}{k}_"):
                states.append(run.take(saved))
        n_iter = runs[0].n_iter
        iterations = saved.take(
            "snapshot_iterations", np.dtype(np.int64), (range(1, n_iter + 1),), 1, n_iter
        ).tolist()
        saved.refuse_unless(
            {state["progress"][0] for state in states} == {iterations[-1]}
            and iterations == sorted(set(iterations)),
            "snapshot_iterations does not end where its runs are",
        )
        shape = len(iterations), len(self._runs), 2, runs[0].scene.observation.images[0].size
        snapshots = saved.take("snapshots", np.dtype(np.float32), shape, 0.0)
        saved.refuse_others()
        for run, state in zip(runs, states, strict=True):
            run.restore(state)
        self.snapshots = [
            (iteration, [(a, b) for a, b in pairs])
            for iteration, pairs in zip(iterations, snapshots, strict=True)
        ]

    def drop_before(self, first: float) -> None:
        """Drop the snapshots before an iteration."""
        self.snapshots = [each for each in self.snapshots if each[0] >= first]

    @property
    def iterations(self) -> list[int]:
        """The iterations of the snapshots."""
        return [iteration for iteration, _ in self.snapshots]

    @property
    def last(self) -> list[Pair]:
        """The last snapshot."""
        return self.snapshots[-1][1]

    def excess(self, reference: Sequence[Pair]) -> Array:
        """Return ``||f_k||^2 - 2 <f_k, f>`` of each snapshot, with the reference for A_L, B_L."""
        return np.array(
            [
                np.mean(
                    [
                        _dot(a + b, a + b) - 4.0 * (_dot(a, b_end) + _dot(b, a_end))
                        for (a, b), (a_end, b_end) in zip(pairs, reference, strict=True)
                    ]
                )
                for _, pairs in self.snapshots
            ]
        )

    def noise(self, at: int) -> float:
        """Return ``||A_k - B_k||^2`` of one of the snapshots."""
        return float(np.mean([_dot(a - b, a - b) for a, b in self.snapshots[at][1]]))


def most_bytes(setup: Setup, observation: Observation, n_iter: int) -> int:
    """Return the most bytes that the state of a selection, or of a run, may take.

    Raises
    ------
    InputError
        The stars or the pad of the setup cannot be used.
    """
    n_snapshots, due = 1, 1
    while due <= n_iter:
        n_snapshots, due = n_snapshots + 1, _next_snapshot(due)
    snapshot = observation.images[0].size * np.dtype(np.float32).itemsize
    curve = MAX_CANDIDATES * (CURVE_DTYPE.itemsize + 8)
    half = most_bytes_of_run(setup, observation, n_iter) + n_snapshots * (snapshot + curve)
    return 2 * N_SPLITS * half


def _next_snapshot(iteration: int) -> int:
    return max(iteration + 1, math.floor(SPACING * iteration))


def _dot(a: Snapshot, b: Snapshot) -> float:
    return float(a @ b)


def _flat(run: Run) -> Snapshot:
    return run.extended().astype(np.float32).ravel()


class HeldOutSelection:
    """The selection of the penalty and the number of iterations by held-out counts.

    Parameters
    ----------
    start : callable
        ``start(observation, penalty)`` starts a run of at most `n_iter` iterations.
    observation : Observation
        The observation to reconstruct.
    penalty : Penalty
        The smallest penalty, or the only one.
    grid : callable, optional
        ``grid(observation, brightest)`` makes the other penalties to choose from, in increasing
        order; `mu_grid` or `smoothing_grid`.
    n_iter : int
        Iterations at most.
    at_end : bool
        Whether the reconstruction runs to `n_iter`, and the penalty is to be the best there; else
        each penalty has its own number of iterations.

    Raises
    ------
    InputError
        The images hold no counts, or too many in a pixel.

    Warns
    -----
    LnoclWarning
        The images are not whole counts.
    """

    def __init__(
        self,
        start: StartRun,
        observation: Observation,
        penalty: Penalty,
        grid: PenaltyGrid | None,
        n_iter: int,
        at_end: bool,
    ) -> None:
        self._start, self._observation = start, observation
        self._penalty, self._grid = penalty, grid
        self._n_iter, self._at_end = n_iter, at_end
        self._halves = split_counts(observation, N_SPLITS)
        self._candidates: list[_Candidate] = []
        self._trial = _Trial([])
        self._saved: Saved | None = None

    def choose(self, report: Callable[[str], None], save: Callable[[], None]) -> Choice:
        """Return the penalty and the number of iterations that held-out counts choose.

        Parameters
        ----------
        report : callable
            Is given a few words on the progress.
        save : callable
            Is called where `state` may be saved.

        Raises
        ------
        InputError
            No iteration of the halves is better than their start.
        NotFiniteError
            Estimates of halves are infinite or not a number.
        DivergedError
            The objective of a half rises from the start.

        Warns
        -----
        LnoclWarning
            The chosen iteration is too near `n_iter`; the objective of a half rises.
        """
        while (penalty := self._next_penalty()) is not None:
            self._trial = self._start_trial(penalty)
            first = self._candidates[0] if self._candidates else None
            self._candidates.append(
                _run_trial(self._trial, penalty, self._at_end, first, report, save)
            )
        best = min(self._candidates, key=lambda candidate: candidate.error)
        if not self._at_end and LENGTH_RATIO * best.n_iter > self._n_iter:
            warn(
                f"held-out counts have chosen iteration {best.n_iter} of {self._n_iter}, too near "
                f"the end to be sure; give n_iter {LENGTH_RATIO * best.n_iter} or more"
            )
        curve = np.concatenate([candidate.curve for candidate in self._candidates])
        return Choice(best.penalty, self._n_iter if self._at_end else best.n_iter, curve)

    def _start_trial(self, penalty: Penalty) -> _Trial:
        with ignored_warnings(LnoclWarning):  # the run on all counts warns of the same
            halved = penalty.of_half()
            trial = _Trial(
                [(self._start(a, halved), self._start(b, halved)) for a, b in self._halves]
            )
            if self._saved is not None:
                trial.restore(self._saved)
                self._saved = None
        return trial

    def _next_penalty(self) -> Penalty | None:
        """Return the penalty to try next, if any."""
        if not self._candidates:
            return self._penalty
        least = min(candidate.error for candidate in self._candidates)
        if self._grid is None or self._candidates[-1].error > (1.0 + ERROR_TOLERANCE) * least:
            return None  # the penalties increase, and the last is too large already
        brightest = 2.0 * max(float(half.max()) for half in self._candidates[0].reference[0])
        others = self._grid(self._observation, brightest) if brightest > 0 else []
        return dict(enumerate(others, 1)).get(len(self._candidates))

    def state(self) -> State:
        """Return the arrays that `restore` needs."""
        state = self._trial.state()
        if self._candidates:
            state["candidates"] = np.array([candidate.row() for candidate in self._candidates])
            state["reference"] = np.array(self._candidates[0].reference)
            state["curves"] = rows_of(
                np.concatenate([candidate.curve for candidate in self._candidates])
            )
        return state

    def restore(self, saved: Saved) -> None:
        """Continue from the state in a checkpoint.

        Raises
        ------
        FileError
            The selection cannot have such a state.
        """
        self._saved = saved
        most = UNBOUNDED
        rows = saved.take(
            "candidates",
            FLOAT,
            (range(MAX_CANDIDATES), 6),
            [0, 0, 1, 0, -most, -most],
            [most, most, self._n_iter, *[most] * 3],
        )
        curves = take_curve(saved, "curves", self._n_iter)
        shape = N_SPLITS if len(rows) else 0, 2, self._observation.images[0].size
        reference = [(a, b) for a, b in saved.take("reference", np.dtype(np.float32), shape, 0.0)]
        for mu, smoothing, n_iter, error, *scale in rows.tolist():
            penalty = self._next_penalty()
            saved.refuse_unless(
                penalty == Penalty(mu, smoothing) and is_whole(n_iter),
                f"candidates holds mu {mu:g}, smoothing {smoothing:g}, iteration {n_iter:g}",
            )
            curve = curves[(curves["mu"] == mu) & (curves["smoothing"] == smoothing)]
            self._candidates.append(
                _Candidate(Penalty(mu, smoothing), int(n_iter), error, curve, reference, *scale)
            )
        saved.refuse_unless(self._next_penalty() is not None, "candidates leaves nothing to try")


@dataclass
class _Candidate:
    """A penalty that was tried.

    Attributes
    ----------
    penalty : Penalty
        The penalty.
    n_iter : int
        The iteration to choose.
    error : float
        The relative error there, or at the last iteration where the reconstruction ends there.
    curve : ndarray
        The relative error of each snapshot.
    reference : list of pairs
        The estimates A_L and B_L, of the first candidate.
    offset, squared_norm : float
        The constant that the excess lacks, and the square of the norm of f, by the same.
    """

    penalty: Penalty
    n_iter: int
    error: float
    curve: NDArray[np.void]
    reference: list[Pair]
    offset: float
    squared_norm: float

    def row(self) -> list[float]:
        """Return the numbers."""
        mu, smoothing = self.penalty.mu, self.penalty.smoothing
        return [mu, smoothing, self.n_iter, self.error, self.offset, self.squared_norm]


def _run_trial(
    trial: _Trial,
    penalty: Penalty,
    at_end: bool,
    first: _Candidate | None,
    report: Callable[[str], None],
    save: Callable[[], None],
) -> _Candidate:
    """Run a trial as long as is needed; its errors are relative to the first's reference."""
    for iteration in trial.advance():
        _, least, chosen = _select(trial, first)
        weights = f"mu {penalty.mu:.2g}, smoothing {penalty.smoothing:.2g}"
        report(f"held-out counts, {weights}: iteration {chosen} of {iteration}")
        if not at_end and iteration >= max(MIN_ITERATIONS, LENGTH_RATIO * chosen):
            break
        trial.drop_before(min(OLDEST_SNAPSHOT * chosen, trial.iterations[least]))
        save()
    if not trial.snapshots:
        raise InputError(
            "half of the counts is too little: no iteration betters the start; give n_iter, mu and "
            "smoothing as numbers"
        )
    excess, least, chosen = _select(trial, first)
    if first:
        reference, offset, squared_norm = first.reference, first.offset, first.squared_norm
    else:
        reference = trial.last
        offset = trial.noise(least) - float(excess.min())
        squared_norm = float(np.mean([4.0 * _dot(a, b) for a, b in reference]))
    squared_errors = np.maximum(excess + offset, 0.0)
    errors = np.sqrt(squared_errors / max(squared_norm, offset, np.finfo(float).tiny))
    error = float(errors[-1] if at_end else errors.min())
    curve = np.zeros(len(errors), CURVE_DTYPE)
    curve["mu"], curve["smoothing"] = penalty.mu, penalty.smoothing
    curve["iteration"], curve["error"] = trial.iterations, errors
    return _Candidate(penalty, chosen, error, curve, reference, offset, squared_norm)


def _select(trial: _Trial, first: _Candidate | None) -> tuple[Array, int, int]:
    """Return the excess of each snapshot, the index of the least, and the iteration to choose."""
    excess = trial.excess(first.reference if first else trial.last)
    refuse_not_finite(*excess)
    least = int(np.argmin(excess))
    allowed = ((1.0 + ERROR_TOLERANCE) ** 2 - 1.0) * trial.noise(least)
    return excess, least, trial.iterations[np.flatnonzero(excess <= excess[least] + allowed)[-1]]
