"""The errors of a study along each of its axes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from lnocl.plotting.figure import MARKERS, line_style, new_figure, plain_ticks

if TYPE_CHECKING:
    from astropy.table import Table
    from matplotlib.figure import Figure

# What is drawn: column, factor and label.
SHOWN = (
    ("rho_star", 100.0, r"error near the star, $\rho''$ (%)"),
    ("magnitude_error", 1e3, "error of the star (mmag)"),
)


def draw_study(table: Table, axes: Sequence[str]) -> Figure:
    """Draw medians over seeds against each axis that has several numbers, a line a setting.

    Parameters
    ----------
    table : Table
        As `lnocl.studies.study.run` yields it.
    axes : sequence of str
        Its columns that say what was done, the seed among them.

    Returns
    -------
    matplotlib.figure.Figure
        A row of panels an axis; bars from the smallest to the largest of the seeds.

    Raises
    ------
    LnoclError
        matplotlib is missing.
    """
    varied = [name for name in axes if name != "seed" and len(set(table[name])) > 1]
    numbers = [name for name in varied if table[name].dtype.kind in "if"] or ["seed"]
    figure = new_figure(9.5, 3.4 * len(numbers) + 0.2)
    panels = figure.subplots(len(numbers), len(SHOWN), squeeze=False)
    for row, name in zip(panels, numbers, strict=True):
        others = [each for each in varied if each != name]
        settings = sorted({tuple(each) for each in table[others].iterrows()} if others else {()})
        for panel, (column, factor, label) in zip(row, SHOWN, strict=True):
            for i, setting in enumerate(settings):
                is_of_it = np.ones(len(table), bool)
                for other, value in zip(others, setting, strict=True):
                    is_of_it &= table[other] == value
                words = ", ".join(f"{o} {v}" for o, v in zip(others, setting, strict=True))
                _draw_line(panel, table[is_of_it], name, (column, factor), i, words)
            values = np.array(sorted(set(table[name])), float)
            if (values > 0).all() and values.max() >= 10 * values.min():
                panel.set_xscale("log")
            panel.set(xlabel=name.replace("_", " "), ylabel=label)
            if (abs(np.array(table[column], float)) > 0).any():
                panel.set_yscale("log")
                plain_ticks(panel.yaxis)
            panel.grid(alpha=0.3)
        if others:
            row[0].legend(fontsize=7)
    return figure


def _draw_line(
    panel: Any, table: Table, name: str, shown: tuple[str, float], i: int, words: str
) -> None:
    column, factor = shown
    places = sorted(set(table[name]))
    if not places:
        return
    errors = [factor * abs(np.array(table[column][table[name] == place])) for place in places]
    middle = np.array([np.median(each) for each in errors])
    below = middle - [each.min() for each in errors]
    above = [each.max() for each in errors] - middle
    style = line_style(i) | {"marker": MARKERS[i % len(MARKERS)], "markersize": 4, "capsize": 2}
    panel.errorbar(places, middle, yerr=(below, above), label=words, linewidth=1.2, **style)
