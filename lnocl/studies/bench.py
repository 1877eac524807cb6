"""The command ``lnocl bench``: from a scene or files to a table, its file and its picture."""

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

# Columns that the terminal explains.
EXPLAINED = ("ms", "to_goal", "deviation", "near_star", "flux", "rho", "front")


class Problem(NamedTuple):
    """What is reconstructed.

    Attributes
    ----------
    observation : Observation
        The images.
    stars : sequence of (x, y)
        Positions in pixels, 0-based.
    mu : float
        Weight of the Tikhonov term, per electron.
    inputs : dict
        Where it came from, for the record.
    simulation : Simulation or None
        The truth, where it is known.
    """

    observation: Observation
    stars: Sequence[tuple[float, float]]
    mu: float
    inputs: dict[str, Any]
    simulation: Simulation | None = None


class Source(Protocol):
    """Where a problem comes from."""

    @property
    def paths(self) -> list[str]:
        """Files that it is read from."""

    def load(self) -> Problem:
        """Return it."""


class Demo(NamedTuple):
    """The demo's scene.

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
        """Files that it is read from: none."""
        return []

    def load(self) -> Problem:
        """Simulate it."""
        simulation = simulate(load_target(demo.SCENE, self.size))
        inputs = {"scene": demo.SCENE, "size": self.size, "seed": simulation.experiment.seed}
        observation = experiment.observe(simulation)
        return Problem(observation, simulation.stars, self.mu, inputs, simulation)


class Files(NamedTuple):
    """FITS files, and what `lnocl.Observation` and `lnocl.deconvolve` are told of them."""

    images: Sequence[str]
    psfs: Sequence[str]
    background: Sequence[Word]
    read_noise: Sequence[Word]
    stars: Sequence[tuple[float, float]]
    mu: float

    @property
    def paths(self) -> list[str]:
        """Files that it is read from."""
        return [*self.images, *self.psfs]

    def load(self) -> Problem:
        """Read them."""
        known = Calibration(self.background, self.read_noise)
        read = frames.read_frames(self.images, self.psfs, known)
        inputs = {
            "images": dict(zip(self.images, read.sha256["images"], strict=True)),
            "psfs": dict(zip(self.psfs, read.sha256["psfs"], strict=True)),
            "background": read.background,
            "read_noise": list(self.read_noise),
        }
        return Problem(read.observation, self.stars, self.mu, inputs)


def choose_source(
    images: Sequence[str],
    psfs: Sequence[str] | None,
    background: Sequence[Word] | None,
    read_noise: Sequence[Word] | None,
    stars: Sequence[tuple[float, float]],
    mu: float | None,
    size: int | None,
) -> Source:
    """Return the files, or the demo's scene where none are given.

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
        Arguments of files without files, or a size with them.
    """
    if not images:
        given = {"psf": psfs, "background": background, "read-noise": read_noise, "star": stars}
        if strays := [f"--{name}" for name, value in given.items() if value]:
            raise InputError(
                f"{strays[0]} goes with images, and none are given; the demo's scene has its own"
            )
        return Demo(256 if size is None else size, demo.MU if mu is None else mu)
    if not psfs:
        raise InputError("images need their PSFs: give --psf")
    if size is not None:
        raise InputError("--size is of the demo's scene, and images are given; leave one out")
    return Files(images, psfs, background or [0.0], read_noise or [0.0], stars, mu or 0.0)


def run(
    source: Source,
    n_iter: int = 400,
    accuracy: float = 1e-3,
    device: str | None = None,
    stem: str | None = None,
    overwrite: bool = False,
    progress: bool = False,
) -> Iterator[str]:
    """Compare settings on a source; print, write and draw what they cost and how close they come.

    Interrupted, it reports the runs that are complete, and then raises KeyboardInterrupt.

    Parameters
    ----------
    source : Source
        Of `choose_source`.
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
        A parameter or an image that cannot be used.
    DeviceError
        No OpenCL device, or one that cannot do what was asked of it.
    FileError
        A file that cannot be read or written, or that exists and must not be overwritten.
    """
    trade.check(n_iter, accuracy)
    if stem is not None:
        _check_files(stem, overwrite, source.paths)
    problem = source.load()
    table = None
    interrupt = None
    try:
        for so_far in trade.compare(
            problem.observation,
            problem.stars,
            problem.mu,
            n_iter,
            accuracy,
            problem.simulation,
            device,
            progress,
        ):
            table = so_far
    except KeyboardInterrupt as error:
        interrupt = error
    if table is not None:
        yield from _report(table, problem, accuracy, stem, overwrite)
    if interrupt is not None:
        raise interrupt


def _report(
    table: Table, problem: Problem, accuracy: float, stem: str | None, overwrite: bool
) -> Iterator[str]:
    table.meta |= {
        "version": __version__,
        "inputs": problem.inputs,
        "stars": [list(star) for star in problem.stars],
        "mu": problem.mu,
    }
    yield f"deviations from {_reference(table)}, on {table.meta['device']}"
    yield from _lines(table)
    yield from (
        f"{name}: {table[name].description}" for name in EXPLAINED if name in table.colnames
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
    judged = trade.judged(table)
    settings = {}
    for precision, pad in dict.fromkeys(zip(table["precision"], table["pad"], strict=True)):
        rows = table[(table["precision"] == precision) & (table["pad"] == pad)]
        settings[f"{precision}, {f'pad {pad}' if pad else 'no padding'}"] = {
            "seconds": np.array(rows["seconds"]),
            "deviation": np.array(rows[judged]),
            "front": np.array(rows["front"]),
        }
    return draw_costs(settings, "all rows" if judged == "deviation" else "rows around the star")


def _check_files(stem: str, overwrite: bool, inputs: Sequence[str]) -> None:
    if not os.path.basename(stem):
        raise InputError(f"the output {stem!r} names no file; give a path without its ending")
    for ending in (".ecsv", ".png"):
        atomic.check_output(stem + ending, overwrite, inputs)
