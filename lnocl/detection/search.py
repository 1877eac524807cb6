"""Point sources in an image by a matched filter with the PSF, each taken out once it is found."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import KDTree

from lnocl.core.scene.arrays import Array, darker_noise
from lnocl.core.scene.cores import centre, fwhm
from lnocl.core.scene.shifting import ENDLESS, MARGIN, Cutout, MovablePsf
from lnocl.detection.fitting import STEPS, amounts, fit
from lnocl.detection.maxima import peaks

Window = tuple[slice, slice]

# The disc in which a star is fitted holds this share of the sum of the squared PSF, and as many
# pixels more on each side as the PSF is wide.
SQUARED_LIGHT = 0.97
# An extended source is what the PSF fits worse than the PSF smoothed by a Gaussian of so many of
# its widths: less than this share of its peak is a point's.
BROADER, POINT_SHARE = 0.4, 0.45
# Two points explain what one does not only where they leave next to nothing to broader sources.
SEVERAL_SHARE = 0.9
# Maxima are those of the image smoothed by a Gaussian of so many PSF widths, each the brightest
# within so many widths.
SMOOTHING, SEPARATION = 0.35, 0.45
# What lies in the wings of brighter stars must be brighter than this share of them: PSFs err.
OF_WINGS = 0.5
# So many of the brightest maxima within so many PSF widths may be fitted with one. Without any it
# may be two stars, so many widths apart to begin with.
NEIGHBOURS, NEAR, APART = 4, 2.5, 0.9
# Sweeps over stars after new ones are found.
SWEEPS = 2
# Noise that is lower by less than this share than before brings no new maxima.
LOWER = 0.02
# A box with more bad pixels than this, percent, says nothing of the sky.
MOST_BAD = 50.0
# A place with less weight than this share of the most has too few good pixels.
LEAST_WEIGHT = 1e-3


class PointSources(NamedTuple):
    """What a matched filter finds.

    Attributes
    ----------
    x, y, flux, significance, width : ndarray of float64, shape (n,)
        Of each star: its place, its flux in units of the PSF's sum, its flux over the standard
        deviation of such fluxes in the image, and its full width at half maximum, pixels.
    is_known : ndarray of bool, shape (n,)
        Whether it was known before, so that its place was not fitted.
    extended : ndarray of float64, shape (m,)
        Significance of each maximum that is wider than the PSF.
    """

    x: Array
    y: Array
    flux: Array
    significance: Array
    width: Array
    is_known: NDArray[np.bool_]
    extended: Array


class _Profile:
    """A PSF and its smoothed version at any place of an image."""

    def __init__(self, psf: Array) -> None:
        self.shape = psf.shape
        self.width = fwhm(psf)
        row, column = centre(psf.shape)
        radius = np.hypot(*np.ogrid[-row : psf.shape[0] - row, -column : psf.shape[1] - column])
        inwards = np.argsort(radius, axis=None)
        squares = np.cumsum(psf.ravel()[inwards] ** 2)
        within = radius.ravel()[inwards][np.searchsorted(squares, SQUARED_LIGHT * squares[-1])]
        self.half = int(np.ceil(within + self.width))
        far = self.half + MARGIN  # where what is cut off rings no more
        core = np.pad(psf, far)[row : row + 2 * far + 1, column : column + 2 * far + 1]
        smooth = ndimage.gaussian_filter(core, BROADER * self.width)
        self._whole, *self._cores = (MovablePsf(part, ENDLESS) for part in (psf, core, smooth))

    def at(self, there: Window, x: float, y: float, *, smooth: bool = False) -> Array:
        """Return the values of a star at (x, y) in a window round it."""
        return _inside(self._cores[smooth].at(x, y), there)

    def with_slopes(self, there: Window, x: float, y: float) -> Array:
        """Return the values, and their slopes along x and y of the star, shape (3, h, w)."""
        return _inside(self._cores[False].with_slopes(x, y), there)

    def window(self, x: float, y: float, shape: tuple[int, ...]) -> Window:
        """Return the rows and columns in which a star is fitted."""
        return around(x, y, (self.half, self.half), shape)

    def whole(self, x: float, y: float, shape: tuple[int, ...]) -> tuple[Window, Array]:
        """Return the rows and columns that the whole PSF covers, and its values there."""
        there = around(x, y, (self.shape[0] // 2, self.shape[1] // 2), shape)
        return there, _inside(self._whole.at(x, y), there)


def _inside(star: Cutout, there: Window) -> Array:
    """Return the values of a star in a window, 0 where it has none."""
    rows, columns = there
    shape = rows.stop - rows.start, columns.stop - columns.start
    laid = np.zeros((*star.values.shape[:-2], *shape))
    return star.add_to(laid, (rows.start, columns.start), ENDLESS)


def around(x: float, y: float, half: tuple[int, int], shape: tuple[int, ...]) -> Window:
    """Return the rows and columns of an image within so many pixels of a place."""
    places = zip((round(y), round(x)), half, shape, strict=True)
    rows, columns = (slice(max(at - h, 0), min(at + h + 1, n)) for at, h, n in places)
    return rows, columns


class _MatchedFilter:
    """Least-squares fluxes of a PSF and of a constant in a disc round every pixel."""

    def __init__(self, profile: _Profile, weights: Array) -> None:
        half = profile.half
        side = slice(-half, half + 1)
        self._disc = (np.hypot(*np.ogrid[side, side]) <= half + 0.5).astype(float)
        self._psf = profile.at((side, side), 0.0, 0.0) * self._disc
        total = _sums(weights, self._disc)
        self._share = _sums(weights, self._psf) / np.maximum(total, LEAST_WEIGHT * total.max())
        information = _sums(weights, self._psf**2) - self._share**2 * total
        is_known = information > LEAST_WEIGHT * information.max()
        self._information = np.where(is_known, information, np.inf)

    def __call__(self, weighted: Array) -> tuple[Array, Array]:
        """Return the fluxes in an image, given times its weights, and their signal-to-noise."""
        excess = _sums(weighted, self._psf) - self._share * _sums(weighted, self._disc)
        return excess / self._information, excess / np.sqrt(self._information)


def _sums(image: Array, part: Array) -> Array:
    """Return the sums of an image times a part of odd sides that is centred on each pixel."""
    from scipy.signal import oaconvolve  # which sources beside a model's do not need

    return np.asarray(oaconvolve(image, part[::-1, ::-1], mode="same"))


class _Search:
    """An image, the stars found in it, and what is left of it without them."""

    def __init__(
        self, image: Array, weights: Array, psf: Array, threshold: float, is_rough: bool
    ) -> None:
        self.profile = _Profile(psf)
        self.rough_within = round(self.profile.width) if is_rough else 0
        self.filter = _MatchedFilter(self.profile, weights)
        self.left, self.weights, self.threshold = image.copy(), weights, threshold
        self.stars: list[Array] = []  # x, y, flux, signal of each
        self.found_at: list[Array] = []  # x, y of each where it was found
        self.whole = self.filter(weights * image)[1]
        self.noise = self.noise_of(self.whole)

    def noise_of(self, signal: Array) -> Array:
        """Return the noise of the filtered image, by its darker half, and locally by what is left.

        It is more than 1 where neighbouring pixels share their noise, or have structure.
        """
        is_good = (self.weights > 0) & (signal != 0)
        if not is_good.any():
            return np.full(signal.shape, np.inf)
        dark = max(1.0, darker_noise(signal[is_good]))
        return np.maximum(dark, in_boxes(signal, ~is_good, 2 * self.profile.half + 1)[1])

    def take_out(self, star: Array, share: float = 1.0) -> None:
        """Take this share of a star out of the image, given its place and flux."""
        x, y, flux = star[:3]
        there, values = self.profile.whole(x, y, self.left.shape)
        self.left[there] -= share * flux * values

    def maxima(self) -> tuple[Array, Array, Array]:
        """Return the places, fluxes and signal of new maxima, the most significant first."""
        flux, signal = self.filter(self.weights * self.left)
        smooth = ndimage.gaussian_filter(self.left, SMOOTHING * self.profile.width)
        apart = max(1, round(SEPARATION * self.profile.width))
        is_new = smooth == ndimage.maximum_filter(smooth, 2 * apart + 1)
        is_new &= signal > self.threshold * self.noise
        # Of a rough PSF the wings are the brightest within its width.
        wings = ndimage.maximum_filter(abs(self.whole - signal), 2 * self.rough_within + 1)
        is_new &= signal > OF_WINGS * wings
        y, x = np.nonzero(is_new)
        order = np.argsort(-signal[y, x])
        y, x = y[order], x[order]
        places = np.stack([x, y], axis=1) + peaks(smooth, y, x, "reflect")[0]
        return places, flux[y, x], signal[y, x]

    def is_point(self, places: Array, least: float = POINT_SHARE) -> bool:
        """Return whether the first of these places has a point, given sources at the others.

        Each has the PSF and its smoothed version, as they fit best together.
        """
        x, y = places[0]
        there = self.profile.window(x, y, self.left.shape)
        parts = [
            self.profile.at(there, *place, smooth=smooth)
            for place in places
            for smooth in (False, True)
        ]
        parts.append(np.ones_like(parts[0]))
        point, broad = amounts(parts, self.left[there], self.weights[there])[:2]
        sharp, smooth_peak = point * parts[0].max(), max(broad * parts[1].max(), 0.0)
        return bool(sharp > least * (sharp + smooth_peak))

    def is_apart(self, places: Array) -> NDArray[np.bool_]:
        """Return whether places are farther than `SEPARATION` from all stars found so far.

        That is from where they are, and from where they were found: a fit may have moved them.
        """
        if not self.stars:
            return np.ones(places.shape[:-1], bool)
        distances = KDTree([star[:2] for star in self.stars] + self.found_at).query(places)[0]
        return np.asarray(distances > SEPARATION * self.profile.width)

    def are_two(self, places: Array) -> bool:
        """Return whether two points or more explain an image that one does not."""
        second = np.roll(places, -1, axis=0)
        return self.is_point(places, SEVERAL_SHARE) and self.is_point(second, SEVERAL_SHARE)

    def split(self, place: Array) -> Array:
        """Return two places along the longer axis of the light round one; that one in a hole."""
        there = self.profile.window(place[0], place[1], self.left.shape)
        light = np.clip(self.left[there] - self.left[there].max() / 2.0, 0.0, None)
        rows, columns = np.nonzero(light)
        if not len(rows):
            return place[np.newaxis]
        _, axes = np.linalg.eigh(np.cov(columns, rows, aweights=light[rows, columns], ddof=0))
        return place + np.outer([0.5, -0.5], APART * self.profile.width * axes[:, 1])

    def fit(self, places: Array, fluxes: Array, n_steps: int = STEPS) -> tuple[Array, Array]:
        """Return places and fluxes of stars near the first, as they fit best with a level."""
        there = self.profile.window(places[0, 0], places[0, 1], self.left.shape)
        star = partial(self.profile.with_slopes, there)
        light, weights = self.left[there], self.weights[there]
        return fit(star, places, fluxes, light, weights, [np.ones_like(light)], n_steps)

    def width(self, star: Array) -> float:
        """Return the width of a star's image without its neighbours; NaN where noise hides it.

        The image is smoothed by the PSF, so that there is little noise in it, and compared with the
        PSF smoothed likewise; squares of widths add up. What a Gaussian loses half a width from its
        middle gives each.
        """
        x, y, flux = star[:3]
        there, far = self.profile.window(x, y, self.left.shape), self.profile.width / 2
        moves = [(0.0, 0.0), (far, 0.0), (-far, 0.0), (0.0, far), (0.0, -far)]
        cores = [self.profile.at(there, x + dx, y + dy) for dx, dy in moves]
        squares = []
        for light in (self.left[there] + flux * cores[0], cores[0]):
            middle, *beside = (float((core * light).sum()) for core in cores)
            if not 0 < np.mean(beside) < middle:
                return np.nan
            squares.append(4.0 * np.log(2.0) * far**2 / np.log(middle / np.mean(beside)))
        square = squares[0] - squares[1] + self.profile.width**2
        return float(np.sqrt(square)) if square > 0 else np.nan

    def take_out_known(self, x: float, y: float) -> Array:
        """Return a star at a place, and take it out; all good pixels of the PSF give its flux."""
        there, value = self.profile.whole(x, y, self.left.shape)
        weights = self.weights[there]
        information = max(float((weights * value**2).sum()), np.finfo(float).tiny)
        flux = float((weights * value * self.left[there]).sum()) / information
        star = np.array([x, y, flux, flux * np.sqrt(information)])
        self.take_out(star)
        return star

    def refit(self, near: Array) -> None:
        """Fit flux and place of the stars near places, the brightest first."""
        reach = 2 * self.profile.half
        stars = sorted(self.stars, key=lambda star: -star[2])
        nearest, _ = KDTree(near).query([star[:2] for star in stars])
        for _ in range(SWEEPS):
            for star, distance in zip(stars, nearest, strict=True):
                if distance <= reach:
                    self._fit(star)

    def _fit(self, star: Array) -> None:
        self.take_out(star, -1.0)
        limits = np.array(self.left.shape[::-1]) - 0.5
        places, fluxes = self.fit(star[np.newaxis, :2], star[2:3], n_steps=1)
        star[:2] = np.clip(places[0], -0.5, limits - 1e-6)
        star[2] = max(fluxes[0], 0.0)
        self.take_out(star)


def pixels_at(x: Array, y: Array, shape: tuple[int, ...]) -> tuple[NDArray[np.int_], ...]:
    """Return rows and columns of the pixels at places, or of the nearest in an image."""
    return tuple(
        np.round(at).astype(int).clip(0, n - 1) for at, n in zip((y, x), shape, strict=True)
    )


def in_boxes(pixels: Array, bad: NDArray[np.bool_], box: int) -> tuple[Array, Array]:
    """Return sigma-clipped median and standard deviation in boxes, interpolated between them.

    They are those of all good pixels where no box has enough of them.
    """
    from astropy.stats import sigma_clipped_stats
    from photutils.background import Background2D

    try:
        sky = Background2D(pixels, min(box, *pixels.shape), mask=bad, exclude_percentile=MOST_BAD)
    except ValueError:
        _, level, noise = sigma_clipped_stats(pixels[~bad])
        return np.full(pixels.shape, level), np.full(pixels.shape, noise)
    return sky.background, sky.background_rms


def find_points(
    image: Array,
    weights: Array,
    psf: Array,
    threshold: float,
    known: Array,
    excluded: NDArray[np.bool_],
    *,
    is_rough: bool = False,
) -> PointSources:
    r"""Return the point sources in an image.

    A star at place s is significant by the flux that fits it best with a constant b,

    .. math:: \min_{c, b} \sum_n w_n (g_n - c P_{s n} - b)^2

    in a disc round it. The most significant maxima within the reach of the PSF are taken out of the
    image; fluxes and places of all near them are fitted again, and so on until none is new. A
    maximum whose best fit by the PSF and the PSF smoothed is mostly the latter is extended.

    Parameters
    ----------
    image : ndarray of float64, shape (ny, nx)
        Without the sky; finite.
    weights : ndarray of float64, shape (ny, nx)
        One over the variance of each pixel; 0 where it is bad.
    psf : ndarray of float64, shape (ky, kx)
        Its peak is at (ky // 2, kx // 2), and its sum 1.
    threshold : float
        Smallest significance.
    known : ndarray of float64, shape (n, 2)
        Places of stars that are taken out first, with the fluxes of their good pixels.
    excluded : ndarray of bool, shape (ny, nx)
        Where no star is sought.
    is_rough : bool, optional
        Whether the PSF is right in its core alone.

    Returns
    -------
    PointSources
        The known ones first.
    """
    if not weights.any():
        none = np.zeros(0)
        return PointSources(none, none, none, none, none, none.astype(bool), none)
    search = _Search(image, weights, psf, threshold, is_rough)
    fixed = [search.take_out_known(x, y) for x, y in known]
    extended: list[Array] = []
    while True:
        places, fluxes, signal = search.maxima()
        pixels = np.round(places).astype(int)
        kept = ~excluded[pixels[:, 1], pixels[:, 0]]
        kept &= search.is_apart(places)  # what a star leaves in its core is none
        candidates = np.column_stack([places, fluxes, signal])[kept]
        points, extended = _points_among(search, candidates, extended)
        for star in points:
            search.stars.append(star)
            search.found_at.append(star[:2].copy())
            search.take_out(star)
        if points:
            new = np.array([star[:2] for star in points])
            search.refit(new)
            reach = 2 * search.profile.half
            distances = KDTree(new).query(np.reshape(extended, (-1, 2)))[0]
            extended = [each for each, far in zip(extended, distances, strict=True) if far > reach]
        noise = search.noise_of(search.filter(weights * search.left)[1])
        if not points and (noise > (1.0 - LOWER) * search.noise).all():
            break
        search.noise = np.minimum(noise, search.noise)
    found = [*fixed, *(star for star in search.stars if star[2] > 0)]
    is_known = np.arange(len(found)) < len(fixed)
    x, y, flux, signal = np.reshape(found, (-1, 4)).T
    width = np.array([search.width(star) for star in found])
    places = np.reshape(extended, (-1, 2))
    wide = pixels_at(places[:, 0], places[:, 1], image.shape)
    return PointSources(
        x,
        y,
        flux,
        signal / search.noise[pixels_at(x, y, image.shape)],
        width,
        is_known,
        (search.filter(weights * search.left)[1] / search.noise)[wide],
    )


def _points_among(
    search: _Search, candidates: Array, extended: list[Array]
) -> tuple[list[Array], list[Array]]:
    """Return the stars among maxima, and the places of the extended ones.

    Each row of the maxima has place, flux and signal. No star is within reach of a more significant
    one. What was extended before, with no new star near it, is so still.
    """
    if not len(candidates):
        return [], extended
    places = candidates[:, :2]
    tree, points = KDTree(places), []
    was_extended = {tuple(np.round(each).astype(int)) for each in extended}
    taken = np.zeros(len(places), bool)
    for i, place in enumerate(places):
        if tuple(np.round(place).astype(int)) in was_extended:
            continue
        if taken[tree.query_ball_point(place, search.profile.half)].any():
            continue
        star = candidates[i].copy()
        if not search.is_point(places[[i]]):
            near = sorted(tree.query_ball_point(place, NEAR * search.profile.width))
            others = [j for j in near if j != i][:NEIGHBOURS]
            several = places[[i, *others]] if others else search.split(place)
            several, fluxes = search.fit(several, np.zeros(len(several)))
            order = np.argsort(-fluxes)
            several, fluxes = several[order], fluxes[order]
            is_near = np.hypot(*(several[0] - place)) < search.profile.width
            if not (is_near and search.is_apart(several[0]) and search.are_two(several)):
                extended.append(place)
                continue
            star[:3] = *several[0], fluxes[0]
        taken[i] = True
        points.append(star)
    return points, extended
