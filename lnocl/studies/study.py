"""Grids of simulated observations, each reconstructed and measured against its truth."""

from __future__ import annotations

import dataclasses
import itertools
import time
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from contextlib import closing
from functools import lru_cache
from typing import Any

import numpy as np
from astropy import units as u
from astropy.table import Table

from lnocl import metrics
from lnocl.deconvolution import deconvolve
from lnocl.errors import InputError
from lnocl.parallel import work
from lnocl.process import ignored_warnings
from lnocl.runs.options import check_choices, check_length
from lnocl.scene.observation import Array, Observation
from lnocl.simulation import Experiment, Simulation, Star, Target, fizeau_psf, hh34, simulate

METHODS = "mc-rl", "rl"
# The Strehl ratio of the PSFs that those given are mixed with, in that of the true ones.
WRONG_STREHL = 0.7


@dataclasses.dataclass(frozen=True)
class Case:
    """A simulated observation, and how it is reconstructed; what is not given is the paper's.

    Attributes
    ----------
    size : int
        Pixels along each side; even, 64 or more.
    contrast : float
        Flux of the star in that of the jet, more than zero.
    extended_magnitude : float
        Of the jet; that of the star follows.
    strehl : float
        Strehl ratio, in (0, 1].
    n_images : int
        Images, the baseline turned by ``180 / n_images`` degrees from one to the next; one or more.
    exposure : float
        Of each image, minutes; more than zero.
    psf_error : float
        Relative error of the PSFs that are given, ``||K' - K|| / ||K||``, zero or more: K' is mixed
        of K and of a PSF with other residual phases and 0.7 of the Strehl ratio.
    position_error : float
        Pixels by which the star is off, in a direction that follows from the seed.
    refine : bool
        Whether its position is refined.
    method : {"mc-rl", "rl"}
        With the star as a component of its own, or without.
    solver, stop, smoothing, mu, n_iter
        As for `lnocl.deconvolve`; stop may be ``"none"``.
    seed : int
        Of residual phases, noise and direction.
    """

    size: int = 256
    contrast: float = 1.0
    extended_magnitude: float = 13.0
    strehl: float = 0.7
    n_images: int = 4
    exposure: float = 30.0
    psf_error: float = 0.0
    position_error: float = 0.0
    refine: bool = False
    method: str = "mc-rl"
    solver: str = "sgp"
    stop: str = "held-out"
    smoothing: str = "auto"
    mu: float = 0.0
    n_iter: int = 1000
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("stop", "smoothing"):
            object.__setattr__(self, name, _word(getattr(self, name)))
        check_choices(self.solver, "single", "opencl", None)
        check_length(self.n_iter, _read(self.stop))
        for name, least in (("psf_error", 0.0), ("position_error", 0.0)):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) >= least):
                raise InputError(f"{name} must be finite and not negative")
        if not (np.isfinite(self.contrast) and self.contrast > 0):
            raise InputError(f"contrast must be finite and more than zero; {self.contrast} given")
        if not (isinstance(self.n_images, (int, np.integer)) and self.n_images >= 1):
            raise InputError(f"n_images must be a whole number, 1 or more; {self.n_images} given")
        if not 0 < self.strehl <= 1:
            raise InputError(f"strehl must be in (0, 1]; {self.strehl} was given")
        if self.position_error > self.size / 8:
            raise InputError(f"position_error must be {self.size / 8:g} pixels at most here")
        if self.method not in METHODS:
            raise InputError(f"method {self.method!r} is not known; give {', '.join(METHODS)}")

    @property
    def observed(self) -> tuple[Any, ...]:
        """What the images hang on."""
        return (
            *(self.size, self.contrast, self.extended_magnitude, self.strehl),
            *(self.n_images, self.exposure, self.seed),
        )


AXES: dict[str, Any] = {each.name: each.default for each in dataclasses.fields(Case)}

# What is measured: format and description.
MEASURES = {
    "rho": (".4f", "rho', error of the extended source, all rows"),
    "rho_star": (".4f", "rho'', the same, 24 rows around the star"),
    "magnitude_error": (".5f", "magnitude of the star less the true one"),
    "iterations": ("d", "iterations done"),
    "chosen_smoothing": (".2e", "weight of the edge-preserving term"),
    "stopped": ("", "why it stopped"),
    "seconds": (
        ".2f",
        "time of the reconstruction, with the compilation of kernels where it is the first",
    ),
}


def make_cases(axes: Mapping[str, Sequence[Any]]) -> list[Case]:
    """Return a case for each combination of values, those of one observation together.

    Parameters
    ----------
    axes : mapping of str to sequence
        Values of the attributes of `Case`; what is left out has its default.

    Raises
    ------
    InputError
        A value is out of range, or an axis is not known or empty.
    """
    for name, values in axes.items():
        if name not in AXES:
            raise InputError(f"{name} is not known; give {', '.join(AXES)}")
        if not len(values):
            raise InputError(f"{name} has no value")
    products = itertools.product(*axes.values())
    cases = dict.fromkeys(Case(**dict(zip(axes, values, strict=True))) for values in products)
    return sorted(cases, key=lambda case: tuple(map(str, case.observed)))


