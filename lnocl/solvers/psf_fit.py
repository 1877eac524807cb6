r"""PSFs from the images themselves: a few parameters of each, the extended source marginalised.

The model of image j is ``m_j = A_j f + sum_s c_s P_js + b_j``, all of which hangs on the
parameters theta_j of PSF j. Near an estimate

.. math:: g_j \approx m_j + J \eta + A_j (a \psi), \qquad \psi \sim N(0, C)

with the changes eta of parameters, fluxes and positions, J the derivatives of the models, and an
error of the extended source that is as large as it is, smoothed, a, and correlated over C. Both are
fitted at once, weighted by 1 / m_j: eta is eliminated, psi found by conjugate gradients. Where f is
held instead, it takes up a part of what is wrong with the PSFs, and eta lags and is biased.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.fft
import scipy.linalg
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from lnocl.scene.forward_model import Model
from lnocl.scene.observation import Array
from lnocl.scene.psf_families import PsfFamilies
from lnocl.scene.scene import MIN_MODEL, Scene
from lnocl.solvers.fluxes import MAX_FADING

# The error of the extended source is correlated over this, pixels, and as large as it is smoothed
# over that.
CORRELATED, SMOOTHED = 1.5, 4.0
# Steps of conjugate gradients, and the share of the gradient at which they end.
N_STEPS, FINISHED = 40, 1e-4
# Of the information's diagonal.
ROUNDING = 1e-12
# A step moves no parameter by more of its prior's standard deviations, and no star by more pixels.
MAX_STEP, MAX_MOVE = 3.0, 0.5


class PsfStep(NamedTuple):
    """Changes of PSF parameters, shape (p, k), and the stars' new fluxes and positions."""

    parameters: Array
    fluxes: Array
    positions: Array


def step(
    scene: Scene,
    families: PsfFamilies,
    parameters: Array,
    extended: Array,
    fluxes: Array,
    moves: bool,
) -> PsfStep:
    """Return a step of Gauss and Newton for PSFs and stars, the extended source marginalised.

    Parameters
    ----------
    scene : Scene
        Its PSFs are those of the parameters.
    families : PsfFamilies
        What the PSFs may be.
    parameters : ndarray of float64, shape (p, k)
        The present ones.
    extended : ndarray of float64, shape (Ny, Nx)
        Extended source, on the grid and scaled.
    fluxes : ndarray of float64, shape (n,)
        Star fluxes, scaled.
    moves : bool
        Whether the stars' positions are fitted too.
    """
    model = Model(scene)
    images = _linearise(scene, families, model, extended, fluxes, moves)
    n, n_psf = len(fluxes), parameters.size
    at, prior = np.zeros((2, n_psf + n * (3 if moves else 1)))
    at[:n_psf], prior[:n_psf] = parameters.ravel(), np.tile(families.prior**-2.0, len(parameters))
    change = _Fit(images, model, _amplitude(extended), prior).solve(at)
    longest = (abs(change[:n_psf].reshape(parameters.shape)) / families.prior).max(initial=0.0)
    change *= MAX_STEP / max(longest, MAX_STEP)
    to = np.maximum(fluxes + change[n_psf : n_psf + n], MAX_FADING * fluxes)
    moved = change[n_psf + n :].reshape(-1, n).T.clip(-MAX_MOVE, MAX_MOVE)
    of_psfs = change[:n_psf].reshape(parameters.shape)
    return PsfStep(of_psfs, to, scene.stars + moved if moves else scene.stars)


class Misfit(NamedTuple):
    """How far an estimate is from the images, whatever error its extended source may have.

    Attributes
    ----------
    square : float
        The least squares of `_Fit` with the PSFs held: a sum of squares of residuals, weighted, and
        of psi. Noise alone gives `n_pixels`.
    n_pixels : int
        Pixels observed.
    """

    square: float
    n_pixels: int

    @property
    def reduced(self) -> float:
        """The square over its expectation: 1 where there is noise alone."""
        return self.square / self.n_pixels


