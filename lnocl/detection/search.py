"""Point sources in an image by a matched filter with the PSF, each taken out once it is found."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage
from scipy.spatial import KDTree

from lnocl.scene.arrays import Array, darker_noise
from lnocl.scene.cores import centre, fwhm

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
# may be two stars, so many widths apart to begin with, whose places are fitted in so many steps.
NEIGHBOURS, NEAR, APART, STEPS = 4, 2.5, 0.9, 8
# Sweeps over stars after new ones are found, and the farthest move in one, pixels.
SWEEPS, FARTHEST = 2, 0.5
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
    """A PSF and its smoothed version at any place, by cubic splines."""

    def __init__(self, psf: Array) -> None:
        self.shape = psf.shape
        self.width = fwhm(psf)
        row, column = centre(psf.shape)
        radius = np.hypot(*np.ogrid[-row : psf.shape[0] - row, -column : psf.shape[1] - column])
        inwards = np.argsort(radius, axis=None)
        squares = np.cumsum(psf.ravel()[inwards] ** 2)
        within = radius.ravel()[inwards][np.searchsorted(squares, SQUARED_LIGHT * squares[-1])]
        self.half = int(np.ceil(within + self.width))
        margin = self.half + 3
        self._origin = row + margin, column + margin
        wide = np.pad(psf, margin)
        smooth = ndimage.gaussian_filter(wide, BROADER * self.width)
        self._splines = [ndimage.spline_filter(each, 3) for each in (wide, smooth)]

    def at(
        self, rows: slice, columns: slice, x: float, y: float, *, smooth: bool = False
    ) -> tuple[Array, Array, Array]:
        """Return the values at pixels of a star at (x, y), and their slopes along x and y of it."""
        (row, wy, sy), (column, wx, sx) = _spline_weights(y), _spline_weights(x)
        top, left = rows.start - row + self._origin[0] - 2, columns.start - column
        left += self._origin[1] - 2
        ny, nx = rows.stop - rows.start, columns.stop - columns.start
        part = self._splines[smooth][top : top + ny + 3, left : left + nx + 3]
        valued, sloping = (sum(w[k] * part[k : k + ny] for k in range(4)) for w in (wy, sy))
        value, along_x = (sum(w[k] * valued[:, k : k + nx] for k in range(4)) for w in (wx, sx))
        return value, along_x, sum(wx[k] * sloping[:, k : k + nx] for k in range(4))

    def window(self, x: float, y: float, shape: tuple[int, ...]) -> Window:
        """Return the rows and columns in which a star is fitted."""
        return around(x, y, (self.half, self.half), shape)

    def reach(self, x: float, y: float, shape: tuple[int, ...]) -> Window:
        """Return the rows and columns that the whole PSF covers."""
        return around(x, y, (self.shape[0] // 2, self.shape[1] // 2), shape)


def around(x: float, y: float, half: tuple[int, int], shape: tuple[int, ...]) -> Window:
    """Return the rows and columns of an image within so many pixels of a place."""
    places = zip((round(y), round(x)), half, shape, strict=True)
    rows, columns = (slice(max(at - h, 0), min(at + h + 1, n)) for at, h, n in places)
    return rows, columns


def _spline_weights(place: float) -> tuple[int, Array, Array]:
    """Return the pixel below a place, the weights of the four splines round it, and their slopes.

    The slopes are those of a profile that moves with the place.
    """
    pixel = int(np.floor(place))
    offset = np.arange(-2, 2) + (place - pixel)
    t = np.abs(offset)
    weights = np.where(t < 1, 2 / 3 - t**2 + t**3 / 2, np.clip(2 - t, 0, None) ** 3 / 6)
    steepness = np.where(t < 1, -2 * t + 1.5 * t**2, -(np.clip(2 - t, 0, None) ** 2) / 2)
    return pixel, weights, steepness * np.sign(offset)


class _MatchedFilter:
    """Least-squares fluxes of a PSF and of a constant in a disc round every pixel."""

    def __init__(self, profile: _Profile, weights: Array) -> None:
        self._shape, half = weights.shape, profile.half
        self._fine = [fft.next_fast_len(n + 2 * half, real=True) for n in weights.shape]
        side = slice(-half, half + 1)
        disc = (np.hypot(*np.ogrid[side, side]) <= half + 0.5).astype(float)
        psf = profile.at(side, side, 0.0, 0.0)[0] * disc
        self.peak = float(psf[half, half])
        self._psf, self._disc = self._spectrum(psf), self._spectrum(disc)
        known = fft.rfft2(weights, self._fine)
        total = self._sums(known, self._disc)
        self._share = self._sums(known, self._psf) / np.maximum(total, LEAST_WEIGHT * total.max())
        information = self._sums(known, self._spectrum(psf**2))
        information -= self._share**2 * total
        is_known = information > LEAST_WEIGHT * information.max()
        self._information = np.where(is_known, information, np.inf)

    def _spectrum(self, part: Array) -> NDArray[np.complex128]:
        moved = np.zeros(self._fine)
        moved[: part.shape[0], : part.shape[1]] = part
        half = part.shape[0] // 2
        return np.conj(fft.rfft2(np.roll(moved, (-half, -half), (0, 1))))

    def _sums(self, spectrum: NDArray[np.complex128], part: NDArray[np.complex128]) -> Array:
        ny, nx = self._shape
        return fft.irfft2(spectrum * part, self._fine)[:ny, :nx]

    def __call__(self, weighted: Array) -> tuple[Array, Array]:
        """Return the fluxes in an image, given times its weights, and their signal-to-noise."""
        spectrum = fft.rfft2(weighted, self._fine)
        excess = self._sums(spectrum, self._psf) - self._share * self._sums(spectrum, self._disc)
        return excess / self._information, excess / np.sqrt(self._information)


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
        there = self.profile.reach(x, y, self.left.shape)
        self.left[there] -= share * flux * self.profile.at(*there, x, y)[0]

    def maxima(self) -> tuple[Array, Array, Array]:
        """Return the places, fluxes and signal of new maxima, the most significant first."""
        flux, signal = self.filter(self.weights * self.left)
        smooth = ndimage.gaussian_filter(self.left, SMOOTHING * self.profile.width)
        apart = max(1, round(SEPARATION * self.profile.width))
        is_new = smooth == ndimage.maximum_filter(smooth, 2 * apart + 1)
        is_new &= signal > self.threshold * self.noise
        is_new &= signal > OF_WINGS * self._wings(signal)
        y, x = np.nonzero(is_new)
        order = np.argsort(-signal[y, x])
        y, x = y[order], x[order]
        places = np.array([_vertices(smooth, y, x, 1), _vertices(smooth, y, x, 0)]).T
        return places, flux[y, x], signal[y, x]

    def _wings(self, signal: Array) -> Array:
        """Return the signal of the stars; of a rough PSF the largest within its width."""
        wings = np.abs(self.whole - signal)
        return ndimage.maximum_filter(wings, 2 * self.rough_within + 1)

    def is_point(self, places: Array, least: float = POINT_SHARE) -> bool:
        """Return whether the first of these places has a point, given sources at the others.

        Each has the PSF and its smoothed version, as they fit best together.
        """
        x, y = places[0]
        there = self.profile.window(x, y, self.left.shape)
        parts = [
            self.profile.at(*there, *place, smooth=smooth)[0].ravel()
            for place in places
            for smooth in (False, True)
        ]
        point, broad = self._solve(there, [*parts, np.ones(parts[0].size)])[:2]
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

    def untangle(self, places: Array) -> tuple[Array, Array]:
        """Return places and fluxes of stars at about these places, as they fit best together."""
        x, y = places[0]
        there = self.profile.window(x, y, self.left.shape)
        places = places.copy()
        fluxes: Array = np.zeros(len(places))
        for step in range(STEPS):
            parts = [self.profile.at(*there, *place) for place in places]
            values = [value.ravel() for value, _, _ in parts]
            slopes = [flux * each.ravel() for flux, part in zip(fluxes, parts, strict=True)
                      for each in part[1:]]  # fmt: skip
            found = self._solve(
                there, [*values, np.ones(values[0].size), *(slopes if step else [])]
            )
            fluxes = found[: len(places)]
            moves = found[len(places) + 1 :].reshape(-1, 2)
            if step:
                places += np.clip(moves, -FARTHEST, FARTHEST)
        return places, fluxes

    def _solve(self, there: Window, parts: Sequence[Array]) -> Array:
        """Return the amounts of some images that explain what is left in a window best."""
        root = np.sqrt(self.weights[there]).ravel()
        matrix = np.stack(parts, axis=1) * root[:, np.newaxis]
        return np.asarray(np.linalg.lstsq(matrix, self.left[there].ravel() * root, rcond=1e-8)[0])

    def width(self, star: Array) -> float:
        """Return the width of a star's image without its neighbours; NaN where noise hides it.

        The image is smoothed by the PSF, so that there is little noise in it, and compared with the
        PSF smoothed likewise; squares of widths add up. What a Gaussian loses half a width from its
        middle gives each.
        """
        x, y, flux = star[:3]
        there, step = self.profile.window(x, y, self.left.shape), self.profile.width / 2
        moves = [(0.0, 0.0), (step, 0.0), (-step, 0.0), (0.0, step), (0.0, -step)]
        cores = [self.profile.at(*there, x + dx, y + dy)[0] for dx, dy in moves]
        own = [float((core * cores[0]).sum()) for core in cores]
        seen = [
            float((core * self.left[there]).sum()) + flux * at
            for core, at in zip(cores, own, strict=True)
        ]
        squares = []
        for middle, *beside in (seen, own):
            if not 0 < np.mean(beside) < middle:
                return np.nan
            squares.append(4.0 * np.log(2.0) * step**2 / np.log(middle / np.mean(beside)))
        square = squares[0] - squares[1] + self.profile.width**2
        return float(np.sqrt(square)) if square > 0 else np.nan

    def take_out_known(self, x: float, y: float) -> Array:
        """Return a star at a place, and take it out; all good pixels of the PSF give its flux."""
        there = self.profile.reach(x, y, self.left.shape)
        value, weights = self.profile.at(*there, x, y)[0], self.weights[there]
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
        x, y, flux = star[:3]
        there = self.profile.window(x, y, self.left.shape)
        value, along_x, along_y = self.profile.at(*there, x, y)
        parts = [value, flux * along_x, flux * along_y, np.ones_like(value)]
        matrix = np.stack([part.ravel() for part in parts], axis=1)
        weighted = matrix * self.weights[there].reshape(-1, 1)
        normal = weighted.T @ matrix
        scale = np.sqrt(np.maximum(normal.diagonal(), np.finfo(float).tiny))
        step = np.linalg.lstsq(
            normal / np.outer(scale, scale), weighted.T @ self.left[there].ravel() / scale, 1e-9
        )[0]
        brighter, dx, dy, _ = step / scale
        self.take_out(star, -1.0)
        limits = np.array(self.left.shape[::-1]) - 0.5
        move = np.clip([dx, dy], -FARTHEST, FARTHEST)
        star[:2] = np.clip(star[:2] + move, -0.5, limits - 1e-6)
        star[2] = max(flux + brighter, 0.0)
        self.take_out(star)


def pixels_at(x: Array, y: Array, shape: tuple[int, ...]) -> tuple[NDArray[np.int_], ...]:
    """Return rows and columns of the pixels at places, or of the nearest in an image."""
    return tuple(
        np.round(at).astype(int).clip(0, n - 1) for at, n in zip((y, x), shape, strict=True)
    )


def _vertices(values: Array, y: NDArray[np.int_], x: NDArray[np.int_], axis: int) -> Array:
    """Return where parabolas through maxima and their neighbours along an axis are highest."""
    at = (y, x)[axis]
    inner = (at > 0) & (at < values.shape[axis] - 1)
    step = np.array([1, 0]) if axis == 0 else np.array([0, 1])
    before, here, after = (
        values[(y + k * inner * step[0], x + k * inner * step[1])] for k in (-1, 0, 1)
    )
    bend = before - 2.0 * here + after
    shift = np.divide(0.5 * (before - after), bend, out=np.zeros(len(at)), where=bend < 0)
    return at + np.clip(shift, -0.5, 0.5)


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
            several, fluxes = search.untangle(
                places[[i, *others]] if others else search.split(place)
            )
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
