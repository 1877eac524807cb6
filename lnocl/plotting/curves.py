"""Errors, magnitudes and costs as curves."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure

from lnocl.plotting.figure import MARKERS, Array, as_text, line_style, new_figure, plain_ticks


def draw_errors(curves: Mapping[str, Mapping[str, Array]]) -> Figure:
    """Draw the restoration errors rho' and rho'' against the iterations.

    Parameters
    ----------
    curves : mapping of str to mapping of str to ndarray
        For each name the columns ``iteration``, ``rho`` and ``rho_star``.

    Returns
    -------
    matplotlib.figure.Figure
        Two panels; dots mark the minima.

    Raises
    ------
    LnoclError
        Where matplotlib is missing.
    """
    figure = new_figure(9.5, 4.0)
    for axis, column, title in zip(
        figure.subplots(1, 2),
        ("rho", "rho_star"),
        (
            r"Restoration error $\rho'$, all rows",
            r"Restoration error $\rho''$, 24 rows around the star",
        ),
        strict=True,
    ):
        for i, (name, curve) in enumerate(curves.items()):
            x, y = curve["iteration"], 100 * curve[column]
            axis.plot(x, y, **line_style(i), label=as_text(name))
            axis.plot(x[y.argmin()], y.min(), "o", ms=6, color=line_style(i)["color"])
        axis.set(xscale="log", yscale="log", xlabel="iteration", ylabel="error (%)")
        axis.set_title(title, fontsize=10)
        plain_ticks(axis.yaxis)
        axis.grid(alpha=0.3)
        axis.legend(fontsize=9, title="dot: smallest", title_fontsize=8)
    return figure


def draw_magnitudes(curves: Mapping[str, Mapping[str, Array]], true: float | None) -> Figure:
    """Draw the magnitude of the star against the iterations.

    Parameters
    ----------
    curves : mapping of str to mapping of str to ndarray
        For each name the columns ``iteration`` and ``magnitude``.
    true : float, optional
        The true magnitude.

    Returns
    -------
    matplotlib.figure.Figure
        One panel, bright upwards.

    Raises
    ------
    LnoclError
        Where matplotlib is missing.
    """
    figure = new_figure(6.5, 4.0)
    axis = figure.subplots()
    if true is not None:
        axis.axhline(true, color="black", lw=1, label="truth")
    for i, (name, curve) in enumerate(curves.items()):
        axis.plot(curve["iteration"], curve["magnitude"], **line_style(i), label=as_text(name))
    axis.set(xscale="log", xlabel="iteration", ylabel="star (mag)")
    axis.ticklabel_format(axis="y", useOffset=False)
    axis.invert_yaxis()
    axis.grid(alpha=0.3)
    axis.legend(fontsize=9)
    return figure


def draw_costs(settings: Mapping[str, Mapping[str, NDArray]], measure: str) -> Figure:
    """Draw the deviation of settings from a reference against their time.

    Parameters
    ----------
    settings : mapping of str to mapping of str to ndarray
        For each name the columns ``seconds``, ``deviation`` (relative) and ``front`` (whether
        nothing is both faster and closer).
    measure : str
        Name of the deviation, for the axis.

    Returns
    -------
    matplotlib.figure.Figure
        One panel, both axes logarithmic; a line joins the front. A deviation of 0, such as that
        of the reference, has no place on the axis: a dotted line marks its time.

    Raises
    ------
    LnoclError
        Where matplotlib is missing.
    """
    figure = new_figure(6.5, 4.5)
    axis = figure.subplots()
    seconds, deviation, front = (
        np.concatenate([columns[name] for columns in settings.values()])
        for name in ("seconds", "deviation", "front")
    )
    joined = np.flatnonzero(front.astype(bool) & (deviation > 0))
    joined = joined[np.argsort(seconds[joined])]
    axis.plot(seconds[joined], deviation[joined], color="0.6", lw=4, alpha=0.5, label="front")
    for i, (name, columns) in enumerate(settings.items()):
        shown = columns["deviation"] > 0
        axis.plot(
            columns["seconds"][shown],
            columns["deviation"][shown],
            MARKERS[i % len(MARKERS)],
            color=line_style(i)["color"],
            label=as_text(name),
        )
    for time in seconds[deviation == 0]:
        axis.axvline(time, color="black", lw=1, ls=":", label="reference (deviation 0)")
    axis.set(xscale="log", yscale="log", xlabel="time (s)", ylabel=f"deviation, {measure}")
    axis.grid(alpha=0.3)
    axis.legend(fontsize=9)
    return figure
