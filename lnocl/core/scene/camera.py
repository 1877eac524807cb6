r"""Cameras: the maps from the sky's grid to the images, ``A_j = Sample o Turn o Blur o Transmit``.

- Transmit: where an image has a transmission, each pixel of the sky is multiplied by its share;
- Blur: the sky is convolved with the response of image j (`lnocl.core.scene.scene.Scene.psf`), by
  its spectrum, round the edges of the grid;
- Turn: where images are turned against the sky, three shears (`lnocl.core.scene.rotation`);
- Sample: an image has each `oversample`-th point of that along both axes.

Of each map there are `forward`, `adjoint` and `squares`, the adjoint of the squared elements; and
`window`, the map between a window of the sky and one of the image. Maps with the same `key` share
spectra of the sky: `images_of` and `Windows` transform the sky once for all of them.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Hashable, Iterable, Iterator, Sequence
from copy import copy
from functools import cached_property
from itertools import groupby
from types import EllipsisType
from typing import Any, Self

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from lnocl.core.scene.arrays import Array
from lnocl.core.scene.line_weights import TAPS
from lnocl.core.scene.rotation import Rotation
from lnocl.core.scene.scene import Scene
from lnocl.core.scene.shifting import Window, window
from lnocl.core.scene.threads import threads

Spectrum = NDArray[np.complex128]
# Rows and columns of the images' grid, or of the sky's, without an end.
Ranges = tuple[range, range]
# Where in an array a part of it lies; an ellipsis: all over.
Part = Window | EllipsisType


class LinearMap:
    """A map from the sky to an image, in two halves that meet in the spectrum of the sky.

    Attributes
    ----------
    key : hashable
        Maps of equal keys take the same spectrum of a sky.
    transmission : ndarray of float64 or None
        The share of each pixel's light, of the shape of the sky.
    """

    _otf: Spectrum
    key: Hashable
    _grid: tuple[int, int]  # of the transform
    _sky: Part = ...  # where the sky lies in it
    _seen: Part = ...  # where the image does
    _oversample = 1
    transmission: Array | None = None

    def single(self) -> Self:
        """Return the map for skies and images in single precision.

        Shears and transmissions are made in double precision all the same.
        """
        other = copy(self)
        other._otf = self._otf.astype(np.complex64)
        return other

    def forward(self, sky: Array) -> Array:
        """Return the image of a sky."""
        return self.seen(self.spectrum(sky))

    def adjoint(self, image: Array) -> Array:
        """Return the adjoint of `forward`."""
        return self.sky(self.back(image))

    def spectrum(self, sky: Array) -> Spectrum:
        """Return the spectrum of a sky."""
        seen = sky if self.transmission is None else self.transmission * sky
        return self._transform(seen, self._sky)

    def shared_spectrum(self, sky: Array, spectra: dict[Hashable, Spectrum]) -> Spectrum:
        """Return the spectrum of a sky, that which the map before left if it is of this `key`."""
        if self.key not in spectra:
            spectra.clear()
            spectra[self.key] = self.spectrum(sky)
        return spectra[self.key]

    def seen(self, spectrum: Spectrum) -> Array:
        """Return the image of the sky that has this spectrum."""
        fine = self._pixels(self._otf * spectrum)[_each(self._seen)]
        return np.ascontiguousarray(sampled(fine, self._oversample))

    def back(self, image: Array) -> Spectrum:
        """Return the spectrum of the adjoint, applied to an image."""
        return np.asarray(self._otf.conj() * self.unsampled(image))

    def unsampled(self, image: Array) -> Spectrum:
        """Return the spectrum of an image where it lies on the sky."""
        return self._transform(spread(image, self._oversample), self._seen)

    def sky(self, spectrum: Spectrum) -> Array:
        """Return the sky of a spectrum, which is overwritten."""
        sky = self._pixels(spectrum)[self._sky]
        return sky if self.transmission is None else self.transmission * sky

    def _transform(self, values: Array, there: Part) -> Spectrum:
        laid = values
        if there is not ...:
            laid = np.zeros((*values.shape[:-2], *self._grid), values.dtype)
            laid[_each(there)] = values
        return np.asarray(scipy.fft.rfft2(laid, workers=threads(self._grid)))

    def _pixels(self, spectrum: Spectrum) -> Array:
        workers = threads(self._grid)
        return np.asarray(scipy.fft.irfft2(spectrum, self._grid, workers=workers, overwrite_x=True))


class Camera(LinearMap):
    """``A_j``: what image j has of the sky, scaled and per exposure as `Scene` has it.

    Parameters
    ----------
    scene : Scene
        With the images and the PSFs.
    j : int
        Which image.
    is_kept : bool
        Whether it serves more than once, so that the spectrum of the PSF is held.

    Attributes
    ----------
    psf : Cutout
        The response, `Scene.psf_cutout`.
    rotation : Rotation or None
        How the image is turned.
    place : tuple of ndarray of float64
        M, shape (2, 2), and t, (2,), of `Observation.on_fine_pixels`: pixel u of the sky is at
        ``M u + t`` in the image.
    grid, image_grid : tuple of int
        Shapes of the sky and of the image.
    flat, back_flat : float
        What a flat sky of ones is in the image, and a flat image of ones in the sky: both stay
        flat, but for a transmission.
    """

    def __init__(self, scene: Scene, j: int, is_kept: bool = True) -> None:
        self._is_kept = is_kept
        self._scene, self._j, self._oversample = scene, j, scene.oversample
        self.grid = self._grid = self.key = scene.grid
        self.psf, self.image_grid = scene.psf_cutout(j), scene.image_grid
        self.rotation = scene.rotations[j] if scene.rotations else None
        self.place = scene.observation.on_fine_pixels(j)[:2]
        if scene.transmission is not None:
            self.transmission = scene.transmission[j]
            self.key = self.grid, self.transmission.ctypes.data
        self.flat = float(self.psf.values.sum())
        self.back_flat = self.flat / float(scene.areas[j])
        self._window_otfs: dict[Hashable, Spectrum] = {}

    @cached_property
    def _otf(self) -> Spectrum:  # type: ignore[override]
        return self._make_otf()

    def _make_otf(self) -> Spectrum:
        return self._transform(self._scene.psf(self._j), ...)

    def seen(self, spectrum: Spectrum) -> Array:
        """Return the image of the sky that has this spectrum."""
        return np.ascontiguousarray(sampled(self.convolved(spectrum), self._oversample))

    def convolved(self, spectrum: Spectrum) -> Array:
        """Return the image before its pixels sample it, of the shape of the sky."""
        if self._is_kept:
            product = self._otf * spectrum
        else:
            product = self._make_otf()
            product *= spectrum
        sky = self._pixels(product)
        return sky if self.rotation is None else self.rotation.forward(sky)

    def in_frame(self, sky: Array) -> Spectrum:
        """Return the spectrum of a sky, per pixel of it, in the frame of the image before its PSF.

        Where the image is turned it has what the image's pixels can hold: that its PSF can show.
        """
        spectrum, rotation, shift = self.spectrum(sky), self.rotation, self.place[1]
        v, u = np.fft.fftfreq(self.grid[0])[:, None], np.fft.rfftfreq(self.grid[1])
        if rotation is None:
            dx, dy = shift
            return np.asarray(spectrum * np.exp(-2j * np.pi * (u * dx + v * dy)))
        c, s = (rotation.scale * f(rotation.angle) for f in (math.cos, math.sin))
        is_held = (abs(c * u - s * v) <= 0.5) & (abs(s * u + c * v) <= 0.5)
        seen = rotation.forward(self._pixels(spectrum * is_held * rotation.undone()))
        return self._transform(seen, ...)

    def unsampled(self, image: Array) -> Spectrum:
        """Return the spectrum of an image where it lies on the sky."""
        if self.rotation is None:
            return super().unsampled(image)
        return self._transform(self.rotation.adjoint(spread(image, self._oversample)), ...)

    def point(self) -> Array:
        """Return what the image has of a point at the origin, shape (Ny, Nx).

        Where images are turned `Scene.psf` has what their weights need besides; its squares mean
        nothing.
        """
        return self._scene.psf_cutout(self._j).on_grid(self._scene.grid)

    def squares(self, image: Array, elements: Array | None = None, power: int = 2) -> Array:
        """Return ``(A_j^2)^T x``, with the squares of the elements of A_j, for x not below 0.

        Shears and their weights are made for what pixels hold, and would ring: pixels of an image
        that is turned are shared out among the four of the sky round each.

        Parameters
        ----------
        image : ndarray of float64, shape (ny, nx)
            x.
        elements : ndarray of float64, shape (Ny, Nx), optional
            What to take instead of the squares of `point`.
        power : int, optional
            That of the transmission, beside such elements.
        """
        elements = self.point() ** 2 if elements is None else elements
        spectra = (self._transform(each, ...) for each in (self._shared_out(image), elements))
        back = self._pixels(next(spectra) * next(spectra).conj())
        return back if self.transmission is None else self.transmission**power * back

    def _shared_out(self, image: Array) -> Array:
        """Return the pixels of an image where they lie on the sky's grid."""
        if self.rotation is None:
            return spread(image, self._oversample)
        y, x = np.nonzero(image)
        turn, offset = self.place
        pixels = self._oversample * np.stack([x, y], axis=1)
        places = np.linalg.solve(turn, (pixels - offset).T)[::-1]
        first = np.floor(places).astype(int)
        sky = np.zeros(math.prod(self.grid))
        for step in np.ndindex(2, 2):
            corner = first + np.array(step)[:, None]
            share = (1.0 - abs(places - corner)).prod(axis=0)
            index = np.ravel_multi_index(tuple(corner), self.grid, mode="wrap")
            sky += np.bincount(index, share * image[y, x], sky.size)
        return sky.reshape(self.grid)

    def of_ones(self) -> Array | float:
        """Return the image of a sky of ones: a number where it is flat."""
        if self.transmission is None:
            return self.flat
        return self.forward(np.ones(self.grid))

    def window(self, seen: Ranges, sky: Ranges | None = None) -> WindowCamera | TurnedWindow:
        """Return the map between a window of the sky and one of the image.

        Parameters
        ----------
        seen : tuple of range
            Rows and columns of the image, round the edges of its grid.
        sky : tuple of range, optional
            Those of the sky; beyond them it is dark. By default all that reaches the image's.
        """
        if self.rotation is None:
            return WindowCamera(self, seen, sky)
        return TurnedWindow(self, self.rotation, seen, sky)

    def part(self, sky: Array, seen: Ranges) -> Array:
        """Return a window of the image of a sky."""
        there = self.window(seen)
        return there.forward(_part(sky, there.reached))

    def reached(self, seen: Ranges) -> Ranges:
        """Return the rows and columns of the sky that reach a window of the image, not turned.

        That is an axis as a whole where they are more.
        """
        axes = zip(seen, self.psf[1:], self.psf.values.shape, self.grid, strict=True)
        rows, columns = (_reached(self.fine(at), *each) for at, *each in axes)
        return rows, columns

    def fine(self, at: range) -> range:
        """Return the pixels of the sky that begin with some of the image, along an axis."""
        return range(self._oversample * at.start, self._oversample * at.stop)

    def part_otf(
        self, shape: tuple[int, int], first: Sequence[int], origin: Sequence[int]
    ) -> Spectrum:
        """Return the spectrum of a part of the response, on an array of this shape.

        Its row and column of `first` are those that the part begins with; those of `origin` go to
        the origin.
        """
        key = shape, *(tuple(np.subtract(each, self.psf[1:])) for each in (first, origin))
        if key not in self._window_otfs:
            part = self.psf.add_to(np.zeros(shape), (first[0], first[1]), self.grid)
            laid = np.roll(part, np.subtract(first, origin), axis=(0, 1))
            self._window_otfs[key] = scipy.fft.rfft2(laid)
        return self._window_otfs[key]


