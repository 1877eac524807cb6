"""A figure: its colours and lines, and the file that it is written to."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from lnocl.errors import installed
from lnocl.io.atomic import whole_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage
else:  # for the modules beside this one; matplotlib may be missing
    Axes = Figure = Any


DPI = 110
# The palette of M. Okabe and K. Ito, "Color Universal Design" (2008), for colour-blind readers.
COLOURS = ("#D55E00", "#0072B2", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
STYLES = ("-", "--", "-.", ":")
COLOUR_MAP = "viridis"
# Stars that are drawn by themselves, the brightest or first; and sources that are numbered.
MOST_STARS, MOST_NUMBERED = 6, 40


def check_matplotlib() -> None:
    """Check that figures can be drawn.

    Raises
    ------
    LnoclError
        Where matplotlib is missing.
    """
    installed("matplotlib", "pictures need matplotlib, which is not installed")


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
        stream.write(png_of(figure))


def png_of(figure: Figure) -> bytes:
    """Return a figure as PNG."""
    with io.BytesIO() as stream:
        figure.savefig(stream, format="png", dpi=DPI, pil_kwargs={"optimize": True})
        return stream.getvalue()


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure of a size in inches, apart from pyplot's state.

    A notebook shows it, whether it has imported pyplot or not.
    """
    check_matplotlib()
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    class ShownFigure(Figure):
        def _repr_png_(self) -> bytes:
            return png_of(self)

    figure = ShownFigure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def show_image(
    axis: Axes,
    image: NDArray[Any],
    norm: Normalize,
    extent: tuple[float, float, float, float] | None = None,
    colours: str = COLOUR_MAP,
    bad: str = "0.6",
) -> AxesImage:
    """Draw an image with y upwards and its pixels as they are, NaN in a colour of its own."""
    from matplotlib import colormaps

    return axis.imshow(
        image,
        norm=norm,
        cmap=colormaps[colours].with_extremes(bad=bad),
        origin="lower",
        interpolation="nearest",
        extent=extent,
    )


def extent_of(shape: Sequence[int], finer: int = 1) -> tuple[float, float, float, float]:
    """Return the edges of an image whose pixels are so many times finer than the axes'."""
    ny, nx = (n / finer for n in shape)
    return -0.5, nx - 0.5, -0.5, ny - 0.5


def line_style(i: int) -> dict[str, Any]:
    """Return colour and style of the i-th line; they begin again after the last."""
    return {"color": COLOURS[i % len(COLOURS)], "linestyle": STYLES[i % len(STYLES)]}


def outlined(colour: str, edge: str) -> dict[str, Any]:
    """Return the style of text that is read on any image: a colour, and that of its edge."""
    from matplotlib.patheffects import withStroke

    return {"color": colour, "path_effects": [withStroke(linewidth=2.0, foreground=edge)]}


def as_text(words: str) -> str:
    """Return words of a user or of a file, of which matplotlib draws each $ as one: no formula."""
    return words.replace("$", r"\$")
