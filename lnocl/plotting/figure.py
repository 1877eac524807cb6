"""A figure: its colours and lines, and the file that it is written to."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

from lnocl.errors import LnoclError
from lnocl.io.atomic import whole_file

if TYPE_CHECKING:
    from matplotlib.figure import Figure


DPI = 110
# The palette of M. Okabe and K. Ito, "Color Universal Design" (2008), for colour-blind readers.
COLOURS = ("#D55E00", "#0072B2", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
STYLES = ("-", "--", "-.", ":")
COLOUR_MAP = "viridis"


def check_matplotlib() -> None:
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
            "pictures need matplotlib, which is not installed: pip install matplotlib"
        ) from None


def save_figure(figure: Figure, path: str, overwrite: bool = False) -> None:
    """Write a figure as PNG, complete or not at all.

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


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure of a size in inches, apart from pyplot's state.

    A notebook shows it, whether it has imported pyplot or not.
    """
    check_matplotlib()
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    class ShownFigure(Figure):
        def _repr_png_(self) -> bytes:
            with io.BytesIO() as stream:
                self.savefig(stream, format="png", dpi=DPI)
                return stream.getvalue()

    figure = ShownFigure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def line_style(i: int) -> dict[str, Any]:
    """Return colour and style of the i-th line; they begin again after the last."""
    return {"color": COLOURS[i % len(COLOURS)], "linestyle": STYLES[i % len(STYLES)]}


def as_text(words: str) -> str:
    """Return words of a user or of a file, of which matplotlib draws each $ as one: no formula."""
    return words.replace("$", r"\$")
