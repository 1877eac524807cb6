r"""The score of a source at each place of the sky, under a model that does not have it.

A source of flux c at place x adds ``c P_jx`` to image j. Under the model m_j without it, score and
Fisher information of c are

.. math::
    T(x) = \sum_j \langle P_{jx}, w_j (g_j - m_j) / v_j \rangle, \qquad
    F(x) = \sum_j \langle P_{jx}^2, w_j / v_j \rangle,

v_j the variance of the counts. The stars and a level of the sky round x are not known either. Schur
complements take out what the source has in common with them,

.. math::
    T' = T - B^T G^{-1} T_s, \qquad F' = F - B^T G^{-1} B, \qquad W' = W - B^T G^{-1} W_s, \\
    T'' = T' - W' \frac{\overline{T'}}{\overline{W'}}, \qquad
    F'' = F' - \frac{W'^2}{n_D \overline{W'}},

where G is the information of the stars, B what they share with the source, W with a flat sky, and
the bars are means over a disc of n_D pixels, three PSF widths in radius. What is found to be
structure has no part in them: a source there keeps all of F', and ``W'^2 / (n_D mean W')`` is added
to the variance of its score.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from copy import copy
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import scipy.fft
from numpy.typing import NDArray
from scipy import ndimage

from lnocl.core.scene.apertures import FWHM
from lnocl.core.scene.arrays import Array
from lnocl.core.scene.estimate import Estimate
from lnocl.core.scene.forward_model import Model
from lnocl.core.scene.psf_pixels import CORRELATED
from lnocl.core.scene.scene import MIN_MODEL
from lnocl.core.scene.smooth_field import SmoothField
from lnocl.core.scene.texture import ROUND, coarseness, resolution
from lnocl.core.scene.threads import threads
from lnocl.detection.known_stars import KnownStars
from lnocl.detection.maxima import SIGNIFICANT
from lnocl.detection.score_noise import noise_of

# Radius of the disc whose level is taken out, in widths of the PSFs, and of a disc for the counts'
# level over that. Full width of the Gaussian that smooths the estimate, resolutions.
DISC, LARGER, SMOOTHED = 3.0, 2.0, 12.0
# Pixels brighter than so many times the smoothed estimate are cut to that for the level.
PEAKED = 3.0
# Where less than this share of what lies round a place is level, it has none.
FAR = 1e-3
# A level is known where so much of the disc is level.
SOME_LEVEL = 0.1
# Nothing is tested where stars, or the level, leave less than this share of the information, or
# where less was observed than this share of the most.
LEFT, LEFT_BY_LEVEL, SEEN = 0.5, 0.2, 0.05
# Width of rings round stars, resolutions.
RING = 1.0
# Of a score, what is not of each place's own PSF.
OF_ALL = "is_tested", "correlation", "foremost"


class Score(NamedTuple):
    """The score of a source at each place of the sky, stars and level marginalised.

    Attributes
    ----------
    values : ndarray of float64, shape (Ny, Nx)
        The score over its standard deviation for counts of the model without the source.
    score, information, variance : ndarray of float64, shape (Ny, Nx)
        T'', what a unit of flux adds to it, and its variance by noise; of scaled units. That has
        the counts of structure too, where there is some.
    skewness : ndarray of float64, shape (Ny, Nx)
        Of the score, for Poisson counts.
    of_psfs : ndarray of float64, shape (Ny, Nx)
        Its variance by the errors of PSFs that the run has found, over that by noise.
    starlit : ndarray of float64, shape (Ny, Nx)
        The same for PSFs whose relative error is 1.
    is_tested : ndarray of bool, shape (Ny, Nx)
        Where the images tell a source from stars and level.
    correlation : ndarray of float64, shape (Ny, Nx)
        Between the scores at the origin and at each place, of a level sky that is known.
    curvature : ndarray of float64, shape (2, 2, Ny, Nx)
        The mean of ``grad u grad u^T`` for noise u of unit variance, along y and x.
    foremost : int
        The image that tells most.
    """

    values: Array
    score: Array
    information: Array
    variance: Array
    skewness: Array
    of_psfs: Array
    starlit: Array
    is_tested: NDArray[np.bool_]
    correlation: Array
    curvature: Array
    foremost: int


class _Linear(NamedTuple):
    """Images and their model without a source, with one variance of the counts or another.

    Attributes
    ----------
    residuals, precisions, variances : list of p ndarray of float64, shape (ny, nx)
        ``w_j (g_j - m_j) / v_j``, ``w_j / v_j`` and v_j.
    apart : list of p ndarray of float64
        What of the residuals is structure.
    """

    residuals: list[Array]
    precisions: list[Array]
    variances: list[Array]
    apart: list[Array]


class _Spectral(NamedTuple):
    """What follows from the spectrum of a score's noise, as all images have it at each place.

    Attributes
    ----------
    gain, spread : ndarray of float64, shape (Ny, Nx)
        The shares of ``W^2 / (n_D mean W)`` that the level has of information and variance; exact
        where the noise is the same everywhere.
    correlation : ndarray of float64, shape (Ny, Nx)
        Of the score before the level is taken out.
    curvature : ndarray of float64, shape (2, 2, Ny, Nx)
        Of the score after that.
    foremost : int
        The image that tells most.
    """

    gain: Array
    spread: Array
    correlation: Array
    curvature: Array
    foremost: int


class Null:
    """The model without a source: stars, background and a smooth level.

    Parameters
    ----------
    estimate : Estimate
        What is modelled, and how bright it is.
    moves : bool
        Whether positions of stars were fitted.
    psf_errors : tuple of ndarray of float64
        Radii at which rings round stars begin and end, pixels of the images, and the relative error
        of the PSFs in each; of lengths k + 1 and k.

    Attributes
    ----------
    resolution : float
        That of all images together, pixels of the sky.
    disc : float
        Radius of the disc whose level is taken out, pixels of the sky.
    stars : KnownStars
        Of the model.
    rings : ndarray of float64, shape (Ny, Nx)
        Distances from the star that lights each place most, resolutions.
    is_structured : ndarray of bool, shape (Ny, Nx)
        Where the sky has more than its level.
    """

    def __init__(self, estimate: Estimate, moves: bool, psf_errors: tuple[Array, Array]) -> None:
        self.scene = scene = estimate.scene
        self._model = Model(scene)
        self.resolution, self.disc = resolution(scene), DISC * coarseness(scene)
        self._psf_errors = psf_errors
        fluxes = estimate.fluxes
        self.stars = KnownStars(self._model, fluxes[: scene.n_stars], moves)
        self._starlight = list(self._model.starlight(fluxes))
        self._sky = estimate.extended
        self.is_structured = self._is_dark = np.zeros(scene.grid, bool)
        if scene.transmission is not None:
            self._is_dark = (scene.transmission == 0).all(axis=0)
        self.rings = self.stars.rings(RING * self.resolution)
        self._model_sky()
        self.is_structured = self._find_structure()
        if self.is_structured.any():
            self._model_sky()

    def _model_sky(self) -> None:
        """Model the sky by its level, and what is structured apart from it."""
        structured = self.is_structured
        smooth = _level(self._sky, ~(structured | self._is_dark), SMOOTHED * self.resolution)
        structure = np.where(structured, np.maximum(self._sky - smooth, 0.0), 0.0)
        means, light = self._means(smooth), self._model.forward(structure)
        first = self._linearise(means, self._variances(smooth + structure), light)
        # The level as the counts have it: the estimate may hold less or more.
        excess = self._adjoint(first.residuals) - self._adjoint(first.apart)
        excess, response = map(self._mean_in_disc, (excess, self._flat_response(first)))
        has_level = response > FAR * response.max()
        excess = np.divide(excess, response, out=np.zeros_like(excess), where=has_level)
        level = np.maximum(smooth + self._mean_in_disc(excess, LARGER), self._one_count())
        self._linear = self._linearise(means, self._variances(level + structure), light)
        # Whether there is anything is asked of counts of the level alone.
        self._bare = self._linearise(means, self._variances(level), light)

    def _find_structure(self) -> NDArray[np.bool_]:
        """Return where the sky has more than noise, and a resolution round it."""
        score = self.score()
        noise = noise_of(score, self.rings, None)
        values = score.values / noise.scatter
        radius = int(np.ceil(self.resolution))
        disc = np.hypot(*np.ogrid[-radius : radius + 1, -radius : radius + 1]) <= radius
        found = ndimage.binary_dilation(values > SIGNIFICANT, disc)
        return np.asarray(found)

    def _one_count(self) -> float:
        """Return the level of one count in the disc, about the most where there are no counts."""
        seen = float((self._model.sums * self.scene.seen_areas / self.scene.areas**2).sum())
        return 1.0 / (self.scene.scale * seen * np.count_nonzero(self._disc(LARGER)))

    def _means(self, level: Array) -> list[Array]:
        images = self._model.forward(level)
        parts = zip(images, self._model.background, self._starlight, strict=True)
        return [np.maximum(image + known + light, MIN_MODEL) for image, known, light in parts]

    def _variances(self, level: Array) -> list[Array]:
        """Return the variances of the counts.

        A PSF that is too sharp for its pixels rings below 0, and errs by as much light there.
        """
        images = self._model.forward(level)
        parts = zip(images, self._model.background, self._starlight, strict=True)
        return [np.maximum(image + known, MIN_MODEL) + abs(light) for image, known, light in parts]

    def _linearise(self, means: Sequence[Array], variances: list[Array], light: Array) -> _Linear:
        weights = self._model.weights
        each = zip(self.scene.images(), means, variances, weights, strict=True)
        residuals = [w * (image - mean) / v for image, mean, v, w in each]
        precisions = [w / v for v, w in zip(variances, weights, strict=True)]
        apart = [p * each for p, each in zip(precisions, light, strict=True)]
        return _Linear(residuals, precisions, variances, apart)

    def _adjoint(self, images: Sequence[Array], width: float = 0.0) -> Array:
        """Return ``sum_j <P_jx, x_j>`` at each place x of the grid."""
        total = self._model.adjoint(images)
        return _blurred(total, width) if width else total

    def _powers(
        self, images: Sequence[Array], power: int, width: float = 0.0, of_share: int | None = None
    ) -> Iterator[Array]:
        """Yield ``<P_jx^power, x_j>`` at each place x of the grid for each image x_j, 0 or more.

        The transmission there is in it to the same power, or another.
        """
        of_share = power if of_share is None else of_share
        for j, (camera, image) in enumerate(zip(self._model.cameras, images, strict=True)):
            yield camera.squares(image, self.kernel(j, width) ** power, of_share)

    def _sum_of_powers(self, images: Sequence[Array], power: int, width: float = 0.0) -> Array:
        """Return ``sum_j <P_jx^power, x_j>`` at each place x, not below 0 by rounding."""
        return np.maximum(sum(self._powers(images, power, width)), 0.0)

    def kernel(self, j: int, width: float) -> Array:
        """Return what image j shows of a source at the origin, as wide as given."""
        response = self._model.cameras[j].point()
        return _blurred(response, width) if width else response

    def _flat_response(self, linear: _Linear, width: float = 0.0) -> Array:
        of_ones = self._model.of_ones
        flat = [each * ones for each, ones in zip(linear.precisions, of_ones, strict=True)]
        return self._adjoint(flat, width=width)

    def _mean_in_disc(self, sky: Array, larger: float = 1.0) -> Array:
        disc = np.conj(scipy.fft.rfft2(self._disc(larger)))
        return np.asarray(scipy.fft.irfft2(scipy.fft.rfft2(sky) * disc, sky.shape))

    def _disc(self, larger: float = 1.0) -> Array:
        y, x = (np.fft.fftfreq(n, 1.0 / n) for n in self.scene.grid)
        disc = (np.hypot(y[:, None], x) <= larger * self.disc).astype(np.float64)
        return np.asarray(disc / disc.sum())

    def score(self, width: float = 0.0) -> Score:
        """Return the score of a Gaussian source of this full width at half maximum, pixels.

        A width of 0 is a point. Where PSFs vary over the field it is that of the PSFs at each node
        of the field, each with the share that it has of the PSF at a place.
        """
        found = self._score_seen(width)
        if not self.scene.observation.psf_fields:
            return found
        shares, parts = zip(
            *((share, at._score_seen(width)) for share, at in self._at_nodes()), strict=True
        )

        def mixed(name: str) -> Array:
            terms = zip(shares, (getattr(part, name) for part in parts), strict=True)
            return np.asarray(sum(np.where(share, value, 0.0) * share for share, value in terms))

        of_places: dict[str, Any] = {n: mixed(n) for n in Score._fields if n not in OF_ALL}
        found = found._replace(**of_places)
        return found._replace(is_tested=np.isfinite(found.variance))

    def _at_nodes(self) -> Iterator[tuple[Array, Null]]:
        """Yield the share of each node of the PSFs at each place, and the same null there."""
        scene, observation = self.scene, self.scene.observation
        q, fields = scene.oversample, observation.psf_fields
        axes = []
        for k, n in enumerate(scene.grid[::-1]):
            nodes = np.unique(np.concatenate([field.nodes[k] for field in fields]))
            places, ones = (np.arange(n) - (q - 1) / 2.0) / q, np.eye(len(nodes))
            axes.append(
                [(x, np.interp(places, nodes, one)) for x, one in zip(nodes, ones, strict=True)]
            )
        for (x, along), (y, down) in product(*axes):
            share, place = np.outer(down, along), np.array([x, y])
            if share.any():
                at = copy(self)
                psfs = [field.at(*observation.places(j, place)) for j, field in enumerate(fields)]
                at._model = Model(scene.seen_through(np.array(psfs)))
                at.stars = self.stars.beside(at._model)
                yield share, at

    def _score_seen(self, width: float) -> Score:
        found = self._score(self._linear, width)
        if not self.is_structured.any():
            return found
        bare, structured = self._score(self._bare, width), self.is_structured
        of_bare = ("values", "skewness", "of_psfs", "starlit")
        pairs = {name: (getattr(bare, name), getattr(found, name)) for name in of_bare}
        return found._replace(**{k: np.where(structured, *pair) for k, pair in pairs.items()})

    def _score(self, linear: _Linear, width: float) -> Score:
        scale = self.scene.scale
        score = scale * self._adjoint(linear.residuals, width)
        raw, spectral = self._of_images(linear, width)
        flat = scale * self._flat_response(linear, width)
        taken = self.stars.shared(linear.residuals, linear.precisions, width, self.resolution)
        score, flat = score - scale * taken.score, flat - scale * taken.flat
        information = np.maximum(raw - scale * taken.information, 0.0)
        # Sources are tested without those elsewhere, and have no part in the level round others.
        beside = score - scale * self._adjoint(linear.apart, width)
        is_level = ~self.is_structured
        least = SOME_LEVEL * self._mean_in_disc(flat)
        in_disc = np.maximum(self._mean_in_disc(flat * is_level), least)
        in_disc = np.maximum(in_disc, FAR * in_disc.max())
        shared = flat**2 / in_disc / np.count_nonzero(self._disc())
        score = np.where(is_level, beside, score)
        score -= flat * self._mean_in_disc(beside * is_level) / in_disc
        left = np.where(is_level, information - spectral.gain * shared, information)
        variance = np.where(is_level, information - spectral.spread * shared, information + shared)
        is_tested = (information > LEFT * raw) & (variance > 0)
        is_tested &= left * abs(left) > LEFT_BY_LEVEL * information * variance
        is_tested &= self._is_inside() & self._is_seen(linear, width)
        variance = np.where(is_tested, variance, np.inf)
        third = scale * self._sum_of_powers(self._third_moments(linear), 3, width)
        of_psfs, starlit = self._of_psfs(linear, width)
        return Score(
            score / np.sqrt(variance),
            score,
            np.where(is_tested, left, np.inf),
            variance,
            third / np.maximum(variance, np.finfo(float).tiny) ** 1.5,
            of_psfs / variance,
            starlit / variance,
            is_tested,
            spectral.correlation,
            spectral.curvature,
            spectral.foremost,
        )

    def _of_images(self, linear: _Linear, width: float) -> tuple[Array, _Spectral]:
        """Return the information of a source alone, and what follows from the noise of each image.

        Spectra of images count by their share of the information, at each place.
        """
        grid, high = self.scene.grid, 1.0 - scipy.fft.fft2(self._disc()).real
        in_disc, frequencies = np.count_nonzero(self._disc()), _wave_numbers(grid)
        total, correlation, sums = np.zeros(grid), np.zeros(grid), np.zeros((6, *grid))
        told = []
        for j, part in enumerate(self._powers(linear.precisions, 2, width)):
            part = np.maximum(self.scene.scale * part, 0.0)  # but for rounding
            power = abs(scipy.fft.fft2(self.kernel(j, width), workers=threads(grid))) ** 2
            power /= power.sum()
            noise = power * high**2
            moments = [(noise * k).sum() for k in frequencies]
            area = power[0, 0] * power.size / in_disc
            each = 1.0 - (power * high).sum(), 1.0 - noise.sum(), area, *moments
            total += part
            told.append(float(part.sum()))
            correlation += told[-1] * power
            for of_sum, factor in zip(sums, each, strict=True):
                of_sum += factor * part
        shares = np.divide(sums, total, out=np.zeros_like(sums), where=total > 0)
        area = np.where(total > 0, shares[2], 1.0)
        yy, yx, xx = shares[3:] / (1.0 - shares[1])
        correlation = scipy.fft.ifft2(correlation, workers=threads(grid)).real
        return total, _Spectral(
            shares[0] / area,
            shares[1] / area,
            correlation / correlation[0, 0],
            np.array([[yy, yx], [yx, xx]]),
            int(np.argmax(told)),
        )

    def _is_seen(self, linear: _Linear, width: float) -> NDArray[np.bool_]:
        """Return where the images tell as much of a source, beside all light, as elsewhere."""
        depths = [
            float(p.sum()) / max(float(w.sum()), 1.0) * w
            for p, w in zip(linear.precisions, self._model.weights, strict=True)
        ]
        seen = np.asarray(sum(self._powers(depths, 2, width, of_share=1)))
        return np.asarray(seen > SEEN * seen.max())

    def _is_inside(self) -> NDArray[np.bool_]:
        """Return the places of the frame, less its edges along which the grid is periodic."""
        scene, edge = self.scene, math.ceil(self.resolution / 2.0)
        inside = []
        for n, size in zip(scene.observation.sky_shape, scene.grid, strict=True):
            at = np.arange(size)
            first, last = (edge, n - edge) if n == size else (0, n)
            inside.append((at >= first) & (at < last))
        return np.asarray(inside[0][:, None] & inside[1])

    def _third_moments(self, linear: _Linear) -> list[Array]:
        """Return the third moments of the counts' Poisson part, over the cube of their variance."""
        observation, scene = self.scene.observation, self.scene
        ny, nx = observation.shape
        moments = []
        for j, (v, w) in enumerate(zip(linear.variances, self._model.weights, strict=True)):
            of_reading = np.zeros(scene.image_grid)
            of_reading[:ny, :nx] = observation.read_noise[j] ** 2 / scene.scale
            of_reading = np.divide(of_reading, w, out=np.zeros_like(v), where=w > 0)
            moments.append(w * np.maximum(v - of_reading, 0.0) / v**3)
        return moments

    def _of_psfs(self, linear: _Linear, width: float) -> tuple[Array, Array]:
        """Return the variance of the score by PSF errors: those found, and relative ones of 1."""
        # Errors of pixels are correlated over less than a PSF.
        size = min(64, *self.scene.image_grid)
        together = float(SmoothField((size, size), CORRELATED).apply(np.ones((size, size)))[0, 0])
        factor = (self.scene.scale * together) ** 2
        found, whole = (
            factor * self._sum_of_powers(each, 2, width)
            for each in self.stars.squares(linear.precisions, *self._psf_errors)
        )
        return found, whole

    def brightest_structure(self) -> Array:
        """Return the flux that the brightest structure round each place has in a resolution."""
        if not self.is_structured.any():
            return np.zeros(self.scene.grid)
        structure = np.where(self.is_structured, self._sky, 0.0)
        area = math.pi / (4.0 * math.log(2.0)) * self.resolution**2
        seen = area * ndimage.gaussian_filter(structure, self.resolution / FWHM, mode="wrap")
        return np.asarray(
            ndimage.maximum_filter(seen, round(2.0 * ROUND * self.resolution) + 1, mode="wrap")
        )


