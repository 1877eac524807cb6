"""Reconstructions of two halves of the counts, in step, and the snapshots that are held of them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from lnocl.errors import DivergedError, NotFiniteError, warn
from lnocl.runs.run import Run
from lnocl.runs.saved import LARGEST, Saved
from lnocl.runs.start import Start
from lnocl.scene.observation import Array
from lnocl.solvers.engine import State

# The ratio of one iteration of which a snapshot is taken to that before.
SPACING = 1.1

# The beginnings of the names under which the state of each half, a number, and snapshots are saved.
HALVES, SNAPSHOTS = "halves_", "snapshots"


class Snapshot(NamedTuple):
    """The estimates of both halves at an iteration, scaled: their mean is that of all counts.

    Attributes
    ----------
    iteration : int
        The iteration.
    extended : ndarray, shape (2, Ny, Nx)
        A and B, the extended sources.
    star_fluxes : ndarray of float64, shape (2, n)
        Star fluxes.
    positions : ndarray of float64, shape (2, n, 2)
        Star positions.
    """

    iteration: int
    extended: Array
    star_fluxes: Array
    positions: Array


class Halves:
    """Runs on two halves of the counts; iterating over them runs both, and takes snapshots.

    Parameters
    ----------
    starts : sequence of two Start
        Where they start.
    n_iter : int
        Iterations at most.

    Attributes
    ----------
    done : int
        Iterations that both have done.
    snapshots : list of Snapshot
        At iterations a tenth apart.
    """

    def __init__(self, starts: Sequence[Start], n_iter: int) -> None:
        self._start, self._n_iter = starts[0], n_iter
        self._runs = [Run(start, n_iter, half) for half, start in enumerate(starts)]
        setup = self._start.setup
        is_single = setup.engine == "opencl" and setup.precision == "single"
        self._dtype = np.dtype(np.float32 if is_single else np.float64)
        self.done = 0
        self.snapshots: list[Snapshot] = []

    def __iter__(self) -> Iterator[int]:
        """Iterate; where the objective of a half rises, end at the last snapshot before that.

        Raises
        ------
        DivergedError, NotFiniteError
            An objective rises or is not finite, and no snapshot before that is left.

        Warns
        -----
        LnoclWarning
            An objective rises or is not finite.
        """
        due = self._due()
        try:
            for done, _ in zip(*self._runs, strict=False):
                self.done = done
                if done == due:
                    self.snapshots.append(self.snapshot())
                    due = self._due()
                yield done
        except (DivergedError, NotFiniteError):
            best = min(run.best_iteration() for run in self._runs)
            self.snapshots = [each for each in self.snapshots if each.iteration <= best]
            if not self.snapshots:
                raise
            warn(
                f"the objective of a half of the counts rises after iteration {best}: held-out "
                f"counts choose among the iterations up to {self.snapshots[-1].iteration}"
            )

    def _due(self) -> int:
        """Return the iteration of the next snapshot."""
        return next_snapshot(self.snapshots[-1].iteration if self.snapshots else 0)

    def snapshot(self) -> Snapshot:
        """Return the estimates as they are."""
        extended = np.empty((2, *self._runs[0].scene.grid), self._dtype)
        for half, run in zip(extended, self._runs, strict=True):
            half[:] = run.engine.extended()
        return Snapshot(
            self.done,
            extended,
            np.array([run.engine.star_fluxes() for run in self._runs]),
            np.array([run.scene.stars for run in self._runs]),
        )

    def extended(self) -> Array:
        """Return the sum of the extended sources, electrons per pixel, shape (ny, nx)."""
        first, second = self._runs
        return first.extended() + second.extended()

    def star_fluxes(self) -> Array:
        """Return the sums of the star fluxes, electrons."""
        first, second = self._runs
        return first.star_fluxes() + second.star_fluxes()

    def star_positions(self) -> Array:
        """Return the means of the star positions, pixels, shape (n, 2)."""
        return np.mean([run.star_positions() for run in self._runs], axis=0)

    def objective(self) -> float:
        """Return the sum of the last objectives."""
        return sum(run.objective() for run in self._runs)

    def objectives(self, last: int) -> Array:
        """Return the sums of the objectives, of the start and all iterations up to the last."""
        for run in self._runs:
            run.finish()
        first, second = (run.objectives()[: last + 1] for run in self._runs)
        return first + second

    @property
    def engine_name(self) -> str:
        """The device, its platform and driver."""
        return self._runs[0].engine.name

    def state(self) -> State:
        """Return the arrays that `restore` needs, as they are between iterations.

        Raises
        ------
        NotFiniteError
            A value is infinite or not a number.
        """
        columns = zip(Snapshot._fields, zip(*self.snapshots, strict=True), strict=False)
        state = {f"{SNAPSHOTS}_{field}": np.array(values) for field, values in columns}
        for k, run in enumerate(self._runs):
            state |= {f"{HALVES}{k}_{name}": array for name, array in run.state().items()}
        return state

    def restore(self, saved: Saved) -> None:
        """Continue from the state in a checkpoint.

        Raises
        ------
        FileError
            The halves cannot have such a state.
        """
        states = []
        for k, run in enumerate(self._runs):
            with saved.part(f"{HALVES}{k}_"):
                states.append(run.take(saved))
        done = {int(state["progress"][0]) for state in states}
        saved.refuse_unless(len(done) == 1, f"{HALVES}0_progress and {HALVES}1_progress differ")
        self.snapshots, self.done = self._take_snapshots(saved), done.pop()
        iterations = [each.iteration for each in self.snapshots]
        saved.refuse_unless(
            iterations == sorted(set(iterations)) and iterations[-1] <= self.done < self._due(),
            f"{SNAPSHOTS}_iteration does not lead to iteration {self.done}",
        )
        for run, state in zip(self._runs, states, strict=True):
            run.restore(state)

    def _take_snapshots(self, saved: Saved) -> list[Snapshot]:
        grid, stars, reach = self._start.scene.grid, self._start.given_stars, 0.0
        if self._start.refines:
            from lnocl.solvers.positions import RADIUS

            reach = RADIUS * (1.0 + 1e-9)  # which rounding may exceed
        name, whole, double = f"{SNAPSHOTS}_", np.dtype(np.int64), np.dtype(np.float64)
        count = (range(1, self._n_iter + 1),)
        iterations = saved.take(f"{name}iteration", whole, count, 1, self._n_iter)
        k, n = len(iterations), len(stars)
        return [
            Snapshot(*each)
            for each in zip(
                iterations.tolist(),
                saved.take(f"{name}extended", self._dtype, (k, 2, *grid), 0.0, LARGEST),
                saved.take(f"{name}star_fluxes", double, (k, 2, n), 0.0, LARGEST),
                saved.take(f"{name}positions", double, (k, 2, n, 2), stars - reach, stars + reach),
                strict=True,
            )
        ]


def next_snapshot(iteration: int) -> int:
    """Return the iteration of which a snapshot is taken after that of another."""
    return max(iteration + 1, math.floor(SPACING * iteration))
