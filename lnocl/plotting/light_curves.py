"""Light curves: the flux of each star in each epoch."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes

from lnocl.core.scene.arrays import Array
from lnocl.plotting.figure import MOST_STARS, as_text, line_style


class LightCurves(NamedTuple):
    """Fluxes of stars in several epochs.

    Attributes
    ----------
    fluxes, errors : ndarray of float64, shape (n_stars, n_epochs)
        And their standard errors. Both are NaN where no image of the epoch shows the star.
    unit : str
        Of both.
    """

    fluxes: Array
    errors: Array
    unit: str


def light_curves(fluxes: Array, errors: Array, epochs: Array, unit: str) -> LightCurves | None:
    """Return the light curves of a table of stars and epochs; None where it has one epoch."""
    n_epochs = int(np.max(epochs, initial=0)) + 1
    if n_epochs == 1:
        return None
    return LightCurves(np.reshape(fluxes, (-1, n_epochs)), np.reshape(errors, (-1, n_epochs)), unit)


def draw(axis: Axes, curves: LightCurves) -> None:
    """Draw the fluxes of the brightest stars over their mean, with their standard errors."""
    from matplotlib.ticker import MaxNLocator

    is_seen = np.isfinite(curves.fluxes)
    means = np.where(is_seen, curves.fluxes, 0.0).sum(axis=1) / np.maximum(is_seen.sum(axis=1), 1)
    shown = np.sort(np.argsort(-means, kind="stable")[:MOST_STARS])
    epochs = np.arange(curves.fluxes.shape[1])
    for i, s in enumerate(shown[means[shown] > 0]):
        flux, error = curves.fluxes[s] / means[s], curves.errors[s] / means[s]
        style = line_style(i) | {"lw": 0.8, "marker": "o", "ms": 3}
        axis.errorbar(
            # Errors side by side, where stars have the same flux.
            epochs + 0.06 * (i - (len(shown) - 1) / 2.0),
            flux,
            np.nan_to_num(error),
            capsize=2,
            label=f"star {s + 1}, mean {means[s]:.4g} {as_text(curves.unit)}",
            **style,
        )
    axis.set_title("light curves", fontsize=9)
    axis.set_xlabel("epoch")
    axis.set_ylabel("flux / mean", fontsize=9)
    axis.xaxis.set_major_locator(MaxNLocator(integer=True))
    if axis.containers:
        axis.legend(fontsize=8)
    axis.grid(alpha=0.3)
