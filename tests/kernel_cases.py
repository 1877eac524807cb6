"""The cases that kernels are compared with their twins on: grids, tunings, scenes, precisions."""

import functools
import re
from types import SimpleNamespace

import numpy as np
import pyopencl as cl
import pytest
from kernel_comparison import ALLOWED, deviation, kernels_of
from kernel_harness import THREE_IMAGES, TURNED, TWICE_AS_FINE, TWO_SKIES, KernelHarness, inputs
from kernel_scenes import FOUR_TIMES_AS_FINE, SCENES, THREE_FINE_SKIES, TWO_TURNED_SKIES

from lnocl.core.opencl import sources
from lnocl.core.opencl.device import choose, context_of
from lnocl.core.opencl.tuning import Tuning, candidates


def of_gpu(*grid, oversample=1, has_turns=False, dtype=np.float32, most=1024):
    """Return the tuning of a GPU with 132 compute units and 48 KiB of local memory a group."""
    gpu = SimpleNamespace(
        local_mem_size=48 * 1024,
        max_compute_units=132,
        max_work_group_size=most,
        type=cl.device_type.GPU,
    )
    return candidates(gpu, np.dtype(dtype))[0].fit(
        gpu, np.dtype(dtype), grid, oversample, has_turns
    )


# Name: (grid, tuning, scene, precisions), a capital letter for one that only CI tests. Each grid
# is the smallest that takes some path of kernels/fft.cl; tunings other than the default share a
# block among work-items, as a GPU does. A program takes seconds to compile and each of its kernels
# another: but for a few cases, each has one precision, as sources name a type alone.
# (PoCL 3 miscompiles vectors of 2 in groups of several work-items; no tuning has them.)
CASES = {
    "outer radix 2": ((2, 2), None, "plain", "S"),
    "outer radix 4": ((4, 4), None, "plain", "S"),
    "outer radix 8": ((8, 8), None, "mask, mu, smoothing", "S"),
    "radices 4, 4 and 8, 4": ((16, 32), None, THREE_IMAGES, "D"),
    "radices 8, 8 and 4, 8, 4": ((64, 128), None, "two images, star, mu", "sD"),
    "radices 8, 8, 4": ((256, 16), None, "plain", "S"),
    "exposure map": ((32, 16), None, "exposure map, mu", "D"),
    "exposure map, group": ((32, 16), Tuning(1, 8, group=4), "exposure map, mu", "S"),
    "radices 8, 8, 8": ((8, 512), None, "plain", "S"),
    "radices 4, 8, 8, 4, middle pass": ((32, 1024), None, "plain", "S"),
    "middle pass along y": ((2048, 4), None, "plain", "d"),
    "odd factors 3 and 5": ((48, 80), None, THREE_IMAGES, "sD"),
    "odd factors 5 and 9": ((80, 144), None, "two images, star, mu", "D"),
    "odd factors 9 and 7": ((144, 112), None, "mask, mu, smoothing", "S"),
    "odd factors 7 and 3": ((112, 96), None, "exposure map, mu", "D"),
    "odd factor 3, radices 8 and 8, 4 within": ((192, 768), None, "plain", "S"),
    "odd factor 5, middle pass": ((2560, 16), None, "plain", "S"),
    "odd factors 3 and 9, group": ((48, 144), Tuning(1, 8, group=4), THREE_IMAGES, "S"),
    "odd factors 3 and 5, vectors of 16": ((96, 160), Tuning(16, 16), THREE_IMAGES, "D"),
    "odd factor 5, several vectors a block": ((80, 96), Tuning(4, 8), "plain", "S"),
    "sky twice as fine": ((32, 64), None, TWICE_AS_FINE, "sD"),
    "sky twice as fine, smallest": ((64, 4), None, TWICE_AS_FINE, "S"),
    "sky twice as fine, odd factors 3 and 5": ((96, 80), None, TWICE_AS_FINE, "D"),
    "sky twice as fine, group": ((64, 96), Tuning(1, 8, group=4), TWICE_AS_FINE, "S"),
    "sky twice as fine, middle pass": ((2048, 32), None, TWICE_AS_FINE, "D"),
    "sky four times as fine": ((64, 32), None, FOUR_TIMES_AS_FINE, "S"),
    "sky four times as fine, radices 8, 8, 4": ((64, 1024), None, FOUR_TIMES_AS_FINE, "D"),
    "sky four times as fine, group": ((128, 64), Tuning(1, 8, group=4), FOUR_TIMES_AS_FINE, "S"),
    "two skies, odd factors 3 and 5": ((48, 80), None, TWO_SKIES, "sD"),
    "two skies, group": ((64, 32), Tuning(1, 8, group=4), TWO_SKIES, "S"),
    "two skies, global scratch": (
        (64, 32),
        Tuning(4, 16, scratch_is_global=True),
        TWO_SKIES,
        "S",
    ),
    "two skies, GPU": ((16, 32), of_gpu(16, 32), TWO_SKIES, "s"),
    "two skies, turned": ((64, 64), None, TWO_TURNED_SKIES, "S"),
    "three skies, twice as fine": ((32, 64), None, THREE_FINE_SKIES, "sD"),
    "three skies, twice as fine, group": (
        (64, 96),
        Tuning(1, 8, group=4),
        THREE_FINE_SKIES,
        "S",
    ),
    "three skies, twice as fine, GPU": (
        (64, 64),
        of_gpu(64, 64, oversample=2),
        THREE_FINE_SKIES,
        "S",
    ),
    "turned": ((64, 64), None, TURNED, "sD"),
    "turned, odd factors 3 and 5": ((48, 80), None, TURNED, "D"),
    "turned, several vectors a block": ((64, 32), Tuning(4, 8), TURNED, "S"),
    "turned, several pieces a column": ((512, 16), None, TURNED, "S"),
    "turned, group": ((64, 64), Tuning(1, 8, group=4), TURNED, "S"),
    "turned, blocks of 1": ((64, 32), Tuning(1, 1, group=4), TURNED, "S"),
    "turned, global scratch": ((64, 32), Tuning(4, 4, scratch_is_global=True), TURNED, "S"),
    "turned, GPU": ((512, 64), of_gpu(512, 64, has_turns=True), TURNED, "S"),
    "global scratch": ((64, 32), Tuning(4, 16, scratch_is_global=True), "plain", "S"),
    "several vectors a block": ((64, 32), Tuning(4, 8), "mask, mu, smoothing", "S"),
    "group": ((64, 32), Tuning(1, 8, group=4), THREE_IMAGES, "SD"),
    "group, middle pass": ((2048, 16), Tuning(1, 2, group=64), "plain", "D"),
    "group, global scratch": (
        (256, 64),
        Tuning(4, 32, group=8, scratch_is_global=True),
        "mask, mu, smoothing",
        "S",
    ),
    "GPU, 64": ((64, 64), of_gpu(64, 64), THREE_IMAGES, "D"),
    "GPU, 512": ((512, 512), of_gpu(512, 512), "exposure map, mu", "S"),
    "GPU, 1024": ((512, 1024), of_gpu(512, 1024), THREE_IMAGES, "S"),
    "GPU, blocks of 1": ((64, 32), of_gpu(64, 32, dtype=np.float64), "mask, mu, smoothing", "D"),
    "GPU, two passes in registers": ((16, 32), of_gpu(16, 32), "mask, mu, smoothing", "s"),
    "GPU, last pass of radix 2": ((256, 32), of_gpu(256, 32), "exposure map, mu", "S"),
    "GPU, odd factor 3": ((96, 192), of_gpu(96, 192), THREE_IMAGES, "S"),
    "GPU, odd factors 3 and 5": ((80, 48), Tuning(1, 2, group=8, points=16), THREE_IMAGES, "S"),
    "GPU, odd factors 7 and 9": ((56, 72), Tuning(1, 1, group=4, points=16), "plain", "D"),
    "GPU, not in registers": ((4096, 16), of_gpu(4096, 16), "mask, mu, smoothing", "S"),
    "GPU, sky twice as fine": ((64, 64), of_gpu(64, 64, oversample=2), TWICE_AS_FINE, "S"),
    "GPU, sky twice as fine, odd": (
        (96, 80),
        Tuning(1, 2, group=8, points=16),
        TWICE_AS_FINE,
        "D",
    ),
    "GPU, sky four times as fine": (
        (64, 128),
        Tuning(1, 4, group=32, points=16),
        FOUR_TIMES_AS_FINE,
        "S",
    ),
    "GPU, odd factors": ((144, 80), of_gpu(144, 80), "two images, star, mu", "D"),
}
DTYPES = {"s": np.float32, "d": np.float64}
# Of tests that need a program with stars and without weights; CI runs them in double.
in_each_precision = pytest.mark.parametrize(
    "dtype", [np.float32, pytest.param(np.float64, marks=pytest.mark.exhaustive)]
)
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

