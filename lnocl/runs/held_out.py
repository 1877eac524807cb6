"""The number of iterations, chosen by held-out counts: cross-validation by data thinning.

Data thinning gives each count to one of two halves of the observation, with probability 1/2. The
halves are independent Poisson observations of the same sky, and are reconstructed side by side.
With A_k and B_k their extended sources after k iterations, A_L and B_L after the last, the sum
f_k = A_k + B_k is a reconstruction from all counts: the result, at the best k. But for a constant
its squared error is

    ||f_k - f||^2 - ||f||^2 = ||f_k||^2 - 2 <f_k, f>,   <f_k, f> = 2 (<A_k, B_L> + <B_k, A_L>),

as noise of independent halves averages out of these products, and structure that L iterations have
not resolved is small where L is large. The noise alone is ||A_k - B_k||^2. The likelihood of the
held-out half itself, the usual measure, is flat over most of the run and ends it two to four times
too early: docs/sgp.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lnocl.errors import InputError, refuse_not_finite, warn
from lnocl.runs.halves import Halves, Snapshot, next_snapshot
from lnocl.runs.outcome import CURVE_DTYPE, Outcome
from lnocl.runs.run import most_bytes as most_bytes_of_run
from lnocl.runs.saved import Saved
from lnocl.runs.start import Start
from lnocl.runs.thinning import split_counts
from lnocl.scene.observation import Array
from lnocl.scene.penalty import Penalty
from lnocl.solvers.engine import State

# The chosen iteration is the last with an error within a tenth of the least: near a star the
# estimate improves long after the rest. The least squared error is taken to be the noise alone;
# unresolved structure adds as much again and more, so that a tenth is cautious.
ERROR_TOLERANCE = 0.1
# The halves run to this multiple of the chosen iteration, so that the references are resolved.
LENGTH_RATIO = 2
MIN_ITERATIONS = 10
# Snapshots before this share of the chosen iteration are dropped.
OLDEST_SNAPSHOT = 1.0 / 3.0

# look(iteration, halves) returns whether to end there.
Look = Callable[[int, Halves], bool]


class HeldOutCounts:
    """The choice of the number of iterations by held-out counts.

    Parameters
    ----------
    start : Start
        Where the reconstruction starts.
    penalty : Penalty
        On the extended source.
    n_iter : int
        Iterations at most.

    Raises
    ------
    InputError
        The images hold no counts, or too many in a pixel.

    Warns
    -----
    LnoclWarning
        The images are not whole counts.
    """

    def __init__(self, start: Start, penalty: Penalty, n_iter: int) -> None:
        self._start, self._penalty, self._n_iter = start, penalty, n_iter
        halves = split_counts(start.scene.observation)
        self._halves = Halves([start.of_half(each) for each in halves], n_iter)
        self._next_look = MIN_ITERATIONS
        self._is_over = False

    def choose(self, look: Look, save: Callable[[], None]) -> Outcome:
        """Return the reconstruction that held-out counts choose, or that at which `look` ends it.

        Parameters
        ----------
        look : callable
            Is called after each iteration of the halves.
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
        halves = self._halves
        for iteration in () if self._is_over else halves:
            is_last = self._judge_when_due()
            if look(iteration, halves):
                return self._outcome(halves.snapshot(), "callback")
            if is_last:
                break
            save()
        if not halves.snapshots:
            raise InputError(
                "half of the counts is too little: no iteration betters the start; give n_iter "
                "and stop None"
            )
        curve, _, chosen = assess(halves.snapshots, self._start.scene.observation.shape)
        if LENGTH_RATIO * chosen.iteration > self._n_iter:
            warn(
                f"held-out counts have chosen iteration {chosen.iteration} of {self._n_iter}, too "
                f"near the end to be sure; give n_iter {LENGTH_RATIO * chosen.iteration} or more"
            )
        return replace(self._outcome(chosen, "held-out"), curve=curve)

    def _judge_when_due(self) -> bool:
        """Drop snapshots that are too old, where that is due; return whether the end is reached."""
        snapshots = self._halves.snapshots
        last = snapshots[-1].iteration
        if last != self._halves.done or last < self._next_look:
            return False
        _, best, chosen = assess(snapshots, self._start.scene.observation.shape)
        self._next_look = max(MIN_ITERATIONS, LENGTH_RATIO * chosen.iteration)
        oldest = min(OLDEST_SNAPSHOT * chosen.iteration, best.iteration)
        self._halves.snapshots = [each for each in snapshots if each.iteration >= oldest]
        return last >= self._next_look

    def _outcome(self, snapshot: Snapshot, stop_reason: str) -> Outcome:
        """Return the sum of both halves' estimates; scaled, it is their mean."""
        start = self._start
        scene = copy(start.scene)
        if start.refines:
            scene.move_stars(snapshot.positions.mean(axis=0))
        return Outcome(
            scene=scene,
            extended=snapshot.extended.mean(axis=0, dtype=np.float64),
            star_fluxes=snapshot.star_fluxes.mean(axis=0),
            given_stars=start.given_stars if start.refines else None,
            objectives=self._halves.objectives(snapshot.iteration),
            engine_name=self._halves.engine_name,
            penalty=self._penalty,
            stop_reason=stop_reason,
        )

    def state(self) -> State:
        """Return the arrays that `restore` needs, as they are between iterations."""
        return self._halves.state() | {"next_look": np.array([self._next_look])}

    def restore(self, saved: Saved, ended: str) -> None:
        """Continue from the state in a checkpoint.

        Raises
        ------
        FileError
            The halves cannot have such a state.
        """
        saved.refuse_unless(ended in ("", "callback", "held-out"), f"it ended by {ended}")
        most = LENGTH_RATIO * self._n_iter + MIN_ITERATIONS
        (next_look,) = saved.take("next_look", np.dtype(np.int64), (1,), 1, most)
        self._halves.restore(saved)
        saved.refuse_others()
        self._next_look, self._is_over = int(next_look), ended == "held-out"


