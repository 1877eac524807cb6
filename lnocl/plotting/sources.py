"""Extended sources side by side, around the star."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lnocl import metrics

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

from lnocl.plotting.figure import COLOUR_MAP, Array, as_text, new_figure

# Pixels shown around the star: to the left and right, before and beyond it along the jet.
ACROSS, BEFORE, BEYOND = 24, 16, 32
# Share of the brightest true pixel at which the log stretch ends.
LOG_FLOOR = 1e-3


@dataclass(frozen=True)
class Source:
    """An extended source to draw.

    Attributes
    ----------
    name : str
        For titles and legends.
    extended : ndarray of float64, shape (ny, nx)
        Electrons per pixel.
    holds_star : bool
        Whether the star is part of it (RLM) rather than a component of its own (MC-RL).
    note : str
        A line under its name, in titles.
    doubtful : ndarray of bool, shape (ny, nx), or None
        Pixels to outline, where errors of the PSFs may have faked what is there.
    """

    name: str
    extended: Array
    holds_star: bool = False
    note: str = ""
    doubtful: NDArray[np.bool_] | None = None


@dataclass(frozen=True)
class Frame:
    """Position of the star and size of the pixels, for the axes.

    Attributes
    ----------
    star : (x, y) or None
        Pixels, 0-based; without it a figure shows the whole image.
    pixel_scale : float or None
        Mas per pixel; without it axes are in pixels.
    """

    star: tuple[float, float] | None = None
    pixel_scale: float | None = None

    @property
    def unit(self) -> str:
        """Unit of the axes."""
        return "pixels" if self.pixel_scale is None else "mas"

    @property
    def origin(self) -> tuple[float, float]:
        """Position of zero on the axes, pixels."""
        return (0.0, 0.0) if self.star is None else self.star

    def along(self, n: int, axis: int) -> Array:
        """Return the positions of n pixels along an axis (0 for x), in its unit."""
        return np.asarray((np.arange(n) - self.origin[axis]) * (self.pixel_scale or 1.0))

    def label(self, axis: str) -> str:
        """Return the label of an axis."""
        return f"{axis} ({self.unit})" if self.star is None else f"{axis} from star ({self.unit})"


def draw_objects(truth: Source | None, found: Sequence[Source], frame: Frame) -> Figure:
    """Draw the extended sources side by side around the star, in sqrt and in log scale.

    Parameters
    ----------
    truth : Source, optional
        The true one; without it the stretch is that of the brightest reconstruction apart from
        the star.
    found : sequence of Source
        Reconstructions, one or more.
    frame : Frame
        Without a star everything is shown.

    Returns
    -------
    matplotlib.figure.Figure
        Two rows of panels.

    Raises
    ------
    LnoclError
        Where matplotlib is missing.
    """
    shown = [*([] if truth is None else [truth]), *found]
    measured = [truth] if truth is not None else found
    top = max(_top(source, frame) for source in measured)
    figure = new_figure(max(2.6 * len(shown) + 0.8, 4.5), 6.2)
    rows = figure.subplots(2, len(shown), sharex=True, sharey=True, squeeze=False)
    for axes, stretch in zip(rows, ("sqrt", "log"), strict=True):
        draw_panels(figure, axes, shown, top, frame, stretch)
    return figure


def _top(source: Source, frame: Frame) -> float:
    """Return the brightest pixel; a star that is part of the source is left out."""
    if not source.holds_star:
        return float(source.extended.max())
    if frame.star is not None:
        return float(metrics.mask_star(source.extended, whole_pixel(frame.star)).max())
    # Its position is unknown, but a star has few pixels.
    return float(np.percentile(source.extended, 99.9) or source.extended.max())


def whole_pixel(star: tuple[float, float]) -> tuple[int, int]:
    """Return the pixel (x, y) that a position lies in."""
    return round(star[0]), round(star[1])


def draw_panels(
    part: Figure, axes: Sequence[Axes], shown: Sequence[Source], top: float, frame: Frame, name: str
) -> None:
    """Draw the sources on one stretch, which ends at `top`."""
    from matplotlib.colors import LogNorm, PowerNorm
    from matplotlib.ticker import MaxNLocator

    log = name == "log"
    norm = LogNorm(LOG_FLOOR * top, top) if log else PowerNorm(0.5, 0, top)
    last = axes[0].get_subplotspec()
    for axis, source in zip(axes, shown, strict=True):
        ny, nx = source.extended.shape
        x, y = frame.along(nx, 0), frame.along(ny, 1)
        step = (frame.pixel_scale or 1.0) / 2
        picture = axis.imshow(
            source.extended.clip(LOG_FLOOR * top if log else 0.0),
            norm=norm,
            cmap=COLOUR_MAP,
            origin="lower",
            interpolation="nearest",
            extent=(x[0] - step, x[-1] + step, y[0] - step, y[-1] + step),
        )
        title = "\n".join(filter(None, (source.name, source.note)))
        axis.set_title(as_text(title), fontsize=11)
        if source.doubtful is not None and source.doubtful.any():
            axis.contour(x, y, source.doubtful, [0.5], colors="red", linewidths=0.8)
        if last is None or last.is_last_row():
            axis.set_xlabel(frame.label("x"))
        if frame.star is not None:
            scale = frame.pixel_scale or 1.0
            axis.set_xlim(max(-ACROSS * scale, x[0]), min(ACROSS * scale, x[-1]))
            axis.set_ylim(max(-BEFORE * scale, y[0]), min(BEYOND * scale, y[-1]))
            for colour, width in (("black", 3.0), ("white", 1.4)):
                axis.plot(0, 0, "o", ms=13, mfc="none", mec=colour, mew=width)
    axes[0].set_ylabel(frame.label("y"))
    if frame.star is not None:
        axes[0].annotate(
            "star", (0, 0), (12, -12), textcoords="offset points", color="white", fontsize=10
        )
    bar = part.colorbar(
        picture,
        ax=list(axes),
        label=f"flux per pixel, {name}",
        extend="both" if log else "max",
        shrink=0.85,
        pad=0.01,
    )
    if not log:
        bar.locator = MaxNLocator(5)
