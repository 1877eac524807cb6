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
from lnocl.verify.harness import Rig, rounded

# What a kernel made, and what its twin made of the same.
Pairs = Iterator[tuple[NDArray, NDArray]]

# Worst element over largest: three times what was measured over all cases of the tests on PoCL,
# 3.3e-7 and 1.2e-15.
ALLOWED = {np.float32: 1e-6, np.float64: 3.7e-15}


def kernels_of(scene: Mapping[str, Any]) -> list[str]:
    """Return the kernels that a program for a scene has, one of `lnocl.verify.harness.SCENES`."""
    return [name for name in KERNELS if name != "smooth" or scene.get("has_smoothing")]


def deviation(rig: Rig, given: SimpleNamespace, kernel: str) -> float:
    """Return how far a kernel is from its twin.

    Parameters
    ----------
    rig : Rig
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
    rig.forget()
    # NaN is the worst of all, which NumPy's max heeds and Python's does not.
    return float(np.max([relative(*pair) for pair in KERNELS[kernel](rig, given)]))


def relative(found: ArrayLike, expected: ArrayLike) -> float:
    """Return the worst deviation as a share of the largest expected value."""
    largest = np.abs(expected).max(initial=0.0)
    worst = np.abs(np.subtract(found, expected)).max(initial=0.0)
    if worst == 0:
        return 0.0
    return float(worst / largest) if largest else np.inf


def _run_rfft_rows(rig: Rig, given: SimpleNamespace) -> Pairs:
    out = rig.empty_spectra()
    rig.launcher.rows("rfft_rows", out, rig.put_pixels(given.pixels))()
    yield rig.take_spectra(out), reference.rfft_rows(given.pixels)


def _run_irfft_rows(rig: Rig, given: SimpleNamespace) -> Pairs:
    out = rig.empty_pixels()
    rig.launcher.rows("irfft_rows", out, rig.put_spectra(given.spectrum))()
    yield rig.take_pixels(out), reference.irfft_rows(given.spectrum)


def _run_fft_columns(rig: Rig, given: SimpleNamespace) -> Pairs:
    out = rig.put(rig.layout.pack_columns(given.columns))
    rig.launcher.columns("fft_columns", out)()
    found = rig.layout.unpack_columns(rig.take(out, rig.layout.spectra_shape))
    yield found, reference.fft_columns(given.columns)[bit_reversed(rig.grid[0])]


def _run_ifft_columns(rig: Rig, given: SimpleNamespace) -> Pairs:
    out = rig.put(rig.layout.pack_columns(given.columns[bit_reversed(rig.grid[0])]))
    rig.launcher.columns("ifft_columns", out)()
    found = rig.layout.unpack_columns(rig.take(out, rig.layout.spectra_shape))
    yield found, reference.ifft_columns(given.columns)


def _run_otf_columns(rig: Rig, given: SimpleNamespace) -> Pairs:
    packed, edge = rig.otf_parts(reference.otf_columns(given.spectrum[0]))
    packed, edge = np.stack([packed] * given.p), np.stack([edge] * given.p)
    packed[:-1], edge[:-1] = 2.0, 2.0  # the other images' parts stay as they are
    out, out_edge = rig.put(np.full(packed.shape, 2.0)), rig.put(np.full(edge.shape, 2.0))
    rig.launcher.columns(
        "otf_columns", out, out_edge, rig.put_spectra(given.spectrum), np.int32(given.p - 1)
    )()
    yield rig.take(out, packed.shape)[-1], packed[-1]
    yield rig.take(out, packed.shape)[:-1], packed[:-1]
    yield rig.take(out_edge, edge.shape), edge


def _put_otfs(rig: Rig, given: SimpleNamespace) -> tuple[cl.Buffer, cl.Buffer]:
    parts = [rig.otf_parts(otf) for otf in given.otfs]
    return rig.put([columns for columns, _ in parts]), rig.put([edge for _, edge in parts])


def _run_convolve_columns(rig: Rig, given: SimpleNamespace) -> Pairs:
    others = np.full((given.p - 1, *given.spectrum.shape[1:]), np.nan)
    out = rig.put_spectra([*given.spectrum, *others])
    rig.launcher.columns("convolve_columns", out, *_put_otfs(rig, given))()
    expected = _real_edges(reference.convolve_columns(given.spectrum[0], given.otfs))
    yield rig.take_spectra(out, given.p), expected


def _run_correlate_columns(rig: Rig, given: SimpleNamespace) -> Pairs:
    out = rig.put_spectra(given.spectra)
    rig.launcher.columns("correlate_columns", out, *_put_otfs(rig, given))()
    found = rig.take_spectra(out, given.p)
    yield found[0], _real_edges(reference.correlate_columns(given.spectra, given.otfs))
    if not np.array_equal(found[1:], _real_edges(given.spectra[1:])):
        raise DeviceError("others than array 0 are written")


def _real_edges(row_spectra: NDArray) -> NDArray:
    """Row spectra of real pixels have real columns 0 and Nx / 2; drop float64's rounding."""
    row_spectra[..., [0, -1]] = row_spectra[..., [0, -1]].real
    return row_spectra


