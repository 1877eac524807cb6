"""Pictures of results, from their files."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from lnocl.core.runs.outcome import mean_over_epochs
from lnocl.errors import InputError
from lnocl.io import atomic
from lnocl.io.parts import read_parts
from lnocl.io.saved_results import SavedResult, read_result
from lnocl.plotting.beside import draw_beside
from lnocl.plotting.figure import Figure, check_matplotlib, save_figure
from lnocl.plotting.light_curves import light_curves
from lnocl.plotting.profiles import draw_bands
from lnocl.plotting.result import ResultView, draw_result

if TYPE_CHECKING:
    from astropy.table import Table

# What is larger is no number of a result, and differences of such are not finite.
LARGEST = 1e300
# Refined stars may lie so many pixels outside their image.
REACH = 3.0


def draw(folder: str, results: Sequence[str], overwrite: bool = False) -> Iterator[str]:
    """Draw a picture of each result and its profiles, and several results beside each other.

    Parameters
    ----------
    folder : str
        Folder of the figures, made where it does not exist.
    results : sequence of str
        Files of `fitswrite.write_result`, such as a truth.
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
        its image.
    """
    check_matplotlib()
    results = list(dict.fromkeys(results))
    pictures = ["result"] if len(results) == 1 else [f"result_{i + 1}" for i in range(len(results))]
    profiles = {
        f"{picture}_profile_{k}": each
        for picture, path in zip(pictures, results, strict=True)
        for k, each in enumerate(read_profiles(path), 1)
    }
    outputs = [f"{name}.png" for name in (*pictures, *profiles, "objects")]
    atomic.check_folder(folder, overwrite, outputs, make=False)
    saved = [read_result(path) for path in results]
    check_saved(saved)
    views = [view_of(each) for each in saved]
    atomic.check_folder(folder, overwrite, outputs)
    for picture, each, view in zip(pictures, saved, views, strict=True):
        yield save(folder, picture, draw_result(view), overwrite)
        if not each.cubes:
            yield (
                f"{each.path} has no models and residuals to show: repeat its run with "
                "--residuals, or draw them in the run, with --plot"
            )
    for name, profile in profiles.items():
        yield save(folder, name, draw_bands(*profile), overwrite)
    if len(saved) > 1:
        beside = {
            f"{name}, {sky}" if view.names else name: each
            for name, view in zip(_names(results), views, strict=True)
            for sky, each in view.skies().items()
        }
        yield save(folder, "objects", draw_beside(beside), overwrite)


def read_profiles(path: str) -> list[tuple[str, dict[str, tuple[Table, Table]], str]]:
    """Return name, light and width, and unit of light of each profile whose errors a result has.

    With components each has light and width, by its name; else there is one without a name.
    """
    held = read_parts(path, ["ERRORS", "COMPONENTS"])
    if "ERRORS" not in held:
        return []
    from astropy.table import Table  # which takes its time to load

    errors = Table(held["ERRORS"].values)
    along = errors[np.isfinite(errors["at"])]
    names = list(dict.fromkeys(along["name"].tolist()))
    pairs = [
        tuple(along[along["name"] == name] for name in pair)
        for pair in zip(names[::2], names[1::2], strict=True)
    ]
    skies = held["COMPONENTS"].values["name"].tolist() if "COMPONENTS" in held else [""]
    found = []
    for i in range(0, len(pairs), len(skies)):
        of_each = dict(zip(skies, pairs[i : i + len(skies)], strict=True))
        name = names[2 * i].removeprefix(f"{skies[0]} ").removesuffix(" flux")
        found.append((name, of_each, pairs[i][0]["unit"][0]))
    return found


def view_of(saved: SavedResult) -> ResultView:
    """Return the arrays and texts of the picture of a saved result."""
    q = saved.oversample
    nothing = np.zeros((0, *(n // q for n in saved.extended.shape[-2:])))
    models, residuals = (
        np.where(abs(cube) < LARGEST, cube, np.nan)
        for cube in (saved.cubes.get(name, nothing) for name in ("MODELS", "RESIDUALS"))
    )
    electrons = saved.cubes.get("ELECTRONS", np.ones(1))
    images = models + residuals * np.sqrt(models.clip(0.0))
    table, unit = saved.tables["STARS"], str(saved.header.get("BUNIT", "unknown unit"))
    epochs = table.get("epoch", np.zeros(len(saved.stars), int))
    n_epochs = int(np.max(epochs, initial=0)) + 1
    return ResultView(
        extended=saved.extended,
        stars=saved.stars[::n_epochs],  # once each, whatever epochs there are
        star_fluxes=mean_over_epochs(saved.star_fluxes, n_epochs),
        n_iter=int(saved.number("NITER") or 0),
        history=saved.tables.get("HISTORY", {}),
        held_out=saved.tables.get("HELDOUT", {}),
        images=images / electrons,
        models=np.where(np.isnan(images), np.nan, models) / electrons,  # without background there
        residuals=residuals,
        offsets=saved.offsets,
        turns=saved.turns,
        doubtful=saved.doubtful,
        unit=unit,
        oversample=q,
        light_curves=light_curves(
            saved.star_fluxes,
            table.get("variation_error", np.full(len(epochs), np.nan)),
            () if saved.component_names else saved.epoch_labels,
            unit,
        ),
        names=saved.component_names,
        noise=saved.noise,
    )


def save(folder: str, name: str, figure: Figure, overwrite: bool) -> str:
    """Write a figure into a folder as PNG, and return a line that names its file."""
    path = os.path.join(folder, f"{name}.png")
    save_figure(figure, path, overwrite)
    return f"drew {path}"


def check_saved(saved: Sequence[SavedResult]) -> None:
    """Refuse results that cannot be drawn, or not beside each other.

    Raises
    ------
    InputError
        Their shapes differ, one holds values that are not finite, or has a star outside its image.
    """
    first = saved[0]
    ny, nx = first.extended.shape[-2:]
    for each in saved:
        if each.extended.shape[-2:] != (ny, nx):
            raise InputError(
                f"{each.path} has the shape {each.extended.shape[-2:]} and {first.path} "
                f"{(ny, nx)}; they must be the same"
            )
        if not (abs(each.extended) < LARGEST).all():
            raise InputError(f"{each.path} holds values that are not finite; draw another")
        width, height = nx / each.oversample, ny / each.oversample
        for x, y in each.stars:
            if not (-REACH <= x + 0.5 < width + REACH and -REACH <= y + 0.5 < height + REACH):
                raise InputError(f"{each.path} has a star at ({x:g}, {y:g}), outside its image")


def _names(paths: Sequence[str]) -> list[str]:
    """Return the name of each file without its ending, or its path where two are equal."""
    names = [os.path.splitext(os.path.basename(path))[0] for path in paths]
    return [
        path if names.count(name) > 1 else name for name, path in zip(names, paths, strict=True)
    ]
