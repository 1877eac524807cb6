"""The paper's figures: objects, restoration errors, star magnitude, profiles along the jet.

The figures are those of La Camera et al. (2012), Fig. 2 to 7. Every function returns a figure and
leaves matplotlib's state alone; matplotlib is imported when the first one is drawn.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lnocl import metrics
from lnocl.errors import LnoclError
from lnocl.io.atomic import whole_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

DPI = 110
# The palette of M. Okabe and K. Ito, "Color Universal Design" (2008), for all kinds of sight.
COLOURS = ("#D55E00", "#0072B2", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
STYLES = ("-", "--", "-.", ":")
MARKERS = ("o", "s", "^", "D")
COLOUR_MAP = "viridis"

# Pixels shown around the star: to the left and right, before and beyond it along the jet.
ACROSS, BEFORE, BEYOND = 24, 16, 32
# Share of the brightest true pixel at which the log stretch ends.
LOG_FLOOR = 1e-3
# Share of a PSF's peak at which its stretch ends.
PSF_FLOOR = 1e-4
# Share of the brightest true row below which a row has no relative error worth showing.
FAINT_ROW = 0.01
# Largest relative error that an axis makes room for, percent.
MAX_PERCENT = 100.0


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
    """

    name: str
    extended: Array
    holds_star: bool = False
    note: str = ""