def _run_ratio_rows(rig: Rig, given: SimpleNamespace) -> Pairs:
    spectra, objective, star_sums = reference.ratio_rows(
        given.model_spectra,
        given.images,
        given.weights,
        given.background,
        given.star_images,
        given.star_fluxes,
    )
    images, exposure = given.images, rig.put(np.zeros(1))
    if given.has_exposure_map:
        exposure = rig.put_pixels(given.weights)
    elif given.weights is not None:
        images = np.where(given.weights, given.images, -1.0)
    put = rig.put_pixels if given.background.size > given.p else rig.put
    out = rig.put_spectra(given.model_spectra)
    sums = rig.empty_sums(1 + given.n, given.p)
    stars = (
        image[rig.layout.rows_of(first, given.star_blocks)]
        for star_images, first in zip(given.star_images, given.first_blocks, strict=True)
        for image in star_images
    )
    rig.launcher.rows(
        "ratio_rows",
        out,
        sums,
        rig.put_pixels(images),
        put(given.background),
        exposure,
        rig.put_pixels(stars),
        rig.put(given.first_blocks, np.int32),
        np.int32(given.star_blocks),
        rig.put(given.star_fluxes),
        blocks=rig.program.row_blocks * given.p,
    )()
    yield rig.take_spectra(out, given.p), _real_edges(spectra)
    yield rig.take_sums(sums, 1 + given.n), np.array([objective, *star_sums])


def _run_scale_rows(rig: Rig, given: SimpleNamespace) -> Pairs:
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
    out, extended = rig.put_spectra(given.correction_spectra), rig.put_pixels(given.extended)
    sums, star_fluxes = rig.empty_sums(1), rig.put(given.star_fluxes)
    rig.launcher.rows(
        "scale_rows",
        out,
        extended,
        sums,
        star_fluxes,
        _put_inverse_weight(rig, given),
        rig.put(given.star_corrections),
        *_put_smoothing(rig, given),
        rig.dtype.type(given.mu),
    )()
    yield rig.take_pixels(extended), scaled
    yield rig.take_spectra(out), spectrum
    yield rig.take(star_fluxes, -1), fluxes
    if given.mu:
        yield rig.take_sums(sums, 1), np.array([squares])


def _run_smooth(rig: Rig, given: SimpleNamespace) -> Pairs:
    slope, curvature, value = reference.smooth(given.extended, given.smoothing, given.edge)
    outs, sums = (rig.empty_pixels(), rig.empty_pixels()), rig.empty_sums(1)
    weights = rig.dtype.type(given.smoothing), rig.dtype.type(given.edge)
    rig.launcher.blocks("smooth", *outs, sums, rig.put_pixels(given.extended), *weights)()
    yield rig.take_pixels(outs[0]), slope
    yield rig.take_pixels(outs[1]), curvature
    yield rig.take_sums(sums, 1), np.array([value])