def run(
    cases: Iterable[Case],
    *,
    device: str | None = None,
    parallel: bool | int | str = False,
    earlier: Table | None = None,
) -> Generator[Table]:
    """Reconstruct cases and measure them, but for those that an earlier table has.

    Parameters
    ----------
    cases : iterable of Case
        What to do.
    device : str, optional
        As for `lnocl.deconvolve`.
    parallel : bool, int or "current-scheduler", optional
        As for `lnocl.parallel.check_parallel`.
    earlier : Table, optional
        Rows that are there.

    Yields
    ------
    Table
        After each case, all rows so far: the attributes of the case, then `MEASURES`.

    Raises
    ------
    InputError
        A value that the simulation or `lnocl.deconvolve` refuses.
    """
    rows = [] if earlier is None else [dict(zip(row.colnames, row, strict=True)) for row in earlier]
    done = {_case_of(row) for row in rows}
    due = [case for case in cases if case not in done]
    with closing(work(_Measuring(device), due, parallel)) as measured:
        for case, found in zip(due, measured, strict=True):
            rows.append(dataclasses.asdict(case) | found)
            yield tabulate(rows)


def tabulate(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Return rows as a table."""
    table = Table([dict(row) for row in rows], names=[*AXES, *MEASURES])
    for name, (pattern, description) in MEASURES.items():
        table[name].info.format, table[name].info.description = pattern or None, description
    return table


def _case_of(row: Mapping[str, Any]) -> Case:
    return Case(**{name: type(default)(row[name]) for name, default in AXES.items()})


class _Measuring:
    """Makes what measures a case; it can be pickled."""

    def __init__(self, device: str | None) -> None:
        self._device = device

    def __call__(self) -> Callable[[Case], dict[str, Any]]:
        return self._measure

    def _measure(self, case: Case) -> dict[str, Any]:
        simulation = _simulate(*case.observed)
        star = simulation.stars[0]
        observation = Observation(
            simulation.images,
            _wrong_psfs(simulation, case),
            background=simulation.background,
            read_noise=simulation.read_noise,
            psf_centre="given",
        )
        angle = np.random.default_rng([case.seed, 1]).uniform(0.0, 2.0 * np.pi)
        off = case.position_error * np.array([np.cos(angle), np.sin(angle)])
        begun = time.perf_counter()
        with ignored_warnings():  # that PSFs and places are wrong
            result = deconvolve(
                observation,
                [] if case.method == "rl" else [tuple(star + off)],
                solver=case.solver,
                stop=_read(case.stop),
                smoothing=_read(case.smoothing),
                mu=case.mu,
                n_iter=case.n_iter,
                pad=0,
                refine_positions=case.refine,
                device=self._device,
            )
        seconds = time.perf_counter() - begun
        truth, masked, flux = simulation.extended, None, simulation.star_fluxes[0]
        if case.method == "rl":
            truth, masked = truth.copy(), star
            truth[star[1], star[0]] += flux
            found = metrics.box_flux(result.extended, star)
        else:
            found = float(result.star_fluxes[0])
        rows = metrics.star_rows(star, truth.shape)
        return {
            "rho": metrics.restoration_error(result.extended, truth, star=masked),
            "rho_star": metrics.restoration_error(result.extended, truth, rows, masked),
            "magnitude_error": metrics.magnitude(max(found, 1e-3 * flux), 1.0)
            - metrics.magnitude(flux, 1.0),
            "iterations": result.n_iter,
            "chosen_smoothing": result.smoothing,
            "stopped": result.stop_reason,
            "seconds": seconds,
        }


def _word(value: Any) -> str:
    """Return a rule or a weight as tables hold it."""
    if value is None:
        return "none"
    try:
        return repr(float(value))
    except ValueError:
        return str(value)


def _read(text: str) -> Any:
    """Return a number, None or a word."""
    if text == "none":
        return None
    try:
        return float(text)
    except ValueError:
        return text


@lru_cache(maxsize=2)
def _simulate(
    size: int,
    contrast: float,
    extended_magnitude: float,
    strehl: float,
    n_images: int,
    exposure: float,
    seed: int,
) -> Simulation:
    target = hh34(size)
    star, magnitude = target.stars[0], extended_magnitude - 2.5 * np.log10(contrast)
    target = Target(target.extended, [Star(star.x, star.y, magnitude * u.mag)])
    return simulate(
        target,
        Experiment(
            angles=np.arange(n_images) * 180.0 / n_images * u.deg,
            exposure_time=exposure * u.min,
            strehl=strehl,
            extended_magnitude=extended_magnitude * u.mag,
            seed=seed,
        ),
    )


def _wrong_psfs(simulation: Simulation, case: Case) -> Array:
    """Return PSFs with the relative error of the case, of unit sum."""
    if not case.psf_error:
        return simulation.psfs
    how, shape = simulation.experiment, simulation.extended.shape
    seeds = np.random.SeedSequence([case.seed, 2]).spawn(case.n_images)
    mixed = []
    for psf, angle, seed in zip(simulation.psfs, how.angles, seeds, strict=True):
        other = fizeau_psf(
            (shape[0], shape[1]),
            angle,
            how.wavelength,
            how.pixel_scale,
            WRONG_STREHL * case.strehl,
            seed,
        )
        difference = other - psf
        share = case.psf_error * np.linalg.norm(psf) / np.linalg.norm(difference)
        if share > 1:
            raise InputError(
                f"psf_error is at most {case.psf_error / share:.3g} here; {case.psf_error} given"
            )
        mixed.append(psf + share * difference)
    return np.array(mixed)
