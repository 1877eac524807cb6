"""A result as one page of HTML, which needs no network and no other file."""

from __future__ import annotations

import base64
import html
import io
import json
import math
from collections.abc import Mapping, Sequence
from importlib.resources import files
from string import Template
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lnocl.core.scene.arrays import Array
from lnocl.notebook import block_means
from lnocl.plotting.figure import COLOUR_MAP, new_figure, png_of
from lnocl.plotting.result import (
    FAINT_SHARE,
    MAX_SIGMA,
    Region,
    ResultView,
    brightest,
    draw_choice,
    draw_light_curves,
    finer_slices,
    image_limits,
    worst_image,
)
from lnocl.plotting.significance import SignificanceView, draw_significance

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Bytes of the whole frame's pictures, about: an image and its residuals are noise, of a byte a
# pixel each, a model takes a third, the extended source a half; in base64 four for three.
FRAME_BYTES = 1.5e6
BYTES_OF_IMAGE, BYTES_OF_SOURCE = 3.1, 0.7
# Half the side of an enlarged region, pixels.
HALF = 24
# Codes of a pixel: 0 is bad, the others are steps.
STEPS = 254


def make_report(
    view: ResultView,
    title: str,
    messages: Sequence[str] = (),
    stars: Mapping[str, Sequence[float]] | None = None,
    cards: Sequence[tuple[str, Any, str]] = (),
    commands: str = "",
    found: SignificanceView | None = None,
) -> str:
    """Return a page with images to blink and stretch, messages of the run, tables and the command.

    Parameters
    ----------
    view : ResultView
        What its pictures show; without images the extended source alone.
    title : str
        Its heading.
    messages : sequence of str, optional
        The answer of the run; after an empty line its warnings, which begin with "warning: ", and
        what was measured and chosen.
    stars : mapping of str to sequence of float, optional
        Columns of the table of stars.
    cards : sequence of (keyword, value, comment), optional
        Header cards.
    commands : str, optional
        Commands that repeat the run.
    found : SignificanceView, optional
        Detections and limits.

    Raises
    ------
    LnoclError
        matplotlib is missing.
    """
    step = frame_step(view)
    regions = [Region("whole frame")]
    regions += [Region(f"star {s + 1}", view.stars[s], HALF) for s in view.zooms()]
    data = {
        "regions": [_region(view, region, 1 if region.middle else step) for region in regions],
        "stars": [[round(x, 3), round(y, 3)] for x, y in view.stars],
        "first": worst_image(view, regions[0]) if len(view.images) else 0,
        "palettes": {"source": _palette(COLOUR_MAP), "residuals": _palette("RdBu_r")},
    }
    notes = [f"The whole frame is shown in blocks of {step} x {step} pixels."] if step > 1 else []
    if view.oversample > 1:
        notes.append(
            "The extended source is finer: shown is its light in each pixel of the images."
        )
    if not len(view.images):
        notes.append("The file has no models and residuals: repeat the run with both.")
    template = Template((files("lnocl.plotting") / "report.html").read_text("utf-8"))
    return template.substitute(
        title=html.escape(title),
        messages=_said(messages),
        stars=_table(stars or {}, "star"),
        found=_found(found),
        curve=_curve(view),
        commands=html.escape(commands),
        cards=_cards(cards),
        note=html.escape(" ".join(notes)),
        data=json.dumps(data, allow_nan=False).replace("<", "\\u003c"),
    )


def frame_step(view: ResultView) -> int:
    """Return the side of the blocks in which the whole frame fits the page, pixels."""
    each = BYTES_OF_IMAGE * len(view.images) + BYTES_OF_SOURCE
    return max(1, int(np.ceil(np.sqrt(math.prod(view.shape) * each / FRAME_BYTES))))


def _region(view: ResultView, region: Region, step: int) -> dict[str, Any]:
    """Return the pictures of a region: image, model and residuals of each image, and the source."""
    images: list[list[dict[str, Any]]] = []
    for j in range(len(view.images)):
        offset = view.offset_at(j, region)
        shape = view.images[j].shape
        there = region.slices(shape, offset)
        corner = _corner(there, shape, offset)
        if not view.images[j][there].size:  # not in this image
            images.append([])
            continue
        low, high, _ = image_limits(view.images[j][there])
        scale = image_limits(view.images[j])[2]
        limits = (low, high, scale)
        residuals = step * block_means(view.residuals[j][there], step)  # still over their noise
        images.append(
            [
                _layer("image", block_means(view.images[j][there], step), limits, corner),
                _layer("model", block_means(view.models[j][there], step), limits, corner),
                _layer("residuals", residuals, (-MAX_SIGMA, MAX_SIGMA, 0.0), corner, "sigma"),
            ]
        )
    there, q = region.slices(view.shape), view.oversample
    # Of a finer sky the light in each pixel of the images.
    extended = q**2 * block_means(view.extended[finer_slices(there, q)], q)
    top = brightest(extended)
    source = _layer(
        "extended source",
        block_means(extended, step),
        (0.0, top, FAINT_SHARE * top),
        _corner(there, view.shape, (0.0, 0.0)),
        view.unit,
    )
    return {"name": region.name, "step": step, "images": images, "source": source}


