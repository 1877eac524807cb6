"""Every kernel against its twin in `lnocl.core.reference`, on random arrays, on any device."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterator, Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyopencl as cl
from kernel_harness import KernelHarness, Windows, rounded
from numpy.typing import ArrayLike, NDArray

from lnocl.core import reference
from lnocl.core.opencl.layout import reversed_order
from lnocl.core.opencl.shears import Shears
from lnocl.core.reference.decide import next_step
from lnocl.core.scene.steps import Steps
from lnocl.errors import DeviceError

# What a kernel made, and what its twin made of the same.
Pairs = Iterator[tuple[NDArray, NDArray]]

# Kernels of images that are turned.
SHEARED = "irfft_sheared", "ratio_sheared", "rfft_sheared", "unshear_columns", "sample_lines"

# Inputs that are numbers, by the names of the kernels' arguments.
NUMBERS = "mu", "spectral"

# Worst element over largest: three times what was measured over all cases of the tests on PoCL,
# 3.3e-7 and 1.2e-15. With divisions and roots as far off as OpenCL allows it is 5.8e-7 in single.
ALLOWED = {np.float32: 1e-6, np.float64: 3.7e-15}


def kernels_of(scene: Mapping[str, Any]) -> list[str]:
    """Return the kernels that a program for a scene has, one of `kernel_harness.SCENES`."""
    parts = {"smooth": "has_smoothing", **dict.fromkeys(SHEARED, "has_turns")}
    return [name for name in KERNELS if name not in parts or scene.get(parts[name])]


def deviation(harness: KernelHarness, given: SimpleNamespace, kernel: str) -> float:
    """Return how far a kernel is from its twin.

    Parameters
    ----------
    harness : KernelHarness
        With the kernels and the device.
    given : SimpleNamespace
        What `kernel_harness.inputs` returned for it.
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


def _twin(function: Callable[..., Any], given: SimpleNamespace, **special: Any) -> Any:
    """Return what a twin makes of the inputs with its parameters' names, but for special ones."""
    names = inspect.signature(function).parameters.keys() - special
    return function(**{name: getattr(given, name) for name in names}, **special)


def _launch(
    harness: KernelHarness, given: SimpleNamespace, kernel: str, **special: Any
) -> dict[str, Any]:
    """Launch a kernel on the inputs with its arguments' names, but for special ones; return all."""
    names = [name for name in harness.program.arguments[kernel] if name not in special]
    arguments = {name: _put(harness, name, getattr(given, name, None)) for name in names}
    arguments = {name: each for name, each in arguments.items() if each is not None} | special
    harness.launch(kernel, **arguments)
    return arguments


def _put(harness: KernelHarness, name: str, values: Any) -> cl.Buffer | float | None:
    """Return an input for a kernel: a number, pixels, their one value, or one a star or sky."""
    if name in NUMBERS:
        return float(values)
    if isinstance(values, float):
        return harness.put_points(values)
    if isinstance(values, np.ndarray):
        is_pixels = values.ndim > 2 and values.shape[1:] != (1, 1)
        return harness.put_pixels(values) if is_pixels else harness.put(values)
    return None  # the scene has none


def _put_windows(harness: KernelHarness, name: str, windows: Windows) -> dict[str, Any]:
    """Return where windows lie, by the names of the kernels' arguments."""
    return {
        f"{name}_corners": harness.put(windows.corners, np.int32),
        f"{name}_near": harness.put(windows.near, np.int32),
        f"{name}_blocks": windows.n_blocks,
        f"{name}_columns": windows.n_columns,
    }


def _run_rfft_rows(harness: KernelHarness, given: SimpleNamespace) -> Pairs:
    out = harness.empty_spectra()
    _launch(harness, given, "rfft_rows", spectra=out)
    yield harness.take_spectra(out, given.k), reference.rfft_rows(given.pixels)


def _run_irfft_rows(harness: KernelHarness, given: SimpleNamespace) -> Pairs:
    out = harness.empty_pixels()
    harness.launch("irfft_rows", pixels=out, spectra=harness.put_spectra(given.spectrum))
    yield harness.take_pixels(out), reference.irfft_rows(given.spectrum)


