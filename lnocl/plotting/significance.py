"""Detections and limits: the map of signal-to-noise, that of limits, and their curves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lnocl.core.scene.arrays import Array
from lnocl.plotting.figure import (
    COLOUR_MAP,
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
        Columns ``x``, ``y`` and ``kind``; and ``star``, ``distance``, ``contrast`` and
        ``contrast_error`` for the curves.
    limit : ndarray of float64, shape (ny, nx), or None
        Flux that is found with a probability of a half.
    curves : mapping of str to array_like, or None
        Columns ``star``, ``distance``, and ``contrast`` with the probabilities, percent; and
        ``separation``, arcsec, where that is known.
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


def draw_significance(view: SignificanceView, n_columns: int = 2) -> Figure:
    """Draw the maps that there are, and the curves of limits, so many in a row at most.

    Raises
    ------
    LnoclError
        matplotlib is missing.
    """
    curves = view.curves or {}
    contrasts = [curves[name] for name in curves if name.startswith("contrast")]
    wanted = {
        _draw_signal: view.signal is not None,
        _draw_limit: view.limit is not None,
        _draw_curves: np.isfinite(contrasts).any(),
    }
    panels = [draw for draw, is_there in wanted.items() if is_there]
    n_columns = min(len(panels), n_columns)
    n_rows = -(-len(panels) // n_columns)
    figure = new_figure(6.2 * n_columns, 4.8 * n_rows)
    for k, draw in enumerate(panels, 1):
        draw(figure.add_subplot(n_rows, n_columns, k), view)
    return figure


def _draw_signal(axis: Axes, view: SignificanceView) -> None:
    from matplotlib.colors import Normalize

    signal, most = np.asarray(view.signal), SHOWN * view.threshold
    n = _draw_map(axis, view, signal, Normalize(-most, most), "RdBu_r", "signal-to-noise")
    what = "points" if not view.width else f"sources {view.width:g} pixels wide"
    title = f"{what}: {n} above {view.threshold:.2f}; grey: not tested; crosses: stars"
    axis.set_title(f"{title}\ncircles: points; squares: perhaps extended", fontsize=9)


def _draw_limit(axis: Axes, view: SignificanceView) -> None:
    from matplotlib.colors import LogNorm
    from matplotlib.ticker import LogLocator, MaxNLocator

    limit = np.asarray(view.limit)
    good = limit[np.isfinite(limit) & (limit > 0)]
    low, high = (good.min(), np.quantile(good, 0.999)) if good.size else (1.0, 10.0)
    norm = LogNorm(low, max(high, 1.01 * low))
    ticks = LogLocator(subs=(1.0, 2.0, 5.0)) if high > 5 * low else MaxNLocator(6)
    _draw_map(axis, view, limit, norm, COLOUR_MAP, f"flux ({as_text(view.unit)})", ticks)
    title = "flux that is found with a probability of 50 %"
    axis.set_title(f"{title}\ngrey: not tested, or a point found; crosses: stars", fontsize=9)


def _draw_curves(axis: Axes, view: SignificanceView) -> None:
    from matplotlib.ticker import LogLocator, NullLocator

    curves = {name: np.asarray(column) for name, column in (view.curves or {}).items()}
    axis.set(xscale="log", yscale="log", ylabel="contrast")
    unit, scale = "pixels", 1.0
    if "separation" in curves:
        unit, scale = "arcsec", curves["separation"][0] / curves["distance"][0]
    levels = [name[8:] for name in curves if name.startswith("contrast")]
    for i, star in enumerate(np.unique(curves["star"])[:MOST_STARS]):
        chosen, colour = curves["star"] == star, COLOURS[i % len(COLOURS)]
        distance = scale * curves["distance"][chosen]
        for k, level in enumerate(levels):
            axis.plot(
                distance, curves[f"contrast{level}"][chosen], lw=1.2, color=colour,
                linestyle=STYLES[k % len(STYLES)],
                label=f"star {star}, {level} %" if not k or not i else None,
            )  # fmt: skip
        _mark_contrasts(axis, view.detections or {}, star, scale, colour)
    nearest = scale * curves["distance"].min()
    label = f"inner working angle: {nearest:.3g} {unit}"
    axis.axvspan(0.8 * nearest, nearest, color="0.85", label=label)
    axis.set(xlabel=f"separation ({unit})", xlim=(0.8 * nearest, None))
    axis.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.xaxis.set_major_formatter("{x:g}")
    axis.xaxis.set_minor_locator(NullLocator())
    axis.grid(alpha=0.3)
    title = f"limits at {view.threshold:.2f} sigma, near a star by Student's t (Mawet et al. 2014)"
    marks = "\ncircles: points found; squares: perhaps extended" if view.detections else ""
    axis.set_title(f"{title}{marks}", fontsize=9)
    axis.legend(fontsize=8)
    right = axis.twinx()
    right.set_ylim(*(-2.5 * np.log10(axis.get_ylim())))
    right.set_ylabel("magnitudes below the star")


def _mark_contrasts(
    axis: Axes, found: Mapping[str, Any], star: int, scale: float, colour: str
) -> None:
    """Mark the detections beside a star that are brighter than nothing, with their errors."""
    names = "distance", "contrast", "contrast_error"
    if "contrast" not in found:  # in files of before
        return
    distance, contrast, error = (np.asarray(found[name], float) for name in names)
    for i in np.flatnonzero((np.asarray(found["star"]) == star) & (contrast > 0)):
        marker = "o" if found["kind"][i] == "point" else "s"
        at = scale * distance[i], contrast[i]
        axis.errorbar(*at, error[i], fmt=marker, ms=6, mec="k", color=colour, ecolor="k", capsize=3)
        if i < MOST_NUMBERED:
            axis.annotate(f"{i + 1}", at, (6, 6), textcoords="offset points", fontsize=8)


def _draw_map(
    axis: Axes, view: SignificanceView, values: Array, norm: Any, colours: str, label: str,
    ticks: Any = None,
) -> int:  # fmt: skip
    """Draw a map and mark its stars and detections; return how many detections it has."""
    shown = show_image(axis, values, norm, extent_of(values.shape, view.oversample), colours)
    beside = axis.inset_axes((1.03, 0.0, 0.05, 1.0))  # as high as the map
    axis.figure.colorbar(shown, cax=beside, label=label, ticks=ticks, format="{x:g}")
    dark = outlined("black", "white")
    for place in view.stars:
        axis.plot(*place, "+", ms=8, mew=1.2, **dark)
    axis.set(xlabel="x (pixels)", ylabel="y (pixels)")
    if view.detections is None:
        return 0
    places = np.array([view.detections["x"], view.detections["y"]], float).T
    is_point = np.asarray(view.detections["kind"]) == "point"
    for chosen, marker in ((is_point, "o"), (~is_point, "s")):
        axis.plot(*places[chosen].T, marker, ms=11, mfc="none", mew=1.2, **dark)
    for i, place in enumerate(places[:MOST_NUMBERED], 1):
        axis.annotate(f"{i}", place, (6, 6), textcoords="offset points", fontsize=9, **dark)
    return len(places)
