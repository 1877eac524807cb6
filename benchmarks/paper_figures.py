"""The paper's figures, La Camera et al. (2012), Fig. 2 to 7: jets, errors and profiles."""

from dataclasses import dataclass

import numpy as np
from experiment import NEAR_STAR, relative_error, width_profile, width_threshold
from matplotlib.colors import LogNorm, PowerNorm
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter, ScalarFormatter

from lnocl import metrics
from lnocl.plotting.figure import COLOUR_MAP, line_style, new_figure

# Pixels shown around the star: to the left and right, before and beyond it along the jet.
ACROSS, BEFORE, BEYOND = 24, 16, 32
# Share of the brightest true pixel at which the log stretch ends.
LOG_FLOOR = 1e-3
# Share of the brightest true row below which relative errors are not shown.
FAINT_ROW = 0.01
# Largest relative error on an axis, percent.
MAX_PERCENT = 100.0


@dataclass(frozen=True)
class Source:
    """An extended source to draw; for RLM it holds the star."""

    name: str
    extended: np.ndarray
    holds_star: bool = False


def draw_objects(truth, found, star, scale):
    """Draw the sources side by side around the star, in sqrt and in log scale of the truth.

    Parameters
    ----------
    truth : Source
        The true jet.
    found : sequence of Source
        Reconstructions.
    star : (x, y)
        Pixels.
    scale : float
        Mas per pixel.
    """
    shown, top = [truth, *found], truth.extended.max()
    figure = new_figure(2.6 * len(shown) + 0.8, 6.2)
    rows = figure.subplots(2, len(shown), sharex=True, sharey=True, squeeze=False)
    for axes, name in zip(rows, ("sqrt", "log"), strict=True):
        is_log = name == "log"
        norm = LogNorm(LOG_FLOOR * top, top) if is_log else PowerNorm(0.5, 0, top)
        for axis, source in zip(axes, shown, strict=True):
            ny, nx = source.extended.shape
            left, right = scale * (-0.5 - star[0]), scale * (nx - 0.5 - star[0])
            bottom, upper = scale * (-0.5 - star[1]), scale * (ny - 0.5 - star[1])
            picture = axis.imshow(
                source.extended.clip(LOG_FLOOR * top if is_log else 0.0),
                norm=norm,
                cmap=COLOUR_MAP,
                origin="lower",
                interpolation="nearest",
                extent=(left, right, bottom, upper),
            )
            axis.set_title(source.name, fontsize=11)
            if is_log:
                axis.set_xlabel("x from star (mas)")
            axis.set_xlim(max(-ACROSS * scale, left), min(ACROSS * scale, right))
            axis.set_ylim(max(-BEFORE * scale, bottom), min(BEYOND * scale, upper))
            for colour, width in (("black", 3.0), ("white", 1.4)):
                axis.plot(0, 0, "o", ms=13, mfc="none", mec=colour, mew=width)
        axes[0].set_ylabel("y from star (mas)")
        axes[0].annotate(
            "star", (0, 0), (12, -12), textcoords="offset points", color="white", fontsize=10
        )
        extend = "both" if is_log else "max"
        label = f"flux per pixel, {name}"
        bar = figure.colorbar(
            picture, ax=list(axes), label=label, extend=extend, shrink=0.85, pad=0.01
        )
        if not is_log:
            bar.locator = MaxNLocator(5)
    return figure


def draw_errors(curves):
    """Draw rho' and rho'' of each name against the iterations; dots mark the minima."""
    figure = new_figure(9.5, 4.0)
    titles = {
        "rho": r"Restoration error $\rho'$, all rows",
        "rho_star": r"Restoration error $\rho''$, 24 rows around the star",
    }
    for axis, (column, title) in zip(figure.subplots(1, 2), titles.items(), strict=True):
        for i, (name, curve) in enumerate(curves.items()):
            x, y = curve["iteration"], 100 * curve[column]
            axis.plot(x, y, **line_style(i), label=name)
            axis.plot(x[y.argmin()], y.min(), "o", ms=6, color=line_style(i)["color"])
        axis.set(xscale="log", yscale="log", xlabel="iteration", ylabel="error (%)")
        axis.set_title(title, fontsize=10)
        axis.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.yaxis.set_major_formatter(ScalarFormatter())
        axis.yaxis.set_minor_formatter(NullFormatter())
        axis.grid(alpha=0.3)
        axis.legend(fontsize=9, title="dot: smallest", title_fontsize=8)
    return figure


