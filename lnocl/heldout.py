"""Iterations and mu chosen by held-out counts: two reconstructions, each judged by the other.

Each count goes to one of two halves of the observation, by the toss of a coin, which makes them
two independent Poisson observations of the same sky. Both are reconstructed side by side. With A_k
and B_k the extended sources after k iterations, in the end A_L and B_L, the sum A_k + B_k is a
reconstruction from all counts, and its error is

    ||A_k + B_k - f||^2 = ||A_k + B_k||^2 - 2 <A_k + B_k, f> + ||f||^2,

in which 2 (<A_k, B_L> + <B_k, A_L>) stands for <A_k + B_k, f> and 4 <A_L, B_L> for ||f||^2: noise
of independent halves averages out of these products, and what L iterations have not yet resolved is
small where L is large. The likelihood of the held-out half itself, the usual measure, is flat over
most of the run and ends it two to four times too early: docs/sgp.md.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from lnocl.errors import InputError, LnoclWarning
from lnocl.observation import Array, Observation
from lnocl.run import Run

CURVE_DTYPE = np.dtype([("mu", np.float64), ("iteration", np.int64), ("error", np.float64)])

# The last iteration whose error is within a tenth of the least: near a star the estimate goes on
# improving long after the rest.
WITHIN = 0.1
# The halves go on for as long again, so that what each is judged by is resolved.
AS_LONG_AGAIN = 2
FEWEST = 10
# Iterations at which the halves are compared are so far apart, relatively.
SPACING = 1.08
# mu in units of p over the largest value of the extended source, at which the Tikhonov term takes
# half of the brightest pixel.
MU_GRID = 10.0 ** np.arange(-3.0, 0.1, 0.5)
MOST_COUNTS = 2.0**62

Estimate = NDArray[np.float32]
BeginHalf = Callable[[Observation, float], Run]


@dataclass
class Choice:
    """What held-out counts have chosen.

    Attributes
    ----------
    mu : float
        Weight of the Tikhonov term.
    n_iter : int
        Iterations.
    curve : ndarray, fields ``mu``, ``iteration`` and ``error``
        Estimated relative error of the extended source, ``||f - truth|| / ||truth||``.
    """

    mu: float
    n_iter: int
    curve: NDArray[np.void]


def halve(observation: Observation) -> tuple[Observation, Observation]:
    """Return two halves of an observation, the counts of each pixel dealt out at random.

    Whole counts are dealt out one by one, so that the halves of a Poisson count are independent
    Poisson counts of half its mean. Of what is no whole count the fraction goes to one of the
    halves, which keeps their variances those of counts to 1/16. The seed is fixed.

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
            "held-out counts need counts, and the images hold none; give n_iter and mu"
        )
    if images.max() > MOST_COUNTS:
        raise InputError(
            f"a pixel of {images.max():.3g} electrons cannot be dealt out; give n_iter and mu"
        )
    whole = np.floor(images)
    if (whole != images).any():
        warnings.warn(
            "the images are not whole counts: they are split as if they were Poisson counts",
            LnoclWarning,
            stacklevel=5,
        )
    rng = np.random.default_rng(0)
    first = rng.binomial(whole.astype(np.int64), 0.5) + (images - whole) * rng.integers(
        0, 2, images.shape
    )
    background, mask = observation.background / 2.0, observation.mask
    psfs = observation.psfs
    return (
        Observation(first, psfs, background=background, mask=mask),
        Observation(images - first, psfs, background=background, mask=mask),
    )


@dataclass
class _Pair:
    """The two halves' runs at one mu, and their estimates at some iterations."""

    first: Run
    second: Run
    kept: list[tuple[int, Estimate, Estimate]] = field(default_factory=list)

    def advance(self) -> Iterator[int]:
        """Go on to the next iteration that is kept, and yield it, to the end of either run."""
        due = 1
        for iteration, _ in zip(self.first, self.second, strict=False):  # either may end early
            if iteration == due:
                self.kept.append((iteration, _flat(self.first), _flat(self.second)))
                due = max(due + 1, math.floor(SPACING * due))
                yield iteration

    def errors(self, reference: tuple[Estimate, Estimate]) -> Array:
        """Return the estimated relative error at each iteration kept; 0 where it is negative."""
        first_end, second_end = reference
        truth = 4.0 * float(first_end @ second_end)
        squares = np.array(
            [
                float((a + b) @ (a + b)) - 4.0 * float(a @ second_end + b @ first_end) + truth
                for _, a, b in self.kept
            ]
        )
        return np.sqrt(np.maximum(squares, 0.0) / max(truth, np.finfo(float).tiny))

    @property
    def end(self) -> tuple[Estimate, Estimate]:
        """The last estimates."""
        return self.kept[-1][1:]


