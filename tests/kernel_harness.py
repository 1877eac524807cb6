"""Launching single kernels on arrays in natural order, random ones to begin with."""

from __future__ import annotations

import functools
from collections.abc import Iterable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import ArrayLike, DTypeLike, NDArray

from lnocl.core.opencl.launch import READ_WRITE, Launcher
from lnocl.core.opencl.layout import Layout, PixelLayout, reversed_order
from lnocl.core.opencl.program import Program
from lnocl.core.opencl.shears import Shears
from lnocl.core.opencl.tuning import Tuning, odd_part
from lnocl.core.opencl.windows import stars_near
from lnocl.core.scene.rotation import Rotation
from lnocl.core.scene.steps import Steps
from lnocl.errors import DeviceError

# What of a scene kernels are told as they are launched; with all else they are built.
MAPS = "has_weights", "has_background_map", "has_exposure_map", "has_smoothing_map"
ARGUMENTS = "n_images", "n_skies", "n_stars", "has_mu", "has_smoothing", *MAPS
# Scenes with all parts, together, that a program can have.
THREE_IMAGES = "three images, two stars, mask, background map, map of smoothing"
TWICE_AS_FINE = "sky twice as fine, three images, two stars, mask, background map"
TURNED = "three images turned, two stars, mask, background map"
TWO_SKIES = "two skies, three images, two stars, mask, mu, smoothing"
SCENES: dict[str, dict[str, Any]] = {
    "plain": {"n_images": 1},
    THREE_IMAGES: {
        "n_images": 3,
        "n_stars": 2,
        "has_weights": True,
        "has_background_map": True,
        "has_smoothing": True,
        "has_smoothing_map": True,
    },
    "exposure map, mu": {
        "n_images": 2,
        "n_stars": 1,
        "has_mu": True,
        "has_weights": True,
        "has_exposure_map": True,
        "has_background_map": True,
    },
    TWICE_AS_FINE: {
        "n_images": 3,
        "n_stars": 2,
        "has_weights": True,
        "has_background_map": True,
        "oversample": 2,
    },
    TWO_SKIES: {
        "n_images": 3,
        "n_skies": 2,
        "n_stars": 2,
        "has_mu": True,
        "has_weights": True,
        "has_smoothing": True,
    },
    TURNED: {
        "n_images": 3,
        "n_stars": 2,
        "has_weights": True,
        "has_background_map": True,
        "has_turns": True,
    },
}

CANARY = np.frombuffer(b"\xa5" * 64, np.uint8)


