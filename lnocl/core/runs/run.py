"""A run: a solver and its engine on one observation, with what it takes to continue it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from copy import copy
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lnocl.core.engines.engine import Engine, State
from lnocl.core.runs.descent import Descent
from lnocl.core.runs.outcome import Outcome
from lnocl.core.runs.start import Setup, Start, make_model, measure_steps, move_stars
from lnocl.core.scene.arrays import Array
from lnocl.core.scene.estimate import Estimate
from lnocl.core.scene.observation import Observation
from lnocl.core.scene.scene import Scene
from lnocl.core.scene.steps import NOT_FINITE, PAUSED, SETTLED
from lnocl.errors import DeviceError, refuse_not_finite

if TYPE_CHECKING:
    from lnocl.core.scene.forward_model import Model
    from lnocl.core.solvers.scaling import Scaling

# Star positions are refined after this many iterations, then after twice as many each time.
FIRST_REFINED = 3
# Iterations that are queued at once: as many as have so many pixels, so that an interrupt is
# answered soon, and no more than this, as the device runs idle while the host looks; fewer where a
# run may settle meanwhile.
AHEAD_PIXELS, MOST_AHEAD = 2**26, (64, 16)


class Run:
    """A solver and its engine on one observation; iterating over it runs it.

    Parameters
    ----------
    start : Start
        Where it starts.
    n_iter : int
        Iterations at most.
    tolerance : float, optional
        It ends where the objective changes by less than this share of itself an iteration, in the
        mean of ten; 0 for never.
    engine : Engine, optional
        One of a scene like that of the start; by default a new one.

    Attributes
    ----------
    scene : Scene
        The model of the observation; the stars are where the run has moved them.
    engine : Engine
        The engine that computes it.
    n_iter : int
        Iterations at most.
    done : int
        Iterations done.
    tolerance : float
        As given; it may be changed.
    stride : int
        Iterations between two looks at the run, at most; it may be changed.
    goal : int
        An iteration beyond which it does not run before the next look; it may be changed.

    Raises
    ------
    InputError, DeviceError
        As `deconvolve`.
    """

    def __init__(
        self, start: Start, n_iter: int, tolerance: float = 0.0, engine: Engine | None = None
    ) -> None:
        self._setup, self.n_iter, self.tolerance = start.setup, n_iter, tolerance
        part = copy(start.scene), start.scaling
        self.engine = engine or _make_engines(start.setup, [part], n_iter)[0]
        self.scene = self.engine.scene
        ahead = AHEAD_PIXELS // (self.scene.n_images * math.prod(self.scene.grid))
        self.stride, self.goal = min(max(ahead, 1), MOST_AHEAD[tolerance > 0]), n_iter
        self._refines = start.refines
        self._begin(start)

    def _begin(self, start: Start) -> None:
        self.engine.start(start.extended, start.star_fluxes)
        self.done = 0
        self._begin_stage()

    def repeat(self, start: Start, observation: Observation) -> None:
        """Begin again where the run started, with other images; buffers and programs stay.

        Parameters
        ----------
        start : Start
            Where the run started.
        observation : Observation
            That of the run, but for its images.
        """
        self.scene.observation = observation
        if self._refines:
            self.scene.move_stars(start.scene.stars)
            self.engine.move_stars()
            if start.scaling is not None:
                self.engine.set_scaling(start.scaling)
        self.engine.take_images()
        self._begin(start)

    def __iter__(self) -> Iterator[int]:
        """Run to the end, yielding the iterations done at each look.

        Raises
        ------
        NotFiniteError, DivergedError
            The objective is not finite, or rises.
        """
        descent = Descent(self.scene)
        self._check(descent, 0)  # those from before a checkpoint
        while self.done < self.n_iter:
            begin, is_stage_new = self.done, self.engine.look().is_first
            while (looked := self.done) < (due := min(self._due, self.n_iter)):
                if not self._advance():
                    break
                self._check(descent, looked + 1)
                yield self.done
            was_stuck = is_stage_new and begin == self.done < due
            if was_stuck or self.is_settled or not self._refines:
                return
            if self.done < self.n_iter:
                self._refine()
                self._begin_stage()

    def _check(self, descent: Descent, first: int) -> None:
        """Refuse objectives that rise, where steps are not refused for that."""
        if self.engine.scaling is None:
            descent.check(self.engine.objectives(first)[: self.done + 1 - first].tolist())

    def _advance(self) -> bool:
        """Do iterations until the next look is due; return whether any was done."""
        before = self.done
        self.set_off()
        self.engine.finish()
        steps = self.engine.look()
        if steps.reason == NOT_FINITE:
            refuse_not_finite(math.nan)
        self.done = steps.done
        return self.done > before

    def set_off(self) -> None:
        """Let the engine's next ticks iterate until the next look is due."""
        steps, goal = self.engine.look(), min(self._due, self.n_iter, self.goal)
        # Where it is beyond those done it has set off, and its batch's ticks have brought it there.
        rests = steps.reason == PAUSED and not steps.going and steps.done == self.done
        if rests and self.done < goal:
            self.engine.go_on(min(self.done + self.stride, goal) + 1, self.tolerance)

    def complete(self, tick: Callable[[int], object] = int) -> str:
        """Run to the end, telling how many iterations are done more; return why it ended."""
        before = self.done
        for done in self:
            tick(done - before)
            before = done
        if self.is_settled:
            return "change"
        return "n_iter" if self.done == self.n_iter else "converged"

    @property
    def is_settled(self) -> bool:
        """Whether the objective changes by less than the tolerance."""
        return self.engine.look().reason == SETTLED

    def _begin_stage(self) -> None:
        """Set the iteration until which positions stay: the next to refine at, or the last."""
        due = max(FIRST_REFINED, 2 * self.done) if self._refines else self.n_iter
        self._due = min(due, self.n_iter)

    def state(self) -> State:
        """Return the arrays that `restore` needs, as they are between iterations.

        Raises
        ------
        NotFiniteError
            A value is infinite or not a number.
        """
        scaling = self.engine.scaling
        state: State = {
            **self.engine.state(),
            "progress": np.array([self.done, self._due]),
            "positions": self.scene.stars,
        }
        if self._refines and scaling is not None:  # else it is that of the start
            state |= scaling.state()
        for values in state.values():
            refuse_not_finite(values.sum(initial=0.0, dtype=np.float64))
        return state

    def proven_state(self) -> tuple[State, bool]:
        """Return the state, of a finite objective, and whether that is the least so far.

        Raises
        ------
        NotFiniteError
            The objective is infinite or not a number, or values in the state are.
        """
        state, objectives = self.state(), self.engine.objectives()
        refuse_not_finite(objectives[-1])
        return state, int(np.argmin(objectives)) == self.done

    def restore(self, state: State) -> None:
        """Continue from the state of a run of the same observation and parameters."""
        self.done, self._due = state["progress"].tolist()
        if self._refines:
            self.scene.move_stars(state["positions"])
            self.engine.move_stars()
        if self._refines and (scaling := self.engine.scaling) is not None:
            self.engine.set_scaling(scaling.restored(state))
        self.engine.restore(state)

    def return_to_best(self, state: State) -> None:
        """Iterate from a state to the estimate of the least objective before the first not finite.

        This takes a new engine, as nothing that the old one holds can be trusted.

        Raises
        ------
        NotFiniteError
            There is no such estimate.
        """
        best = self.best_iteration()
        scaling = self.engine.scaling
        del self.engine  # the device need not hold both
        (self.engine,) = _make_engines(self._setup, [(self.scene, scaling)], self.n_iter)
        self.restore(state)
        n_iter, self.n_iter = self.n_iter, best
        self.complete()
        self.n_iter = n_iter
        self.state()  # refuses values that are not finite

    @cached_property
    def _model(self) -> Model:
        """The model of the scene; it follows the stars."""
        return make_model(self.scene)

    def _refine(self) -> None:
        """Move the stars to where they are most likely, given the current extended source."""
        extended = self._extended()
        refuse_not_finite(extended.sum())
        shared = self._setup, self.scene, self._model, extended
        star_fluxes = move_stars(*shared, self.engine.star_fluxes())
        star_fluxes, scaling = measure_steps(*shared, star_fluxes)
        if scaling is not None:
            self.engine.set_scaling(scaling)
        self.engine.move_stars()
        self.engine.start(extended, star_fluxes, self.done)

    def estimate(self) -> Estimate:
        """Return the estimate on the grid."""
        return Estimate.of_scaled(self.scene, self._extended(), self.engine.star_fluxes())

    def _extended(self) -> Array:
        """Return the extended source on the grid, scaled, in double precision."""
        return self.engine.extended().astype(np.float64)

    def star_positions(self) -> Array:
        """Return the star positions, pixels, shape (n, 2)."""
        return self.scene.stars

    def extended(self) -> Array:
        """Return the extended source, electrons per pixel of it."""
        return self.estimate().observed_sky

    def star_fluxes(self) -> Array:
        """Return the star fluxes, electrons."""
        return self.engine.star_fluxes() * self.scene.unit

    def is_shown(self) -> NDArray[np.bool_]:
        """Return which stars, and halos, any image shows."""
        return self.scene.is_shown

    def objective(self) -> float:
        """Return the last objective."""
        return float(self.objectives()[-1])

    def objectives(self) -> Array:
        """Return the objectives so far: of the start, and after each iteration."""
        return self.engine.objectives() * self.scene.scale

    def best_iteration(self) -> int:
        """Return the iteration of the least objective before the first that is not finite."""
        objectives = self.engine.objectives()
        is_infinite = ~np.isfinite(objectives)
        end = int(np.argmax(is_infinite)) if is_infinite.any() else len(objectives)
        return int(np.argmin(objectives[:end])) if end else 0

    def check_descent(self) -> None:
        """Refuse objectives, of the last iterations too, that are not finite or rise.

        Raises
        ------
        NotFiniteError, DivergedError
            As `Descent.check`.
        """
        Descent(self.scene).check(self.engine.objectives().tolist())

    def outcome(self, stop_reason: str) -> Outcome:
        """Return the estimate and the record of a run that has ended."""
        return Outcome(
            setup=self._setup,
            estimate=self.estimate(),
            objectives=self.objectives(),
            stop_reason=stop_reason,
        )


