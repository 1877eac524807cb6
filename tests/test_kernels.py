"""Every kernel against its twin in `lnocl.reference`, with a canary behind every output."""

import functools
from types import SimpleNamespace

import numpy as np
import pyopencl as cl
import pytest

from lnocl import reference
from lnocl.device import choose
from lnocl.fft import READ_WRITE, Launcher, Layout, bit_reversed
from lnocl.program import STEP_SOURCES, Program, Tuning
from lnocl.scene import LEAST_MODEL

CANARY = np.frombuffer(b"\xa5" * 64, np.uint8)


# Name: (grid, tuning, scene, precisions), a capital letter for one that only CI tests. Each grid
# is the smallest that takes some path of kernels/fft.cl; tunings other than the default share a
# block among work-items, as a GPU does.
# (PoCL 3 miscompiles vectors of 2 in groups of several work-items; no tuning has them.)
THREE_IMAGES = "three images, two stars, mask, background map, smoothing"
CASES = {
    "outer radix 2": ((2, 2), None, "plain", "sd"),
    "outer radix 4": ((4, 4), None, "plain", "S"),
    "outer radix 8": ((8, 8), None, "mask, mu, smoothing", "s"),
    "radices 4, 4 and 8, 4": ((16, 32), None, THREE_IMAGES, "sD"),
    "radices 8, 8 and 4, 8, 4": ((64, 128), None, "two images, star, mu", "Sd"),
    "radices 8, 8, 4": ((256, 16), None, "plain", "S"),
    "exposure map": ((32, 16), None, "exposure map", "sD"),
    "exposure map, group": ((32, 16), Tuning(1, 8, group=4), "exposure map", "S"),
    "radices 8, 8, 8": ((8, 512), None, "plain", "S"),
    "radices 4, 8, 8, 4, middle pass": ((32, 1024), None, "plain", "SD"),
    "middle pass along y": ((2048, 4), None, "plain", "d"),
    "global scratch": ((8192, 64), Tuning(4, 16), "plain", "s"),
    "several vectors a block": ((64, 32), Tuning(4, 8), "mask, mu, smoothing", "S"),
    "group": ((64, 32), Tuning(1, 8, group=4), THREE_IMAGES, "sD"),
    "group, middle pass": ((2048, 16), Tuning(1, 2, group=64), "plain", "D"),
    "group, global scratch": ((4096, 64), Tuning(4, 32, group=8), "mask, mu, smoothing", "S"),
}
SCENES = {
    "plain": {"n_images": 1},
    "two images, star, mu": {"n_images": 2, "n_stars": 1, "has_mu": True},
    THREE_IMAGES: {
        "n_images": 3,
        "n_stars": 2,
        "has_weights": True,
        "has_background_map": True,
        "has_smoothing": True,
    },
    "mask, mu, smoothing": {
        "n_images": 1,
        "has_weights": True,
        "has_mu": True,
        "has_smoothing": True,
    },
    "exposure map": {
        "n_images": 2,
        "n_stars": 1,
        "has_weights": True,
        "has_exposure_map": True,
        "has_background_map": True,
    },
}
DTYPES = {"s": np.float32, "d": np.float64}
RUNS = [
    pytest.param(
        case,
        DTYPES[d.lower()],
        marks=[pytest.mark.exhaustive] if d.isupper() else [],
        id=f"{case}-{d}",
    )
    for case, (*_, precisions) in CASES.items()
    for d in precisions
]
KERNELS = (
    "rfft_rows",
    "irfft_rows",
    "fft_columns",
    "ifft_columns",
    "otf_columns",
    "convolve_columns",
    "correlate_columns",
    "ratio_rows",
    "smooth",
    "scale_rows",
    "collect_sums",
    "gradient_rows",
    "step_rows",
)
# Worst element over largest: three times what was measured over all cases on PoCL, 3.3e-7 and
# 1.2e-15.
TOLERANCE = {np.float32: 1e-6, np.float64: 3.7e-15}


@functools.cache
def context():
    return cl.Context([choose().device])


