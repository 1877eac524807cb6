"""Every kernel under Oclgrind: no data race, no access out of bounds, no uninitialised read.

No report on a kernel of lnocl's is excused. Oclgrind 21.10 looks for uninitialised values in vain
in optimised code: it stops at the `freeze` that LLVM's div-rem-pairs puts before `x / n` and
`x % n`, and crashes at vectors. So the kernels are built as they are written, without any pass of
the compiler; no optimiser hides a fault then, either. And grind.py fills and keeps buffers so that
Oclgrind does not lose track of them.
"""

import collections
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import grind
import kernel_comparison as comparison
import pytest
from kernel_scenes import SCENES

HERE = Path(__file__).parents[1]
DEFINITION = re.compile(r"\b(?:KERNEL|(?:__)?kernel)\s+void\s+(\w+)")
REPORT = re.compile(r"^(\S.*)\n\tKernel: (\w+)$((?:\n\t.*)*)", re.MULTILINE)
# Only transforms that are tested by themselves use them.
NOT_IN_A_DECONVOLUTION = {"irfft_rows", "fft_columns", "ifft_columns", *comparison.SHEARED}

BUILD_OPTIONS = "-O0 -disable-llvm-passes"
OPTIONS = ["--data-races", "--uniform-writes", "--uninitialized", "--max-errors", "100000"]

pytestmark = [
    pytest.mark.system,
    pytest.mark.skipif(
        shutil.which("oclgrind") is None, reason="oclgrind is not there: apt-get install oclgrind"
    ),
]

RUNS = [
    pytest.param(
        case, d.lower(), marks=[pytest.mark.exhaustive] if d.isupper() else [], id=f"{case}-{d}"
    )
    for case, (*_, precisions) in grind.CASES.items()
    for d in precisions
]


def run(case, dtype, *planted):
    """Return what the driver printed, the reports, and what else there was on standard error.

    Not from Oclgrind's log, which each new context begins anew.
    """
    command = ["oclgrind", *OPTIONS, *grind.DEVICE_OPTIONS.get(case, [])]
    command += ["--build-options", BUILD_OPTIONS, sys.executable, str(HERE / "grind.py")]
    # Stored programs were built with other options.
    with tempfile.TemporaryDirectory() as store:
        environment = {**os.environ, "POCL_CACHE_DIR": store}
        environment.pop("PYOPENCL_CTX", None)
        done = subprocess.run(
            [*command, case, dtype, *planted],
            env=environment,
            capture_output=True,
            text=True,
            timeout=600,
        )
    trouble = REPORT.sub("", done.stderr).strip()
    if done.returncode:
        trouble += f"\nexit status {done.returncode}"
    return done.stdout, reports(done.stderr), trouble


def reports(text):
    """Return the number of reports of each kind, kernel and line."""
    found = collections.Counter()
    for what, kernel, details in REPORT.findall(text):
        line = re.search(r"At line (\d+) .*of (\S+?):?$", details, re.MULTILINE)
        where = f"{line[2]}:{line[1]}" if line else "?"
        found[f"{re.sub(' ?0x[0-9a-f]+', '', what)} in {kernel}, {where}"] += 1
    return found


def kernels():
    """Return the names of all kernels, from their source."""
    return {
        name
        for file in (HERE.parent / "kernels").glob("*.cl")
        for name in DEFINITION.findall(file.read_text(encoding="ascii"))
    }


@pytest.mark.parametrize(("case", "dtype"), RUNS)
def test_no_kernel_is_at_fault(case, dtype):
    launched, found, trouble = run(case, dtype)
    assert set(found) == set()
    assert not trouble
    if grind.CASES[case][2] == grind.DECONVOLUTION:
        expected = kernels() - NOT_IN_A_DECONVOLUTION
    else:
        expected = set(comparison.kernels_of(SCENES[grind.CASES[case][2]]))
    assert set(json.loads(launched)) == expected


def test_no_kernel_is_left_out():
    scenes = {scene for _, _, scene, _ in grind.CASES.values()} - {grind.DECONVOLUTION}
    tried = {name for scene in scenes for name in comparison.kernels_of(SCENES[scene])}
    assert tried == kernels()


# What is planted: case, kernel, the source and what is put in its place, and the report.
FAULTS = {
    "read behind the end": (
        "group larger than its work",
        "rfft_rows",
        "LOAD(FROM_POINT(from, x, lane), q * INNER(NX))",
        "LOAD(FROM_POINT(from, x, lane), q * INNER(NX) + 1)",
        "Invalid read of size 4 at global memory",
    ),
    "write behind the end": (
        "an item a block",
        "irfft_rows",
        "STORE(FROM_POINT(to, x, lane), q * INNER(NX), a[q])",
        "STORE(FROM_POINT(to, x, lane), q * INNER(NX) + 1, a[q])",
        "Invalid write of size 32 at global memory",
    ),
    "no barrier before a sum": (
        "group larger than its work",
        "ratio_rows",
        "shared[ITEM] = own;\n    BARRIER;",
        "shared[ITEM] = own;",
        "Read-write data race at local memory",
    ),
    "no barrier before the next block": (
        "group, global scratch",
        "irfft_rows",
        "STORE(FROM_POINT(to, x, lane), q * INNER(NX), a[q]);\n        }\n        BARRIER;",
        "STORE(FROM_POINT(to, x, lane), q * INNER(NX), a[q]);\n        }",
        "Read-write data race at global memory",
    ),
    "no barrier in an exchange": (
        "group",
        "convolve_columns",
        "put(z, n, true, length, radix);\n    BARRIER;",
        "put(z, n, true, length, radix);",
        "Read-write data race at local memory",
    ),
    "no barrier between exchanges": (
        "group",
        "rfft_rows",
        "take(z, n, false, next_length, next_radix);\n    BARRIER;",
        "take(z, n, false, next_length, next_radix);",
        "Read-write data race at local memory",
    ),
    "every group scales the stars": (
        "group, exposure map",
        "scale_rows",
        "if (get_group_id(0) == 0) {\n        OF_MEMBER(star_fluxes",
        "{\n        OF_MEMBER(star_fluxes",
        "Read-write data race at global memory",
    ),
    "scratch read before it is written": (
        "an item a block",
        "correlate_columns",
        "if (own > 0 && n_mixed == 1)",
        "if (own >= 0 && n_mixed == 1)",
        "Uninitialized value written to local memory",
    ),
    "padding read": (
        "an item a block",
        "fft_columns",
        "a[q] = LOAD(FROM_POINT(from, y, lane), q * INNER(n))",
        "a[q] = LOAD(FROM_POINT(from, y, lane), q * INNER(n) + 1)",
        "Uninitialized value written to local memory",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_planted_faults_are_found(fault):
    case, kernel, old, new, expected = FAULTS[fault]
    _, found, trouble = run(case, "s", old, new, kernel)
    assert any(f"{expected} address in {kernel}," in report for report in found), trouble


def test_kernels_are_found_however_they_are_written():
    text = "KERNEL void a(\n__kernel void b(\nkernel\n    void c(\nINLINE void d("
    assert DEFINITION.findall(text) == ["a", "b", "c"]