class SpectraLayout(Layout):
    """Converts spectra too between their natural order and that of the kernels."""

    def pack_spectra(self, row_spectra: NDArray) -> NDArray:
        """Return row spectra (rows, Nx // 2 + 1) in the kernels' order and precision.

        Column 0 gets the real parts of columns 0 and Nx / 2, as row spectra of real pixels have
        no others.
        """
        ny, nx = len(row_spectra), self.grid[1]
        kept = np.empty((ny, nx // 2), np.complex128)
        kept[:, 0] = row_spectra[:, 0].real + 1j * row_spectra[:, -1].real
        kept[:, 1:] = row_spectra[:, self.kept]
        kept[:, 1:][:, self.conjugated] = kept[:, 1:][:, self.conjugated].conj()
        return self.pack_columns(kept)

    def unpack_spectra(self, packed: NDArray, ny: int | None = None) -> NDArray[np.complex128]:
        """Return the row spectra (ny, Nx // 2 + 1) of an array in the kernels' order."""
        ny, nx = ny or self.grid[0], self.grid[1]
        kept = self.unpack_columns(packed, ny)
        row_spectra = np.empty((ny, nx // 2 + 1), np.complex128)
        row_spectra[:, 0], row_spectra[:, -1] = kept[:, 0].real, kept[:, 0].imag
        columns = kept[:, 1:]
        row_spectra[:, self.kept] = np.where(self.conjugated, columns.conj(), columns)
        return row_spectra

    def columns_of(self, spectrum: NDArray) -> NDArray[np.complex128]:
        """Return the columns (Ny, Nx / 2) that are kept of a half spectrum of real pixels."""
        ny, nx = self.grid
        columns = np.empty((ny, nx // 2), np.complex128)
        columns[:, 0] = spectrum[:, 0] + 1j * spectrum[:, -1]
        kept = spectrum[:, self.kept]
        columns[:, 1:] = np.where(self.conjugated, kept[-np.arange(ny)].conj(), kept)
        return columns

    def pack_columns(self, columns: NDArray) -> NDArray:
        """Return complex columns (rows, Nx / 2) in the kernels' order, as they are."""
        column_blocks, _, _, block = self.spectra_shape
        ny = len(columns)
        packed = np.zeros(self.spectra_shape, self.dtype)
        blocks = columns.reshape(ny, column_blocks, block).transpose(1, 0, 2)
        packed[:, :ny, 0], packed[:, :ny, 1] = blocks.real, blocks.imag
        return packed

    def unpack_columns(self, packed: NDArray, ny: int | None = None) -> NDArray[np.complex128]:
        """Return the complex columns (ny, Nx / 2) of an array in the kernels' order."""
        ny, nx = ny or self.grid[0], self.grid[1]
        parts = packed[:, :ny].astype(np.float64)
        return (parts[:, :, 0] + 1j * parts[:, :, 1]).transpose(1, 0, 2).reshape(ny, nx // 2)


class Windows:
    """The windows of stars: see kernels/stars.cl.

    That of one star is the whole grid; of several, each is half of its blocks and three quarters
    of its columns, the first star's round the edges. Arrays of a star have them a column apart.

    Parameters
    ----------
    layout : PixelLayout
        Of the arrays.
    n_stars : int
        Their number, at most 2.
    n_arrays : int
        Arrays of a star.
    """

    def __init__(self, layout: PixelLayout, n_stars: int, n_arrays: int) -> None:
        self.layout = layout
        row_blocks, nx = layout.pixels_shape[:2]
        self.n_blocks = row_blocks if n_stars < 2 else max(1, row_blocks // 2)
        self.n_columns = nx if n_stars < 2 else max(1, 3 * nx // 4)
        first = np.array([(row_blocks - 1, nx - 1), (0, 1)])[:n_stars, None]
        self.corners = first + np.array([0, 1]) * np.arange(n_arrays)[:, None]
        self.corners %= (row_blocks, nx)
        self.near = stars_near(self.corners, self.n_blocks, row_blocks)

    def rows(self, s: int, a: int) -> NDArray[np.int64]:
        """Return the rows of a window of a star."""
        return self.layout.rows_of(self.corners[s, a, 0], self.n_blocks)

    def columns(self, s: int, a: int) -> NDArray[np.int64]:
        """Return the columns of a window of a star."""
        nx = self.layout.grid[1]
        return np.arange(self.corners[s, a, 1], self.corners[s, a, 1] + self.n_columns) % nx


class KernelHarness:
    """Puts arrays in natural order on a device, launches kernels, and takes results off it.

    Behind every array lies a canary, which nothing may write to.

    Parameters
    ----------
    context : pyopencl.Context
        Of one device.
    grid, dtype, tuning
        Grid of the sky; as for `lnocl.core.opencl.program.Program`.
    **scene
        Parts of the scene, as for `lnocl.core.opencl.program.Program`, and `ARGUMENTS`: one of
        `SCENES`.
    """

    def __init__(
        self,
        context: cl.Context,
        grid: tuple[int, int],
        dtype: DTypeLike,
        tuning: Tuning | None = None,
        **scene: Any,
    ) -> None:
        self.n_images, self.n_stars = scene.get("n_images", 1), scene.get("n_stars", 0)
        self.n_skies = scene.get("n_skies", 1)
        parts = {name: has for name, has in scene.items() if name not in ARGUMENTS}
        self.program = Program(context, grid, np.dtype(dtype), tuning, **parts)
        self.layout, self.launcher = SpectraLayout(self.program), Launcher(self.program)
        self.dtype, self.grid, self.scene = self.program.dtype, grid, scene
        self.image_grid = self.program.image_grid
        self._buffers: list[cl.Buffer] = []

    def put(self, values: ArrayLike, dtype: DTypeLike | None = None) -> cl.Buffer:
        """Return a buffer that holds values as they lie, and the canary behind them."""
        packed = np.ascontiguousarray(values, dtype or self.dtype)
        data = np.concatenate([packed.reshape(-1).view(np.uint8), CANARY])
        flags = READ_WRITE | cl.mem_flags.COPY_HOST_PTR
        self._buffers.append(cl.Buffer(self.program.context, flags, hostbuf=data))
        return self._buffers[-1]

    def take(self, buffer: cl.Buffer, shape: Any) -> NDArray:
        """Return the contents of a buffer, after a look at the canaries of all buffers."""
        for each in self._buffers:
            if not np.array_equal(self._bytes(each)[-len(CANARY) :], CANARY):
                raise DeviceError("written past the end of an array")
        return self._bytes(buffer)[: -len(CANARY)].view(self.dtype).reshape(shape)

    def launch(self, kernel: str, **arguments: Any) -> None:
        """Launch a kernel with arguments by name; those it needs for the scene's counts are known.

        Arguments that the scene has no use for are small arrays.
        """
        counts = {"n_images": self.n_images, "n_stars": self.n_stars, "n_skies": self.n_skies}
        counts["has_transmission"] = 0
        counts |= {
            "is_smoothed": int(self.scene.get("has_smoothing", False)),
            **{name: int(self.scene.get(name, False)) for name in MAPS},
        }
        given = {**counts, "steps": self.put(Steps().numbers()), **arguments}
        for name, kind in self.program.arguments[kernel].items():
            if name not in given and name not in self.launcher.own:
                given[name] = self.put(np.zeros(2)) if "*" in kind else 0
        self.launcher.bind(kernel, given)()

    def forget(self) -> None:
        """Let go of all buffers put so far."""
        self._buffers.clear()

    def _bytes(self, buffer: cl.Buffer) -> NDArray[np.uint8]:
        data = np.empty(buffer.size, np.uint8)
        cl.enqueue_copy(self.launcher.queue, data, buffer)
        return data

    def put_pixels(self, pixels: Iterable[NDArray]) -> cl.Buffer:
        """Return a buffer of arrays of pixels, in the kernels' order."""
        return self.put([self.layout.pack_pixels(a) for a in pixels])

    def put_points(self, values: ArrayLike) -> cl.Buffer:
        """Return a buffer of values, each as a point that holds for all pixels."""
        return self.put(np.repeat(values, 2 * self.program.tuning.block))

    def put_spectra(self, row_spectra: Iterable[NDArray]) -> cl.Buffer:
        """Return a buffer of row spectra, in the kernels' order."""
        return self.put([self.layout.pack_spectra(a) for a in row_spectra])

    def put_image_spectra(self, row_spectra: Iterable[NDArray]) -> cl.Buffer:
        """Return a buffer of the row spectra of images, behind what several skies have before."""
        row_spectra = list(row_spectra)
        dark = np.full((self.n_skies - 1, *self.layout.spectra_shape), np.nan)
        return self.put([*dark, *map(self.layout.pack_spectra, row_spectra)])

    def put_windows(self, arrays: NDArray, windows: Windows) -> cl.Buffer:
        """Return a buffer of windows of arrays, [n_stars] or [n_stars][n_images]."""
        return self.put_pixels(
            each[np.ix_(windows.rows(s, a), windows.columns(s, a))]
            for s, stack in enumerate(arrays)
            for a, each in enumerate(np.reshape(stack, (-1, *windows.layout.grid)))
        )

    def pack_columns(self, pixels: NDArray) -> NDArray:
        """Return pixels (Ny, Nx) in pieces of columns, as kernels/turn.cl has them."""
        pairs, (ny, nx) = self.program.column_pairs, self.grid
        length = self.program.columns_size // (ny // pairs * nx)
        pair = (np.arange(0, ny // 2, pairs)[:, None] + np.arange(length)) % (ny // 2)
        rows = 2 * pair[:, None] + np.arange(2)[:, None]
        return np.moveaxis(pixels[rows], -1, 1)

    def take_pixels(self, buffer: cl.Buffer) -> NDArray:
        """Return the arrays of pixels (n_skies, Ny, Nx) that a buffer holds."""
        packed = self.take(buffer, (self.n_skies, *self.layout.pixels_shape))
        return self.layout.unpack_pixels(packed).reshape(-1, *self.grid)

    def take_spectra(self, buffer: cl.Buffer, count: int = 1, first: int = 0) -> NDArray:
        """Return the row spectra (count, Ny, Nx // 2 + 1) that a buffer holds, from one on."""
        return self._take_spectra(buffer, count, self.grid[0], first)

    def take_image_spectra(self, buffer: cl.Buffer, count: int) -> NDArray:
        """Return the row spectra (count, ny, Nx // 2 + 1) of images that a buffer holds."""
        return self._take_spectra(buffer, count, self.image_grid[0], self.n_skies - 1)

    def _take_spectra(self, buffer: cl.Buffer, count: int, ny: int, first: int) -> NDArray:
        packed = self.take(buffer, (-1, *self.layout.spectra_shape))[first : first + count]
        return np.array([self.layout.unpack_spectra(a, ny) for a in packed])

    def take_sums(self, buffer: cl.Buffer, n_sums: int) -> NDArray:
        """Return sums over pixels, of the pairs that each block left in a buffer."""
        return self.take(buffer, (-1, n_sums, 2)).astype(float).sum(axis=(0, 2))

    def empty_pixels(self) -> cl.Buffer:
        """Return a buffer for an array of pixels of each sky."""
        return self.put(np.full((self.n_skies, *self.layout.pixels_shape), np.nan))

    def empty_spectra(self) -> cl.Buffer:
        """Return a buffer for an array of row spectra of each sky."""
        return self.put(np.full((self.n_skies, *self.layout.spectra_shape), np.nan))

    def empty_sums(self, n_sums: int = 1) -> cl.Buffer:
        """Return a buffer for the pairs that each block leaves of so many sums."""
        return self.put(np.full((self.n_skies * self.program.row_blocks, n_sums, 2), np.nan))

    def otf_parts(self, otf: NDArray) -> tuple[NDArray, NDArray]:
        """Return an OTF (Ny, Nx // 2 + 1) as the kernels keep it: columns and edge."""
        ny = self.grid[0]
        order = reversed_order(ny)
        columns = self.layout.columns_of(otf)
        columns[:, 0] = (otf[:, 0] + otf[:, -1]) / 2
        edge = ((otf[:, 0] - otf[:, -1]) / 2)[order]
        packed = self.layout.pack_columns(columns[order])[:, :ny]
        if self.program.tuning.points:
            packed = self._in_registers(packed)
        return packed, np.stack([edge.real, edge.imag], axis=-1)

    def _in_registers(self, packed: NDArray) -> NDArray:
        """Return OTFs in the order in which the items of a group hold them."""
        blocks, ny, _, block = packed.shape
        items, odd = self.program.tuning.group // block, odd_part(ny)
        held = packed.reshape(blocks, odd, items, ny // items // odd, 2, block)
        return np.ascontiguousarray(held.transpose(0, 1, 3, 4, 2, 5)).reshape(packed.shape)


def rounded(array: ArrayLike, dtype: DTypeLike) -> NDArray:
    """Round inputs to the precision first, so that only the kernel's own error is left."""
    array = np.asarray(array)
    if np.iscomplexobj(array):
        return rounded(array.real, dtype) + 1j * rounded(array.imag, dtype)
    return array.astype(dtype).astype(float)


def inputs(harness: KernelHarness) -> SimpleNamespace:
    """Return random inputs for every kernel, in natural order."""
    rng = np.random.default_rng(harness.grid[0] * 31 + harness.grid[1])
    ny, nx = harness.grid
    image = harness.image_grid
    p, n, k = harness.n_images, harness.n_stars, harness.n_skies
    has_map, has_weights, has_exposure_map, has_mu, has_smoothing, has_smoothing_map = (
        harness.scene.get(f"has_{what}", False)
        for what in (
            "background_map", "weights", "exposure_map", "mu", "smoothing", "smoothing_map"
        )
    )  # fmt: skip
    own = functools.partial(rounded, dtype=harness.dtype)

    def half_spectra(count: int) -> NDArray:
        return own(np.fft.rfft(rng.normal(size=(count, ny, nx)), axis=-1))

    # Where the sky is finer, each row of A_j f has what lies between the image's pixels too.
    oversample = harness.program.oversample
    model = rng.uniform(0.5, 3.0, (p, image[0], nx))
    model[:, 0, : 2 * oversample] = -3.0  # the division guard, stars or not
    images = rng.poisson(3.0, (p, *image)) / 3.0
    images[:, 0, :2] = 0.0, 1.0
    weights = rng.random((p, *image)) > 0.2
    if has_exposure_map:
        weights = own(weights * rng.uniform(0.5, 2.0, weights.shape))
    star_images = own(rng.random((n, p, *image)))
    cross_information = own(rng.uniform(-0.1, 1.0, (n, ny, nx)))
    star_windows = _cut_to_windows(star_images, harness.layout.images, p)
    cross_windows = _cut_to_windows(cross_information, harness.layout, 1)
    rotations = []
    if harness.scene.get("has_turns"):
        shifts = rng.uniform(-3.0, 3.0, (p, 2)) * np.array(harness.grid[::-1])
        angles = np.linspace(-np.pi / 4, np.pi / 6, p)
        scales = [1.0] * (p - 1) + [1.7]
        each = zip(angles, shifts, scales, strict=True)
        box = range(image[0]), range(image[1])
        rotations = [Rotation(a, at, image, box, scale) for a, at, scale in each]
    mixes = rng.uniform(0.5, 1.5, (p, k))
    mixes[:1, 1:] = 0.0  # the first image shows the first sky alone, where there are several

    def of_skies(number: float) -> NDArray:
        """Return numbers of the skies, from one on."""
        return own(number * (1.0 + 0.25 * np.arange(k)).reshape(-1, 1, 1))

    return SimpleNamespace(
        p=p,
        n=n,
        k=k,
        mixes=own(mixes) if k > 1 else np.ones((p, 1)),
        flux_mixes=own(rng.uniform(0.5, 1.5, (n, k))) if k > 1 else np.ones((n, 1)),
        spectral=float(np.float32(0.15)) if has_smoothing and k > 1 else 0.0,
        rotations=rotations,
        shears=[Shears(rotation) for rotation in rotations],
        sheared=own(rng.uniform(0.5, 3.0, (p, ny, nx))),
        pixels=own(rng.normal(size=(k, ny, nx))),
        columns=own(rng.normal(size=(ny, nx // 2)) + 1j * rng.normal(size=(ny, nx // 2))),
        spectrum=half_spectra(k),
        otfs=own(np.fft.rfft2(rng.normal(size=(p, ny, nx))) / (ny * nx)),
        model_spectra=own(np.fft.rfft(model, axis=-1) / nx),
        image_spectra=half_spectra(p)[:, : image[0]],
        images=own(images),
        weights=weights if has_weights else None,
        has_exposure_map=has_exposure_map,
        background=own(rng.uniform(0.1, 0.2, (p, *image) if has_map else (p, 1, 1))),
        star_images=star_images,
        star_windows=star_windows,
        cross_windows=cross_windows,
        star_fluxes=own(rng.uniform(0.1, 1.0, n)),
        star_weights=own(rng.uniform(1.0, 2.0, n)),
        star_corrections=own(rng.uniform(0.9, 1.1, n)),
        prior_fluxes=own(rng.uniform(0.1, 1.0, n)),
        prior_precision=own(rng.uniform(0.5, 1.0, n)),
        extended=own(rng.random((k, ny, nx))),
        correction_spectra=own(np.fft.rfft(rng.uniform(-4.0, 8.0, (k, ny, nx)), axis=-1) / nx),
        inverse_weight=(
            own(np.where(rng.random((k, ny, nx)) > 0.2, rng.random((k, ny, nx)), 0.0))
            if has_weights
            else 1.0 / p
        ),
        # A step of so much less than f here, of more there, where the projection cuts it off; most
        # changes have one sign, so that their sums are not small differences.
        previous=own(rng.random((k, ny, nx)) * 0.5),
        gradient=own(rng.uniform(-0.2, 2.0, (k, ny, nx))),
        shift=own(rng.random((k, ny, nx))),
        transmission=own(rng.random((p, ny, nx))),
        slope=own(rng.uniform(-0.5, 1.0, (k, ny, nx))) if has_smoothing else 0.0,
        curvature=own(rng.random((k, ny, nx))) if has_smoothing else 0.0,
        smoothing=of_skies(0.4 if has_smoothing else 0.0),
        smoothing_map=own(rng.random((k, ny, nx))) if has_smoothing_map else None,
        edge=of_skies(0.3),
        cross_information=cross_information,
        mu=float(np.float32(0.25)) if has_mu else 0.0,
    )


def _cut_to_windows(arrays: NDArray, layout: PixelLayout, n_arrays: int) -> Windows:
    """Set the arrays of each star to 0 beyond a window, and return the windows."""
    stacks = arrays.reshape(len(arrays), n_arrays, *layout.grid)
    windows = Windows(layout, len(arrays), n_arrays)
    for s, stack in enumerate(stacks):
        for a, each in enumerate(stack):
            each[np.setdiff1d(np.arange(layout.grid[0]), windows.rows(s, a))] = 0.0
            each[:, np.setdiff1d(np.arange(layout.grid[1]), windows.columns(s, a))] = 0.0
    return windows
