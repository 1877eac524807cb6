"""Flux and width profiles along the jet, with their relative errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lnocl import metrics

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

from lnocl.plotting.figure import COLOURS, Array, as_text, line_style, new_figure
from lnocl.plotting.sources import Frame, Source, whole_pixel

# Share of the brightest true row below which relative errors are not shown.
FAINT_ROW = 0.01
# Largest relative error on an axis, percent.
MAX_PERCENT = 100.0


def draw_bands(name: str, flux: Mapping[str, Any], width: Mapping[str, Any], unit: str) -> Figure:
    """Draw light and width along a profile, with the bands that hold the truth.

    Parameters
    ----------
    name : str
        Of the profile.
    flux, width : mapping of str to array_like, shape (k,)
        ``at``, pixels along the axis, ``value``, ``bias``, ``low68``, ``high68``, ``low95`` and
        ``high95``.
    unit : str
        Of the light.

    Returns
    -------
    matplotlib.figure.Figure
        Light above, width below: less the bias a line, as it was found dots, 68 and 95 % bands.

    Raises
    ------
    LnoclError
        Where matplotlib is missing.
    """
    figure = new_figure(8.0, 6.0)
    axes = figure.subplots(2, 1, sharex=True)
    labels = f"light of a slice ({as_text(unit)})", "width (pixels)"
    for axis, rows, label in zip(axes, (flux, width), labels, strict=True):
        at = np.asarray(rows["at"])
        for level, share in ((95, 0.15), (68, 0.3)):
            low, high = rows[f"low{level}"], rows[f"high{level}"]
            axis.fill_between(
                at, low, high, color=COLOURS[1], alpha=share, lw=0, label=f"{level} %"
            )
        unbiased = np.subtract(rows["value"], rows["bias"])
        axis.plot(at, unbiased, color=COLOURS[1], marker="_", label="less the bias")
        axis.plot(at, rows["value"], ".", color="black", ms=3, label="as found")
        axis.set_ylabel(label)
        shown = np.concatenate([rows["low68"], rows["high68"], rows["value"]])
        low, high = min(0.0, float(shown.min())), float(shown.max())
        axis.set_ylim(low, high + 0.2 * (high - low) or 1.0)
        axis.grid(alpha=0.3)
    axes[0].legend(fontsize=9, ncols=4, title=as_text(name))
    axes[1].set_xlabel("position along the axis (pixels)")
    return figure


def draw_profiles(
    kind: str, truth: Source, found: Sequence[Source], frame: Frame, near: int, threshold: float
) -> Figure:
    """Draw the flux or width profile along the jet with relative errors, near the star and beyond.

    Parameters
    ----------
    kind : {"flux", "width"}
        Which profile.
    truth : Source
        The true extended source.
    found : sequence of Source
        Reconstructions.
    frame : Frame
        With a star.
    near : int
        Rows on either side of the star that count as near.
    threshold : float
        Electrons above which a pixel belongs to the jet in the width profile.

    Returns
    -------
    matplotlib.figure.Figure
        Profiles above, relative errors below; near the star left, the rest right.

    Raises
    ------
    LnoclError
        Where matplotlib is missing.
    """
    figure = new_figure(10.0, 6.0)
    axes = figure.subplots(2, 2, sharex="col", height_ratios=(1.3, 1))
    close = rows_near_star(truth, frame, near)
    bright = np.flatnonzero(_bright_rows(truth))
    # At least the last row, where the star's rows reach the edge.
    start = min(close.stop, len(truth.extended) - 1)
    rest = slice(start, max(int(bright[-1]), start) + 1)
    for column, rows, title in ((0, close, "Near the star"), (1, rest, "The rest of the jet")):
        profile, error = axes[:, column]
        draw_rows(profile, error, kind, truth, found, frame, rows, threshold)
        profile.set_title(title, fontsize=10)
        profile.set_xlabel("")
    add_legend(figure, axes[0, 0], found)
    return figure


def add_legend(part: Any, axis: Axes, found: Sequence[Source]) -> None:
    """Add the legend of an axis below a figure or a part of it."""
    masked = any(source.holds_star for source in found)
    lines, labels = axis.get_legend_handles_labels()
    part.legend(
        lines,
        labels,
        loc="outside lower center",
        ncols=min(len(labels), 4),
        fontsize=9,
        title="RLM: without the 3 rows at the star, which is part of it" if masked else None,
        title_fontsize=8,
    )


def rows_near_star(truth: Source, frame: Frame, near: int) -> slice:
    """Return so many rows on either side of the star, inside the image."""
    y = whole_pixel(frame.origin)[1]
    return slice(max(y - near, 0), min(y + near, len(truth.extended)))


def _bright_rows(truth: Source) -> NDArray[np.bool_]:
    flux = metrics.flux_profile(truth.extended)
    return flux >= FAINT_ROW * flux.max()


def draw_rows(
    profile: Axes,
    error: Axes,
    kind: str,
    truth: Source,
    found: Sequence[Source],
    frame: Frame,
    rows: slice,
    threshold: float | None,
) -> None:
    """Draw a profile of these rows, and its relative error where the true row is not faint."""

    def measure(source: Source) -> Array:
        star = whole_pixel(frame.origin) if source.holds_star else None
        if threshold is None or kind == "flux":
            return metrics.flux_profile(source.extended, star)
        return metrics.width_profile(source.extended, threshold, star)

    scale = (frame.pixel_scale or 1.0) if kind == "width" else 1.0
    y = frame.along(len(truth.extended), 1)[rows]
    true = measure(truth)
    reference = np.where(_bright_rows(truth), true, 0.0)
    profile.plot(y, true[rows] * scale, color="black", lw=2.5, label="truth")
    largest = 10.0
    for i, source in enumerate(found):
        values = measure(source)
        percent = 100 * metrics.relative_error(values, reference)[rows]
        profile.plot(y, values[rows] * scale, **line_style(i), label=as_text(source.name))
        error.plot(y, percent, **line_style(i), marker=".", ms=4, label=as_text(source.name))
        largest = max([largest, *np.abs(percent[np.isfinite(percent)])])
    error.set_ylim(*(np.array([-1.1, 1.1]) * min(largest, MAX_PERCENT)))
    error.axhline(0, color="black", lw=1)
    for axis in (profile, error):
        if y[0] <= 0 <= y[-1]:
            axis.axvline(0, color="0.4", lw=1, ls=":")
            axis.annotate(
                "star", (0, 0.97), xycoords=("data", "axes fraction"), rotation=90,
                ha="right", va="top", fontsize=8, color="0.4",
            )  # fmt: skip
        axis.set_xlabel(frame.label("position along the jet"))
        axis.set_xlim(y[0], max(y[-1], y[0] + 1))
        axis.grid(alpha=0.3)
    error.set_ylabel("relative error (%)")
    if kind == "flux":
        profile.set_ylabel("flux per row")
        highest = true[rows].max()
        if highest > 0:
            profile.set(yscale="log", ylim=(highest * 1e-3, highest * 3))
    else:
        profile.set_ylabel(f"width ({frame.unit})")
