"""A device on trial: every kernel against its twin, short deconvolutions against NumPy's."""

from __future__ import annotations

import functools
import math
import textwrap
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyopencl as cl
from astropy import units as u

from lnocl.deconvolution import deconvolve
from lnocl.errors import DeviceError, LnoclError, MisfitWarning
from lnocl.opencl.device import context_of, describe, has_double, spec_of
from lnocl.process import ignored_warnings
from lnocl.result import Result
from lnocl.runs.options import PAPER
from lnocl.scene.observation import Observation
from lnocl.simulation import Experiment, Star, load_target, simulate
from lnocl.verify.comparison import ALLOWED, KERNELS, deviation, kernels_of, relative
from lnocl.verify.harness import SCENES, THREE_IMAGES, TURNED, TWICE_AS_FINE, KernelHarness, inputs

DTYPES: dict[str, type[np.floating[Any]]] = {"single": np.float32, "double": np.float64}

# Grids and scenes for single kernels: the smallest grid, and transforms of two, three and four
# passes, cut to the device as those of any image are; the scenes have every option of the kernels.
# In double precision x and y change places, so that either axis has every number of passes.
CASES = (
    ((2, 2), "plain"),
    ((64, 64), THREE_IMAGES),
    ((256, 1024), "exposure map, mu"),
    ((128, 64), TWICE_AS_FINE),
    ((128, 64), TURNED),
)

# What is deconvolved: the scene of the second case, which has built the kernels for it.
SIZE = 64
ANGLES = (0.0, 60.0, 120.0) * u.deg
STARS = Star(32, 16), Star(50, 44, 15.0 * u.mag)
MASKED = 0.02
# By solver, iterations and the deviation allowed. In single precision OpenCL allows divisions and
# roots that are inexact; with the worst of them the deviations are 5.9e-7 and 1.7e-6, and twice as
# much is allowed. In double precision it is three times the larger of what was measured on PoCL and
# what the reference makes of images that differ by rounding.
RUNS: dict[str, tuple[int, dict[str, float]]] = {
    "sgm": (30, {"single": 1.3e-6, "double": 5e-15}),
    "sgp": (10, {"single": 3.5e-6, "double": 1.6e-14}),
}

# What comes of a device or a compiler at fault, and of the numbers that it makes.
FAULTS = (LnoclError, cl.Error, ArithmeticError, ValueError)
LONGEST_FAULT = 500


@dataclass(frozen=True)
class Row:
    """What was measured of a kernel or a deconvolution.

    Attributes
    ----------
    what : str
        Name of the kernel or of the solver; ``"build"`` where the kernels do not build.
    precision : {"single", "double"}
        Arithmetic.
    grid : tuple of int
        Shape (Ny, Nx).
    measured : float
        Worst deviation from the reference, as a share of the largest value; NaN where there is no
        number.
    allowed : float
        The largest that is right.
    fault : str
        What was raised in place of a result.
    """

    what: str
    precision: str
    grid: tuple[int, int]
    measured: float
    allowed: float
    fault: str = ""

    @property
    def share(self) -> float:
        """The deviation over that allowed; infinite where there is no number."""
        return math.inf if math.isnan(self.measured) else self.measured / self.allowed

    @property
    def right(self) -> bool:
        """Whether the deviation is allowed."""
        return self.share <= 1.0

    @property
    def where(self) -> str:
        """Precision and grid in words."""
        return f"{self.precision}, {self.grid[0]} x {self.grid[1]}"


def run(device: cl.Device) -> list[Row]:
    """Try kernels and deconvolutions on a device, in each precision that it has.

    Parameters
    ----------
    device : pyopencl.Device
        As from `lnocl.opencl.device.choose`.

    Returns
    -------
    list of Row
        One for each kernel, precision and size, or one where its kernels do not build; then one
        for each solver and precision.
    """
    precisions = [each for each in DTYPES if each == "single" or has_double(device)]
    context = context_of(device)
    return [
        row
        for precision in precisions
        for grid, scene in CASES
        for row in _try_kernels(context, precision, grid, scene)
    ] + list(_try_deconvolutions(spec_of(device), precisions))