class WindowCamera(LinearMap):
    """``A_j`` between a window of the sky and one of an image that is not turned.

    Attributes
    ----------
    shape : tuple of int
        Of the window of the image.
    reached : tuple of range
        The window of the sky, round the edges of the grid.
    cut : hashable
        What maps have in common that differ in the PSF alone.
    """

    def __init__(self, camera: Camera, seen: Ranges, sky: Ranges | None) -> None:
        self.shape, self._oversample = (len(seen[0]), len(seen[1])), camera._oversample
        fine, reached = [camera.fine(at) for at in seen], camera.reached(seen)
        self.reached = sky or reached
        axes = fine, self.reached, reached, camera.psf[1:], camera.grid
        down, along = (_plan(*each) for each in zip(*axes, strict=True))
        (height, width), first, origin, (y, x) = zip(down, along, strict=True)
        self._grid = self.key = height, width
        if camera.transmission is not None:
            self.transmission, self.key = _part(camera.transmission, self.reached), id(self)
        self._otf = camera.part_otf(self._grid, first, origin)
        self._sky = window(0, 0, [len(at) for at in self.reached], self._grid)
        self._seen = window(y, x, [len(at) for at in fine], self._grid)
        self.cut = self.key, self.shape, y, x


class TurnedWindow(LinearMap):
    """The same for an image that is turned, whose shears go round the edges of a larger window."""

    def __init__(
        self, camera: Camera, rotation: Rotation, seen: Ranges, sky: Ranges | None
    ) -> None:
        self.shape, self._oversample = (len(seen[0]), len(seen[1])), camera._oversample
        (turn, shift), (rows, columns) = camera.place, map(camera.fine, seen)
        scale = rotation.scale
        corners = [(x, y) for x in (columns[0], columns[-1]) for y in (rows[0], rows[-1])]
        places = np.linalg.solve(turn, (np.array(corners) - shift).T).T
        margin = np.array(camera.psf.values.shape[::-1]) // 2 + TAPS
        first = np.floor(places.min(axis=0) - margin).astype(int)
        last = np.ceil(places.max(axis=0) + margin).astype(int)
        slope = abs(math.tan(rotation.angle / 2.0))
        sheared = scale * (len(columns) + slope * len(rows) + TAPS) + TAPS
        needed = np.maximum(last - first + 1, (math.ceil(sheared), len(rows)))
        nx, ny = (_fast(int(n)) for n in needed)
        self._grid, self.key = (ny, nx), id(self)
        self.reached = sky or ranges(first[::-1].tolist(), self._grid)
        y, x = (at.start - start for at, start in zip(self.reached, first[::-1], strict=True))
        self._sky = window(y, x, [len(at) for at in self.reached], self._grid)
        if camera.transmission is not None:
            self.transmission = _part(camera.transmission, self.reached)
        shift = turn @ first + shift - (columns[0], rows[0])
        box = range(len(rows)), range(len(columns))
        self._rotation = rotation = Rotation(rotation.angle, shift, self._grid, box, scale)
        self._otf = scipy.fft.rfft2(camera.psf.on_grid(self._grid)) * rotation.undone()
        self._phases = rotation.row_phases()
        self._shears = rotation.matrix(self.shape, self._oversample)

    def seen(self, spectrum: Spectrum) -> Array:
        """Return the image of the sky that has this spectrum."""
        if spectrum.ndim > 2:
            return np.array([self.seen(each) for each in spectrum])
        row_spectra = scipy.fft.ifft(self._otf * spectrum, axis=0)
        sheared = scipy.fft.irfft(row_spectra * self._phases, self._grid[1], axis=1)
        taken = self._rotation.sampled(sheared)
        return np.asarray((self._shears @ taken.ravel()).reshape(self.shape))

    def unsampled(self, image: Array) -> Spectrum:
        """Return the spectrum of an image where it lies on the sky."""
        sheared = self._rotation.spread((self._shears.T @ image.ravel()).reshape(self._grid))
        row_spectra = scipy.fft.rfft(sheared, axis=1) * self._phases.conj()
        return np.asarray(scipy.fft.fft(row_spectra, axis=0))


