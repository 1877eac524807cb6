"""Every kernel against its twin in `lnocl.reference`, on random arrays, on any device."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import ArrayLike, NDArray

from lnocl import reference
from lnocl.errors import DeviceError
from lnocl.opencl.fft import bit_reversed
from lnocl.verify.harness import KernelHarness, rounded

# What a kernel made, and what its twin made of the same.
Pairs = Iterator[tuple[NDArray, NDArray]]

# Worst element over largest: three times what was measured over all cases of the tests on PoCL,
# 3.3e-7 and 1.2e-15.
ALLOWED = {np.float32: 1e-6, np.float64: 3.7e-15}


def kernels_of(scene: Mapping[str, Any]) -> list[str]:
    """Return the kernels that a program for a scene has, one of `lnocl.verify.harness.SCENES`."""
    return [name for name in KERNELS if name != "smooth" or scene.get("has_smoothing")]


def deviation(harness: KernelHarness, given: SimpleNamespace, kernel: str) -> float:
    """Return how far a kernel is from its twin.

    Parameters
    ----------
    harness : KernelHarness
        With the kernels and the device.
    given : SimpleNamespace
        What `lnocl.verify.harness.inputs` returned for it.
    kernel : str
        One of `KERNELS`.

    Returns
    -------
    float
        Worst element of an output over the output's largest, of the worst output.

    Raises
    ------
    DeviceError
        Where the kernel writes what it must leave alone.
    """
    harness.forget()
    # NaN is the worst of all, which NumPy's max heeds and Python's does not.
    return float(np.max([relative(*pair) for pair in KERNELS[kernel](harness, given)]))


def relative(found: ArrayLike, expected: ArrayLike) -> float:
    """Return the worst deviation as a share of the largest expected value."""
    largest = np.abs(expected).max(initial=0.0)
    worst = np.abs(np.subtract(found, expected)).max(initial=0.0)
    if worst == 0:
        return 0.0
    return float(worst / largest) if largest else np.inf


def _run_rfft_rows(harness: KernelHarness, given: SimpleNamespace) -> Pairs:
    out = harness.empty_spectra()
    harness.launcher.rows("rfft_rows", out, harness.put_pixels(given.pixels))()
    yield harness.take_spectra(out), reference.rfft_rows(given.pixels)


def _run_irfft_rows(harness: KernelHarness, given: SimpleNamespace) -> Pairs:
    out = harness.empty_pixels()
    harness.launcher.rows("irfft_rows", out, harness.put_spectra(given.spectrum))()
    yield harness.take_pixels(out), reference.irfft_rows(given.spectrum)


def _run_fft_columns(harness: KernelHarness, given: SimpleNamespace) -> Pairs:
    out = harness.put(harness.layout.pack_columns(given.columns))
    harness.launcher.columns("fft_columns", out)()
    found = harness.layout.unpack_columns(harness.take(out, harness.layout.spectra_shape))
    yield found, reference.fft_columns(given.columns)[bit_reversed(harness.grid[0])]


def _run_ifft_columns(harness: KernelHarness, given: SimpleNamespace) -> Pairs:
    out = harness.put(harness.layout.pack_columns(given.columns[bit_reversed(harness.grid[0])]))
    harness.launcher.columns("ifft_columns", out)()
    found = harness.layout.unpack_columns(harness.take(out, harness.layout.spectra_shape))
    yield found, reference.ifft_columns(given.columns)


def _run_otf_columns(harness: KernelHarness, given: SimpleNamespace) -> Pairs:
    packed, edge = harness.otf_parts(reference.otf_columns(given.spectrum[0]))
    packed, edge = np.stack([packed] * given.p), np.stack([edge] * given.p)
    packed[:-1], edge[:-1] = 2.0, 2.0  # the other images' parts stay as they are
    out, out_edge = harness.put(np.full(packed.shape, 2.0)), harness.put(np.full(edge.shape, 2.0))
    harness.launcher.columns(
        "otf_columns", out, out_edge, harness.put_spectra(given.spectrum), np.int32(given.p - 1)
    )()
    yield harness.take(out, packed.shape)[-1], packed[-1]
    yield harness.take(out, packed.shape)[:-1], packed[:-1]
    yield harness.take(out_edge, edge.shape), edge


def _put_otfs(harness: KernelHarness, given: SimpleNamespace) -> tuple[cl.Buffer, cl.Buffer]:
    parts = [harness.otf_parts(otf) for otf in given.otfs]
    return harness.put([columns for columns, _ in parts]), harness.put([edge for _, edge in parts])


def _run_convolve_columns(harness: KernelHarness, given: SimpleNamespace) -> Pairs:
    others = np.full((given.p - 1, *given.spectrum.shape[1:]), np.nan)
    out = harness.put_spectra([*given.spectrum, *others])
    harness.launcher.columns("convolve_columns", out, *_put_otfs(harness, given))()
    expected = _real_edges(reference.convolve_columns(given.spectrum[0], given.otfs))
    yield harness.take_spectra(out, given.p), expected


def _run_correlate_columns(harness: KernelHarness, given: SimpleNamespace) -> Pairs:
    out = harness.put_spectra(given.spectra)
    harness.launcher.columns("correlate_columns", out, *_put_otfs(harness, given))()
    found = harness.take_spectra(out, given.p)
    yield found[0], _real_edges(reference.correlate_columns(given.spectra, given.otfs))
    if not np.array_equal(found[1:], _real_edges(given.spectra[1:])):
        raise DeviceError("others than array 0 are written")


def _real_edges(row_spectra: NDArray) -> NDArray:
    """Row spectra of real pixels have real columns 0 and Nx / 2; drop float64's rounding."""
    row_spectra[..., [0, -1]] = row_spectra[..., [0, -1]].real
    return row_spectra