def draw_magnitudes(curves, true):
    """Draw the magnitude of the star against the iterations, bright upwards."""
    figure = new_figure(6.5, 4.0)
    axis = figure.subplots()
    axis.axhline(true, color="black", lw=1, label="truth")
    for i, (name, curve) in enumerate(curves.items()):
        axis.plot(curve["iteration"], curve["magnitude"], **line_style(i), label=name)
    axis.set(xscale="log", xlabel="iteration", ylabel="star (mag)")
    axis.ticklabel_format(axis="y", useOffset=False)
    axis.invert_yaxis()
    axis.grid(alpha=0.3)
    axis.legend(fontsize=9)
    return figure


def draw_profiles(kind, truth, found, star, scale):
    """Draw the profile "flux" or "width" near the star and beyond, and its relative errors."""
    threshold = width_threshold(truth.extended)
    is_flux = kind == "flux"

    def measure(source):
        masked = star if source.holds_star else None
        if is_flux:
            return metrics.flux_profile(source.extended, masked)
        return width_profile(source.extended, threshold, masked)

    unit = 1.0 if is_flux else scale
    flux = metrics.flux_profile(truth.extended)
    bright = flux >= FAINT_ROW * flux.max()
    true = measure(truth)
    reference = np.where(bright, true, 0.0)
    along = scale * (np.arange(len(true)) - star[1])
    close = slice(max(star[1] - NEAR_STAR, 0), min(star[1] + NEAR_STAR, len(true)))
    # At least the last row, where the star's rows reach the edge.
    start = min(close.stop, len(true) - 1)
    rest = slice(start, max(int(np.flatnonzero(bright)[-1]), start) + 1)
    figure = new_figure(10.0, 6.0)
    axes = figure.subplots(2, 2, sharex="col", height_ratios=(1.3, 1))
    for column, rows, title in ((0, close, "Near the star"), (1, rest, "The rest of the jet")):
        profile, error = axes[:, column]
        y, largest = along[rows], 10.0
        profile.plot(y, unit * true[rows], color="black", lw=2.5, label="truth")
        for i, source in enumerate(found):
            values = measure(source)
            percent = 100 * relative_error(values, reference)[rows]
            profile.plot(y, unit * values[rows], **line_style(i), label=source.name)
            error.plot(y, percent, **line_style(i), marker=".", ms=4, label=source.name)
            largest = max([largest, *abs(percent[np.isfinite(percent)])])
        error.set_ylim(*(np.array([-1.1, 1.1]) * min(largest, MAX_PERCENT)))
        error.axhline(0, color="black", lw=1)
        for axis in (profile, error):
            if y[0] <= 0 <= y[-1]:
                axis.axvline(0, color="0.4", lw=1, ls=":")
            axis.set_xlim(y[0], max(y[-1], y[0] + 1))
            axis.grid(alpha=0.3)
        profile.set_title(title, fontsize=10)
        profile.set_ylabel("flux per row" if is_flux else "width (mas)")
        error.set_xlabel("position along the jet from star (mas)")
        error.set_ylabel("relative error (%)")
        highest = true[rows].max()
        if is_flux and highest > 0:
            profile.set(yscale="log", ylim=(highest * 1e-3, highest * 3))
    lines, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(
        lines,
        labels,
        loc="outside lower center",
        ncols=4,
        fontsize=9,
        title="RLM: without the 3 rows at the star, which is part of it",
        title_fontsize=8,
    )
    return figure
