"""Iterations and penalty chosen by held-out counts: two reconstructions, each judged by the other.

Each count goes to one of two halves of the observation, by the toss of a coin, which makes them
two independent Poisson observations of the same sky. Both are reconstructed side by side. With A_k
and B_k the extended sources after k iterations, in the end A_L and B_L, the sum A_k + B_k is a
reconstruction f_k from all counts, and but for a constant its squared error is

    ||f_k - f||^2 - ||f||^2 = ||f_k||^2 - 2 <f_k, f>,   <f_k, f> = 2 (<A_k, B_L> + <B_k, A_L>),

as noise of independent halves averages out of these products, and what L iterations have not yet
resolved is small where L is large. The noise alone is ||A_k - B_k||^2. All is averaged over a few
ways to deal the counts out. The likelihood of the held-out half itself, the usual measure, is flat
over most of the run and ends it two to four times too early: docs/sgp.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lnocl.errors import InputError, LnoclWarning, refuse_not_finite, warn
from lnocl.process import ignored_warnings
from lnocl.runs.run import Run
from lnocl.scene.observation import Array, Observation
from lnocl.scene.penalty import Penalty

CURVE_DTYPE = np.dtype(
    [
        ("mu", np.float64),
        ("smoothing", np.float64),
        ("iteration", np.int64),
        ("error", np.float64),
    ]
)

NO_CURVE = np.zeros(0, CURVE_DTYPE)

# The last iteration is taken whose error is within a tenth of the least: near a star the estimate
# goes on improving long after the rest. The least squared error is taken to be the noise alone;
# what is not resolved adds as much again and more, so that a tenth is cautious.
WITHIN = 0.1
# The halves go on for as long again, so that what each is judged by is resolved.
AS_LONG_AGAIN = 2
FEWEST = 10
# Ways to deal the counts out.
SPLITS = 3
# Iterations at which the halves are compared are so far apart, relatively.
SPACING = 1.1
# Estimates before this share of the chosen iteration are let go.
FORGOTTEN = 1.0 / 3.0
# mu in units of p over the largest value of the extended source, at which the Tikhonov term takes
# half of the brightest pixel.
MU_GRID = 10.0 ** np.arange(-3.0, 0.1, 0.5)
# The weight of the edge-preserving term in units of the noise of the gradient of the data term.
SMOOTHING_GRID = 10.0 ** np.arange(-1.5, 0.6, 0.5)
MOST_COUNTS = 2.0**62

# Before the names of what all runs on halves have come to, one behind the other.
HALVES = "halves_"

Arrays = dict[str, NDArray[Any]]
Estimate = NDArray[np.float32]
BeginHalf = Callable[[Observation, Penalty], Run]
Grid = Callable[[Observation, float], list[Penalty]]


@dataclass
class Choice:
    """What held-out counts have chosen.

    Attributes
    ----------
    penalty : Penalty
        On the extended source.
    n_iter : int
        Iterations.
    curve : ndarray, fields ``mu``, ``smoothing``, ``iteration`` and ``error``
        Estimated relative error of the extended source, ``||f - truth|| / ||truth||``.
    """

    penalty: Penalty
    n_iter: int
    curve: NDArray[np.void]


def plain(curve: NDArray[np.void]) -> Array:
    """Return a curve as numbers, a row for each field."""
    return np.array([curve[name] for name in CURVE_DTYPE.names or ()], np.float64)


def curve_of(rows: Array) -> NDArray[np.void]:
    """Return a curve from its numbers."""
    curve = np.zeros(rows.shape[1], CURVE_DTYPE)
    for name, row in zip(CURVE_DTYPE.names or (), rows, strict=True):
        curve[name] = row
    return curve


def split_counts(observation: Observation, ways: int = 1) -> list[tuple[Observation, Observation]]:
    """Return two halves of an observation, the counts dealt out at random, in so many ways.

    Whole counts are dealt out one by one, so that the halves of a Poisson count are independent
    Poisson counts of half its mean. Of what is no whole count the fraction goes to one of the
    halves, which keeps their variances those of counts to 1/16. The seeds are fixed.

    Raises
    ------
    InputError
        No counts to deal out, or too many.

    Warns
    -----
    LnoclWarning
        Images that are not whole counts.
    """
    images = np.where(observation.mask, 0.0, observation.images)
    if not images.any():
        raise InputError(
            "the images hold no counts to hold out; give n_iter, mu and smoothing as numbers"
        )
    if images.max() > MOST_COUNTS:
        raise InputError(
            f"a pixel of {images.max():.3g} electrons cannot be dealt out; give n_iter, mu and "
            "smoothing as numbers"
        )
    whole = np.floor(images)
    if (whole != images).any():
        warn("the images are not whole counts: they are split as if they were Poisson counts")
    known = {
        "background": observation.background / 2.0,
        "mask": observation.mask,
        "exposure": observation.exposure,
        "offsets": observation.offsets,
    }
    pairs = []
    for seed in range(ways):
        rng = np.random.default_rng(seed)
        first = rng.binomial(whole.astype(np.int64), 0.5).astype(np.float64)
        first += (images - whole) * rng.integers(0, 2, images.shape)
        with ignored_warnings(LnoclWarning):  # they are said of the whole observation too
            pairs.append(
                (
                    Observation(first, observation.psfs, **known),
                    Observation(images - first, observation.psfs, **known),
                )
            )
    return pairs


Pair = tuple[Estimate, Estimate]


def several_mu(smoothing: float) -> Grid:
    """Return what makes the penalties to choose mu from, once the brightest pixel is known."""

    def grid(observation: Observation, brightest: float) -> list[Penalty]:
        total = observation.exposure.sum(axis=0).max()
        return [Penalty(mu, smoothing) for mu in MU_GRID * total / brightest]

    return grid


def several_smoothings(mu: float) -> Grid:
    """Return what makes the penalties to choose the smoothing from.

    They are measured by the standard deviation of the gradient of the data term where only counts
    vary, ``sqrt(sum_j <e_j^2 / g_j> sum K_j^2)``, < > the mean over the pixels observed.
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
    """The runs of all pairs of halves at one penalty, and their estimates at some iterations."""

    def __init__(self, runs: Sequence[tuple[Run, Run]]) -> None:
        self._runs = runs
        self.kept: list[tuple[int, list[Pair]]] = []

    def advance(self) -> Iterator[int]:
        """Go on to the next iteration that is kept, and yield it, until a run ends."""
        last = self.iterations[-1] if self.kept else 0
        due = max(last + 1, math.floor(SPACING * last))
        for iteration, *_ in zip(*(run for pair in self._runs for run in pair), strict=False):
            if iteration == due:
                self.kept.append((iteration, [(_flat(a), _flat(b)) for a, b in self._runs]))
                due = max(due + 1, math.floor(SPACING * due))
                yield iteration

    def state(self) -> Arrays:
        """Return what `restore` needs, at an iteration that was kept last."""
        runs = enumerate(run for pair in self._runs for run in pair)
        state = {f"{HALVES}{k}_{name}": a for k, run in runs for name, a in run.state().items()}
        state["kept_at"] = np.array(self.iterations)
        state["kept"] = np.array([pairs for _, pairs in self.kept])
        return state

    def restore(self, state: Arrays) -> None:
        """Go on from this state."""
        for k, run in enumerate(run for pair in self._runs for run in pair):
            prefix = f"{HALVES}{k}_"
            run.restore(
                {n.removeprefix(prefix): a for n, a in state.items() if n.startswith(prefix)}
            )
        self.kept = [
            (int(at), [(a, b) for a, b in pairs])
            for at, pairs in zip(state["kept_at"], state["kept"], strict=True)
        ]

    def forget(self, first: float) -> None:
        """Let the estimates before an iteration go."""
        self.kept = [kept for kept in self.kept if kept[0] >= first]

    @property
    def iterations(self) -> list[int]:
        """The iterations kept."""
        return [iteration for iteration, _ in self.kept]

    @property
    def end(self) -> list[Pair]:
        """The last estimates."""
        return self.kept[-1][1]

    def excess(self, reference: Sequence[Pair]) -> Array:
        """Return ``||f_k||^2 - 2 <f_k, f>`` at each iteration kept, judged by a reference."""
        return np.array(
            [
                np.mean(
                    [
                        _dot(a + b, a + b) - 4.0 * (_dot(a, b_end) + _dot(b, a_end))
                        for (a, b), (a_end, b_end) in zip(pairs, reference, strict=True)
                    ]
                )
                for _, pairs in self.kept
            ]
        )

    def noise(self, at: int) -> float:
        """Return ``||A_k - B_k||^2`` at one of the iterations kept."""
        return float(np.mean([_dot(a - b, a - b) for a, b in self.kept[at][1]]))