def images_of(cameras: Iterable[Camera], sky: Array) -> Iterator[Array]:
    """Yield the ``A_j f``; nothing but one of them, and the spectrum of f, is held."""
    spectra: dict[Hashable, Spectrum] = {}
    flat = is_flat(sky)
    for camera in cameras:
        if flat and camera.transmission is None:
            yield np.full(camera.image_grid, sky[0, 0] * camera.flat)
        else:
            yield camera.seen(camera.shared_spectrum(sky, spectra))


class Windows:
    """Maps between one window of the sky and one of each image, those of one cut all at once.

    Parameters
    ----------
    maps : sequence of p WindowCamera or TurnedWindow
        All take the same window of the sky.
    """

    def __init__(self, maps: Sequence[WindowCamera | TurnedWindow]) -> None:
        self._maps, cuts = maps, defaultdict[Hashable, list[int]](list)
        for j, each in enumerate(maps):
            cuts[each.cut if isinstance(each, WindowCamera) else j].append(j)
        self._cuts = list(cuts.values())
        self._joint = [_joined([maps[j] for j in members]) for members in self._cuts]

    def forward(self, sky: Array) -> list[Array]:
        """Return the images of a sky, or of several, shape (..., ny, nx)."""
        images, spectra = [sky] * len(self._maps), dict[Hashable, Spectrum]()
        for members, each in zip(self._cuts, self._joint, strict=True):
            seen = each.seen(each.shared_spectrum(sky, spectra)[..., None, :, :])
            for k, j in enumerate(members):
                images[j] = seen[..., k, :, :]
        return images

    def adjoint(self, images: Sequence[Array]) -> Array:
        """Return the sum of the adjoints, each applied to its image."""
        totals: dict[Hashable, tuple[LinearMap, Spectrum]] = {}
        for members, each in zip(self._cuts, self._joint, strict=True):
            seen = [images[j] for j in members]
            back = each.back(np.array(seen)).sum(axis=0) if len(seen) > 1 else each.back(seen[0])
            _, so_far = totals.get(each.key, (each, 0.0))
            totals[each.key] = each, back + so_far
        return np.asarray(sum(each.sky(total) for each, total in totals.values()))


