"""A frame of a star and the PSFs made from it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lnocl.core.scene.arrays import Array
from lnocl.plotting.figure import COLOURS, Axes, Figure, line_style, new_figure, show_image

# Share of a PSF's peak at which its stretch ends.
PSF_FLOOR = 1e-4


def draw_star_psf(
    frame: Array,
    bad: NDArray[np.bool_],
    centres: Sequence[tuple[float, float]],
    psfs: Sequence[Array],
    angles: Sequence[float],
) -> Figure:
    """Draw a frame of stars, the PSFs made from it, and the PSFs' profiles.

    Parameters
    ----------
    frame : ndarray of float64, shape (ny, nx)
        The frame, its background subtracted.
    bad : ndarray of bool, shape (ny, nx)
        Its bad pixels; drawn in the first colour of the palette.
    centres : sequence of tuple of float
        Each star's (x, y) in the frame, 0-based pixels; the first is drawn, with those near it.
    psfs : sequence of ndarray of float64, shape (k, k)
        The PSFs, centred on ``(k // 2, k // 2)``; a row of the figure each.
    angles : sequence of float
        Degrees by which each was rotated.

    Returns
    -------
    matplotlib.figure.Figure
        Frame and PSF in logarithmic stretch from 1 to `PSF_FLOOR` of the peak of each, the crop
        outlined; rows and columns through the middle.

    Raises
    ------
    LnoclError
        Where matplotlib is missing.
    """
    figure = new_figure(12.5, 4.0 * len(psfs))
    good = np.where(bad, np.nan, frame)
    rows = figure.subplots(len(psfs), 3, squeeze=False)
    for (left, middle, right), psf, angle in zip(rows, psfs, angles, strict=True):
        _draw_frame(left, good, centres[0], len(psf), angle)
        _draw_psf(middle, psf, angle)
        _draw_middle(right, psf)
        for axis in (left, middle):
            axis.set(xlabel="x from the centre (pixels)", ylabel="y from the centre (pixels)")
            axis.plot(0, 0, "+", color="white", ms=9, mew=0.8)
        others = np.reshape(centres[1:], (-1, 2)) - centres[0]
        left.plot(*others.T, "+", color="white", ms=9, mew=0.8, scalex=False, scaley=False)
    return figure


def _draw_frame(
    axis: Axes, good: Array, centre: tuple[float, float], side: int, angle: float
) -> None:
    """Draw a frame, NaN where it is bad, and the crop before it was rotated."""
    low, high = _edges(side)
    y, x = (np.arange(n) - c for n, c in zip(good.shape, centre[::-1], strict=True))
    near = (np.abs(y[:, None]) + np.abs(x) <= side) & np.isfinite(good)
    brightest = good[near].max() if near.any() else 1.0
    _draw_log(axis, good, (x[0] - 0.5, x[-1] + 0.5, y[0] - 0.5, y[-1] + 0.5), brightest)
    corners = np.array([[low, low], [high, low], [high, high], [low, high], [low, low]])
    cosine, sine = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    axis.plot(*(corners @ np.array([[cosine, -sine], [sine, cosine]])).T, color="white", lw=1)
    wide = 0.75 * side
    axis.set(xlim=(max(-wide, x[0]), min(wide, x[-1])), ylim=(max(-wide, y[0]), min(wide, y[-1])))
    axis.set_title("Frame with crop (white) and bad pixels (orange)", fontsize=11)


def _draw_psf(axis: Axes, psf: Array, angle: float) -> None:
    edges = _edges(len(psf))
    shown = _draw_log(axis, psf, (*edges, *edges), psf.max())
    turned = f", rotated by {angle:g} degrees" if angle else ""
    axis.set_title(f"PSF{turned}", fontsize=11)
    axis.figure.colorbar(shown, ax=axis, label="share of the peak", extend="min", pad=0.02)


def _draw_middle(axis: Axes, psf: Array) -> None:
    """Draw row and column of a PSF through its middle."""
    side = len(psf)
    at = np.arange(side) - side // 2
    for i, along in enumerate((psf, psf.T)):
        axis.plot(at, along[side // 2] / psf.max(), **line_style(i), label=f"along {'xy'[i]}")
    axis.set_yscale("symlog", linthresh=PSF_FLOOR)
    axis.axvline(0, color="0.4", lw=1, ls=":")
    axis.set_title("PSF through its centre", fontsize=11)
    axis.set(xlabel="pixels from the centre", ylabel="share of the peak")
    axis.grid(alpha=0.3)
    axis.legend(fontsize=9)


def _edges(side: int) -> tuple[float, float]:
    """Return where an image begins and ends, from the pixel ``side // 2``."""
    first = -(side // 2) - 0.5
    return first, first + side


def _draw_log(
    axis: Axes, image: Array, extent: tuple[float, float, float, float], top: float
) -> Any:
    """Draw an image in logarithmic stretch, negative pixels in the darkest colour."""
    from matplotlib.colors import LogNorm

    shown = (image / top).clip(PSF_FLOOR)
    return show_image(axis, shown, LogNorm(PSF_FLOOR, 1), extent, bad=COLOURS[0])
