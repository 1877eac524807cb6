"""The extended sources of many targets on one page."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from lnocl.io.saved_results import read_result
from lnocl.plotting.figure import Figure, as_text, extent_of, new_figure, show_image

# Pixels of a picture, along its longer side; more cannot be told apart on a page.
SIDE = 128
# Of the pixels of an extended source, the share that is white.
BRIGHTEST = 0.002


def draw_batch(results: Mapping[str, str]) -> Figure:
    """Draw the extended source of each result, with an asinh stretch of its own, and its stars.

    Parameters
    ----------
    results : mapping of str to str
        The file of each, by its name.

    Returns
    -------
    matplotlib.figure.Figure
        About as wide as it is high.

    Raises
    ------
    LnoclError
        matplotlib is missing.
    """
    from matplotlib.colors import AsinhNorm

    n_columns = max(math.ceil(math.sqrt(len(results))), 1)
    n_rows = max(math.ceil(len(results) / n_columns), 1)
    figure = new_figure(1.3 * n_columns + 0.3, 1.5 * n_rows + 0.3)
    axes = figure.subplots(n_rows, n_columns, squeeze=False).ravel()
    for each in axes:
        each.set_axis_off()
    for each, (name, path) in zip(axes, results.items(), strict=False):
        saved = read_result(path)
        extended = np.hstack([*saved.extended]) if saved.component_names else saved.extended
        ny, nx = extended.shape
        step = max(math.ceil(max(ny, nx) / SIDE), 1)
        top = max(float(np.quantile(extended, 1.0 - BRIGHTEST)), np.finfo(float).tiny)
        norm = AsinhNorm(linear_width=top / 30.0, vmin=0.0, vmax=top)
        show_image(each, extended[::step, ::step], norm, extent_of((ny, nx)))
        for x, y in saved.sky_stars:
            each.plot(x, y, "+", color="white", markersize=4)
        each.set_title(as_text(name), fontsize=6, pad=2)
    return figure
