"""What ``lnocl deconvolve`` says of its result."""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from lnocl.errors import counted
from lnocl.residuals import Fit, StarResiduals
from lnocl.result import Result

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from lnocl.io.frames import Frames

# The darkest share of the extended source, and how bright it may be, in standard deviations of a
# pixel's noise.
DARK_SHARE, FLOOR = 0.05, 0.5
# How a verdict begins where nothing is wrong.
FITS = "the model fits"

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
    flux, error = result.extended_flux
    unit = re.sub(r"^(electron|photon)\b", r"\1s", frames.unit)
    stars = [
        f"star at ({x:.7g}, {y:.7g}): {_flux(flux, error)} {unit}; residuals "
        f"{_rms(found.core)} in its core, {_rms(found.wings)} in its wings, where noise gives 1"
        for (x, y), flux, error, found in zip(
            result.star_positions,
            result.star_fluxes / frames.electrons,
            result.star_flux_errors / frames.electrons,
            at_stars,
            strict=True,
        )
    ]
    return [
        f"{counted(result.n_iter, 'iteration')} on {device}, objective {objective:.6g}",
        REASONS[result.stop_reason],
        *stars,
        f"extended source: {_flux(flux / frames.electrons, error / frames.electrons)} {unit}",
        *_floor(result, frames, unit),
        f"residuals {_rms(overall)} in all, where noise gives 1",
        *_shortness(arguments, result),
    ]


def _shortness(arguments: argparse.Namespace, result: Result) -> list[str]:
    if result.n_iter > 1 or result.n_iter == arguments.n_iter or result.stop_reason == "interrupt":
        return []
    return [
        f"it ended after {counted(result.n_iter, 'iteration')}: there is little but noise, or PSF, "
        "background or noise are wrong"
    ]


def _floor(result: Result, frames: Frames, unit: str) -> list[str]:
    """Return what to say where the extended source is nowhere dark."""
    observation = frames.observation
    darkest = float(np.quantile(result.extended, DARK_SHARE))
    counts = darkest * observation.oversample**2 * _means(observation.exposure)
    if not (counts > FLOOR * np.sqrt(_means(observation.background) + counts)).any():
        return []
    return [
        f"the extended source is hardly darker anywhere than {darkest / frames.electrons:.3g} "
        f"{unit} a pixel: the background is too low by that, or light fills the frame"
    ]


def _means(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean of each image, of numbers or maps."""
    return np.asarray(values.reshape(len(values), -1).mean(axis=1))


def _flux(flux: float, error: float) -> str:
    return f"{flux:.6g} +- {error:.2g}" if math.isfinite(error) else f"{flux:.6g}"


def _rms(fit: Fit) -> str:
    return f"{fit.rms:.2f} +- {fit.error:.2f}" if fit.n_pixels else "unknown (no good pixel)"


def verdict_on(
    arguments: argparse.Namespace,
    result: Result,
    at_stars: Sequence[StarResiduals],
    overall: Fit,
    is_warned: bool,
) -> list[str]:
    """Return that the model fits, or else where it does not and what to do, a line each."""
    unfitted, lit, dark = [], [], []
    for (x, y), flux, found in zip(
        result.star_positions, result.star_fluxes, at_stars, strict=True
    ):
        if not flux > 0:
            dark.append(f"({x:.7g}, {y:.7g})")
        if found.is_misfit:
            unfitted.append(f"({x:.7g}, {y:.7g})")
        if found.has_halo:
            lit.append(f"({x:.7g}, {y:.7g}), {100 * found.halo:.0f} %")
    verdict = []
    if unfitted:
        by_default = [] if isinstance(arguments.smoothing, float) else ["pixels"]
        may_free = "pixels" not in (arguments.refine_psfs or by_default)
        verdict.append(
            f"the model does not fit at {len(unfitted)} of {counted(len(at_stars), 'star')}, "
            f"{' '.join(unfitted[:3])}: give a better PSF"
            + (", or try --refine-psfs jitter pixels" if may_free else "")
        )
    elif overall.is_misfit:
        verdict.append("the model does not fit: see to background, noise and gain")
    if dark:
        verdict.append(
            f"no light is left for {counted(len(dark), 'star')}, {' '.join(dark[:3])}: there is "
            "none, or it is elsewhere; lnocl stars finds where"
        )
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
    return verdict or [f"{FITS}, but see the warnings above" if is_warned else FITS]
