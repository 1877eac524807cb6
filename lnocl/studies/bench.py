"""The work of ``lnocl bench``: settings are timed, and measured against double precision."""

from __future__ import annotations

import math
import time
from collections.abc import Collection, Iterator, Sequence
from typing import Any, NamedTuple

from lnocl import metrics
from lnocl.core.opencl.device import choose, describe
from lnocl.core.runs.options import PAPER
from lnocl.core.scene.arrays import Array, whole
from lnocl.core.scene.observation import Observation
from lnocl.deconvolution import deconvolve
from lnocl.errors import InputError, LnoclWarning, MisfitWarning
from lnocl.process import ignored_warnings
from lnocl.result import Estimate, Result
from lnocl.simulation import hh34, simulate

# Estimates are measured after an eighth, a quarter, half and all of the iterations.
PARTS = (8, 4, 2, 1)

# Columns of the table: width and format, and description.
COLUMNS = {
    "precision": ("<9", "precision of the arithmetic"),
    "pad": (">4", "least unobserved pixels round the images"),
    "iterations": (">10", "iterations done"),
    "ms": (">8.3g", "time of an iteration, mean over the run from its second one on"),
    "seconds": (">8.3g", "time of all iterations"),
    "deviation": (">9.1e", "deviation of the extended source from that in double precision"),
    "error": (">8.2%", "error of the extended source against the truth of the scene"),
}


class Case(NamedTuple):
    """What settings are compared on.

    Attributes
    ----------
    observation : Observation
        The images and their PSFs.
    stars : sequence of (x, y)
        Positions in pixels, 0-based. The 24 rows around the first count, where they fit in the
        image, else all rows.
    truth : ndarray of float64, shape (ny, nx), optional
        The true extended source, electrons per pixel.
    """

    observation: Observation
    stars: Sequence[tuple[float, float]]
    truth: Array | None = None

    @property
    def rows(self) -> slice:
        """The rows that count."""
        try:
            x, y = self.stars[0]
            return metrics.star_rows((round(x), round(y)), self.observation.shape)
        except (IndexError, InputError):
            return slice(None)


def simulated_case(size: int) -> Case:
    """Return the demo's scene, with so many pixels along each side."""
    made = simulate(hh34(size))
    background, read_noise = made.background, made.read_noise
    observation = Observation(made.images, made.psfs, background=background, read_noise=read_noise)
    return Case(observation, made.stars, made.extended)


def check(n_iter: int, accuracy: float) -> None:
    """Check the parameters of `run` before any work is done.

    Raises
    ------
    InputError
        `n_iter` is less than 8, or `accuracy` is not positive and finite.
    """
    whole("n_iter", n_iter, PARTS[0])
    if not (math.isfinite(accuracy) and accuracy > 0):
        raise InputError(f"`accuracy` must be positive and finite; {accuracy} was given")


def run(
    case: Case,
    n_iter: int = 400,
    accuracy: float = 1e-3,
    device: str | None = None,
    progress: bool = False,
) -> Iterator[str]:
    """Compare settings, and say which to take.

    Parameters
    ----------
    case, n_iter, device, progress
        As for `compare`.
    accuracy : float
        Deviation that the advice may have, positive.

    Yields
    ------
    str
        Lines for the terminal, each as soon as it is known.

    Raises
    ------
    InputError, DeviceError
        As for `compare`.
    """
    name = describe(choose(device).device)
    measure = "all rows" if case.rows == slice(None) else "24 rows around the star"
    yield f"{measure}, against {n_iter} iterations in double precision without padding, on {name}"
    table: list[dict[str, Any]] = []
    for row in compare(case, n_iter, device, progress):
        if not table:
            yield " ".join(format(key, COLUMNS[key][0].split(".")[0]) for key in row)
        table.append(row)
        yield " ".join(format(value, COLUMNS[key][0]) for key, value in row.items())
    yield from (f"{key}: {COLUMNS[key][1]}" for key in list(table[0])[3:])
    yield advice(table, accuracy)


