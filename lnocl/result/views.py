"""What the picture of a result shows."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from lnocl.core.runs.outcome import mean_over_epochs
from lnocl.plotting.light_curves import light_curves
from lnocl.plotting.result import ResultView
from lnocl.result.summary import Unit

if TYPE_CHECKING:
    from lnocl.result import Result


def view_of(result: Result, unit: Unit | None = None) -> ResultView:
    """Return the arrays and texts of the picture of a result, its light curves in a unit."""
    unit = unit or Unit(result._unit)
    observation = result._observation
    models = result.models()
    return ResultView(
        extended=result.extended,
        # Once each, whatever epochs there are.
        stars=[(x, y) for x, y in result.star_positions[:: observation.n_epochs].tolist()],
        star_fluxes=mean_over_epochs(result.star_fluxes, observation.n_epochs),
        n_iter=result.n_iter,
        history={name: result.history[name] for name in result.history.dtype.names or ()},
        held_out={name: result.held_out[name] for name in result.held_out.dtype.names or ()},
        images=observation.as_given(np.where(observation.mask, np.nan, observation.images)),
        models=models,
        residuals=result._residuals(models),
        offsets=observation.transforms[:, :, 2],
        turns=observation.transforms[:, :, :2] if observation.is_mapped else None,
        doubtful=None if result.psf_refinement is None else result.doubtful,
        unit=result._unit,
        oversample=observation.oversample,
        light_curves=light_curves(
            result.star_fluxes / unit.electrons,
            result.star_variation_errors / unit.electrons,
            observation.epoch_labels,
            unit.name,
        ),
    )