def _flat(run: Run) -> Estimate:
    return run.extended().astype(np.float32).ravel()


def choose(
    begin: BeginHalf,
    observation: Observation,
    mus: Array | None,
    n_iter: int,
    at_end: bool,
    report: Callable[[str], None],
) -> Choice:
    """Return the mu and the number of iterations that held-out counts choose.

    Parameters
    ----------
    begin : callable
        ``begin(observation, mu)`` begins a run of at most `n_iter` iterations.
    observation : Observation
        What is to be reconstructed.
    mus : ndarray of float64, or None
        The weights to choose from; None for `MU_GRID` and 0.
    n_iter : int
        Iterations at most.
    at_end : bool
        Whether the reconstruction will go on to `n_iter`, and mu is to be the best there; else
        each mu has its own number of iterations.
    report : callable
        Told in a few words how far it is.
    """
    halves = halve(observation)
    given = mus is not None
    pending = [0.0] if mus is None else sorted(float(mu) for mu in mus)
    reference: tuple[Estimate, Estimate] | None = None
    curves: list[NDArray[np.void]] = []
    best = (math.inf, 0.0, n_iter)
    while pending:
        mu = pending.pop(0)
        # A half has half the data term and a quarter of the squares.
        pair = _Pair(begin(halves[0], 2.0 * mu), begin(halves[1], 2.0 * mu))
        chosen = _follow(pair, mu, n_iter, at_end, reference, report)
        reference = reference or pair.end
        errors = pair.errors(reference)
        iterations = [iteration for iteration, *_ in pair.kept]
        curves.append(_curve(mu, iterations, errors))
        error = float(errors[-1] if at_end else errors.min())
        if error < best[0]:
            best = error, mu, n_iter if at_end else iterations[chosen]
        if error > (1.0 + WITHIN) * best[0]:
            break  # mu grows, and is too large already
        if not given and not pending and mu == 0.0:
            brightest = 2.0 * max(float(half.max()) for half in reference)
            pending = list(MU_GRID * observation.n_images / brightest) if brightest > 0 else []
    if not at_end and AS_LONG_AGAIN * best[2] > n_iter:
        warnings.warn(
            f"held-out counts have chosen iteration {best[2]} of {n_iter}, too near the end to be "
            f"sure; give n_iter {AS_LONG_AGAIN * best[2]} or more",
            LnoclWarning,
            stacklevel=4,
        )
    return Choice(best[1], best[2], np.concatenate(curves))


def _follow(
    pair: _Pair,
    mu: float,
    n_iter: int,
    at_end: bool,
    reference: tuple[Estimate, Estimate] | None,
    report: Callable[[str], None],
) -> int:
    """Take a pair as far as is needed; return which of the kept iterations is chosen."""
    chosen = 0
    for iteration in pair.advance():
        errors = pair.errors(reference or pair.end)
        chosen = int(np.flatnonzero(errors <= (1.0 + WITHIN) * errors.min())[-1])
        report(
            f"held-out counts, mu {mu:.2g}: error {errors[chosen]:.3g} at {pair.kept[chosen][0]}"
        )
        settled = AS_LONG_AGAIN * pair.kept[chosen][0] <= iteration and iteration >= FEWEST
        if settled and not at_end:
            break
    return chosen


def _curve(mu: float, iterations: list[int], errors: Array) -> NDArray[np.void]:
    curve = np.zeros(len(iterations), CURVE_DTYPE)
    curve["mu"], curve["iteration"], curve["error"] = mu, iterations, errors
    return curve