@functools.cache
def bench(case, dtype):
    grid, tuning, scene, _ = CASES[case]
    program = Program(
        context(),
        grid,
        np.dtype(dtype),
        tuning,
        STEP_SOURCES,
        least_model=LEAST_MODEL,
        **SCENES[scene],
    )
    return Bench(program)


class Bench:
    """Puts arrays in natural order on the device, launches, and takes results off it."""

    def __init__(self, program):
        self.program, self.layout, self.launcher = program, Layout(program), Launcher(program)
        self.dtype, self.grid = program.dtype, program.grid
        self.outputs = []

    def put(self, values, dtype=None):
        packed = np.ascontiguousarray(values, dtype or self.dtype)
        data = np.concatenate([packed.reshape(-1).view(np.uint8), CANARY])
        buffer = cl.Buffer(context(), READ_WRITE | cl.mem_flags.COPY_HOST_PTR, hostbuf=data)
        self.outputs.append(buffer)
        return buffer

    def take(self, buffer, shape):
        """Return what the buffer holds, after looking at the canaries of all buffers."""
        for each in self.outputs:
            data = np.empty(each.size, np.uint8)
            cl.enqueue_copy(self.launcher.queue, data, each)
            assert np.array_equal(data[-len(CANARY) :], CANARY), "written past the end"
            if each is buffer:
                kept = data
        return kept[: -len(CANARY)].view(self.dtype).reshape(shape)

    def holds(self, buffer, values):
        """Say whether a buffer still holds what was put into it."""
        data = np.empty(buffer.size, np.uint8)
        cl.enqueue_copy(self.launcher.queue, data, buffer)
        packed = np.ascontiguousarray(values, self.dtype).reshape(-1).view(np.uint8)
        return np.array_equal(data[: -len(CANARY)], packed)

    def put_pixels(self, pixels):
        return self.put([self.layout.pack_pixels(a) for a in pixels])

    def put_spectra(self, row_spectra):
        return self.put([self.layout.pack_spectra(a) for a in row_spectra])

    def take_pixels(self, buffer, count=1):
        packed = self.take(buffer, (count, *self.layout.pixels_shape))
        return np.array([self.layout.unpack_pixels(a) for a in packed])

    def take_spectra(self, buffer, count=1):
        packed = self.take(buffer, (count, *self.layout.spectra_shape))
        return np.array([self.layout.unpack_spectra(a) for a in packed])

    def empty_pixels(self, count=1):
        return self.put(np.full((count, *self.layout.pixels_shape), np.nan))

    def empty_spectra(self, count=1):
        return self.put(np.full((count, *self.layout.spectra_shape), np.nan))

    def otf_parts(self, otf):
        """Return an OTF (Ny, Nx // 2 + 1) as the kernels keep it: columns and edge."""
        ny = self.grid[0]
        order = bit_reversed(ny)
        columns = self.layout.columns_of(otf)
        columns[:, 0] = (otf[:, 0] + otf[:, -1]) / 2
        edge = ((otf[:, 0] - otf[:, -1]) / 2)[order]
        packed = self.layout.pack_columns(columns[order])[:, :ny]
        return packed, np.stack([edge.real, edge.imag], axis=-1)


def rounded(array, dtype):
    """Round inputs to the precision first, so that only the kernel's own error is left."""
    if np.iscomplexobj(array):
        return array.real.astype(dtype).astype(float) + 1j * array.imag.astype(dtype).astype(float)
    return np.asarray(array).astype(dtype).astype(float)


