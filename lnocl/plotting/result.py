"""A result at a glance: image, model, residuals and extended source, whole and round each star."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lnocl.core.scene.arrays import Array
from lnocl.core.scene.components import CONTINUUM
from lnocl.plotting import light_curves
from lnocl.plotting.figure import (
    COLOUR_MAP,
    MOST_NUMBERED,
    MOST_STARS,
    Axes,
    Figure,
    as_text,
    line_style,
    new_figure,
    outlined,
    show_image,
)
from lnocl.plotting.light_curves import LightCurves

# Residuals are shown between these, in standard deviations of the noise.
MAX_SIGMA = 5.0
# An extended source is shown down to this share of its brightest pixel, nearly logarithmically.
FAINT_SHARE = 3e-3
# So many stars are targets: the first, as those named one by one come before those of a table.
TARGETS = 3
# A ratio of components is shown where both are so many times their noise, and skies and ratios are
# shown up to a number.
ABOVE_NOISE, MOST_SKIES = 3.0, 9
# The share of the pixels of a ratio that are not brighter than the colours show.
BRIGHTEST = 0.98
BLANK = "grey: within noise"
# The one sky that there is without components.
EXTENDED = "extended source"
# The colours of residuals, and of ratios.
NOISE, RATIO = "RdBu_r", "cividis"
# What red lines are.
OUTLINED = "red: perhaps the PSF's error alone"

Columns = Mapping[str, Array]


@dataclass(frozen=True)
class ResultView:
    """What the picture of a result shows.

    Attributes
    ----------
    extended : ndarray of float64
        Extended source: pixels of the images, or finer ones. All light is in one unit.
    stars : sequence of (x, y)
        Positions, pixels of the images.
    star_fluxes : ndarray of float64, shape (n,)
        In any unit.
    n_iter : int
        The iteration of the estimate.
    history : mapping of str to ndarray
        Columns ``iteration`` and ``objective``; empty where it is not known.
    held_out : mapping of str to ndarray
        Columns ``smoothing``, ``iteration`` and ``error``; empty where held-out counts did not
        choose.
    images, models, residuals : ndarray, shape (p, ny, nx)
        As of `lnocl.Result`, NaN where a pixel of the images is bad; p is 0 where they are unknown.
    offsets : ndarray of float64, shape (p, 2)
        Of the images, pixels.
    doubtful : ndarray of bool, shape (ny, nx), or None
        Pixels to outline, where errors of the PSFs may have faked what is there.
    unit : str
        That of the extended source, the images and the models, per pixel of each.
    oversample : int
        Pixels of the extended source to one of the images, along each axis.
    turns : ndarray of float64, shape (p, 2, 2), or None
        Rotations, flips and scales of the images; None where there are none.
    light_curves : LightCurves or None
        Of the stars, where there are several epochs.
    names : sequence of str
        Of the components, where the extended source, and `doubtful`, have a plane for each.
    noise : ndarray of float64, shape (K, ny, nx), or None
        The noise of each component.
    """

    extended: Array
    stars: Sequence[tuple[float, float]]
    star_fluxes: Array
    n_iter: int
    history: Columns
    held_out: Columns
    images: NDArray[Any]
    models: NDArray[Any]
    residuals: NDArray[Any]
    offsets: Array
    doubtful: NDArray[np.bool_] | None = None
    unit: str = "electron"
    oversample: int = 1
    turns: Array | None = None
    light_curves: LightCurves | None = None
    names: Sequence[str] = ()
    noise: Array | None = None

    def place(self, j: int, position: Sequence[float]) -> tuple[float, float]:
        """Return where a position of the sky is in image j."""
        there = np.asarray(position) if self.turns is None else self.turns[j] @ position
        x, y = (there + self.offsets[j]).tolist()
        return x, y

    def offset_at(self, j: int, region: Region) -> tuple[float, float]:
        """Return by how much the middle of a region is moved in image j."""
        middle = region.middle or tuple((n - 1) / 2.0 for n in self.shape[::-1])
        (x, y), (u, v) = self.place(j, middle), middle
        return x - u, y - v

    @property
    def shape(self) -> tuple[int, int]:
        """Shape (ny, nx) of the sky in pixels of the images."""
        ny, nx = self.extended.shape[-2:]
        return ny // self.oversample, nx // self.oversample

    def skies(self) -> dict[str, ResultView]:
        """Return the components as extended sources by their names, or the one that there is."""
        if not self.names:
            return {EXTENDED: self}
        doubtful = [None] * len(self.names) if self.doubtful is None else self.doubtful
        planes = zip(self.names, self.extended, doubtful, strict=True)
        return {
            name: replace(self, extended=sky, doubtful=flags, names=())
            for name, sky, flags in planes
        }

    def ratios(self) -> dict[str, Array]:
        """Return the other components over the continuum, NaN where one is not above noise."""
        if CONTINUUM not in self.names or self.noise is None:
            return {}
        bright = np.where(self.extended > ABOVE_NOISE * self.noise, self.extended, np.nan)
        shown = dict(zip(self.names, bright, strict=True))
        below = shown.pop(CONTINUUM)
        return {f"{name} / {CONTINUUM}": each / below for name, each in shown.items()}

    def zooms(self) -> list[int]:
        """Return the stars to enlarge, in their order: the first, and the brightest of others."""
        is_other = np.arange(len(self.stars)) >= TARGETS
        order = np.lexsort((-np.asarray(self.star_fluxes), is_other))
        return sorted(order[:MOST_STARS].tolist())

    def half(self) -> int:
        """Return half the side of an enlarged region, pixels."""
        return max(16, round(max(self.shape) / 16))


@dataclass(frozen=True)
class Region:
    """A part of the sky.

    Attributes
    ----------
    name : str
        Title of its row.
    middle : (x, y) or None
        Pixels of the sky; None for the whole frame.
    half : int
        Half its side, pixels.
    """

    name: str
    middle: tuple[float, float] | None = None
    half: int = 0

    def slices(self, shape: Sequence[int], offset: Sequence[float] = (0.0, 0.0)) -> Any:
        """Return rows and columns of an image of this shape, in which the sky is offset."""
        if self.middle is None:
            return np.s_[:, :]
        parts = []
        for at, shift, n in zip(self.middle[::-1], offset[::-1], shape, strict=True):
            first = round(at + shift) - self.half
            parts.append(slice(min(max(first, 0), n), min(max(first + 2 * self.half + 1, 0), n)))
        return tuple(parts)


def draw_result(view: ResultView) -> Figure:
    """Draw a result: the whole frame, each star enlarged, and how the iteration was chosen.

    Parameters
    ----------
    view : ResultView
        Without images only the extended source is shown.

    Returns
    -------
    matplotlib.figure.Figure
        A row for the whole frame and one for each of six stars, the first three and the brightest
        of the others: image, model, residuals and extended source. With components there are rows
        for them below, on one stretch, and for their ratios to that called continuum. With several
        images, each row shows that whose residuals are largest there. Below them the errors that
        held-out counts estimate, or else the objective; and light curves of the stars where there
        are several epochs.

    Raises
    ------
    LnoclError
        Where matplotlib is missing.
    """
    stars = view.zooms()
    regions = [Region("whole frame")]
    regions += [Region(f"star {s + 1}", view.stars[s], view.half()) for s in stars]
    has_images = len(view.images) > 0
    n_columns, groups = 3 if view.names else 4, [_panels(view, region) for region in regions]
    if not (has_images or view.names):
        groups = [[panel for group in groups for panel in group]]
    rows = [group[i : i + n_columns] for group in groups for i in range(0, len(group), n_columns)]
    height = 2.7 * len(rows)
    below: list[Any] = [(draw_choice, view), (light_curves.draw, view.light_curves)]
    below = below[: 1 + (view.light_curves is not None)]
    heights = height, *(2.3 for _ in below)
    n_columns = max(map(len, rows))
    figure = new_figure(max(3.0 * n_columns, 6.0), sum(heights) + 0.6)
    parts: Any = figure.subfigures(len(heights), 1, height_ratios=heights)
    axes = parts[0].subplots(len(rows), n_columns, squeeze=False)
    for row, panels in zip(axes, rows, strict=True):
        for axis, panel in zip(row, panels, strict=False):
            panel(axis)
        for axis in row[len(panels) :]:
            axis.set_axis_off()
    for axis in axes[-1]:
        axis.set_xlabel("x (pixels)", fontsize=9)
    for axis in axes[:, 0]:
        axis.set_ylabel("y (pixels)", fontsize=9)
    said = list[str]()
    if len(view.stars) > len(stars):
        said.append(f"enlarged: {len(stars)} of {len(view.stars)} stars")
    if (n_skies := len(view.names) + len(view.ratios())) > MOST_SKIES:
        said.append(f"the first {MOST_SKIES} of {n_skies} components and ratios")
    if said:
        parts[0].suptitle("; ".join(said))
    for part, (draw, what) in zip(parts[1:], below, strict=True):
        draw(part.subplots(), what)
    return figure


def worst_image(view: ResultView, region: Region) -> int:
    """Return the image whose residuals in a region are largest, of those that see it."""
    squares = []
    for j, values in enumerate(view.residuals):
        there = values[region.slices(values.shape, view.offset_at(j, region))]
        good = there[np.isfinite(there)]
        squares.append(float(np.mean(good**2)) if good.size else -1.0)
    return int(np.argmax(squares))


def image_limits(image: NDArray[Any]) -> tuple[float, float, float]:
    """Return the darkest and the brightest level of an image, and the noise of its sky.

    The noise is 1.4826 times the median deviation from the median, or a thousandth of the range
    where that is as small as rounding, as in images of few counts. The darkest level is three
    times that deviation below the median, or the lowest pixel.
    """
    good = image[np.isfinite(image)]
    if not good.size:
        return 0.0, 1.0, 1.0
    middle = float(np.median(good))
    noise = 1.4826 * float(np.median(abs(good - middle)))
    low, high = max(middle - 3 * noise, float(good.min())), float(good.max())
    span = high - low or abs(high) or 1.0
    return low, max(high, low + 1e-6 * span), noise if noise > 1e-6 * span else 1e-3 * span


def brightest(extended: Array) -> float:
    """Return the brightest pixel, or 1 where there is nothing that colours can show."""
    top = float(extended.max(initial=0.0))
    return top if top > np.sqrt(np.finfo(float).tiny) else 1.0


def _panels(view: ResultView, region: Region) -> list[Callable[[Axes], None]]:
    """Return what draws image, model and residuals of a region, then its skies and their ratios."""
    from matplotlib.colors import AsinhNorm, Normalize

    panels = list[Callable[[Axes], None]]()
    if len(view.images):
        j = worst_image(view, region)
        there = region.slices(view.images[j].shape, view.offset_at(j, region))
        low, high, _ = image_limits(view.images[j][there])
        name = "image" if len(view.images) == 1 else f"image {j + 1} of {len(view.images)}"
        norm = AsinhNorm(image_limits(view.images[j])[2], low, high)
        light = norm, COLOUR_MAP, f"{as_text(view.unit)} per pixel"
        noise = Normalize(-MAX_SIGMA, MAX_SIGMA), NOISE, "sigma"
        cubes = (view.images, light), (view.models, light), (view.residuals, noise)
        titles = f"{name}, {region.name}", "model", "residuals / noise"
        stars = [[view.place(j, star) for star in view.stars], (), ()]
        for (cube, how), title, marked in zip(cubes, titles, stars, strict=True):
            panels.append(partial(_draw_panel, cube[j], there, title, how, marked, 1))
    where = "" if panels and not view.names else f", {region.name}"
    skies = view.skies()
    there = finer_slices(region.slices(view.shape), view.oversample)
    top = max(brightest(sky.extended[there]) for sky in skies.values())
    for name, sky in skies.items():
        panels.append(
            partial(draw_extended, view=sky, region=region, title=as_text(name) + where, top=top)
        )
    for name, ratio in view.ratios().items():
        how = Normalize(0.0, highest(ratio[there])), RATIO, as_text(name)
        title = f"{as_text(name)}{where}\n{BLANK}"
        panels.append(partial(_draw_panel, ratio, there, title, how, view.stars, view.oversample))
    return panels[: MOST_SKIES + 3 * (len(view.images) > 0)]


def _draw_panel(
    image: NDArray[Any],
    there: Any,
    title: str,
    how: tuple[Any, str, str],
    stars: Sequence[tuple[float, float]],
    oversample: int,
    axis: Axes,
) -> None:
    """Draw a part of an image with a title, a norm, colours and the label of their bar."""
    norm, colours, label = how
    _add_bar(axis, _draw_region(axis, image, there, norm, colours, oversample), label)
    axis.set_title(title, fontsize=10)
    _mark_stars(axis, stars)


def highest(ratio: Array) -> float:
    """Return the value of a ratio that the brightest colour stands for."""
    known = ratio[np.isfinite(ratio)]
    return float(np.quantile(known, BRIGHTEST)) if known.any() else 1.0


def draw_extended(axis: Axes, view: ResultView, region: Region, title: str, top: float) -> None:
    """Draw a region of the extended source on a stretch up to `top`."""
    from matplotlib.colors import AsinhNorm

    there = finer_slices(region.slices(view.shape), view.oversample)
    norm = AsinhNorm(FAINT_SHARE * top, 0.0, top)
    how = norm, COLOUR_MAP, f"{as_text(view.unit)} per pixel"
    is_doubtful = view.doubtful is not None and view.doubtful[there].any()
    title += f"\n{OUTLINED}" * bool(is_doubtful)
    _draw_panel(view.extended, there, title, how, view.stars, view.oversample, axis)
    if view.doubtful is not None and is_doubtful:
        outline(axis, view.doubtful, there, view.oversample)


def outline(
    axis: Axes, flags: NDArray[np.bool_], there: Any = np.s_[:, :], oversample: int = 1
) -> None:
    """Outline flagged pixels of a part of an image, and leave the limits of the axes.

    The axes may be those of pixels that are `oversample` times as coarse.
    """
    limits = axis.get_xlim(), axis.get_ylim()
    y, x = (
        (np.arange(n)[part] + 0.5) / oversample - 0.5
        for part, n in zip(there, flags.shape, strict=True)
    )
    if min(len(x), len(y)) > 1:  # else there is nothing to draw a line between
        axis.contour(x, y, flags[there], [0.5], colors="red", linewidths=0.8)
    axis.set(xlim=limits[0], ylim=limits[1])


def finer_slices(there: Any, oversample: int) -> Any:
    """Return the rows and columns of a sky so many times as fine."""
    return tuple(
        slice(*(None if at is None else oversample * at for at in (part.start, part.stop)))
        for part in there
    )


def _draw_region(
    axis: Axes, image: NDArray[Any], there: Any, norm: Any, colours: str, oversample: int = 1
) -> Any:
    """Draw a part of an image, on axes of pixels so many times as coarse; bad pixels are grey."""
    # A part alone is drawn, since matplotlib scales all that it is given.
    rows, columns = (part.indices(n) for part, n in zip(there, image.shape, strict=True))
    edges = columns[0], columns[1], rows[0], rows[1]
    left, right, bottom, top = (edge / oversample - 0.5 for edge in edges)
    extent = left, right, bottom, top
    part = image[there]
    if not part.size:
        axis.text(0.5, 0.5, "not in this image", transform=axis.transAxes, ha="center")
        part, extent = np.full((1, 1), np.nan), (-0.5, 0.5, -0.5, 0.5)
    return show_image(axis, part, norm, extent, colours)


def _add_bar(axis: Axes, shown: Any, label: str) -> None:
    """Draw a colour bar as high as its panel, without ticks that would hide each other."""
    bar = axis.figure.colorbar(shown, cax=axis.inset_axes((1.03, 0.0, 0.05, 1.0)))
    spread: list[float] = []
    for value in sorted(bar.get_ticks(), reverse=True):
        share = float(shown.norm(value))
        if 0 <= share <= 1 and (not spread or shown.norm(spread[-1]) - share >= 0.08):
            spread.append(value)
    bar.set_ticks(spread)
    bar.set_label(label, fontsize=8)
    bar.ax.tick_params(labelsize=7)
    axis.tick_params(labelsize=7)


def _mark_stars(axis: Axes, stars: Sequence[tuple[float, float]]) -> None:
    """Circle the stars inside the axes, and number them where they are not too many."""
    (left, right), (bottom, top) = axis.get_xlim(), axis.get_ylim()
    inside = [
        (s, x, y) for s, (x, y) in enumerate(stars, 1) if left <= x <= right and bottom <= y <= top
    ]
    if inside:
        _, x, y = np.transpose(inside)
        for colour, width in (("black", 2.4), ("white", 1.1)):
            axis.plot(x, y, "o", ms=11, mfc="none", mec=colour, mew=width)
    style = {"textcoords": "offset points", "fontsize": 8, **outlined("white", "black")}
    for s, left_of, below in inside if len(inside) <= MOST_NUMBERED else []:
        axis.annotate(f"{s}", (left_of, below), (6, 6), **style)
    axis.set(xlim=(left, right), ylim=(bottom, top))


def draw_choice(axis: Axes, view: ResultView) -> None:
    """Draw the error that held-out counts estimate for each smoothing, or the objective."""
    from matplotlib.ticker import LogFormatter

    if view.held_out and len(view.held_out["iteration"]):
        table = view.held_out
        curves = {
            f"{value:.2g}": (table["smoothing"] == value, 100 * table["error"])
            for value in np.unique(table["smoothing"])
        }
        rule = "the last iteration whose error is within a tenth of the least"
        axis.set_title(f"held-out counts take {rule}", fontsize=9)
        label = "estimated error (%)"
    else:
        table = view.history
        curves = {"": (np.s_[:], table["objective"])} if table else {}
        label = "objective J"
    n_drawn = 0
    for i, (name, (rows, values)) in enumerate(curves.items()):
        x, y = (np.asarray(each, float)[rows] for each in (table["iteration"], values))
        shown = (x > 0) & (y > 0) & np.isfinite(y)  # those that a logarithmic scale has
        n_drawn += int(shown.sum())
        axis.plot(x[shown], y[shown], **line_style(i), label=name)
    if not n_drawn:
        axis.clear()
        axis.set_axis_off()
        return
    if len(curves) > 1 or next(iter(curves)):
        axis.legend(fontsize=8, title="smoothing", title_fontsize=8)
    if view.n_iter > 0:
        axis.axvline(view.n_iter, color="0.4", lw=1, ls=":")
    taken = f" (dotted: {view.n_iter}, the result)" if view.n_iter > 0 else ""
    axis.set(xscale="log", yscale="log", xlabel=f"iteration{taken}")
    for each in (axis.xaxis, axis.yaxis):
        each.set_major_formatter(LogFormatter())
        each.set_minor_formatter(LogFormatter())
    axis.set_ylabel(label, fontsize=9)
    axis.grid(alpha=0.3, which="both")
