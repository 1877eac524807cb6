"""What is wrong with PSFs that do not fit the stars, where it is of a kind that has a name."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from lnocl.core.scene.arrays import Array
from lnocl.core.scene.cores import fwhm
from lnocl.core.scene.detector import psfs_on_detector
from lnocl.core.scene.observation import Observation
from lnocl.core.scene.psf_edge import psf_edge
from lnocl.core.scene.shifting import ENDLESS, MovablePsf
from lnocl.core.scene.transforms import enlarged

# The square in which a star is fitted reaches so many widths of its PSF, and pixels at most.
REACH, LEAST_REACH, MOST_REACH = 2.5, 5, 30
# So many of the brightest stars are looked at.
MOST_STARS = 5
# A PSF has a fault where reduced chi squared is above this, and turned leaves this share of the
# excess, and less than all others by as much.
WRONG, LEFT = 2.0, 0.3
# A pedestal has this share of the PSF's light or more, and so many standard errors: wings and halos
# may be flat too.
PEDESTAL, CLEAR = 0.02, 4.0

TURNS: dict[str, Callable[[Array], Array]] = {
    "flipped along x": lambda psf: psf[:, ::-1],
    "flipped along y": lambda psf: psf[::-1],
    "turned by 180 degrees": lambda psf: psf[::-1, ::-1],
    "turned by 90 degrees": lambda psf: np.rot90(psf),
    "turned by 270 degrees": lambda psf: np.rot90(psf, 3),
    "with x and y exchanged": lambda psf: psf.T,
    "with x and y exchanged and turned by 180 degrees": lambda psf: psf[::-1, ::-1].T,
}


class _Stamp(NamedTuple):
    """A star in an image: its pixels, their precision, and its place from the first of them."""

    light: Array
    precision: Array
    place: tuple[float, float]

    def chi_squared(self, psf: Array) -> float:
        """Return that of the star as a PSF shows it, its place a little free, and a level."""
        there = MovablePsf(psf, ENDLESS).with_slopes(*self.place)
        shown = there.add_to(np.zeros((3, *self.light.shape)), (0, 0), ENDLESS)
        columns = np.vstack([shown.reshape(3, -1), np.ones(self.light.size)]).T
        weights = np.sqrt(self.precision).ravel()
        weighted, light = weights[:, None] * columns, weights * self.light.ravel()
        found = np.linalg.lstsq(weighted, light)[0]
        return float(np.sum((light - weighted @ found) ** 2))


def name_faults(observation: Observation, stars: Array) -> str:
    """Return what is wrong with the first PSF that has a fault with a name; else nothing.

    Such a PSF fits the stars when it is flipped or turned by quarters, or it has a pedestal: a
    level all round its border.

    Parameters
    ----------
    observation : Observation
        The images.
    stars : ndarray of float64, shape (n, 2)
        Their places in the sky, with no PSFs of their own.
    """
    for j, psf in enumerate(psfs_on_detector(observation)):
        stamps = _stamps(observation, j, stars, psf)
        if name := _turn(psf, stamps) if stamps else "":
            return f"`psfs[{j}]` fits when it is {name}: give it so"
        edge = psf_edge(observation.psfs[j])
        if edge.level > max(PEDESTAL, CLEAR * edge.level_error):
            return (
                f"`psfs[{j}]` has a pedestal of {100 * edge.level:.2g} % of its light, level to "
                "its border: take that off, unless it is a halo"
            )
    return ""


def _stamps(observation: Observation, j: int, stars: Array, psf: Array) -> list[_Stamp]:
    """Return the brightest stars in an image whose squares lie within it."""
    reach = int(np.clip(np.ceil(REACH * fwhm(psf)), LEAST_REACH, MOST_REACH))
    found = []
    for place in observation.places(j, stars):
        x, y = np.round(place).astype(int).tolist()
        (ny, nx), first = observation.shape, (y - reach, x - reach)
        if min(first) < 0 or y + reach >= ny or x + reach >= nx:
            continue
        there = j, slice(y - reach, y + reach + 1), slice(x - reach, x + reach + 1)
        counts = observation.images[there]
        light = counts - np.broadcast_to(observation.background[j], (ny, nx))[there[1:]]
        precision = ~observation.mask[there] / np.maximum(counts, 1.0)
        found.append(_Stamp(light, precision, (place[0] - first[1], place[1] - first[0])))
    return sorted(found, key=lambda stamp: -float(stamp.light.sum()))[:MOST_STARS]


def _turn(psf: Array, stamps: list[_Stamp]) -> str:
    """Return the turn with which a PSF fits stars, if it does with one alone."""
    side = max(psf.shape) // 2 * 2 + 1
    square = enlarged(psf, (side, side), is_centred=True)
    n = sum(np.count_nonzero(stamp.precision) - 4 for stamp in stamps)

    def excess(turned: Array) -> float:
        return sum(stamp.chi_squared(turned) for stamp in stamps) / n - 1.0

    given = excess(square)
    if n <= 0 or given < WRONG - 1.0:
        return ""
    left = {name: excess(np.ascontiguousarray(turn(square))) for name, turn in TURNS.items()}
    (best, least), (_, second) = sorted(left.items(), key=lambda each: each[1])[:2]
    return best if least < LEFT * min(given, second) else ""
