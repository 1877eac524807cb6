"""Truth, image and reconstructions in one figure, with the flux near the star."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure

from lnocl.plotting.figure import new_figure
from lnocl.plotting.profiles import add_legend, draw_rows, rows_near_star
from lnocl.plotting.sources import Frame, Source, draw_panels


def draw_overview(
    truth: Source, image: Source, found: Sequence[Source], frame: Frame, near: int
) -> Figure:
    """Draw truth, image and reconstructions around the star, and the flux near it below.

    Parameters
    ----------
    truth, image : Source
        The true extended source, and one of the images, its sky subtracted.
    found : sequence of Source
        Reconstructions.
    frame : Frame
        With a star.
    near : int
        Rows on either side of the star for the profiles.

    Returns
    -------
    matplotlib.figure.Figure
        Objects above, flux profile and its relative error below.

    Raises
    ------
    LnoclError
        Where matplotlib is missing.
    """
    shown = [truth, image, *found]
    figure = new_figure(2.75 * len(shown), 7.0)
    parts: Any = figure.subfigures(2, 1, height_ratios=(1.2, 1))
    above, below = parts
    axes = above.subplots(1, len(shown), sharey=True, squeeze=False)[0]
    draw_panels(above, axes, shown, truth.extended.max(), frame, "log")
    profile, error = below.subplots(1, 2)
    draw_rows(profile, error, "flux", truth, found, frame, rows_near_star(truth, frame, near), None)
    profile.set_title("Flux of each row across the jet", fontsize=11)
    error.set_title("Its relative error", fontsize=11)
    add_legend(below, profile, found)
    return figure