def _dot(a: Estimate, b: Estimate) -> float:
    return float(a @ b)


def _flat(run: Run) -> Estimate:
    return run.extended().astype(np.float32).ravel()


class HeldOutSelection:
    """Held-out counts at work on the choice of the penalty and the number of iterations.

    Parameters
    ----------
    begin : callable
        ``begin(observation, penalty)`` begins a run of at most `n_iter` iterations.
    observation : Observation
        What is to be reconstructed.
    penalty : Penalty
        The least, or the only one.
    grid : callable, optional
        ``grid(observation, brightest)`` makes the others to choose from, growing; `several_mu` or
        `several_smoothings`.
    n_iter : int
        Iterations at most.
    at_end : bool
        Whether the reconstruction will go on to `n_iter`, and the penalty is to be the best there;
        else each penalty has its own number of iterations.

    Raises
    ------
    InputError
        No counts to deal out, or too many.

    Warns
    -----
    LnoclWarning
        Images that are not whole counts.
    """

    def __init__(
        self,
        begin: BeginHalf,
        observation: Observation,
        penalty: Penalty,
        grid: Grid | None,
        n_iter: int,
        at_end: bool,
    ) -> None:
        self._begin, self._observation = begin, observation
        self._penalty, self._grid = penalty, grid
        self._n_iter, self._at_end = n_iter, at_end
        self._halves = split_counts(observation, SPLITS)
        self._judged: list[_Candidate] = []
        self._trial = _Trial([])
        self._saved: Arrays = {}

    def choose(self, report: Callable[[str], None], keep: Callable[[], None]) -> Choice:
        """Return the penalty and the number of iterations that held-out counts choose.

        Parameters
        ----------
        report : callable
            Told in a few words how far it is.
        keep : callable
            Called where `state` may be taken.

        Raises
        ------
        InputError
            Halves of which no iteration betters the start.
        NotFiniteError
            Estimates of halves that are infinite or not a number.

        Warns
        -----
        LnoclWarning
            An iteration chosen too near `n_iter`.
        """
        while (penalty := self._next()) is not None:
            with ignored_warnings(LnoclWarning):  # likewise
                halved = penalty.of_half()
                self._trial = _Trial(
                    [(self._begin(a, halved), self._begin(b, halved)) for a, b in self._halves]
                )
                if self._saved:
                    self._trial.restore(self._saved)
                    self._saved = {}
            first = self._judged[0] if self._judged else None
            self._judged.append(_follow(self._trial, penalty, self._at_end, first, report, keep))
        best = min(self._judged, key=lambda judged: judged.error)
        if not self._at_end and AS_LONG_AGAIN * best.n_iter > self._n_iter:
            warn(
                f"held-out counts have chosen iteration {best.n_iter} of {self._n_iter}, too near "
                f"the end to be sure; give n_iter {AS_LONG_AGAIN * best.n_iter} or more"
            )
        curve = np.concatenate([judged.curve for judged in self._judged])
        return Choice(best.penalty, self._n_iter if self._at_end else best.n_iter, curve)

    def _next(self) -> Penalty | None:
        """Return the penalty to be tried next, if any."""
        if not self._judged:
            return self._penalty
        least = min(judged.error for judged in self._judged)
        if self._grid is None or self._judged[-1].error > (1.0 + WITHIN) * least:
            return None  # the penalty grows, and is too large already
        brightest = 2.0 * max(float(half.max()) for half in self._judged[0].reference[0])
        others = self._grid(self._observation, brightest) if brightest > 0 else []
        return dict(enumerate(others, 1)).get(len(self._judged))

    def state(self) -> Arrays:
        """Return what `restore` needs."""
        state = self._trial.state()
        if self._judged:
            state["judged"] = np.array([judged.row() for judged in self._judged])
            state["reference"] = np.array(self._judged[0].reference)
            state["curves"] = plain(np.concatenate([judged.curve for judged in self._judged]))
        return state

    def restore(self, state: Arrays) -> None:
        """Go on from this state."""
        self._saved = state
        curves = curve_of(state.get("curves", plain(NO_CURVE)))
        for mu, smoothing, n_iter, error, zero, truth in state.get("judged", np.zeros((0, 6))):
            curve = curves[(curves["mu"] == mu) & (curves["smoothing"] == smoothing)]
            reference = [(a, b) for a, b in state["reference"]]
            penalty = Penalty(float(mu), float(smoothing))
            self._judged.append(
                _Candidate(penalty, int(n_iter), error, curve, reference, float(zero), float(truth))
            )


