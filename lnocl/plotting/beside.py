"""Extended sources beside each other."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from lnocl.plotting.figure import Figure, as_text, new_figure
from lnocl.plotting.result import Region, ResultView, brightest, draw_extended, finer_slices


def draw_beside(views: Mapping[str, ResultView]) -> Figure:
    """Draw the extended sources of several results beside each other, on one stretch for a unit.

    It is that of the faintest, so that a star which is a part of one does not hide the others.

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
        s = int(np.argmax(np.nan_to_num(first.star_fluxes)))
        regions.append(Region(f"star {s + 1}", first.stars[s], first.half()))
    figure = new_figure(max(3.0 * len(views), 6.0), 2.9 * len(regions))
    axes = figure.subplots(len(regions), len(views), squeeze=False)
    for row, region in zip(axes, regions, strict=True):
        tops: dict[str, float] = {}
        for view in views.values():
            there = view.extended[finer_slices(region.slices(view.shape), view.oversample)]
            if there.any():
                tops[view.unit] = min(brightest(there), tops.get(view.unit, np.inf))
        for axis, (name, view) in zip(row, views.items(), strict=True):
            draw_extended(axis, view, region, as_text(name), tops.get(view.unit, 1.0))
    return figure
