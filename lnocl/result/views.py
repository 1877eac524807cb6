"""What the picture of a result shows."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from lnocl.core.runs.outcome import mean_over_epochs
from lnocl.core.scene.arrays import Array
from lnocl.plotting.light_curves import light_curves
from lnocl.plotting.result import ResultView
from lnocl.result.summary import Unit

if TYPE_CHECKING:
    from lnocl.result import Result


def electrons_in(result: Result, electrons: float) -> Array:
    """Return the electrons in a unit of a result, in each image or its pixels; NaN for none.

    Parameters
    ----------
    result : Result
        The result.
    electrons : float
        In this unit, or per second where exposures were given.

    Returns
    -------
    ndarray of float64, shape (p, ny, nx) or (p, 1, 1)
        By which images and models are in the unit of the result.
    """
    observation = result._observation
    exposure = observation.exposure if result._findings.setup.is_rate else np.ones(1)
    is_map = exposure.ndim == 3
    each = observation.as_given(exposure) if is_map else exposure.reshape(-1, 1, 1)
    found = np.broadcast_to(electrons * each, (len(observation.images), *each.shape[1:]))
    return np.where(found > 0, found, np.nan)


def noise_of(result: Result, electrons: float) -> Array | None:
    """Return `Findings.pixel_noise` in a unit of so many electrons; None without components."""
    return result._findings.pixel_noise() / electrons if result.component_names else None


def view_of(result: Result, unit: Unit | None = None) -> ResultView:
    """Return the arrays and texts of the picture of a result, in a unit."""
    unit = unit or Unit(result._unit)
    observation = result._observation
    models, electrons = result.models(), electrons_in(result, unit.electrons)
    images = observation.as_given(np.where(observation.mask, np.nan, observation.images))
    return ResultView(
        extended=result.extended / unit.electrons,
        # Once each, whatever epochs there are.
        stars=[(x, y) for x, y in result.star_positions[:: observation.n_epochs].tolist()],
        star_fluxes=mean_over_epochs(result.star_fluxes, observation.n_epochs),
        n_iter=result.n_iter,
        history={name: result.history[name] for name in result.history.dtype.names or ()},
        held_out={name: result.held_out[name] for name in result.held_out.dtype.names or ()},
        images=images / electrons,
        models=np.where(np.isnan(images), np.nan, models) / electrons,  # without background there
        residuals=result._residuals(models),
        offsets=observation.transforms[:, :, 2],
        turns=observation.transforms[:, :, :2] if observation.is_mapped else None,
        doubtful=None if result.psf_refinement is None else result.doubtful,
        unit=unit.name,
        oversample=observation.oversample,
        light_curves=light_curves(
            result.star_fluxes / unit.electrons,
            result.star_variation_errors / unit.electrons,
            () if result.component_names else observation.epoch_labels,
            unit.name,
        ),
        names=result.component_names,
        noise=noise_of(result, unit.electrons),
    )
