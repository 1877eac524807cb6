"""The paper's experiment: reconstruct a simulation whose truth is known, and measure the result."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lnocl import metrics
from lnocl.deconvolution import HISTORY_DTYPE, Estimate, deconvolve
from lnocl.observation import Array, Observation
from lnocl.simulate import Simulation

CURVE_DTYPE = np.dtype(
    [
        ("iteration", np.int64),
        ("rho", np.float64),
        ("rho_star", np.float64),
        ("magnitude", np.float64),
    ]
)

# Rows on either side of the star for the flux profile near it: the paper's 40 pixels.
NEAR_STAR = 20
# Share of the brightest true row, spread over its width, that counts as jet in the width profile.
WIDTH_SHARE = 0.1


@dataclass
class Reconstruction:
    """A reconstruction at its best, and how it came there.

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
        At the smallest rho''; with the star in it for RLM.
    star_flux : float
        Electrons, at the smallest rho''; in a 3 x 3 box for RLM.
    history : ndarray
        Fields ``iteration`` and ``objective``, of every iteration done.
    device : str
        Name of the device.
    """

    method: str
    mu: float
    curve: NDArray[np.void]
    extended: Array
    star_flux: float
    history: NDArray[np.void] = field(default_factory=lambda: np.zeros(0, HISTORY_DTYPE))
    device: str = ""

    def best(self, field: str) -> tuple[int, float]:
        """Return the iteration and the value at which ``rho`` or ``rho_star`` is smallest."""
        row = self.curve[int(np.argmin(self.curve[field]))]
        return int(row["iteration"]), float(row[field])

    @property
    def name(self) -> str:
        """Method and mu, for tables and legends."""
        return self.method if self.method == "RLM" else f"MC-RL mu={self.mu:g}"


class Tracker:
    """A callback that follows restoration errors and the star's magnitude, and keeps the best.

    Parameters
    ----------
    simulation : Simulation
        With one star.
    method : {"RLM", "MC-RL"}
        Decides how errors and magnitude are measured (La Camera et al. 2012, section 3.2).
    every : int
        Iterations from one look to the next.
    patience : float, optional
        Stop when the iterations exceed this many times those of the smallest rho''.
    """

    def __init__(
        self, simulation: Simulation, method: str, every: int, patience: float | None = None
    ) -> None:
        self.star = simulation.stars[0]
        self._simulation = simulation
        self._has_star = method == "RLM"
        self._every, self._patience = every, patience
        self._rows = metrics.star_rows(self.star, simulation.extended.shape)
        self._truth = simulation.extended.copy()
        if self._has_star:
            self._truth[self.star[1], self.star[0]] += simulation.star_fluxes[0]
        self.curve: list[tuple[int, float, float, float]] = []
        self.extended = np.zeros(0)
        self.star_flux = 0.0
        self._best = (0, np.inf)

    def __call__(self, iteration: int, estimate: Estimate) -> bool:
        """Measure this iteration, if its turn has come; return whether to stop."""
        if iteration % self._every:
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
        if rho_star < self._best[1]:
            self._best = iteration, rho_star
            self.extended, self.star_flux = extended, flux
        return self._patience is not None and iteration > self._patience * self._best[0]


def observe(simulation: Simulation) -> Observation:
    """Return the observation that a simulation stands for, read noise included."""
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
    """Reconstruct a simulation by one method and follow its errors.

    Parameters
    ----------
    simulation : Simulation
        With one star.
    observation : Observation
        That of `observe`.
    method : {"RLM", "MC-RL"}
        Without or with the star as a component of its own.
    mu : float
        Weight of the Tikhonov term, for MC-RL.
    n_iter, every, patience
        Most iterations; iterations between two looks; see `Tracker`.
    **keywords
        For `lnocl.deconvolve`.
    """
    tracker = Tracker(simulation, method, every, patience)
    stars = [] if method == "RLM" else simulation.stars
    result = deconvolve(observation, stars, mu, n_iter=n_iter, callback=tracker, **keywords)
    return Reconstruction(
        method,
        mu,
        np.array(tracker.curve, CURVE_DTYPE),
        tracker.extended,
        tracker.star_flux,
        result.history,
        result.device,
    )


def width_threshold(truth: Array) -> float:
    """Return the count above which a pixel belongs to the jet in the width profile."""
    return WIDTH_SHARE * float(truth.max())


def profile_errors(simulation: Simulation, found: Reconstruction) -> dict[str, float]:
    """Return the mean absolute relative errors of flux and width profile near the star.

    Over the rows within 20 of the star in which the true jet has at least a hundredth of its
    brightest row (flux), or any pixel above the threshold (width); for RLM without the 3 rows
    around the star (La Camera et al. 2012, section 4).
    """
    truth, star = simulation.extended, simulation.stars[0]
    masked = star if found.method == "RLM" else None
    near = slice(max(star[1] - NEAR_STAR, 0), star[1] + NEAR_STAR)
    true_flux = metrics.flux_profile(truth)
    true_flux = np.where(true_flux < 0.01 * true_flux.max(), 0.0, true_flux)
    flux = metrics.relative_error(metrics.flux_profile(found.extended, masked), true_flux)
    threshold = width_threshold(truth)
    width = metrics.relative_error(
        metrics.width_profile(found.extended, threshold, masked),
        metrics.width_profile(truth, threshold),
    )
    return {
        "flux": float(np.nanmean(np.abs(flux[near]))),
        "width": float(np.nanmean(np.abs(width[near]))),
    }