def _joined(maps: Sequence[WindowCamera | TurnedWindow]) -> WindowCamera | TurnedWindow:
    """Return maps of one cut as one, whose images are stacked."""
    if len(maps) == 1:
        return maps[0]
    joint = copy(maps[0])
    joint._otf = np.array([each._otf for each in maps])
    return joint


def adjoints_of(cameras: Sequence[Camera], images: Iterable[Array], factors: Array) -> Array:
    """Return ``sum_j q_kj A_j^T x_j`` for each k, shape (k, Ny, Nx); q has shape (k, p).

    Images that share their memory, as weights do, are transformed once; those of one value each
    are not. The result may be read-only: of such alone it is a view of one value, too.
    """
    if cameras[0].transmission is not None:
        skies = np.zeros((len(factors), *cameras[0].grid))
        for camera, image, own in zip(cameras, images, factors.T, strict=True):
            skies += own[:, None, None] * camera.adjoint(image)
        return skies
    grid, flat, spectra = cameras[0].grid, np.zeros(len(factors)), list[Spectrum]()
    for image, members in _runs(images, cameras[0].rotation is None):
        shares, seen_by = factors[:, members], [cameras[j] for j in members]
        if not any(image.strides):  # of one value, as weights are where all is observed
            flat += shares @ [camera.back_flat for camera in seen_by] * image[0, 0]
            continue
        spectrum = seen_by[0].unsampled(image).conj()
        spectra = spectra or [np.zeros_like(spectrum) for _ in factors]
        for total, share in zip(spectra, shares, strict=True):
            total += mixed_otf(seen_by, share) * spectrum
    if not spectra:
        return np.broadcast_to(flat[:, None, None], (len(flat), *grid))
    pairs = zip(spectra, flat.tolist(), strict=True)
    return np.array([cameras[0].sky(each.conj()) + level for each, level in pairs])