def _wave_numbers(grid: tuple[int, int]) -> tuple[Array, Array, Array]:
    """Return the products ``k_y k_y``, ``k_y k_x`` and ``k_x k_x`` of the grid's frequencies."""
    ky, kx = (2.0 * np.pi * np.fft.fftfreq(n) for n in grid)
    return (ky**2)[:, None] + 0.0 * kx, ky[:, None] * kx, kx**2 + 0.0 * ky[:, None]


def _level(sky: Array, is_level: NDArray[np.bool_], width: float) -> Array:
    """Return the level of a sky by those of its pixels, without what is narrow in it."""
    share = _blurred(is_level.astype(np.float64), width)
    capped = np.where(is_level, sky, 0.0)
    for most in (PEAKED, None):
        smooth = np.maximum(_blurred(capped, width), 0.0)
        smooth = np.divide(smooth, share, out=np.zeros_like(smooth), where=share > FAR)
        if most is not None:
            capped = np.minimum(capped, most * smooth)
    return smooth


def _blurred(values: Array, width: float) -> Array:
    """Return a periodic array convolved with a Gaussian of this full width at half maximum."""
    deviation = width / FWHM
    v, u = np.fft.fftfreq(values.shape[0])[:, None], np.fft.rfftfreq(values.shape[1])
    transfer = np.exp(-2.0 * (math.pi * deviation) ** 2 * (v**2 + u**2))
    spectrum = scipy.fft.rfft2(values, workers=threads(values.shape)) * transfer
    return np.asarray(scipy.fft.irfft2(spectrum, values.shape, workers=threads(values.shape)))
