"""Reports of results, from their files: what was found as tables in words, with units."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from itertools import repeat
from typing import Any

import numpy as np

from lnocl.core.scene.arrays import Array
from lnocl.io import sky
from lnocl.io.headers import number
from lnocl.io.parts import Content, read_parts
from lnocl.io.saved_results import SavedResult, read_result
from lnocl.plotting.figure import check_matplotlib
from lnocl.plotting.report import Table, make_report
from lnocl.plotting.result import ResultView
from lnocl.plotting.significance import SignificanceView
from lnocl.result.summary import rounded, with_error
from lnocl.studies.figures import check_saved, view_of

# The tables that are shown, and what those are of whose rows have numbers.
TABLES = "STARS", "COMPONENTS", "HALOS", "REGIONS", "ERRORS", "DETECTIONS", "LIMITS"
NUMBERED = {"STARS": "star", "DETECTIONS": "detection"}
# Cards that say nothing of the result.
LEFT_OUT = "", "COMMENT", "HISTORY", "SIMPLE", "BITPIX", "EXTEND"


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
    check_saved([saved])
    target = str(saved.header.get("OBJECT") or saved.header.get("TARGNAME") or "").strip()
    title = os.path.basename(path) + (f": {target}" if target else "")
    header = (each for each in saved.header.cards if each.keyword not in LEFT_OUT)
    cards = [(each.keyword, each.value, each.comment) for each in header]
    parts, view = read_parts(path, (*TABLES, "SIGNAL", "LIMIT50")), view_of(saved)
    made = {name: table_of(name, parts[name], saved) for name in TABLES if name in parts}
    # Of a search it is told that nothing was found; others without rows have nothing to tell.
    tables = {name.capitalize(): made[name] for name in made if made[name] or name == "DETECTIONS"}
    found = _found(path, view, parts)
    given = saved.messages, tables, cards, saved.commands(), found, arcseconds(saved)
    return make_report(view, title, *given)


def _found(path: str, view: ResultView, parts: Mapping[str, Content]) -> SignificanceView | None:
    """Return the detections and limits of a saved result; None where it has none."""
    table = parts.get("LIMITS", parts.get("DETECTIONS"))
    if table is None:
        return None
    threshold, width = (number(path, table.header, each) for each in ("THRESHOL", "SRCWIDTH"))
    what = threshold or np.nan, width or 0.0, str(table.header.get("FLUXUNIT", ""))
    found = (parts.get(name) for name in ("SIGNAL", "DETECTIONS", "LIMIT50", "LIMITS"))
    shown = (None if each is None else each.values for each in found)
    return SignificanceView(view.stars, view.oversample, *what, *shown)


def arcseconds(saved: SavedResult) -> Array | None:
    """Return how far east and north pixels of the images lead at the first star, arcsec.

    That is a matrix whose columns are those of a pixel along x and along y; None without celestial
    coordinates. Without stars it holds at the middle of the image.
    """
    if not sky.has_celestial(saved.header):
        return None
    middle = (np.array(saved.extended.shape[:-3:-1]) - 1.0) / 2.0
    at = np.array([*saved.sky_stars, middle][0])
    here, *ends = sky.to_sky(at + saved.oversample * np.eye(3, 2, -1), saved.header)
    moved = (np.array(ends) - here + 180.0) % 360.0 - 180.0
    matrix = 3600.0 * (moved * [np.cos(np.radians(here[1])), 1.0]).T
    return matrix if np.isfinite(matrix).all() and np.linalg.det(matrix) else None


def table_of(name: str, part: Content, saved: SavedResult) -> Table:
    """Return a table of a result in words: values with their errors, and units in its head."""
    header, values = part.header, {key: np.asarray(each) for key, each in part.values.items()}
    units = {header[f"TTYPE{i}"]: header.get(f"TUNIT{i}", "") for i in range(1, len(values) + 1)}
    if name == "HALOS" or "electron" in str(saved.header.get("BUNIT")):  # for which FITS has none
        units = {key: re.sub(r"\bct\b", "electron", unit) for key, unit in units.items()}
    if name == "ERRORS":
        is_one = np.isnan(values.pop("at"))  # profiles are drawn by lnocl plot
        unbiased = values.pop("value") - values.pop("bias")
        values = {"name": values["name"], "value less bias": unbiased, **values}
        values = {key: each[is_one] for key, each in values.items()}
    numbers, n_epochs = np.arange(len(next(iter(values.values())))), len(saved.epoch_labels) or 1
    if "share" in values:  # of a ring that was tested, or of replicas
        values["share tested" if name == "LIMITS" else "share with light"] = values.pop("share")
    if name in NUMBERED:
        values = {NUMBERED[name]: numbers // (n_epochs if name == "STARS" else 1) + 1, **values}
    if "epoch" in values and saved.epoch_labels:
        values["epoch"] = np.array(saved.epoch_labels)[values["epoch"].astype(int)]
    if saved.component_names:
        values = {"images of" if key == "epoch" else key: each for key, each in values.items()}
    errors = {key: values[f"{key}_error"] for key in values if f"{key}_error" in values}
    if "error" in values:
        errors |= dict.fromkeys(("flux", "value less bias"), values["error"])
    # What has the digits of an error, and shows none: the ends of intervals, and errors.
    alone = {key: each if "error" in key else values["error"] for key, each in values.items()
             if re.search("error|^(low|high)\\d", key)}  # fmt: skip
    shown = {}
    for key, column in values.items():
        if key == "error" or (key.endswith("_error") and key[:-6] in errors):
            continue
        head = re.sub(r"(?<=[a-z])(\d+)$", r" \1 %", key.replace("_", " "))
        unit, of_key = repeat(units.get(key, "")), errors.get(key, alone.get(key, repeat(None)))
        cells = list(map(_cell, column.tolist(), unit, of_key, repeat(key in alone)))
        if any(cells):  # notes may be empty
            shown[f"{head} ({units[key]})" if units.get(key) else head] = cells
    return shown


def _cell(value: Any, unit: str, error: float | None, is_alone: bool) -> str:
    """Return a value in words, with its error where it has one, or rounded by it alone."""
    if isinstance(value, str | int):
        return str(value)
    if error is not None and is_alone:
        return rounded(value, error)
    if error is not None:
        words = with_error(value, error).replace(" +- ", " \u00b1 ")
        return words if "\u00b1" in words else f"{words}, error unknown"
    if not np.isfinite(value):
        return "\u2013"
    places = {"deg": ".6f", "pix": ".2f"}.get(unit, "#.3g" if abs(value) < 999.5 else "")
    return f"{value:{places}}".rstrip(".") if places else rounded(value, abs(value) / 100)
