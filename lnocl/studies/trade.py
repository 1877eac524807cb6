"""What accuracy costs: settings timed, and measured against the answer in double precision."""

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
from lnocl.runs.progress import make_bar
from lnocl.scene.observation import Array, Observation, numbers
from lnocl.simulation.simulate import Simulation
from lnocl.studies import experiment

# Estimates are kept after these shares of the iterations: an eighth, a quarter, half, all.
PARTS = (8, 4, 2, 1)

# Columns of the table: unit, format on the terminal, and description.
COLUMNS = {
    "precision": (None, "s", "of the arithmetic"),
    "pad": ("pix", "d", "least unobserved pixels round the images"),
    "iterations": (None, "d", "done"),
    "ms": ("ms", ".3g", "an iteration, mean of the run from its second one on"),
    "seconds": ("s", ".3g", "of the iterations"),
    "to_goal": ("s", ".3g", "to the reference's last objective times 1 + accuracy; NaN: never"),
    "deviation": (None, ".1e", "of the extended source from the reference, all rows"),
    "near_star": (None, ".1e", "the same, 24 rows around the first star"),
    "star_flux": (None, ".1e", "largest deviation of a star's flux"),
    "flux": (None, ".1e", "largest deviation of the flux profile"),
    "width": (None, ".1e", "largest deviation of the width profile"),
    "rho": (None, ".2%", "rho', error of the extended source, all rows"),
    "rho_star": (None, ".2%", "rho'', the same, 24 rows around the star"),
    "mag_error": ("mag", ".4f", "magnitude of the star less the true one"),
    "front": (None, "", "nothing is both faster and closer to the reference"),
}


