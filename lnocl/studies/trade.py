"""Cost against accuracy: settings are timed, and measured against double precision."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from astropy.table import Table
from numpy.typing import ArrayLike, NDArray

from lnocl import metrics
from lnocl.deconvolution import deconvolve
from lnocl.errors import InputError, LnoclWarning
from lnocl.result import Estimate, Result
from lnocl.runs.options import PAPER, Precision
from lnocl.runs.progress import Progress
from lnocl.scene.observation import Array, Observation, numbers
from lnocl.simulation import Simulation
from lnocl.studies import experiment

# Estimates are measured after an eighth, a quarter, half and all of the iterations.
PARTS = (8, 4, 2, 1)

# Columns of the table: unit, format on the terminal, and description.
COLUMNS = {
    "precision": (None, "s", "precision of the arithmetic"),
    "pad": ("pix", "d", "least unobserved pixels round the images"),
    "iterations": (None, "d", "iterations done"),
    "ms": ("ms", ".3g", "time of an iteration, mean over the run from its second one on"),
    "seconds": ("s", ".3g", "time of all iterations"),
    "to_goal": ("s", ".3g", "time to the reference's last objective times 1 + accuracy, or NaN"),
    "deviation": (None, ".1e", "deviation of the extended source from the reference, all rows"),
    "near_star": (None, ".1e", "the same, 24 rows around the first star"),
    "star_flux": (None, ".1e", "largest deviation of a star's flux"),
    "flux": (None, ".1e", "largest deviation of the flux profile"),
    "width": (None, ".1e", "largest deviation of the width profile"),
    "rho": (None, ".2%", "rho', error of the extended source, all rows"),
    "rho_star": (None, ".2%", "rho'', the same, 24 rows around the star"),
    "mag_error": ("mag", ".4f", "magnitude of the star less the true one"),
    "front": (None, "", "whether no other setting is faster and closer to the reference"),
}


def check(n_iter: int, accuracy: float) -> None:
    """Check the parameters of `compare` before any work is done.

    Parameters
    ----------
    n_iter : int
        Iterations of the longest run, 8 or more.
    accuracy : float
        Deviation that is close enough, positive.

    Raises
    ------
    InputError
        `n_iter` is less than 8, or `accuracy` is not positive and finite.
    """
    if not (isinstance(n_iter, (int, np.integer)) and n_iter >= PARTS[0]):
        raise InputError(f"n_iter must be a whole number, {PARTS[0]} or more; {n_iter} was given")
    if not (math.isfinite(accuracy) and accuracy > 0):
        raise InputError(f"accuracy must be positive and finite; {accuracy} was given")


def compare(
    observation: Observation,
    stars: Sequence[tuple[float, float]] = (),
    mu: float = 0.0,
    n_iter: int = 400,
    accuracy: float = 1e-3,
    simulation: Simulation | None = None,
    device: str | None = None,
    progress: bool = False,
) -> Iterator[Table]:
    r"""Time settings of `lnocl.deconvolve`, and measure each against double precision.

    The reference :math:`(f_0, c_0)` is the estimate in double precision, without padding, after
    `n_iter` iterations. For both precisions, without padding and with half the PSF's larger axis,
    the deviation from it

    .. math:: \delta = \| f - f_0 \| \, / \, \| f_0 \|

    is measured after an eighth, a quarter, half and all of the iterations.

    Parameters
    ----------
    observation : Observation
        The images, p of shape (ny, nx).
    stars : sequence of (x, y), optional
        As for `lnocl.deconvolve`. "Near the star" is near the first.
    mu : float, optional
        As for `lnocl.deconvolve`, per electron.
    n_iter : int, optional
        Iterations of the reference, 8 or more.
    accuracy : float, optional
        Relative excess over the reference's objective that `to_goal` times, positive.
    simulation : Simulation, optional
        The simulation that `observation` was made from, with one star, where there is one.
    device : str, optional
        As for `lnocl.deconvolve`.
    progress : bool, optional
        Whether a progress bar is shown on stderr, where that is a terminal.

    Yields
    ------
    Table
        After each run, a table of all runs so far: a row for each setting, with the columns of
        `COLUMNS`, of which ``rho``, ``rho_star`` and ``mag_error`` need the truth. Times are of
        the iterations alone. Deviations are shares of the reference. ``near_star`` and
        ``rho_star`` are NaN where there is no star, or where its 24 rows do not fit in the image.
        ``flux`` and ``width`` are over the rows of `lnocl.studies.experiment.profile_errors`;
        without a star, over those of the whole image. The meta of the table holds device,
        iterations and accuracy.

    Raises
    ------
    InputError
        `check` or `lnocl.deconvolve` refuses a value, or the reference is 0 everywhere.
    DeviceError
        As for `lnocl.deconvolve`: no double precision, or too little memory for the padding.

    Warns
    -----
    LnoclWarning
        As for `lnocl.deconvolve`, once.
    """
    check(n_iter, accuracy)
    half = max(observation.psfs.shape[1:]) // 2
    settings = [
        Setting(precision, pad)
        for pad in dict.fromkeys((0, half))
        for precision in ("double", "single")
    ]

    def reconstruct(setting: Setting, n_iter: int, callback: Any = None) -> Result:
        given = PAPER | {"mu": mu, "n_iter": n_iter, "pad": setting.pad}
        precision = setting.precision
        return deconvolve(
            observation, stars, **given, precision=precision, device=device, callback=callback
        )

    reconstruct(settings[0], 1)  # raises errors and gives warnings before the bar is shown
    checkpoints = sorted({n_iter // part for part in PARTS})
    rows: list[dict[str, Any]] = []
    reference = None
    with Progress(len(settings) * len(checkpoints), "row", progress) as bar:
        _compile(settings[1:], reconstruct)
        for setting in settings:
            timer = IterationTimer(checkpoints, bar.update)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", LnoclWarning)  # the first run has given it
                result = reconstruct(setting, n_iter, timer)
            reference = reference or ReferenceSolution.of(result, stars, accuracy, simulation)
            rows += _rows(setting, timer, result, reference)
            yield _tabulate(rows, device=result.device, n_iter=n_iter, accuracy=accuracy)


def pareto_front(seconds: ArrayLike, deviations: ArrayLike) -> NDArray[np.bool_]:
    """Return which settings are on the Pareto front of time and deviation.

    A setting is off the front if another is at least as fast and as close, and faster or closer.

    Parameters
    ----------
    seconds, deviations : array_like, shape (n,)
        The two costs of each setting.

    Returns
    -------
    ndarray of bool, shape (n,)
        True on the front; False where either is NaN.

    Raises
    ------
    InputError
        They are not real numbers, or some are masked.

    Examples
    --------
    >>> from lnocl.studies.trade import pareto_front
    >>> pareto_front([1.0, 2.0, 3.0], [0.1, 0.2, 0.0])
    array([ True, False,  True])
    """
    s, d = numbers("seconds", seconds), numbers("deviations", deviations)
    no_worse = (s[:, None] <= s) & (d[:, None] <= d)
    better = (s[:, None] < s) | (d[:, None] < d)
    return ~(no_worse & better).any(axis=0) & ~np.isnan(s) & ~np.isnan(d)


def deviation_column(table: Table) -> str:
    """Return the name of the deviation that counts: near the star, or of all rows without one."""
    return "deviation" if np.isnan(table["near_star"]).any() else "near_star"


def advice(table: Table, accuracy: float) -> str:
    """Return a sentence that names the fastest setting within an accuracy.

    Parameters
    ----------
    table : Table
        Table of `compare`.
    accuracy : float
        Largest deviation in the column of `deviation_column`.

    Returns
    -------
    str
        The setting with its time and deviation; or the sentence says that no setting is so close.
    """
    column = deviation_column(table)
    good = table[table[column] <= accuracy]
    if not len(good):
        return f"for an accuracy of {accuracy:g}: no setting is so close to the reference"
    best = good[int(np.argmin(good["seconds"]))]
    padding = f"{best['pad']} pixels of padding" if best["pad"] else "no padding"
    return (
        f"for an accuracy of {accuracy:g}: {best['precision']} precision, {padding}, "
        f"{best['iterations']} iterations: {best['seconds']:.2g} s, deviation {best[column]:.1e}"
    )


@dataclass(frozen=True)
class Setting:
    """The precision and padding of a run.

    Attributes
    ----------
    precision : {"single", "double"}
        Precision of the arithmetic.
    pad : int
        Least unobserved pixels round the images.
    """

    precision: Precision
    pad: int


class IterationTimer:
    """A callback that times iterations, and stores the estimates at some of them.

    The clock starts after the first iteration, and so holds neither compilation nor start-up. It
    stands while the callback reads an estimate.

    Parameters
    ----------
    checkpoints : collection of int
        Iterations whose estimate is stored.
    on_checkpoint : callable
        Called without arguments at each checkpoint, with the clock stopped.

    Attributes
    ----------
    estimates : dict of int to (ndarray, ndarray)
        Extended source, shape (ny, nx), and star fluxes, shape (n,), electrons, by iteration.
    """

    def __init__(self, checkpoints: Collection[int], on_checkpoint: Callable[[], Any]) -> None:
        self.estimates: dict[int, tuple[Array, Array]] = {}
        self._checkpoints, self._on_checkpoint = checkpoints, on_checkpoint
        self._spans: list[float] = []
        self._fetches: list[float] = []
        self._resumed = math.nan
        self._last = 0

    def __call__(self, iteration: int, estimate: Estimate) -> None:
        """Store the estimate if this iteration is a checkpoint."""
        if iteration != 1 and iteration not in self._checkpoints:
            return
        # Reading waits for the device, which runs behind the host. So this span holds the
        # iterations and one fetch; a second read does not wait, and times the fetch alone.
        extended = estimate.extended
        arrived = time.perf_counter()
        del estimate.extended
        extended = estimate.extended
        self._fetches.append(time.perf_counter() - arrived)
        if iteration > 1:
            self._spans.append(arrived - self._resumed)
        if iteration in self._checkpoints:
            self.estimates[iteration] = extended, estimate.star_fluxes
            self._on_checkpoint()
        self._last = iteration
        self._resumed = time.perf_counter()

    @property
    def seconds_each(self) -> float:
        """Mean time of the iterations after the first, in seconds."""
        # The shortest fetch is the best measure: other work on the machine only adds to it.
        fetching = len(self._spans) * min(self._fetches)
        return (sum(self._spans) - fetching) / (self._last - 1)


@dataclass(frozen=True)
class ReferenceSolution:
    """The solution in double precision, and the truth where it is known, to measure estimates by.

    Attributes
    ----------
    extended : ndarray of float64, shape (ny, nx)
        Extended source of the reference, electrons per pixel.
    star_fluxes : ndarray of float64, shape (n,)
        Star fluxes of the reference, electrons.
    goal : float
        Objective of the column ``to_goal``.
    star : (x, y) or None
        Pixel of the first star.
    rows : slice or None
        The 24 rows around it, where they fit in the image.
    simulation : Simulation or None
        The simulation, which holds the truth.
    """

    extended: Array
    star_fluxes: Array
    goal: float
    star: tuple[int, int] | None
    rows: slice | None
    simulation: Simulation | None = field(repr=False)

    @classmethod
    def of(
        cls,
        reference: Result,
        stars: Sequence[tuple[float, float]],
        accuracy: float,
        simulation: Simulation | None,
    ) -> ReferenceSolution:
        """Return the reference that a result makes."""
        extended = reference.extended
        if not extended.any():
            raise InputError("the images hold no light above their background to measure")
        star = (round(stars[0][0]), round(stars[0][1])) if len(stars) else None
        goal = float(reference.history["objective"][-1]) * (1 + accuracy)
        rows = star and _rows_around(star, extended.shape)
        return cls(extended, reference.star_fluxes, goal, star, rows, simulation)

    def iterations_to_goal(self, objectives: Array) -> float:
        """Return the number of iterations to the goal; NaN where it is not reached."""
        within = np.flatnonzero(objectives <= self.goal)
        return float(within[0]) if within.size else math.nan

    def measure(self, extended: Array, star_fluxes: Array) -> dict[str, float]:
        """Return the deviations of an estimate, and its errors from the truth, by column."""
        profiles = experiment.profile_deviations(extended, self.extended)
        near = slice(None) if self.star is None else experiment.near_star(self.star)
        columns = {
            "deviation": metrics.restoration_error(extended, self.extended),
            "near_star": self._near(extended, self.extended),
            "star_flux": _largest(metrics.relative_error(star_fluxes, self.star_fluxes)),
            **{kind: _largest(each[near]) for kind, each in profiles.items()},
        }
        if self.simulation is not None:
            columns |= self._errors(self.simulation, extended, star_fluxes)
        return columns

    def _errors(self, truth: Simulation, extended: Array, star_fluxes: Array) -> dict[str, float]:
        found, true = (
            metrics.magnitude(float(fluxes[0]), truth.zero_magnitude_flux)
            for fluxes in (star_fluxes, truth.star_fluxes)
        )
        return {
            "rho": metrics.restoration_error(extended, truth.extended),
            "rho_star": self._near(extended, truth.extended),
            "mag_error": found - true,
        }

    def _near(self, extended: Array, true: Array) -> float:
        if self.rows is None or not true[self.rows].any():
            return math.nan
        return metrics.restoration_error(extended, true, self.rows)


def _compile(settings: Sequence[Setting], reconstruct: Callable[[Setting, int], Result]) -> None:
    """Do one iteration of each setting, which compiles its kernels and raises its errors early."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LnoclWarning)  # the first run has given it
        for setting in settings:
            reconstruct(setting, 1)