FOLDER = sources.folder()


def kernels_in(file):
    """Return the kernels that a source file has."""
    text = (FOLDER / file).read_text(encoding="ascii")
    return re.findall(r"^KERNEL void (\w+)\(", text, re.MULTILINE)


@functools.cache
def harness_of(case, dtype):
    grid, tuning, scene, _ = CASES[case]
    device = choose().device
    if tuning is not None and not tuning.scratch_is_global:
        oversample, has_turns = (SCENES[scene].get(key, 0) for key in ("oversample", "has_turns"))
        needed = tuning.local_bytes(grid, oversample or 1, np.dtype(dtype), bool(has_turns))
        if needed > device.local_mem_size:
            pytest.skip("the device has too little local memory for this cut")
    return KernelHarness(context_of(device), grid, dtype, tuning, **SCENES[scene])


def agree_with_twins(file):
    """Return a test for each kernel of a source file, in each case."""

    runs = [
        pytest.param(*run.values, kernel, marks=run.marks, id=f"{run.id}-{kernel}")
        for run in RUNS
        for kernel in kernels_in(file)
        if kernel in kernels_of(SCENES[CASES[run.values[0]][2]])
    ]

    @pytest.mark.parametrize(("case", "dtype", "kernel"), runs)
    def test(case, dtype, kernel):
        harness = harness_of(case, dtype)
        assert deviation(harness, inputs(harness), kernel) <= ALLOWED[dtype]

    return test
