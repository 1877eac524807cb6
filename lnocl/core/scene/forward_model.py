"""The model of a scene on the host, in double precision, for use outside the iterations."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Hashable, Iterable, Iterator, Sequence
from copy import copy
from functools import cached_property

import numpy as np

from lnocl.core.scene.arrays import Array, together
from lnocl.core.scene.camera import (
    Camera,
    Ranges,
    Spectrum,
    Windows,
    adjoints_of,
    images_of,
    is_flat,
    ranges,
)
from lnocl.core.scene.grid import psf_shape
from lnocl.core.scene.scene import Scene
from lnocl.core.scene.shifting import MARGIN, Cutout

# Rows and columns of the grid.
Box = tuple[slice, slice]
# A box is convolved by itself where what its PSF reaches is less than this share of the grid.
SHARE_OF_GRID = 0.25

# What weights and PSFs that are turned leave far from a star, as a share of its largest value. It
# enters measures of steps alone.
RINGING = 1e-4
# Rounding of an FFT, as a share of the largest value.
ROUNDING = 1e-16


class Model:
    """The linear maps of a scene: ``m_j = A_j f + sum_s c_s P_js + b_j``, on the grid and scaled.

    A_j convolves with the response of image j and takes each `oversample`-th point.

    Attributes
    ----------
    scene : Scene
        The scene.
    shape : tuple of int
        (p, ny, nx), of the images on their grid.
    grid : tuple of int
        (Ny, Nx), of the sky.
    oversample : int
        Ny / ny.
    weights : ndarray of float64, shape (p, ny, nx)
        Its relative exposure where a pixel was observed, else 0.
    background : ndarray of float64, shape (p, 1, 1) or (p, ny, nx)
        b_j.
    sums : ndarray of float64, shape (p,)
        What a flat sky of ones is in each image: it stays flat, but for a transmission. So does
        the adjoint of a flat image.

    Notes
    -----
    Images are worked on one after the other: fresh memory for all at once would cost more time than
    the arithmetic on it.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.shape = (scene.n_images, *scene.image_grid)
        self.grid, self.oversample = scene.grid, scene.oversample
        self.cameras = [Camera(scene, j) for j in range(scene.n_images)]
        self.sums = np.array([camera.flat for camera in self.cameras])
        weights = np.ones((1, 1, 1)) if scene.weights is None else scene.weights
        if not weights.strides[0]:  # all images share them
            weights = weights[:1]
        self.weights = np.broadcast_to(weights.astype(np.float64), self.shape)
        self.background, _ = together(scene.background(), self.weights)

    def with_background(self, scene: Scene, more: Sequence[Array]) -> Model:
        """Return the model of a scene with the same sky, and more background in each image."""
        other = copy(self)
        other.scene, other.background = scene, self.background + np.array(more)
        return other

    def single(self) -> Model:
        """Return the model for skies and images in single precision."""
        other = copy(self)
        other.cameras = [camera.single() for camera in self.cameras]
        return other

    @cached_property
    def of_ones(self) -> list[Array | float]:
        """What a sky of ones is in each image: a number where it stays flat."""
        return [camera.of_ones() for camera in self.cameras]

    def forward(self, extended: Array) -> Array:
        """Return the ``A_j f``, shape (p, ny, nx); of several skies, of their mixtures."""
        images = np.empty(self.shape, extended.dtype)
        for image, seen in zip(images, seen_by(self.scene, self.cameras, extended), strict=True):
            image[:] = seen
        return images

    def convolved(self, extended: Array) -> Iterator[Array]:
        """Yield the ``A_j f`` before pixels sample them, each of shape (Ny, Nx)."""
        spectra: dict[Hashable, Spectrum] = {}
        for camera in self.cameras:
            yield camera.convolved(camera.shared_spectrum(extended, spectra))

    def adjoint(self, arrays: Iterable[Array]) -> Array:
        """Return ``sum_j A_j^T x_j``, shape (Ny, Nx); of several skies, times w_jk, (K, Ny, Nx)."""
        return self.adjoints(arrays, np.ones((1, self.shape[0])))[0]

    def adjoints(self, arrays: Iterable[Array], factors: Array) -> Array:
        """Return ``sum_j q_kj A_j^T x_j`` for each k, as `adjoints_of` does."""
        mixed = (factors[:, None] * self.scene.mixes.T).reshape(-1, self.shape[0])
        back = adjoints_of(self.cameras, arrays, mixed)
        return back.reshape(len(factors), *self.scene.sky_grid)

    def adjoint_of_cutouts(self, cutouts: Sequence[Cutout]) -> Cutout:
        """Return ``sum_j A_j^T x_j`` of images x_j that are 0 beyond a cutout, one an image.

        It is that of one sky, which all images show.

        It is computed in the window that it lies in, where that is smaller than the grid. Outer
        rows and columns below the rounding of its largest value are cut off; where images are
        turned, those below a ten thousandth of it.
        """
        # Stars are not in the images of other epochs.
        lit = [j for j, each in enumerate(cutouts) if each.values.any()] or [0]
        seen = {j: ranges(cutouts[j][1:], cutouts[j].values.shape) for j in lit}
        reached = zip(*(self.cameras[j].reached(each) for j, each in seen.items()), strict=True)
        rows, columns = (
            range(min(at.start for at in axis), max(at.stop for at in axis)) for axis in reached
        )
        if self.scene.rotations or len(rows) >= self.grid[0] or len(columns) >= self.grid[1]:
            dark = np.broadcast_to(0.0, self.shape[1:])
            laid = (
                each.on_grid(self.shape[1:]) if j in lit else dark for j, each in enumerate(cutouts)
            )
            total = adjoints_of(self.cameras, laid, np.ones((1, self.shape[0])))[0]
            least = RINGING if self.scene.rotations else ROUNDING
            return Cutout(total, 0, 0).trimmed(least * float(abs(total).max()))
        windows = [self.cameras[j].window(each, (rows, columns)) for j, each in seen.items()]
        total = Windows(windows).adjoint([cutouts[j].values for j in seen])
        cutout = Cutout(total, rows.start, columns.start)
        return cutout.trimmed(ROUNDING * float(abs(total).max()))

    def starlight(self, star_fluxes: Array) -> Iterator[Array]:
        """Yield the light of stars, where they are now, and halos in each image, (ny, nx)."""
        for j in range(self.shape[0]):
            yield self.scene.star_field.light(j, star_fluxes)

    def images(self, extended: Array, star_fluxes: Array) -> Array:
        """Return the m_j, not below 0."""
        images = self.forward(extended)
        for image, background, light in zip(
            images, self.background, self.starlight(star_fluxes), strict=True
        ):
            _illuminate(image, background, light)
        return images

    def images_at(self, boxes: Sequence[Box], extended: Array) -> Array:
        """Return the m_j without stars in a box of each; beyond it they may be 0."""
        skies = skies_seen(self.scene, extended)
        flat = all(map(is_flat, skies)) and self.scene.transmission is None
        if not flat and (self.scene.rotations or self.are_large(boxes)):
            return self.images(extended, np.zeros(self.scene.n_fluxes))
        images = np.zeros(self.shape)
        for image, sky, box, camera, known in zip(
            images, skies, boxes, self.cameras, self.background, strict=True
        ):
            seen = camera.flat * sky[0, 0] if flat else camera.part(sky, _ranges_of(box))
            np.maximum(seen + np.broadcast_to(known, image.shape)[box], 0.0, out=image[box])
        return images

    def are_large(self, boxes: Sequence[Box]) -> bool:
        """Return whether the pixels that a box of an image sees are a large share of the grid."""
        pairs = zip(self.cameras, boxes, strict=True)
        reached = (camera.reached(_ranges_of(box)) for camera, box in pairs)
        largest = max(len(rows) * len(columns) for rows, columns in reached)
        return largest > SHARE_OF_GRID * math.prod(self.grid)