def _rows(
    setting: Setting, timer: IterationTimer, result: Result, reference: ReferenceSolution
) -> Iterator[dict[str, Any]]:
    each = timer.seconds_each
    for iterations, (extended, star_fluxes) in timer.estimates.items():
        yield {
            "precision": setting.precision,
            "pad": setting.pad,
            "iterations": iterations,
            "ms": 1e3 * each,
            "seconds": each * iterations,
            "to_goal": each * reference.iterations_to_goal(result.history["objective"]),
            **reference.measure(extended, star_fluxes),
        }


def _tabulate(rows: Sequence[dict[str, Any]], **meta: Any) -> Table:
    table = Table(rows=list(rows), names=list(rows[0]), meta=meta)
    # Only the digits that are shown count: rounding alone makes no setting closer than another.
    shown = [float(f"{deviation:.1e}") for deviation in table[deviation_column(table)]]
    table["front"] = pareto_front(table["seconds"], shown)
    for name in table.colnames:
        unit, form, description = COLUMNS[name]
        column = table[name]
        column.unit, column.format, column.description = unit, form or None, description
    return table


def _rows_around(star: tuple[int, int], shape: tuple[int, ...]) -> slice | None:
    try:
        return metrics.star_rows(star, (shape[0], shape[1]))
    except InputError:
        return None  # the star is too close to the edge for its rows


def _largest(errors: Array) -> float:
    sizes = np.abs(errors[~np.isnan(errors)])
    return float(sizes.max()) if sizes.size else math.nan
