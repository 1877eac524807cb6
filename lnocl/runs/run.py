"""A solver at work on an observation: what `deconvolve` drives, one or several at a time."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import islice
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lnocl.errors import refuse_not_finite
from lnocl.scene.observation import Array, Observation
from lnocl.scene.penalty import Penalty
from lnocl.scene.scene import Scene
from lnocl.solvers import SOLVERS
from lnocl.solvers.sgp import Steps

if TYPE_CHECKING:
    from lnocl.scene.forward_model import Model
    from lnocl.solvers.scaling import Scaling


@dataclass(frozen=True)
class Setup:
    """What runs on several observations of one sky have in common; as for `deconvolve`."""

    stars: Sequence[tuple[float, float]]
    pad: int | str
    solver: str
    precision: str
    engine: str
    device: str | None
    refine_positions: bool = False


# Iterations after which star positions are refined: this, and twice as many each time.
FIRST_REFINED = 3


class Run:
    """A solver and its engine, at work on one observation.

    Parameters
    ----------
    setup : Setup
        What is done.
    observation : Observation
        On what.
    penalty : Penalty
        On the extended source.
    n_iter : int
        Iterations at most.
    initial_extended, initial_star_fluxes : array_like, optional
        Where it starts, as for `deconvolve`.

    Attributes
    ----------
    scene : Scene
        What is modelled.
    engine : Engine
        Where it is computed.
    done : int
        Iterations done.

    Raises
    ------
    InputError, DeviceError
        As `deconvolve`.
    """

    def __init__(
        self,
        setup: Setup,
        observation: Observation,
        penalty: Penalty,
        n_iter: int,
        initial_extended: ArrayLike | None = None,
        initial_star_fluxes: ArrayLike | None = None,
    ) -> None:
        leeway = 0.0
        if setup.refine_positions:
            from lnocl.solvers.positions import RADIUS

            leeway = RADIUS
        self._setup, self._n_iter = setup, n_iter
        self.scene = Scene(observation, setup.stars, penalty, setup.pad, leeway)
        self._given_stars = self.scene.stars
        self._refines = setup.refine_positions and self.scene.n_stars > 0
        extended, star_fluxes = self.scene.start(initial_extended, initial_star_fluxes)
        needs_model = self._refines or setup.solver == "sgp"
        model = _make_model(self.scene) if needs_model else None
        if self._refines:
            self._model: Any = model  # else it is let go
            star_fluxes = self._move_stars(extended, star_fluxes, look_round=True)
        scaling = None
        if setup.solver == "sgp":
            star_fluxes, scaling = _prepare(self.scene, model, extended, star_fluxes)
        self.engine: Any = _make_engine(setup, self.scene, n_iter, scaling)
        self.engine.start(extended, star_fluxes)
        self.done = 0
        self._begin_stage()

    def __iter__(self) -> Iterator[int]:
        solve = SOLVERS[self._setup.solver]
        while self.done < self._n_iter:
            begin, is_stage_new = self.done, not self._steps.has_iterated
            for iteration in solve(self.engine, self._due - begin, self._steps):
                self.done = begin + iteration
                yield self.done
            was_stuck = is_stage_new and begin == self.done < self._due
            if was_stuck or not self._refines:
                return
            if self.done < self._n_iter:
                self._refine()
                self._begin_stage()

    def _begin_stage(self) -> None:
        """Begin the iterations until positions are refined, or the last one."""
        self._steps = Steps()
        due = max(FIRST_REFINED, 2 * self.done) if self._refines else self._n_iter
        self._due = min(due, self._n_iter)

    def state(self) -> dict[str, NDArray]:
        """Return what `restore` needs, as it is between iterations.

        Raises
        ------
        NotFiniteError
            There are values in it that are infinite or not a number.
        """
        steps, scaling = self._steps, self.engine.scaling
        state = {
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

    def proven_state(self) -> dict[str, NDArray]:
        """Return the state, of an estimate whose objective is finite.

        Raises
        ------
        NotFiniteError
            The objective is infinite or not a number, or values in the state are.
        """
        state = self.state()
        is_recorded = len(self.engine.objectives()) > self.done
        self.finish()
        refuse_not_finite(self.engine.objective())
        if not is_recorded:  # the solver is about to make the same ratios
            self.engine.restore(state)
        return state

    def restore(self, state: dict[str, NDArray]) -> None:
        """Go on from the state of such a run, made of the same observation and parameters."""
        self.done, self._due = (int(number) for number in state["progress"][:2])
        alpha, *lengths = state["steps"].tolist()
        self._steps = Steps(alpha, lengths, bool(state["progress"][2]))
        if self._refines:
            self.scene.move_stars(state["positions"])
            self.engine.move_stars()
        if self.engine.scaling is not None:
            self.engine.set_scaling(self._restored_scaling(state))
        self.engine.restore(state)
        self._forget_end()

    def redo(self, state: dict[str, NDArray]) -> None:
        """Go from a state to the last estimate whose objective, and those before, were finite.

        On a new engine, as nothing that the old one holds can be trusted.

        Raises
        ------
        NotFiniteError
            There is none.
        """
        finite = np.isfinite(self.engine.objectives())
        last = (len(finite) if finite.all() else int(np.argmin(finite))) - 1
        scaling, self.engine = self.engine.scaling, None  # the device need not hold both
        self.engine = _make_engine(self._setup, self.scene, self._n_iter, scaling)
        self.restore(state)
        for _ in islice(self, max(last - self.done, 0)):
            pass
        self.finish()
        self.state()  # which is finite

    def _restored_scaling(self, state: dict[str, NDArray]) -> Scaling:
        from lnocl.solvers.scaling import Scaling

        return Scaling.from_state(state)

    def _refine(self) -> None:
        """Move the stars to where the extended source of now makes them most likely."""
        self._forget_end()
        extended = self.engine.extended()
        refuse_not_finite(extended.sum())
        star_fluxes = self._move_stars(extended, self.engine.star_fluxes())
        if self.engine.scaling is not None:
            star_fluxes, scaling = _prepare(self.scene, self._model, extended, star_fluxes)
            self.engine.set_scaling(scaling)
        self.engine.move_stars()
        self.engine.start(extended, star_fluxes)

    def _move_stars(self, extended: Array, star_fluxes: Array, look_round: bool = False) -> Array:
        """Move the stars of the scene; return their fluxes there."""
        from lnocl.solvers.positions import StarFit, Stars

        fit = StarFit(self.scene, self._model, extended, self._given_stars)
        given = Stars(star_fluxes, self.scene.stars)
        starts = [given, fit.look_round(given)] if look_round else [given]
        stars = min(map(fit.minimise, starts), key=fit.objective)
        self.scene.move_stars(stars.positions)
        return stars.fluxes

    def star_positions(self) -> Array:
        """Return the star positions, pixels, shape (n, 2)."""
        return self.scene.stars

    def star_errors(self) -> tuple[Array, Array]:
        """Return the standard errors of star fluxes and positions, 0 where none were refined."""
        if not self._refines:
            return np.zeros(self.scene.n_stars), np.zeros((self.scene.n_stars, 2))
        from lnocl.solvers.positions import StarFit, Stars

        fit = StarFit(self.scene, self._model, self.engine.extended(), self._given_stars)
        errors = fit.errors(Stars(self.engine.star_fluxes(), self.scene.stars))
        # J is divided by the scale too, so that its information is that of as many fewer counts.
        fluxes, positions = errors.fluxes * self.scene.unit, errors.positions
        root = 1.0 / np.sqrt(self.scene.scale)
        return fluxes * root, positions * root

    def extended(self) -> Array:
        """Return the extended source, electrons per pixel, shape (ny, nx)."""
        ny, nx = self.scene.observation.shape
        return self.engine.extended()[:ny, :nx] * self.scene.unit

    def star_fluxes(self) -> Array:
        """Return the star fluxes, electrons."""
        return self.engine.star_fluxes() * self.scene.unit

    def models(self) -> Callable[[], Array]:
        """Return what makes the m_j of the estimate of now, electrons per pixel."""
        extended, star_fluxes = self.engine.extended(), self.engine.star_fluxes()
        return partial(_model_images, self.scene, extended, star_fluxes)

    def objective(self) -> float:
        """Return the objective recorded last."""
        return self.engine.objective() * self.scene.scale

    def objectives(self) -> Array:
        """Return the objectives recorded so far: of the start, and after each iteration."""
        return self.engine.objectives() * self.scene.scale

    def finish(self) -> None:
        """Record the objective of the last estimate, where the solver has not done so."""
        if len(self.engine.objectives()) == self.done:
            self.engine.ratio()

    def _forget_end(self) -> None:
        """Take the objective of the last estimate off the record, where the solver has put it."""
        if len(self.engine.objectives()) > self.done:
            self.engine.forget_objective()


# What follows loads scipy, which not every start needs.


def _make_model(scene: Scene) -> Model:
    from lnocl.scene.forward_model import Model

    return Model(scene)


def _prepare(
    scene: Scene, model: Any, extended: Array, star_fluxes: Array
) -> tuple[Array, Scaling]:
    from lnocl.solvers.scaling import prepare

    return prepare(scene, model, extended, star_fluxes)


def _model_images(scene: Scene, extended: Array, star_fluxes: Array) -> Array:
    ny, nx = scene.observation.shape
    model = _make_model(scene)
    images = model.images(extended, star_fluxes)
    if scene.has_exposure_map:
        images *= model.weights
    return images[:, :ny, :nx] * scene.scale


def engine_name(setup: Setup) -> str:
    """Return the name of the engine that runs have: the device, its platform and driver.

    Raises
    ------
    InputError
        No such device.
    DeviceError
        No device at all.
    """
    if setup.engine == "numpy":
        return str(importlib.import_module("lnocl.engines.numpy").ReferenceEngine.name)
    device = importlib.import_module("lnocl.opencl.device")
    return str(device.describe(device.choose(setup.device).device))


def _make_engine(setup: Setup, scene: Scene, n_iter: int, scaling: Any) -> Any:
    # Imported where it is chosen: the reference runs where no OpenCL is installed.
    if setup.engine == "numpy":
        return importlib.import_module("lnocl.engines.numpy").ReferenceEngine(scene, scaling)
    opencl = importlib.import_module("lnocl.engines.opencl")
    return opencl.OpenCLEngine(scene, setup.precision, setup.device, n_iter, scaling=scaling)
