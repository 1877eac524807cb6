"""What a notebook shows of an object: a table of a few lines beside a thumbnail."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Pixels of a thumbnail's longer side, at most, and on the screen.
SIDE, ON_SCREEN = 256, 200
# The share of the brightest pixel at which the stretch of a thumbnail turns from a line to a
# logarithm.
LINEAR_SHARE = 0.01


def html_card(title: str, rows: Mapping[str, object], image: NDArray[np.float64]) -> str:
    """Return a table and an image in HTML; without matplotlib the table alone.

    Parameters
    ----------
    title : str
        Its heading.
    rows : mapping of str to object
        Texts of the table, by their names; they are escaped, but for line breaks.
    image : ndarray, shape (ny, nx) or (k, ny, nx)
        What the thumbnail shows, several beside each other; NaN where it is not known.
    """
    lines = "".join(
        f"<tr><th style='text-align:left'>{html.escape(name)}</th>"
        f"<td style='text-align:left'>{_escaped(str(value))}</td></tr>"
        for name, value in rows.items()
    )
    planes = image.reshape(-1, *image.shape[-2:])
    content = thumbnail(np.hstack([*planes]))
    picture = (
        f"<img alt='{html.escape(title)}' src='data:image/png;base64,{content}' "
        f"style='width:{ON_SCREEN * len(planes)}px;image-rendering:pixelated'>"
        if content
        else ""
    )
    return (
        f"<div style='display:flex;gap:1em;align-items:flex-start'>{picture}"
        f"<div><b>{html.escape(title)}</b><table>{lines}</table></div></div>"
    )


def thumbnail(image: NDArray[np.float64]) -> str:
    """Return a small image as PNG in base64, stretched by an inverse hyperbolic sine; y goes up.

    Nothing where matplotlib is missing.
    """
    try:
        from matplotlib import colormaps
        from matplotlib.image import imsave
    except ImportError:
        return ""
    step = -(-max(image.shape) // SIDE)
    means = block_means(image, step)
    small = np.nan_to_num(means)
    low, high = float(np.percentile(small, 1)), float(small.max())
    scale = LINEAR_SHARE * (high - low) or 1.0
    shown = np.arcsinh((small - low).clip(0.0) / scale) / np.arcsinh(1.0 / LINEAR_SHARE)
    colours = colormaps["viridis"](shown.clip(0.0, 1.0), bytes=True)
    colours[np.isnan(means)] = (150, 150, 150, 255)
    with io.BytesIO() as stream:
        imsave(stream, colours[::-1], format="png")
        return base64.b64encode(stream.getvalue()).decode("ascii")


def block_means(image: NDArray[Any], step: int) -> NDArray[np.float64]:
    """Return the means of the good pixels of blocks, NaN where there is none.

    The last blocks are smaller where the step does not divide the sides.
    """
    rest = [(0, -n % step) for n in image.shape]
    whole = np.pad(image.astype(np.float64), rest, constant_values=np.nan)
    ny, nx = (n // step for n in whole.shape)
    blocks = whole.reshape(ny, step, nx, step)
    known = np.isfinite(blocks)
    sums = np.where(known, blocks, 0.0).sum(axis=(1, 3))
    counts = known.sum(axis=(1, 3))
    return np.divide(sums, counts, out=np.full(sums.shape, np.nan), where=counts > 0)


def _escaped(text: str) -> str:
    return html.escape(text).replace("\n", "<br>")
