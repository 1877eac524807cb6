"""The least squares of a star and of the extended source round it, in a window.

The extended source is a field of the covariance that `lnocl.core.scene.texture` expects, and a
level, an unknown of about its mean there: an estimate that is positive holds light where there is
none. So the fluxes and positions of stars, and their errors, depend on no iteration. For errors the
amounts of halos are unknown too: what the images tell of them beyond the window is their prior in
it.

Where PSFs are not exact their errors are unknown too (`lnocl.core.solvers.psf_errors`). So is a
cusp of the extended source under each star that has a host (`lnocl.core.scene.hosts`), a Gaussian
as wide as the resolution: a host that is as narrow as the PSF exchanges light with the star and the
PSF's width.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import cached_property

import numpy as np
import scipy.fft
from numpy.typing import NDArray
from scipy.linalg import block_diag

from lnocl.core.scene.arrays import Array
from lnocl.core.scene.camera import Camera, Windows
from lnocl.core.scene.detector import on_sky
from lnocl.core.scene.estimate import Estimate
from lnocl.core.scene.hosts import light_of_host
from lnocl.core.scene.scene import Scene
from lnocl.core.scene.texture import Texture, hidden_radii, hidden_radius, resolution
from lnocl.core.scene.transforms import enlarged
from lnocl.core.scene.view import Places, View, Window
from lnocl.core.solvers.fluxes import precision
from lnocl.core.solvers.least_squares import Field, LeastSquares, LinearImage, SourceError
from lnocl.core.solvers.psf_errors import VARIANCE, PsfErrors
from lnocl.core.solvers.sources import Sources

# Side of the window round a star, and how far off other stars may be that are not taken as known,
# resolutions.
WINDOW, NEIGHBOURS = 9.0, 4.0
# What lies farther from a window has no part in the texture there, resolutions.
MARGIN = 3.0
# The standard deviation of the light of a cusp under a star, over that of a host round it.
CUSP = 6.0
# The standard deviation of a Gaussian of unit full width at half maximum.
DEVIATION = VARIANCE**0.5
# The inverse variance of what is held.
HELD = 1e12
# Steps of conjugate gradients at most.
N_STEPS = 2000
# So many of the brightest stars tell of the PSFs, and are looked at for companions.
MOST_STARS = 4


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
        (`lnocl.core.solvers.halos.HaloErrors`). Halos are unknown then; by default they are known.
    holds_shapes : bool
        Whether only the pixels of PSFs are unknown, of what those may have wrong.

    Attributes
    ----------
    width : float
        The resolution, pixels of the sky.
    hidden : ndarray of float64, shape (n_shown,)
        Radii round stars that are shown in which no image has observed a pixel, pixels of the sky.
    n_shapes : int
        Halos of each image that are unknown.
    """

    def __init__(
        self,
        estimate: Estimate,
        moves: bool,
        raised: Array | None = None,
        holds_shapes: bool = False,
    ) -> None:
        self.estimate, self.moves, self.holds_shapes = estimate, moves, holds_shapes
        self.scene = scene = estimate.scene
        self.width = resolution(scene)
        self.hidden = hidden_radii(scene, self.width)
        self.cameras = [Camera(scene, j) for j in range(scene.n_images)]
        self.n_shapes = 0 if raised is None else len(raised)
        self._roots = np.zeros(0) if raised is None else raised**-0.5
        models = estimate.models() if self.n_shapes else ()
        self._precisions = [
            precision(scene, model, View(scene, j).weights) for j, model in enumerate(models)
        ]

    def beyond(self, j: int, window: Window) -> Array:
        """Return what image j tells of its halos beyond a window, the extended source unknown.

        That is their information, shape (n_shapes, n_shapes), less by the factors `raised`.
        """
        scene, precisions = self.scene, self._precisions[j].copy()
        precisions[window.of(scene.image_grid)] = 0.0
        of_image = range(scene.n_stars + j, scene.n_fluxes, scene.n_images)
        halos = np.array([scene.star_image(j, k) for k in of_image])
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
        Stars that are fitted: this, which is the first, and those near it. Halos follow in the
        unknowns, shape by shape, and then positions.
    unknowns : ndarray of int, shape (n_held, 1 or 3)
        Those of each: its flux, and perhaps x and y, which it has in all epochs.
    level : int
        That of a level of the extended source, which follows them, and of which cusps do.
    n : int
        All of these; those of `psfs` follow, unless they are held.
    psfs : PsfErrors or None
        The errors of the PSFs there; None where they are exact.
    images : list of LinearImage
        The images near the estimate, in arrays of the window.
    prior : ndarray of float64
        The inverse of the covariance of all unknowns before.
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
        self.window, self.hidden = window_round(around, star)
        self._views = [View.round(scene, j, self.window) for j in range(scene.n_images)]
        self.held = np.append(star, _neighbours(scene, star, width))
        halos = scene.n_stars + np.arange(around.n_shapes * scene.n_images)
        sources = Sources(around.estimate, np.append(self.held, halos), around.moves)
        self.unknowns, self.resolution, self._finished = sources.unknowns, width, finished
        there, texture = _texture_in(self.window, around)
        self.source = self._source_error(around, texture.amplitude[there], texture.width)
        self.expected = texture.mean[there] - around.estimate.part(self.places(scene))
        level = max(float(texture.mean[there].mean()), HELD**-0.5)
        beyond = self.source.images_of(self.expected)
        observation = scene.observation
        self.psfs, self._cusps = None, list[float]()
        is_free = not around.holds_shapes
        if observation.psf_error or (len(observation.psf_scatter) and is_free):
            self.psfs = PsfErrors(around.estimate, self._views)
        if observation.psf_error:
            self._cusps = [self._cusp(around, s) for s in self.held]
        self.images = [
            self._linearise(around, sources, *each)
            for each in zip(self._views, around.cameras, beyond, strict=True)
        ]
        self.level, self.n = sources.n, sources.n + 1 + len(self._cusps)
        prior = [self._prior_of_halos(around, sources.n), level**-2, np.eye(len(self._cusps))]
        self.prior = block_diag(*prior, *([self.psfs.prior] if self.psfs and is_free else []))

    def _cusp(self, around: Surroundings, star: int) -> float:
        """Return the standard deviation of the light of a cusp under a star."""
        sky = around.estimate.part(self.places(around.scene))
        rows, columns = offsets_from(around.scene, star, self.window)
        return CUSP * light_of_host(sky, rows, columns, self.resolution, self.hidden)

    def places(self, scene: Scene) -> Places:
        """Return the rows and columns of the window in the sky, on the grid."""
        return self.window.finer(scene.oversample).of(scene.grid)

    def level_shares(self, change: Array) -> Array:
        """Return how much an unknown falls where levels of the background rise, shape (p, 3).

        `change` is its change by each residual in the window, shape (p, height, width).
        """
        pairs = zip(change, self._views, strict=True)
        return np.array(
            [
                [np.vdot(each, enlarged(level, each.shape)) for level in v.levels]
                for each, v in pairs
            ]
        )

    @cached_property
    def fit(self) -> LeastSquares:
        """The least squares of stars, halos, and extended source and its level."""
        return LeastSquares(self.images, self.fields, self.prior, N_STEPS, self._finished)

    @cached_property
    def fit_beside_known(self) -> LeastSquares:
        """Those with the extended source known, where PSFs are not."""
        prior, held = self.prior.copy(), range(self.level, self.n)
        prior[held, held] += HELD
        return LeastSquares(self.images, self.fields[1:], prior, N_STEPS, self._finished)

    @cached_property
    def fields(self) -> list[Field]:
        """The extended source, and the pixels of PSFs."""
        of_psfs = [self.psfs.pixels(self.window.shape)] if self.psfs else []
        return [self.source, *of_psfs]

    def _prior_of_halos(self, around: Surroundings, n: int) -> Array:
        p, k = around.scene.n_images, len(self.held)
        prior, first = np.zeros((n, n)), k + p * np.arange(around.n_shapes)
        for j, view in enumerate(self._views if around.n_shapes else []):
            prior[np.ix_(first + j, first + j)] = around.beyond(j, view.window)
        return prior

    def _source_error(self, around: Surroundings, amplitude: Array, width: float) -> SourceError:
        """Return the Gaussian field of the source's error there, and its map to the images."""
        shape, sky = self.window.shape, self.window.finer(around.scene.oversample).ranges
        maps = [
            camera.window(view.window.ranges, sky)
            for camera, view in zip(around.cameras, self._views, strict=True)
        ]
        windows = Windows(maps)

        def forward(sky: Array) -> Array:
            return np.array([enlarged(each, shape) for each in windows.forward(sky)])

        def adjoint(images: Iterable[Array]) -> Array:
            pairs = zip(maps, images, strict=True)
            return windows.adjoint([image[: m.shape[0], : m.shape[1]] for m, image in pairs])

        return SourceError(forward, adjoint, amplitude, width)

    def _linearise(
        self, around: Surroundings, sources: Sources, view: View, camera: Camera, beyond: Array
    ) -> LinearImage:
        """Return an image near the estimate, in arrays of the window.

        `beyond` is the light of the sky that is expected, less that of the estimate.
        """
        model = view.model(around.estimate, camera)
        image = sources.linear(view, model)
        scene, cusps = around.scene, list[Array]()
        flat = np.full(view.window.shape, scene.gains[view.j] * scene.areas[view.j])
        if scene.transmission is not None:
            flat = camera.part(np.broadcast_to(1.0, scene.grid), view.window.ranges)
        for s, light in zip(self.held, self._cusps, strict=False):
            width = self.resolution / scene.oversample / scene.observation.scales[view.j]
            cusp = scene.star_cutout(view.j, s).blurred(width * DEVIATION, scene.image_grid)
            cusps.append(light * view.cut(cusp))
        image = image.beside([flat, *cusps], sources.n + np.arange(1 + len(cusps)))
        if self.psfs and not around.holds_shapes:
            of_psfs, unknowns = self.psfs.slopes(view.j, model)
            image = image.beside(of_psfs, sources.n + 1 + len(cusps) + unknowns)
        n, shape = len(image.unknowns), self.window.shape
        slopes = enlarged(image.slopes.reshape(n, *view.window.shape), shape)
        return LinearImage(
            slopes.reshape(n, math.prod(shape)),
            image.unknowns,
            enlarged(image.left, shape) - beyond,
            enlarged(image.precision, shape),
        )


