"""What ``lnocl deconvolve`` says of its result."""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from lnocl.errors import counted
from lnocl.residuals import Fit, StarResiduals, sharp_sources
from lnocl.result import Result
from lnocl.scene.detector import on_sky
from lnocl.scene.observation import Observation
from lnocl.scene.stars import MAX_SHIFT

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from lnocl.io.frames import Frames

# The darkest share of the extended source, and how bright it may be, in standard deviations of a
# pixel's noise.
DARK_SHARE, FLOOR = 0.05, 0.5
# How a verdict begins where nothing is wrong.
FITS = "the model fits"
# Where a star without light may be instead: so many pixels from its place.
ELSEWHERE = 10
# Of a star that was moved by this share of `MAX_SHIFT` more may be needed.
AT_LIMIT = 0.99

REASONS = {
    "n_iter": "all iterations were done",
    "held-out": "held-out counts chose this iteration",
    "discrepancy": "the data are fitted as well as noise allows",
    "change": "the objective hardly changed any more",
    "converged": "no step lowers the objective any more",
    "diverged": "the objective rose after this iteration",
    "not finite": "the objective was not finite after this iteration",
    "interrupt": "it was interrupted",
}


def summarise(
    arguments: argparse.Namespace,
    result: Result,
    frames: Frames,
    at_stars: Sequence[StarResiduals],
    overall: Fit,
) -> list[str]:
    """Return how a reconstruction ended, and what it found, a line each."""
    objective = result.history["objective"][-1]
    device, _, _ = result.device.partition(" (")  # the header has its platform and driver
    unit = _unit(frames)
    stars = _light_curves(result, frames) or [
        f"star at ({x:.7g}, {y:.7g}): {_flux(flux, error, frames)}; residuals "
        f"{_rms(found.core)} in its core, {_rms(found.wings)} in its wings, where noise gives 1"
        for (x, y), flux, error, found in zip(
            result.star_positions,
            result.star_fluxes,
            result.star_flux_errors,
            at_stars,
            strict=True,
        )
    ]
    return [
        f"{counted(result.n_iter, 'iteration')} on {device}, objective {objective:.6g}",
        REASONS[result.stop_reason],
        *stars,
        *(["; ".join(lines)] if (lines := result._halo_lines()) else []),
        f"extended source: {_flux(*result.extended_flux, frames)} in the whole frame",
        *_floor(result, frames, unit),
        *_unnamed(result, frames),
        f"residuals {_rms(overall)} in all, where noise gives 1",
        *_shortness(arguments, result),
    ]


def _light_curves(result: Result, frames: Frames) -> list[str]:
    """Return a line for each star that has a flux in each of several epochs."""
    n = frames.observation.n_epochs
    if n == 1:
        return []
    fluxes, errors = (
        np.reshape(each, (-1, n)) / frames.electrons
        for each in (result.star_fluxes, result.star_flux_errors)
    )
    return [
        f"star at ({x:.7g}, {y:.7g}): {n} epochs, {flux.min():.5g} to {flux.max():.5g} "
        f"{_unit(frames)}, with errors of {np.median(error):.2g} (median)"
        for (x, y), flux, error in zip(result.star_positions[::n], fluxes, errors, strict=True)
    ]


def _shortness(arguments: argparse.Namespace, result: Result) -> list[str]:
    if result.n_iter > 1 or result.n_iter == arguments.n_iter or result.stop_reason == "interrupt":
        return []
    return [
        f"it ended after {counted(result.n_iter, 'iteration')}: there is little but noise, or PSF, "
        "background or noise are wrong"
    ]


def _unnamed(result: Result, frames: Frames) -> list[str]:
    """Return a line on sources in the extended source that are as sharp as stars."""
    observation = frames.observation
    background = float((_means(observation.background) / _areas(observation)).sum())
    exposure = float(_means(observation.exposure).sum())  # of all images, whose noise tells
    found = sharp_sources(result.extended * exposure, background, observation.oversample)
    found = found / (1.0, 1.0, exposure)
    offsets = found[:, None, :2] - result.star_positions
    found = found[(np.hypot(*np.moveaxis(offsets, -1, 0)) > MAX_SHIFT).all(axis=1)]
    if not len(found):
        return []
    (x, y, light), n = found[0], len(found)
    return [
        f"{counted(n, 'source')} in the extended source {'is' if n == 1 else 'are'} as sharp as "
        f"stars, the brightest at ({x:.7g}, {y:.7g}) with {light / frames.electrons:.3g} "
        f"{_unit(frames)}: name stars by --star, or --stars with the table of lnocl stars"
    ]


def _floor(result: Result, frames: Frames, unit: str) -> list[str]:
    """Return a line where the extended source is nowhere dark."""
    observation = frames.observation
    darkest = float(np.quantile(result.extended, DARK_SHARE))
    counts = darkest * _areas(observation) * _means(observation.exposure)
    if not (counts > FLOOR * np.sqrt(_means(observation.background) + counts)).any():
        return []
    return [
        f"the extended source is hardly darker anywhere than {darkest / frames.electrons:.3g} "
        f"{unit} a pixel: the background is too low by that, or light fills the frame"
    ]


