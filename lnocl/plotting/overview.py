"""Extended sources beside each other, and their flux near the star."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure

from lnocl.plotting.figure import Array, as_text, line_style, new_figure
from lnocl.plotting.result import Region, ResultView, brightest, draw_extended, finer_slices

# Share of the brightest row below which relative errors are not shown, and the largest, percent.
FAINT, MAX_PERCENT = 0.01, 100.0


def draw_beside(views: Mapping[str, ResultView]) -> Figure:
    """Draw the extended sources of several results beside each other, all on one stretch.

    Parameters
    ----------
    views : mapping of str to ResultView
        The results by their names, of images of one shape.

    Returns
    -------
    matplotlib.figure.Figure
        A row for the whole frame, and one for the brightest star of the first result with stars.

    Raises
    ------
    LnoclError
        Where matplotlib is missing.
    """
    regions = [Region("whole frame")]
    if first := next((view for view in views.values() if len(view.stars)), None):
        s = int(np.argmax(first.star_fluxes))
        regions.append(Region(f"star {s + 1}", first.stars[s], first.half()))
    figure = new_figure(max(3.0 * len(views), 6.0), 2.9 * len(regions))
    _draw_rows(figure, views, regions)
    return figure


def draw_overview(
    views: Mapping[str, ResultView], region: Region, profiles: Mapping[str, Array], star: int
) -> Figure:
    """Draw extended sources around the star, and profiles of their flux below.

    Parameters
    ----------
    views : mapping of str to ResultView
        The sources by their names.
    region : Region
        What is shown of them.
    profiles : mapping of str to ndarray of float64, shape (n,)
        The flux of rows from the first that is shown on, by names; the first is the truth.
    star : int
        Row of the star, counted from the first that is shown.

    Returns
    -------
    matplotlib.figure.Figure
        Sources above, flux and its relative error below.

    Raises
    ------
    LnoclError
        Where matplotlib is missing.
    """
    figure = new_figure(3.0 * len(views), 6.2)
    parts: Any = figure.subfigures(2, 1, height_ratios=(1, 1))
    _draw_rows(parts[0], views, [region])
    flux, error = parts[1].subplots(1, 2)
    (_, true), *found = profiles.items()
    y, reference = np.arange(len(true)) - star, np.where(true > FAINT * true.max(), true, np.nan)
    flux.plot(y, true, color="black", lw=2.5, label="truth")
    for i, (name, values) in enumerate(found):
        flux.plot(y, values, **line_style(i), label=as_text(name))
        error.plot(y, 100.0 * (values / reference - 1.0), **line_style(i), marker=".", ms=4)
    flux.set(yscale="log", ylim=(1e-3 * true.max(), 3.0 * true.max()))
    flux.set_title("flux of each row across the jet", fontsize=10)
    flux.legend(fontsize=9)
    error.set_ylim(-MAX_PERCENT, MAX_PERCENT)
    error.set_title("its relative error (%)", fontsize=10)
    for axis in (flux, error):
        axis.axvline(0, color="0.4", lw=1, ls=":")
        axis.set(xlabel="rows from the star", xlim=(y[0], y[-1]))
        axis.grid(alpha=0.3)
    return figure


def _draw_rows(part: Any, views: Mapping[str, ResultView], regions: Sequence[Region]) -> None:
    """Draw a row of panels for each region, on the stretch of the faintest of its sources.

    So a star that is a part of one source does not hide the others.
    """
    axes = part.subplots(len(regions), len(views), squeeze=False)
    for row, region in zip(axes, regions, strict=True):
        there = {
            name: view.extended[finer_slices(region.slices(view.shape), view.oversample)]
            for name, view in views.items()
        }
        top = min((brightest(each) for each in there.values() if each.any()), default=1.0)
        for axis, (name, view) in zip(row, views.items(), strict=True):
            draw_extended(axis, view, region, as_text(name), top)
