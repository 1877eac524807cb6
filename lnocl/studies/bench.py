"""The work of ``lnocl bench``: from a scene or files to a table, its file and its figure."""

from __future__ import annotations

import io
import os
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np
from astropy.table import Table

from lnocl import __version__
from lnocl.errors import InputError, LnoclError
from lnocl.io import atomic, frames
from lnocl.io.frames import Calibration, Word
from lnocl.plotting.curves import draw_costs
from lnocl.plotting.figure import check_matplotlib, save_figure
from lnocl.scene.observation import Observation
from lnocl.simulation import Simulation, load_target, simulate
from lnocl.studies import demo, experiment, trade

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Columns whose descriptions are printed below the table.
DESCRIBED = ("ms", "to_goal", "deviation", "near_star", "flux", "rho", "front")


class BenchmarkInput(NamedTuple):
    """An observation, and the arguments of its deconvolution.

    Attributes
    ----------
    observation : Observation
        The images and their PSFs.
    stars : sequence of (x, y)
        Positions in pixels, 0-based.
    mu : float
        Weight of the Tikhonov term, per electron.
    inputs : dict
        Scene and seed, or files and their checksums, for the record.
    simulation : Simulation or None
        The simulation, where `observation` is one.
    """

    observation: Observation
    stars: Sequence[tuple[float, float]]
    mu: float
    inputs: dict[str, Any]
    simulation: Simulation | None = None


class InputSource(Protocol):
    """A source of benchmark input: the demo's scene, or files."""

    @property
    def paths(self) -> list[str]:
        """Paths of its files."""

    def load(self) -> BenchmarkInput:
        """Return the input."""


class DemoScene(NamedTuple):
    """The demo's scene as a source.

    Attributes
    ----------
    size : int
        Pixels along each side.
    mu : float
        Weight of the Tikhonov term, per electron.
    """

    size: int
    mu: float

    @property
    def paths(self) -> list[str]:
        """An empty list: the scene is simulated."""
        return []

    def load(self) -> BenchmarkInput:
        """Simulate the scene."""
        simulation = simulate(load_target(demo.SCENE, self.size))
        inputs = {"scene": demo.SCENE, "size": self.size, "seed": simulation.experiment.seed}
        observation = experiment.observe(simulation)
        return BenchmarkInput(observation, simulation.stars, self.mu, inputs, simulation)


class FitsFiles(NamedTuple):
    """FITS files as a source, with arguments of `lnocl.Observation` and `lnocl.deconvolve`."""

    images: Sequence[str]
    psfs: Sequence[str]
    background: Sequence[Word]
    read_noise: Sequence[Word]
    stars: Sequence[tuple[float, float]]
    mu: float

    @property
    def paths(self) -> list[str]:
        """Paths of the images and PSFs."""
        return [*self.images, *self.psfs]

    def load(self) -> BenchmarkInput:
        """Read the files."""
        calibration = Calibration(self.background, self.read_noise)
        read = frames.read_frames(self.images, self.psfs, calibration)
        inputs = {
            "images": dict(zip(self.images, read.sha256["images"], strict=True)),
            "psfs": dict(zip(self.psfs, read.sha256["psfs"], strict=True)),
            "background": read.background,
            "read_noise": list(self.read_noise),
        }
        return BenchmarkInput(read.observation, self.stars, self.mu, inputs)


def choose_source(
    images: Sequence[str],
    psfs: Sequence[str] | None,
    background: Sequence[Word] | None,
    read_noise: Sequence[Word] | None,
    stars: Sequence[tuple[float, float]],
    mu: float | None,
    size: int | None,
) -> InputSource:
    """Return the files as a source, or the demo's scene if no image is given.

    Parameters
    ----------
    images, psfs : sequence of str
        Paths of FITS files.
    background, read_noise : sequence of float or str, optional
        As for `frames.Calibration`; by default 0.
    stars : sequence of (x, y)
        Positions in pixels, 0-based.
    mu : float, optional
        Weight of the Tikhonov term, per electron; by default 0, or that of the demo.
    size : int, optional
        Pixels along each side of the demo's scene; by default 256.

    Raises
    ------
    InputError
        Arguments of images are given without images, a size with them, or images without PSFs.
    """
    if not images:
        given = {"psf": psfs, "background": background, "read-noise": read_noise, "star": stars}
        if strays := [f"--{name}" for name, value in given.items() if value]:
            raise InputError(
                f"{strays[0]} goes with images, and none are given; the demo's scene has its own"
            )
        return DemoScene(256 if size is None else size, demo.MU if mu is None else mu)
    if not psfs:
        raise InputError("images need their PSFs: give --psf")
    if size is not None:
        raise InputError("--size is of the demo's scene, and images are given; leave one out")
    return FitsFiles(images, psfs, background or [0.0], read_noise or [0.0], stars, mu or 0.0)