def compare(
    case: Case, n_iter: int, device: str | None = None, progress: bool = False
) -> Iterator[dict[str, Any]]:
    """Time settings of `lnocl.deconvolve`, and measure each against double precision.

    The reference is the estimate in double precision, without padding, after `n_iter` iterations.
    Both precisions are compared with it, without padding and with half the PSF's larger axis.

    Parameters
    ----------
    case : Case
        What they are compared on.
    n_iter : int
        Iterations of the paper's method, 8 or more.
    device : str, optional
        As for `lnocl.deconvolve`.
    progress : bool, optional
        Whether progress bars are shown on stderr, where that is a terminal.

    Yields
    ------
    dict
        The `COLUMNS` of a setting; ``error`` where the truth is known.

    Raises
    ------
    InputError
        `lnocl.deconvolve` refuses a value, or the reference is 0 everywhere.
    DeviceError
        The device has no double precision, or too little memory for the padding.

    Warns
    -----
    LnoclWarning
        As for `lnocl.deconvolve`, once.
    """
    half = max(case.observation.psfs.shape[1:]) // 2
    settings = [
        {"precision": precision, "pad": pad}
        for pad in dict.fromkeys((0, half))
        for precision in ("double", "single")
    ]

    def reconstruct(setting: dict[str, Any], n_iter: int, **more: Any) -> Result:
        given = PAPER | setting | {"n_iter": n_iter, "device": device} | more
        return deconvolve(case.observation, case.stars, **given)

    with ignored_warnings(MisfitWarning):  # as after an iteration is no wonder
        reconstruct(settings[0], 1)  # whose other warnings are shown
    with ignored_warnings(LnoclWarning):
        for setting in settings:  # compiled, and with their errors raised, before the work
            reconstruct(setting, 1)
    reference = None
    for setting in settings:
        timer = IterationTimer({n_iter // part for part in PARTS})
        with ignored_warnings(LnoclWarning):
            result = reconstruct(setting, n_iter, callback=timer, progress=progress)
        reference = result.extended if reference is None else reference
        if not reference[case.rows].any():
            raise InputError("the images hold no light above their background to measure")
        each = timer.seconds / (n_iter - 1)
        for iterations, extended in timer.estimates.items():
            row = {**setting, "iterations": iterations, "ms": 1e3 * each}
            row |= {"seconds": each * iterations}
            row["deviation"] = metrics.restoration_error(extended, reference, case.rows)
            if case.truth is not None:
                row["error"] = metrics.restoration_error(extended, case.truth, case.rows)
            yield row


class IterationTimer:
    """A callback that times iterations, and stores the estimates at some of them.

    The clock starts after the first iteration, and so holds neither compilation nor start-up. It
    holds the few copies of an estimate from the device, and stands while it is stored.

    Parameters
    ----------
    iterations : collection of int
        Iterations whose estimate is stored.

    Attributes
    ----------
    estimates : dict of int to ndarray
        Extended source, shape (ny, nx), electrons, by iteration.
    seconds : float
        Time of the iterations after the first.
    """

    def __init__(self, iterations: Collection[int]) -> None:
        self.estimates: dict[int, Array] = {}
        self.seconds = 0.0
        self._iterations, self._resumed = iterations, math.nan

    def __call__(self, iteration: int, estimate: Estimate) -> None:
        """Store the estimate if this iteration is one of them."""
        if iteration == 1 or iteration in self._iterations:
            extended = estimate.extended  # which waits for the device
            if iteration > 1:
                self.seconds += time.perf_counter() - self._resumed
            if iteration in self._iterations:
                self.estimates[iteration] = extended
            self._resumed = time.perf_counter()


def advice(table: Sequence[dict[str, Any]], accuracy: float) -> str:
    """Return a sentence that names the fastest setting within an accuracy, if there is one."""
    good = [row for row in table if row["deviation"] <= accuracy]
    if not good:
        return f"for an accuracy of {accuracy:g}: no setting is so close to the reference"
    best = min(good, key=lambda row: row["seconds"])
    padding = f"{best['pad']} pixels of padding" if best["pad"] else "no padding"
    return (
        f"for an accuracy of {accuracy:g}: {best['precision']} precision, {padding}, "
        f"{best['iterations']} iterations: {best['seconds']:.2g} s, "
        f"deviation {best['deviation']:.1e}"
    )