@dataclass(frozen=True)
class Frame:
    """Where the star is and how large the pixels are.

    Attributes
    ----------
    star : (x, y) or None
        Pixels, 0-based; without it a figure shows all there is.
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
        """Where the axes are zero, pixels."""
        return (0.0, 0.0) if self.star is None else self.star

    def along(self, n: int, axis: int) -> Array:
        """Return the positions of n pixels along an axis (0 for x), in its unit."""
        return np.asarray((np.arange(n) - self.origin[axis]) * (self.pixel_scale or 1.0))

    def label(self, axis: str) -> str:
        """Return the label of an axis."""
        return f"{axis} ({self.unit})" if self.star is None else f"{axis} from star ({self.unit})"


def check() -> None:
    """Check that figures can be drawn.

    Raises
    ------
    LnoclError
        Where matplotlib is missing.
    """
    try:
        import matplotlib  # noqa: F401
    except ImportError:
        raise LnoclError(
            "pictures need matplotlib, which is not installed: pip install 'lnocl[plot]'"
        ) from None


def save(figure: Figure, path: str, overwrite: bool = False) -> None:
    """Write a figure as PNG: the file is there complete, or not at all.

    Parameters
    ----------
    figure : matplotlib.figure.Figure
        One of those that the functions here return.
    path : str
        File to write.
    overwrite : bool, optional
        Whether an existing file may be replaced.

    Raises
    ------
    FileError
        The file cannot be written, or exists and must not be overwritten.
    """
    with whole_file(path, overwrite) as stream:
        figure.savefig(stream, format="png", dpi=DPI, pil_kwargs={"optimize": True})


def overview(
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
    figure = _figure(2.75 * len(shown), 7.0)
    parts: Any = figure.subfigures(2, 1, height_ratios=(1.2, 1))
    above, below = parts
    axes = above.subplots(1, len(shown), sharey=True, squeeze=False)[0]
    _draw_objects(above, axes, shown, truth.extended.max(), frame, "log")
    profile, error = below.subplots(1, 2)
    _draw_profile(profile, error, "flux", truth, found, frame, _near(truth, frame, near), None)
    profile.set_title("Flux of each row across the jet", fontsize=11)
    error.set_title("Its relative error", fontsize=11)
    _legend_of_profiles(below, profile, found)
    return figure


def objects(truth: Source | None, found: Sequence[Source], frame: Frame) -> Figure:
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
    figure = _figure(max(2.6 * len(shown) + 0.8, 4.5), 6.2)
    rows = figure.subplots(2, len(shown), sharex=True, sharey=True, squeeze=False)
    for axes, stretch in zip(rows, ("sqrt", "log"), strict=True):
        _draw_objects(figure, axes, shown, top, frame, stretch)
    return figure


def errors(curves: Mapping[str, Mapping[str, Array]]) -> Figure:
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
    figure = _figure(9.5, 4.0)
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
            axis.plot(x, y, **_line(i), label=name)
            axis.plot(x[y.argmin()], y.min(), "o", ms=6, color=_line(i)["color"])
        axis.set(xscale="log", yscale="log", xlabel="iteration", ylabel="error (%)")
        axis.set_title(title, fontsize=10)
        _plain_ticks(axis.yaxis)
        axis.grid(alpha=0.3)
        axis.legend(fontsize=9, title="dot: smallest", title_fontsize=8)
    return figure


def magnitudes(curves: Mapping[str, Mapping[str, Array]], true: float | None) -> Figure:
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
    figure = _figure(6.5, 4.0)
    axis = figure.subplots()
    if true is not None:
        axis.axhline(true, color="black", lw=1, label="truth")
    for i, (name, curve) in enumerate(curves.items()):
        axis.plot(curve["iteration"], curve["magnitude"], **_line(i), label=name)
    axis.set(xscale="log", xlabel="iteration", ylabel="star (mag)")
    axis.ticklabel_format(axis="y", useOffset=False)
    axis.invert_yaxis()
    axis.grid(alpha=0.3)
    axis.legend(fontsize=9)
    return figure


def objectives(histories: Mapping[str, Mapping[str, Array]]) -> Figure:
    """Draw the objective against the iterations, above the smallest one of each.

    Parameters
    ----------
    histories : mapping of str to mapping of str to ndarray
        For each name the columns ``iteration`` and ``objective``.

    Returns
    -------
    matplotlib.figure.Figure
        One panel.

    Raises
    ------
    LnoclError
        Where matplotlib is missing.
    """
    figure = _figure(6.5, 4.0)
    axis = figure.subplots()
    for i, (name, history) in enumerate(histories.items()):
        later = history["iteration"] > 0
        axis.plot(history["iteration"][later], history["objective"][later], **_line(i), label=name)
    axis.set(xscale="log", yscale="log", xlabel="iteration", ylabel="objective J")
    axis.grid(alpha=0.3)
    axis.legend(fontsize=9)
    return figure


def held_out_errors(tables: Mapping[str, Mapping[str, Array]]) -> Figure:
    """Draw the errors that held-out counts estimate, a line for each penalty.

    Parameters
    ----------
    tables : mapping of str to mapping of str to ndarray
        For each name the columns ``mu``, ``smoothing``, ``iteration`` and ``error``.

    Returns
    -------
    matplotlib.figure.Figure
        A panel for each name.

    Raises
    ------
    LnoclError
        Where matplotlib is missing.
    """
    figure = _figure(6.5 * len(tables), 4.0)
    panels = figure.subplots(1, len(tables), squeeze=False)[0]
    for axis, (name, table) in zip(panels, tables.items(), strict=True):
        varied = max(("mu", "smoothing"), key=lambda weight: len(np.unique(table[weight])))
        for i, value in enumerate(np.unique(table[varied])):
            rows = table[varied] == value
            axis.plot(
                table["iteration"][rows], table["error"][rows], **_line(i), label=f"{value:.2g}"
            )
        axis.set(xscale="log", yscale="log", xlabel="iteration", ylabel="estimated relative error")
        axis.set_title(name, fontsize=10)
        axis.grid(alpha=0.3, which="both")
        axis.legend(fontsize=9, title=varied)
    return figure


def profiles(
    kind: str, truth: Source, found: Sequence[Source], frame: Frame, near: int, threshold: float
) -> Figure:
    """Draw the flux or width profile along the jet with relative errors, near the star and beyond.

    Parameters
    ----------
    kind : {"flux", "width"}
        Which profile.
    truth : Source
        The true extended source.
    found : sequence of Source
        Reconstructions.
    frame : Frame
        With a star.
    near : int
        Rows on either side of the star that count as near.
    threshold : float
        Electrons above which a pixel belongs to the jet in the width profile.

    Returns
    -------
    matplotlib.figure.Figure
        Profiles above, relative errors below; near the star left, the rest right.

    Raises
    ------
    LnoclError
        Where matplotlib is missing.
    """
    figure = _figure(10.0, 6.0)
    axes = figure.subplots(2, 2, sharex="col", height_ratios=(1.3, 1))
    close = _near(truth, frame, near)
    bright = np.flatnonzero(_bright_rows(truth))
    # The last row at least, also where the star's rows reach the edge.
    start = min(close.stop, len(truth.extended) - 1)
    rest = slice(start, max(int(bright[-1]), start) + 1)
    for column, rows, title in ((0, close, "Near the star"), (1, rest, "The rest of the jet")):
        profile, error = axes[:, column]
        _draw_profile(profile, error, kind, truth, found, frame, rows, threshold)
        profile.set_title(title, fontsize=10)
        profile.set_xlabel("")
    _legend_of_profiles(figure, axes[0, 0], found)
    return figure


def costs(settings: Mapping[str, Mapping[str, NDArray]], measure: str) -> Figure:
    """Draw what settings deviate from a reference against the time they take.

    Parameters
    ----------
    settings : mapping of str to mapping of str to ndarray
        For each name the columns ``seconds``, ``deviation`` (relative) and ``front`` (whether
        nothing is both faster and closer).
    measure : str
        What deviates, for the axis.

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
    figure = _figure(6.5, 4.5)
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
            color=_line(i)["color"],
            label=name,
        )
    for time in seconds[deviation == 0]:
        axis.axvline(time, color="black", lw=1, ls=":", label="reference (deviation 0)")
    axis.set(xscale="log", yscale="log", xlabel="time (s)", ylabel=f"deviation, {measure}")
    axis.grid(alpha=0.3)
    axis.legend(fontsize=9)
    return figure