def check(n_iter: int, accuracy: float) -> None:
    """Check the parameters of `compare`, before any work is done.

    Parameters
    ----------
    n_iter : int
        Most iterations.
    accuracy : float
        Deviation that is good enough.

    Raises
    ------
    InputError
        Where `n_iter` is less than 8, or `accuracy` is not positive and finite.
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
    r"""Time and measure the settings of `lnocl.deconvolve`, against double precision.

    The reference :math:`(f_0, c_0)` is the estimate in double precision, without padding, after
    `n_iter` iterations. For both precisions, without padding and with half the PSF's larger axis,
    the deviation from it

    .. math:: \delta = \| f - f_0 \| \, / \, \| f_0 \|

    is measured after an eighth, a quarter, half and all of the iterations.

    Parameters
    ----------
    observation : Observation
        The images, p of shape (ny, nx), and what is known of them.
    stars : sequence of (x, y), optional
        As for `lnocl.deconvolve`. The first one is that of the rows around the star.
    mu : float, optional
        As for `lnocl.deconvolve`, per electron.
    n_iter : int, optional
        Iterations of the reference, 8 or more.
    accuracy : float, optional
        Relative excess over the reference's objective that `to_goal` times, positive.
    simulation : Simulation, optional
        What `observation` was made from, with one star, where the truth is known.
    device : str, optional
        As for `lnocl.deconvolve`.
    progress : bool, optional
        Show a progress bar on stderr, where that is a terminal.

    Yields
    ------
    Table
        After each run, of all runs so far: a row for each setting, with the columns of `COLUMNS`
        (``rho``, ``rho_star`` and ``mag_error`` where the truth is known). Times in seconds and
        milliseconds, of the iterations alone; deviations relative, 1 is all of the reference.
        NaN in ``near_star`` and ``rho_star`` where there is no star, or where its 24 rows do not
        fit in the image. ``flux`` and ``width`` are over the rows that count in
        `lnocl.studies.experiment.profile_errors`; without a star, over those of the whole image.
        The meta of the table holds device, iterations and accuracy.

    Raises
    ------
    InputError
        `check` or `lnocl.deconvolve` refuses a value, or the images hold no light.
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
        return deconvolve(
            observation, stars, mu=mu, n_iter=n_iter, precision=setting.precision,
            device=device, pad=setting.pad, callback=callback,
        )  # fmt: skip

    reconstruct(settings[0], 1)  # what it refuses is refused before the bar shows
    checkpoints = sorted({n_iter // part for part in PARTS})
    rows: list[dict[str, Any]] = []
    yardstick = None
    with make_bar(len(settings) * len(checkpoints), "row", progress) as bar:
        _compile(settings[1:], reconstruct)
        for setting in settings:
            watch = Watch(checkpoints, bar.update)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", LnoclWarning)  # the first run has said it
                result = reconstruct(setting, n_iter, watch)
            yardstick = yardstick or ReferenceSolution.of(result, stars, accuracy, simulation)
            rows += _rows(setting, watch, result, yardstick)
            yield _tabulate(rows, device=result.device, n_iter=n_iter, accuracy=accuracy)


def front(seconds: ArrayLike, deviations: ArrayLike) -> NDArray[np.bool_]:
    """Return which settings nothing beats on both sides, their Pareto front.

    A setting is beaten by one that is as fast and as close at least, and faster or closer.

    Parameters
    ----------
    seconds, deviations : array_like, shape (n,)
        Small is good.

    Returns
    -------
    ndarray of bool, shape (n,)
        True on the front; False where either is NaN.

    Raises
    ------
    InputError
        Where they are no real numbers, or some are masked.

    Examples
    --------
    >>> from lnocl.trade import front
    >>> front([1.0, 2.0, 3.0], [0.1, 0.2, 0.0])
    array([ True, False,  True])
    """
    s, d = numbers("seconds", seconds), numbers("deviations", deviations)
    no_worse = (s[:, None] <= s) & (d[:, None] <= d)
    better = (s[:, None] < s) | (d[:, None] < d)
    return ~(no_worse & better).any(axis=0) & ~np.isnan(s) & ~np.isnan(d)


def judged(table: Table) -> str:
    """Return the column that `front` and `advice` go by: near the star, where it is known."""
    return "deviation" if np.isnan(table["near_star"]).any() else "near_star"


def advice(table: Table, accuracy: float) -> str:
    """Return a sentence: the fastest setting whose deviation is within the accuracy.

    Parameters
    ----------
    table : Table
        Of `compare`.
    accuracy : float
        Deviation that is good enough, around the first star, or of all rows without one.

    Returns
    -------
    str
        The setting with its time and deviation, or that there is none.
    """
    column = judged(table)
    good = table[table[column] <= accuracy]
    if not len(good):
        return f"for an accuracy of {accuracy:g}: no setting comes so close to the reference"
    best = good[int(np.argmin(good["seconds"]))]
    padding = f"{best['pad']} pixels of padding" if best["pad"] else "no padding"
    return (
        f"for an accuracy of {accuracy:g}: {best['precision']} precision, {padding}, "
        f"{best['iterations']} iterations: {best['seconds']:.2g} s, deviation {best[column]:.1e}"
    )


@dataclass(frozen=True)
class Setting:
    """What is varied between runs.

    Attributes
    ----------
    precision : {"single", "double"}
        Of the arithmetic.
    pad : int
        Least unobserved pixels round the images.
    """

    precision: str
    pad: int


class Watch:
    """A callback that keeps estimates and times the iterations between them.

    The clock starts when the first iteration is done, so it holds no compilation, no upload and
    no start-up; it stands while the callback works on an estimate.

    Parameters
    ----------
    checkpoints : collection of int
        Iterations whose estimate is kept.
    tell : callable
        Called, without arguments, at each checkpoint, with the clock stopped.

    Attributes
    ----------
    kept : dict of int to (ndarray, ndarray)
        Extended source, shape (ny, nx), and star fluxes, shape (n,), electrons, by iteration.
    """

    def __init__(self, checkpoints: Collection[int], tell: Callable[[], Any]) -> None:
        self.kept: dict[int, tuple[Array, Array]] = {}
        self._checkpoints, self._tell = checkpoints, tell
        self._spans: list[float] = []
        self._fetches: list[float] = []
        self._resumed = math.nan
        self._last = 0

    def __call__(self, iteration: int, estimate: Estimate) -> None:
        """Keep the estimate, where this iteration is a checkpoint."""
        if iteration != 1 and iteration not in self._checkpoints:
            return
        # The device runs behind the host: reading waits for it, so that this span holds the
        # iterations and one fetch; a second read, which need not wait, tells what a fetch takes.
        extended = estimate.extended
        arrived = time.perf_counter()
        del estimate.extended
        extended = estimate.extended
        self._fetches.append(time.perf_counter() - arrived)
        if iteration > 1:
            self._spans.append(arrived - self._resumed)
        if iteration in self._checkpoints:
            self.kept[iteration] = extended, estimate.star_fluxes
            self._tell()
        self._last = iteration
        self._resumed = time.perf_counter()

    @property
    def seconds_each(self) -> float:
        """Mean time of an iteration, seconds, of those after the first."""
        # The shortest fetch: a machine that does something else only makes them longer.
        fetching = len(self._spans) * min(self._fetches)
        return (sum(self._spans) - fetching) / (self._last - 1)


@dataclass(frozen=True)
class ReferenceSolution:
    """What estimates are measured by: the reference and, where it is known, the truth.

    Attributes
    ----------
    extended : ndarray of float64, shape (ny, nx)
        The reference's, electrons per pixel.
    star_fluxes : ndarray of float64, shape (n,)
        The reference's, electrons.
    goal : float
        Objective to be reached.
    star : (x, y) or None
        The first star.
    rows : slice or None
        The rows around it, where they fit.
    simulation : Simulation or None
        The truth.
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
        """Return the yardstick that a reference makes."""
        extended = reference.extended
        if not extended.any():
            raise InputError("the images hold no light above their background to measure")
        star = (round(stars[0][0]), round(stars[0][1])) if len(stars) else None
        goal = float(reference.history["objective"][-1]) * (1 + accuracy)
        rows = star and _rows_around(star, extended.shape)
        return cls(extended, reference.star_fluxes, goal, star, rows, simulation)

    def reached(self, objectives: Array) -> float:
        """Return the iterations to the goal; NaN where it is not reached."""
        within = np.flatnonzero(objectives <= self.goal)
        return float(within[0]) if within.size else math.nan

    def measure(self, extended: Array, star_fluxes: Array) -> dict[str, float]:
        """Return the columns of an estimate, deviations first, errors where there is a truth."""
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
    """Do one iteration of each: kernels are compiled, and what cannot run is refused at once."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LnoclWarning)  # the first run has said it
        for setting in settings:
            reconstruct(setting, 1)


def _rows(
    setting: Setting, watch: Watch, result: Result, yardstick: ReferenceSolution
) -> Iterator[dict[str, Any]]:
    each = watch.seconds_each
    for iterations, (extended, star_fluxes) in watch.kept.items():
        yield {
            "precision": setting.precision,
            "pad": setting.pad,
            "iterations": iterations,
            "ms": 1e3 * each,
            "seconds": each * iterations,
            "to_goal": each * yardstick.reached(result.history["objective"]),
            **yardstick.measure(extended, star_fluxes),
        }


def _tabulate(rows: Sequence[dict[str, Any]], **meta: Any) -> Table:
    table = Table(rows=list(rows), names=list(rows[0]), meta=meta)
    # To the digits shown: rounding alone does not make a setting closer than another.
    shown = [float(f"{deviation:.1e}") for deviation in table[judged(table)]]
    table["front"] = front(table["seconds"], shown)
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
