"""Targets to simulate: an extended source and its stars, built in or read from a file."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from astropy import units as u
from numpy.typing import ArrayLike
from scipy.special import expit

from lnocl.core.scene.arrays import numbers
from lnocl.core.scene.quantities import bare
from lnocl.errors import InputError
from lnocl.io import fitsread
from lnocl.simulation.checks import check_shape, number

# Below this the 24 rows around the star of `hh34` do not fit.
MIN_JET_SIZE = 64
DEFAULT_SIZE = 1024


@dataclass(frozen=True)
class Star:
    """A point source.

    Parameters
    ----------
    x, y : int
        Position in pixels, 0-based, x along columns.
    magnitude : Quantity, optional
        In mag, by default 13.

    Examples
    --------
    >>> import astropy.units as u
    >>> from lnocl.simulation import Star
    >>> print(Star(30, 40, 11.5 * u.mag).magnitude)
    11.5 mag
    """

    x: int
    y: int
    magnitude: u.Quantity = 13.0 * u.mag


class Target:
    """An extended source and its stars, as they are on the sky.

    Parameters
    ----------
    extended : array_like, shape (ny, nx)
        Extended source in any unit of flux per pixel, not negative, of a positive sum. Both axes
        are even and 32 pixels or more.
    stars : sequence of Star, optional
        Point sources, at whole pixels of the image.

    Attributes
    ----------
    extended : ndarray of float64, shape (ny, nx)
        Of unit sum.
    stars : tuple of Star
        The point sources.

    Raises
    ------
    InputError
        - The extended source is not a plane of finite numbers, or has masked or negative pixels.
        - It has no flux or one that is not finite, or a side is odd or too small.
        - A star lies outside it or between pixels.

    Examples
    --------
    >>> import numpy as np
    >>> from lnocl.simulation import Star, Target
    >>> disc = np.zeros((64, 64))
    >>> disc[28:36, 28:36] = 5.0
    >>> target = Target(disc, [Star(32, 32)])
    >>> float(target.extended.sum()), target.stars[0].x
    (1.0, 32)
    """

    def __init__(self, extended: ArrayLike, stars: Sequence[Star] = ()) -> None:
        array = numbers("the extended source", bare("the extended source", extended))
        check_shape(array.shape)
        if not (np.isfinite(array).all() and (array >= 0).all()):
            raise InputError("the extended source must be finite and not negative everywhere")
        with np.errstate(over="ignore"):
            total = array.sum()
        if not np.isfinite(total):
            raise InputError(
                "the extended source is too large to be summed: divide it by a constant"
            )
        if total == 0:
            raise InputError("the extended source has no flux: all its pixels are zero")
        self.extended = array / total
        self.stars = tuple(_check_star(star, array.shape) for star in stars)


def hh34(size: int = DEFAULT_SIZE) -> Target:
    """Return a jet of the kind of HH 34 and the star that drives it, on a square of this size.

    The axis of the jet lies along y. It leaves the star as a thin spine that widens and wiggles a
    little and carries curved knots. It ends in a bow shock, ``0.62 * size`` pixels from the star.
    The first knot is 8 pixels from the star, and each is 1.45 times as far as the one before. Width
    of the spine and places of the knots are the same in a frame of any size. In a smaller one the
    jet is shorter, has fewer knots and fades faster. Nothing in it is random.

    Parameters
    ----------
    size : int
        Pixels along each side; even, 64 or more.

    Returns
    -------
    Target
        The jet, of unit sum, and the star, of magnitude 13, at ``(size // 2, size // 4)``.

    Raises
    ------
    InputError
        The size is not a whole number, odd or below 64.

    Examples
    --------
    >>> from lnocl.simulation import hh34
    >>> target = hh34(256)
    >>> target.extended.shape, target.stars[0].x, target.stars[0].y
    ((256, 256), 128, 64)
    """
    ny, nx = check_shape((size, size), MIN_JET_SIZE)
    star = Star(nx // 2, ny // 4)
    s = np.arange(ny)[:, None] - float(star.y)  # distance from the star along the axis
    length = 0.62 * ny
    width = 4.0 + 0.02 * np.clip(s, 0, None)
    t = np.arange(nx) - star.x - 0.25 * width * np.sin(s / (4.0 + 0.09 * length))
    across = np.exp(-0.5 * (t / width) ** 2)
    along = expit(s / 1.5) * expit((length - s) / (0.02 * length)) * np.exp(-1.5 * s / length)
    jet = along * across
    distance, k = 8.0, 0
    while distance < 0.85 * length:
        front = (s - distance + t**2 / (6.0 * width)) / (1.2 + 0.05 * distance)
        brightness = (2.5 + 1.5 * math.cos(2.4 * k)) * math.exp(-1.5 * distance / length)
        jet += brightness * np.exp(-0.5 * front**2) * across
        distance, k = 1.45 * distance, k + 1
    shell = (s - length + t**2 / (0.2 * length)) / (1.5 + 0.008 * length)
    jet += 0.7 * np.exp(-0.5 * shell**2 - 0.5 * (t / (0.09 * length)) ** 2)
    return Target(np.where(jet > 1e-6 * jet.max(), jet, 0.0), [star])


SCENES = {"hh34": hh34}


def load_target(
    scene: str | Path, size: int | None = None, stars: Sequence[Star] | None = None
) -> Target:
    """Return a built-in scene, or the first image of a FITS file as the extended source.

    Parameters
    ----------
    scene : str or Path
        Name of a built-in scene (``"hh34"``), or a FITS file. Its pixels are taken as they are; its
        WCS is not read.
    size : int, optional
        Pixels along each side of a built-in scene, 1024 by default; a file has its own.
    stars : sequence of Star, optional
        Stars instead of those of the scene. Those of a file are one star of magnitude 13 at the
        header keywords STARX, STARY (0-based), where it has them.

    Returns
    -------
    Target
        Extended source and stars.

    Raises
    ------
    InputError
        The scene is unknown, a size is given with a file, or `Target` refuses it.
    FileError
        The file is not readable as FITS, or holds no image.

    Examples
    --------
    >>> from lnocl.simulation import load_target
    >>> load_target("hh34", size=64).extended.shape
    (64, 64)
    """
    if str(scene) in SCENES:
        target = SCENES[str(scene)](DEFAULT_SIZE if size is None else size)
        return target if stars is None else Target(target.extended, stars)
    if not Path(scene).is_file():
        raise InputError(
            f"scene {str(scene)!r} is neither a built-in one ({', '.join(SCENES)}) nor a file"
        )
    if size is not None:
        raise InputError(f"`size` {size} was given with {scene}, which has its own; leave it out")
    image = fitsread.read_single(str(scene))
    if stars is None:
        keyed = "STARX" in image.header and "STARY" in image.header
        stars = [Star(image.header["STARX"], image.header["STARY"])] if keyed else []
    return Target(image.data[0], stars)


def _check_star(star: Star, shape: tuple[int, ...]) -> Star:
    ny, nx = shape
    number("the magnitude of a star", star.magnitude, u.mag)
    for value in (star.x, star.y):
        if not isinstance(value, (int, float, np.integer, np.floating)):
            raise InputError(f"the position of a star must be two numbers; {value!r} was given")
    if not (0 <= star.x <= nx - 1 and 0 <= star.y <= ny - 1):
        raise InputError(
            f"the star at ({star.x:g}, {star.y:g}) lies outside the image: x must be in "
            f"[0, {nx - 1}] and y in [0, {ny - 1}]"
        )
    if star.x != round(star.x) or star.y != round(star.y):
        raise InputError(
            f"the star at ({star.x:g}, {star.y:g}) lies between pixels; give the nearest whole "
            f"pixel ({round(star.x)}, {round(star.y)})"
        )
    return Star(round(star.x), round(star.y), u.Quantity(star.magnitude).to(u.mag))