def _run_ratio_rows(harness: KernelHarness, given: SimpleNamespace) -> Pairs:
    spectra, objective, star_sums = reference.ratio_rows(
        given.model_spectra,
        given.images,
        given.weights,
        given.background,
        given.star_images,
        given.star_fluxes,
    )
    images, exposure = given.images, harness.put(np.zeros(1))
    if given.has_exposure_map:
        exposure = harness.put_pixels(given.weights)
    elif given.weights is not None:
        images = np.where(given.weights, given.images, -1.0)
    put = harness.put_pixels if given.background.size > given.p else harness.put
    out = harness.put_spectra(given.model_spectra)
    sums = harness.empty_sums(1 + given.n, given.p)
    stars = (
        image[harness.layout.rows_of(first, given.star_blocks)]
        for star_images, first in zip(given.star_images, given.first_blocks, strict=True)
        for image in star_images
    )
    harness.launcher.rows(
        "ratio_rows",
        out,
        sums,
        harness.put_pixels(images),
        put(given.background),
        exposure,
        harness.put_pixels(stars),
        harness.put(given.first_blocks, np.int32),
        np.int32(given.star_blocks),
        harness.put(given.star_fluxes),
        blocks=harness.program.row_blocks * given.p,
    )()
    yield harness.take_spectra(out, given.p), _real_edges(spectra)
    yield harness.take_sums(sums, 1 + given.n), np.array([objective, *star_sums])


def _run_scale_rows(harness: KernelHarness, given: SimpleNamespace) -> Pairs:
    scaled, spectrum, squares, fluxes = reference.scale_rows(
        given.correction_spectra,
        given.extended,
        given.inverse_weight,
        given.mu,
        given.star_fluxes,
        given.star_corrections,
        given.slope,
        given.curvature,
    )
    out, extended = (
        harness.put_spectra(given.correction_spectra),
        harness.put_pixels(given.extended),
    )
    sums, star_fluxes = harness.empty_sums(1), harness.put(given.star_fluxes)
    harness.launcher.rows(
        "scale_rows",
        out,
        extended,
        sums,
        star_fluxes,
        _put_inverse_weight(harness, given),
        harness.put(given.star_corrections),
        *_put_smoothing(harness, given),
        harness.dtype.type(given.mu),
    )()
    yield harness.take_pixels(extended), scaled
    yield harness.take_spectra(out), spectrum
    yield harness.take(star_fluxes, -1), fluxes
    if given.mu:
        yield harness.take_sums(sums, 1), np.array([squares])


def _run_smooth(harness: KernelHarness, given: SimpleNamespace) -> Pairs:
    slope, curvature, value = reference.smooth(given.extended, given.smoothing, given.edge)
    outs, sums = (harness.empty_pixels(), harness.empty_pixels()), harness.empty_sums(1)
    weights = harness.dtype.type(given.smoothing), harness.dtype.type(given.edge)
    harness.launcher.blocks("smooth", *outs, sums, harness.put_pixels(given.extended), *weights)()
    yield harness.take_pixels(outs[0]), slope
    yield harness.take_pixels(outs[1]), curvature
    yield harness.take_sums(sums, 1), np.array([value])


