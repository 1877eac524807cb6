"""Every kernel against its twin in `lnocl.reference`, with a canary behind every output."""

import functools

import numpy as np
import pyopencl as cl
import pytest

from lnocl import reference
from lnocl.errors import DeviceError
from lnocl.opencl.device import choose
from lnocl.opencl.program import Tuning
from lnocl.scene.scene import LEAST_MODEL
from lnocl.verify.comparison import ALLOWED, KERNELS, deviation, kernels_of
from lnocl.verify.harness import SCENES, THREE_IMAGES, KernelHarness, inputs, rounded

# Name: (grid, tuning, scene, precisions), a capital letter for one that only CI tests. Each grid
# is the smallest that takes some path of kernels/fft.cl; tunings other than the default share a
# block among work-items, as a GPU does.
# (PoCL 3 miscompiles vectors of 2 in groups of several work-items; no tuning has them.)
CASES = {
    "outer radix 2": ((2, 2), None, "plain", "sd"),
    "outer radix 4": ((4, 4), None, "plain", "S"),
    "outer radix 8": ((8, 8), None, "mask, mu, smoothing", "s"),
    "radices 4, 4 and 8, 4": ((16, 32), None, THREE_IMAGES, "sD"),
    "radices 8, 8 and 4, 8, 4": ((64, 128), None, "two images, star, mu", "Sd"),
    "radices 8, 8, 4": ((256, 16), None, "plain", "S"),
    "exposure map": ((32, 16), None, "exposure map, mu", "sD"),
    "exposure map, group": ((32, 16), Tuning(1, 8, group=4), "exposure map, mu", "S"),
    "radices 8, 8, 8": ((8, 512), None, "plain", "S"),
    "radices 4, 8, 8, 4, middle pass": ((32, 1024), None, "plain", "SD"),
    "middle pass along y": ((2048, 4), None, "plain", "d"),
    "global scratch": ((8192, 64), Tuning(4, 16), "plain", "s"),
    "several vectors a block": ((64, 32), Tuning(4, 8), "mask, mu, smoothing", "S"),
    "group": ((64, 32), Tuning(1, 8, group=4), THREE_IMAGES, "sD"),
    "group, middle pass": ((2048, 16), Tuning(1, 2, group=64), "plain", "D"),
    "group, global scratch": ((4096, 64), Tuning(4, 32, group=8), "mask, mu, smoothing", "S"),
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


@functools.cache
def context():
    return cl.Context([choose().device])


@functools.cache
def rig_of(case, dtype):
    grid, tuning, scene, _ = CASES[case]
    return KernelHarness(context(), grid, dtype, tuning, **SCENES[scene])


@pytest.mark.parametrize("dtype", DTYPES.values())
def test_inputs_of_out_of_place_transforms_stay_as_they_are(dtype):
    harness = rig_of("radices 8, 8 and 4, 8, 4", dtype)
    given = inputs(harness)
    for name, out, packed in (
        ("rfft_rows", harness.empty_spectra(), harness.layout.pack_pixels(given.pixels)),
        ("irfft_rows", harness.empty_pixels(), harness.layout.pack_spectra(given.spectrum[0])),
    ):
        buffer = harness.put(packed)
        harness.launcher.rows(name, out, buffer)()
        assert np.array_equal(harness.take(buffer, packed.shape), packed), name


def test_what_lies_behind_every_array_is_watched():
    harness = rig_of("outer radix 2", np.float32)
    harness.forget()
    written, other = harness.put(np.zeros(4)), harness.put(np.zeros(4))
    assert not harness.take(other, 4).any()
    cl.enqueue_copy(harness.launcher.queue, written, np.ones(1, np.uint8), dst_offset=16)
    with pytest.raises(DeviceError, match="written past the end of an array"):
        harness.take(other, 4)
    harness.forget()
    assert not harness.take(other, 4).any()


@pytest.mark.parametrize(("case", "dtype"), RUNS)
def test_kernels_agree_with_their_twins(case, dtype):
    harness = rig_of(case, dtype)
    given = inputs(harness)
    assert set(harness.program.kernels) == set(kernels_of(harness.scene))
    for kernel in harness.program.kernels:
        assert deviation(harness, given, kernel) <= ALLOWED[dtype], kernel


def test_every_kernel_is_tested_and_has_a_twin():
    harness = rig_of("radices 4, 4 and 8, 4", np.float32)
    assert set(harness.program.kernels) == set(KERNELS)
    assert all(callable(getattr(reference, name)) for name in KERNELS)


def launch_ratio_rows(harness, model, images, star_image):
    """Return the ratio's row spectra and the sums, for one image of a model that is exact."""
    background = harness.put([1.0])
    spectra, sums = (
        harness.put_spectra(np.fft.rfft(model - 1.0)[None] / harness.grid[1]),
        harness.put(np.zeros((harness.program.row_blocks, 2, 2))),
    )
    harness.launcher.rows(
        "ratio_rows",
        spectra,
        sums,
        harness.put_pixels(images[None]),
        background,
        harness.put(np.zeros(1)),
        harness.put_pixels(star_image[None]),
        harness.put([0], np.int32),
        np.int32(harness.program.row_blocks),
        harness.put([0.0]),
        blocks=harness.program.row_blocks,
    )()
    return harness.take_spectra(spectra)[0], harness.take(sums, (-1, 2, 2)).astype(float)


def with_star(dtype):
    return KernelHarness(context(), (64, 128), dtype, n_stars=1)


@pytest.mark.parametrize("dtype", DTYPES.values())
def test_division_guard(dtype):
    """Where the model is not positive the ratio is 0, and J's term that of the least model."""
    harness = with_star(dtype)
    images, model = np.ones(harness.grid), np.ones(harness.grid)
    # One pixel of the model is negative, all others are as the images.
    model[3, :] = 1.0 - 2.0 * (np.arange(harness.grid[1]) == 7)
    dark, sums = launch_ratio_rows(harness, model, images, np.zeros(harness.grid))
    expected = np.zeros(harness.grid)
    expected[3, 7] = -1.0
    assert np.abs(dark - reference.rfft_rows(expected)).max() < 1e3 * np.finfo(dtype).eps
    term = -np.log(LEAST_MODEL) - 1.0 + LEAST_MODEL
    eps = float(np.finfo(dtype).eps)
    assert sums[:, 0].sum() == pytest.approx(term, rel=4 * eps)
    images[3, 7] = 0.0
    _, sums = launch_ratio_rows(harness, model, images, np.zeros(harness.grid))
    assert abs(sums[:, 0].sum()) < LEAST_MODEL + 1e3 * eps**2 * images.size


def test_sums_over_pixels_are_compensated():
    """Sums of exact ratios in single precision are right to a double's digits, nearly."""
    harness = with_star(np.float32)
    images = rounded(np.random.default_rng(11).uniform(0.5, 2.0, harness.grid), np.float32)
    _, sums = launch_ratio_rows(harness, np.ones(harness.grid), images, np.ones(harness.grid))
    expected = (images - 1.0).sum()
    assert sums[:, 1].sum() == pytest.approx(expected, rel=3e-9)
    assert sums[:, 1, 0].sum() != pytest.approx(expected, rel=3e-9)


def test_the_cases_take_both_kinds_of_scratch():
    assert rig_of("global scratch", np.float32).program.scratch_is_global
    assert not rig_of("radices 8, 8 and 4, 8, 4", np.float32).program.scratch_is_global


@pytest.mark.parametrize("dtype", DTYPES.values())
def test_adjoint_dot_product(dtype):
    """<A f, r> = <f, A^T r> for an asymmetric PSF whose peak is far from the origin."""
    harness = rig_of("radices 4, 8, 8, 4, middle pass", dtype)
    rng = np.random.default_rng(3)
    f, r, psf = rng.random(harness.grid), rng.random(harness.grid), np.zeros(harness.grid)
    psf[5:9, 20:31] = rng.random((4, 11))
    spectra = harness.empty_spectra()
    pixels = harness.put_pixels(psf[None])
    otf = harness.put(np.zeros((1, *harness.grid))), harness.put(np.zeros((1, harness.grid[0], 2)))
    harness.launcher.rows("rfft_rows", spectra, pixels)()
    harness.launcher.columns("otf_columns", *otf, spectra, np.int32(0))()

    def apply(name, image):
        harness.launcher.rows("rfft_rows", spectra, harness.put_pixels(image[None]))()
        harness.launcher.columns(name, spectra, *otf)()
        # irfft_rows wants half of what rfft_rows gives; the OTF has taken care of that.
        harness.launcher.rows("irfft_rows", pixels, spectra)()
        return harness.take_pixels(pixels)[0]

    forward = (apply("convolve_columns", f) * r).sum()
    backward = (f * apply("correlate_columns", r)).sum()
    assert forward == pytest.approx(backward, rel={np.float32: 1e-7, np.float64: 3e-16}[dtype] * 4)
