"""An image with the stars that were found in it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from lnocl.core.scene.arrays import Array
from lnocl.plotting.figure import COLOURS, Figure, new_figure, outlined, show_image
from lnocl.plotting.result import image_limits

# Stars that are numbered, the brightest; more would hide each other.
MAX_NUMBERED = 200


def draw_stars(image: Array, stars: Mapping[str, Any]) -> Figure:
    """Draw an image with circles round its stars, and the numbers of the brightest 200.

    Parameters
    ----------
    image : ndarray of float64, shape (ny, nx)
        In any linear unit; pixels that are not finite are grey.
    stars : mapping of str to array_like
        Columns ``star`` (numbers), ``x``, ``y`` (pixels), ``peak`` and ``saturated``.

    Returns
    -------
    matplotlib.figure.Figure
        One panel; saturated stars have orange circles.

    Raises
    ------
    LnoclError
        Where matplotlib is missing.
    """
    ny, nx = image.shape
    side = 10.0
    figure = new_figure(side * min(1.0, nx / ny) + 1.0, side * min(1.0, ny / nx) + 0.7)
    from matplotlib.colors import AsinhNorm

    axis = figure.subplots()
    low, high, noise = image_limits(image)
    show_image(axis, image, AsinhNorm(3.0 * noise, low, high), colours="gray_r")
    saturated = np.asarray(stars["saturated"], bool)
    x, y = (np.asarray(stars[name], float) for name in ("x", "y"))
    size = 9 if len(x) <= MAX_NUMBERED else 4
    for chosen, colour in ((~saturated, COLOURS[1]), (saturated, COLOURS[0])):
        axis.plot(x[chosen], y[chosen], "o", ms=size, mfc="none", **outlined(colour, "white"))
    for i in np.argsort(-np.asarray(stars["peak"], float))[:MAX_NUMBERED]:
        axis.annotate(
            f"{stars['star'][i]}", (x[i], y[i]), (4, 4), textcoords="offset points",
            fontsize=7, annotation_clip=True, **outlined(COLOURS[1 - saturated[i]], "white"),
        )  # fmt: skip
    axis.set(xlim=(-0.5, nx - 0.5), ylim=(-0.5, ny - 0.5), xlabel="x (pixels)", ylabel="y (pixels)")
    more = f", the brightest {MAX_NUMBERED} numbered" if len(x) > MAX_NUMBERED else ""
    orange = "; orange: saturated" if saturated.any() else ""
    axis.set_title(f"{len(x)} stars{more}{orange}", fontsize=10)
    return figure