def _ranges_of(box: Box) -> Ranges:
    return range(box[0].start, box[0].stop), range(box[1].start, box[1].stop)


def skies_seen(scene: Scene, extended: Array) -> list[Array]:
    """Return the sky that each image shows: of several skies the mixture of its filter."""
    if scene.mixing is None:
        return [extended] * scene.n_images
    mixed = scene.mixing.seen(extended)
    return [mixed[g] for g in scene.mixing.filters]


def seen_by(scene: Scene, cameras: Iterable[Camera], extended: Array) -> Iterator[Array]:
    """Yield the image that each camera has of the sky that it shows."""
    if scene.mixing is None:
        yield from images_of(cameras, extended)
        return
    spectra = defaultdict[int, dict[Hashable, Spectrum]](dict)  # of each of these skies
    for camera, sky in zip(cameras, skies_seen(scene, extended), strict=True):
        yield camera.seen(camera.shared_spectrum(sky, spectra[id(sky)]))


def model_images(scene: Scene, extended: Array, star_fluxes: Array) -> Iterator[Array]:
    """Yield the m_j, as `Model.images` returns them; nothing but one of them is held."""
    background = scene.background()
    cameras = (Camera(scene, j, is_kept=False) for j in range(scene.n_images))
    for j, image in enumerate(seen_by(scene, cameras, extended)):
        _illuminate(image, background[j], scene.star_field.light(j, star_fluxes))
        yield image


def _illuminate(image: Array, background: Array | float, starlight: Array) -> None:
    """Add background and starlight to the image of an extended source; leave nothing below 0."""
    image += background
    image += starlight
    np.maximum(image, 0.0, out=image)


def largest_window(scene: Scene) -> tuple[int, int]:
    """Return the largest shape of `Model.adjoint_of_cutouts` of star images, wherever these lie."""
    grid, shapes = scene.grid, (scene.observation.psfs.shape[1:], psf_shape(scene.observation))
    if scene.rotations:
        return grid
    more = 2 * MARGIN + 2 * (scene.oversample - 1)
    height, width = (k + of_star + 2 * more for k, of_star in zip(*shapes, strict=True))
    return grid if height >= grid[0] or width >= grid[1] else (height, width)
