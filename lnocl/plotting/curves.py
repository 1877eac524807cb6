"""Costs as curves."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure

from lnocl.plotting.figure import line_style, new_figure
from lnocl.scene.arrays import Array


def draw_costs(settings: Mapping[str, tuple[Array, Array]], measure: str) -> Figure:
    """Draw the deviation of settings from a reference against their time.

    Parameters
    ----------
    settings : mapping of str to (ndarray, ndarray)
        Seconds and relative deviations of each name. A deviation of 0, such as that of the
        reference, has no place on the axis.
    measure : str
        Name of the deviation, for the axis.

    Returns
    -------
    matplotlib.figure.Figure
        One panel, both axes logarithmic.

    Raises
    ------
    LnoclError
        Where matplotlib is missing.
    """
    figure = new_figure(6.5, 4.5)
    axis = figure.subplots()
    for i, (name, (seconds, deviation)) in enumerate(settings.items()):
        shown = deviation > 0
        axis.plot(seconds[shown], deviation[shown], **line_style(i), marker="o", label=name)
    axis.set(xscale="log", yscale="log", xlabel="time (s)", ylabel=f"deviation, {measure}")
    axis.grid(alpha=0.3)
    axis.legend(fontsize=9)
    return figure