def assess(
    snapshots: Sequence[Snapshot], shape: tuple[int, int]
) -> tuple[NDArray[np.void], Snapshot, Snapshot]:
    """Return the relative errors of snapshots, the best of them, and the one to choose.

    Parameters
    ----------
    snapshots : sequence of Snapshot
        At least one; the last is the reference.
    shape : tuple of int
        Shape (ny, nx) of the images, within which errors are measured.

    Raises
    ------
    NotFiniteError
        Estimates are infinite or not a number.
    """
    inside = tuple(map(slice, shape))

    def product(a: Array, b: Array) -> float:
        return float(np.einsum("yx,yx->y", a[inside], b[inside]).sum(dtype=np.float64))

    a_last, b_last = snapshots[-1].extended
    excess, noise = np.zeros((2, len(snapshots)))
    for k, snapshot in enumerate(snapshots):
        a, b = snapshot.extended
        squares, mixed = product(a, a) + product(b, b), 2.0 * product(a, b)
        noise[k] = squares - mixed
        excess[k] = squares + mixed - 4.0 * (product(a, b_last) + product(b, a_last))
    refuse_not_finite(*excess, *noise)
    best = int(np.argmin(excess))
    allowed = ((1.0 + ERROR_TOLERANCE) ** 2 - 1.0) * noise[best]
    chosen = np.flatnonzero(excess <= excess[best] + allowed)[-1]
    offset = noise[best] - excess[best]  # the least squared error is taken to be the noise alone
    squared_norm = max(4.0 * product(a_last, b_last), offset, np.finfo(float).tiny)
    curve = np.zeros(len(snapshots), CURVE_DTYPE)
    curve["iteration"] = [each.iteration for each in snapshots]
    curve["error"] = np.sqrt(np.maximum(excess + offset, 0.0) / squared_norm)
    return curve, snapshots[best], snapshots[chosen]


def most_bytes(start: Start, n_iter: int) -> int:
    """Return the most bytes that the state of held-out counts may take."""
    n_snapshots, due = 1, 1
    while due <= n_iter:
        n_snapshots, due = n_snapshots + 1, next_snapshot(due)
    numbers = 2 * math.prod(start.scene.grid) + 6 * start.scene.n_stars + 1
    snapshots = n_snapshots * numbers * np.dtype(np.float64).itemsize
    return 2 * most_bytes_of_run(start, n_iter) + snapshots
