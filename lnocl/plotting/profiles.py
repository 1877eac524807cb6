"""Light and width along a profile, with their errors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from lnocl.plotting.figure import COLOURS, Figure, as_text, new_figure


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
