"""The paper's figures, drawn from result files."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lnocl import metrics
from lnocl.errors import InputError
from lnocl.io import atomic, fitsread
from lnocl.plotting.curves import (
    draw_errors,
    draw_held_out_errors,
    draw_magnitudes,
    draw_objectives,
)
from lnocl.plotting.figure import check_matplotlib, save_figure
from lnocl.plotting.profiles import draw_profiles
from lnocl.plotting.sources import Frame, Source, draw_objects
from lnocl.studies import experiment

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FIGURES = ("objects", "errors", "magnitude", "objective", "held-out", "flux", "width")
FIGURE_FILES = tuple(f"{name}.png" for name in FIGURES)


def draw(
    folder: str, results: Sequence[str], truth: str | None = None, overwrite: bool = False
) -> Iterator[str]:
    """Draw the paper's figures from result files, as far as their data allow.

    Parameters
    ----------
    folder : str
        Folder of the figures, made where it does not exist.
    results : sequence of str
        Files of `fitswrite.write_result`. A result without stars counts as RLM.
    truth : str, optional
        File with the true source and one star.
    overwrite : bool, optional
        Whether figures in the folder may be replaced.

    Yields
    ------
    str
        A line for each figure: its file, or why it was skipped.

    Raises
    ------
    LnoclError
        matplotlib is missing.
    FileError
        A file cannot be read or written, or a figure exists.
    InputError
        The shapes of the files differ, one holds no flux or values that are not finite, or has a
        star outside its image.
    """
    check_matplotlib()
    atomic.check_folder(folder, overwrite, FIGURE_FILES, make=False)
    results = list(dict.fromkeys(results))
    saved = [fitsread.read_result(path) for path in results]
    true = None if truth is None else fitsread.read_result(truth)
    _check_saved([*([] if true is None else [true]), *saved])
    names = _names(results, saved)
    sources = [
        Source(name, each.extended, not each.stars, _note(each), each.doubtful)
        for name, each in zip(names, saved, strict=True)
    ]
    frame = _frame([*([] if true is None else [true]), *saved])
    original = None if true is None else Source("truth", true.extended)
    curves = _tables(names, [each.curve for each in saved])
    histories = _tables(names, [each.history for each in saved])
    atomic.check_folder(folder, overwrite, FIGURE_FILES)
    yield save(folder, "objects", draw_objects(original, sources, frame), overwrite)
    if curves:
        yield save(folder, "errors", draw_errors(curves), overwrite)
        yield save(folder, "magnitude", draw_magnitudes(curves, _true_magnitude(true)), overwrite)
    else:
        yield "errors and magnitude skipped: no file has a table CURVE (lnocl demo writes it)"
        if histories:
            yield save(folder, "objective", draw_objectives(histories), overwrite)
    held_out = _tables(names, [each.held_out for each in saved])
    if held_out:
        yield save(folder, "held-out", draw_held_out_errors(held_out), overwrite)
    if original is None or frame.star is None:
        yield "flux and width skipped: they need --truth with a star"
        return
    threshold = experiment.width_threshold(original.extended)
    for kind in ("flux", "width"):
        figure = draw_profiles(kind, original, sources, frame, experiment.NEAR_STAR, threshold)
        yield save(folder, kind, figure, overwrite)


def save(folder: str, name: str, figure: Figure, overwrite: bool) -> str:
    """Write a figure into a folder as PNG, and return a line that names its file."""
    path = os.path.join(folder, f"{name}.png")
    save_figure(figure, path, overwrite)
    return f"drew {path}"


def _check_saved(saved: Sequence[fitsread.SavedResult]) -> None:
    first = saved[0]
    ny, nx = first.extended.shape
    for each in saved:
        if each.extended.shape != (ny, nx):
            raise InputError(
                f"{each.path} has the shape {each.extended.shape} and {first.path} {(ny, nx)}; "
                "they must be the same"
            )
        if not (np.isfinite(each.extended).all() and each.extended.max() > 0):
            raise InputError(f"{each.path} holds values that are not finite, or no flux")
        for x, y in each.stars:
            if not (-0.5 <= x < nx - 0.5 and -0.5 <= y < ny - 0.5):
                raise InputError(f"{each.path} has a star at ({x:g}, {y:g}), outside its image")


def _note(result: fitsread.SavedResult) -> str:
    """Return what the outline of a result means, where there is one."""
    is_outlined = result.doubtful is not None and result.doubtful.any()
    return "red: the PSF's error may be all there is" if is_outlined else ""


def _names(paths: Sequence[str], saved: Sequence[fitsread.SavedResult]) -> list[str]:
    """Return the method and mu of each result, with its path where two would be equal."""
    names = []
    for each in saved:
        mu = each.number("MU") or 0.0
        method = "MC-RL" if each.stars else "RLM"
        names.append(f"{method} mu={mu:g}" if each.stars or mu else method)
    return [
        f"{name} ({path})" if names.count(name) > 1 else name
        for name, path in zip(names, paths, strict=True)
    ]


def _tables(
    names: Sequence[str], tables: Sequence[dict[str, NDArray[np.float64]] | None]
) -> dict[str, dict[str, NDArray[np.float64]]]:
    """Return the tables that have rows, by name."""
    return {
        name: table
        for name, table in zip(names, tables, strict=True)
        if table is not None and table["iteration"].size
    }


def _frame(saved: Sequence[fitsread.SavedResult]) -> Frame:
    star = next((each.stars[0] for each in saved if each.stars), None)
    scale = next((each.number("PIXSCALE") for each in saved if "PIXSCALE" in each.header), None)
    return Frame(star, scale)


def _true_magnitude(true: fitsread.SavedResult | None) -> float | None:
    if true is None or not true.stars:
        return None
    zero = true.number("MAGZERO")
    return None if zero is None else metrics.magnitude(float(true.star_fluxes[0]), zero)