def _run_fft_columns(harness: KernelHarness, given: SimpleNamespace) -> Pairs:
    out = harness.put(harness.layout.pack_columns(given.columns))
    harness.launch("fft_columns", spectra=out)
    found = harness.layout.unpack_columns(harness.take(out, harness.layout.spectra_shape))
    yield found, reference.fft_columns(given.columns)[reversed_order(harness.grid[0])]


def _run_ifft_columns(harness: KernelHarness, given: SimpleNamespace) -> Pairs:
    order = reversed_order(harness.grid[0])
    out = harness.put(harness.layout.pack_columns(given.columns[order]))
    harness.launch("ifft_columns", spectra=out)
    found = harness.layout.unpack_columns(harness.take(out, harness.layout.spectra_shape))
    yield found, reference.ifft_columns(given.columns)


def _run_otf_columns(harness: KernelHarness, given: SimpleNamespace) -> Pairs:
    packed, edge = harness.otf_parts(reference.otf_columns(given.spectrum[0]))
    packed, edge = np.stack([packed] * given.p), np.stack([edge] * given.p)
    packed[:-1], edge[:-1] = 2.0, 2.0  # the other images' parts stay as they are
    otfs, edges = harness.put(np.full(packed.shape, 2.0)), harness.put(np.full(edge.shape, 2.0))
    harness.launch(
        "otf_columns",
        otfs=otfs,
        otf_edges=edges,
        spectra=harness.put_spectra(given.spectrum),
        image=given.p - 1,
    )
    yield harness.take(otfs, packed.shape)[-1], packed[-1]
    yield harness.take(otfs, packed.shape)[:-1], packed[:-1]
    yield harness.take(edges, edge.shape), edge


def _put_otfs(harness: KernelHarness, given: SimpleNamespace) -> dict[str, cl.Buffer]:
    parts = [harness.otf_parts(otf) for otf in given.otfs]
    phases = [harness.layout.pack_phases(each) for each in given.rotations]
    return {
        "otfs": harness.put([columns for columns, _ in parts]),
        "otf_edges": harness.put([edge for _, edge in parts]),
        "row_phases": harness.put(phases),
        "mixes": harness.put(given.mixes),
    }


def _mixes(given: SimpleNamespace) -> NDArray | None:
    """Return the weights of several skies."""
    return given.mixes if given.k > 1 else None


def _phases(given: SimpleNamespace) -> NDArray | None:
    """Return the phases of the rows of images that are turned."""
    phases = [rotation.row_phases() for rotation in given.rotations]
    return np.array(phases) if phases else None


def _run_convolve_columns(harness: KernelHarness, given: SimpleNamespace) -> Pairs:
    others = np.full((given.p - 1, *given.spectrum.shape[1:]), np.nan)
    out = harness.put_spectra([*given.spectrum, *others])
    harness.launch("convolve_columns", spectra=out, **_put_otfs(harness, given))
    oversample, phases = harness.program.oversample, _phases(given)
    skies = given.spectrum if given.k > 1 else given.spectrum[0]
    expected = reference.convolve_columns(skies, given.otfs, oversample, phases, _mixes(given))
    yield harness.take_image_spectra(out, given.p), _real_edges(expected)
    # Images that have skies of their own.
    skies = rounded(np.arange(1, given.p + 1)[:, None, None] * given.spectrum[:1], harness.dtype)
    out = harness.put_image_spectra(skies)
    harness.launch("convolve_columns", spectra=out, has_transmission=1, **_put_otfs(harness, given))
    expected = reference.convolve_columns(skies, given.otfs, oversample, phases)
    yield harness.take_image_spectra(out, given.p), _real_edges(expected)


def _run_correlate_columns(harness: KernelHarness, given: SimpleNamespace) -> Pairs:
    out, phases = harness.put_image_spectra(given.image_spectra), _phases(given)
    harness.launch("correlate_columns", spectra=out, **_put_otfs(harness, given))
    found = reference.correlate_columns(given.image_spectra, given.otfs, phases, _mixes(given))
    expected = _real_edges(found)
    yield harness.take_spectra(out, given.k).reshape(expected.shape), expected
    others = harness.take_image_spectra(out, given.p)[1:]
    if given.k == 1 and not np.array_equal(others, _real_edges(given.image_spectra[1:])):
        raise DeviceError("others than those of skies are written")
    out, first = harness.put_image_spectra(given.image_spectra), given.k - 1
    arguments = _put_otfs(harness, given)
    harness.launch("correlate_columns", spectra=out, has_transmission=1, **arguments)
    own = [
        reference.correlate_columns(
            given.image_spectra[j], given.otfs[j], None if phases is None else phases[j]
        )
        for j in (slice(k, k + 1) for k in range(given.p))
    ]
    yield harness.take_spectra(out, given.p, first), _real_edges(np.array(own))