def table(rows: Sequence[Row]) -> Iterator[str]:
    """Return the lines of a table with the worst row of each kernel and solver."""
    worst = [max(each, key=lambda row: row.share) for each in _by_name(rows).values()]
    yield f"{'kernel or solver':<18} {'worst in':<20} {'deviation':>9} {'allowed':>9}"
    for row in worst:
        eps = float(np.finfo(DTYPES[row.precision]).eps)
        shown = "failed" if row.fault else f"{row.measured / eps:.2g}"
        yield (
            f"{row.what:<18} {row.where:<20} {shown:>9} {row.allowed / eps:>9.2g}"
            f"  {'right' if row.right else 'WRONG'}"
        )
    yield (
        "deviation: largest difference from the NumPy reference over its largest value, in units "
        "of the precision's rounding: 1.2e-07 single, 2.2e-16 double"
    )
    if all(row.precision == "single" for row in rows):
        yield "the device has no double precision, so none was tried"
    yield from (f"{row.what} ({row.where}): {row.fault}" for row in worst if row.fault)


def verdict(rows: Sequence[Row], device: cl.Device) -> str:
    """Return in one line that all is right.

    Raises
    ------
    DeviceError
        Where it is not; the message says what is wrong.
    """
    wrong = _by_name([row for row in rows if not row.right])
    if wrong:
        named = (f"{what} ({_precisions(found)})" for what, found in wrong.items())
        raise DeviceError(
            f"WRONG on {describe(device)}: {', '.join(named)}: do not trust its results; try "
            "another driver or --engine numpy"
        )
    n_runs = sum(row.what in RUNS for row in rows)
    return f"all {len(KERNELS)} kernels and {n_runs} deconvolutions are right on {describe(device)}"


def _try_kernels(
    context: cl.Context, precision: str, grid: tuple[int, int], scene: str
) -> Iterator[Row]:
    dtype = DTYPES[precision]
    allowed = ALLOWED[dtype]
    if precision == "double":
        grid = grid[1], grid[0]
    try:
        harness = KernelHarness(context, grid, dtype, **SCENES[scene])
    except FAULTS as error:
        yield Row("build", precision, grid, math.nan, allowed, _fault(error))
        return
    given = inputs(harness)
    for kernel in kernels_of(SCENES[scene]):
        measure = functools.partial(deviation, harness, given, kernel)
        yield _row(kernel, precision, grid, measure, allowed)


def _try_deconvolutions(device: str, precisions: Sequence[str]) -> Iterator[Row]:
    observation, stars = _observe()
    for solver, (n_iter, allowed) in RUNS.items():
        reconstruct = functools.partial(
            deconvolve, observation, stars=stars, **(PAPER | {"solver": solver, "n_iter": n_iter})
        )
        with ignored_warnings(MisfitWarning):
            expected = reconstruct(engine="numpy")
        for precision in precisions:
            measure = functools.partial(
                _strays, reconstruct, expected, precision=precision, device=device
            )
            yield _row(solver, precision, (SIZE, SIZE), measure, allowed[precision])


def _row(
    what: str,
    precision: str,
    grid: tuple[int, int],
    measure: Callable[[], float],
    allowed: float,
) -> Row:
    try:
        # Runs that end early fit no image.
        with np.errstate(all="ignore"), ignored_warnings(MisfitWarning):
            return Row(what, precision, grid, measure(), allowed)
    except FAULTS as error:
        return Row(what, precision, grid, math.nan, allowed, _fault(error))


def _observe() -> tuple[Observation, list[tuple[int, int]]]:
    """Return three images with a mask and a map of the background, and the places of two stars."""
    seen = simulate(load_target("hh34", SIZE, STARS), Experiment(angles=ANGLES))
    shape = seen.images.shape
    mask = np.random.default_rng(0).random(shape) < MASKED
    background = np.broadcast_to(seen.background[:, None, None], shape)
    observation = Observation(
        seen.images, seen.psfs, background=background, read_noise=seen.read_noise, mask=mask
    )
    return observation, seen.stars


def _strays(reconstruct: Callable[..., Result], expected: Result, **how: str) -> float:
    """Return how far a reconstruction is from that expected, at worst."""
    found = reconstruct(**how)
    return max(
        relative(found.extended, expected.extended),
        relative(found.star_fluxes, expected.star_fluxes),
        relative(found.history["objective"], expected.history["objective"]),
    )


def _fault(error: Exception) -> str:
    return textwrap.shorten(str(error), LONGEST_FAULT, placeholder=" ...")


def _by_name(rows: Sequence[Row]) -> dict[str, list[Row]]:
    names = dict.fromkeys(row.what for row in rows)
    return {name: [row for row in rows if row.what == name] for name in names}


def _precisions(rows: Sequence[Row]) -> str:
    return ", ".join(dict.fromkeys(row.precision for row in rows))
