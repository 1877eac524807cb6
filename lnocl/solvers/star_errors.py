r"""Standard errors of stars whose extended source is not known either.

The joint Fisher information of the stars' fluxes and positions and of the extended source is

.. math:: \begin{pmatrix} J^T P J & J^T P A L \\ L^T A^T P J & 1 + L^T A^T P A L \end{pmatrix},

with J the derivatives of the models ``m_j``, P one over their variances, A the convolutions, and
``L = a C^(1/2)`` the root of the covariance that the extended source is expected to have
(`lnocl.scene.texture`): what lies under a star nothing but this tells from it. The variance of a
star is a diagonal element of the inverse. The extended source is eliminated by its Schur
complement, with conjugate gradients, in a window round each star.

The same least squares tell how far a star is from where they are least, as the extended source is
not where it is expected or iterations have ended early. The square of that is added.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from lnocl.scene.forward_model import model_images
from lnocl.scene.observation import Array
from lnocl.scene.scene import MIN_MODEL, Scene
from lnocl.scene.shifting import MovablePsf, Stamp
from lnocl.scene.texture import Texture
from lnocl.solvers.fluxes import variances
from lnocl.solvers.least_squares import LeastSquares, LinearImage, SourceError

# Side of the window round a star, and how far off other stars may be that are not taken as known,
# resolutions.
WINDOW, NEIGHBOURS = 9.0, 4.0
# Steps of conjugate gradients at most, and the share of the gradient at which they end.
N_STEPS, FINISHED = 2000, 1e-8


class _Window(NamedTuple):
    """A window of the periodic grid: its first row and column, and its shape."""

    y: int
    x: int
    shape: tuple[int, int]

    def of(self, grid: tuple[int, int]) -> tuple[NDArray[np.int_], NDArray[np.int_]]:
        """Return its rows and columns, to index arrays on the grid with."""
        rows, columns = (
            np.arange(first, first + k) % n
            for first, k, n in zip((self.y, self.x), self.shape, grid, strict=True)
        )
        return rows[:, None], columns

    def moved(self, dx: int, dy: int) -> _Window:
        """Return it moved by whole pixels."""
        return self._replace(y=self.y + dy, x=self.x + dx)


def standard_errors(scene: Scene, extended: Array, fluxes: Array, moves: bool) -> Array:
    """Return the standard errors of stars, with the extended source marginalised.

    Parameters
    ----------
    scene : Scene
        What is modelled, with the stars where they are.
    extended : ndarray of float64, shape (Ny, Nx)
        Extended source, on the grid and scaled.
    fluxes : ndarray of float64, shape (n,)
        Star fluxes, scaled.
    moves : bool
        Whether positions were fitted too; else they are taken as known.

    Returns
    -------
    ndarray of float64, shape (n, 3)
        Of flux, scaled, x and y, pixels; NaN for positions that were not fitted, and where the
        images do not determine a star.
    """
    texture = Texture(scene, extended)
    psfs = [MovablePsf(psf, scene.grid) for psf in scene.scaled_psfs()]
    windows = [_window_round(scene, star, texture.resolution) for star in scene.stars]
    data = _cut_data(scene, extended, fluxes, windows)
    errors = np.full((scene.n_stars, 3), np.nan)
    for star, (row, window) in enumerate(zip(errors, windows, strict=True)):
        held = np.append(star, _neighbours(scene, star, texture.resolution))
        images = [
            _linearise(scene, psfs[j], j, fluxes, held, window, moves, *data[j][star])
            for j in range(scene.n_images)
        ]
        source = _source_error(scene, psfs, texture, window)
        excess = source.images_of((texture.mean - extended)[window.of(scene.grid)])
        images = [
            image._replace(left=image.left - each)
            for image, each in zip(images, excess, strict=True)
        ]
        row[: 3 if moves else 1] = _errors_of_first(images, source, len(held))
    return errors


def _cut_data(
    scene: Scene, extended: Array, fluxes: Array, windows: Sequence[_Window]
) -> list[list[tuple[Array, Array]]]:
    """Return ``g_j - m_j`` and one over its variance, scaled, for each image and window."""
    data = []
    models = model_images(scene, extended, fluxes)
    for j, (counts, model) in enumerate(zip(scene.images(), models, strict=True)):
        weights = 1.0 if scene.weights is None else scene.weights[j]
        total = np.maximum(model, MIN_MODEL)
        precision = np.where(total > MIN_MODEL, scene.scale * weights / total, 0.0)
        left = counts - total
        there = [_in_image(scene, j, window).of(scene.grid) for window in windows]
        data.append([(left[each], precision[each]) for each in there])
    return data


def _in_image(scene: Scene, j: int, window: _Window) -> _Window:
    """Return where a window of the sky lies in image j, to the nearest pixel."""
    dx, dy = np.round(scene.observation.offsets[j]).astype(int).tolist()
    return window.moved(dx, dy)


def _errors_of_first(images: list[LinearImage], source: SourceError, n: int) -> Array:
    """Return the errors of the first of n stars, of its flux and perhaps x and y."""
    k = len(images[0].slopes)
    fit = LeastSquares(images, [source], np.zeros(k), N_STEPS, FINISHED)
    is_determined = np.isfinite(variances(fit.information))
    if not is_determined.any():
        return np.full(k // n, np.nan)
    change, _ = fit.solve(np.zeros(k))
    errors = [
        np.hypot(fit.variance(i) ** 0.5, change[i]) if is_determined[i] else np.nan
        for i in range(0, k, n)
    ]
    return np.array(errors)


def _window_round(scene: Scene, star: Array, resolution: float) -> _Window:
    """Return a window round a star: the whole axis of the grid where it is not twice as long."""
    size = scipy.fft.next_fast_len(int(np.ceil(WINDOW * resolution)), real=True)
    height, width = (size if 2 * size <= n else n for n in scene.grid)
    x, y = np.round(star).astype(int).tolist()
    return _Window(y - height // 2, x - width // 2, (height, width))


def _neighbours(scene: Scene, star: int, resolution: float) -> NDArray[np.int_]:
    """Return which other stars are near one; those beyond are taken as known."""
    size = np.array(scene.grid[::-1])
    away = (scene.stars - scene.stars[star] + size / 2) % size - size / 2
    near = np.flatnonzero(np.hypot(*away.T) <= NEIGHBOURS * resolution)
    return near[near != star]


def _source_error(
    scene: Scene, psfs: Sequence[MovablePsf], texture: Texture, window: _Window
) -> SourceError:
    """Return the error of the extended source in a window, and what it changes there."""
    # Twice the window, in which nothing wraps round; or the grid, on which it does.
    height, width = (min(2 * k, n) for k, n in zip(window.shape, scene.grid, strict=True))
    shape = height, width
    around = _Window(-(height // 2), -(width // 2), shape)
    otfs = []
    for psf, offset in zip(psfs, scene.observation.offsets, strict=True):
        cut = _cut(psf.at(*(offset - np.round(offset))), around, scene.grid)
        otfs.append(scipy.fft.rfft2(np.roll(cut, (around.y, around.x), axis=(0, 1))))
    inside = (..., *map(slice, window.shape))

    def forward(sky: Array) -> Array:
        images = scipy.fft.irfft2(otfs * scipy.fft.rfft2(sky, shape), shape)
        return np.asarray(images[inside])

    def adjoint(images: Iterable[Array]) -> Array:
        spectra = np.conj(otfs) * scipy.fft.rfft2(np.array(images), shape)
        return np.asarray(scipy.fft.irfft2(spectra.sum(axis=0), shape)[inside])

    amplitude = texture.amplitude[window.of(scene.grid)]
    return SourceError(forward, adjoint, amplitude, texture.width)


def _linearise(
    scene: Scene,
    psf: MovablePsf,
    j: int,
    fluxes: Array,
    held: NDArray[np.int_],
    window: _Window,
    moves: bool,
    left: Array,
    precision: Array,
) -> LinearImage:
    """Return image j near the estimate: its slopes in all fluxes, perhaps all x, and all y."""
    there = _in_image(scene, j, window)
    slopes = [_cut(scene.star_stamp(j, s), there, scene.grid) for s in held]
    if moves:
        offset = scene.observation.offsets[j]
        moved = [psf.with_slopes(*(scene.stars[s] + offset)) for s in held]
        for axis in (1, 2):
            for s, (stamp, values) in zip(held, moved, strict=True):
                slope = stamp._replace(values=fluxes[s] * values[axis])
                slopes.append(_cut(slope, there, scene.grid))
    k = len(slopes)
    return LinearImage(np.array(slopes).reshape(k, -1), np.arange(k), left, precision)


def _cut(stamp: Stamp, window: _Window, grid: tuple[int, int]) -> Array:
    """Return what a stamp has in a window."""
    light = np.zeros(window.shape)
    y, x = (stamp.rows(grid) - window.y) % grid[0], (stamp.columns(grid) - window.x) % grid[1]
    y_in, x_in = y < window.shape[0], x < window.shape[1]
    light[np.ix_(y[y_in], x[x_in])] = stamp.values[np.ix_(y_in, x_in)]
    return light