def star_psf(
    frame: Array,
    bad: NDArray[np.bool_],
    centre: tuple[float, float],
    psfs: Sequence[Array],
    angles: Sequence[float],
) -> Figure:
    """Draw a frame of a star, the PSFs made from it, and the PSFs' profiles.

    Parameters
    ----------
    frame : ndarray of float64, shape (ny, nx)
        The frame, its background subtracted.
    bad : ndarray of bool, shape (ny, nx)
        Its bad pixels; drawn in the first colour of the palette.
    centre : tuple of float
        The star's (x, y) in the frame, 0-based pixels.
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
    figure = _figure(12.5, 4.0 * len(psfs))
    seen = np.where(bad, np.nan, frame)
    rows = figure.subplots(len(psfs), 3, squeeze=False)
    for (left, middle, right), psf, angle in zip(rows, psfs, angles, strict=True):
        _draw_frame(left, seen, centre, len(psf), angle)
        _draw_psf(middle, psf, angle)
        _draw_middle(right, psf)
        for axis in (left, middle):
            axis.set(xlabel="x from the centre (pixels)", ylabel="y (pixels)")
            axis.plot(0, 0, "+", color="white", ms=9, mew=0.8)
    return figure


def _draw_frame(
    axis: Axes, seen: Array, centre: tuple[float, float], side: int, angle: float
) -> None:
    """Draw a frame, NaN where it is bad, and the crop before it was rotated."""
    low, high = _edges(side)
    y, x = (np.arange(n) - c for n, c in zip(seen.shape, centre[::-1], strict=True))
    near = (np.abs(y[:, None]) + np.abs(x) <= side) & np.isfinite(seen)
    brightest = seen[near].max() if near.any() else 1.0
    _draw_log(axis, seen, (x[0] - 0.5, x[-1] + 0.5, y[0] - 0.5, y[-1] + 0.5), brightest)
    corners = np.array([[low, low], [high, low], [high, high], [low, high], [low, low]])
    cosine, sine = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    axis.plot(*(corners @ np.array([[cosine, -sine], [sine, cosine]])).T, color="white", lw=1)
    wide = 0.75 * side
    axis.set(xlim=(max(-wide, x[0]), min(wide, x[-1])), ylim=(max(-wide, y[0]), min(wide, y[-1])))
    axis.set_title("Frame, bad pixels coloured, and crop", fontsize=11)


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
    for i, (values, name) in enumerate(
        ((psf[side // 2], "along x"), (psf[:, side // 2], "along y"))
    ):
        axis.plot(at, values / psf.max(), **_line(i), label=name)
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
    """Draw an image in logarithmic stretch, what is negative as the darkest."""
    from matplotlib import colormaps
    from matplotlib.colors import LogNorm

    colours = colormaps[COLOUR_MAP].with_extremes(bad=COLOURS[0])
    return axis.imshow(
        (image / top).clip(PSF_FLOOR),
        norm=LogNorm(PSF_FLOOR, 1),
        cmap=colours,
        origin="lower",
        interpolation="nearest",
        extent=extent,
    )


def _figure(width: float, height: float) -> Figure:
    check()
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _line(i: int) -> dict[str, Any]:
    return {"color": COLOURS[i % len(COLOURS)], "linestyle": STYLES[i % len(STYLES)]}


def _plain_ticks(axis: Any) -> None:
    """Label a short logarithmic axis with plain numbers."""
    from matplotlib.ticker import LogLocator, NullFormatter, ScalarFormatter

    axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.set_major_formatter(ScalarFormatter())
    axis.set_minor_formatter(NullFormatter())


def _top(source: Source, frame: Frame) -> float:
    """Return the brightest pixel apart from the star, where one is in the source."""
    if not source.holds_star:
        return float(source.extended.max())
    if frame.star is not None:
        return float(metrics.mask_star(source.extended, _whole(frame.star)).max())
    # Nobody knows where it is; a star is few pixels.
    return float(np.percentile(source.extended, 99.9) or source.extended.max())


def _whole(star: tuple[float, float]) -> tuple[int, int]:
    return round(star[0]), round(star[1])


def _draw_objects(
    part: Figure, axes: Sequence[Axes], shown: Sequence[Source], top: float, frame: Frame, name: str
) -> None:
    """Draw the sources on one stretch, which ends at the brightest true pixel."""
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
        axis.set_title("\n".join(filter(None, (source.name, source.note))), fontsize=11)
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
        label=f"electrons per pixel, {name}",
        extend="both" if log else "max",
        shrink=0.85,
        pad=0.01,
    )
    if not log:
        bar.locator = MaxNLocator(5)


def _legend_of_profiles(part: Any, axis: Axes, found: Sequence[Source]) -> None:
    masked = any(source.holds_star for source in found)
    lines, labels = axis.get_legend_handles_labels()
    part.legend(
        lines,
        labels,
        loc="outside lower center",
        ncols=min(len(labels), 4),
        fontsize=9,
        title="RLM without the 3 rows at the star, which it holds" if masked else None,
        title_fontsize=8,
    )


def _near(truth: Source, frame: Frame, near: int) -> slice:
    y = _whole(frame.origin)[1]
    return slice(max(y - near, 0), min(y + near, len(truth.extended)))


def _bright_rows(truth: Source) -> NDArray[np.bool_]:
    flux = metrics.flux_profile(truth.extended)
    return flux >= FAINT_ROW * flux.max()


def _draw_profile(
    profile: Axes,
    error: Axes,
    kind: str,
    truth: Source,
    found: Sequence[Source],
    frame: Frame,
    rows: slice,
    threshold: float | None,
) -> None:
    """Draw a profile of these rows, and its relative error where the true row is not faint."""

    def measure(source: Source) -> Array:
        star = _whole(frame.origin) if source.holds_star else None
        if threshold is None or kind == "flux":
            return metrics.flux_profile(source.extended, star)
        return metrics.width_profile(source.extended, threshold, star)

    scale = (frame.pixel_scale or 1.0) if kind == "width" else 1.0
    y = frame.along(len(truth.extended), 1)[rows]
    true = measure(truth)
    reference = np.where(_bright_rows(truth), true, 0.0)
    profile.plot(y, true[rows] * scale, color="black", lw=2.5, label="truth")
    largest = 10.0
    for i, source in enumerate(found):
        values = measure(source)
        percent = 100 * metrics.relative_error(values, reference)[rows]
        profile.plot(y, values[rows] * scale, **_line(i), label=source.name)
        error.plot(y, percent, **_line(i), marker=".", ms=4, label=source.name)
        largest = max([largest, *np.abs(percent[np.isfinite(percent)])])
    error.set_ylim(*(np.array([-1.1, 1.1]) * min(largest, MAX_PERCENT)))
    error.axhline(0, color="black", lw=1)
    for axis in (profile, error):
        if y[0] <= 0 <= y[-1]:
            axis.axvline(0, color="0.4", lw=1, ls=":")
            axis.annotate(
                "star", (0, 0.97), xycoords=("data", "axes fraction"), rotation=90,
                ha="right", va="top", fontsize=8, color="0.4",
            )  # fmt: skip
        axis.set_xlabel(frame.label("position along the jet"))
        axis.set_xlim(y[0], max(y[-1], y[0] + 1))
        axis.grid(alpha=0.3)
    error.set_ylabel("relative error (%)")
    if kind == "flux":
        profile.set_ylabel("electrons per row")
        highest = true[rows].max()
        if highest > 0:
            profile.set(yscale="log", ylim=(highest * 1e-3, highest * 3))
    else:
        profile.set_ylabel(f"width ({frame.unit})")
