"""Light and width along a profile, with their errors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from lnocl.plotting.figure import COLOURS, Axes, Figure, as_text, new_figure

# What lines are.
UNBIASED = "less the bias"


def draw_bands(
    name: str, skies: Mapping[str, tuple[Mapping[str, Any], Mapping[str, Any]]], unit: str
) -> Figure:
    """Draw light and width along a profile, with the bands that hold the truth.

    Parameters
    ----------
    name : str
        Of the profile.
    skies : mapping of str to (mapping, mapping)
        Light and width by the name of a component, which is empty where there is one sky. Each is
        a mapping of str to array_like, shape (k,): ``at``, pixels along the axis, ``value``,
        ``bias``, ``low68``, ``high68``, ``low95`` and ``high95``.
    unit : str
        Of the light.

    Returns
    -------
    matplotlib.figure.Figure
        Light above, width below: less the bias a line, as it was found dots, 68 and 95 % bands; a
        colour for each component.

    Raises
    ------
    LnoclError
        Where matplotlib is missing.
    """
    figure = new_figure(8.0, 6.0)
    axes = figure.subplots(2, 1, sharex=True)
    labels = f"light of a slice ({as_text(unit)})", "width (pixels)"
    for i, (axis, label) in enumerate(zip(axes, labels, strict=True)):
        shown = [np.zeros(1)]
        for k, (sky, quantities) in enumerate(skies.items()):
            _draw_band(axis, quantities[i], as_text(sky), COLOURS[(k + 1) % len(COLOURS)], k == 0)
            shown += [np.asarray(quantities[i][each]) for each in ("low68", "high68", "value")]
        axis.set_ylabel(label)
        low, high = min(map(np.min, shown)), max(map(np.max, shown))
        axis.set_ylim(low, high + 0.2 * (high - low) or 1.0)
        axis.grid(alpha=0.3)
    title = as_text(name) if "" in skies else f"{as_text(name)}, {UNBIASED}"
    axes[0].legend(fontsize=9, ncols=4, title=title)
    axes[1].set_xlabel("position along the axis (pixels)")
    return figure


def _draw_band(
    axis: Axes, rows: Mapping[str, Any], sky: str, colour: str, is_explained: bool
) -> None:
    """Draw a quantity along a profile; the legend has what is drawn once."""
    at = np.asarray(rows["at"])
    for level, share in ((95, 0.15), (68, 0.3)):
        low, high = rows[f"low{level}"], rows[f"high{level}"]
        label = f"{level} %" if is_explained else None
        axis.fill_between(at, low, high, color=colour, alpha=share, lw=0, label=label)
    unbiased = np.subtract(rows["value"], rows["bias"])
    axis.plot(at, unbiased, color=colour, marker="_", label=sky or UNBIASED)
    label = "as found" if is_explained else None
    axis.plot(at, rows["value"], ".", color="black", ms=3, label=label)