def _run_transmit_rows(harness: KernelHarness, given: SimpleNamespace) -> Pairs:
    out = harness.put_image_spectra(np.full((given.p, *given.spectrum.shape[1:]), np.nan))
    _launch(harness, given, "transmit_rows", spectra=out)
    mixes, skies = _mixes(given), given.extended
    expected = reference.transmit_rows(skies, given.transmission, mixes)
    yield harness.take_spectra(out, given.p, given.k - 1), expected


def _run_gather_rows(harness: KernelHarness, given: SimpleNamespace) -> Pairs:
    row_spectra = reference.rfft_rows(given.transmission[::-1] * given.extended[0] - 0.3)
    row_spectra = rounded(row_spectra, harness.dtype)
    out, others = harness.put_image_spectra(row_spectra), (given.p - 1, given.k)
    before = harness.take_spectra(out, *others)
    _launch(harness, given, "gather_rows", spectra=out, transmitted=harness.empty_pixels())
    expected = reference.gather_rows(row_spectra, given.transmission, _mixes(given))
    yield harness.take_spectra(out, given.k).reshape(expected.shape), expected
    if not np.array_equal(harness.take_spectra(out, *others), before):
        raise DeviceError("others than those of skies are written")


def _real_edges(row_spectra: NDArray) -> NDArray:
    """Row spectra of real pixels have real columns 0 and Nx / 2; drop float64's rounding."""
    row_spectra[..., [0, -1]] = row_spectra[..., [0, -1]].real
    return row_spectra


def _run_ratio_rows(harness: KernelHarness, given: SimpleNamespace) -> Pairs:
    spectra, objective, star_sums = _twin(
        reference.ratio_rows, given, row_spectra=given.model_spectra
    )
    out, observed = harness.put_image_spectra(given.model_spectra), _put_observed(harness, given)
    harness.launch("ratio_rows", spectra=out, **observed)
    yield harness.take_image_spectra(out, given.p), _real_edges(spectra)
    yield harness.take_sums(observed["ratio_sums"], 1), np.array([objective])
    yield _take_star_sums(harness, given, observed["star_sums"]), star_sums


def _put_observed(harness: KernelHarness, given: SimpleNamespace) -> dict[str, Any]:
    """Return all that models are compared with, stars, and room for the sums."""
    images, exposure = given.images, harness.put_points(1.0)
    if given.has_exposure_map:
        exposure = harness.put_pixels(given.weights)
    elif given.weights is not None:
        images = np.where(given.weights, given.images, -1.0)
    put = harness.put_pixels if given.background.size > given.p else harness.put_points
    n_sums = given.p * given.star_windows.n_blocks
    return {
        "ratio_sums": harness.put(np.full((harness.program.image_row_blocks * given.p, 2), np.nan)),
        "star_sums": harness.put(np.full((given.n, n_sums, 2), np.nan)),
        "images": harness.put_pixels(images),
        "background": put(given.background),
        "star_images": harness.put_windows(given.star_images, given.star_windows),
        **_put_windows(harness, "star", given.star_windows),
        "star_fluxes": harness.put(given.star_fluxes),
        "exposure": exposure,
    }


def _two_launches(given: SimpleNamespace) -> list[tuple[int, int]]:
    """Return first and number of images of a launch for one, and of another for the rest."""
    return [(0, 1), (1, given.p - 1)]


def _run_irfft_sheared(harness: KernelHarness, given: SimpleNamespace) -> Pairs:
    expected = reference.irfft_sheared(given.image_spectra)
    spectra = harness.put_image_spectra(given.image_spectra)
    for first, count in _two_launches(given):
        out = harness.put(np.full(count * harness.program.columns_size, np.nan))
        array = first + given.k - 1
        harness.launch("irfft_sheared", columns=out, spectra=spectra, array=array, count=count)
        packed = np.array([harness.pack_columns(each) for each in expected[first : first + count]])
        yield harness.take(out, packed.shape), packed


