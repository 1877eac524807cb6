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

from lnocl.scene.detector import DetectorPsf, movable_psfs, on_sky
from lnocl.scene.forward_model import add_to_window, sampled, spread
from lnocl.scene.observation import Array
from lnocl.scene.scene import MIN_MODEL, Scene
from lnocl.scene.shifting import MovablePsf, Stamp
from lnocl.scene.texture import Texture, resolution
from lnocl.solvers.fluxes import variances
from lnocl.solvers.least_squares import LeastSquares, LinearImage, SourceError

# Side of the window round a star, and how far off other stars may be that are not taken as known,
# resolutions.
WINDOW, NEIGHBOURS = 9.0, 4.0
# What lies farther from a window has no part in the texture there, resolutions.
MARGIN = 3.0
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

    def finer(self, q: int) -> _Window:
        """Return the pixels of a sky q times as fine that it holds."""
        return _Window(q * self.y, q * self.x, (q * self.shape[0], q * self.shape[1]))


def standard_errors(scene: Scene, sky: Array, star_fluxes: Array, moves: bool) -> Array:
    """Return the standard errors of stars, with the extended source marginalised.

    Parameters
    ----------
    scene : Scene
        What is modelled, with the stars where they are.
    sky : ndarray of float64, shape (Ny, Nx)
        Extended source on the grid, electrons per pixel.
    star_fluxes : ndarray of float64, shape (n,)
        Electrons.
    moves : bool
        Whether positions were fitted too; else they are taken as known.

    Returns
    -------
    ndarray of float64, shape (n, 3)
        Of flux, electrons, x and y, pixels; NaN for positions that were not fitted, and where the
        images do not determine a star.

    Notes
    -----
    All is computed in windows: arrays on the grid would take more memory than the run.
    """
    width = resolution(scene)
    psfs = movable_psfs(scene.scaled_psfs(), scene.observation, scene.image_grid)
    errors = np.full((scene.n_stars, 3), np.nan)
    for star, row in enumerate(errors):
        window = _window_round(scene, scene.stars[star], width)
        held = np.append(star, _neighbours(scene, star, width))
        there, texture = _texture_in(window, scene, sky, width)
        source = _source_error(scene, psfs, texture.amplitude[there], texture.width, window)
        on_sky_window = window.finer(scene.oversample).of(scene.grid)
        beyond = source.images_of(texture.mean[there] - sky[on_sky_window] / scene.unit)
        images = [
            _linearise(scene, j, sky, star_fluxes, held, window, moves, beyond[j])
            for j in range(scene.n_images)
        ]
        row[: 3 if moves else 1] = _errors_of_first(images, source, len(held))
    errors[:, 0] *= scene.unit
    return errors


def _texture_in(
    window: _Window, scene: Scene, sky: Array, width: float
) -> tuple[tuple[slice, slice], Texture]:
    """Return the texture round a window of the images, and where the window lies in it."""
    window = window.finer(scene.oversample)
    margin = int(np.ceil(MARGIN * width))
    (y, height), (x, breadth) = (
        (first - margin, k + 2 * margin) if k + 2 * margin < n else (first, n)
        for first, k, n in zip((window.y, window.x), window.shape, scene.grid, strict=True)
    )
    around = _Window(y, x, (height, breadth))
    stars = (on_sky(scene.stars, scene.oversample) - (x, y)) % scene.grid[::-1]
    inside = (stars < (breadth, height)).all(axis=1)
    there = tuple(
        slice(first - start, first - start + k)
        for first, start, k in zip((window.y, window.x), (y, x), window.shape, strict=True)
    )
    extended = sky[around.of(scene.grid)] / scene.unit
    return (there[0], there[1]), Texture(extended, stars[inside], width)


def _observed(scene: Scene, j: int, there: _Window) -> tuple[Array, Array, Array]:
    """Return counts, background and weights of image j in a window, as `Scene` has them."""
    observation, (ny, nx) = scene.observation, scene.observation.shape
    rows, columns = there.of(scene.image_grid)
    inside = (rows < ny) & (columns < nx)
    pixels = np.minimum(rows, ny - 1), np.minimum(columns, nx - 1)
    counts = np.where(inside, observation.images[j][pixels] / scene.scale, 0.0)
    if observation.background.ndim == 1:
        background = np.full(there.shape, observation.background[j] / scene.scale)
    else:
        known = observation.background[j][pixels] / scene.scale
        background = np.where(inside, known, 1.0)
    if scene.weights is None:
        return counts, background, np.ones(there.shape)
    weights = scene.weights[j][rows, columns].astype(np.float64)
    if scene.has_exposure_map:
        seen = weights > 0
        counts = np.divide(counts, weights, out=np.zeros(there.shape), where=seen)
        background = np.divide(background, weights, out=np.ones(there.shape), where=seen)
    return counts, background, weights


