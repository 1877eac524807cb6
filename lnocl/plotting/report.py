"""A result as one page of HTML, which needs no network and no other file."""

from __future__ import annotations

import base64
import html
import io
import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from importlib.resources import files
from string import Template
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lnocl.core.scene.arrays import Array
from lnocl.notebook import block_means
from lnocl.plotting import light_curves, result
from lnocl.plotting.figure import COLOUR_MAP, Axes, Figure, new_figure, png_of
from lnocl.plotting.result import Region, ResultView, finer_slices
from lnocl.plotting.significance import SignificanceView, draw_significance

# Bytes of the whole frame's pictures, about: an image and its residuals are noise, of a byte a
# pixel each, a model takes a third, the extended source a half; in base64 four for three.
FRAME_BYTES = 1.5e6
BYTES_OF_IMAGE, BYTES_OF_SOURCE = 3.1, 0.7
# Half the side of an enlarged region, pixels.
HALF = 24
# Codes of a pixel: 0 is bad, the others are steps.
STEPS = 254

# Cells of a table by the heads of its columns, with units.
Table = Mapping[str, Sequence[str]]


def make_report(
    view: ResultView,
    title: str,
    messages: Sequence[str] = (),
    tables: Mapping[str, Table] = MappingProxyType({}),
    cards: Sequence[tuple[str, Any, str]] = (),
    commands: str = "",
    found: SignificanceView | None = None,
    arcseconds: Array | None = None,
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
    tables : mapping of str to mapping of str to sequence of str, optional
        Columns of tables by the titles of their sections; figures are with those of their titles.
    cards : sequence of (keyword, value, comment), optional
        Header cards.
    commands : str, optional
        Commands that repeat the run.
    found : SignificanceView, optional
        Detections and limits.
    arcseconds : ndarray of float64, shape (2, 2), optional
        How far east and north a pixel along x and one along y lead.

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
        "first": result.worst_image(view, regions[0]) if len(view.images) else 0,
        "palettes": {name: _palette(name) for name in (COLOUR_MAP, result.NOISE, result.RATIO)},
        "arcseconds": None if arcseconds is None else arcseconds.tolist(),
    }
    notes = {
        f"The whole frame is shown in blocks of {step} x {step} pixels.": step > 1,
        "The extended source is finer: shown is its light in each pixel of the images.": (
            view.oversample > 1
        ),
        f"Ratios are blank where a component is within {result.ABOVE_NOISE:g} times its noise.": (
            bool(view.ratios())
        ),
        "The file has no models and residuals: repeat the run with both.": not len(view.images),
    }
    figures = {"Stars": _drawn(light_curves.draw, view.light_curves)} if view.light_curves else {}
    if found is not None and (found.signal is not None or found.limit is not None):
        figures["Detections" if "Detections" in tables else "Limits"] = draw_significance(found, 1)
    choice = _drawn(result.draw_choice, view) if view.held_out or view.history else None
    template = Template((files("lnocl.plotting") / "report.html").read_text("utf-8"))
    return template.substitute(
        title=html.escape(title),
        messages=_said(messages),
        sections="".join(_section(each, figures.get(each), tables[each]) for each in tables),
        choice=_section("How the iteration was chosen", choice),
        commands=html.escape(commands),
        cards=_table([], [[str(cell) for cell in card] for card in cards]),
        note=" ".join(note for note, holds in notes.items() if holds),
        data=json.dumps(data, allow_nan=False).replace("<", "\\u003c"),
    )


def frame_step(view: ResultView) -> int:
    """Return the side of the blocks in which the whole frame fits the page, pixels."""
    n_skies = min(len(view.names) + len(view.ratios()) or 1, result.MOST_SKIES)
    each = BYTES_OF_IMAGE * len(view.images) + BYTES_OF_SOURCE * n_skies
    return max(1, int(np.ceil(np.sqrt(math.prod(view.shape) * each / FRAME_BYTES))))