def _put_columns(harness: KernelHarness, given: SimpleNamespace) -> dict[str, cl.Buffer]:
    return {
        "column_shifts": harness.put([each.column_wholes for each in given.shears], np.int32),
        "column_weights": harness.put([each.column_weights for each in given.shears]),
    }


def _taken_up(shears: Shears, image: NDArray) -> NDArray:
    """Return an image whose rows lie rotated as it is: the inverse of `Shears.lay`."""
    columns = (np.arange(image.shape[-1]) + shears.roll[:, None]) % image.shape[-1]
    return image[..., np.arange(len(columns))[:, None], columns]


def _run_ratio_sheared(harness: KernelHarness, given: SimpleNamespace) -> Pairs:
    # Those of the kernel lie with their rows rotated, so the twin has them turned back.
    lying = {"images": given.images, "weights": given.weights, "background": given.background}
    own = {
        name: np.array([_taken_up(s, each) for s, each in zip(given.shears, arrays, strict=True)])
        for name, arrays in {**lying, "stars": given.star_images.swapaxes(0, 1)}.items()
    }
    back, objective, star_sums = _twin(
        reference.ratio_sheared,
        given,
        column_shifts=np.array([each.column_shifts for each in given.rotations]),
        image_shifts=np.array([each.image_shifts for each in given.rotations]),
        star_images=own.pop("stars").swapaxes(0, 1),
        **own,
    )
    observed = _put_observed(harness, given) | _put_columns(harness, given)
    block = harness.program.tuning.block
    weights = harness.put([each.pack_image_weights(block) for each in given.shears])
    for first, count in _two_launches(given):
        out = harness.put(np.full(count * harness.program.columns_size, np.nan))
        some = slice(first, first + count)
        columns = harness.put([harness.pack_columns(each) for each in given.sheared[some]])
        arrays = {"ratio_columns": out, "columns": columns, "image_weights": weights}
        numbers = {"image": first, "count": count}
        numbers["image_blocks"] = harness.program.image_row_blocks
        harness.launch("ratio_sheared", **numbers, **arrays, **observed)
        packed = np.array([harness.pack_columns(each) for each in back[some]])
        yield harness.take(out, packed.shape), packed
    yield harness.take_sums(observed["ratio_sums"], 1), np.array([objective])
    yield _take_star_sums(harness, given, observed["star_sums"]), star_sums


def _run_rfft_sheared(harness: KernelHarness, given: SimpleNamespace) -> Pairs:
    shifts = np.array([each.column_shifts for each in given.rotations])
    expected = reference.rfft_sheared(given.sheared, shifts)
    out = harness.put_image_spectra(np.full(given.image_spectra.shape, np.nan))
    for first, count in _two_launches(given):
        sheared = given.sheared[first : first + count]
        columns = harness.put([harness.pack_columns(each) for each in sheared])
        arrays = {"spectra": out, "ratio_columns": columns, **_put_columns(harness, given)}
        numbers = {"image": first, "array": first + given.k - 1, "count": count}
        harness.launch("rfft_sheared", **numbers, **arrays)
    yield harness.take_image_spectra(out, given.p), _real_edges(expected)


def _run_unshear_columns(harness: KernelHarness, given: SimpleNamespace) -> Pairs:
    shifts = np.array([each.column_shifts for each in given.rotations])
    expected = reference.unshear_columns(given.sheared, shifts)
    arrays = _put_columns(harness, given)
    for j, pixels in enumerate(given.sheared):
        out = harness.put(np.full(harness.program.columns_size, np.nan))
        columns = harness.put(harness.pack_columns(pixels))
        harness.launch("unshear_columns", image=j, columns=out, ratio_columns=columns, **arrays)
        packed = harness.pack_columns(expected[j])
        yield harness.take(out, packed.shape), packed


