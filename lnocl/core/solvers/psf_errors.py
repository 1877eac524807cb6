r"""What PSFs may have wrong, as unknowns of the least squares at a star.

Every real PSF K_j is a little wrong. What the images have is taken to be

.. math:: K_j + \sum_k \theta_k L_{jk} + D_j, \qquad \theta_k \sim N(0, 1),

with the derivatives L of K_j (`slopes_of`), each times the standard deviation of its prior, light
beyond its file and a level of it among them (`lnocl.core.scene.psf_edge`), and the errors D_j of
its pixels, in proportion to the PSF (`PixelErrors`). Images with the same PSF have the same theta,
and those of two PSFs are correlated, as PSFs of one set err together. Where several images are of
one epoch, each has a zero point besides: the light that it has of all sources, relative to the
others.

`lnocl.Observation` has the priors as `psf_error`, the standard deviation of the relative width.
Light outside the stars is taken through the PSF as it is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import scipy.fft
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.ndimage import affine_transform, gaussian_filter

from lnocl.core.scene.arrays import Array
from lnocl.core.scene.cores import fwhm
from lnocl.core.scene.detector import Movable
from lnocl.core.scene.estimate import Estimate
from lnocl.core.scene.observation import Observation
from lnocl.core.scene.psf_edge import psf_edge
from lnocl.core.scene.psf_field import mapped
from lnocl.core.scene.remembered import remembered
from lnocl.core.scene.shifting import Cutout
from lnocl.core.scene.smooth_field import SmoothField
from lnocl.core.scene.transforms import enlarged
from lnocl.core.scene.view import View

# The derivatives: by a stretch and a blur along x, across and along y each, by wings, by a shift,
# by the light beyond the file, by a level of it.
N_SLOPES, N_SHAPES = 11, 6
# Standard deviations over that of the width: of the errors of pixels, relative to the PSF smoothed,
# of zero points, of a shift and of the width of the Lorentzian of wings, both in widths of the PSF.
PIXELS, ZERO_POINTS, SHIFT, WINGS = 0.67, 0.67, 0.5, 0.3
# Errors of pixels are correlated over this, and in proportion to the PSF smoothed over that, pixels
# of the images.
CORRELATED, SMOOTHED = 0.6, 2.0
# The variance of a Gaussian of unit full width at half maximum.
VARIANCE = 1.0 / (8.0 * np.log(2.0))
# Pixels beside a PSF in which the derivatives of its edges ring.
MARGIN = 8
# The correlation of theta of two PSFs: those of a library err together, those of a frame alone.
ALIKE = 0.5
# Full width at half maximum of the narrowest PSFs whose samples hold their shape, in their pixels.
NARROWEST = 2.0
# The mean of the zero points of an epoch is known to this share of each: it is that of the fluxes.
COMMON = 1e-3


def slopes_of(psf: Array, error: float) -> Array:
    r"""Return the derivatives L of a PSF, each times the standard deviation of its prior.

    In spectra, with the frequencies u and v of x and y and w the width of the PSF, these are those
    of a stretch, ``-(u, v) d/d(u, v)`` of the spectrum, of a convolution with a Gaussian,
    ``-2 pi^2 (u^2, 2 u v, v^2)`` times it, with a Lorentzian, ``-2 pi |(u, v)|`` times it, and of a
    shift, ``-2 pi i (u, v)`` times it. The Gaussian is such that a Gaussian PSF is as much wider as
    by the stretch. All of them leave the light of the file as it is.

    Parameters
    ----------
    psf : ndarray of float64, shape (ky, kx)
        Its middle is ``(ky // 2, kx // 2)``.
    error : float
        Standard deviation of the relative width.

    Returns
    -------
    ndarray of float64, shape (N_SLOPES - 2, ky, kx)
        By a stretch along x, across and along y, by a blur likewise, by wings, and by a shift along
        x and y.
    """
    spectrum, stretches, blurs, (v, u) = _spectra(psf, error)
    width = fwhm(psf)
    shift = -1j * SHIFT * error * width * spectrum
    wings = -WINGS * error * width * np.hypot(u, v) * spectrum
    changes = _from_spectra([*stretches, *(blurs * spectrum), wings, u * shift, v * shift], psf)
    won = changes.sum(axis=(1, 2), keepdims=True) / psf.sum()
    return np.asarray(changes - won * psf)


def _spectra(psf: Array, error: float) -> tuple[Array, Array, Array, tuple[Array, Array]]:
    """Return the spectrum of a PSF, its changes by stretches, factors of blurs, and v and u."""
    wide = np.pad(psf, MARGIN)
    y, x = (np.arange(n) - n // 2 for n in wide.shape)
    v, u = 2.0 * np.pi * np.fft.fftfreq(len(y))[:, None], 2.0 * np.pi * np.fft.rfftfreq(len(x))
    along, across = error * scipy.fft.rfft2(np.array([x * wide, y[:, None] * wide]))
    stretches = np.array([-1j * u * along, -1j * (u * across + v * along), -1j * v * across])
    squares = np.array(np.broadcast_arrays(u**2, 2.0 * u * v, v**2))
    blurs = -error * VARIANCE * fwhm(psf) ** 2 * squares
    return np.asarray(scipy.fft.rfft2(wide)), stretches, blurs, (np.asarray(v), np.asarray(u))


def _from_spectra(spectra: Sequence[Array], psf: Array) -> Array:
    """Return arrays of the shape of a PSF from spectra of `_spectra`."""
    shape = tuple(n + 2 * MARGIN for n in psf.shape)
    wide = scipy.fft.irfft2(np.array(spectra), shape)
    return np.asarray(wide[:, MARGIN:-MARGIN, MARGIN:-MARGIN])


def alike(observation: Observation) -> NDArray[np.int_]:
    """Return the number of the PSF that each image has, shape (p,)."""
    psfs = observation.psfs
    firsts = [next(k for k in range(j + 1) if (psfs[k] == psfs[j]).all()) for j in range(len(psfs))]
    return np.unique(firsts, return_inverse=True)[1]


def count(observation: Observation) -> int:
    """Return how many PSFs the images have."""
    return int(alike(observation).max()) + 1


def cost(theta: Array) -> float:
    """Return half the square of theta, (n_psfs, n), over the covariance of its prior."""
    return 0.5 * float(np.sum(theta * (_precision(len(theta)) @ theta)))


def _precision(n_psfs: int) -> Array:
    """Return the inverse of the covariance of one theta over PSFs."""
    return np.asarray(np.linalg.inv((1.0 - ALIKE) * np.eye(n_psfs) + ALIKE))


def with_errors(observation: Observation, theta: Array) -> Observation:
    """Return an observation whose PSFs have changes of shape, shape (n_psfs, N_SHAPES).

    They are stretched and then blurred, as `slopes_of` has it to first order: speckles far from the
    middle move by more than their width. PSFs keep their light and their places. What would be
    below 0 is 0.
    """
    numbers, error = alike(observation), observation.psf_error

    def change(j: int, stack: Array) -> Array:
        by_stretch, by_blur = theta[numbers[j]].reshape(2, 3)
        changed = stack.copy()
        for k, psf in enumerate(stack):
            spectrum, _, blurs, _ = _spectra(_stretched(psf, error * by_stretch), error)
            [changed[k]] = _from_spectra([spectrum * np.exp(np.tensordot(by_blur, blurs, 1))], psf)
        changed = np.where(stack < 0, changed, changed.clip(0.0))
        light = stack.sum(axis=(1, 2), keepdims=True)
        return changed * light / changed.sum(axis=(1, 2), keepdims=True)

    return observation.replace(psfs=mapped(observation.psfs_over_images, change))


def _stretched(psf: Array, by: Array) -> Array:
    """Return a PSF that is wider by shares along x, across, and along y, by quintic splines.

    The map is the exponential of these shares, so that none turns a PSF over.
    """
    if not by.any():
        return psf
    middle = np.array(psf.shape) // 2
    back = expm(-np.array([[by[2], by[1]], [by[1], by[0]]]))
    # Beyond the file the values at its edge are repeated.
    return np.asarray(affine_transform(psf, back, middle - back @ middle, order=5, mode="nearest"))


class PsfErrors:
    """The errors of the PSFs of all images at the stars in a window.

    Parameters
    ----------
    estimate : Estimate
        What is modelled, and how bright it is.
    views : sequence of p View
        The images in the window.

    Attributes
    ----------
    n : int
        Unknowns: the theta of each PSF, N_SLOPES, and then zero points.
    prior : ndarray of float64, shape (n, n)
        The inverse of their covariance.
    """

    def __init__(self, estimate: Estimate, views: Sequence[View]) -> None:
        self._estimate, self._views = estimate, views
        observation = estimate.scene.observation
        self._error, self._numbers = observation.psf_error, alike(observation)
        n, epochs = N_SLOPES * count(observation), observation.epochs
        self._is_one_of_several = np.bincount(epochs)[epochs] > 1
        self._zero_points = n - 1 + np.cumsum(self._is_one_of_several)
        self.n = n + int(self._is_one_of_several.sum())
        self.prior = np.eye(self.n)
        self.prior[:n, :n] = np.kron(_precision(count(observation)), np.eye(N_SLOPES))
        for epoch in np.unique(epochs[self._is_one_of_several]):
            of_epoch = self._zero_points[epochs == epoch]
            self.prior[np.ix_(of_epoch, of_epoch)] += COMMON**-2

    def slopes(self, j: int, model: Array) -> tuple[list[Array], NDArray[np.int_]]:
        """Return the derivatives of the model of an image in its window, and by which unknowns."""
        # A PSF and one that is changed are moved alike by fractions of a pixel.
        slopes = list(self._of_stars(j, self._slopes_at, N_SLOPES))
        unknowns = N_SLOPES * self._numbers[j] + np.arange(N_SLOPES)
        if self._is_one_of_several[j]:
            sources = model - self._views[j].background
            slopes.append(ZERO_POINTS * self._error * sources)
            unknowns = np.append(unknowns, self._zero_points[j])
        return slopes, unknowns

    def pixels(self, shape: tuple[int, int]) -> PixelErrors:
        """Return the errors of pixels, in arrays of a shape, which holds all windows."""
        scatter = self._estimate.scene.observation.psf_scatter
        light, deviations = np.zeros((2, len(self._views), *shape))
        for j in range(len(self._views)):
            own = self._of_stars(j, lambda _, psf, at: psf.at(*at))
            deviation = PIXELS * self._error * gaussian_filter(own, SMOOTHED)
            if len(scatter):
                given = self._of_stars(j, self._scatter_at)
                deviation = np.maximum(deviation, given)
            light[j], deviations[j] = (enlarged(each, shape) for each in (own, deviation))
        return PixelErrors(light, deviations, self._numbers)

    def _slopes_at(self, j: int, psf: Movable, at: Array) -> Cutout:
        """Return the derivatives of a star's image by what its PSF may have wrong."""
        scene, (ny, nx) = self._estimate.scene, self._views[j].window.shape
        height, width = scene.observation.shape
        images = scene.oversample * height, scene.oversample * width
        most = 2 * scene.oversample * ny, 2 * scene.oversample * nx
        return _slopes_at(psf, self._error, most, images, *at.tolist())

    def _scatter_at(self, j: int, psf: Movable, at: Array) -> Cutout:
        scatter = self._estimate.scene.observation.psf_scatter[j]
        return psf.changed(lambda own: own.sum() * scatter).at(*at)

    def _of_stars(
        self, j: int, seen_at: Callable[[int, Movable, Array], Cutout], *several: int
    ) -> Array:
        """Return what the stars in a window show, by what each of unit flux does at its place."""
        scene, view, field = self._estimate.scene, self._views[j], self._estimate.scene.star_field
        seen = np.zeros((*several, *view.window.shape))
        for s in field.reaching(j, view.window[:2], view.window.shape):
            if s < scene.n_stars:  # else it is a halo
                cutout = seen_at(j, field.psfs[j][s], field.places[j][s])
                seen += self._estimate.fluxes[s] * view.cut(cutout)
        return seen


@remembered(2**25)  # all fits of a run ask for the same few
def _slopes_at(
    psf: Movable, error: float, most: tuple[int, int], images: tuple[int, int], x: float, y: float
) -> Cutout:
    """Return the derivatives of the image of a star at (x, y), (N_SLOPES, h, w)."""
    # A PSF and one that is changed are moved alike by fractions of a pixel.
    seen = _with_slopes(psf, error, most, images).at(x, y)
    return seen._replace(values=seen.values[1:] - seen.values[0])


@remembered(2**27)  # as those of all stars
def _with_slopes(
    psf: Movable, error: float, most: tuple[int, int], images: tuple[int, int]
) -> Movable:
    """Return a PSF, and it with each slope, to be placed alike."""
    return psf.changed(partial(_changed, error=error, most=most, images=images))


def _changed(psf: Array, error: float, most: tuple[int, int], images: tuple[int, int]) -> Array:
    """Return a PSF in an array of a shape, and it with each slope, (N_SLOPES + 1, height, width).

    Light beyond the file, which counts where images are larger, has the standard deviation that the
    edge of the PSF tells. A level of all pixels has that of its border, which it is part of. It
    holds at most `psf_error` of the light, as a halo of the PSF may be as level.

    Parameters
    ----------
    psf : ndarray of float64, shape (ky, kx)
        Of whatever light.
    error : float
        Standard deviation of the relative width.
    most : tuple of int
        The shape, of what a star in a window may light.
    images : tuple of int
        The shape of the images, in the pixels of the PSF.
    """
    shape = min(psf.shape[0], most[0]), min(psf.shape[1], most[1])
    near = enlarged(psf, shape, is_centred=True)
    slopes = [enlarged(each, most, is_centred=True) for each in slopes_of(near, error)]
    own, (beyond, level) = enlarged(psf, most, is_centred=True), np.zeros((2, *most))
    light = float(psf.sum())
    if light > 0:
        flat = enlarged(np.ones(psf.shape), most, is_centred=True)
        height = min(_on_border(psf), error * light / psf.size)
        level = height * (flat - psf.size / light * own)
        if (psf.shape < np.array(images)).any():
            edge = psf_edge(psf / light)
            beyond = light * edge.wing(most) - edge.light * own
    return own + np.array([np.zeros(most), *slopes, beyond, level])


def _on_border(psf: Array) -> float:
    """Return the mean of the outermost pixels of a PSF."""
    return float(np.mean([*psf[0], *psf[-1], *psf[1:-1, 0], *psf[1:-1, -1]]))


class PixelErrors:
    r"""The errors of the pixels of PSFs as a random field, in the window of a star.

    .. math:: D_j = \delta - S_j \sum \delta \Big/ \sum S_j, \qquad \delta = a_j C^{1/2} x

    with the light S_j of the stars there, the scatter a_j, correlated over C: no light is won or
    lost. Images with the same PSF have the same x.

    Parameters
    ----------
    light, scatter : ndarray of float64, shape (p, height, width)
        S and a.
    numbers : ndarray of int, shape (p,)
        That of the PSF of each image.

    Attributes
    ----------
    at : ndarray of float64, shape (n_psfs, height, width)
        The current value of x, which is 0.
    scatter : ndarray of float64, shape (p, height, width)
        The a_j, 0 or more.
    """

    def __init__(self, light: Array, scatter: Array, numbers: NDArray[np.int_]) -> None:
        self.scatter, self._numbers = scatter.clip(0.0), numbers
        total = np.maximum(light.sum(axis=(1, 2), keepdims=True), np.finfo(float).tiny)
        self._shares = light / total
        self._smooth = SmoothField(light.shape[1:], CORRELATED)
        self.at = np.zeros((int(numbers.max()) + 1, *light.shape[1:]))

    def forward(self, x: Array) -> Array:
        """Return the changes of the images, shape (p, height, width)."""
        changes = self.scatter * self._smooth.apply(x)[self._numbers]
        return changes - self._shares * changes.sum(axis=(1, 2), keepdims=True)

    def adjoint(self, images: Array) -> Array:
        """Return the transpose of `forward` applied to images, shape (n_psfs, height, width)."""
        back = np.zeros_like(self.at)
        lost = (self._shares * images).sum(axis=(1, 2), keepdims=True)
        np.add.at(back, self._numbers, self.scatter * (images - lost))
        return self._smooth.apply(back)