def _areas(observation: Observation) -> NDArray[np.float64]:
    """Return how many pixels of the sky are one of each image."""
    return np.asarray((observation.oversample * observation.scales) ** 2)


def _means(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean of each image, of numbers or maps."""
    return np.asarray(values.reshape(len(values), -1).mean(axis=1))


def _flux(flux: float, error: float, frames: Frames) -> str:
    """Return a flux and its error, electrons, in the unit of the images, and in electrons."""
    units = {_unit(frames): frames.electrons}
    if frames.electrons != 1.0:
        units["electrons" + "/s" * frames.unit.endswith("/s")] = 1.0
    values = [f"{_number(flux / one, error / one)} {unit}" for unit, one in units.items()]
    return " = ".join(values)


def _unit(frames: Frames) -> str:
    return re.sub(r"^(electron|photon)\b", r"\1s", frames.unit)


def _number(value: float, error: float) -> str:
    return f"{value:.6g} +- {error:.2g}" if math.isfinite(error) else f"{value:.6g}"


def _rms(fit: Fit) -> str:
    return f"{fit.rms:.2f} +- {fit.error:.2f}" if fit.n_pixels else "unknown (no good pixel)"


def verdict_on(
    arguments: argparse.Namespace,
    result: Result,
    frames: Frames,
    given_stars: Sequence[tuple[float, float]],
    at_stars: Sequence[StarResiduals],
    overall: Fit,
    is_warned: bool,
) -> list[str]:
    """Return that the model fits, or else where it does not and what to do, a line each."""
    unfitted, lit, dark, lost = [], [], [], []
    observation = frames.observation
    given_stars = [star for star in given_stars for _ in range(observation.n_epochs)]
    for place, given, flux, found in zip(
        result.star_positions, given_stars, result.star_fluxes, at_stars, strict=True
    ):
        if not flux > 0:
            where = _elsewhere(result.extended, place, observation.oversample)
            dark.append(f"{_at(given)}{where}")
            continue
        if np.hypot(*(place - np.array(given))) > AT_LIMIT * MAX_SHIFT:
            lost.append(f"{_at(given)} to {_at(place)}")
        if found.is_misfit:
            unfitted.append(_at(place))
        if found.has_halo:
            lit.append(f"{_at(place)}, {100 * found.halo:.0f} %")
    verdict = []
    if dark:
        verdict.append(f"no light is left for {counted(len(dark), 'star')}: {'; '.join(dark[:3])}")
    if lost:
        verdict.append(
            f"{counted(len(lost), 'star')} moved as far as stars may, {MAX_SHIFT:g} pixels, from "
            f"{'; '.join(lost[:3])}: give the place where it is brightest"
        )
    if unfitted:
        by_default = [] if isinstance(arguments.smoothing, float) else ["pixels"]
        remedy = "leave --refine-psfs out" if by_default else "try --refine-psfs jitter pixels"
        may_free = "pixels" not in (arguments.refine_psfs or by_default)
        may_free = may_free and not observation.is_turned and observation.n_epochs == 1
        verdict.append(
            f"the model does not fit at {len(unfitted)} of {counted(len(at_stars), 'star')}, "
            f"{' '.join(unfitted[:3])}: give a better PSF" + (f", or {remedy}" if may_free else "")
        )
    elif overall.is_misfit and not (dark or lost):
        verdict.append("the model does not fit: see to background, noise and gain")
    refinement = result.psf_refinement
    is_fitted = refinement is not None and refinement.has_free_pixels  # which follow the noise
    if overall.is_overfit and not is_fitted:
        is_smoothed = bool((result.smoothing or 0.0) > 0.0)
        verdict.append(
            "the residuals are far less than noise: the noise that is taken is too large (see to "
            "unit, gain, exposure, background and read noise), or the model follows the noise"
            + ("" if is_smoothed else " (take fewer iterations, or --smoothing)")
        )
    if lit:
        verdict.append(
            f"light lies all round {counted(len(lit), 'star')}, as a share of its flux: "
            f"{'; '.join(lit[:3])}: the PSF is too narrow or lacks its wings, the background is "
            "too low, or a source lies there"
        )
    return verdict or [f"{FITS}, but see the warnings of the run" if is_warned else FITS]


def _at(place: Iterable[float]) -> str:
    x, y = place
    return f"({x:.7g}, {y:.7g})"


def _elsewhere(extended: NDArray[np.float64], place: NDArray[np.float64], finer: int) -> str:
    """Return where the brightest light near a star without light is, and what to do."""
    x, y = np.round(on_sky(place, finer)).astype(int)
    reach = ELSEWHERE * finer
    rows, columns = (slice(max(at - reach, 0), max(at + reach + 1, 0)) for at in (y, x))
    around = extended[rows, columns]
    if not around.any():
        return ", nor near it: leave it out"
    row, column = np.unravel_index(int(around.argmax()), around.shape)
    at = np.array([columns.start + column, rows.start + row], float)
    brightest = (at - (finer - 1) / 2.0) / finer
    return (
        f", and the brightest light within {ELSEWHERE} pixels lies at {_at(brightest)}: give the "
        "star's place, or leave it out"
    )