def _corner(there: Any, shape: Sequence[int], offset: Sequence[float]) -> tuple[float, float]:
    """Return where the first pixel of a part of an image is in the sky."""
    first = [part.indices(n)[0] for part, n in zip(there, shape, strict=True)]
    return first[1] - offset[0], first[0] - offset[1]


def _layer(
    name: str,
    values: Array,
    limits: tuple[float, float, float],
    corner: tuple[float, float],
    unit: str = "electron",
) -> dict[str, Any]:
    """Return a picture and how its pixels are read; a scale of 0 is linear, else they are asinh."""
    low, high, scale = limits
    shares = ((values - low) / (high - low)).clip(0.0, 1.0)
    if scale:
        steepness = (high - low) / scale
        shares = np.arcsinh(shares * steepness) / np.arcsinh(steepness)
    codes = np.where(np.isfinite(shares), 1 + np.round(STEPS * np.nan_to_num(shares)), 0)
    return {
        "name": name,
        "palette": "residuals" if name == "residuals" else "source",
        "unit": unit,
        "png": _png(codes[::-1].astype(np.uint8)),
        "low": low,
        "high": high,
        "scale": scale,
        "x": corner[0],
        "y": corner[1],
    }


def _png(codes: NDArray[np.uint8]) -> str:
    from PIL import Image  # on which matplotlib depends

    with io.BytesIO() as stream:
        Image.fromarray(codes).save(stream, format="PNG", optimize=True)
        return base64.b64encode(stream.getvalue()).decode("ascii")


def _palette(name: str) -> str:
    """Return the 256 colours of a map, three bytes each."""
    from matplotlib import colormaps

    colours = colormaps[name](np.arange(256), bytes=True)[:, :3]
    return base64.b64encode(colours.tobytes()).decode("ascii")


def _curve(view: ResultView) -> str:
    n = 2 if view.light_curves else 1
    figure = new_figure(8.5, 3.0 * n)
    axes = figure.subplots(n, squeeze=False)[:, 0]
    draw_choice(axes[0], view)
    if n > 1:
        draw_light_curves(axes[1], view)
    return _picture(figure)


def _picture(figure: Figure) -> str:
    return base64.b64encode(png_of(figure)).decode("ascii")


def _said(lines: Sequence[str]) -> str:
    """Return the answer of a run, its warnings, and a list to unfold of all else."""
    if not lines:
        return "<p>The file does not hold it.</p>"
    end = list(lines).index("") if "" in lines else len(lines)
    warned = [line for line in lines[end + 1 :] if line.startswith("warning: ")]
    more = [line for line in lines[end + 1 :] if line not in warned]
    parts = [f"<pre>{html.escape(chr(10).join(lines[:end]))}</pre>", _list(warned, "warning")]
    if more:
        summary = "What was measured and chosen"
        parts.append(f"<details><summary>{summary}</summary>{_list(more)}</details>")
    return "".join(parts)


def _list(lines: Sequence[str], kind: str = "") -> str:
    items = "".join(f"<li>{html.escape(line)}</li>" for line in lines)
    return f"<ul class='{kind}'>{items}</ul>" if lines else ""


def _found(view: SignificanceView | None) -> str:
    """Return the section of detections and limits; nothing where the file has none."""
    if view is None:
        return ""
    parts = ["<h2>Detections and limits</h2>"]
    if view.signal is not None or view.limit is not None:
        picture = _picture(draw_significance(view, stacked=True))
        parts.append(
            f'<img alt="detections and limits" src="data:image/png;base64,{picture}" '
            'style="max-width:100%">'
        )
    if view.detections is not None:
        parts.append(_table(view.detections, "detection"))
    if view.curves is not None:
        rows = _table(view.curves, "ring")
        parts.append(f"<details><summary>Limits round each star</summary>{rows}</details>")
    return "\n".join(parts)


def _table(columns: Mapping[str, Sequence[Any]], what: str) -> str:
    n = len(next(iter(columns.values()), ()))
    if not n:
        return "<p>None.</p>"
    head = "".join(f"<th>{html.escape(name)}</th>" for name in (what, *columns))
    rows = (
        "".join(f"<td>{cell}</td>" for cell in (s + 1, *(_cell(c[s]) for c in columns.values())))
        for s in range(n)
    )
    return f"<table><tr>{head}</tr>{''.join(f'<tr>{row}</tr>' for row in rows)}</table>"


def _cell(value: Any) -> str:
    return html.escape(value) if isinstance(value, str) else f"{value:.7g}"


def _cards(cards: Sequence[tuple[str, Any, str]]) -> str:
    rows = ("".join(f"<td>{html.escape(str(cell))}</td>" for cell in card) for card in cards)
    return f"<table>{''.join(f'<tr>{row}</tr>' for row in rows)}</table>"
