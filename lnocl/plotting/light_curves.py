"""Light curves: the flux of each star in each epoch."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lnocl.core.scene.arrays import Array
from lnocl.plotting.figure import MOST_STARS, Axes, as_text, line_style

# Labels of epochs that an axis has room for.
MOST_LABELS = 8


class LightCurves(NamedTuple):
    """Fluxes of stars in several epochs.

    Attributes
    ----------
    fluxes, errors : ndarray of float64, shape (n_stars, n_epochs)
        And the standard errors of their changes. Both are NaN where no image of the epoch shows the
        star.
    unit : str
        Of both.
    labels : sequence of str
        Of the epochs: dates, numbers or other texts.
    """

    fluxes: Array
    errors: Array
    unit: str
    labels: Sequence[str]


def light_curves(
    fluxes: Array, errors: Array, labels: Sequence[str], unit: str
) -> LightCurves | None:
    """Return the light curves of a table of stars and epochs; None where it has one epoch."""
    n = len(labels)
    if n <= 1:
        return None
    return LightCurves(np.reshape(fluxes, (-1, n)), np.reshape(errors, (-1, n)), unit, labels)


def times(labels: Sequence[str]) -> NDArray[Any]:
    """Return the places of epochs on an axis: numbers, such as MJD, dates, or else 0, 1, 2 ..."""
    are_dates = all(re.match(r"\d{4}-\d\d-\d\d", label) for label in labels)  # not 03-05
    with contextlib.suppress(ValueError):
        found = np.array(labels).astype("datetime64[s]" if are_dates else np.float64)
        if not (found != found).any():
            return found
    return np.arange(float(len(labels)))


def draw(axis: Axes, curves: LightCurves) -> None:
    """Draw the fluxes of the brightest stars over their mean, with the errors of their changes."""
    is_seen = np.isfinite(curves.fluxes)
    means = np.where(is_seen, curves.fluxes, 0.0).sum(axis=1) / np.maximum(is_seen.sum(axis=1), 1)
    shown = np.sort(np.argsort(-means, kind="stable")[:MOST_STARS])
    epochs = times(curves.labels)
    for i, s in enumerate(shown[means[shown] > 0]):
        flux, error = curves.fluxes[s] / means[s], curves.errors[s] / means[s]
        style = line_style(i) | {"lw": 0.8, "marker": "o", "ms": 3}
        mean = f"{float(f'{means[s]:.4g}'):,.7g}".replace(",", " ")
        label = f"star {s + 1}, mean {mean} {as_text(curves.unit)}"
        axis.errorbar(epochs, flux, np.nan_to_num(error), capsize=2, label=label, **style)
    axis.set_title("light curves, with the errors of the changes", fontsize=9)
    axis.set(xlabel="epoch", ylabel="flux / mean")
    _mark(axis, epochs, curves.labels)
    if axis.containers:
        axis.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    axis.grid(alpha=0.3)


def _mark(axis: Axes, epochs: NDArray[Any], labels: Sequence[str]) -> None:
    """Mark an axis with dates, numbers, or labels, not all where they are many."""
    from matplotlib.dates import AutoDateLocator, ConciseDateFormatter
    from matplotlib.ticker import MaxNLocator

    if epochs.dtype.kind == "M":
        locator = AutoDateLocator(maxticks=8)
        axis.xaxis.set_major_locator(locator)
        axis.xaxis.set_major_formatter(ConciseDateFormatter(locator))
    elif epochs.tolist() == [*range(len(labels))]:
        step = -(-len(labels) // MOST_LABELS)
        axis.set_xticks(epochs[::step], [as_text(label) for label in labels[::step]])
    else:
        axis.xaxis.set_major_locator(MaxNLocator(8))
