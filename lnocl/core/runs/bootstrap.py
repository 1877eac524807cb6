"""Errors of what is measured in a reconstruction, by replicas of it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from lnocl.core.runs.outcome import Outcome
from lnocl.core.runs.quantities import (
    Part,
    Quantity,
    compared,
    in_electrons,
    measure,
    measure_part,
    propagate,
    quantities_of,
)
from lnocl.core.runs.repeated import RerunWithCounts
from lnocl.core.runs.replicas import Replica, Replicas
from lnocl.core.scene.apertures import AMOUNT, FLUX, FWHM, RATIO, Aperture
from lnocl.core.scene.arrays import Array, whole
from lnocl.core.scene.texture import resolution
from lnocl.errors import InputError
from lnocl.parallel import Parallel, work
from lnocl.progress import Progress

if TYPE_CHECKING:
    from astropy.table import QTable

MIN_REPLICAS = 10
# Levels of the intervals.
LEVELS = 0.68, 0.95
# Replicas that are reconstructed together, at most, and pixels of their images.
MOST_TOGETHER, BATCH_PIXELS = 16, 2**19


@dataclass(frozen=True, eq=False)
class Bootstrap:
    r"""Errors of quantities of a reconstruction, by replicas of it.

    A replica is a sky that the reconstruction may stand for (`lnocl.core.scene.texture`), observed
    and reconstructed alike. Its errors are the values found less the values drawn. Their mean is
    the bias b, their standard deviation the standard error s. Where the stated errors of stars are
    larger than replicas tell, s has the rest too, with the share of each star that a region holds.
    The light of a region, with its bias or without, is not more certain than it is near to that
    without smoothing: replicas, which are as smooth as v, cannot tell how sharp the sky is.
    The interval of a level round the value v is

    .. math:: v - b \pm t \, s \sqrt{1 + 1 / n}

    for n replicas, with t the quantile of Student's distribution of n - 1 degrees of freedom.

    Attributes
    ----------
    quantities : tuple of k Quantity
        Fluxes of stars, amounts of halos, positions of stars where these were refined, the light of
        the extended source in regions, light and widths along profiles.
    errors : ndarray of float64, shape (n, k)
        The errors of each replica, in electrons or pixels. Those of the PSFs are included where
        their scatter is known.
    of_psfs : ndarray of float64, shape (n, k) or (0, k)
        The part of the errors that comes from PSFs; of length 0 where their scatter is not known.
    sums : ndarray of float64, shape (3, ny, nx) or (3, K + m, ny, nx)
        The sums over replicas of the errors of the extended source and of their squares, electrons
        per pixel, smoothed to the resolution; and the number of replicas in which there is light.
        Those of K components are followed by those of m ratios.
    resolution : float
        Full width at half maximum of that smoothing, pixels: the resolution of all images together.
    seed : int
        Of the replicas.
    unit : str
        Of light: ``electron``, or ``electron/s`` where exposures were given.
    stated : ndarray of float64, shape (m,)
        Standard errors of stars and halos, `lnocl.Result.star_flux_errors` and
        `lnocl.Result.halo_flux_errors`, and of the positions of stars that are moved,
        `lnocl.Result.star_position_errors`.
    shares : ndarray of float64, shape (k, m)
        The share of each star's light that each quantity holds, 1 for its own flux or position.
    of_smoothing : ndarray of float64, shape (k,)
        The light of each region less that by as many iterations without smoothing, electrons; 0
        for all else.
    ratio_map : ndarray of float64, shape (m, ny, nx)
        Of components, one of which is called continuum, each other over that, at the resolution.

    See Also
    --------
    lnocl.Result.bootstrap : Returns it.

    References
    ----------
    Efron, B., Tibshirani, R. J., "An Introduction to the Bootstrap" (1993), chapter 6.5.

    Examples
    --------
    >>> import numpy as np
    >>> import lnocl
    >>> y, x = np.indices((33, 33)) - 16
    >>> psf = np.exp(-(x**2 + y**2) / 4)
    >>> observation = lnocl.Observation(5 + 1000 * psf / psf.sum(), psf)
    >>> result = lnocl.deconvolve(observation, [(16, 16)], stop=None, n_iter=5, engine="numpy")
    >>> found = result.bootstrap(10)
    >>> found.n, found.unit, found.quantities[0].name, found.values.round()
    (10, 'electron', 'star 1 flux', array([1000.]))
    >>> low, high = found.interval(0.95)
    >>> bool(low[0] < 1000 < high[0])
    True
    >>> found.bias.shape, found.standard_errors.shape, found.error_map.shape, found.bias_map.shape
    ((1,), (1,), (33, 33), (33, 33))
    """

    quantities: tuple[Quantity, ...]
    errors: Array
    of_psfs: Array
    sums: Array
    resolution: float
    seed: int
    unit: str = "electron"
    stated: Array = field(default_factory=lambda: np.zeros(0))
    shares: Array = field(default_factory=lambda: np.zeros((1, 0)))
    of_smoothing: Array | float = 0.0
    ratio_map: Array = field(default_factory=lambda: np.zeros(0))

    @property
    def n(self) -> int:
        """Number of replicas."""
        return len(self.errors)

    @property
    def values(self) -> Array:
        """The values in the reconstruction, shape (k,), electrons or pixels."""
        return np.array([quantity.value for quantity in self.quantities])

    @property
    def bias(self) -> Array:
        """The mean errors, shape (k,), electrons or pixels."""
        return self.errors.mean(axis=0)

    @property
    def standard_errors(self) -> Array:
        """The standard errors, shape (k,), electrons or pixels."""
        variances = self.errors.var(axis=0, ddof=1)
        hidden = np.maximum(self.stated**2 - variances[: len(self.stated)], 0.0)
        found = np.sqrt(variances + self.shares**2 @ hidden)
        return np.asarray(np.maximum(found, self._least))

    @property
    def covariances(self) -> Array:
        """The covariances of the errors, shape (k, k), such as of components in one region.

        Those of stars are in the light of regions. What smoothing changes is not in them.
        """
        hidden = np.maximum(self.stated**2 - self.errors.var(axis=0, ddof=1)[: len(self.stated)], 0)
        return np.asarray(np.cov(self.errors.T) + (self.shares * hidden) @ self.shares.T)

    @property
    def _least(self) -> Array:
        """The least errors of the light of regions, before and after the bias is taken from it."""
        changed = np.broadcast_to(self.of_smoothing, self.bias.shape)
        return np.where(changed, np.maximum(np.abs(changed), np.abs(changed - self.bias)), 0.0)

    def units(self, electrons: float) -> Array:
        """Return electrons in the unit of each quantity, 1 for positions, shape (k,)."""
        return np.array([electrons if each.kind == FLUX else 1.0 for each in self.quantities])

    def interval(self, level: float) -> Array:
        """Return the bounds that hold the truth with this probability.

        Parameters
        ----------
        level : float
            The probability, in (0, 1).

        Returns
        -------
        ndarray of float64, shape (2, k)
            Lower and upper bounds, electrons or pixels.

        Raises
        ------
        InputError
            The level is not between 0 and 1.

        Examples
        --------
        Ten errors of a flux of 100 electrons, without bias:

        >>> import numpy as np
        >>> from lnocl.core.runs.bootstrap import Bootstrap, Quantity
        >>> flux, errors = Quantity("star 1 flux", "flux", 100.0), np.tile([[-3.0], [3.0]], (5, 1))
        >>> found = Bootstrap((flux,), errors, errors[:0], np.zeros((3, 8, 8)), 2.0, seed=0)
        >>> found.interval(0.68).ravel().round(1)
        array([ 96.5, 103.5])
        """
        from scipy.stats import t

        if not 0.0 < level < 1.0:
            raise InputError(f"the level of an interval lies between 0 and 1; {level} was given")
        half = t.ppf((1.0 + level) / 2.0, self.n - 1) * np.sqrt(1.0 + 1.0 / self.n)
        middle, width = self.values - self.bias, half * self.standard_errors
        return np.array([middle - width, middle + width])

    @property
    def shares_there(self) -> Array:
        """The share of replicas in which light is there, shape (k,); NaN for positions and widths.

        It is there where the value less the error of the replica is above 0.
        """
        is_light = np.array([each.kind in (FLUX, AMOUNT) for each in self.quantities])
        shares = np.mean(self.values - self.errors > 0, axis=0)
        return np.where(is_light, shares, np.nan)

    @property
    def share_map(self) -> Array:
        """The share of replicas in which each pixel has light, at the resolution."""
        return np.asarray(self._of_skies(self.sums[2]) / self.n)

    @property
    def bias_map(self) -> Array:
        """Mean error of the extended source, electrons per pixel, at the resolution."""
        return np.asarray(self._of_skies(self.sums[0]) / self.n)

    @property
    def error_map(self) -> Array:
        """Standard error of the extended source, electrons per pixel, at the resolution."""
        return self._of_skies(self._deviations)

    @property
    def ratio_error_map(self) -> Array:
        """Standard error of ``ratio_map``, to first order in those of both components."""
        return np.asarray(self._deviations[len(self._of_skies(self._deviations)) :])

    @property
    def _deviations(self) -> Array:
        squares = self.sums[1] - self.sums[0] ** 2 / self.n
        return np.sqrt(np.maximum(squares, 0.0) / (self.n - 1))

    def _of_skies(self, planes: Array) -> Array:
        """Return the planes of the extended source, without those of ratios."""
        return planes[: len(planes) - len(self.ratio_map)]

    def to_table(self, electrons: float = 1.0, unit: str | None = None) -> QTable:
        """Return a table with a row for each quantity.

        Parameters
        ----------
        electrons : float, optional
            Electrons in the unit of fluxes.
        unit : str, optional
            That unit; by default the attribute ``unit``.

        Returns
        -------
        astropy.table.QTable
            Columns ``name``, ``at`` and ``unit``; ``value``, ``bias`` and ``error``; ``low68``,
            ``high68``, ``low95`` and ``high95``, the intervals; ``share``, that of replicas with
            the light; and ``note``. Where the scatter of the PSFs is known, ``error_psf`` is its
            part of the error, and ``error_noise`` the rest. Where light was smoothed,
            ``error_smoothing`` is the least error of the light of regions.

        Examples
        --------
        >>> import numpy as np
        >>> from lnocl.core.runs.bootstrap import Bootstrap, Quantity
        >>> flux, errors = Quantity("star 1 flux", "flux", 100.0), np.tile([[-3.0], [3.0]], (5, 1))
        >>> found = Bootstrap((flux,), errors, errors[:0], np.zeros((3, 8, 8)), 2.0, seed=0)
        >>> print(found.to_table()["name", "value", "error"][0]["error"].round(2))
        3.16
        """
        from astropy.table import QTable  # which takes its time to load

        columns = {"value": self.values, "bias": self.bias, "error": self.standard_errors}
        if len(self.of_psfs):
            columns["error_noise"] = (self.errors - self.of_psfs).std(axis=0, ddof=1)
            columns["error_psf"] = self.of_psfs.std(axis=0, ddof=1)
        if np.any(self.of_smoothing):
            columns["error_smoothing"] = self._least
        units = {FLUX: unit or self.unit, AMOUNT: "electron", RATIO: ""}
        for level in LEVELS:
            low, high = self.interval(level)
            columns |= {f"low{level * 100:.0f}": low, f"high{level * 100:.0f}": high}
        return QTable(
            {
                "name": [each.name for each in self.quantities],
                "at": [np.nan if each.at is None else each.at for each in self.quantities],
                "unit": [units.get(each.kind, "pix") for each in self.quantities],
                **{name: values / self.units(electrons) for name, values in columns.items()},
                "share": self.shares_there,
                "note": [each.note for each in self.quantities],
            }
        )


def bootstrap(
    outcome: Outcome,
    n: int,
    parts: Sequence[Part],
    seed: int,
    progress: bool = False,
    earlier: Bootstrap | None = None,
    look: Callable[[Bootstrap], None] | None = None,
    parallel: Parallel = False,
) -> Bootstrap:
    """Return the errors of a reconstruction by n replicas, of which some may be there already.

    Parameters
    ----------
    outcome : Outcome
        The reconstruction.
    n : int
        Replicas, `MIN_REPLICAS` or more.
    parts : sequence of Aperture or Profile
        What of the extended source is measured.
    seed : int
        Zero or more.
    progress : bool, optional
        Show a progress bar.
    earlier : Bootstrap, optional
        Replicas of the same reconstruction, measured alike; n of them and the others in all.
    look : callable, optional
        Is given the errors so far after each replica from the second on.
    parallel : bool, int or "current-scheduler", optional
        As for `lnocl.parallel.check_parallel`.

    Raises
    ------
    InputError
        n is less than ten, the seed is negative, or earlier replicas are of another reconstruction.
    """
    check_number(n, seed)
    found = without_replicas(outcome, parts, seed)
    if earlier is not None:
        _refuse_other(earlier, found)
        found = earlier
    found = replace(found, of_smoothing=_changed_by_smoothing(outcome, parts, found.values))
    size = 1 if parallel else min(_together(outcome), max(n - found.n, 1))
    batches = [range(k, min(k + size, n)) for k in range(found.n, n, size)]
    make = partial(_Measuring, outcome, parts, seed, found.resolution, size)
    names = outcome.scene.observation.component_names
    with (
        Progress(n, "replica", progress, "replicas") as bar,
        closing(work(make, batches, parallel)) as measured,
    ):
        bar.update(found.n)
        for each in chain.from_iterable(measured):
            for changes in (each.errors, each.of_psfs):
                propagate(changes, found.values, parts, names)
            found = replace(
                found,
                errors=np.concatenate([found.errors, each.errors]),
                of_psfs=np.concatenate([found.of_psfs, each.of_psfs]),
                sums=found.sums + each.sums,
            )
            bar.update()
            if look is not None and found.n > 1:
                look(found)
    return found


def without_replicas(outcome: Outcome, parts: Sequence[Part], seed: int) -> Bootstrap:
    """Return the quantities of a reconstruction, measured on itself, without replicas."""
    width = resolution(outcome.scene)
    quantities, shares = quantities_of(outcome, parts, width)
    errors, is_shown = outcome.star_errors(), outcome.scene.is_shown[: outcome.scene.n_stars]
    positions = errors.positions[is_shown & outcome.moves].ravel()
    stated = np.nan_to_num(np.append(in_electrons(outcome, errors.fluxes), positions))
    maps = _Maps(outcome, width)
    pixels = np.zeros((3, *maps.answer.shape))
    none = np.zeros((0, len(quantities)))
    unit = "electron/s" if outcome.setup.is_rate else "electron"
    known = width, seed, unit, stated, shares
    return Bootstrap(quantities, none, none, pixels, *known, ratio_map=maps.ratios)


def _changed_by_smoothing(outcome: Outcome, parts: Sequence[Part], values: Array) -> Array:
    """Return the light of regions less that without smoothing, 0 for other quantities, (k,)."""
    penalty, changed = outcome.scene.penalty, np.zeros(len(values))
    is_region = [isinstance(part, Aperture) for part in parts]
    if any(is_region) and (penalty.smoothing or penalty.near_stars is not None):
        sharp = replace(penalty, smoothing=0.0, near_stars=None)
        given = outcome.scene.observation.images, penalty.stars
        (other,) = RerunWithCounts(outcome, penalty=sharp).of(given)
        light = other.light().sky()
        names, sky = outcome.scene.observation.component_names, other.estimate.observed_sky
        found = [measure_part(part, sky, light, names) for part in parts]
        of_regions = np.repeat(is_region, list(map(len, found)))
        of_parts = slice(len(values) - len(of_regions), None)
        changed[of_parts] = np.where(of_regions, values[of_parts] - np.concatenate(found), 0.0)
    return changed


def check_number(n: object, seed: object) -> None:
    """Refuse a number of replicas, or a seed, that is out of range.

    Raises
    ------
    InputError
        n is not a whole number of ten or more, or the seed is not one of zero or more.
    """
    whole("bootstrap", n, MIN_REPLICAS, ", such as 50")
    whole("seed", seed, 0)


def _together(outcome: Outcome) -> int:
    """Return how many replicas are reconstructed together: more of them would gain nothing."""
    pixels = outcome.scene.n_images * math.prod(outcome.scene.grid)
    setup = outcome.setup
    is_batch = setup.engine == "opencl" and not setup.refine_positions  # else each has an engine
    return min(max(BATCH_PIXELS // pixels, 1), MOST_TOGETHER) if is_batch else 1


class _Maps:
    """The extended source at the resolution and, of components, each over the continuum.

    Attributes
    ----------
    answer : ndarray of float64, shape (ny, nx) or (K + m, ny, nx)
        The extended source, and the ratios.
    ratios : ndarray of float64, shape (m, ny, nx)
        The ratios, which are NaN where there is no continuum.
    """

    def __init__(self, outcome: Outcome, width: float) -> None:
        self._width, self._pairs = width, compared(outcome.scene.observation.component_names)
        self.answer, self.ratios = self._smooth(outcome.estimate.observed_sky), np.zeros(0)
        if self._pairs:
            k, m = np.transpose(self._pairs)
            self._below = np.where(self.answer > 0, self.answer, np.nan)[m]
            self.ratios = self.answer[k] / self._below
            self.answer = np.concatenate([self.answer, self.ratios])

    def error(self, error: Array) -> Array:
        """Return an error of the extended source like `answer`, that of ratios to first order."""
        smooth = self._smooth(error)
        if not self._pairs:
            return smooth
        k, m = np.transpose(self._pairs)
        return np.concatenate([smooth, (smooth[k] - self.ratios * smooth[m]) / self._below])

    def _smooth(self, sky: Array) -> Array:
        from scipy.ndimage import gaussian_filter

        widths = [0.0] * (sky.ndim - 2) + [self._width / FWHM] * 2
        return np.asarray(gaussian_filter(sky, widths, mode="nearest"))


class _Measured(NamedTuple):
    """What a replica adds to the arrays of `Bootstrap` of these names."""

    errors: Array
    of_psfs: Array
    sums: Array


class _Measuring:
    """Makes replicas by their numbers, and measures them."""

    def __init__(
        self, outcome: Outcome, parts: Sequence[Part], seed: int, width: float, size: int
    ) -> None:
        self._outcome, self._parts = outcome, parts
        self._replicas, self._maps = Replicas(outcome, seed, size), _Maps(outcome, width)

    def __call__(self, numbers: Sequence[int]) -> list[_Measured]:
        return list(map(self._measure, self._replicas.reconstruct(*numbers)))

    def _measure(self, replica: Replica) -> _Measured:
        drawn, seen = (measure(self._outcome, sky, self._parts) for sky in replica[:2])
        last, of_psfs = replica.found, np.zeros((0, len(seen)))
        if replica.found_with_psfs is not None:
            last = replica.found_with_psfs
            of_psfs = (measure(self._outcome, last, self._parts) - seen)[None]
            seen = seen + of_psfs[0]
        error = self._maps.error(last.extended - replica.drawn.extended)
        # There is light where the answer is brighter than the error.
        sums = np.array([error, error**2, self._maps.answer > error])
        return _Measured((seen - drawn)[None], of_psfs, sums)


def _refuse_other(earlier: Bootstrap, expected: Bootstrap) -> None:
    """Refuse replicas of another reconstruction, or that were measured otherwise."""
    is_same = (
        earlier.quantities == expected.quantities
        and earlier.sums.shape == expected.sums.shape
        and (earlier.seed, earlier.resolution) == (expected.seed, expected.resolution)
    )
    if not is_same:
        raise InputError(
            "the file has replicas of another run, other regions or another seed: give the same, "
            "or `overwrite`"
        )
