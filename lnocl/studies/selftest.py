"""A device on trial: short reconstructions with every option of the kernels, against NumPy's."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from lnocl.core.opencl.device import choose, has_double, spec_of
from lnocl.core.runs.run import Run
from lnocl.core.runs.start import Setup, make_start
from lnocl.core.scene.arrays import Array
from lnocl.core.scene.observation import Observation
from lnocl.core.scene.penalty import Penalty
from lnocl.core.scene.transforms import rotations
from lnocl.core.solvers import SolverName
from lnocl.errors import DeviceError, LnoclError

# Iterations by solver; and the deviation allowed by precision. In single precision OpenCL allows
# divisions and roots that are inexact: with the worst of them the deviation is 2.2e-6, and twice as
# much is allowed. With PoCL it is 8e-7, and 4.5e-15 in double precision.
RUNS: dict[SolverName, int] = {"sgm": 30, "sgp": 5}
ALLOWED = {"single": 4.4e-6, "double": 1.6e-14}
STARS = (30.3, 17.8), (50.0, 44.0)
# What comes of a device or a compiler at fault, and of the numbers that it makes.
FAULTS = (LnoclError, ArithmeticError, ValueError)


class Case(NamedTuple):
    """An observation, its stars, and a penalty."""

    observation: Observation
    stars: Array
    penalty: Penalty = Penalty()


@dataclass(frozen=True)
class Row:
    """What was measured of a reconstruction.

    Attributes
    ----------
    case, solver, precision : str
        What was reconstructed, and how.
    measured : float
        Its largest difference from that of the reference, over the largest value.
    allowed : float
        The largest that rounding explains.
    fault : str
        The error that came instead, if one did.
    """

    case: str
    solver: str
    precision: str
    measured: float
    allowed: float
    fault: str = ""

    @property
    def is_right(self) -> bool:
        """Whether the deviation is allowed; no number is not."""
        return self.measured <= self.allowed

    @property
    def name(self) -> str:
        """All that tells it from others."""
        return f"{self.case} ({self.solver}, {self.precision})"


def cases() -> dict[str, Case]:
    """Return what is reconstructed: together the scenes have every option of the kernels.

    Transforms are of two, three and four passes, cut to the device as those of any image are.
    """
    rng = np.random.default_rng(0)

    def observe(ny: int, nx: int, p: int, **given: Any) -> Observation:
        y, x = np.ogrid[:ny, :nx]
        light = 20.0 + 400.0 * np.exp(-((x - 0.4 * nx) ** 2 + (2 * y - ny) ** 2) / (0.1 * ny * ny))
        v, u = np.ogrid[-8:9, -8:9]
        widths = 2.0 + np.arange(p)[:, None, None]
        psfs = np.exp(-(u**2 + u * v + v**2) / widths) + 0.1 * np.exp(-abs(u - 3) - abs(v + 2))
        for at_x, at_y in STARS:
            light += 800.0 * np.exp(-((x - at_x) ** 2 + (y - at_y) ** 2) / 3.0)
        images = rng.poisson(light, (p, ny, nx))
        return Observation(images, psfs, **{"background": 5.0, "read_noise": 2.0, **given})

    stars = np.array(STARS)
    shape = 3, 64, 64
    seen: dict[str, Any] = {
        "mask": rng.random(shape) < 0.02,
        "background": rng.uniform(3.0, 6.0, shape),
    }
    turned = rotations([15.0, -40.0, 75.0], (31.0, 33.0))
    turned[2] /= 1.7  # larger pixels
    return {
        "one image": Case(observe(64, 64, 1), stars[:0]),
        "transmission": Case(
            observe(*shape[1:], 3, transmission=rng.uniform(0.2, 1.0, shape)), stars
        ),
        "mask and map of smoothing": Case(
            observe(*shape[1:], 3, **seen),
            stars,
            Penalty(smoothing=0.01, near_stars=rng.uniform(0.0, 0.02, shape[1:])),
        ),
        "map of exposure": Case(
            observe(256, 1024, 2, exposure=rng.uniform(0.0, 2.0, (2, 256, 1024)).round(1)),
            stars[:1],
            Penalty(mu=1e-4),
        ),
        "finer sky": Case(observe(*shape[1:], 3, oversample=2, **seen), stars),
        "turned images": Case(observe(*shape[1:], 3, transforms=turned, **seen), stars),
    }


def run(device: str | None = None) -> Iterator[Row]:
    """Reconstruct on a device, in each precision that it has, and yield what was measured.

    Parameters
    ----------
    device : str, optional
        As for `lnocl.core.opencl.device.choose`.
    """
    chosen = choose(device).device
    precisions = ["single", *(["double"] if has_double(chosen) else [])]
    spec = spec_of(chosen)
    for name, case in cases().items():
        for solver, n_iter in RUNS.items():
            expected = _reconstruct(case, solver, n_iter, "double", "numpy", None)
            for precision in precisions:
                how = name, solver, precision
                try:
                    with np.errstate(all="ignore"):
                        found = _reconstruct(case, solver, n_iter, precision, "opencl", spec)
                        measured = float(np.max([*map(relative, found, expected)]))  # heeds NaN
                    yield Row(*how, measured, ALLOWED[precision])
                except FAULTS as error:
                    fault = textwrap.shorten(str(error), 500, placeholder=" ...")
                    yield Row(*how, math.nan, ALLOWED[precision], fault)


def _reconstruct(
    case: Case, solver: SolverName, n_iter: int, precision: str, engine: str, device: str | None
) -> tuple[Array, Array, Array]:
    """Return extended source, star fluxes and objectives of a run."""
    setup = Setup(case.observation, case.stars, 0, solver, precision, engine, device)
    made = Run(make_start(setup, case.penalty), n_iter)
    made.complete()
    return made.extended(), made.star_fluxes(), made.objectives()


def relative(found: Array, expected: Array) -> float:
    """Return the worst deviation as a share of the largest expected value."""
    worst = float(np.abs(np.subtract(found, expected)).max(initial=0.0))
    largest = float(np.abs(expected).max(initial=0.0))
    if worst == 0.0:
        return 0.0
    return worst / largest if largest else math.inf


def line(row: Row) -> str:
    """Return a row as a line of a table."""
    eps = float(np.finfo("f4" if row.precision == "single" else "f8").eps)
    shown = row.fault or f"{row.measured / eps:.2g} of {row.allowed / eps:.2g} allowed"
    return f"{row.name}: {shown}, {'right' if row.is_right else 'WRONG'}"


def verdict(rows: Sequence[Row], device: str) -> str:
    """Return in one line that all is right on a device of this name.

    Raises
    ------
    DeviceError
        Something is wrong; the message names it.
    """
    wrong = [row.name for row in rows if not row.is_right]
    if wrong:
        raise DeviceError(
            f"WRONG on {device}: {', '.join(wrong)}: do not trust its results; try "
            "another driver or --engine numpy"
        )
    return f"all {len(rows)} reconstructions are right on {device}"
