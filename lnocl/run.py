"""A solver at work on an observation: what `deconvolve` drives, one or several at a time."""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from numpy.typing import ArrayLike

from lnocl.observation import Array, Observation
from lnocl.scene import Scene
from lnocl.solvers import SOLVERS


@dataclass(frozen=True)
class Setup:
    """What runs on several observations of one sky have in common; as for `deconvolve`."""

    stars: Sequence[tuple[float, float]]
    pad: int
    solver: str
    precision: str
    engine: str
    device: str | None


class Run:
    """A solver and its engine, at work on one observation.

    Parameters
    ----------
    setup : Setup
        What is done.
    observation : Observation
        On what.
    mu : float
        Weight of the Tikhonov term.
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
        mu: float,
        n_iter: int,
        initial_extended: ArrayLike | None = None,
        initial_star_fluxes: ArrayLike | None = None,
    ) -> None:
        self.scene = Scene(observation, setup.stars, mu, setup.pad)
        extended, star_fluxes = self.scene.start(initial_extended, initial_star_fluxes)
        scaling = None
        if setup.solver == "sgp":
            from lnocl.scaling import prepare  # it loads scipy, which not every start needs

            star_fluxes, scaling = prepare(self.scene, extended, star_fluxes)
        self.engine = _make_engine(setup, self.scene, n_iter, scaling)
        self.engine.start(extended, star_fluxes)
        self.done = 0
        self._iterations = SOLVERS[setup.solver](self.engine, n_iter)

    def __iter__(self) -> Iterator[int]:
        for iteration in self._iterations:
            self.done = iteration
            yield iteration

    def extended(self) -> Array:
        """Return the extended source, electrons per pixel, shape (ny, nx)."""
        ny, nx = self.scene.observation.shape
        return self.engine.extended()[:ny, :nx] * self.scene.scale

    def star_fluxes(self) -> Array:
        """Return the star fluxes, electrons."""
        return self.engine.star_fluxes() * self.scene.scale

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


def _make_engine(setup: Setup, scene: Scene, n_iter: int, scaling: Any) -> Any:
    # Imported where it is chosen: the reference runs where no OpenCL is installed.
    if setup.engine == "numpy":
        return importlib.import_module("lnocl.reference").ReferenceEngine(scene, scaling)
    opencl = importlib.import_module("lnocl.opencl")
    return opencl.OpenCLEngine(scene, setup.precision, setup.device, n_iter, scaling=scaling)