def run(
    source: InputSource,
    n_iter: int = 400,
    accuracy: float = 1e-3,
    device: str | None = None,
    stem: str | None = None,
    overwrite: bool = False,
    progress: bool = False,
) -> Iterator[str]:
    """Compare the cost and accuracy of settings, and write a table and a figure.

    An interrupted comparison reports the runs that are complete, then raises KeyboardInterrupt.

    Parameters
    ----------
    source : InputSource
        Source of `choose_source`.
    n_iter, accuracy, device, progress
        As for `lnocl.studies.trade.compare`.
    stem : str, optional
        Path without its ending of the files ``.ecsv`` and ``.png``.
    overwrite : bool, optional
        Whether they may be replaced.

    Yields
    ------
    str
        Lines for the terminal.

    Raises
    ------
    InputError
        A parameter or an image cannot be used.
    DeviceError
        No OpenCL device was found, or the device failed.
    FileError
        A file cannot be read or written, or exists and must not be overwritten.
    """
    trade.check(n_iter, accuracy)
    if stem is not None:
        _check_files(stem, overwrite, source.paths)
    given = source.load()
    table = None
    interrupt = None
    try:
        for so_far in trade.compare(
            given.observation,
            given.stars,
            given.mu,
            n_iter,
            accuracy,
            given.simulation,
            device,
            progress,
        ):
            table = so_far
    except KeyboardInterrupt as error:
        interrupt = error
    if table is not None:
        yield from _report(table, given, accuracy, stem, overwrite)
    if interrupt is not None:
        raise interrupt


def _report(
    table: Table, given: BenchmarkInput, accuracy: float, stem: str | None, overwrite: bool
) -> Iterator[str]:
    table.meta |= {
        "version": __version__,
        "inputs": given.inputs,
        "stars": [list(star) for star in given.stars],
        "mu": given.mu,
    }
    yield f"deviations from {_reference(table)}, on {table.meta['device']}"
    yield from _lines(table)
    yield from (
        f"{name}: {table[name].description}" for name in DESCRIBED if name in table.colnames
    )
    if stem is not None:
        yield from _write(table, stem, overwrite)
    yield trade.advice(table, accuracy)


def _reference(table: Table) -> str:
    return f"double precision, no padding, {table.meta['n_iter']} iterations"


def _lines(table: Table) -> list[str]:
    # The first column is left-aligned: the command line strips what it prints.
    align = ["<", *(">" for _ in table.colnames[1:])]
    return table.pformat(max_lines=-1, max_width=-1, show_unit=True, align=align)


def _write(table: Table, stem: str, overwrite: bool) -> Iterator[str]:
    text = io.StringIO()
    table.write(text, format="ascii.ecsv")
    atomic.write_text(f"{stem}.ecsv", text.getvalue(), overwrite)
    yield f"written to {stem}.ecsv"
    try:
        check_matplotlib()
    except LnoclError as error:
        yield f"no picture: {error}"
        return
    save_figure(_figure(table), f"{stem}.png", overwrite)
    yield f"drew {stem}.png"


def _figure(table: Table) -> Figure:
    column = trade.deviation_column(table)
    settings = {}
    for precision, pad in dict.fromkeys(zip(table["precision"], table["pad"], strict=True)):
        rows = table[(table["precision"] == precision) & (table["pad"] == pad)]
        settings[f"{precision}, {f'pad {pad}' if pad else 'no padding'}"] = {
            "seconds": np.array(rows["seconds"]),
            "deviation": np.array(rows[column]),
            "front": np.array(rows["front"]),
        }
    return draw_costs(settings, "all rows" if column == "deviation" else "rows around the star")


def _check_files(stem: str, overwrite: bool, inputs: Sequence[str]) -> None:
    if not os.path.basename(stem):
        raise InputError(f"the output {stem!r} names no file; give a path without its ending")
    for ending in (".ecsv", ".png"):
        atomic.check_output(stem + ending, overwrite, inputs)
