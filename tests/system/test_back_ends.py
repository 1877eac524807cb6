"""What two compilers for GPUs make of the kernels: no work-item needs memory of its own.

clang compiles the kernels, cut as for a GPU, for NVIDIA's and AMD's processors; NVIDIA's own
assembler, where it is installed, assembles what comes of the first.
"""

import re
import shutil
import subprocess
from glob import glob

import numpy as np
import pytest
from kernel_cases import of_gpu
from kernel_harness import ARGUMENTS, THREE_IMAGES, TURNED, TWICE_AS_FINE
from kernel_scenes import FOUR_TIMES_AS_FINE, SCENES

from lnocl.core.opencl import program
from lnocl.core.opencl.device import choose, context_of
from lnocl.core.opencl.sources import source

pytestmark = [pytest.mark.system]

CLANG = next(filter(None, map(shutil.which, ["clang-19", "clang-18", "clang-17", "clang"])), None)
PTXAS = shutil.which("ptxas")
LIBRARIES = "/usr/lib/clc", "/usr/share/clc"  # of functions that OpenCL has built in
# Target, processor and library.
TARGETS = {
    "NVIDIA": ("nvptx64--nvidiacl", "sm_70", "nvptx64--nvidiacl.bc"),
    "AMD": ("amdgcn-amd-amdhsa", "gfx906", "amdgcn--amdhsa.bc"),
}
# Lengths, one with three blocks in 48 KiB, one with a single one, and both odd and finer.
CASES = {
    "64": ((64, 64), THREE_IMAGES),
    "1024": ((1024, 1024), THREE_IMAGES),
    "4096": ((4096, 4096), "exposure map, mu"),
    "odd": ((144, 112), "mask, mu, smoothing"),
    "odd, in registers": ((768, 768), "mask, mu, smoothing"),
    "finer": ((256, 512), FOUR_TIMES_AS_FINE),
    "finer, in registers": ((1024, 1024), TWICE_AS_FINE),
    "turned": ((1024, 1024), TURNED),
}
# Most work-items of a group.
MOST = {"NVIDIA": 1024, "AMD": 256}
# Most registers of 32 bits: of 128, two groups of 256 work-items go on either processor. Work-items
# that hold lines have more.
MAX_REGISTERS = {np.float32: 128, np.float64: 256}
MAX_WITH_LINES = {np.float32: 192, np.float64: 256}
# And those of a group together.
REGISTERS_OF_GROUP = 65536


def cut_of(target, grid, scene, dtype):
    """Return how the kernels are cut for a GPU, and the other parts of their program."""
    parts = {k: v for k, v in SCENES[scene].items() if k not in ARGUMENTS}
    cut = of_gpu(*grid, **parts, dtype=dtype, most=MOST[target])
    assert cut.group > 1
    return cut, parts


def options(target, grid, scene, dtype):
    """Return the options with which a program for a GPU is built, and the most registers."""
    cut, parts = cut_of(target, grid, scene, dtype)
    built = program.Program(context_of(choose().device), grid, np.dtype(dtype), cut, **parts)
    most = (MAX_WITH_LINES if cut.points else MAX_REGISTERS)[dtype]
    return built.options, min(most, REGISTERS_OF_GROUP // cut.group)


def test_cases_have_lines_in_registers_and_in_the_scratch():
    held = {
        name: bool(cut_of("NVIDIA", *case, np.float32)[0].points) for name, case in CASES.items()
    }
    assert held == {
        "64": True,
        "1024": True,
        "4096": True,
        "odd": False,
        "odd, in registers": True,
        "finer": False,
        "finer, in registers": True,
        "turned": False,
    }


def compiled(target, given, tmp_path):
    """Return the assembly of all kernels."""
    triple, processor, library = TARGETS[target]
    found = [file for folder in LIBRARIES for file in glob(f"{folder}/{library}")]
    if CLANG is None or not found:
        pytest.skip("no clang with libclc here: install clang-19 and libclc-19")
    (tmp_path / "kernels.cl").write_text(source(), encoding="ascii")
    which = "-march=" if target == "NVIDIA" else "-mcpu="
    command = [
        *(CLANG, "-x", "cl", "-O3", "-S", "-nogpulib", "-target", triple, which + processor),
        *("-Xclang", "-finclude-default-header"),
        *("-Xclang", "-mlink-builtin-bitcode", "-Xclang", found[0]),
        *given,
        *("kernels.cl", "-o", "kernels.s"),
    ]
    subprocess.run(command, cwd=tmp_path, check=True, capture_output=True, text=True)
    return (tmp_path / "kernels.s").read_text()


RUNS = pytest.mark.parametrize("dtype", [np.float32, np.float64], ids=["single", "double"])


@RUNS
@pytest.mark.parametrize("case", CASES)
def test_work_items_of_amd_have_registers_alone(tmp_path, case, dtype):
    given, most = options("AMD", *CASES[case], dtype)
    assembly = compiled("AMD", given, tmp_path)
    kernels = re.findall(
        r"\.name: +(\w+)\n.*?private_segment_fixed_size: (\d+).*?"
        r"\.vgpr_count: +(\d+)\n +\.vgpr_spill_count: (\d+)",
        assembly,
        re.DOTALL,
    )
    names = {name for name, *_ in kernels}
    assert {"ratio_rows", "scale_rows", "convolve_columns", "step_rows"} <= names
    for name, private, registers, spilt in kernels:
        assert (int(private), int(spilt)) == (0, 0), name
        assert int(registers) <= most, name


@RUNS
@pytest.mark.parametrize("case", CASES)
def test_work_items_of_nvidia_have_registers_alone(tmp_path, case, dtype):
    assembly = compiled("NVIDIA", options("NVIDIA", *CASES[case], dtype)[0], tmp_path)
    assert len(re.findall(r"\.entry (\w+)", assembly)) >= 12
    assert not re.findall(r"__local_depot|\bld\.local|\bst\.local", assembly)


@RUNS
@pytest.mark.parametrize("case", CASES)
@pytest.mark.skipif(PTXAS is None, reason="no ptxas here: it comes with NVIDIA's CUDA")
def test_nvidia_assembles_them_without_spilling(tmp_path, case, dtype):
    given, most = options("NVIDIA", *CASES[case], dtype)
    compiled("NVIDIA", given, tmp_path)
    done = subprocess.run(
        [PTXAS, "-arch=sm_90", f"-maxrregcount={most}", "-v", "-o", "kernels.o", "kernels.s"],
        cwd=tmp_path,
        check=True,
        capture_output=True,
        text=True,
    )
    frames = re.findall(r"(\d+) bytes stack frame, (\d+) bytes spill stores", done.stderr)
    registers = [int(n) for n in re.findall(r"Used (\d+) registers", done.stderr)]
    assert len(frames) == len(registers) >= 12
    # Of 512 work-items, each has 128 registers: gradient_rows keeps three numbers in memory then.
    assert set(frames) - {("16", "12")} == {("0", "0")}
    assert (("16", "12") in frames) == (case == "4096" and dtype == np.float32)
    assert max(registers) <= most
