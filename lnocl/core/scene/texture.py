r"""What a sky may hold that an estimate of it does not: detail below the resolution.

An estimate is smoother than the sky, and what lies under the core of a star it may give to either.
The sky is expected to be

.. math:: \max(\bar f + a\, C^{1/2} x, 0), \qquad x \sim N(0, 1).

The mean is the estimate f, but under a star's core it continues inwards what lies round it. The
amplitude a is a share of f, smoothed; near a star a share of the brightest there. C is a
correlation over a part of the resolution. How large these are was measured on simulated skies:
docs/validation/errors.md.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import scipy.fft
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from lnocl.core.scene.arrays import Array
from lnocl.core.scene.cores import fwhm
from lnocl.core.scene.detector import pixel_spectrum
from lnocl.core.scene.scene import Scene
from lnocl.core.scene.smooth_field import SmoothField

# Amplitudes, of the extended source and of the brightest near a star.
SHARE, SHARE_NEAR = 0.37, 0.8
# All lengths are in resolutions. Widths of the correlation, of the smoothing of the amplitude, and
# of that near stars.
CORRELATED, SMOOTHED, SMOOTHED_NEAR = 0.4, 0.55, 0.28
# What lies to the first distance of a star is its core, to the second it is near, to the third
# round it; the core ends over a width.
CORE, NEAR, ROUND, EDGE = 0.85, 1.1, 1.65, 0.4
# The farthest that a star may be from the middle of its pixel.
HALF_PIXEL = 0.5**0.5
# Of images with sides of so many pixels or more every third is taken for a median, and so on.
FEWER = 512
# What is expected under the core is at most so many times the mean round it.
STEEPEST = 4.0


class Texture:
    """The skies that an estimate may stand for, as a Gaussian field on the grid.

    Parameters
    ----------
    extended : ndarray of float64, shape (Ny, Nx)
        The estimate of the extended source, on the grid or periodic as that, zero or more.
    stars : ndarray of float64, shape (n, 2)
        Positions of stars there.
    resolution : float
        Full width at half maximum of what all images resolve together, pixels.
    hidden : ndarray of float64, shape (n,), optional
        Radii round the stars in which no image has observed a pixel: all of that is core.

    Attributes
    ----------
    mean, amplitude : ndarray of float64, shape (Ny, Nx)
        Mean and standard deviation, in the unit of `extended`.
    width : float
        Pixels over which the field is correlated (`lnocl.core.scene.smooth_field.SmoothField`).
    """

    def __init__(
        self, extended: Array, stars: Array, resolution: float, hidden: Array | None = None
    ) -> None:
        self._resolution, self.width = resolution, CORRELATED * resolution
        self.mean = extended.copy()
        self.amplitude = SHARE * _smooth(extended, SMOOTHED * resolution)
        self._correlate = SmoothField(extended.shape, self.width).apply
        bright = _smooth(extended, SMOOTHED_NEAR * resolution)
        radii = np.zeros(len(stars)) if hidden is None else hidden
        for star, radius in zip(stars, radii.tolist(), strict=True):
            self._fill(star, radius, extended, bright)

    def _fill(self, star: Array, hidden: float, extended: Array, bright: Array) -> None:
        """Expect the light round a star's core to go on under it; near it vary by the brightest."""
        grid = extended.shape
        half = min(int(np.ceil(ROUND * self._resolution + hidden)), (min(grid) - 1) // 2)
        columns, rows = (round(at) + np.arange(-half, half + 1) for at in star)
        distance = np.hypot((rows - star[1])[:, None], columns - star[0])
        is_seen = distance >= hidden
        distance = np.maximum(distance - hidden, 0.0) / self._resolution
        window = np.ix_(rows % grid[0], columns % grid[1])
        is_round = (distance > CORE) & (distance <= ROUND)
        if not is_round.any():  # the grid is smaller than this
            return
        brightest = bright[window][is_seen & (distance <= ROUND)].max()
        least = np.where(distance <= NEAR, SHARE_NEAR * brightest, 0)
        share = core(distance)
        amplitude = self.amplitude[window]
        if hidden:  # too wide to follow a slope across, and what an estimate holds there is any
            expected = np.full(distance.shape, extended[window][is_round].mean())
            amplitude += share * (SHARE * expected - amplitude)
        else:
            expected = _continued(extended[window], distance, is_round)
        self.mean[window] += share * (expected - self.mean[window])
        self.amplitude[window] = np.maximum(amplitude, least)

    def apply(self, x: Array) -> Array:
        """Return the field ``a C^(1/2) x`` of white noise x."""
        return self.amplitude * self._correlate(x)

    def draw(self, rng: np.random.Generator) -> Array:
        """Return a sky, shape (Ny, Nx)."""
        return np.maximum(self.mean + self.apply(rng.standard_normal(self.mean.shape)), 0.0)


def core(distance: Array) -> Array:
    """Return the core of a star: 1 in its middle, falling to 0 at distances in resolutions."""
    return np.clip((CORE - distance) / EDGE + 1.0, 0.0, 1.0)


def resolution(scene: Scene) -> float:
    """Return the full width at half maximum of what all images resolve together, pixels.

    It is that of the PSF whose OTF is the root of the mean of ``|OTF_j|^2``, each with the
    response of the images' pixels, in pixels of the sky. Images count by what they tell of a flat
    sky. With several skies it is that of the filter which resolves least: components need all.
    """
    if scene.mixing is not None:
        return max(resolution(scene.of_images(which)) for which in scene.mixing.images)
    return _width(sum(d * each for d, each in zip(_depths(scene), _powers(scene), strict=True)))


def coarseness(scene: Scene) -> float:
    """Return the width of the images' PSFs, pixels of the sky.

    It is the root of the mean of squares of their full widths at half maximum. Images count by what
    they tell of a point.
    """
    depths, powers = _depths(scene), list(_powers(scene))
    told = np.array([d * each.sum() for d, each in zip(depths, powers, strict=True)])
    squares = np.array([_width(each) for each in powers]) ** 2
    return float(np.sqrt((told * squares).sum() / told.sum()))


def _powers(scene: Scene) -> Iterator[Array]:
    """Yield ``|OTF_j|^2`` with the response of the images' pixels, on the sky's."""
    psfs, observation = scene.psfs_of_sky(), scene.observation
    if scene.rotations:  # squares, whose sides are even
        n = max(map(len, psfs))
        psfs = [np.pad(psf, (n - len(psf)) // 2) for psf in psfs]
    v, u = (np.fft.fftfreq(n) for n in psfs[0].shape)
    pixel = abs(pixel_spectrum(v[:, None], u, observation)) / observation.oversample**2
    for psf in psfs:
        yield abs(scipy.fft.fft2(psf) * pixel) ** 2


def _width(power: Array) -> float:
    return fwhm(scipy.fft.fftshift(scipy.fft.ifft2(np.sqrt(power)).real))


def _depths(scene: Scene) -> Array:
    """Return the information on a flat sky that each image has, as shares of all, shape (p,).

    Its counts' variance is the median of its pixels, or their mean where most have none. Of many
    pixels some are taken, as that is asked for again and again.
    """
    observation, depths = scene.observation, np.zeros(scene.n_images)
    step = 2 * (math.isqrt(math.prod(observation.shape)) // FEWER) + 1
    exposures = np.broadcast_to(observation.exposure.T, observation.images.T.shape).T
    maps = (each[:, ::step, ::step] for each in (observation.images, observation.mask, exposures))
    for j, (image, mask, exposure) in enumerate(zip(*maps, strict=True)):
        counts = image[~mask]
        if counts.size:
            variance = float(np.median(counts)) or max(float(counts.mean()), 1.0 / counts.size)
            each = float(exposure[~mask].mean()) * scene.seen_areas[j]
            depths[j] = counts.size * each**2 / variance
    return depths / depths.sum()


def _continued(values: Array, distance: Array, is_round: NDArray[np.bool_]) -> Array:
    """Return the exponential of the distance that the inner and outer half of a ring determine."""
    mean = values[is_round].mean()
    middle = distance[is_round].mean()
    halves = is_round & (distance <= middle), is_round & (distance > middle)
    inner, outer = (values[half].mean() if half.any() else 0.0 for half in halves)
    if not (inner > 0 and outer > 0):
        return np.full(values.shape, mean)
    near, far = (distance[half].mean() for half in halves)
    slope = np.log(inner / outer) / (far - near)
    # A logarithm, as the power may overflow.
    power = np.minimum(slope * (near - distance), np.log(STEEPEST * mean / inner))
    return np.asarray(inner * np.exp(power))


def _smooth(sky: Array, width: float) -> Array:
    return np.asarray(gaussian_filter(sky, width, mode="wrap"), np.float64)


def hidden_radii(scene: Scene, resolution: float) -> Array:
    """Return that of `hidden_radius` for each star that is shown, once each, shape (n_shown,)."""
    return np.array([hidden_radius(scene, star, resolution) for star in scene.shown_places])


def hidden_radius(scene: Scene, star: Array, resolution: float) -> float:
    """Return the radius round a star in which no image has observed a pixel, pixels of the sky.

    It is 0 for a star that an image has observed, for one that lies outside the images, and where
    the core of the star, which a resolution has, is wider.
    """
    radius = _hidden_radius(scene, star)
    return radius if radius > CORE * resolution else 0.0


def _hidden_radius(scene: Scene, star: Array) -> float:
    observation, radii = scene.observation, []
    shape = np.array(observation.shape)
    for j, mask in enumerate(observation.mask):
        at = observation.places(j, star)[::-1]
        nearest = np.round(at).astype(int)
        if (nearest < 0).any() or (nearest >= shape).any():
            continue
        if not mask[tuple(nearest)]:
            return 0.0
        away = _to_good_pixel(mask, at)
        if away < np.inf:
            radii.append(max(away - HALF_PIXEL, 0.0) * scene.oversample * observation.scales[j])
    return min(radii, default=0.0)


def _to_good_pixel(mask: NDArray[np.bool_], at: Array) -> float:
    """Return the distance from a place (y, x) to the nearest good pixel; infinite without one."""
    reach, away = 4, np.inf
    while away > reach and reach < 2 * max(mask.shape):
        reach *= 2
        low = np.maximum(np.floor(at).astype(int) - reach, 0)
        high = np.ceil(at).astype(int) + reach + 1
        good = np.argwhere(~mask[low[0] : high[0], low[1] : high[1]]) + low
        away = float(np.hypot(*(good - at).T).min(initial=np.inf))
    return away