def _run_collect_sums(harness: KernelHarness, given: SimpleNamespace) -> Pairs:
    rng = np.random.default_rng(7)
    blocks = harness.program.row_blocks
    ratio_sums = rounded(rng.normal(size=(blocks * given.p, 1 + given.n, 2)) + 1, harness.dtype)
    ratio_sums[:, 2:] *= -1.0  # the correction of a second star counts as 0
    square_sums = rounded(rng.random((blocks, 2)), harness.dtype)
    smooth_sums = rounded(rng.random((blocks, 2)), harness.dtype)
    totals = ratio_sums.sum(axis=(0, 2))
    objective, corrections = reference.collect_sums(
        totals[0],
        square_sums.sum(),
        smooth_sums.sum() if given.smoothing else 0.0,
        totals[1:],
        given.star_weights,
        given.mu,
    )
    objectives = harness.put(np.full((3, 2), -1.0))
    star_corrections = harness.put(np.zeros(given.n))
    harness.launcher.one_group(
        "collect_sums",
        objectives,
        star_corrections,
        harness.put(ratio_sums),
        harness.put(square_sums),
        harness.put(smooth_sums),
        harness.put(given.star_weights),
        harness.dtype.type(given.mu),
        np.int32(1),
    )()
    found = harness.take(objectives, (3, 2)).astype(float)
    yield found.sum(axis=1), np.array([-2.0, objective, -2.0])
    yield harness.take(star_corrections, -1), corrections


def _run_gradient_rows(harness: KernelHarness, given: SimpleNamespace) -> Pairs:
    expected, change_step, change_change = reference.gradient_rows(
        given.correction_spectra,
        given.extended,
        given.previous,
        given.gradient,
        given.shift,
        given.inverse_weight,
        given.mu,
        given.slope,
        given.curvature,
    )
    gradient, sums = harness.put_pixels(given.gradient), harness.empty_sums(2)
    harness.launcher.rows(
        "gradient_rows",
        harness.put_spectra(given.correction_spectra),
        sums,
        gradient,
        harness.put_pixels(given.extended),
        harness.put_pixels(given.previous),
        harness.put_pixels(given.shift),
        _put_inverse_weight(harness, given),
        *_put_smoothing(harness, given),
        harness.dtype.type(given.mu),
    )()
    yield harness.take_pixels(gradient), expected
    yield harness.take_sums(sums, 2), np.array([change_step, change_change])


def _run_step_rows(harness: KernelHarness, given: SimpleNamespace) -> Pairs:
    alpha = float(np.float32(1.3))
    for share in (1.0, float(np.float32(0.4))):
        extended, spectrum, squares, slope, coupling = reference.step_rows(
            given.extended,
            given.gradient,
            given.shift,
            given.inverse_weight,
            given.cross_information,
            given.mu,
            alpha,
            share,
            given.curvature,
        )
        out, trial = harness.empty_spectra(), harness.empty_pixels()
        sums, square_sums = harness.empty_sums(1 + given.n), harness.empty_sums(1)
        harness.launcher.rows(
            "step_rows",
            out,
            trial,
            sums,
            square_sums,
            harness.put_pixels(given.extended),
            harness.put_pixels(given.gradient),
            harness.put_pixels(given.shift),
            _put_inverse_weight(harness, given),
            _put_smoothing(harness, given)[1],
            harness.put_pixels(given.cross_information) if given.n else harness.put(np.zeros(1)),
            *(harness.dtype.type(value) for value in (given.mu, alpha, share)),
        )()
        yield harness.take_pixels(trial), extended
        yield harness.take_spectra(out), spectrum
        yield harness.take_sums(sums, 1 + given.n), np.array([slope, *coupling])
        if given.mu:
            yield harness.take_sums(square_sums, 1), np.array([squares])


def _put_inverse_weight(harness: KernelHarness, given: SimpleNamespace) -> cl.Buffer:
    if given.weights is None:
        return harness.put(np.zeros(1))
    return harness.put_pixels(given.inverse_weight)


def _put_smoothing(harness: KernelHarness, given: SimpleNamespace) -> tuple[cl.Buffer, cl.Buffer]:
    if not given.smoothing:
        return harness.put(np.zeros(1)), harness.put(np.zeros(1))
    return harness.put_pixels(given.slope), harness.put_pixels(given.curvature)


KERNELS: dict[str, Callable[[KernelHarness, SimpleNamespace], Pairs]] = {
    "rfft_rows": _run_rfft_rows,
    "irfft_rows": _run_irfft_rows,
    "fft_columns": _run_fft_columns,
    "ifft_columns": _run_ifft_columns,
    "otf_columns": _run_otf_columns,
    "convolve_columns": _run_convolve_columns,
    "correlate_columns": _run_correlate_columns,
    "ratio_rows": _run_ratio_rows,
    "smooth": _run_smooth,
    "scale_rows": _run_scale_rows,
    "collect_sums": _run_collect_sums,
    "gradient_rows": _run_gradient_rows,
    "step_rows": _run_step_rows,
}
