"""Reconstructions of two halves of the counts, in step, and the snapshots that are held of them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lnocl.core.engines.engine import State
from lnocl.core.runs.run import make_runs
from lnocl.core.runs.start import Start
from lnocl.core.scene.arrays import Array
from lnocl.errors import DivergedError, NotFiniteError, warn

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
    extended : sequence of two ndarray, shape (Ny, Nx)
        A and B, the extended sources.
    star_fluxes : ndarray of float64, shape (2, n)
        Star fluxes.
    positions : ndarray of float64, shape (2, n, 2)
        Star positions.
    """

    iteration: int
    extended: Sequence[NDArray[np.floating]]
    star_fluxes: Array
    positions: Array


class Halves:
    """Runs on two halves of the counts; iterating over them runs both, and takes snapshots.

    Parameters
    ----------
    starts : sequence of two Start
        Where they start.
    n_iter : int
        The last iteration, at most.
    stride : int
        Iterations between two looks at them, at most.
    first : int
        The iteration that they start from.

    Attributes
    ----------
    first : int
        The iteration that they start from.
    done : int
        The last iteration that both have done.
    snapshots : list of Snapshot
        At iterations a tenth apart.
    """

    def __init__(self, starts: Sequence[Start], n_iter: int, stride: int, first: int = 0) -> None:
        self._n_iter, self._stride = n_iter, stride
        self._runs = make_runs(starts, n_iter - first)
        self._going = [iter(run) for run in self._runs]
        self.first = self.done = first
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
            while self._advance(min(due, self.done + self._stride, self._n_iter)):
                if self.done == due:
                    self.snapshots.append(self.snapshot())
                    due = self._due()
                yield self.done
        except (DivergedError, NotFiniteError):
            best = self.first + min(run.best_iteration() for run in self._runs)
            self.snapshots = [each for each in self.snapshots if each.iteration <= best]
            if not self.snapshots:
                raise
            warn(
                f"the objective of a half of the counts rises after iteration {best}: held-out "
                f"counts choose among the iterations up to {self.snapshots[-1].iteration}"
            )

    def _advance(self, goal: int) -> bool:
        """Run both to an iteration beyond those done; return whether they get there."""
        for run in self._runs:
            run.goal = goal - self.first
        pairs = [*zip(self._runs, self._going, strict=True)]
        while any(run.done < run.goal for run in self._runs):
            for run in self._runs:
                run.set_off()
            for run, going in pairs:
                if run.done < run.goal and next(going, None) is None:
                    return False
        is_there, self.done = goal > self.done, goal
        return is_there

    def _due(self) -> int:
        """Return the iteration of the next snapshot."""
        return next_snapshot(self.snapshots[-1].iteration if self.snapshots else self.first)

    def snapshot(self) -> Snapshot:
        """Return the estimates as they are."""
        return Snapshot(
            self.done,
            [run.engine.extended() for run in self._runs],
            np.array([run.engine.star_fluxes() for run in self._runs]),
            np.array([run.scene.stars for run in self._runs]),
        )

    def extended(self) -> Array:
        """Return the sum of the extended sources, electrons per pixel, shape (ny, nx)."""
        return np.sum([run.extended() for run in self._runs], axis=0)

    def star_fluxes(self) -> Array:
        """Return the sums of the star fluxes, electrons."""
        return np.sum([run.star_fluxes() for run in self._runs], axis=0)

    def is_shown(self) -> NDArray[np.bool_]:
        """Return which stars, and halos, any image shows."""
        return self._runs[0].scene.is_shown

    def star_positions(self) -> Array:
        """Return the means of the star positions, pixels, shape (n, 2)."""
        return np.mean([run.star_positions() for run in self._runs], axis=0)

    def objective(self) -> float:
        """Return the sum of the last objectives."""
        return sum(run.objective() for run in self._runs)

    def objectives(self, last: int) -> Array:
        """Return the sums of the objectives, of where they started and all iterations up to one."""
        return np.sum([run.objectives()[: last - self.first + 1] for run in self._runs], axis=0)

    def state(self) -> State:
        """Return the arrays that `restore` needs, as they are between iterations.

        Raises
        ------
        NotFiniteError
            A value is infinite or not a number.
        """
        state = pack(SNAPSHOTS, self.snapshots)
        for k, run in enumerate(self._runs):
            state |= {f"{HALVES}{k}_{name}": array for name, array in run.state().items()}
        return state

    def restore(self, state: State) -> None:
        """Continue from this state."""
        for k, run in enumerate(self._runs):
            prefix = f"{HALVES}{k}_"
            own = {name for name in state if name.startswith(prefix)}
            run.restore({name.removeprefix(prefix): state[name] for name in own})
        self.snapshots = unpack(SNAPSHOTS, state)
        self.done = self.first + self._runs[0].done


def pack(name: str, snapshots: Sequence[Snapshot]) -> State:
    """Return the arrays of snapshots, by the names under which they are saved."""
    columns = zip(Snapshot._fields, zip(*snapshots, strict=True), strict=False)
    return {f"{name}_{field}": np.array(values) for field, values in columns}


def unpack(name: str, state: State) -> list[Snapshot]:
    """Return the snapshots that are saved under a name."""
    iterations, *others = (state.get(f"{name}_{field}", ()) for field in Snapshot._fields)
    return list(map(Snapshot, map(int, iterations), *others))


def next_snapshot(iteration: int) -> int:
    """Return the iteration of which a snapshot is taken after that of another."""
    return max(iteration + 1, math.floor(SPACING * iteration))
