"""A run: a solver and its engine on one observation, with what it takes to continue it."""

from __future__ import annotations

from collections.abc import Iterator
from copy import copy
from functools import cached_property
from itertools import islice
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lnocl.core.runs.descent import Descent
from lnocl.core.runs.outcome import Outcome
from lnocl.core.runs.start import Setup, Start, make_model, measure_steps, move_stars
from lnocl.core.scene.arrays import Array
from lnocl.core.scene.estimate import Estimate
from lnocl.core.scene.observation import Observation
from lnocl.core.scene.scene import Scene
from lnocl.core.solvers import SOLVERS
from lnocl.core.solvers.engine import Engine, State
from lnocl.core.solvers.sgp import Steps
from lnocl.errors import refuse_not_finite

if TYPE_CHECKING:
    from lnocl.core.scene.forward_model import Model
    from lnocl.core.solvers.scaling import Scaling

# Star positions are refined after this many iterations, then after twice as many each time.
FIRST_REFINED = 3


class Run:
    """A solver and its engine on one observation; iterating over it runs it.

    Parameters
    ----------
    start : Start
        Where it starts.
    n_iter : int
        Iterations at most.
    half : {0, 1}, optional
        Which half of the counts it is of, where both are run side by side.

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

    Raises
    ------
    InputError, DeviceError
        As `deconvolve`.
    """

    def __init__(self, start: Start, n_iter: int, half: int | None = None) -> None:
        self._setup, self.n_iter, self._half = start.setup, n_iter, half
        self.scene = copy(start.scene)
        self._refines = start.refines
        self.engine = _make_engine(self._setup, self.scene, n_iter, start.scaling, half)
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
        solve = SOLVERS[self._setup.solver]
        descent = Descent(self.scene)
        descent.check(self.engine.objectives().tolist())  # those from before a checkpoint
        while self.done < self.n_iter:
            begin, is_stage_new = self.done, not self._steps.has_iterated
            prior = self.scene.star_prior
            for iteration in solve(self.engine, self._due - begin, self._steps, prior):
                self.done = begin + iteration
                if fetched := self.engine.fetched_objectives():
                    descent.check(fetched)
                yield self.done
            was_stuck = is_stage_new and begin == self.done < self._due
            if was_stuck or not self._refines:
                return
            if self.done < self.n_iter:
                self._refine()
                self._begin_stage()

    def _begin_stage(self) -> None:
        """Set the iteration until which positions stay: the next to refine at, or the last."""
        self._steps = Steps()
        due = max(FIRST_REFINED, 2 * self.done) if self._refines else self.n_iter
        self._due = min(due, self.n_iter)

    def state(self) -> State:
        """Return the arrays that `restore` needs, as they are between iterations.

        Raises
        ------
        NotFiniteError
            A value is infinite or not a number.
        """
        steps, scaling = self._steps, self.engine.scaling
        state: State = {
            **self.engine.state(),
            "progress": np.array([self.done, self._due, steps.has_iterated]),
            "steps": np.array([steps.alpha, *steps.lengths]),
            "positions": self.scene.stars,
        }
        if scaling is not None:
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
        state = self.state()
        is_recorded = len(self.engine.objectives()) > self.done
        self.finish()
        objectives = self.engine.objectives()
        refuse_not_finite(objectives[-1])
        if not is_recorded:  # the solver is about to make the same ratios
            self.engine.restore(state)
        return state, int(np.argmin(objectives)) == self.done

    def restore(self, state: State) -> None:
        """Continue from the state of a run of the same observation and parameters."""
        self.done, self._due = (int(number) for number in state["progress"][:2])
        alpha, *lengths = state["steps"].tolist()
        self._steps = Steps(alpha, lengths, bool(state["progress"][2]))
        if self._refines:
            self.scene.move_stars(state["positions"])
            self.engine.move_stars()
        if self.engine.scaling is not None:
            from lnocl.core.solvers.scaling import Scaling

            self.engine.set_scaling(Scaling.from_state(state))
        self.engine.restore(state)
        self._forget_end()

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
        self.engine = _make_engine(self._setup, self.scene, self.n_iter, scaling, self._half)
        self.restore(state)
        for _ in islice(self, max(best - self.done, 0)):
            pass
        self.finish()
        self.state()  # refuses values that are not finite

    @cached_property
    def _model(self) -> Model:
        """The model of the scene; it follows the stars."""
        return make_model(self.scene)

    def _refine(self) -> None:
        """Move the stars to where they are most likely, given the current extended source."""
        self._forget_end()
        extended = self.engine.extended()
        refuse_not_finite(extended.sum())
        shared = self._setup, self.scene, self._model, extended
        star_fluxes = move_stars(*shared, self.engine.star_fluxes())
        star_fluxes, scaling = measure_steps(*shared, star_fluxes)
        if scaling is not None:
            self.engine.set_scaling(scaling)
        self.engine.move_stars()
        self.engine.start(extended, star_fluxes)

    def estimate(self) -> Estimate:
        """Return the estimate on the grid."""
        extended, fluxes = self.engine.extended(), self.engine.star_fluxes()
        return Estimate.of_scaled(self.scene, extended, fluxes)

    def star_positions(self) -> Array:
        """Return the star positions, pixels, shape (n, 2)."""
        return self.scene.stars

    def extended(self) -> Array:
        """Return the extended source, electrons per pixel of it."""
        ny, nx = self.scene.observation.sky_shape
        return self.engine.extended()[:ny, :nx] * self.scene.unit

    def star_fluxes(self) -> Array:
        """Return the star fluxes, electrons."""
        return self.engine.star_fluxes() * self.scene.unit

    def is_shown(self) -> NDArray[np.bool_]:
        """Return which stars, and halos, any image shows."""
        return self.scene.is_shown

    def objective(self) -> float:
        """Return the last objective."""
        return self.engine.objective() * self.scene.scale

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

    def finish(self) -> None:
        """Record the objective of the current estimate, where the solver has not done so."""
        if len(self.engine.objectives()) == self.done:
            self.engine.ratio()

    def outcome(self, stop_reason: str) -> Outcome:
        """Return the estimate and the record of a run that has ended."""
        self.finish()
        return Outcome(
            setup=self._setup,
            estimate=self.estimate(),
            objectives=self.objectives(),
            stop_reason=stop_reason,
        )

    def _forget_end(self) -> None:
        """Take the objective of the current estimate off the record, where it is there."""
        if len(self.engine.objectives()) > self.done:
            self.engine.forget_objective()


def _make_engine(
    setup: Setup, scene: Scene, n_iter: int, scaling: Scaling | None, half: int | None
) -> Engine:
    # Imported where it is chosen: the reference runs where no OpenCL is installed.
    if setup.engine == "numpy":
        from lnocl.core.engines.numpy import ReferenceEngine

        return ReferenceEngine(scene, scaling)
    from lnocl.core.engines.opencl import OpenCLEngine

    return OpenCLEngine(scene, setup.precision, setup.device, n_iter, scaling=scaling, half=half)