def mixed_otf(cameras: Sequence[Camera], shares: Array) -> Spectrum:
    """Return ``sum_j q_j K^_j`` over some images."""
    if len(cameras) == 1:
        otf = cameras[0]._otf
        return otf if shares[0] == 1.0 else np.asarray(shares[0] * otf)
    mixed = np.zeros(cameras[0].grid)
    for camera, share in zip(cameras, shares, strict=True):
        mixed[camera.psf.window(mixed.shape)] += share * camera.psf.values
    return cameras[0]._transform(mixed, ...)


def _runs(images: Iterable[Array], may_share: bool) -> Iterator[tuple[Array, list[int]]]:
    """Yield images with the places of all in a row that are the same memory, as shared weights."""

    def memory(at: tuple[int, Array]) -> object:
        return (at[1].ctypes.data, at[1].strides) if may_share else at[0]

    for _, each in groupby(enumerate(images), memory):
        run = list(each)  # all are held: none lies in the memory of another
        yield run[0][1], [j for j, _ in run]


def is_flat(array: Array) -> bool:
    """Return whether an array has one value alone; convolved, it stays flat."""
    return not any(array.strides) or bool((array == array[0, 0]).all())


def sampled(sky: Array, oversample: int) -> Array:
    """Return each `oversample`-th row and column: what an image has of a convolved sky."""
    return sky[..., ::oversample, ::oversample]


