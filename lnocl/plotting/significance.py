"""Detections and limits: the map of signal-to-noise, that of limits, and their curves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lnocl.core.scene.arrays import Array
from lnocl.plotting.figure import (
    COLOURS,
    MOST_NUMBERED,
    MOST_STARS,
    STYLES,
    Axes,
    Figure,
    as_text,
    extent_of,
    new_figure,
    outlined,
    show_image,
)

# The map of signal-to-noise is shown up to so many thresholds.
SHOWN = 1.5


@dataclass(frozen=True)
class SignificanceView:
    """What the picture of detections and limits shows.

    Attributes
    ----------
    stars : sequence of (x, y)
        Known stars, pixels of the images.
    oversample : int
        Pixels of the maps to one of the images, along each axis.
    threshold, width : float
        Of signal-to-noise, and of the sources, pixels of the images.
    unit : str
        Of fluxes.
    signal : ndarray of float64, shape (ny, nx), or None
        Signal-to-noise of a source at each place.
    detections : mapping of str to array_like, or None
        Columns ``x``, ``y`` and ``kind``.
    limit : ndarray of float64, shape (ny, nx), or None
        Flux that is found with a probability of a half.
    curves : mapping of str to array_like, or None
        Columns ``star``, ``distance``, and ``magnitudes`` with the probabilities, percent.
    """

    stars: Sequence[tuple[float, float]]
    oversample: int
    threshold: float
    width: float
    unit: str
    signal: Array | None = None
    detections: Mapping[str, Any] | None = None
    limit: Array | None = None
    curves: Mapping[str, Any] | None = None


def draw_significance(view: SignificanceView) -> Figure:
    """Draw the maps that there are, and the curves of limits, two in a row.

    Raises
    ------
    LnoclError
        matplotlib is missing.
    """
    curves = view.curves or {}
    magnitudes = [curves[name] for name in curves if name.startswith("magnitudes")]
    wanted = {
        _draw_signal: view.signal is not None,
        _draw_limit: view.limit is not None,
        _draw_curves: np.isfinite(magnitudes).any(),
    }
    panels = [draw for draw, is_there in wanted.items() if is_there]
    n_rows, n_columns = -(-len(panels) // 2), min(len(panels), 2)
    figure = new_figure(6.2 * n_columns, 4.8 * n_rows)
    for k, draw in enumerate(panels, 1):
        draw(figure.add_subplot(n_rows, n_columns, k), view)
    return figure


def _draw_signal(axis: Axes, view: SignificanceView) -> None:
    from matplotlib.colors import Normalize

    signal, most = np.asarray(view.signal), SHOWN * view.threshold
    extent = extent_of(signal.shape, view.oversample)
    shown = show_image(axis, signal, Normalize(-most, most), extent, "RdBu_r")
    axis.figure.colorbar(shown, ax=axis, label="signal-to-noise")
    _mark_stars(axis, view)
    n = 0
    if view.detections is not None:
        x, y = (np.asarray(view.detections[name], float) for name in "xy")
        is_point = np.asarray(view.detections["kind"]) == "point"
        n = len(x)
        for chosen, marker in ((is_point, "o"), (~is_point, "s")):
            axis.plot(x[chosen], y[chosen], marker, ms=11, mfc="none", mec="k", mew=1.2)
        for i in range(min(n, MOST_NUMBERED)):
            style = {"textcoords": "offset points", "fontsize": 8, **outlined("black", "white")}
            axis.annotate(f"{i + 1}", (x[i], y[i]), (6, 6), **style)
    what = "points" if not view.width else f"sources {view.width:g} pixels wide"
    title = f"{what}: {n} above {view.threshold:.2f}\ncircles: points; squares: perhaps extended"
    axis.set_title(title, fontsize=9)


def _draw_limit(axis: Axes, view: SignificanceView) -> None:
    from matplotlib.colors import LogNorm

    limit = np.asarray(view.limit)
    good = limit[np.isfinite(limit) & (limit > 0)]
    low, high = (good.min(), np.quantile(good, 0.999)) if good.size else (1.0, 10.0)
    norm = LogNorm(low, max(high, 1.01 * low))
    shown = show_image(axis, limit, norm, extent_of(limit.shape, view.oversample))
    axis.figure.colorbar(shown, ax=axis, label=f"flux ({as_text(view.unit)})")
    _mark_stars(axis, view)
    axis.set_title("found with a probability of 50 %", fontsize=9)


def _draw_curves(axis: Axes, view: SignificanceView) -> None:
    from matplotlib.ticker import LogLocator, NullLocator

    curves = view.curves or {}
    stars = np.asarray(curves["star"], int)
    levels = [name[10:] for name in curves if name.startswith("magnitudes")]
    for i, star in enumerate(np.unique(stars)[:MOST_STARS]):
        chosen = stars == star
        distance = np.asarray(curves["distance"], float)[chosen]
        for k, level in enumerate(levels):
            values = np.asarray(curves[f"magnitudes{level}"], float)[chosen]
            label = f"star {star}, {level} %" if not k or not i else None
            axis.plot(
                distance, values, label=label,
                color=COLOURS[i % len(COLOURS)], linestyle=STYLES[k % len(STYLES)], lw=1.2,
            )  # fmt: skip
    axis.set_xlabel("distance from the star (pixels)")
    axis.set_ylabel("limit (magnitudes below the star)")
    axis.invert_yaxis()
    axis.set_xscale("log")
    axis.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.xaxis.set_major_formatter("{x:g}")
    axis.xaxis.set_minor_locator(NullLocator())
    axis.grid(alpha=0.3)
    axis.set_title("limits and the probability of being found", fontsize=9)
    axis.legend(fontsize=8)


def _mark_stars(axis: Axes, view: SignificanceView) -> None:
    for x, y in view.stars:
        axis.plot(x, y, "+", ms=7, mew=1.0, color=COLOURS[4])
    axis.set(xlabel="x (pixels)", ylabel="y (pixels)")