def misfit(scene: Scene, extended: Array, fluxes: Array) -> Misfit:
    """Return how well the PSFs of a scene fit, with fluxes fitted and the source marginalised."""
    psfs, model = scene.observation.psfs, Model(scene)
    held = PsfFamilies((), psfs, psfs, psfs)
    images = _linearise(scene, held, model, extended, fluxes, False)
    fit = _Fit(images, model, _amplitude(extended), np.zeros(len(fluxes)))
    n_pixels = sum(int(np.count_nonzero(each.precision)) for each in images)
    return Misfit(fit.least_square(), n_pixels)


def _amplitude(extended: Array) -> Array:
    """Return how large the error of an extended source may be."""
    return np.asarray(gaussian_filter(extended, SMOOTHED, mode="wrap"), np.float64)


class _Image(NamedTuple):
    """One image near an estimate.

    Attributes
    ----------
    slopes : ndarray of float64, shape (k, Ny * Nx)
        Derivatives of its model with respect to its k unknowns.
    unknowns : ndarray of int, shape (k,)
        Which they are.
    left : ndarray of float64, shape (Ny, Nx)
        ``g_j - m_j``.
    precision : ndarray of float64, shape (Ny, Nx)
        One over the variance of that, for Poisson counts.
    """

    slopes: Array
    unknowns: NDArray[np.int_]
    left: Array
    precision: Array


def _linearise(
    scene: Scene,
    families: PsfFamilies,
    model: Model,
    extended: Array,
    fluxes: Array,
    moves: bool,
) -> list[_Image]:
    p, k, n = scene.n_images, len(families.prior), len(fluxes)
    shared = p * k + np.arange(n * (3 if moves else 1))
    diffuse, images = model.forward(extended), []
    for j, (counts, weights) in enumerate(zip(scene.images(), model.weights, strict=True)):
        stars = [scene.star_image(j, s) for s in range(n)]
        light = diffuse[j] + sum(c * star for c, star in zip(fluxes, stars, strict=True))
        total = np.maximum(light + model.background[j], MIN_MODEL)
        slopes = [*_psf_slopes(scene, families, j, light, extended, fluxes), *stars]
        if moves:
            slopes += _star_slopes(stars, fluxes)
        images.append(
            _Image(
                np.array(slopes).reshape(len(slopes), -1),
                np.concatenate([np.arange(j * k, (j + 1) * k), shared]),
                counts - total,
                np.where(total > MIN_MODEL, scene.scale * weights / total, 0.0),
            )
        )
    return images


def _psf_slopes(
    scene: Scene, families: PsfFamilies, j: int, light: Array, extended: Array, fluxes: Array
) -> Iterator[Array]:
    """Yield the derivatives of a model with respect to the parameters of its PSF."""
    factors, modes = families.slopes(j, scene.grid)
    whole = scipy.fft.rfft2(light)
    for factor in factors:
        yield scipy.fft.irfft2(factor * whole, scene.grid)
    if not modes:
        return
    u, v = _frequencies(scene.grid)
    dx, dy = scene.observation.offsets[j]
    sky = scipy.fft.rfft2(extended)
    for c, (x, y) in zip(fluxes, scene.stars, strict=True):
        sky = sky + c * np.exp(-2j * np.pi * (u * x + v * y))
    sky *= scene.gains[j] * np.exp(-2j * np.pi * (u * dx + v * dy))
    for mode in modes:
        yield scipy.fft.irfft2(mode * sky, scene.grid)


def _star_slopes(stars: Sequence[Array], fluxes: Array) -> list[Array]:
    """Return the derivatives of star images with respect to all x, and all y."""
    slopes = []
    for axis in (0, 1):
        for c, star in zip(fluxes, stars, strict=True):
            factor = -2j * np.pi * _frequencies(star.shape)[axis]
            slopes.append(c * scipy.fft.irfft2(factor * scipy.fft.rfft2(star), star.shape))
    return slopes


def _frequencies(grid: tuple[int, ...]) -> tuple[Any, Any]:
    """Return the frequencies along x and y of a real transform."""
    return np.fft.rfftfreq(grid[1])[None, :], np.fft.fftfreq(grid[0])[:, None]


