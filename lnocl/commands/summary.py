"""What ``lnocl deconvolve`` says of its result."""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

from lnocl.errors import counted
from lnocl.residuals import Fit, StarResiduals
from lnocl.result import Result

if TYPE_CHECKING:
    from lnocl.io.frames import Frames

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
    overall: Fit | None,
    is_warned: bool,
) -> list[str]:
    """Return how a reconstruction ended, what it found, and whether the model fits, a line each."""
    objective = result.history["objective"][-1]
    device, _, _ = result.device.partition(" (")  # the header has its platform and driver
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
        f"extended source: {result.extended.sum() / frames.electrons:.6g} {unit}",
        *([] if overall is None else [f"residuals {_rms(overall)} in all, where noise gives 1"]),
        *_shortness(arguments, result),
        *_verdict(arguments, result, at_stars, overall, is_warned),
    ]


def _shortness(arguments: argparse.Namespace, result: Result) -> list[str]:
    if result.n_iter > 1 or result.n_iter == arguments.n_iter or result.stop_reason == "interrupt":
        return []
    return [
        f"it ended after {counted(result.n_iter, 'iteration')}: there is little but noise, or PSF, "
        "background or noise are wrong"
    ]


def _flux(flux: float, error: float) -> str:
    return f"{flux:.6g} +- {error:.2g}" if math.isfinite(error) else f"{flux:.6g}"


def _rms(fit: Fit) -> str:
    return f"{fit.rms:.2f} +- {fit.error:.2f}" if fit.n_pixels else "unknown (no good pixel)"


def _verdict(
    arguments: argparse.Namespace,
    result: Result,
    at_stars: Sequence[StarResiduals],
    overall: Fit | None,
    is_warned: bool,
) -> list[str]:
    """Return whether the model fits, and where not what to do."""
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
    elif overall is not None and overall.is_misfit:
        verdict.append("the model does not fit: see to background, noise and gain")
    if dark:
        verdict.append(
            f"no light is left for {counted(len(dark), 'star')}, {' '.join(dark[:3])}: there is "
            "none, or it is elsewhere; lnocl stars finds where"
        )
    fits = [overall] if overall is not None else [found.wings for found in at_stars]
    refinement = result.psf_refinement
    is_fitted = refinement is not None and refinement.has_free_pixels  # which follow the noise
    if any(fit.is_overfit for fit in fits) and not is_fitted:
        verdict.append(
            "the residuals are far less than noise: the noise that is taken is too large (see to "
            "unit, gain, exposure, background and read noise), or the model follows the noise "
            "(take fewer iterations, or --smoothing)"
        )
    if lit:
        verdict.append(
            f"light lies all round {counted(len(lit), 'star')}, as a share of its flux: "
            f"{'; '.join(lit[:3])}: the PSF is too narrow or lacks its wings, the background is "
            "too low, or a source lies there"
        )
    if at_stars or overall is not None:
        fitting = "the model fits, but see the warnings above" if is_warned else "the model fits"
        verdict = verdict or [fitting]
    return verdict
