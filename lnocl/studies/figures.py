"""Pictures of results, and the paper's figures where truth or errors are known, from files."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from lnocl import metrics
from lnocl.errors import InputError
from lnocl.io import atomic
from lnocl.io.fitserrors import read_errors
from lnocl.io.saved_results import SavedResult, read_result
from lnocl.plotting.curves import draw_errors, draw_magnitudes
from lnocl.plotting.figure import check_matplotlib, save_figure
from lnocl.plotting.profiles import draw_bands, draw_profiles
from lnocl.plotting.report import make_report
from lnocl.plotting.result import OUTLINED, ResultView, draw_result
from lnocl.plotting.sources import Frame, Source, draw_objects
from lnocl.studies import experiment

if TYPE_CHECKING:
    from astropy.table import Table
    from matplotlib.figure import Figure

# What is larger is no number of a result, and differences of such are not finite.
LARGEST = 1e300
# Refined stars may lie so many pixels outside their image; profiles beside one need it inside.
REACH = 3.0
FIGURES = ("objects", "errors", "magnitude", "flux", "width")


def draw(
    folder: str, results: Sequence[str], truth: str | None = None, overwrite: bool = False
) -> Iterator[str]:
    """Draw a picture of each result, and the paper's figures as far as the data allow.

    Parameters
    ----------
    folder : str
        Folder of the figures, made where it does not exist.
    results : sequence of str
        Files of `fitswrite.write_result`. A result without stars counts as RLM.
    truth : str, optional
        File with the true source.
    overwrite : bool, optional
        Whether figures in the folder may be replaced.

    Yields
    ------
    str
        A line for each figure: its file, or what it lacks.

    Raises
    ------
    LnoclError
        matplotlib is missing.
    FileError
        A file cannot be read or written, or a figure exists.
    InputError
        The shapes of the files differ, one holds values that are not finite, or has a star outside
        its image; a truth without flux.
    """
    check_matplotlib()
    results = list(dict.fromkeys(results))
    pictures = ["result"] if len(results) == 1 else [f"result_{i + 1}" for i in range(len(results))]
    profiles = {
        f"{picture}_profile_{k}": each
        for picture, path in zip(pictures, results, strict=True)
        for k, each in enumerate(read_profiles(path), 1)
    }
    outputs = [f"{name}.png" for name in (*pictures, *profiles, *FIGURES)]
    atomic.check_folder(folder, overwrite, outputs, make=False)
    saved = [read_result(path) for path in results]
    true = None if truth is None else read_result(truth)
    _check_saved([*([] if true is None else [true]), *saved], REACH if true is None else 0.0)
    if true is not None and not true.extended.max() > 0:
        raise InputError(f"{true.path} holds no flux; give another --truth, or leave it out")
    names = _names(results, saved)
    atomic.check_folder(folder, overwrite, outputs)
    for picture, each in zip(pictures, saved, strict=True):
        yield save(folder, picture, draw_result(view_of(each)), overwrite)
        if not each.cubes:
            yield (
                f"{each.path} has no models and residuals to show: repeat its run with --models "
                "--residuals, or draw them in the run, with --plot"
            )
    for name, profile in profiles.items():
        yield save(folder, name, draw_bands(*profile), overwrite)
    curves = {
        name: each.tables["CURVE"]
        for name, each in zip(names, saved, strict=True)
        if "CURVE" in each.tables
    }
    if curves:
        yield save(folder, "errors", draw_errors(curves), overwrite)
        yield save(folder, "magnitude", draw_magnitudes(curves, _true_magnitude(true)), overwrite)
    if true is None and len(saved) == 1:
        return
    sources = [
        Source(name, each.extended, not each.stars, _note(each), each.doubtful)
        for name, each in zip(names, saved, strict=True)
    ]
    frame = _frame([*([] if true is None else [true]), *saved])
    original = None if true is None else Source("truth", true.extended)
    yield save(folder, "objects", draw_objects(original, sources, frame), overwrite)
    if original is None:
        return
    if frame.star is None:
        yield "flux and width skipped: they are profiles beside one star"
        return
    threshold = experiment.width_threshold(original.extended)
    for kind in ("flux", "width"):
        figure = draw_profiles(kind, original, sources, frame, experiment.NEAR_STAR, threshold)
        yield save(folder, kind, figure, overwrite)


def read_profiles(path: str) -> list[tuple[str, Table, Table, str]]:
    """Return name, light, width and unit of light of each profile whose errors a result has."""
    errors = read_errors(path)
    if errors is None:
        return []
    along = errors[np.isfinite(errors["at"])]
    names = list(dict.fromkeys(along["name"].tolist()))
    found = []
    for flux, width in zip(names[::2], names[1::2], strict=True):
        parts = [along[along["name"] == name] for name in (flux, width)]
        found.append((flux.removesuffix(" flux"), *parts, parts[0]["unit"][0]))
    return found


def report(path: str) -> str:
    """Return a page of HTML that shows a saved result.

    Raises
    ------
    LnoclError
        matplotlib is missing.
    FileError
        The file cannot be read, or is not a result.
    InputError
        It holds values that are not finite, or a star outside its image.
    """
    check_matplotlib()
    saved = read_result(path)
    _check_saved([saved], REACH)
    target = str(saved.header.get("OBJECT") or saved.header.get("TARGNAME") or "").strip()
    title = os.path.basename(path) + (f": {target}" if target else "")
    cards = [
        (card.keyword, card.value, card.comment)
        for card in saved.header.cards
        if card.keyword not in ("", "COMMENT", "HISTORY", "SIMPLE", "BITPIX", "EXTEND")
    ]
    stars = {name: column.tolist() for name, column in saved.tables["STARS"].items()}
    return make_report(view_of(saved), title, saved.messages, stars, cards, saved.commands())


def view_of(saved: SavedResult) -> ResultView:
    """Return what the picture of a saved result shows."""
    q = saved.oversample
    nothing = np.zeros((0, *(n // q for n in saved.extended.shape)))
    models, residuals = (
        np.where(abs(cube) < LARGEST, cube, np.nan)
        for cube in (saved.cubes.get(name, nothing) for name in ("MODELS", "RESIDUALS"))
    )
    # Electrons, as images and models are, whatever the unit of the file.
    alone = f"1 {saved.header.get('BUNIT', '')}"
    factor, _, unit = str(saved.header.get("ONEUNIT", alone)).partition(" ")
    return ResultView(
        extended=float(factor) * saved.extended,
        stars=saved.stars,
        star_fluxes=saved.star_fluxes,
        n_iter=int(saved.number("NITER") or 0),
        history=saved.tables.get("HISTORY", {}),
        held_out=saved.tables.get("HELDOUT", {}),
        images=models + residuals * np.sqrt(models.clip(0.0)),
        models=models,
        residuals=residuals,
        offsets=saved.offsets,
        doubtful=saved.doubtful,
        unit=unit,
        oversample=q,
    )


def save(folder: str, name: str, figure: Figure, overwrite: bool) -> str:
    """Write a figure into a folder as PNG, and return a line that names its file."""
    path = os.path.join(folder, f"{name}.png")
    save_figure(figure, path, overwrite)
    return f"drew {path}"


def _check_saved(saved: Sequence[SavedResult], room: float) -> None:
    first = saved[0]
    ny, nx = first.extended.shape
    for each in saved:
        if each.extended.shape != (ny, nx):
            raise InputError(
                f"{each.path} has the shape {each.extended.shape} and {first.path} {(ny, nx)}; "
                "they must be the same"
            )
        if not (abs(each.extended) < LARGEST).all():
            raise InputError(f"{each.path} holds values that are not finite; draw another")
        width, height = nx / each.oversample, ny / each.oversample
        for x, y in each.stars:
            if not (-room <= x + 0.5 < width + room and -room <= y + 0.5 < height + room):
                raise InputError(f"{each.path} has a star at ({x:g}, {y:g}), outside its image")


def _note(result: SavedResult) -> str:
    """Return what the outline of a result means, where there is one."""
    is_outlined = result.doubtful is not None and result.doubtful.any()
    return OUTLINED if is_outlined else ""


def _names(paths: Sequence[str], saved: Sequence[SavedResult]) -> list[str]:
    """Return the method and mu of each result, or its file, with its path where two are equal."""
    names = []
    for path, each in zip(paths, saved, strict=True):
        mu = each.number("MU")
        name = str(each.header.get("METHOD") or os.path.splitext(os.path.basename(path))[0])
        names.append(f"{name} mu={mu:g}" if mu else name)
    return [
        f"{name} ({path})" if names.count(name) > 1 else name
        for name, path in zip(names, paths, strict=True)
    ]


def _frame(saved: Sequence[SavedResult]) -> Frame:
    """Return the axes: from the star, where there is one alone."""
    several = any(len(each.stars) > 1 for each in saved)
    star = next((each.sky_stars[0] for each in saved if each.stars), None)
    scale = next((each.number("PIXSCALE") for each in saved if "PIXSCALE" in each.header), None)
    return Frame(None if several else star, scale)


def _true_magnitude(true: SavedResult | None) -> float | None:
    if true is None or not true.stars:
        return None
    zero = true.number("MAGZERO")
    return None if zero is None else metrics.magnitude(float(true.star_fluxes[0]), zero)
