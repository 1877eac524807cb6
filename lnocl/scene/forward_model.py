"""The model of a scene on the host, in double precision, for use outside the iterations."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from copy import copy
from functools import cached_property
from typing import Any

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from lnocl.scene.arrays import Array
from lnocl.scene.estimate import Estimate
from lnocl.scene.grid import psf_shape
from lnocl.scene.line_weights import TAPS
from lnocl.scene.rotation import Rotation
from lnocl.scene.scene import Scene
from lnocl.scene.shifting import MARGIN, Cutout

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
        What a flat sky of ones is in each image: it stays flat. So does the adjoint of a flat
        image.

    Notes
    -----
    Images are worked on one after the other: fresh memory for all at once would cost more time than
    the arithmetic on it.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.shape = (scene.n_images, *scene.image_grid)
        self.grid, self.oversample = scene.grid, scene.oversample
        self._window_otfs: dict[Any, NDArray[np.complex128]] = {}
        self._psfs = [scene.psf_cutout(j) for j in range(scene.n_images)]
        self.sums = np.array([psf.values.sum() for psf in self._psfs])
        self._back_sums = self.sums / scene.areas
        weights = np.ones((1, 1, 1)) if scene.weights is None else scene.weights
        if not weights.strides[0]:  # all images share them
            weights = weights[:1]
        self.weights = np.broadcast_to(weights.astype(np.float64), self.shape)
        background = scene.background()
        self.background = background if background.ndim == 3 else background[:, None, None]

    def with_background(self, scene: Scene, more: Sequence[Array]) -> Model:
        """Return the model of a scene with the same sky, and more background in each image."""
        other = copy(self)
        other.scene, other.background = scene, self.background + np.array(more)
        return other

    @cached_property
    def _otfs(self) -> list[NDArray[np.complex128]]:
        p = self.shape[0]
        return [scipy.fft.rfft2(self.scene.psf(j), workers=-1) for j in range(p)]

    def forward(self, extended: Array) -> Array:
        """Return the ``A_j f``, shape (p, ny, nx)."""
        images = np.empty(self.shape)
        if is_flat(extended):
            images[:] = extended[0, 0] * self.sums[:, None, None]
            return images
        for image, sky in zip(images, self.convolved(extended), strict=True):
            image[:] = sampled(sky, self.oversample)
        return images

    def convolved(self, extended: Array) -> Iterator[Array]:
        """Yield the ``A_j f`` before pixels sample them, each of shape (Ny, Nx)."""
        spectrum = scipy.fft.rfft2(extended, workers=-1)
        for j, otf in enumerate(self._otfs):
            sky = scipy.fft.irfft2(otf * spectrum, self.grid, workers=-1, overwrite_x=True)
            yield turned(self.scene, j, sky)

    def adjoint(self, arrays: Iterable[Array]) -> Array:
        """Return ``sum_j A_j^T x_j``, shape (Ny, Nx)."""
        (total,) = self.adjoints(arrays, np.ones((1, self.shape[0])))
        return total

    def adjoints(self, arrays: Iterable[Array], factors: Array) -> Array:
        """Return ``sum_j q_kj A_j^T x_j`` for each k, shape (k, Ny, Nx); q has shape (k, p).

        It may be read-only: of arrays of one value each it is a view of one value, too.
        """
        flat, spectra = np.zeros(len(factors)), list[NDArray[np.complex128]]()
        rotations = self.scene.rotations
        runs = _runs(arrays) if not rotations else ((each, [j]) for j, each in enumerate(arrays))
        for array, members in runs:
            shares = factors[:, members]
            if not any(array.strides):  # of one value, as weights are where all is observed
                flat += shares @ self._back_sums[members] * array[0, 0]
                continue
            seen = rotations[members[0]].adjoint(array) if rotations else array
            spectrum = scipy.fft.rfft2(spread(seen, self.oversample), workers=-1).conj()
            spectra = spectra or [np.zeros_like(spectrum) for _ in factors]
            for total, share in zip(spectra, shares, strict=True):
                total += self._mixed_otf(members, share) * spectrum
        if not spectra:
            return np.broadcast_to(flat[:, None, None], (len(flat), *self.grid))
        back = [
            scipy.fft.irfft2(each.conj(), self.grid, workers=-1, overwrite_x=True)
            for each in spectra
        ]
        return np.array(back) + flat[:, None, None]

    def _mixed_otf(self, members: Sequence[int], shares: Array) -> NDArray[np.complex128]:
        """Return ``sum_j q_j K^_j`` over some images."""
        if len(members) == 1:
            otf = self._otfs[members[0]]
            return otf if shares[0] == 1.0 else shares[0] * otf
        mixed = np.zeros(self.grid)
        for j, share in zip(members, shares, strict=True):
            psf = self._psfs[j]
            mixed[psf.window(mixed.shape)] += share * psf.values
        return np.asarray(scipy.fft.rfft2(mixed, workers=-1))

    def adjoint_of_cutouts(self, cutouts: Sequence[Cutout]) -> Cutout:
        """Return ``sum_j A_j^T x_j`` of images x_j that are 0 beyond a cutout, one an image.

        It is computed in the window that it lies in, where that is smaller than the grid. Outer
        rows and columns below the rounding of its largest value are cut off; where images are
        turned, those below a ten thousandth of it.
        """
        given, q = cutouts, self.oversample
        # Stars are not in the images of other epochs.
        lit = [j for j, each in enumerate(given) if each.values.any()] or [0]
        cutouts = [Cutout(spread(given[j].values, q), q * given[j].y, q * given[j].x) for j in lit]
        psfs = [self._psfs[j] for j in lit]
        first, size = _window_of_correlations(cutouts, psfs)
        if self.scene.rotations or (size >= self.grid).any():
            dark = np.broadcast_to(0.0, self.shape[1:])
            total = self.adjoint(
                given[j].on_grid(self.shape[1:]) if j in lit else dark for j in range(len(given))
            )
            least = RINGING if self.scene.rotations else ROUNDING
            return Cutout(total, 0, 0).trimmed(least * float(abs(total).max()))
        shape = tuple(scipy.fft.next_fast_len(int(n), real=True) for n in size)
        spectrum: Any = 0.0
        for j, cutout, psf in zip(lit, cutouts, psfs, strict=True):
            laid = np.zeros(shape)
            y, x = cutout.y - psf.y - first[0], cutout.x - psf.x - first[1]
            laid[y : y + cutout.values.shape[0], x : x + cutout.values.shape[1]] = cutout.values
            spectrum = spectrum + self._window_otf(j, shape).conj() * scipy.fft.rfft2(laid)
        total = scipy.fft.irfft2(spectrum, shape)[: size[0], : size[1]]
        cutout = Cutout(total, int(first[0]), int(first[1]))
        return cutout.trimmed(ROUNDING * float(abs(total).max()))

    def _window_otf(self, j: int, shape: tuple[int, ...]) -> NDArray[np.complex128]:
        if (j, shape) not in self._window_otfs:
            self._window_otfs[j, shape] = scipy.fft.rfft2(self._psfs[j].values, shape)
        return self._window_otfs[j, shape]

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
        flat = is_flat(extended)
        if not flat and (self.scene.rotations or self.are_large(boxes)):
            return self.images(extended, np.zeros(self.scene.n_fluxes))
        images = np.zeros(self.shape)
        for j, (image, box) in enumerate(zip(images, boxes, strict=True)):
            rows, columns = (range(side.start, side.stop) for side in box)
            image[box] = np.broadcast_to(self.background[j], image.shape)[box]
            if flat:
                image[box] += self.sums[j] * extended[0, 0]
            else:
                image[box] += self._convolve_at(extended, j, rows, columns)
            np.maximum(image[box], 0.0, out=image[box])
        return images

    def _convolve_at(self, extended: Array, j: int, rows: range, columns: range) -> Array:
        return convolve_at(extended, self._psfs[j], rows, columns, self.oversample)

    def are_large(self, boxes: Sequence[Box]) -> bool:
        """Return whether the pixels that a box of an image sees are a large share of the grid."""
        sides = [
            np.add([self.oversample * (side.stop - side.start) for side in box], psf.values.shape)
            for box, psf in zip(boxes, self._psfs, strict=True)
        ]
        largest = max(math.prod(map(int, each)) for each in sides)
        return largest > SHARE_OF_GRID * math.prod(self.grid)


def _runs(arrays: Iterable[Array]) -> Iterator[tuple[Array, list[int]]]:
    """Yield arrays with the places of all in a row that are the same memory, as shared weights."""
    first, members = np.zeros(0), list[int]()
    for j, array in enumerate(arrays):  # first is held: no other lies in its memory
        is_same = array.ctypes.data == first.ctypes.data and array.strides == first.strides
        if members and not is_same:
            yield first, members
            members = []
        if not members:
            first = array
        members.append(j)
    yield first, members


def is_flat(array: Array) -> bool:
    """Return whether an array has one value alone; convolved, it stays flat."""
    return not any(array.strides) or bool((array == array[0, 0]).all())


def sampled(sky: Array, oversample: int) -> Array:
    """Return each `oversample`-th row and column: what an image has of a convolved sky."""
    return sky[..., ::oversample, ::oversample]


def spread(image: Array, oversample: int) -> Array:
    """Return the adjoint of `sampled`: the pixels of an image on the sky's, 0 between them."""
    if oversample == 1:
        return image
    *others, ny, nx = image.shape
    sky = np.zeros((*others, oversample * ny, oversample * nx))
    sky[..., ::oversample, ::oversample] = image
    return sky