def brightest(estimate: Estimate, is_meant: NDArray[np.bool_] | bool = True) -> list[int]:
    """Return the first epochs of the `MOST_STARS` brightest stars, or of those that are meant."""
    n_stars, n_epochs = estimate.scene.n_stars, estimate.scene.n_epochs
    light = np.where(is_meant, estimate.star_fluxes[:n_stars], 0.0).reshape(-1, n_epochs).sum(1)
    order = np.argsort(-light, kind="stable")[:MOST_STARS]
    return (n_epochs * order[light[order] > 0]).tolist()


def offsets_from(scene: Scene, star: int, window: Window) -> tuple[Array, Array]:
    """Return how far below, (height, 1), and right, (width,), of a star the sky in a window is."""
    window, at = window.finer(scene.oversample), on_sky(scene.stars[star], scene.oversample)[::-1]
    rows, columns = (
        (first + np.arange(k) - place + n / 2) % n - n / 2
        for first, k, place, n in zip(window[:2], window.shape, at, scene.grid, strict=True)
    )
    return rows[:, None], columns


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


def window_round(around: Surroundings, star: int) -> tuple[Window, float]:
    """Return a window of the images round a star, and the radius that no image has observed.

    It is the whole axis of the grid where that is not twice as long.
    """
    scene, place = around.scene, around.scene.stars[star]
    hidden = hidden_radius(scene, place, around.width)
    length = int(np.ceil((WINDOW * around.width + 2.0 * hidden) / scene.oversample))
    size = scipy.fft.next_fast_len(length, real=True)
    height, width = (size if 2 * size <= n else n for n in scene.image_grid)
    x, y = np.round(place).astype(int).tolist()
    return Window(y - height // 2, x - width // 2, (height, width)), hidden


def _neighbours(scene: Scene, star: int, resolution: float) -> NDArray[np.int_]:
    """Return which other stars are near one; those beyond are taken as known."""
    size = np.array(scene.grid[::-1])
    away = scene.oversample * (scene.stars - scene.stars[star])
    away = (away + size / 2) % size - size / 2
    near = np.flatnonzero(np.hypot(*away.T) <= NEIGHBOURS * resolution)
    return near[near != star]
