"""The paper's experiment: a simulation is reconstructed, and measured against its truth.

The measures are those of La Camera et al. (2012), sections 3.2 and 4. The axis of the jet lies
along y, so a pixel line across it is a row.
"""

from dataclasses import dataclass

import numpy as np

import lnocl
from lnocl import metrics
from lnocl.core.runs.options import PAPER
from lnocl.errors import InputError

CURVE_DTYPE = np.dtype(
    [("iteration", int), ("rho", float), ("rho_star", float), ("magnitude", float)]
)

# Half the rows of a profile near the star: the paper's 40, 20 before the star and 20 from it on.
NEAR_STAR = 20
# Share of the brightest row that a row needs to count in the flux profile near the star: behind
# the star the jet is so faint that relative errors there say nothing of it.
JET_SHARE = 0.05
# Share of the brightest true pixel above which a pixel counts as jet in the width profile.
WIDTH_SHARE = 0.1


def observe(simulation):
    """Return the images of a simulation as an observation, with background and read noise."""
    return lnocl.Observation(
        simulation.images,
        simulation.psfs,
        background=simulation.background,
        read_noise=simulation.read_noise,
    )


def box_flux(image, star):
    """Return the flux in the 3 x 3 pixels around the star, the paper's measure of it in RLM."""
    x, y = star
    return float(image[y - 1 : y + 2, x - 1 : x + 2].sum())


def width_profile(image, threshold, star=None):
    """Return the pixels of each row from the first to the last above the threshold, both counted.

    It is 0 where all are below, and NaN in the 3 rows around a star that is part of the image.
    """
    above = np.asarray(image) > threshold
    first = above.argmax(axis=1)
    last = above.shape[1] - 1 - above[:, ::-1].argmax(axis=1)
    widths = np.where(above.any(axis=1), last - first + 1.0, 0.0)
    if star is not None:
        widths[star[1] - 1 : star[1] + 2] = np.nan
    return widths


def relative_error(profile, reference):
    """Return ``(profile - reference) / reference``; NaN where the reference is 0."""
    found, true = np.asarray(profile, float), np.asarray(reference, float)
    error = np.full(found.shape, np.nan)
    return np.divide(found - true, true, out=error, where=true != 0)


def width_threshold(truth):
    """Return the count above which a pixel belongs to the jet in the width profile."""
    return WIDTH_SHARE * truth.max()


def near_star(star):
    """Return the 40 rows around the star, 20 before it and 19 after it, cut at the edges."""
    return slice(max(star[1] - NEAR_STAR, 0), star[1] + NEAR_STAR)


def profile_errors(truth, star, found):
    """Return the mean absolute relative errors of the flux and width profiles near the star.

    For RLM the 3 rows around the star are left out. ``flux`` is of the rows with a twentieth of the
    light of the brightest or more, ``width`` of those with a true pixel above `width_threshold`;
    both are NaN where there is none.
    """
    masked = star if found.method == "RLM" else None
    flux, threshold = metrics.flux_profile(truth), width_threshold(truth)
    flux[flux < JET_SHARE * flux.max()] = 0.0
    errors = {
        "flux": relative_error(metrics.flux_profile(found.extended, masked), flux),
        "width": relative_error(
            width_profile(found.extended, threshold, masked), width_profile(truth, threshold)
        ),
    }
    sizes = {kind: abs(error[near_star(star)]) for kind, error in errors.items()}
    return {
        kind: float(np.nanmean(size)) if np.isfinite(size).any() else np.nan
        for kind, size in sizes.items()
    }


@dataclass
class Reconstruction:
    """The estimate of the smallest error near the star, and the errors of all iterations.

    Method is "RLM", with the star in the image, or "MC-RL". The curve has the fields of
    `CURVE_DTYPE`: rho' of all rows, rho'' of the 24 rows around the star, and its magnitude.
    """

    method: str
    mu: float
    curve: np.ndarray
    extended: np.ndarray
    star_flux: float
    history: np.ndarray | None = None
    device: str = ""

    def best(self, field):
        """Return the iteration and the value at which ``rho`` or ``rho_star`` is smallest."""
        row = self.curve[int(np.argmin(self.curve[field]))]
        return int(row["iteration"]), float(row[field])


class Tracker:
    """A callback that measures the errors of estimates, and stores that of the smallest rho''.

    It looks every so many iterations and at the last. With `patience` it ends the run after so many
    times the iterations of the smallest rho' and rho''.
    """

    def __init__(self, simulation, method, every, n_iter, patience=None):
        if every < 1:
            raise InputError(f"every must be a whole number, 1 or more; {every} was given")
        if len(simulation.stars) != 1:
            raise InputError(
                f"the simulation has {len(simulation.stars)} stars; errors near the star need "
                "exactly one"
            )
        (self.star,) = simulation.stars
        self._masked = self.star if method == "RLM" else None
        self._every, self._n_iter, self._patience = every, n_iter, patience
        self._truth = simulation.extended
        self._rows = metrics.star_rows(self.star, self._truth.shape)
        self._zero = zero_magnitude_flux(simulation)
        self.curve = []
        self.extended, self.star_flux = np.zeros(0), 0.0
        self._smallest = {"rho": (0, np.inf), "rho_star": (0, np.inf)}

    def __call__(self, iteration, estimate):
        """Measure the estimate if this iteration is due, and return whether to stop."""
        if iteration % self._every and iteration != self._n_iter:
            return False
        extended = estimate.extended
        rho = metrics.restoration_error(extended, self._truth, star=self._masked)
        rho_star = metrics.restoration_error(extended, self._truth, self._rows, self._masked)
        if self._masked is None:
            flux = float(estimate.star_fluxes[0])
        else:
            flux = box_flux(extended, self.star)
        self.curve.append((iteration, rho, rho_star, metrics.magnitude(flux, self._zero)))
        if rho < self._smallest["rho"][1]:
            self._smallest["rho"] = iteration, rho
        if rho_star < self._smallest["rho_star"][1]:
            self._smallest["rho_star"] = iteration, rho_star
            self.extended, self.star_flux = extended, flux
        last = max(at for at, _ in self._smallest.values())
        return self._patience is not None and iteration > self._patience * last


def zero_magnitude_flux(simulation):
    """Return the electrons of a star of magnitude 0."""
    return simulation.experiment.source_electrons("0 mag")


def reconstruct(simulation, method, mu, n_iter, every=10, patience=None, **keywords):
    """Reconstruct a simulation by the paper's iteration, and measure its errors on the way."""
    tracker = Tracker(simulation, method, every, n_iter, patience)
    stars = [] if method == "RLM" else simulation.stars
    settings = {**PAPER, "mu": mu, "n_iter": n_iter, "callback": tracker, **keywords}
    result = lnocl.deconvolve(observe(simulation), stars, **settings)
    curve = np.array(tracker.curve, CURVE_DTYPE)
    found = tracker.extended, tracker.star_flux
    return Reconstruction(method, mu, curve, *found, result.history, result.device)