def turned(scene: Scene, j: int, sky: Array) -> Array:
    """Return image j of a convolved sky, turned where it is."""
    return scene.rotations[j].forward(sky) if scene.rotations else sky


def convolve_at(
    extended: Array, psf: Cutout, rows: range, columns: range, oversample: int = 1
) -> Array:
    """Return ``A_j f`` in some rows and columns of the images' grid, round its edges."""
    if oversample > 1:
        fine_rows, fine_columns = (
            range(oversample * at.start, oversample * at.stop) for at in (rows, columns)
        )
        return sampled(convolve_at(extended, psf, fine_rows, fine_columns), oversample)
    height, width = psf.values.shape
    reach = len(rows) + height - 1, len(columns) + width - 1
    if math.prod(reach) >= extended.size:  # a transform of the grid is the smaller one
        spectrum = scipy.fft.rfft2(extended, workers=-1)
        spectrum *= scipy.fft.rfft2(psf.on_grid(extended.shape), workers=-1)
        image = scipy.fft.irfft2(spectrum, extended.shape, workers=-1, overwrite_x=True)
        return np.asarray(_around(image, rows, columns))
    first = rows.start - psf.y - height + 1, columns.start - psf.x - width + 1
    ranges = (range(at, at + n) for at, n in zip(first, reach, strict=True))
    shape = tuple(scipy.fft.next_fast_len(n, real=True) for n in reach)
    spectrum = scipy.fft.rfft2(_around(extended, *ranges), shape)
    spectrum *= scipy.fft.rfft2(psf.values, shape)
    image = scipy.fft.irfft2(spectrum, shape)
    return np.asarray(image[height - 1 : reach[0], width - 1 : reach[1]])


