"""Where runs start: a scene, an estimate of it, and what its steps are measured with."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from lnocl.core.scene.arrays import Array
from lnocl.core.scene.estimate import Estimate
from lnocl.core.scene.observation import Observation
from lnocl.core.scene.penalty import Penalty
from lnocl.core.scene.scene import Scene
from lnocl.core.scene.stars import MAX_SHIFT

if TYPE_CHECKING:
    from lnocl.core.scene.forward_model import Model
    from lnocl.core.solvers import SolverName
    from lnocl.core.solvers.scaling import Scaling


@dataclass(frozen=True)
class Setup:
    """The observation and the parameters that all runs of one call of `deconvolve` share.

    Attributes are the arguments of `deconvolve`, checked; `stars` are the positions as given, and
    `settles_halos` whether halos are held at what `lnocl.core.runs.halos` finds. `in_time` is
    whether exposures were given, where those of the observation were changed, and `looks_round`
    whether stars may lie in another minimum than the nearest, where they are moved.
    """

    observation: Observation
    stars: Array
    pad: int | str
    solver: SolverName
    precision: str
    engine: str
    device: str | None
    refine_positions: bool = False
    initial_extended: Array | None = None
    initial_star_fluxes: Array | None = None
    settles_halos: bool = False
    in_time: bool | None = None
    looks_round: bool = True

    @property
    def is_rate(self) -> bool:
        """Whether the sky is per unit of time, as exposures were given."""
        given = self.in_time
        return bool((self.observation.exposure != 1.0).any()) if given is None else given

    def scene(self, penalty: Penalty) -> Scene:
        """Return the model of the observation, with the stars where they were given."""
        max_shift = MAX_SHIFT if self.refine_positions else 0.0
        return Scene(self.observation, self.stars, penalty, self.pad, max_shift)

    def engine_name(self) -> str:
        """Return the name of the engine: the device, its platform and driver.

        Raises
        ------
        InputError
            There is no such device.
        DeviceError
            There is no device at all.
        """
        if self.engine == "numpy":
            from lnocl.core.engines.numpy import ReferenceEngine

            return ReferenceEngine.name
        from lnocl.core.opencl import device

        return device.describe(device.choose(self.device).device)

    def tuning_name(self) -> str:
        """Return the name of the tuning, which decides the last digits; "" with NumPy."""
        if self.engine == "numpy":
            return ""
        from lnocl.core.opencl import device, tuning

        dtype = np.dtype(np.float64 if self.precision == "double" else np.float32)
        chosen = device.choose(self.device).device
        return tuning.in_words(tuning.chosen(chosen, dtype), dtype)


@dataclass(frozen=True)
class Start:
    """Where a run starts, on the grid and scaled; runs of halves of the counts start alike.

    Attributes
    ----------
    setup : Setup
        The parameters that the runs share.
    scene : Scene
        The model of the observation, with the stars where they start.
    extended : ndarray of float64, shape (Ny, Nx)
        Extended source.
    star_fluxes : ndarray of float64, shape (n_fluxes,)
        Fluxes of stars and halos.
    scaling : Scaling or None
        For the scaled gradient projection method.
    """

    setup: Setup
    scene: Scene
    extended: Array
    star_fluxes: Array
    scaling: Scaling | None

    @property
    def refines(self) -> bool:
        """Whether there are stars to be moved."""
        return self.setup.refine_positions and self.scene.n_stars > 0

    def penalised(self, penalty: Penalty) -> Start:
        """Return this start with another penalty."""
        scene = self.scene.penalised(penalty)
        if self.scaling is None or scene.star_prior is self.scene.star_prior:
            return replace(self, scene=scene)
        from lnocl.core.solvers.scaling import heed

        star_fluxes, scaling = heed(scene.star_prior, self.star_fluxes, self.scaling)
        return replace(self, scene=scene, star_fluxes=star_fluxes, scaling=scaling)

    def of_half(self, observation: Observation) -> Start:
        """Return this start for half of the counts."""
        return replace(self, scene=self.scene.of_half(observation))

    def estimate(self) -> Estimate:
        """Return the estimate that a run starts from."""
        return Estimate.of_scaled(self.scene, self.extended, self.star_fluxes)

    def at(self, extended: Array, star_fluxes: Array, positions: Array) -> Start:
        """Return a start from another estimate."""
        if not self.refines:
            return replace(self, extended=extended, star_fluxes=star_fluxes)
        scene = copy(self.scene)
        scene.move_stars(positions)
        star_fluxes, scaling = measure_steps(
            self.setup, scene, make_model(scene), extended, star_fluxes
        )
        return replace(
            self, scene=scene, extended=extended, star_fluxes=star_fluxes, scaling=scaling
        )


def make_start(setup: Setup, penalty: Penalty) -> Start:
    """Return where a run starts, its stars moved there where that is asked for.

    Parameters
    ----------
    setup : Setup
        The parameters that the runs share.
    penalty : Penalty
        The penalty on the extended source.

    Raises
    ------
    InputError
        As `deconvolve`.
    """
    scene = setup.scene(penalty)
    setup = replace(setup, pad=scene.pad)  # for all that is made again of what the run finds
    extended, star_fluxes = scene.start(setup.initial_extended, setup.initial_star_fluxes)
    refines = setup.refine_positions and scene.n_stars > 0
    scaling = None
    if refines or setup.solver == "sgp":
        model = make_model(scene)  # which is large, and goes with this block
        if refines:
            star_fluxes = move_stars(setup, scene, model, extended, star_fluxes, setup.looks_round)
        star_fluxes, scaling = measure_steps(setup, scene, model, extended, star_fluxes)
    return Start(setup, scene, extended, star_fluxes, scaling)


# What follows loads scipy, which not every start needs.


def make_model(scene: Scene) -> Model:
    """Return the model of a scene on the host; it follows the stars."""
    from lnocl.core.scene.forward_model import Model

    return Model(scene)


def move_stars(
    setup: Setup,
    scene: Scene,
    model: Model,
    extended: Array,
    star_fluxes: Array,
    look_round: bool = False,
) -> Array:
    """Move the stars of a scene to where they are most likely; return their fluxes there."""
    from lnocl.core.solvers.positions import StarFit, Stars

    star_fluxes, halos = np.split(star_fluxes, [scene.n_stars])
    given = np.repeat(setup.stars, scene.n_epochs, axis=0)
    fit = StarFit(scene, model, extended, given, halos)
    current = Stars(star_fluxes, scene.stars)
    starts = [current, fit.look_round(current)] if look_round else [current]
    stars = min(map(fit.minimise, starts), key=fit.objective)
    scene.move_stars(stars.positions)
    return np.concatenate([stars.fluxes, halos])


def measure_steps(
    setup: Setup, scene: Scene, model: Model, extended: Array, star_fluxes: Array
) -> tuple[Array, Scaling | None]:
    """Return star fluxes to continue from, and the scaling of steps for the solver that has one."""
    if setup.solver != "sgp":
        return star_fluxes, None
    from lnocl.core.solvers.scaling import heed, prepare

    return heed(scene.star_prior, *prepare(scene, model, extended, star_fluxes))
