"""The least squares of a star and of the extended source round it, in a window.

The extended source is a field of the covariance that `lnocl.scene.texture` expects, and a level of
about its mean there: an estimate that is positive holds light where there is none. So the fluxes
and positions of stars, and their errors, depend on no iteration. For errors the amounts of halos
are unknown too: what the images tell of them beyond the window is their prior in it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from lnocl.scene.arrays import Array
from lnocl.scene.camera import Camera, Ranges, adjoint_of, ranges, seen_by
from lnocl.scene.estimate import Estimate
from lnocl.scene.forward_model import add_to_window
from lnocl.scene.scene import MIN_MODEL, Scene
from lnocl.scene.shifting import Cutout
from lnocl.scene.stars import along_sky
from lnocl.scene.texture import Texture, hidden_radii, hidden_radius, resolution
from lnocl.solvers.fluxes import precision
from lnocl.solvers.least_squares import Field, LeastSquares, LevelError, LinearImage, SourceError
from lnocl.solvers.levels import planes

# Side of the window round a star, and how far off other stars may be that are not taken as known,
# resolutions.
WINDOW, NEIGHBOURS = 9.0, 4.0
# What lies farther from a window has no part in the texture there, resolutions.
MARGIN = 3.0
# Steps of conjugate gradients at most.
N_STEPS = 2000


class Window(NamedTuple):
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

    @property
    def ranges(self) -> Ranges:
        """Its rows and columns, without an end."""
        return ranges((self.y, self.x), self.shape)

    def finer(self, q: int) -> Window:
        """Return the pixels of a sky q times as fine that it holds."""
        return Window(q * self.y, q * self.x, (q * self.shape[0], q * self.shape[1]))


class Surroundings:
    """What the windows of all stars of an estimate share.

    Parameters
    ----------
    estimate : Estimate
        What is modelled, and how bright it is.
    moves : bool
        Whether positions are unknown too; else they are taken as known.
    raised : ndarray of float64, shape (n_shapes,), optional
        How many times the variance of each halo is that with the extended source known
        (`lnocl.solvers.halos.HaloErrors`). Halos are unknown then; by default they are known.

    Attributes
    ----------
    width : float
        The resolution, pixels of the sky.
    hidden : ndarray of float64, shape (n_shown,)
        Radii round stars that are shown in which no image has observed a pixel, pixels of the sky.
    n_shapes : int
        Halos of each image that are unknown.
    """

    def __init__(self, estimate: Estimate, moves: bool, raised: Array | None = None) -> None:
        self.estimate, self.moves = estimate, moves
        self.scene = scene = estimate.scene
        self.width = resolution(scene)
        self.hidden = hidden_radii(scene, self.width)
        self.cameras = [Camera(scene, j) for j in range(scene.n_images)]
        self.n_shapes = 0 if raised is None else len(raised)
        self._roots = np.zeros(0) if raised is None else raised**-0.5
        self._precisions = self._find_precisions() if self.n_shapes else []

    def _find_precisions(self) -> list[Array]:
        scene = self.scene
        weights = np.ones((1, 1, 1)) if scene.weights is None else scene.weights
        weights = np.broadcast_to(weights, (scene.n_images, *scene.image_grid))
        models = self.estimate.models()
        return [precision(scene, model, w) for model, w in zip(models, weights, strict=True)]

    def halos(self, j: int) -> list[Cutout]:
        """Return the halos of image j that are unknown, for an amount of 1."""
        scene, p = self.scene, self.scene.n_images
        return [scene.star_cutout(j, scene.n_stars + h * p + j) for h in range(self.n_shapes)]

    def beyond(self, j: int, window: Window) -> Array:
        """Return what image j tells of its halos beyond a window, the extended source unknown.

        That is their information, shape (n_shapes, n_shapes), less by the factors `raised`.
        """
        precisions = self._precisions[j].copy()
        precisions[window.of(self.scene.image_grid)] = 0.0
        halos = np.array([halo.on_grid(self.scene.image_grid) for halo in self.halos(j)])
        halos *= self._roots[:, None, None]
        return np.asarray(np.einsum("hyx,yx,iyx->hi", halos, precisions, halos, optimize=True))


class NearStar:
    """One star, those near it, and the extended source round them.

    All is computed in a window: arrays on the grid would take more memory than the run.

    Parameters
    ----------
    around : Surroundings
        The estimate.
    star : int
        The star.
    finished : float
        The share of the gradient at which conjugate gradients end.

    Attributes
    ----------
    window : Window
        The pixels of the images, without offset.
    held : ndarray of int, shape (n_held,)
        Stars that are fitted: this, which is the first, and those near it.
    unknowns : ndarray of int, shape (n_held, 1 or 3)
        Those of each: its flux, and perhaps x and y, which it has in all epochs.
    n_of_stars : int
        Unknowns of all: fluxes, perhaps all x, and all y. Halos follow, shape by shape.
    resolution : float
        What all images resolve together, pixels of the sky.
    hidden : float
        The radius round the star in which no image has observed a pixel, pixels of the sky.
    source : SourceError
        The extended source less its expected mean, in the window.
    expected : ndarray of float64
        That mean less the estimate, in the window of the sky, scaled.
    """

    def __init__(self, around: Surroundings, star: int, finished: float) -> None:
        scene, width = around.scene, around.width
        self.hidden = hidden_radius(scene, scene.stars[star], width)
        self.window = _window_round(scene, scene.stars[star], WINDOW * width + 2.0 * self.hidden)
        held = np.append(star, _neighbours(scene, star, width))
        there, texture = _texture_in(self.window, around)
        self.source = self._source_error(around, texture.amplitude[there], texture.width)
        self.held, self.n_held, self.resolution = held, len(held), width
        self._finished, self.unknowns = finished, _unknowns(held, scene.n_epochs, around.moves)
        self.n_of_stars = int(self.unknowns.max()) + 1
        self.expected = texture.mean[there] - around.estimate.part(self.places(scene))
        level = float(texture.mean[there].mean())
        self._level = LevelError(level, self._responses(around), self.window.shape)
        beyond = self.source.images_of(self.expected)
        self._images = [self._linearise(around, j, held, each) for j, each in enumerate(beyond)]
        self._prior = self._prior_of_halos(around)

    def _responses(self, around: Surroundings) -> Array:
        """Return what a flat sky of ones is in the window of each image."""
        scene, window = around.scene, self.window
        if scene.transmission is None:
            return (scene.gains * scene.areas)[:, None, None]
        ones = np.broadcast_to(1.0, scene.grid)
        seen = (
            camera.part(ones, _in_image(scene, j, window).ranges)
            for j, camera in enumerate(around.cameras)
        )
        return np.array([_padded(each, window.shape) for each in seen])

    def places(self, scene: Scene) -> tuple[NDArray[np.int_], NDArray[np.int_]]:
        """Return the rows and columns of the window in the sky, on the grid."""
        return self.window.finer(scene.oversample).of(scene.grid)

    def level_shares(self, scene: Scene, change: Array) -> Array:
        """Return how much an unknown falls where levels of the background rise, shape (p, 3).

        `change` is its change by each residual in the window, shape (p, height, width).
        """
        shares = np.zeros((scene.n_images, 3))
        for j, each in enumerate(change):
            there = _in_image(scene, j, self.window)
            shapes = _planes_in(scene, j, there)
            shares[j] = [np.vdot(each, _padded(shape, each.shape)) for shape in shapes]
        return shares

    @cached_property
    def fit(self) -> LeastSquares:
        """The least squares of stars, halos, and extended source and its level."""
        fields: list[Field] = [self.source, self._level]
        return LeastSquares(self._images, fields, self._prior, N_STEPS, self._finished)

    def _prior_of_halos(self, around: Surroundings) -> Array:
        p, k = around.scene.n_images, self.n_of_stars
        prior = np.zeros((k + around.n_shapes * p,) * 2)
        if around.n_shapes:
            for j in range(p):
                there = _in_image(around.scene, j, self.window)
                prior[k + j :: p, k + j :: p] = around.beyond(j, there)
        return prior

    def _source_error(self, around: Surroundings, amplitude: Array, width: float) -> SourceError:
        """Return the error of the extended source in the window, and its change there."""
        scene, window = around.scene, self.window
        sky = window.finer(scene.oversample).ranges
        there = [_in_image(scene, j, window).ranges for j in range(scene.n_images)]
        windows = [
            camera.window(seen, sky) for camera, seen in zip(around.cameras, there, strict=True)
        ]

        def forward(sky: Array) -> Array:
            return np.array([_padded(each, window.shape) for each in seen_by(windows, sky)])

        def adjoint(images: Iterable[Array]) -> Array:
            pairs = zip(windows, images, strict=True)
            held = (image[: each.shape[0], : each.shape[1]] for each, image in pairs)
            return adjoint_of(windows, held)

        return SourceError(forward, adjoint, amplitude, width)

    def _linearise(
        self, around: Surroundings, j: int, held: NDArray[np.int_], beyond: Array
    ) -> LinearImage:
        """Return image j near the estimate: its slopes in all fluxes, perhaps all x, and all y.

        `beyond` is the light of the sky that is expected, less that of the estimate.
        """
        scene, grid = around.scene, around.scene.image_grid
        there = _in_image(scene, j, self.window)
        counts, background, weights = _observed(scene, j, there)
        # Of images that are turned the grid is no period, so the window is not moved into it.
        model, first, shape = background.copy(), (there.y, there.x), self.window.shape
        add_to_window(model, around.estimate, j, first)
        total = np.maximum(model, MIN_MODEL)
        lit = np.flatnonzero(scene.shown[held, j])
        slopes = [_cut(scene.star_cutout(j, s), there, grid) for s in held[lit]]
        if around.moves:
            psfs, places = scene.star_field.psfs[j], scene.star_field.places[j]
            turn = scene.observation.turns[j]
            moved = [along_sky(psfs[s].with_slopes(*places[s]), turn) for s in held[lit]]
            for axis in (1, 2):
                fluxes = around.estimate.fluxes[held[lit]]
                for flux, each in zip(fluxes, moved, strict=True):
                    slope = each._replace(values=flux * each.values[axis])
                    slopes.append(_cut(slope, there, grid))
        p, unknowns = scene.n_images, self.unknowns[lit].T.ravel()
        slopes += [_cut(halo, there, grid) for halo in around.halos(j)]
        of_halos = self.n_of_stars + j + p * np.arange(around.n_shapes)
        unknowns, k = np.append(unknowns, of_halos), len(slopes)
        left = _padded(counts - total, shape) - beyond
        laid = np.array([_padded(slope, shape) for slope in slopes])
        precisions = _padded(precision(scene, model, weights), shape)
        return LinearImage(laid.reshape(k, left.size), unknowns, left, precisions)


def _unknowns(held: NDArray[np.int_], n_epochs: int, moves: bool) -> NDArray[np.int_]:
    """Return the unknowns of stars in epochs: fluxes, all x, and all y, of a place each."""
    n, numbers = len(held), dict[int, int]()
    place = np.array([numbers.setdefault(s, len(numbers)) for s in (held // n_epochs).tolist()])
    each = [np.arange(n), n + place, n + len(numbers) + place]
    return np.stack(each if moves else each[:1], axis=1)


def _texture_in(window: Window, around: Surroundings) -> tuple[tuple[slice, slice], Texture]:
    """Return the texture round a window of the images, and where the window lies in it."""
    scene, width = around.scene, around.width
    window = window.finer(scene.oversample)
    margin = int(np.ceil(MARGIN * width))
    (y, height), (x, breadth) = (
        (first - margin, k + 2 * margin) if k + 2 * margin < n else (first, n)
        for first, k, n in zip((window.y, window.x), window.shape, scene.grid, strict=True)
    )
    whole = Window(y, x, (height, breadth))
    stars = (scene.shown_stars - (x, y)) % scene.grid[::-1]
    inside = (stars < (breadth, height)).all(axis=1)
    there = tuple(
        slice(first - start, first - start + k)
        for first, start, k in zip((window.y, window.x), (y, x), window.shape, strict=True)
    )
    extended = around.estimate.part(whole.of(scene.grid))
    return (there[0], there[1]), Texture(extended, stars[inside], width, around.hidden[inside])


def _observed(scene: Scene, j: int, there: Window) -> tuple[Array, Array, Array]:
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


def _planes_in(scene: Scene, j: int, there: Window) -> Array:
    """Return the shapes of a level of image j in a window, shape (3, height, width)."""
    rows, columns = there.of(scene.image_grid)
    return scene.per_exposure(planes(scene.observation, rows, columns), 0.0, j, (rows, columns))


def _in_image(scene: Scene, j: int, window: Window) -> Window:
    """Return the pixels of image j round the middle of a window of the sky, as wide as that."""
    height, width = window.shape
    middle = np.array([window.x + width // 2, window.y + height // 2])
    x, y = np.round(scene.observation.places(j, middle)).astype(int).tolist()
    # Larger pixels are fewer.
    ny, nx = (math.ceil(n / scene.observation.scales[j]) for n in window.shape)
    return Window(y - ny // 2, x - nx // 2, (ny, nx))


def _padded(image: Array, shape: tuple[int, int]) -> Array:
    """Return the pixels of a window of an image in an array of the shape of the largest."""
    if image.shape == shape:
        return image
    laid = np.zeros(shape)
    laid[: image.shape[0], : image.shape[1]] = image
    return laid


def _window_round(scene: Scene, star: Array, side: float) -> Window:
    """Return a window of so many pixels of the sky round a star.

    It is the whole axis of the grid where that is not twice as long.
    """
    length = int(np.ceil(side / scene.oversample))
    size = scipy.fft.next_fast_len(length, real=True)
    height, width = (size if 2 * size <= n else n for n in scene.image_grid)
    x, y = np.round(star).astype(int).tolist()
    return Window(y - height // 2, x - width // 2, (height, width))


def _neighbours(scene: Scene, star: int, resolution: float) -> NDArray[np.int_]:
    """Return which other stars are near one; those beyond are taken as known."""
    size = np.array(scene.grid[::-1])
    away = scene.oversample * (scene.stars - scene.stars[star])
    away = (away + size / 2) % size - size / 2
    near = np.flatnonzero(np.hypot(*away.T) <= NEIGHBOURS * resolution)
    return near[near != star]


def _cut(cutout: Cutout, window: Window, grid: tuple[int, int]) -> Array:
    """Return the values of a cutout that lie in a window, and 0 elsewhere."""
    return cutout.add_to(np.zeros(window.shape), (window.y, window.x), grid)