def inputs(b):
    """Random inputs for every kernel, in natural order."""
    rng = np.random.default_rng(b.grid[0] * 31 + b.grid[1])
    ny, nx = b.grid
    p, n = b.program.n_images, b.program.n_stars
    dtype = b.dtype

    def half_spectra(count):
        return rounded(np.fft.rfft(rng.normal(size=(count, ny, nx)), axis=-1), dtype)

    model = rng.uniform(0.5, 3.0, (p, ny, nx))
    model[:, 0, :2] = -1.0  # the division guard
    images = rng.poisson(3.0, (p, ny, nx)) / 3.0
    images[:, 0, :2] = 0.0, 1.0
    weights = rng.random((p, ny, nx)) > 0.2
    has_exposure_map = "-DHAS_EXPOSURE_MAP=1" in b.program.options
    if has_exposure_map:
        weights = rounded(weights * rng.uniform(0.5, 2.0, weights.shape), dtype)
    # One star is seen in all blocks; of two, each in half of them, the first round the edge.
    row_blocks = b.program.row_blocks
    star_blocks = row_blocks if n < 2 else max(1, row_blocks // 2)
    first_blocks = np.array([row_blocks - 1, 0])[:n]
    star_images = rounded(rng.random((n, p, ny, nx)), dtype)
    for images_of_star, first in zip(star_images, first_blocks, strict=True):
        dark = np.setdiff1d(np.arange(ny), b.layout.rows_of(first, star_blocks))
        images_of_star[:, dark] = 0.0
    has_map = "-DHAS_BACKGROUND_MAP=1" in b.program.options
    has_weights = "-DHAS_WEIGHTS=1" in b.program.options
    has_smoothing = "-DHAS_SMOOTHING=1" in b.program.options
    return SimpleNamespace(
        p=p,
        n=n,
        pixels=rounded(rng.normal(size=(1, ny, nx)), dtype),
        columns=rounded(
            rng.normal(size=(ny, nx // 2)) + 1j * rng.normal(size=(ny, nx // 2)), dtype
        ),
        spectrum=half_spectra(1),
        spectra=half_spectra(p),
        otfs=rounded(np.fft.rfft2(rng.normal(size=(p, ny, nx))) / (ny * nx), dtype),
        model_spectra=rounded(np.fft.rfft(model, axis=-1) / nx, dtype),
        images=rounded(images, dtype),
        weights=weights if has_weights else None,
        has_exposure_map=has_exposure_map,
        background=rounded(rng.uniform(0.1, 0.2, (p, ny, nx) if has_map else (p, 1, 1)), dtype),
        star_images=star_images,
        star_blocks=star_blocks,
        first_blocks=first_blocks,
        star_fluxes=rounded(rng.uniform(0.1, 1.0, n), dtype),
        star_weights=rounded(rng.uniform(1.0, 2.0, n), dtype),
        star_corrections=rounded(rng.uniform(0.9, 1.1, n), dtype),
        extended=rounded(rng.random((1, ny, nx)), dtype),
        correction_spectra=rounded(
            np.fft.rfft(rng.uniform(-0.1, 2.0, (1, ny, nx)), axis=-1) / nx, dtype
        ),
        inverse_weight=(
            rounded(np.where(rng.random((1, ny, nx)) > 0.2, rng.random((1, ny, nx)), 0.0), dtype)
            if has_weights
            else 1.0 / p
        ),
        # A step of so much less than f here, of more there, where the projection cuts it off; most
        # changes have one sign, so that their sums are not small differences.
        previous=rounded(rng.random((1, ny, nx)) * 0.5, dtype),
        gradient=rounded(rng.uniform(-0.2, 2.0, (1, ny, nx)), dtype),
        shift=rounded(rng.random((1, ny, nx)), dtype),
        scaling=rounded(rng.random((1, ny, nx)), dtype),
        slope=rounded(rng.uniform(-0.5, 1.0, (1, ny, nx)), dtype) if has_smoothing else 0.0,
        curvature=rounded(rng.random((1, ny, nx)), dtype) if has_smoothing else 0.0,
        smoothing=float(np.float32(0.4)) if has_smoothing else 0.0,
        edge=float(np.float32(0.3)),
        reach=rounded(rng.uniform(-0.1, 1.0, (n, ny, nx)), dtype),
        mu=float(np.float32(0.25)) if "-DHAS_MU=1" in b.program.options else 0.0,
    )


@pytest.mark.parametrize("dtype", DTYPES.values())
def test_inputs_of_out_of_place_transforms_stay_as_they_are(dtype):
    b = bench("radices 8, 8 and 4, 8, 4", dtype)
    i = inputs(b)
    pixels, spectrum = b.layout.pack_pixels(i.pixels), b.layout.pack_spectra(i.spectrum[0])
    launcher = b.launcher
    for name, out, packed in (
        ("rfft_rows", b.empty_spectra(), pixels),
        ("irfft_rows", b.empty_pixels(), spectrum),
    ):
        given = b.put(packed)
        launcher.rows(name, out, given)()
        assert b.holds(given, packed), name


def run_rfft_rows(b, i):
    out = b.empty_spectra()
    b.launcher.rows("rfft_rows", out, b.put_pixels(i.pixels))()
    yield b.take_spectra(out), reference.rfft_rows(i.pixels)


def run_irfft_rows(b, i):
    out = b.empty_pixels()
    b.launcher.rows("irfft_rows", out, b.put_spectra(i.spectrum))()
    yield b.take_pixels(out), reference.irfft_rows(i.spectrum)


def run_fft_columns(b, i):
    out = b.put(b.layout.pack_columns(i.columns))
    b.launcher.columns("fft_columns", out)()
    found = b.layout.unpack_columns(b.take(out, b.layout.spectra_shape))
    yield found, reference.fft_columns(i.columns)[bit_reversed(b.grid[0])]


def run_ifft_columns(b, i):
    out = b.put(b.layout.pack_columns(i.columns[bit_reversed(b.grid[0])]))
    b.launcher.columns("ifft_columns", out)()
    found = b.layout.unpack_columns(b.take(out, b.layout.spectra_shape))
    yield found, reference.ifft_columns(i.columns)


def run_otf_columns(b, i):
    packed, edge = b.otf_parts(reference.otf_columns(i.spectrum[0]))
    packed, edge = np.stack([packed] * i.p), np.stack([edge] * i.p)
    packed[:-1], edge[:-1] = 2.0, 2.0  # the other images' parts stay as they are
    out, out_edge = b.put(np.full(packed.shape, 2.0)), b.put(np.full(edge.shape, 2.0))
    b.launcher.columns("otf_columns", out, out_edge, b.put_spectra(i.spectrum), np.int32(i.p - 1))()
    yield b.take(out, packed.shape)[-1], packed[-1]
    yield b.take(out, packed.shape)[:-1], packed[:-1]
    yield b.take(out_edge, edge.shape), edge


def put_otfs(b, i):
    parts = [b.otf_parts(otf) for otf in i.otfs]
    return b.put([columns for columns, _ in parts]), b.put([edge for _, edge in parts])


def run_convolve_columns(b, i):
    given = np.concatenate([i.spectrum, np.full((i.p - 1, *i.spectrum.shape[1:]), np.nan)])
    out = b.put_spectra(given)
    b.launcher.columns("convolve_columns", out, *put_otfs(b, i))()
    yield b.take_spectra(out, i.p), real_edges(reference.convolve_columns(i.spectrum[0], i.otfs))


def run_correlate_columns(b, i):
    out = b.put_spectra(i.spectra)
    b.launcher.columns("correlate_columns", out, *put_otfs(b, i))()
    found = b.take_spectra(out, i.p)
    yield found[0], real_edges(reference.correlate_columns(i.spectra, i.otfs))
    assert np.array_equal(found[1:], real_edges(i.spectra[1:])), "others than array 0 are written"


def real_edges(row_spectra):
    """Row spectra of real pixels have real columns 0 and Nx / 2; drop float64's rounding."""
    row_spectra[..., [0, -1]] = row_spectra[..., [0, -1]].real
    return row_spectra


def run_ratio_rows(b, i):
    spectra, objective, star_sums = reference.ratio_rows(
        i.model_spectra, i.images, i.weights, i.background, i.star_images, i.star_fluxes
    )
    images, exposure = i.images, b.put(np.zeros(1))
    if i.has_exposure_map:
        exposure = b.put_pixels(i.weights)
    elif i.weights is not None:
        images = np.where(i.weights, i.images, -1.0)
    background = b.put_pixels(i.background) if i.background.size > i.p else b.put(i.background)
    out = b.put_spectra(i.model_spectra)
    sums = b.put(np.full((b.program.row_blocks * i.p, 1 + i.n, 2), np.nan))
    rows = [b.layout.rows_of(first, i.star_blocks) for first in i.first_blocks]
    stars = [image[r] for images, r in zip(i.star_images, rows, strict=True) for image in images]
    b.launcher.rows(
        "ratio_rows",
        out,
        sums,
        b.put_pixels(images),
        background,
        exposure,
        b.put_pixels(stars),
        b.put(i.first_blocks, np.int32),
        np.int32(i.star_blocks),
        b.put(i.star_fluxes),
        blocks=b.program.row_blocks * i.p,
    )()
    yield b.take_spectra(out, i.p), real_edges(spectra)
    found = b.take(sums, (-1, 1 + i.n, 2)).astype(float).sum(axis=(0, 2))
    yield found, np.array([objective, *star_sums])


def run_scale_rows(b, i):
    scaled, spectrum, squares, fluxes = reference.scale_rows(
        i.correction_spectra,
        i.extended,
        i.inverse_weight,
        i.mu,
        i.star_fluxes,
        i.star_corrections,
        i.slope,
        i.curvature,
    )
    out, extended = b.put_spectra(i.correction_spectra), b.put_pixels(i.extended)
    sums, star_fluxes = b.put(np.zeros((b.program.row_blocks, 2))), b.put(i.star_fluxes)
    b.launcher.rows(
        "scale_rows",
        out,
        extended,
        sums,
        star_fluxes,
        put_inverse_weight(b, i),
        b.put(i.star_corrections),
        *put_smoothing(b, i),
        b.dtype.type(i.mu),
    )()
    yield b.take_pixels(extended), scaled
    yield b.take_spectra(out), spectrum
    yield b.take(star_fluxes, -1), fluxes
    if i.mu:
        yield b.take(sums, -1).astype(float).sum(), squares


def run_smooth(b, i):
    expected = reference.smooth(i.extended, i.smoothing, i.edge)
    slope, curvature = b.empty_pixels(), b.empty_pixels()
    sums = b.put(np.full((b.program.row_blocks, 2), np.nan))
    weights = b.dtype.type(i.smoothing), b.dtype.type(i.edge)
    extended = b.put_pixels(i.extended)
    b.launcher.blocks("smooth", slope, curvature, sums, extended, *weights)()
    yield b.take_pixels(slope), expected[0]
    yield b.take_pixels(curvature), expected[1]
    yield b.take(sums, -1).astype(float).sum(), expected[2]


def run_collect_sums(b, i):
    rng = np.random.default_rng(7)
    ratio_sums = rounded(rng.normal(size=(b.program.row_blocks * i.p, 1 + i.n, 2)) + 1, b.dtype)
    square_sums = rounded(rng.random((b.program.row_blocks, 2)), b.dtype)
    smooth_sums = rounded(rng.random((b.program.row_blocks, 2)), b.dtype)
    totals = ratio_sums.sum(axis=(0, 2))
    objective, corrections = reference.collect_sums(
        totals[0],
        square_sums.sum(),
        smooth_sums.sum() if i.smoothing else 0.0,
        totals[1:],
        i.star_weights,
        i.mu,
    )
    objectives = b.put(np.full((3, 2), -1.0))
    star_corrections = b.put(np.zeros(i.n))
    b.launcher.one_group(
        "collect_sums",
        objectives,
        star_corrections,
        b.put(ratio_sums),
        b.put(square_sums),
        b.put(smooth_sums),
        b.put(i.star_weights),
        b.dtype.type(i.mu),
        np.int32(1),
    )()
    found = b.take(objectives, (3, 2)).astype(float)
    yield found.sum(axis=1), np.array([-2.0, objective, -2.0])
    yield b.take(star_corrections, -1), corrections


def run_gradient_rows(b, i):
    *expected, change_step, change_change = reference.gradient_rows(
        i.correction_spectra,
        i.extended,
        i.previous,
        i.gradient,
        i.shift,
        i.inverse_weight,
        i.mu,
        i.slope,
        i.curvature,
    )
    gradient, previous = b.put_pixels(i.gradient), b.put_pixels(i.previous)
    scaling = b.empty_pixels()
    sums = b.put(np.full((b.program.row_blocks, 2, 2), np.nan))
    b.launcher.rows(
        "gradient_rows",
        b.put_spectra(i.correction_spectra),
        sums,
        gradient,
        previous,
        scaling,
        b.put_pixels(i.extended),
        b.put_pixels(i.shift),
        put_inverse_weight(b, i),
        *put_smoothing(b, i),
        b.dtype.type(i.mu),
    )()
    yield b.take_pixels(gradient), expected[0]
    yield b.take_pixels(scaling), expected[1]
    assert np.array_equal(b.take_pixels(previous), i.extended)
    found = b.take(sums, (-1, 2, 2)).astype(float).sum(axis=(0, 2))
    yield found, np.array([change_step, change_change])


def run_step_rows(b, i):
    alpha = float(np.float32(1.3))
    f, gradient, scaling = (a[0] for a in (i.extended, i.gradient, i.scaling))
    for share in (1.0, float(np.float32(0.4))):
        extended, spectrum, squares, slope, reached = reference.step_rows(
            f, gradient, scaling, i.reach, alpha, share
        )
        out, trial = b.empty_spectra(), b.empty_pixels()
        sums = b.put(np.full((b.program.row_blocks, 1 + i.n, 2), np.nan))
        square_sums = b.put(np.full((b.program.row_blocks, 2), np.nan))
        b.launcher.rows(
            "step_rows",
            out,
            trial,
            sums,
            square_sums,
            b.put_pixels(i.extended),
            b.put_pixels(i.gradient),
            b.put_pixels(i.scaling),
            b.put_pixels(i.reach) if i.n else b.put(np.zeros(1)),
            *(b.dtype.type(value) for value in (alpha, share)),
        )()
        yield b.take_pixels(trial), extended
        yield b.take_spectra(out), spectrum
        found = b.take(sums, (-1, 1 + i.n, 2)).astype(float).sum(axis=(0, 2))
        yield found, np.array([slope, *reached])
        if i.mu:
            yield b.take(square_sums, -1).astype(float).sum(), squares


def put_inverse_weight(b, i):
    return b.put_pixels(i.inverse_weight) if i.weights is not None else b.put(np.zeros(1))


def put_smoothing(b, i):
    if not i.smoothing:
        return b.put(np.zeros(1)), b.put(np.zeros(1))
    return b.put_pixels(i.slope), b.put_pixels(i.curvature)


RUN = {name: globals()[f"run_{name}"] for name in KERNELS}


@pytest.mark.parametrize(("case", "dtype"), RUNS)
def test_kernels_agree_with_their_twins(case, dtype):
    b = bench(case, dtype)
    i = inputs(b)
    for name in b.program.kernels:
        run = RUN[name]
        b.outputs.clear()
        for found, expected in run(b, i):
            largest = np.abs(expected).max(initial=0.0)
            worst = np.abs(found - expected).max(initial=0.0)
            assert worst <= TOLERANCE[dtype] * largest, (name, worst / largest)


def test_every_kernel_is_tested_and_has_a_twin():
    b = bench("radices 4, 4 and 8, 4", np.float32)
    assert set(b.program.kernels) == set(KERNELS)
    assert all(callable(getattr(reference, name)) for name in KERNELS)


def launch_ratio_rows(b, model, images, star_image):
    """Return the ratio's row spectra and the sums, for one image of a model that is exact."""
    background = b.put([1.0])
    spectra, sums = (
        b.put_spectra(np.fft.rfft(model - 1.0)[None] / b.grid[1]),
        b.put(np.zeros((b.program.row_blocks, 2, 2))),
    )
    b.launcher.rows(
        "ratio_rows",
        spectra,
        sums,
        b.put_pixels(images[None]),
        background,
        b.put(np.zeros(1)),
        b.put_pixels(star_image[None]),
        b.put([0], np.int32),
        np.int32(b.program.row_blocks),
        b.put([0.0]),
        blocks=b.program.row_blocks,
    )()
    return b.take_spectra(spectra)[0], b.take(sums, (-1, 2, 2)).astype(float)


def with_star(dtype):
    grid = (64, 128)
    program = Program(
        context(), grid, np.dtype(dtype), least_model=LEAST_MODEL, n_images=1, n_stars=1
    )
    return Bench(program)


@pytest.mark.parametrize("dtype", DTYPES.values())
def test_division_guard(dtype):
    """Where the model is not positive the ratio is 0, and J's term that of the least model."""
    b = with_star(dtype)
    images, model = np.ones(b.grid), np.ones(b.grid)
    # One pixel of the model is negative, all others are as the images.
    model[3, :] = 1.0 - 2.0 * (np.arange(b.grid[1]) == 7)
    dark, sums = launch_ratio_rows(b, model, images, np.zeros(b.grid))
    expected = np.zeros(b.grid)
    expected[3, 7] = -1.0
    assert np.abs(dark - reference.rfft_rows(expected)).max() < 1e3 * np.finfo(dtype).eps
    term = -np.log(LEAST_MODEL) - 1.0 + LEAST_MODEL
    eps = float(np.finfo(dtype).eps)
    assert sums[:, 0].sum() == pytest.approx(term, rel=4 * eps)
    images[3, 7] = 0.0
    _, sums = launch_ratio_rows(b, model, images, np.zeros(b.grid))
    assert abs(sums[:, 0].sum()) < LEAST_MODEL + 1e3 * eps**2 * images.size


def test_sums_over_pixels_are_compensated():
    """Sums of exact ratios in single precision are right to a double's digits, nearly."""
    b = with_star(np.float32)
    images = rounded(np.random.default_rng(11).uniform(0.5, 2.0, b.grid), np.float32)
    _, sums = launch_ratio_rows(b, np.ones(b.grid), images, np.ones(b.grid))
    expected = (images - 1.0).sum()
    assert sums[:, 1].sum() == pytest.approx(expected, rel=3e-9)
    assert sums[:, 1, 0].sum() != pytest.approx(expected, rel=3e-9)


def test_the_cases_take_both_kinds_of_scratch():
    assert bench("global scratch", np.float32).program.scratch_is_global
    assert not bench("radices 8, 8 and 4, 8, 4", np.float32).program.scratch_is_global


@pytest.mark.parametrize("dtype", DTYPES.values())
def test_adjoint_dot_product(dtype):
    """<A f, r> = <f, A^T r> for an asymmetric PSF whose peak is far from the origin."""
    b = bench("radices 4, 8, 8, 4, middle pass", dtype)
    rng = np.random.default_rng(3)
    f, r, psf = rng.random(b.grid), rng.random(b.grid), np.zeros(b.grid)
    psf[5:9, 20:31] = rng.random((4, 11))
    spectra = b.empty_spectra()
    pixels = b.put_pixels(psf[None])
    otf = b.put(np.zeros((1, *b.grid))), b.put(np.zeros((1, b.grid[0], 2)))
    b.launcher.rows("rfft_rows", spectra, pixels)()
    b.launcher.columns("otf_columns", *otf, spectra, np.int32(0))()

    def apply(name, image):
        b.launcher.rows("rfft_rows", spectra, b.put_pixels(image[None]))()
        b.launcher.columns(name, spectra, *otf)()
        # irfft_rows wants half of what rfft_rows gives; the OTF has taken care of that.
        b.launcher.rows("irfft_rows", pixels, spectra)()
        return b.take_pixels(pixels)[0]

    forward = (apply("convolve_columns", f) * r).sum()
    backward = (f * apply("correlate_columns", r)).sum()
    assert forward == pytest.approx(backward, rel={np.float32: 1e-7, np.float64: 3e-16}[dtype] * 4)
