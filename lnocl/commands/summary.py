"""What ``lnocl deconvolve`` says of its result."""

from __future__ import annotations

import argparse
import math
import re
from typing import TYPE_CHECKING

import numpy as np

from lnocl.core.scene.counts import means
from lnocl.core.scene.observation import Observation
from lnocl.core.scene.stars import MAX_SHIFT
from lnocl.errors import counted
from lnocl.residuals import Fit, sharp_sources
from lnocl.result import Result
from lnocl.result.verdict import FITS, in_words

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from lnocl.io.frames import Frames

# The darkest share of the extended source, and how bright it may be, in standard deviations of a
# pixel's noise.
DARK_SHARE, FLOOR = 0.05, 0.5
# Of a star that is masked in all images, or in all of its epoch.
NOT_SHOWN = "no good pixel shows it, and its flux is not known"

SEE_WARNINGS = ", but see the warnings of the run"

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
    is_warned: bool,
) -> list[str]:
    """Return how a reconstruction ended, and what it found, a line each.

    Of the faults of its model `lnocl.deconvolve` has warned.
    """
    verdict = result.verdict()
    objective = result.history["objective"][-1]
    device, _, _ = result.device.partition(" (")  # the header has its platform and driver
    unit = _unit(frames)
    stars = _light_curves(result, frames) or [
        f"star at {in_words(place)}: {_flux(flux, error, frames)}; residuals {_rms(found.core)} in "
        f"its core, {_rms(found.wings)} in its wings, where noise gives 1"
        if np.isfinite(flux)
        else f"star at {in_words(place)}: {NOT_SHOWN}"
        for place, flux, error, found in zip(
            result.star_positions,
            result.star_fluxes,
            result.star_flux_errors,
            result.star_residuals(),
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
        f"residuals {_rms(result.fit())} in all, where noise gives 1",
        *_shortness(arguments, result),
        *([FITS + SEE_WARNINGS * is_warned] if verdict == [FITS] else []),
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
    lines = []
    for place, flux, error in zip(result.star_positions[::n], fluxes, errors, strict=True):
        seen = np.isfinite(flux)
        number = f"{n} epochs" if seen.all() else f"{seen.sum()} of {n} epochs"
        found = f"{number}, {NOT_SHOWN}"
        if seen.any():
            found = (
                f"{number}, {flux[seen].min():.5g} to {flux[seen].max():.5g} {_unit(frames)}, with "
                f"errors of {np.median(error[seen]):.2g} (median)"
            )
        lines.append(f"star at {in_words(place)}: {found}")
    return lines


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
    levels = means(observation.background, observation.mask)
    background = float((levels / _areas(observation)).sum())
    # Of all images, whose noise tells.
    exposure = float(means(observation.exposure, observation.mask).sum())
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
    counts = darkest * _areas(observation) * means(observation.exposure, observation.mask)
    levels = means(observation.background, observation.mask)
    if not (counts > FLOOR * np.sqrt(levels + counts)).any():
        return []
    return [
        f"the extended source is hardly darker anywhere than {darkest / frames.electrons:.3g} "
        f"{unit} a pixel: the background is too low by that, or light fills the frame"
    ]


def _areas(observation: Observation) -> NDArray[np.float64]:
    """Return how many pixels of the sky are one of each image."""
    return np.asarray((observation.oversample * observation.scales) ** 2)


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