def spread(image: Array, oversample: int, beside: float = 0.0) -> Array:
    """Return the adjoint of `sampled`: the pixels of an image on the sky's, 0 between them."""
    if oversample == 1:
        return image
    shape = *image.shape[:-2], *(oversample * n for n in image.shape[-2:])
    sky = np.full(shape, beside, image.dtype)
    sky[..., ::oversample, ::oversample] = image
    return sky


def _each(part: Part) -> Any:
    """Return where a part of each of several arrays lies."""
    return part if isinstance(part, EllipsisType) else (..., *part)


def ranges(first: Sequence[int], shape: Sequence[int]) -> Ranges:
    """Return the rows and columns of a window with a first pixel and a shape."""
    rows, columns = (range(at, at + n) for at, n in zip(first, shape, strict=True))
    return rows, columns


def _part(sky: Array, there: Ranges) -> Array:
    """Return rows and columns of the sky, round its edges."""
    return sky.take(there[0], 0, mode="wrap").take(there[1], 1, mode="wrap")


def _reached(seen: range, first: int, size: int, n: int) -> range:
    """Return what of an axis of n points some see by a PSF with this first lag and size."""
    length = len(seen) + size - 1
    start = seen.start - first - size + 1
    return range(start, start + length) if length < n else range(n)


def _plan(seen: range, sky: range, reached: range, first: int, n: int) -> tuple[int, int, int, int]:
    """Return how an axis of n points is transformed, so that nothing goes round its end wrongly.

    That is the length; the first lag, of image less sky, that the PSF is held from on; the lag at
    the origin; and where the window of the image begins.
    """
    lag = seen.start - sky.start
    if len(sky) < n and sky.start <= reached.start and reached.stop <= sky.stop:
        # All of the PSF, whose first lag is given, has room beside what is seen.
        return min(_fast(len(sky)), n), first, first, lag - first
    length = min(_fast(len(sky) + len(seen)), n)
    return length, lag + len(seen) - length, lag, 0


def _fast(n: int) -> int:
    return int(scipy.fft.next_fast_len(n, real=True))
