"""The result of `deconvolve`, and the estimate that a callback is given."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lnocl.residuals import Fit, StarResiduals, judge, residuals
from lnocl.runs.choice import Choice
from lnocl.runs.run import Run
from lnocl.scene.observation import Array, Observation

HISTORY_DTYPE = np.dtype([("iteration", np.int64), ("objective", np.float64)])


class Estimate:
    """The estimate of an iteration, as a callback gets it: fetched from the device when read.

    Attributes
    ----------
    extended : ndarray of float64, shape (ny, nx)
        Extended source, electrons per pixel.
    star_fluxes : ndarray of float64, shape (n,)
        Electrons.
    star_positions : ndarray of float64, shape (n, 2)
        (x, y) in pixels, as last refined.
    """

    def __init__(self, run: Run) -> None:
        self._run: Run | None = run

    @cached_property
    def extended(self) -> Array:
        """Extended source, electrons per pixel."""
        return self._live().extended()

    @cached_property
    def star_fluxes(self) -> Array:
        """Star fluxes, electrons."""
        return self._live().star_fluxes()

    @cached_property
    def star_positions(self) -> Array:
        """Star positions, pixels."""
        return self._live().star_positions().copy()

    def _live(self) -> Run:
        if self._run is None:
            raise RuntimeError("read what you need of the estimate before the callback returns")
        return self._run

    def _close(self) -> None:
        self._run = None


Callback = Callable[[int, Estimate], Any]


@dataclass(frozen=True, eq=False)
class Result:
    """The result of `deconvolve`. Its arrays are read-only; results are compared by identity.

    Attributes
    ----------
    extended : ndarray of float64, shape (ny, nx)
        Extended source, electrons per pixel.
    star_fluxes : ndarray of float64, shape (n,)
        Electrons, in the order of the stars given.
    star_positions : ndarray of float64, shape (n, 2)
        (x, y) in pixels, as given or refined.
    star_flux_errors : ndarray of float64, shape (n,)
        Standard errors of the fluxes, electrons. They are those of the Fisher information of fluxes
        and positions, with the extended source taken as known. NaN where positions were not refined
        or the images do not determine them, such as those of stars that have moved to one place.
    star_position_errors : ndarray of float64, shape (n, 2)
        Standard errors of the positions, pixels, likewise.
    n_iter : int
        The iteration of the estimate.
    stop_reason : str
        Why the run ended. ``"n_iter"``: all iterations were done. ``"callback"``: the callback
        returned True. ``"change"``, ``"discrepancy"``, ``"held-out"``: the stopping rule was met.
        ``"converged"``: no step of ``"sgp"`` lowers the objective any more, in the precision used.
        ``"diverged"``: the objective rose, as with PSFs that have many negative pixels.
        ``"not finite"``: the objective became infinite or NaN. In the last two cases the estimate
        is that of the least objective, and the history ends there.
    device : str
        Name of the device, its platform and driver; ``"numpy"`` for the reference.
    history : ndarray, fields ``iteration`` (int64) and ``objective`` (float64)
        The objective J after each iteration, from iteration 0, the start.
    mu : float
        Weight of the Tikhonov term, as given or as chosen.
    smoothing : float
        Weight of the edge-preserving term, as given or as chosen.
    held_out : ndarray, fields ``mu``, ``smoothing``, ``iteration`` (int64) and ``error``
        The relative error of the extended source that held-out counts estimate, for each penalty
        and iteration that they compared. Empty where nothing was to be chosen.
    """

    extended: Array
    star_fluxes: Array
    star_positions: Array
    star_flux_errors: Array
    star_position_errors: Array
    n_iter: int
    stop_reason: str
    device: str
    history: NDArray[np.void]
    mu: float
    smoothing: float
    held_out: NDArray[np.void]
    _models: Callable[[], Iterator[Array]] = field(repr=False, compare=False)
    _observation: Observation = field(repr=False, compare=False)

    def __post_init__(self) -> None:
        for values in vars(self).values():
            if isinstance(values, np.ndarray):
                values.flags.writeable = False

    def models(self) -> Array:
        """Return the m_j, shape (p, ny, nx), electrons per pixel.

        ``m_j = e_j (A_j f + sum_s c_s P_js) + b_j``, in double precision. As in the observation,
        the square of the read noise is included.
        """
        return np.array(list(self._models()))

    def residuals(self) -> Array:
        """Return ``(g_j - m_j) / sqrt(m_j)``, shape (p, ny, nx): about 1 where only noise is left.

        NaN where a pixel is bad, or the model is 0.
        """
        images = zip(self._observation.images, self._observation.mask, self._models(), strict=True)
        return np.array([residuals(*each) for each in images])

    def fits(self) -> tuple[Fit, list[StarResiduals]]:
        """Return how well the model fits all good pixels, and at each star.

        It takes a convolution of each image in double precision on the host.
        """
        return judge(self._observation, self._models(), self.star_positions)


def make_result(run: Run, stop_reason: str, choice: Choice) -> Result:
    """Return the result of a run that has ended."""
    run.finish()
    history = np.zeros(run.done + 1, HISTORY_DTYPE)
    history["iteration"] = np.arange(run.done + 1)
    history["objective"] = run.objectives()
    flux_errors, position_errors = run.star_errors()
    ny, nx = run.scene.observation.shape
    sky = run.sky()
    return Result(
        extended=sky[:ny, :nx],
        star_fluxes=run.star_fluxes(),
        star_positions=run.star_positions(),
        star_flux_errors=flux_errors,
        star_position_errors=position_errors,
        n_iter=run.done,
        stop_reason=stop_reason,
        device=run.engine.name,
        history=history,
        mu=choice.penalty.mu,
        smoothing=choice.penalty.smoothing,
        held_out=choice.curve,
        _models=run.models(sky),
        _observation=run.scene.observation,
    )
