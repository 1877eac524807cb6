"""The score of a source at each place of the sky, in units of its noise, and its maxima."""

from __future__ import annotations

import math
from functools import cached_property

import numpy as np
import scipy.linalg
from numpy.typing import NDArray
from scipy import ndimage

from lnocl.core.scene.arrays import Array
from lnocl.core.scene.texture import CORE, ROUND
from lnocl.detection.completeness import needed, values_at
from lnocl.detection.false_alarms import Rarity, of_student, threshold
from lnocl.detection.maxima import peaks
from lnocl.detection.score import Null
from lnocl.detection.score_noise import MANY, noise_of

# Sources whose scores are correlated by less than this are apart, and what is left of a variance is
# no less than its rounding.
APART, ROUNDING = 0.02, 1e-6


class ScoreMap:
    """The score of a source of one width at each place, in units of its noise.

    Parameters
    ----------
    null : Null
        The model without it.
    width : float
        Its full width at half maximum, pixels of the sky; 0 for a point.
    """

    def __init__(self, null: Null, width: float) -> None:
        self.null, self.score, self.width = null, null.score(width), width
        self.noise = noise_of(self.score, null.rings, ~null.is_structured)
        self._rarity = Rarity(null.kernel(self.score.foremost, width))
        self.unit = null.scene.unit
        self.values = self.score.values / self.noise.scatter
        self.values[~self.score.is_tested] = 0.0

    def rarity(self, values: Array, at: tuple[NDArray[np.int_], ...]) -> Array:
        """Return the Gaussian values of values at these rows and columns."""
        gaussian = self._rarity(values, self.score.skewness[at] / self.noise.scatter[at])
        degrees = self.noise.degrees[at]
        is_few = degrees < MANY
        gaussian[is_few] = of_student(gaussian[is_few], degrees[is_few])
        return gaussian

    @cached_property
    def significance(self) -> Array:
        """Gaussian values as rare as the score of each place; NaN where none is tested."""
        y, x = np.nonzero(self.score.is_tested)
        found = np.full(self.values.shape, np.nan)
        found[y, x] = self.rarity(self.values[y, x], (y, x))
        return found

    @property
    def fluxes(self) -> Array:
        """Fluxes, electrons."""
        return self._where_tested(self.score.score, self.score.information) * self.unit

    @property
    def errors(self) -> Array:
        """Standard errors of the fluxes, electrons."""
        deviations = np.sqrt(self.score.variance) * self.noise.scatter
        return self._where_tested(deviations, self.score.information) * self.unit

    def _where_tested(self, values: Array, divisor: Array) -> Array:
        found = np.full(values.shape, np.nan)
        return np.divide(values, divisor, out=found, where=self.score.is_tested)

    def threshold(self, alarms: float) -> float:
        """Return the value that noise exceeds in so many places of the field, on average."""
        is_tested, ((yy, yx), (_, xx)) = self.score.is_tested, self.score.curvature
        cells = np.sqrt(np.maximum(yy * xx - yx**2, 0.0))[is_tested].sum()
        edge = 0.0
        for axis, along in enumerate((xx, yy)):
            for step in (-1, 1):
                is_edge = is_tested & ~np.roll(is_tested, step, axis)
                edge += float(np.sqrt(along[is_edge]).sum())
        return threshold(alarms, float(cells), edge)

    def values_at(self, least: float) -> Array:
        """Return the values whose Gaussian values are a threshold at each place."""
        at = np.nonzero(self.score.is_tested)
        found = np.full(self.values.shape, np.nan)
        found[at] = values_at(least, lambda each: self.rarity(each, at), len(at[0]))
        return found

    def needed(self, values: Array, probability: float) -> Array:
        """Return the fluxes, electrons, that exceed values with this probability."""
        at = np.nonzero(self.score.is_tested)
        skewness = self.score.skewness[at] / self.noise.scatter[at]
        found = np.full(self.values.shape, np.nan)
        found[at] = needed(values[at], skewness, probability) * self.errors[at]
        return found

    def light_round(self, place: Array, value: float) -> float:
        """Return the largest value in a ring round a place, less a point of a value that is there.

        Parameters
        ----------
        place : ndarray of float64, shape (2,)
            (x, y), pixels of the sky.
        value : float
            In units of the noise.
        """
        (rows, columns), resolution = self.values.shape, self.null.resolution
        half = math.ceil(ROUND * resolution) + 1
        x, y = np.round(place).astype(int).tolist()
        side = np.arange(-half, half + 1)
        there = np.ix_((y + side) % rows, (x + side) % columns)
        dx, dy = (place - (x, y)).tolist()
        away = np.array(np.meshgrid(side - dx, side - dy))
        point = self._correlated(away.transpose(1, 2, 0))
        distance = np.hypot(*away) / resolution
        is_round = (distance >= CORE) & (distance <= ROUND)
        return float((self.values[there] - value * point)[is_round].max(initial=0.0))

    @cached_property
    def _spline(self) -> Array:
        return np.asarray(ndimage.spline_filter(self.score.correlation, mode="grid-wrap"))

    def _correlated(self, away: Array) -> Array:
        """Return the correlation of scores so far apart, (x, y) of the last axis, pixels."""
        at = np.moveaxis(away[..., ::-1], -1, 0)
        found = ndimage.map_coordinates(self._spline, at, mode="grid-wrap", prefilter=False)
        return np.asarray(found)

    def peak_fluxes(self, y: NDArray[np.int_], x: NDArray[np.int_]) -> Array:
        """Return the fluxes, electrons, of maxima between pixels, at these rows and columns."""
        return peaks(np.nan_to_num(self.fluxes), y, x, "wrap")[1]

    def maxima(self, least: float) -> tuple[Array, Array, Array]:
        """Return maxima whose Gaussian values are above one, highest first.

        They are above it beside points at the higher ones too: the score of one source may have
        several, where some images are sharper than others.

        Returns
        -------
        places : ndarray of float64, shape (n, 2)
            (x, y), pixels of the sky.
        values, gaussian : ndarray of float64, shape (n,)
            In units of the noise, and as Gaussian values.
        """
        u = self.values
        y, x = np.nonzero((u == ndimage.maximum_filter(u, 3, mode="wrap")) & (u > 0))
        moves, higher = peaks(u, y, x, "wrap")
        gaussian = self.rarity(higher, (y, x))
        order = np.flatnonzero(gaussian > least)
        order = order[np.argsort(-gaussian[order])]
        places = np.stack([x, y], axis=1) + moves
        told: list[int] = []
        for i in order.tolist():
            value = self._beside(places[[i, *told]], higher[[i, *told]])
            if self.rarity(np.array([value]), (y[[i]], x[[i]]))[0] > least:
                told.append(i)
        return places[told], higher[told], gaussian[told]

    def _beside(self, places: Array, values: Array) -> float:
        """Return the value of the first of some places, with points at the others."""
        common = self._correlated(places[1:] - places[0])
        near = np.flatnonzero(abs(common) > APART)
        if not near.size:
            return float(values[0])
        others = places[1:][near]
        gram = self._correlated(others[:, None] - others)
        shares = scipy.linalg.solve(gram, common[near], assume_a="sym")
        left = max(1.0 - float(shares @ common[near]), ROUNDING)
        return float(values[0] - shares @ values[1:][near]) / math.sqrt(left)