def _in_image(scene: Scene, j: int, window: _Window) -> _Window:
    """Return where a window of an image without offset lies in image j, to the nearest pixel."""
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
    length = int(np.ceil(WINDOW * resolution / scene.oversample))
    size = scipy.fft.next_fast_len(length, real=True)
    height, width = (size if 2 * size <= n else n for n in scene.image_grid)
    x, y = np.round(star).astype(int).tolist()
    return _Window(y - height // 2, x - width // 2, (height, width))


def _neighbours(scene: Scene, star: int, resolution: float) -> NDArray[np.int_]:
    """Return which other stars are near one; those beyond are taken as known."""
    size = np.array(scene.grid[::-1])
    away = scene.oversample * (scene.stars - scene.stars[star])
    away = (away + size / 2) % size - size / 2
    near = np.flatnonzero(np.hypot(*away.T) <= NEIGHBOURS * resolution)
    return near[near != star]


def _source_error(
    scene: Scene,
    psfs: Sequence[MovablePsf | DetectorPsf],
    amplitude: Array,
    width: float,
    window: _Window,
) -> SourceError:
    """Return the error of the extended source in a window of the images, and its change there."""
    q, window = scene.oversample, window.finer(scene.oversample)
    # Twice the window, in which nothing wraps round; or the grid, on which it does.
    height, breadth = (min(2 * k, n) for k, n in zip(window.shape, scene.grid, strict=True))
    shape = height, breadth
    around = _Window(-(height // 2), -(breadth // 2), shape)
    otfs = []
    for psf, offset in zip(psfs, scene.observation.offsets, strict=True):
        cut = _cut(psf.response(*(offset - np.round(offset))), around, scene.grid)
        otfs.append(scipy.fft.rfft2(np.roll(cut, (around.y, around.x), axis=(0, 1))))
    inside = (..., *map(slice, window.shape))

    def forward(sky: Array) -> Array:
        images = scipy.fft.irfft2(otfs * scipy.fft.rfft2(sky, shape), shape)
        return np.asarray(sampled(images[inside], q))

    def adjoint(images: Iterable[Array]) -> Array:
        spectra = np.conj(otfs) * scipy.fft.rfft2(spread(np.array(images), q), shape)
        return np.asarray(scipy.fft.irfft2(spectra.sum(axis=0), shape)[inside])

    return SourceError(forward, adjoint, amplitude, width)


def _linearise(
    scene: Scene,
    j: int,
    sky: Array,
    star_fluxes: Array,
    held: NDArray[np.int_],
    window: _Window,
    moves: bool,
    beyond: Array,
) -> LinearImage:
    """Return image j near the estimate: its slopes in all fluxes, perhaps all x, and all y.

    `beyond` is the light of the sky that is expected, less that of the estimate.
    """
    there = _in_image(scene, j, window)
    counts, background, weights = _observed(scene, j, there)
    model = background.copy()
    first = there.y % scene.image_grid[0], there.x % scene.image_grid[1]
    add_to_window(model, scene, sky, np.zeros_like(star_fluxes), j, first)
    for stamp, flux in zip(scene.star_field.stamps[j], star_fluxes, strict=True):
        model += flux / scene.unit * _cut(stamp, there, scene.image_grid)
    total = np.maximum(model, MIN_MODEL)
    precision = np.where(total > MIN_MODEL, scene.scale * weights / total, 0.0)
    slopes = [_cut(scene.star_stamp(j, s), there, scene.image_grid) for s in held]
    if moves:
        offset, psfs = scene.observation.offsets[j], scene.star_field.psfs[j]
        moved = [psfs[s].with_slopes(*(scene.stars[s] + offset)) for s in held]
        for axis in (1, 2):
            for s, (stamp, values) in zip(held, moved, strict=True):
                slope = stamp._replace(values=star_fluxes[s] / scene.unit * values[axis])
                slopes.append(_cut(slope, there, scene.image_grid))
    k, left = len(slopes), counts - total - beyond
    return LinearImage(np.array(slopes).reshape(k, -1), np.arange(k), left, precision)


def _cut(stamp: Stamp, window: _Window, grid: tuple[int, int]) -> Array:
    """Return the values of a stamp that lie in a window, and 0 elsewhere."""
    light = np.zeros(window.shape)
    y, x = (stamp.rows(grid) - window.y) % grid[0], (stamp.columns(grid) - window.x) % grid[1]
    y_in, x_in = y < window.shape[0], x < window.shape[1]
    light[np.ix_(y[y_in], x[x_in])] = stamp.values[np.ix_(y_in, x_in)]
    return light