def _around(pixels: Array, rows: range, columns: range) -> Array:
    return pixels.take(rows, axis=0, mode="wrap").take(columns, axis=1, mode="wrap")


def model_images(scene: Scene, extended: Array, star_fluxes: Array) -> Iterator[Array]:
    """Yield the m_j, as `Model.images` returns them; nothing but one of them is held."""
    background = scene.background()
    for j, image in enumerate(images_of_sky(scene, extended)):
        _illuminate(image, background[j], scene.star_field.light(j, star_fluxes))
        yield image


def images_of_sky(scene: Scene, extended: Array) -> Iterator[Array]:
    """Yield the ``A_j f``, as `Model.forward` returns them; nothing but one of them is held."""
    if is_flat(extended):
        for j in range(scene.n_images):
            yield np.full(scene.image_grid, extended[0, 0] * scene.psf_cutout(j).values.sum())
        return
    spectrum = scipy.fft.rfft2(extended, workers=-1)
    for j in range(scene.n_images):
        otf = scipy.fft.rfft2(scene.psf(j), workers=-1)
        otf *= spectrum
        sky = scipy.fft.irfft2(otf, scene.grid, workers=-1, overwrite_x=True)
        yield np.ascontiguousarray(sampled(turned(scene, j, sky), scene.oversample))


def add_to_window(image: Array, estimate: Estimate, j: int, first: tuple[int, int]) -> None:
    """Add sky, stars and halos, scaled, to an image of a window of the images' grid.

    Parameters
    ----------
    image : ndarray of float64, shape (h, w)
        What is there already, such as the background, scaled.
    estimate : Estimate
        What is modelled, and how bright it is.
    j : int
        Which image.
    first : tuple of int
        Row and column of the first pixel of the window.
    """
    scene, sky, fluxes = estimate.scene, estimate.sky, estimate.fluxes
    rows, columns = (range(at, at + n) for at, n in zip(first, image.shape, strict=True))
    if scene.rotations:
        seen = _turned_at(scene, j, sky, rows, columns)
    else:
        seen = convolve_at(sky, scene.psf_cutout(j), rows, columns, scene.oversample)
    image += seen / scene.unit
    cutouts = scene.star_field.cutouts[j]
    for s in scene.star_field.reaching(j, first, image.shape):
        cutouts[s].add_to(image, first, scene.image_grid, fluxes[s])