def _run_sample_lines(harness: KernelHarness, given: SimpleNamespace) -> Pairs:
    shears, layout = given.shears[-1], harness.layout
    firsts, weights = shears.line_firsts, shears.line_weights
    tables = {"firsts": harness.put(firsts, np.int32), "weights": harness.put(weights)}
    (ny, nx), lanes = harness.grid, harness.program.tuning.lanes

    def run(given: cl.Buffer, shape: tuple[int, ...], lines: int, table: int, array: int) -> Any:
        parts, stride, *rest = shape
        numbers = {"parts": parts, "lines": lines, "stride": stride}
        numbers |= {"length": math.prod(rest) // lanes, "table": table, "array": array}
        out = harness.put(np.full(shape, np.nan))
        harness.launch("sample_lines", sampled=out, given=given, **numbers, **tables)
        return out

    last, spectra = given.p - 1, harness.put_spectra(given.image_spectra)
    for table in (0, ny + nx):
        own = firsts[table : table + ny], weights[table : table + ny]
        expected = reference.sample_lines(given.image_spectra[last], *own, 0)
        found = run(spectra, layout.spectra_shape, ny, table, last)
        yield harness.take_spectra(found)[0], _real_edges(expected)
        own = firsts[table + ny : table + ny + nx], weights[table + ny : table + ny + nx]
        packed = harness.pack_columns(reference.sample_lines(given.sheared[last], *own, 1))
        columns = harness.put(harness.pack_columns(given.sheared[last]))
        found = run(columns, layout.columns_shape, nx, table + ny, 0)
        yield harness.take(found, packed.shape), packed


def _take_star_sums(
    harness: KernelHarness, given: SimpleNamespace, sums: cl.Buffer, k: int = 1
) -> NDArray:
    """Return for each star, or of k skies each, the sum of what the blocks of its window left."""
    if not given.n:
        return np.zeros(0)
    of_all = harness.take(sums, (k, given.n, -1)).astype(float).sum(axis=2)
    return of_all if k > 1 else of_all[0]


def _run_scale_rows(harness: KernelHarness, given: SimpleNamespace) -> Pairs:
    scaled, spectrum, squares, fluxes = _twin(
        reference.scale_rows, given, row_spectrum=given.correction_spectra
    )
    out, sums = harness.put_spectra(given.correction_spectra), harness.empty_sums()
    there = _launch(harness, given, "scale_rows", spectra=out, square_sums=sums)
    yield harness.take_pixels(there["extended"]), scaled
    yield harness.take_spectra(out, given.k), spectrum
    yield harness.take(there["star_fluxes"], -1), fluxes
    if given.mu:
        yield harness.take_sums(sums, 1), np.array([squares])


def _run_smooth(harness: KernelHarness, given: SimpleNamespace) -> Pairs:
    weight = given.smoothing if given.smoothing_map is None else given.smoothing_map
    slope, curvature, value = _twin(reference.smooth, given, smoothing=weight)
    outs, sums = (harness.empty_pixels(), harness.empty_pixels()), harness.empty_sums()
    _launch(harness, given, "smooth", slope=outs[0], curvature=outs[1], smooth_sums=sums)
    yield harness.take_pixels(outs[0]), slope
    yield harness.take_pixels(outs[1]), curvature
    yield harness.take_sums(sums, 1), np.array([value])


def _run_collect_sums(harness: KernelHarness, given: SimpleNamespace) -> Pairs:
    rng = np.random.default_rng(7)
    blocks, ratio_blocks = given.k * harness.program.row_blocks, harness.program.image_row_blocks
    ratio_sums = rounded(rng.normal(size=(ratio_blocks * given.p, 2)) + 1, harness.dtype)
    star_blocks = given.star_windows.n_blocks
    star_sums = rng.normal(size=(given.n, given.p * star_blocks, 2)) + 1
    star_sums[1:] *= -1.0  # the correction of a second star counts as 0
    star_sums = rounded(star_sums, harness.dtype)
    square_sums = rounded(rng.random((blocks, 2)), harness.dtype)
    smooth_sums = rounded(rng.random((blocks, 2)), harness.dtype)
    sums = {
        "objective": ratio_sums.sum(),
        "squares": square_sums.sum(),
        "smoothness": smooth_sums.sum() if given.smoothing.any() else 0.0,
        "star_sums": star_sums.sum(axis=(1, 2)),
    }
    objective = sums["objective"] + 0.5 * given.mu * sums["squares"] + sums["smoothness"]
    put = {
        "ratio_sums": ratio_sums,
        "star_sums": star_sums,
        "square_sums": square_sums,
        "smooth_sums": smooth_sums,
    }
    for steps, before in _judged(objective, harness.dtype):
        numbers, record = harness.put(steps.numbers()), np.full((len(before) + 2, 2), -1.0)
        record[: len(before)] = np.transpose([before, np.zeros(len(before))])
        expected = list(before)
        with np.errstate(invalid="ignore"):  # as runs do
            corrections = _twin(
                reference.collect_sums, given, steps=steps, objectives=expected, **sums
            )
        objectives, data_term = harness.put(record), harness.put(np.zeros(2))
        star_totals = harness.put(np.zeros((given.n, 2)))
        star_corrections = harness.put(np.zeros(given.n))
        _launch(
            harness,
            given,
            "collect_sums",
            steps=numbers,
            objectives=objectives,
            data_term=data_term,
            star_totals=star_totals,
            star_corrections=star_corrections,
            star_blocks=star_blocks,
            **{name: harness.put(values) for name, values in put.items()},
        )
        found = harness.take(objectives, record.shape).astype(float)
        ahead = [-2.0] * (len(record) - len(expected))
        yield found.sum(axis=1), np.array([*expected, *ahead])
        yield from _steps(harness.take(numbers, -1), steps)
        yield harness.take(data_term, -1).sum(), ratio_sums.sum()
        yield _take_star_sums(harness, given, star_totals), sums["star_sums"]
        yield harness.take(star_corrections, -1), corrections


def _judged(objective: float, dtype: np.dtype) -> Iterator[tuple[Steps, list[float]]]:
    """Yield what was decided before an objective, and the objectives before it."""

    def own(**numbers: float) -> Steps:
        return Steps(*rounded(Steps(**numbers).numbers(), dtype).tolist())

    above = list(rounded([objective + 2.0, objective + 1.0], dtype))
    below = list(rounded([objective + 1.0, objective - 1.0], dtype))
    settling = list(rounded(objective + 1e-3 * np.arange(12.0, 0.0, -1.0), dtype))
    step = {"share": 1.0, "slope": -100.0, "recorded": 2.0}
    yield own(), []
    yield own(recorded=2.0, target=3.0), above
    yield own(**step, target=3.0, shortened=2.0), above
    yield own(**step), below
    yield own(**step, shortened=11.0), below
    yield own(**step, shortened=11.0, prior_change=math.inf), above
    # What it is allowed is no number.
    yield own(**{**step, "slope": -math.inf}, rounding=math.inf, shortened=11.0), above
    yield own(**step, prior_change=-3.0), below
    yield own(**step, rounding=0.1 + 1.0 / abs(objective)), below
    yield own(**{**step, "slope": -1e5}), above
    yield own(**step, going=0.0), above
    many = {**step, "recorded": 12.0, "slope": -1e-9}
    yield own(**many, tolerance=1.1e-3 / abs(objective)), settling
    yield own(**many, tolerance=0.9e-3 / abs(objective)), settling
    yield own(**{**many, "recorded": 10.0}, tolerance=1.0), settling[2:]


def _run_follow_stars(harness: KernelHarness, given: SimpleNamespace) -> Pairs:
    rng, n, blocks = np.random.default_rng(8), given.n, given.cross_windows.n_blocks
    root = rng.normal(size=(n, 2 * n))
    inverse = rounded(root @ root.T + np.eye(n), harness.dtype)
    inverse = np.triu(inverse) + np.triu(inverse, 1).T
    k, row_blocks = given.k, given.k * harness.program.row_blocks
    coupling = rounded(rng.uniform(-1.0, 2.0, (k, n, blocks, 2)), harness.dtype)
    change = rounded(rng.normal(size=n), harness.dtype)
    change_sums = rounded(rng.uniform(1.0, 2.0, (2, row_blocks, 2)), harness.dtype)
    for pull, slope, numbers in (
        (-0.3, -1.0, {}),
        (0.2, -1.0, {"is_first": 0.0, "length": 0.3}),
        (-1.5, -1.0, {"is_first": 0.0, "length": 9.0}),
        (-0.3, 1e4, {"is_first": 0.0}),
        (0.1, -1.0, {"is_first": 0.0, "shortened": 2.0, "share": 0.16, "slope": -3.0}),
        (0.1, -1.0, {"going": 0.0}),
    ):
        steps = Steps(*rounded(Steps(**numbers).numbers(), harness.dtype).tolist())
        totals = rounded(rng.uniform(0.1, 0.2, (n, 2)) - pull, harness.dtype)
        slopes = rounded(np.full((row_blocks, 2), slope), harness.dtype)
        kept = harness.put([given.star_fluxes, change, change, change])
        there = _launch(
            harness,
            given,
            "follow_stars",
            steps=harness.put(steps.numbers()),
            star_steps=kept,
            star_totals=harness.put(totals),
            coupling_sums=harness.put(coupling),
            star_inverse=harness.put(inverse),
            step_sums=harness.put(slopes),
            change_sums=harness.put(change_sums),
            cross_blocks=blocks,
        )
        fluxes, changed = given.star_fluxes, change
        if steps.going:
            fluxes, changed = reference.follow_stars(
                steps,
                given.star_fluxes,
                change,
                totals.sum(axis=1),
                coupling.sum(axis=(2, 3)),
                given.flux_mixes,
                inverse,
                given.prior_fluxes,
                given.prior_precision,
                slopes.sum(),
                next_step(steps, *change_sums.sum(axis=(1, 2))),
            )
        if n:
            found = harness.take(there["star_fluxes"], -1), *harness.take(kept, (4, n))[:2]
            yield np.array(found), np.array([fluxes, given.star_fluxes, changed])
        yield from _steps(harness.take(there["steps"], -1), steps)


def _steps(found: NDArray, expected: Steps) -> Pairs:
    """Yield the numbers of a run one by one, but the last, which is small, with its slope."""
    pairs = np.nan_to_num([found.astype(float), expected.numbers()], posinf=1e30)
    yield from pairs[:, :-1].T
    yield pairs[0, -2:], pairs[1, -2:]


def _run_gradient_rows(harness: KernelHarness, given: SimpleNamespace) -> Pairs:
    expected, change_step, change_change = _twin(
        reference.gradient_rows, given, row_spectrum=given.correction_spectra
    )
    spectra = harness.put_spectra(given.correction_spectra)
    sums = harness.put(np.full((2, given.k * harness.program.row_blocks, 2), np.nan))
    there = _launch(harness, given, "gradient_rows", spectra=spectra, change_sums=sums)
    yield harness.take_pixels(there["gradient"]), expected
    found = harness.take(sums, (2, -1)).astype(float).sum(axis=1)
    yield found, np.array([change_step, change_change])


def _run_step_rows(harness: KernelHarness, given: SimpleNamespace) -> Pairs:
    windows, row_blocks = given.cross_windows, given.k * harness.program.row_blocks
    sums = np.zeros((2, row_blocks, 2))
    sums[:, :, 0] = rounded(np.array([[1.3], [0.9]]) / row_blocks, harness.dtype)
    for numbers in ({"alpha": float(np.float32(1.3))}, {"is_first": 0.0}, {"shortened": 1.0}):
        steps = Steps(**numbers)
        alpha, _ = next_step(steps, *sums.sum(axis=(1, 2)))
        before = given.previous if steps.shortened else given.extended
        if steps.shortened:
            made = [*reference.shortened(given.extended, given.previous), None, None]
        else:
            made = _twin(reference.step_rows, given, alpha=alpha)
        extended, spectrum, squares, slope, couplings = made
        out, step_sums, square_sums = (
            harness.empty_spectra(), harness.empty_sums(), harness.empty_sums()
        )  # fmt: skip
        coupling_sums = harness.put(np.full((given.k, given.n, windows.n_blocks, 2), np.nan))
        there = _launch(
            harness,
            given,
            "step_rows",
            spectra=out,
            step_sums=step_sums,
            coupling_sums=coupling_sums,
            square_sums=square_sums,
            cross_information=harness.put_windows(given.cross_information, windows),
            **_put_windows(harness, "cross", windows),
            steps=harness.put(steps.numbers()),
            change_sums=harness.put(sums),
        )
        yield harness.take_pixels(there["extended"]), extended
        yield harness.take_pixels(there["previous"]), before
        yield harness.take_spectra(out, given.k), spectrum
        if slope is not None:
            yield harness.take_sums(step_sums, 1), np.array([slope])
            yield _take_star_sums(harness, given, coupling_sums, given.k), couplings
        if given.mu:
            yield harness.take_sums(square_sums, 1), np.array([squares])


KERNELS: dict[str, Callable[[KernelHarness, SimpleNamespace], Pairs]] = {
    name.removeprefix("_run_"): run for name, run in globals().items() if name.startswith("_run_")
}