class _Fit:
    """The least squares of unknowns and of the error of the extended source.

    Parameters
    ----------
    images : list of _Image
        The images.
    model : Model
        For the A_j.
    amplitude : ndarray of float64, shape (Ny, Nx)
        a, how large the error of the extended source may be.
    prior : ndarray of float64, shape (k,)
        One over the variance of the prior of each unknown, 0 for none; its mean is 0.
    """

    def __init__(self, images: list[_Image], model: Model, amplitude: Array, prior: Array) -> None:
        self._images, self._model = images, model
        self._amplitude, self._prior, self._grid = amplitude, prior, model.shape[1:]
        u, v = _frequencies(self._grid)
        root = np.exp(-((np.pi * CORRELATED) ** 2) * (u**2 + v**2))
        self._root = root / np.sqrt(scipy.fft.irfft2(root**2, self._grid)[0, 0])
        information = np.diag(prior)
        for each in images:
            block = (each.slopes * each.precision.ravel()) @ each.slopes.T
            information[np.ix_(each.unknowns, each.unknowns)] += block
        self._units = 1.0 / np.sqrt(np.maximum(np.diag(information), np.finfo(float).tiny))
        scaled = information * self._units * self._units[:, None]
        # Stars that nothing tells apart leave it singular.
        self._factor = scipy.linalg.cho_factor(scaled + ROUNDING * np.eye(len(prior)))

    def solve(self, at: Array) -> Array:
        """Return the change of the unknowns from where they are."""
        return self._solve(self._prior * at)[0]

    def least_square(self) -> float:
        """Return the least sum of squares, from unknowns at the means of their priors."""
        change, psi = self._solve(np.zeros_like(self._prior))
        left = self._left() - self._changes(change) - self._spread(psi)
        squares = [
            float((e.precision * x * x).sum()) for e, x in zip(self._images, left, strict=True)
        ]
        return sum(squares) + float((psi * psi).sum() + self._prior @ change**2)

    def _left(self) -> Array:
        return np.array([each.left for each in self._images])

    def _solve(self, pull: Array) -> tuple[Array, Array]:
        """Return the change of the unknowns, and psi."""
        left = self._left()
        direct = self._invert(self._moments(left) - pull)
        psi = self._find_psi(self._spread_adjoint(left - self._changes(direct)))
        return self._invert(self._moments(left - self._spread(psi)) - pull), psi

    def _find_psi(self, wanted: Array) -> Array:
        """Return the error of the extended source, by conjugate gradients."""
        psi, rest, along = np.zeros_like(wanted), wanted, wanted
        square = first = float((rest * rest).sum())
        for _ in range(N_STEPS):
            if square <= FINISHED**2 * first:
                break
            image = self._curvature(along)
            share = square / float((along * image).sum())
            psi, rest = psi + share * along, rest - share * image
            before, square = square, float((rest * rest).sum())
            along = rest + square / before * along
        return psi

    def _curvature(self, psi: Array) -> Array:
        """Return the second derivative along psi, the unknowns following it."""
        images = self._spread(psi)
        images -= self._changes(self._invert(self._moments(images)))
        return psi + self._spread_adjoint(images)

    def _spread(self, psi: Array) -> Array:
        """Return the ``A_j (a C^(1/2) psi)``, shape (p, Ny, Nx)."""
        return self._model.forward(self._amplitude * self._correlate(psi))

    def _spread_adjoint(self, images: Array) -> Array:
        weighted = (each.precision * x for each, x in zip(self._images, images, strict=True))
        return self._correlate(self._amplitude * self._model.adjoint(weighted))

    def _correlate(self, field: Array) -> Array:
        spectrum = self._root * scipy.fft.rfft2(field, workers=-1)
        return np.asarray(scipy.fft.irfft2(spectrum, self._grid, workers=-1), np.float64)

    def _moments(self, images: Array) -> Array:
        """Return the products of images with the slopes, weighted."""
        moments = np.zeros(len(self._prior))
        for each, image in zip(self._images, images, strict=True):
            moments[each.unknowns] += each.slopes @ (each.precision * image).ravel()
        return moments

    def _changes(self, change: Array) -> Array:
        """Return the changes of the models, shape (p, Ny, Nx), where the unknowns change."""
        changes = [change[each.unknowns] @ each.slopes for each in self._images]
        return np.array(changes).reshape(self._model.shape)

    def _invert(self, moments: Array) -> Array:
        return np.asarray(self._units * scipy.linalg.cho_solve(self._factor, self._units * moments))