def _turned_at(scene: Scene, j: int, sky: Array, rows: range, columns: range) -> Array:
    """Return ``A_j f`` in some rows and columns of an image that is turned."""
    local = LocalRotation(scene, j, rows, columns)
    return local.image(_around(sky, local.rows, local.columns))


class LocalRotation:
    """``A_j f`` and its adjoint between a window of the sky and one of an image that is turned.

    Parameters
    ----------
    scene : Scene
        With the images and the PSFs.
    j : int
        Which image.
    rows, columns : range
        Its window, pixels of the images' grid.

    Attributes
    ----------
    shape : tuple of int
        Of the window.
    rows, columns : range
        What of the sky's grid, round its edges, reaches the window.
    """

    def __init__(self, scene: Scene, j: int, rows: range, columns: range) -> None:
        turn, shift = scene.observation.turns[j], scene.observation.offsets[j]
        psf = scene.psf_cutout(j)
        corners = [(x, y) for x in (columns[0], columns[-1]) for y in (rows[0], rows[-1])]
        seen = np.linalg.solve(turn, (np.array(corners) - shift).T).T
        margin = np.array(psf.values.shape[::-1]) // 2 + TAPS
        first = np.floor(seen.min(axis=0) - margin).astype(int)
        last = np.ceil(seen.max(axis=0) + margin).astype(int)
        self.shape = len(rows), len(columns)
        angle = scene.rotations[j].angle
        scale = scene.rotations[j].scale
        slope = abs(math.tan(angle / 2.0))
        sheared = scale * (len(columns) + slope * len(rows) + TAPS) + TAPS
        needed = np.maximum(last - first + 1, (math.ceil(sheared), len(rows)))
        nx, ny = (scipy.fft.next_fast_len(int(n), real=True) for n in needed)
        self.rows, self.columns = range(first[1], first[1] + ny), range(first[0], first[0] + nx)
        at = turn @ first + shift - (columns[0], rows[0])
        box = range(self.shape[0]), range(self.shape[1])
        self._rotation = rotation = Rotation(angle, at, (ny, nx), box, scale)
        self._otf = scipy.fft.rfft2(psf.on_grid((ny, nx))) * rotation.undone()
        self._phases, self._shears = rotation.row_phases(), rotation.matrix(self.shape)

    def image(self, sky: Array) -> Array:
        """Return the window of the image, from that of the sky."""
        row_spectra = scipy.fft.ifft(self._otf * scipy.fft.rfft2(sky), axis=0)
        sheared = scipy.fft.irfft(row_spectra * self._phases, sky.shape[1], axis=1)
        sampled = self._rotation.sampled(sheared)
        return np.asarray((self._shears @ sampled.ravel()).reshape(self.shape))

    def adjoint(self, image: Array) -> Array:
        """Return the adjoint of `image`."""
        grid = len(self.rows), len(self.columns)
        sheared = self._rotation.spread((self._shears.T @ image.ravel()).reshape(grid))
        row_spectra = scipy.fft.rfft(sheared, axis=1) * self._phases.conj()
        spectrum = self._otf.conj() * scipy.fft.fft(row_spectra, axis=0)
        return np.asarray(scipy.fft.irfft2(spectrum, grid))


def _illuminate(image: Array, background: Array | float, starlight: Array) -> None:
    """Add background and starlight to the image of an extended source; leave nothing below 0."""
    image += background
    image += starlight
    np.maximum(image, 0.0, out=image)


def _window_of_correlations(
    cutouts: Sequence[Cutout], psfs: Sequence[Cutout]
) -> tuple[NDArray[np.int_], NDArray[np.int_]]:
    """Return first pixel and shape of the window that correlations of cutouts with PSFs lie in."""
    first, last = [], []
    for cutout, psf in zip(cutouts, psfs, strict=True):
        corner = np.array([cutout.y - psf.y, cutout.x - psf.x])
        first.append(corner - psf.values.shape + 1)
        last.append(corner + cutout.values.shape)
    start = np.min(first, axis=0)
    return start, np.max(last, axis=0) - start


def largest_window(scene: Scene) -> tuple[int, int]:
    """Return the largest shape of `Model.adjoint_of_cutouts` of star images, wherever these lie."""
    grid, shapes = scene.grid, (scene.observation.psfs.shape[1:], psf_shape(scene.observation))
    if scene.rotations:
        return grid
    more = 2 * MARGIN + 2 * (scene.oversample - 1)
    height, width = (k + of_star + 2 * more for k, of_star in zip(*shapes, strict=True))
    return grid if height >= grid[0] or width >= grid[1] else (height, width)