@dataclass
class _Candidate:
    """What a trial has come to: the error where the reconstruction would end, and who judged."""

    penalty: Penalty
    n_iter: int
    error: float
    curve: NDArray[np.void]
    reference: list[Pair]
    zero: float
    truth: float

    def row(self) -> list[float]:
        """Return the numbers."""
        penalty = self.penalty
        return [penalty.mu, penalty.smoothing, self.n_iter, self.error, self.zero, self.truth]


def _follow(
    trial: _Trial,
    penalty: Penalty,
    at_end: bool,
    first: _Candidate | None,
    report: Callable[[str], None],
    keep: Callable[[], None],
) -> _Candidate:
    """Take a trial as far as is needed, and judge it as the first one was."""
    for iteration in trial.advance():
        _, least, chosen = _judge(trial, first)
        weights = f"mu {penalty.mu:.2g}, smoothing {penalty.smoothing:.2g}"
        report(f"held-out counts, {weights}: iteration {chosen} of {iteration}")
        if not at_end and iteration >= max(FEWEST, AS_LONG_AGAIN * chosen):
            break
        trial.forget(min(FORGOTTEN * chosen, trial.iterations[least]))
        keep()
    if not trial.kept:
        raise InputError(
            "half of the counts is too little: no iteration betters the start; give n_iter, mu and "
            "smoothing as numbers"
        )
    excess, least, chosen = _judge(trial, first)
    reference = first.reference if first else trial.end
    # The constant that the excess lacks, and the scale of relative errors.
    zero = first.zero if first else trial.noise(least) - float(excess.min())
    truth = first.truth if first else float(np.mean([4.0 * _dot(a, b) for a, b in reference]))
    errors = np.sqrt(np.maximum(excess + zero, 0.0) / max(truth, zero, np.finfo(float).tiny))
    error = float(errors[-1] if at_end else errors.min())
    curve = np.zeros(len(errors), CURVE_DTYPE)
    curve["mu"], curve["smoothing"] = penalty.mu, penalty.smoothing
    curve["iteration"], curve["error"] = trial.iterations, errors
    return _Candidate(penalty, chosen, error, curve, reference, zero, truth)


def _judge(trial: _Trial, first: _Candidate | None) -> tuple[Array, int, int]:
    """Return the excess of what is kept, the place of the least, and the iteration to choose."""
    excess = trial.excess(first.reference if first else trial.end)
    refuse_not_finite(*excess)
    least = int(np.argmin(excess))
    allowed = ((1.0 + WITHIN) ** 2 - 1.0) * trial.noise(least)
    return excess, least, trial.iterations[np.flatnonzero(excess <= excess[least] + allowed)[-1]]
