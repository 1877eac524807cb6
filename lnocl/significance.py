"""Whether there is a source at a place, and how faint one would have been found.

The signal-to-noise of a source at each place follows from its score under the model without it
(`lnocl.detection.score`). Errors of PSFs and noise that neighbours share are part of it
(`lnocl.detection.score_noise`). The threshold follows from the false alarms that are allowed in the
whole field (`lnocl.detection.false_alarms`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.stats import norm

from lnocl.core.runs.outcome import Outcome, mean_over_epochs
from lnocl.core.scene.arrays import Array, number_in, whole
from lnocl.core.scene.detector import on_sky
from lnocl.core.scene.estimate import Estimate
from lnocl.core.scene.quantities import in_unit
from lnocl.core.scene.texture import SHARE_NEAR
from lnocl.core.solvers.companions import SIGNIFICANT, Companion, errors_beside, holding
from lnocl.core.solvers.halos import halo_errors
from lnocl.detection.places import parted, random_pixels
from lnocl.detection.score import Null
from lnocl.detection.score_map import ScoreMap
from lnocl.detection.table import CLEAR, POINT_SOURCE, detections, points_beside_stars
from lnocl.errors import InputError
from lnocl.plotting.significance import SignificanceView, draw_significance

if TYPE_CHECKING:
    from astropy.table import QTable
    from matplotlib.figure import Figure

# A source that was put in is found by a detection within so many resolutions.
NEAR = 0.7
# Of more false alarms in a field the number is not what the threshold says.
MOST_ALARMS = 10.0
# Curves have each pixel up to one, then each tenth, from where this share of a ring is tested.
EACH_PIXEL, TENTHS, HALF = 100, 10, 0.5
# The threshold of fewer is beyond what numbers hold.
FEWEST_ALARMS = 1e-200


def fluxes_of_stars(outcome: Outcome) -> Array:
    """Return the flux of each star, electrons, NaN where it has none, and NaN after the last."""
    fluxes = mean_over_epochs(outcome.fluxes_of_stars, outcome.observation.n_epochs)
    return np.append(np.where(fluxes > 0, fluxes, np.nan), np.nan)


def null_of(outcome: Outcome, estimate: Estimate | None = None) -> Null:
    """Return the model of a reconstruction without sources beside its stars, or those of another.

    That is the reconstruction's `estimate` with further stars.
    """
    refinement = outcome.psf_refinement
    errors = np.zeros(1), np.zeros(0)
    if refinement is not None and refinement.psf_error:
        errors = refinement.edges, refinement.errors_in_rings
    return Null(estimate or outcome.estimate, outcome.moves, errors)


@dataclass(frozen=True, eq=False)
class Significance:
    r"""Sources beside the stars of a reconstruction, and what noise alone would look like.

    Attributes
    ----------
    signal_to_noise : ndarray of float64, of the shape of the extended source
        Of a source at each place: the value of a Gaussian that is as rare. NaN where the images do
        not tell a source from stars.
    flux, flux_error : ndarray of float64, of the same shape
        Its flux and standard error, electrons; NaN there.
    threshold : float
        The signal-to-noise that noise exceeds in `false_alarms` places of the field, on average.
    false_alarms : float
        Expected number of false alarms in the whole field.
    width : float
        Full width at half maximum of the source, pixels of the images; 0 for a point.
    resolution : float
        Full width at half maximum of what all images resolve together, in the same pixels.
    detections : astropy.table.QTable
        The maxima above the threshold, most significant first: ``x``, ``y`` and their errors,
        pixels of the images; ``flux`` and ``flux_error``, electrons; ``significance``; the nearest
        ``star``, counted from 1, or 0, and its ``distance``, pixels; ``kind``; and
        ``contrast`` and ``contrast_error``, over the flux of that star. The kind is "point" for a
        point source, and "extended" where the extended source could be it. The flux of the latter
        is that of a point there, beside an extended source as bright as it is round it.

    See Also
    --------
    lnocl.Result.significance : Returns it.

    Notes
    -----
    A source is "extended" where two things hold. There is light round it, between 0.85 and 1.65
    resolutions. And a point is fitted together with an extended source as bright as that light
    (`lnocl.detection.point_test`), and has less than three errors. All sources wider than a point
    are "extended".

    A companion scatters the ring round its star that it lies in, as an error of the PSF does, and
    hides so, the brighter the more. Where a place within three resolutions of a star has three
    standard deviations of the counts, points are tried there against all that the PSF may have
    wrong (`lnocl.core.solvers.companions`). Those found are detections, with the errors of that
    fit, and stars in the map. How often noise alone raises an alarm was measured:
    :doc:`/validation/detections`.

    Examples
    --------
    A source of 300 electrons at (40, 20), on a sky of 10 electrons per pixel:

    >>> import numpy as np
    >>> import lnocl
    >>> y, x = np.indices((33, 33)) - 16
    >>> psf = np.exp(-(x**2 + y**2) / 4)
    >>> mean = np.full((64, 64), 10.0)
    >>> mean[4:37, 24:57] += 300 * psf / psf.sum()
    >>> images = np.random.default_rng(0).poisson(mean)
    >>> observation = lnocl.Observation(images, psf, background=10)
    >>> result = lnocl.deconvolve(observation, stop=None, n_iter=20, engine="numpy")
    >>> found = result.significance()
    >>> [source] = found.detections
    >>> source["x"].round(), source["y"].round(), source["kind"]
    (<Quantity 40. pix>, <Quantity 20. pix>, np.str_('point'))
    >>> bool(abs(source["flux"].value - 300) < 2 * source["flux_error"].value)
    True
    >>> bool(4 < found.threshold < 5)
    True
    """

    signal_to_noise: Array
    flux: Array
    flux_error: Array
    threshold: float
    false_alarms: float
    width: float
    resolution: float
    detections: QTable
    _map: ScoreMap = field(repr=False)
    _outcome: Outcome = field(repr=False)

    def __post_init__(self) -> None:
        for values in (self.signal_to_noise, self.flux, self.flux_error):
            values.flags.writeable = False

    def limit(self, completeness: float = 0.5) -> Array:
        """Return the flux of a source that would be found with some probability at each place.

        Parameters
        ----------
        completeness : float, optional
            That probability, between 0 and 1.

        Returns
        -------
        ndarray of float64, of the shape of the extended source
            Electrons; NaN where the images do not tell a source from stars. The extended source is
            allowed for where it is: a point has to be three errors above what that may be. Near a
            star it has to be five, or the threshold, above all that PSFs may have wrong, and three
            above that and the extended source, as points are tried and fitted there
            (`lnocl.core.solvers.companions`). Between two and three resolutions the map finds more
            and more of them, and limits pass to its own, by their logarithms. Points that were
            found are part of the model, and a source at one of them is not told from it.

        Raises
        ------
        InputError
            The probability is not between 0 and 1.

        Examples
        --------
        >>> import numpy as np
        >>> import lnocl
        >>> images = np.random.default_rng(1).poisson(10.0, (64, 64))
        >>> observation = lnocl.Observation(images, np.ones((5, 5)), background=10)
        >>> result = lnocl.deconvolve(observation, stop=None, n_iter=20, engine="numpy")
        >>> found = result.significance()
        >>> half, most = (found.limit(share)[32, 32] for share in (0.5, 0.9))
        >>> bool(60 < half < 90), bool(half < most < 1.5 * half)
        (True, True)
        """
        completeness = in_unit("completeness", completeness, "")
        number_in("completeness", completeness, "between 0 and 1", lambda given: 0 < given < 1)
        found = self._beside_points
        fluxes = found.needed(self._at_threshold, completeness), self._flux_distinct_from_source
        (tried, fitted, share), least = self._beside_psfs, max(self.threshold, SIGNIFICANT)
        beside = np.maximum(least * tried, CLEAR * fitted) + norm.ppf(completeness) * tried
        (ny, nx), of_map = self.signal_to_noise.shape, np.maximum(*fluxes)
        return np.asarray((of_map * np.maximum(beside / of_map, 1.0) ** share)[:ny, :nx])

    def inject(
        self, n: int = 100, completeness: float = 0.5, seed: int = 0, progress: bool = False
    ) -> QTable:
        """Put sources into the images, and return which of them are found.

        They lie at random where sources are tested, as many between 3 and 6 pixels from a star as
        between 30 and 60; without stars they lie all over the field. The fluxes are those that
        `limit` says are found with this probability. A few at a time, the reconstruction is made
        again with them.

        Parameters
        ----------
        n : int, optional
            Sources, 1 or more.
        completeness : float, optional
            The probability, between 0 and 1.
        seed : int, optional
            Zero or more.
        progress : bool, optional
            Show progress, as `lnocl.deconvolve` does.

        Returns
        -------
        astropy.table.QTable
            A row for each source: ``x`` and ``y``, pixels of the images; ``distance`` from the
            nearest star, infinite without one; ``flux``, electrons; and ``found``, whether a
            detection lies within 0.7 resolutions; a point, where points are put in.

        Raises
        ------
        InputError
            A number, probability or seed out of range; or nothing is tested.
        DeviceError
            As `lnocl.deconvolve`.

        Examples
        --------
        >>> import numpy as np
        >>> import lnocl
        >>> images = np.random.default_rng(1).poisson(10.0, (64, 64))
        >>> observation = lnocl.Observation(images, np.ones((5, 5)), background=10)
        >>> result = lnocl.deconvolve(observation, stop=None, n_iter=20, engine="numpy")
        >>> sources = result.significance().inject(4, completeness=0.999)
        >>> len(sources), bool(sources["found"].sum() > 2)
        (4, True)
        """
        from astropy.table import QTable
        from astropy.units import electron, pix
        from scipy.ndimage import map_coordinates

        from lnocl.core.runs.injections import APART, Injections
        from lnocl.progress import Progress

        check_injections(n, seed)
        limits, rng = self.limit(completeness), np.random.default_rng(seed)
        scene, q, allowed = self._outcome.scene, self._outcome.scene.oversample, np.isfinite(limits)
        if not allowed.any():
            raise InputError("sources are tested nowhere, so that none can be put in")
        stars = KDTree(on_sky(scene.places, q)[:, ::-1])
        distance = stars.query(np.moveaxis(np.indices(limits.shape), 0, -1))[0]
        weights = allowed / np.clip(distance, 1.0, max(limits.shape)) ** 2
        pixels = random_pixels(weights, n, rng)
        places = pixels + rng.uniform(-0.5, 0.5, pixels.shape)
        between = np.exp(map_coordinates(np.log(limits), places.T, order=1, mode="nearest"))
        fluxes = np.where(np.isfinite(between), between, limits[*pixels.T])
        distance = stars.query(places)[0] / q
        places = (places[:, ::-1] - (q - 1) / 2.0) / q
        injections, found = Injections(self._outcome, self.width * q), np.zeros(n, bool)
        with Progress(n, "source", progress, "sources put in") as bar:
            for few in parted(pixels, APART * self.resolution * q):
                outcome = injections.reconstruct(places[few], fluxes[few], rng)
                found[few] = self._finds(places[few], outcome)
                bar.update(len(few))
        columns = {"x": places[:, 0] * pix, "y": places[:, 1] * pix, "distance": distance * pix}
        return QTable({**columns, "flux": fluxes * electron, "found": found})

    def _finds(self, places: Array, outcome: Outcome) -> NDArray[np.bool_]:
        """Return whether there is a detection at each of some places of a reconstruction."""
        found = significance(outcome, self.width, self.false_alarms).detections
        if not self.width:
            found = found[found["kind"] == POINT_SOURCE]
        tree = KDTree(np.array([found["x"].value, found["y"].value]).T)
        return np.asarray(tree.query(places)[0] < NEAR * self.resolution)

    @cached_property
    def _with_points(self) -> Estimate:
        """The estimate that has the points that were found as stars: else they limit others."""
        estimate, found = self._outcome.estimate, self.detections
        rows = found[found["kind"] == POINT_SOURCE].iterrows("x", "y", "flux")
        points = [Companion(np.array([x.value, y.value]), flux.value) for x, y, flux in rows]
        return holding(estimate, points, self._map.null.resolution) if points else estimate

    @cached_property
    def _beside_points(self) -> ScoreMap:
        """The score of a source beside the points that were found."""
        if self._with_points.scene.n_stars == self._map.null.scene.n_stars:
            return self._map
        return ScoreMap(null_of(self._outcome, self._with_points), self._map.width)

    @cached_property
    def _at_threshold(self) -> Array:
        """The values that are worth the threshold at each place, in units of its noise."""
        return self._beside_points.values_at(self.threshold)

    @cached_property
    def _flux_distinct_from_source(self) -> Array:
        """The flux of a point that is told from the extended source, where there is any.

        That varies by as much as `lnocl.core.scene.texture` expects of the brightest round a star.
        """
        if self._map.width:
            return np.zeros(self._map.values.shape)
        brightest = self._beside_points.null.brightest_structure()
        return np.asarray(CLEAR * SHARE_NEAR * brightest * self._map.unit)

    @cached_property
    def _beside_psfs(self) -> Array:
        """Errors of points near stars, tried and fitted, and a share; 0 elsewhere and of others."""
        if self._map.width:
            return np.zeros((3, *self._map.values.shape))
        estimate, raised = self._with_points, halo_errors(self._outcome.estimate).raised
        is_known = np.arange(estimate.scene.n_stars) < self._outcome.scene.n_stars
        return errors_beside(estimate, raised, is_known)

    def contrast_curves(self, completeness: Sequence[float] | float = (0.5, 0.9, 0.95)) -> QTable:
        """Return the faintest sources that would be found, against the distance from each star.

        Parameters
        ----------
        completeness : sequence of float or float, optional
            Probabilities of being found, between 0 and 1.

        Returns
        -------
        astropy.table.QTable
            A row for each ``distance`` from each ``star``, counted from 1: each whole pixel of the
            images up to 100, then each tenth. The first is the inner working angle, at which half
            of the ring is tested. All are of a ring a pixel wide: the ``share`` of it that is
            tested; the median ``threshold``, in standard errors, of a detection in it; and the
            medians of `limit`: ``flux50``, electrons; ``contrast50``, over the flux of the star;
            and ``magnitudes50``, fainter than the star; likewise for other probabilities.

        Raises
        ------
        InputError
            A probability is not between 0 and 1.

        Examples
        --------
        >>> import numpy as np
        >>> import lnocl
        >>> y, x = np.indices((65, 65)) - 32
        >>> psf = np.exp(-(x**2 + y**2) / 4)
        >>> images = np.random.default_rng(0).poisson(10 + 1e5 * psf / psf.sum())
        >>> observation = lnocl.Observation(images, psf, background=10)
        >>> result = lnocl.deconvolve(observation, [(32, 32)], n_iter=20, engine="numpy")
        >>> curves = result.significance().contrast_curves()
        >>> curves.colnames[:4], bool(curves["magnitudes50"][-1].value > 6)
        (['star', 'distance', 'share', 'threshold'], True)
        """
        from astropy.table import QTable
        from astropy.units import electron, mag, pix

        shares = np.atleast_1d(in_unit("completeness", completeness, "")).tolist()
        found = [self.limit(each) for each in shares]
        limits = {f"{100 * each:g}": limit for each, limit in zip(shares, found, strict=True)}
        ny, nx = self.signal_to_noise.shape
        maps = np.array([self._at_threshold[:ny, :nx], *limits.values()])
        scene, of_stars = self._outcome.scene, fluxes_of_stars(self._outcome)
        rows: list[tuple[float, ...]] = []
        for s, place in enumerate(on_sky(scene.places, scene.oversample)):
            rows += [(s + 1.0, *ring, of_stars[s]) for ring in self._rings(place, maps)]
        star, distance, share, least, *fluxes, of_star = np.reshape(rows, (-1, len(maps) + 4)).T
        table = QTable({"star": star.astype(int), "distance": distance * pix})
        table["share"], table["threshold"] = share, least
        for name, flux in zip(limits, fluxes, strict=True):
            table[f"flux{name}"] = flux * electron
            table[f"contrast{name}"] = flux / of_star
            table[f"magnitudes{name}"] = -2.5 * np.log10(table[f"contrast{name}"]) * mag
        return table

    def _rings(self, place: Array, maps: Array) -> Iterator[tuple[float, ...]]:
        """Yield distance, share that is tested, and medians of maps in rings round a place."""
        from scipy.ndimage import value_indices

        away = np.indices(maps.shape[1:]) - place[::-1, None, None]
        ring = np.round(np.hypot(*away) / self._outcome.scene.oversample).astype(int)
        is_listed = (ring <= EACH_PIXEL) | (ring % TENTHS == 0)
        is_tested, sizes = np.isfinite(maps[1]), np.bincount(ring.ravel())
        rings, has_begun = value_indices(ring * (is_listed & is_tested), ignore_value=0), False
        for k, there in sorted(rings.items()):
            share = len(there[0]) / float(sizes[k])
            has_begun |= share >= HALF
            if has_begun:
                yield float(k), share, *np.median(maps[:, *there], axis=1).tolist()

    def view(self, unit: str = "electron", **maps: Any) -> SignificanceView:
        """Return what a picture shows: detections, and what is given of maps and curves."""
        scene, found = self._outcome.scene, dict(self.detections.items())
        shown = scene.places.tolist(), scene.oversample, self.threshold, self.width, unit
        return SignificanceView(*shown, detections=found, **maps)

    def plot(self) -> Figure:
        """Return a picture of the map with the detections, and of the limits and their curves.

        Returns
        -------
        matplotlib.figure.Figure
            Its ``savefig`` writes a file.

        Raises
        ------
        LnoclError
            matplotlib is missing.

        Examples
        --------
        >>> import numpy as np
        >>> import lnocl
        >>> images = np.random.default_rng(1).poisson(10.0, (64, 64))
        >>> observation = lnocl.Observation(images, np.ones((5, 5)), background=10)
        >>> result = lnocl.deconvolve(observation, stop=None, n_iter=20, engine="numpy")
        >>> [axes.get_title()[:9] for axes in result.significance().plot().axes[:1]]
        ['points: 0']
        """
        curves = dict(self.contrast_curves().items())
        view = self.view(signal=self.signal_to_noise, limit=self.limit(), curves=curves)
        return draw_significance(view)


def significance(outcome: Outcome, width: float, false_alarms: float) -> Significance:
    """Return the sources beside the stars of a reconstruction, `lnocl.Result.significance`."""
    check_search(width, false_alarms)
    observation = outcome.observation
    null = null_of(outcome)
    found = ScoreMap(null, width * observation.oversample)
    least = found.threshold(false_alarms)
    estimate, beside = points_beside_stars(outcome.estimate, null, found, least)
    if beside:
        null = null_of(outcome, estimate)
        found = ScoreMap(null, 0.0)
        least = found.threshold(false_alarms)
    ny, nx = observation.sky_shape
    if not found.score.is_tested[:ny, :nx].any():
        raise InputError(
            f"nowhere do the images tell a source of `width` {width:g} pixels from stars, the "
            "level of the sky and edges: give a narrower one, or a larger field"
        )
    table = detections(outcome.estimate, outcome.moves, found, least, beside)
    of_star = fluxes_of_stars(outcome)[table["star"] - 1]
    for name in ("", "_error"):
        table[f"contrast{name}"] = table[f"flux{name}"].value / of_star
    return Significance(
        found.significance[:ny, :nx],
        found.fluxes[:ny, :nx],
        found.errors[:ny, :nx],
        least,
        false_alarms,
        width,
        null.resolution / observation.oversample,
        table,
        found,
        outcome,
    )


def check_search(width: object, false_alarms: object) -> None:
    """Raise unless the width is finite and not negative, and a threshold has the false alarms.

    Raises
    ------
    InputError
        The width is not a finite number of 0 or more, or the alarms not one from 1e-200 to 10.
    """
    requirement = "a finite number of pixels, 0 or more"
    number_in("width", width, requirement, lambda given: 0 <= given < math.inf)
    least, most = FEWEST_ALARMS, MOST_ALARMS
    requirement = f"the number expected in the whole field, {least:g} to {most:g}, such as 0.01"
    number_in("false_alarms", false_alarms, requirement, lambda given: least <= given <= most)


def check_injections(n: object, seed: object) -> None:
    """Refuse a number of sources or a seed that is out of range.

    Raises
    ------
    InputError
        n is not a whole number of 1 or more, or the seed not one of 0 or more.
    """
    whole("injections", n, 1)
    whole("seed", seed, 0)