def _run_collect_sums(rig: Rig, given: SimpleNamespace) -> Pairs:
    rng = np.random.default_rng(7)
    blocks = rig.program.row_blocks
    ratio_sums = rounded(rng.normal(size=(blocks * given.p, 1 + given.n, 2)) + 1, rig.dtype)
    ratio_sums[:, 2:] *= -1.0  # the correction of a second star counts as 0
    square_sums = rounded(rng.random((blocks, 2)), rig.dtype)
    smooth_sums = rounded(rng.random((blocks, 2)), rig.dtype)
    totals = ratio_sums.sum(axis=(0, 2))
    objective, corrections = reference.collect_sums(
        totals[0],
        square_sums.sum(),
        smooth_sums.sum() if given.smoothing else 0.0,
        totals[1:],
        given.star_weights,
        given.mu,
    )
    objectives = rig.put(np.full((3, 2), -1.0))
    star_corrections = rig.put(np.zeros(given.n))
    rig.launcher.one_group(
        "collect_sums",
        objectives,
        star_corrections,
        rig.put(ratio_sums),
        rig.put(square_sums),
        rig.put(smooth_sums),
        rig.put(given.star_weights),
        rig.dtype.type(given.mu),
        np.int32(1),
    )()
    found = rig.take(objectives, (3, 2)).astype(float)
    yield found.sum(axis=1), np.array([-2.0, objective, -2.0])
    yield rig.take(star_corrections, -1), corrections


def _run_gradient_rows(rig: Rig, given: SimpleNamespace) -> Pairs:
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
    gradient, sums = rig.put_pixels(given.gradient), rig.empty_sums(2)
    rig.launcher.rows(
        "gradient_rows",
        rig.put_spectra(given.correction_spectra),
        sums,
        gradient,
        rig.put_pixels(given.extended),
        rig.put_pixels(given.previous),
        rig.put_pixels(given.shift),
        _put_inverse_weight(rig, given),
        *_put_smoothing(rig, given),
        rig.dtype.type(given.mu),
    )()
    yield rig.take_pixels(gradient), expected
    yield rig.take_sums(sums, 2), np.array([change_step, change_change])


def _run_step_rows(rig: Rig, given: SimpleNamespace) -> Pairs:
    alpha = float(np.float32(1.3))
    for share in (1.0, float(np.float32(0.4))):
        extended, spectrum, squares, slope, reached = reference.step_rows(
            given.extended,
            given.gradient,
            given.shift,
            given.inverse_weight,
            given.reach,
            given.mu,
            alpha,
            share,
            given.curvature,
        )
        out, trial = rig.empty_spectra(), rig.empty_pixels()
        sums, square_sums = rig.empty_sums(1 + given.n), rig.empty_sums(1)
        rig.launcher.rows(
            "step_rows",
            out,
            trial,
            sums,
            square_sums,
            rig.put_pixels(given.extended),
            rig.put_pixels(given.gradient),
            rig.put_pixels(given.shift),
            _put_inverse_weight(rig, given),
            _put_smoothing(rig, given)[1],
            rig.put_pixels(given.reach) if given.n else rig.put(np.zeros(1)),
            *(rig.dtype.type(value) for value in (given.mu, alpha, share)),
        )()
        yield rig.take_pixels(trial), extended
        yield rig.take_spectra(out), spectrum
        yield rig.take_sums(sums, 1 + given.n), np.array([slope, *reached])
        if given.mu:
            yield rig.take_sums(square_sums, 1), np.array([squares])


def _put_inverse_weight(rig: Rig, given: SimpleNamespace) -> cl.Buffer:
    if given.weights is None:
        return rig.put(np.zeros(1))
    return rig.put_pixels(given.inverse_weight)


def _put_smoothing(rig: Rig, given: SimpleNamespace) -> tuple[cl.Buffer, cl.Buffer]:
    if not given.smoothing:
        return rig.put(np.zeros(1)), rig.put(np.zeros(1))
    return rig.put_pixels(given.slope), rig.put_pixels(given.curvature)


KERNELS: dict[str, Callable[[Rig, SimpleNamespace], Pairs]] = {
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
