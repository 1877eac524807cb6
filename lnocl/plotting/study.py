"""The errors of a study along each of its axes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from lnocl.plotting.figure import MARKERS, Array, as_text, line_style, new_figure

if TYPE_CHECKING:
    from astropy.table import Table
    from matplotlib.figure import Figure

# What is drawn: column, factor and label.
SHOWN = (
    ("rho_star", 100.0, r"error near the star, $\rho''$ (%)"),
    ("magnitude_error", 1e3, "error of the star (mmag)"),
)

# Lines of a panel from which on their legend is small.
MANY = 8


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
            _scale(panel.xaxis, np.array(table[name], float), 10.0)
            _scale(panel.yaxis, abs(np.array(table[column], float)), 1.0)
            panel.set(xlabel=as_text(name.replace("_", " ")), ylabel=label)
            panel.grid(alpha=0.3)
        if others:
            small = len(settings) > MANY
            row[1].legend(fontsize=5 if small else 7, ncols=2 if small else 1, framealpha=0.6)
    return figure


def _scale(axis: Any, values: Array, least: float) -> None:
    """Make an axis logarithmic from 0 or the smallest on, where values span a factor."""
    above = values[values > 0]
    if above.size and above.max() >= least * above.min():
        kind = "log" if (values > 0).all() else "symlog"
        more = {} if kind == "log" else {"linthresh": above.min()}
        panel = axis.axes
        (panel.set_xscale if axis is panel.xaxis else panel.set_yscale)(kind, **more)
        axis.set_major_formatter("{x:g}")


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
    panel.errorbar(
        places, middle, yerr=(below, above), label=as_text(words), linewidth=1.2, **style
    )