def make_runs(starts: Sequence[Start], n_iter: int) -> list[Run]:
    """Return runs from starts that differ in their images alone, as a batch: they share ticks.

    Where stars move, or arrays of all are too large for the device, each has an engine of its own.
    """
    parts = [(copy(start.scene), start.scaling) for start in starts]
    pairs = zip(starts, _make_engines(starts[0].setup, parts, n_iter), strict=True)
    return [Run(start, n_iter, engine=engine) for start, engine in pairs]


def complete_together(runs: Sequence[Run]) -> None:
    """Run all to the end; what they raise is raised here."""
    going = [(run, iter(run)) for run in runs]
    while going:
        for run, _ in going:
            run.set_off()
        going = [(run, each) for run, each in going if next(each, None) is not None]


def _make_engines(
    setup: Setup, parts: Sequence[tuple[Scene, Scaling | None]], n_iter: int
) -> Sequence[Engine]:
    """Return an engine for each scene and scaling."""
    # Imported where it is chosen: the reference runs where no OpenCL is installed.
    if setup.engine == "numpy":
        from lnocl.core.engines.numpy import ReferenceEngine

        return [ReferenceEngine(*each) for each in parts]
    from lnocl.core.engines.opencl import OpenCLEngine

    def make(k: int, n_members: int, n_in_all: int) -> OpenCLEngine:
        where, (scene, scaling) = (setup.precision, setup.device, n_iter), parts[k]
        return OpenCLEngine(scene, *where, None, scaling, n_members, n_in_all)

    n = len(parts)
    if n > 1 and not (setup.refine_positions and parts[0][0].n_stars):
        with suppress(DeviceError):  # as arrays of one may be given, if not of all
            first = make(0, n, n)
            return [first, *(first.member(k, parts[k][0]) for k in range(1, n))]
    return [make(k, 1, 0 if k else n) for k in range(n)]