def _region(view: ResultView, region: Region, step: int) -> dict[str, Any]:
    """Return the pictures of a region: image, model and residuals of each image, and the source."""
    images: list[list[dict[str, Any]]] = []
    in_unit = view.unit, f"{view.unit} per pixel", COLOUR_MAP
    for j in range(len(view.images)):
        offset = view.offset_at(j, region)
        shape = view.images[j].shape
        there = region.slices(shape, offset)
        corner = _corner(there, shape, offset)
        if not view.images[j][there].size:  # not in this image
            images.append([])
            continue
        scale = result.image_limits(view.images[j])[2]
        light = (*result.image_limits(view.images[j][there])[:2], scale), corner, *in_unit
        limits = -result.MAX_SIGMA, result.MAX_SIGMA, 0.0
        noise = limits, corner, "sigma", "residual / noise", result.NOISE
        layers = (
            ("image", view.images[j], light),
            ("model", view.models[j], light),
            ("residuals", step * view.residuals[j], noise),  # of blocks over their noise
        )
        images.append(
            [_layer(name, block_means(each[there], step), *how) for name, each, how in layers]
        )
    there, q = region.slices(view.shape), view.oversample
    # Of a finer sky the light in each pixel of the images.
    fine, corner, sources = finer_slices(there, q), _corner(there, view.shape, (0.0, 0.0)), []
    skies = view.skies()
    extended = {name: q**2 * block_means(sky.extended[fine], q) for name, sky in skies.items()}
    top = max(map(result.brightest, extended.values()))
    limits = 0.0, top, result.FAINT_SHARE * top
    for name, source_light in extended.items():
        source = _layer(name, block_means(source_light, step), limits, corner, *in_unit)
        if (doubtful := skies[name].doubtful) is not None:
            flags = block_means(doubtful[fine], q * step) >= 0.5
            source["doubtful"] = {"png": _png(flags[::-1].astype(np.uint8))}
        sources.append(source)
    for name, ratio in view.ratios().items():
        limits = 0.0, result.highest(ratio[fine]), 0.0
        how = limits, corner, "", name, result.RATIO
        sources.append(_layer(name, block_means(ratio[fine], q * step), *how))
    turned = None
    if view.turns is not None:  # the map to each image, less the corner's shift
        shifts = [view.offset_at(j, region) for j in range(len(images))]
        turned = np.dstack([view.turns, view.offsets - shifts]).tolist()
    found = {"images": images, "sources": sources[: result.MOST_SKIES], "turned": turned}
    return {"name": region.name, "step": step, **found}


def _corner(there: Any, shape: Sequence[int], offset: Sequence[float]) -> tuple[float, float]:
    """Return where the first pixel of a part of an image is in the sky."""
    first = [part.indices(n)[0] for part, n in zip(there, shape, strict=True)]
    return first[1] - offset[0], first[0] - offset[1]


def _layer(
    name: str,
    values: Array,
    limits: Sequence[float],
    corner: Sequence[float],
    unit: str,
    label: str,
    palette: str,
) -> dict[str, Any]:
    """Return a picture and how its pixels are read; a scale of 0 is linear, else they are asinh."""
    low, high, scale = limits
    shares = ((values - low) / (high - low)).clip(0.0, 1.0)
    if scale:
        steepness = (high - low) / scale
        shares = np.arcsinh(shares * steepness) / np.arcsinh(steepness)
    codes = np.where(np.isfinite(shares), 1 + np.round(STEPS * np.nan_to_num(shares)), 0)
    read = dict(zip(("low", "high", "scale", "x", "y"), (*limits, *corner), strict=True))
    words = {"name": name, "unit": unit, "label": label, "palette": palette}
    return {**words, **read, "png": _png(codes[::-1].astype(np.uint8))}


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


def _said(lines: Sequence[str]) -> str:
    """Return whether to trust a result, its answer, its warnings, and a list to unfold of more."""
    if not lines:
        return "<p>The file does not hold it.</p>"
    end = list(lines).index("") if "" in lines else len(lines)
    trusted = re.split(r"^trust +(.*(?:\n .*)*)\n?", "\n".join(lines[:end]), flags=re.MULTILINE)
    before, trust, after = [*trusted, "", ""][:3]
    warned = [line for line in lines[end + 1 :] if line.startswith("warning: ")]
    more = [line for line in lines[end + 1 :] if line not in warned]
    parts = [
        _list([line.strip() for line in trust.splitlines()], "trust"),
        f"<pre>{html.escape(before + after)}</pre>",
        _list([each for each in warned if each.removeprefix("warning: ") not in trust], "warning"),
    ]
    if more:
        summary = "What was measured and chosen"
        parts.append(f"<details><summary>{summary}</summary>{_list(more)}</details>")
    return "".join(parts)


def _list(lines: Sequence[str], kind: str = "") -> str:
    items = "".join(f"<li>{html.escape(line)}</li>" for line in lines)
    return f"<ul class='{kind}'>{items}</ul>" if lines else ""


def _drawn(draw: Callable[[Axes, Any], None], what: Any) -> Figure:
    figure = new_figure(8.5, 3.0)
    draw(figure.subplots(), what)
    return figure


def _section(title: str, figure: Figure | None, table: Table | None = None) -> str:
    """Return a heading with a figure and a table below it; nothing where there is neither."""
    shown = f"<h2>{title}</h2>" if figure or table is not None else ""
    if figure is not None:
        picture = base64.b64encode(png_of(figure)).decode("ascii")
        shown += f'<div class="box"><img alt="{title}" src="data:image/png;base64,{picture}"></div>'
    if table is not None:
        rows = list(zip(*table.values(), strict=True))
        shown += _table([tuple(table)], rows) if rows else "<p>None.</p>"
    return shown


def _table(head: Sequence[Sequence[str]], rows: Sequence[Sequence[str]]) -> str:
    """Return a table in a box of its own, in which it may be wider than the page."""
    cells = "".join(
        f"<tr>{''.join(f'<{kind}>{html.escape(cell)}</{kind}>' for cell in row)}</tr>"
        for kind, lines in (("th", head), ("td", rows))
        for row in lines
    )
    return f'<div class="box"><table>{cells}</table></div>'
