"""The paper's experiment: a simulation is reconstructed, and measured against its truth."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lnocl import metrics
from lnocl.deconvolution import deconvolve
from lnocl.errors import InputError
from lnocl.result import HISTORY_DTYPE, Estimate, models_of
from lnocl.runs.options import PAPER
from lnocl.scene.observation import Array, Observation
from lnocl.simulation import Simulation

CURVE_DTYPE = np.dtype(
    [
        ("iteration", np.int64),
        ("rho", np.float64),
        ("rho_star", np.float64),
        ("magnitude", np.float64),
    ]
)

# Half the rows of a profile near the star: the paper's 40, 20 before the star and 20 from it on.
NEAR_STAR = 20
# Share of the brightest row that a row needs to count in the flux profile near the star: behind
# the star the jet is so faint that relative errors there say nothing of it.
JET_SHARE = 0.05
# Share of the brightest true pixel above which a pixel counts as jet in the width profile.
WIDTH_SHARE = 0.1


@dataclass
class Reconstruction:
    """The estimate of the smallest error near the star, and the errors of all iterations.

    Attributes
    ----------
    method : str
        ``"RLM"`` (the star is part of the image) or ``"MC-RL"``.
    mu : float
        Weight of the Tikhonov term, per electron.
    curve : ndarray
        Fields ``iteration``, ``rho`` (rho', restoration error of all rows), ``rho_star``
        (rho'', of the 24 rows around the star) and ``magnitude`` (of the star).
    extended : ndarray of float64, shape (ny, nx)
        Estimate at the smallest rho'', electrons per pixel; for RLM the star is in it.
    star_flux : float
        Flux of the star at the smallest rho'', electrons; for RLM in a box of 3 x 3 pixels.
    history : ndarray
        Fields ``iteration`` and ``objective``, for every iteration.
    device : str
        Name of the device.
    models : ndarray of float64, shape (p, ny, nx)
        The models of that estimate, as `lnocl.Result.models`.
    """

    method: str
    mu: float
    curve: NDArray[np.void]
    extended: Array
    star_flux: float
    history: NDArray[np.void] = field(default_factory=lambda: np.zeros(0, HISTORY_DTYPE))
    device: str = ""
    models: Array = field(default_factory=lambda: np.zeros((0, 0, 0)))

    def best(self, field: str) -> tuple[int, float]:
        """Return the iteration and the value at which ``rho`` or ``rho_star`` is smallest."""
        row = self.curve[int(np.argmin(self.curve[field]))]
        return int(row["iteration"]), float(row[field])

    @property
    def name(self) -> str:
        """Method and mu, as tables and legends show them."""
        return self.method if self.method == "RLM" else f"MC-RL mu={self.mu:g}"


class Tracker:
    """A callback that measures the errors of estimates, and stores the best estimate.

    Parameters
    ----------
    simulation : Simulation
        Simulation with one star.
    method : {"RLM", "MC-RL"}
        Method, by which errors and magnitude are measured (La Camera et al. 2012, section 3.2).
    every : int
        Iterations from one measurement to the next, 1 or more.
    n_iter : int
        The last iteration, which is always measured.
    patience : float, optional
        The run stops after this many times the iterations of the smallest rho' and rho''.

    Raises
    ------
    InputError
        The simulation has not exactly one star, or `every` is less than 1.
    """

    def __init__(
        self,
        simulation: Simulation,
        method: str,
        every: int,
        n_iter: int,
        patience: float | None = None,
    ) -> None:
        if every < 1:
            raise InputError(f"every must be a whole number, 1 or more; {every} was given")
        self.star = _only_star(simulation)
        self._simulation = simulation
        self._has_star = method == "RLM"
        self._every, self._n_iter, self._patience = every, n_iter, patience
        self._rows = metrics.star_rows(self.star, simulation.extended.shape)
        self._truth = simulation.extended.copy()
        if self._has_star:
            self._truth[self.star[1], self.star[0]] += simulation.star_fluxes[0]
        self.curve: list[tuple[int, float, float, float]] = []
        self.extended = np.zeros(0)
        self.star_flux = 0.0
        self._smallest = {"rho": (0, np.inf), "rho_star": (0, np.inf)}

    def __call__(self, iteration: int, estimate: Estimate) -> bool:
        """Measure the estimate if this iteration is due, and return whether to stop."""
        if iteration % self._every and iteration != self._n_iter:
            return False
        extended = estimate.extended
        masked = self.star if self._has_star else None
        rho = metrics.restoration_error(extended, self._truth, star=masked)
        rho_star = metrics.restoration_error(extended, self._truth, self._rows, masked)
        if self._has_star:
            flux = metrics.box_flux(extended, self.star)
        else:
            flux = float(estimate.star_fluxes[0])
        magnitude = metrics.magnitude(flux, self._simulation.zero_magnitude_flux)
        self.curve.append((iteration, rho, rho_star, magnitude))
        if rho < self._smallest["rho"][1]:
            self._smallest["rho"] = iteration, rho
        if rho_star < self._smallest["rho_star"][1]:
            self._smallest["rho_star"] = iteration, rho_star
            self.extended, self.star_flux = extended, flux
        last = max(at for at, _ in self._smallest.values())
        return self._patience is not None and iteration > self._patience * last


def observe(simulation: Simulation) -> Observation:
    """Return the images of a simulation as an observation, with background and read noise."""
    return Observation(
        simulation.images,
        simulation.psfs,
        background=simulation.background,
        read_noise=simulation.read_noise,
    )


def reconstruct(
    simulation: Simulation,
    observation: Observation,
    method: str,
    mu: float,
    n_iter: int,
    every: int = 10,
    patience: float | None = None,
    **keywords: Any,
) -> Reconstruction:
    """Reconstruct a simulation by one method, and measure its errors on the way.

    Parameters
    ----------
    simulation : Simulation
        Simulation with one star.
    observation : Observation
        The simulation as `observe` returns it.
    method : {"RLM", "MC-RL"}
        Without or with the star as a component of its own.
    mu : float
        Weight of the Tikhonov term, per electron.
    n_iter : int
        Largest number of iterations.
    every, patience
        As for `Tracker`.
    **keywords
        Further arguments of `lnocl.deconvolve`, whose defaults here are those of the paper.

    Returns
    -------
    Reconstruction
        The estimate of the smallest rho'', and the curve of errors.

    Raises
    ------
    InputError
        The simulation has not exactly one star, `every` is less than 1, or
        `lnocl.deconvolve` refuses a value.
    """
    tracker = Tracker(simulation, method, every, n_iter, patience)
    stars = [] if method == "RLM" else simulation.stars
    keywords = PAPER | keywords
    result = deconvolve(observation, stars, mu=mu, n_iter=n_iter, callback=tracker, **keywords)
    fluxes = np.array([tracker.star_flux] if stars else [])
    best = replace(result._outcome, sky=tracker.extended, star_fluxes=fluxes)
    return Reconstruction(
        method,
        mu,
        np.array(tracker.curve, CURVE_DTYPE),
        tracker.extended,
        tracker.star_flux,
        result.history,
        result.device,
        np.array(list(models_of(best))),
    )


def width_threshold(truth: Array) -> float:
    """Return the count above which a pixel belongs to the jet in the width profile."""
    return WIDTH_SHARE * float(truth.max())


def profile_errors(simulation: Simulation, found: Reconstruction) -> dict[str, float]:
    """Return the mean absolute relative errors of the flux and width profiles near the star.

    The means are over the rows of `near_star` that have a value in `profile_deviations`; for RLM
    without the 3 rows around the star (La Camera et al. 2012, section 4). They are NaN where no
    row has a value.
    """
    truth, star = simulation.extended, _only_star(simulation)
    masked = star if found.method == "RLM" else None
    near = near_star(star)
    errors = profile_deviations(found.extended, truth, masked)
    return {kind: _mean_size(each[near]) for kind, each in errors.items()}


def near_star(star: tuple[int, int]) -> slice:
    """Return the 40 rows around the star, 20 before it and 19 after it, cut at the edges."""
    return slice(max(star[1] - NEAR_STAR, 0), star[1] + NEAR_STAR)


def profile_deviations(
    extended: Array, truth: Array, masked: tuple[int, int] | None = None
) -> dict[str, Array]:
    """Return the signed relative errors of the flux and width profiles, row by row.

    Parameters
    ----------
    extended, truth : ndarray of float64, shape (ny, nx)
        The estimate and the true source, electrons per pixel.
    masked : (x, y), optional
        Position of the star around which 3 rows are left out, where it is in `extended` (RLM).

    Returns
    -------
    dict of str to ndarray of float64, shape (ny,)
        ``flux``, NaN where the true row is fainter than a twentieth of the brightest, and
        ``width``, NaN where no true pixel of the row is above `width_threshold`.
    """
    true_flux = metrics.flux_profile(truth)
    true_flux = np.where(true_flux < JET_SHARE * true_flux.max(), 0.0, true_flux)
    threshold = width_threshold(truth)
    return {
        "flux": metrics.relative_error(metrics.flux_profile(extended, masked), true_flux),
        "width": metrics.relative_error(
            metrics.width_profile(extended, threshold, masked),
            metrics.width_profile(truth, threshold),
        ),
    }


def _only_star(simulation: Simulation) -> tuple[int, int]:
    if len(simulation.stars) != 1:
        raise InputError(
            f"the simulation has {len(simulation.stars)} stars; errors near the star need "
            "exactly one"
        )
    return simulation.stars[0]


def _mean_size(errors: Array) -> float:
    sizes = np.abs(errors[~np.isnan(errors)])
    return float(sizes.mean()) if sizes.size else float("nan")
