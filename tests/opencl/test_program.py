"""Which programs are built, with which tuning, and which of them a process holds."""

import re

import numpy as np
import pyopencl as cl
import pytest

from lnocl.core.opencl import program
from lnocl.core.opencl.device import choose, context_of
from lnocl.core.opencl.program import Program
from lnocl.core.opencl.tuning import Tuning


@pytest.fixture
def context():
    return context_of(choose().device)


@pytest.fixture
def compiled(monkeypatch):
    """The options of the programs that are compiled, which takes no time."""
    options = []

    class Nothing(program._Built):
        kernel_names = ("rfft_rows",)

        def __init__(self, context, text, given, file):
            options.append(given)

    monkeypatch.setattr(program, "_programs", type(program._programs)())
    monkeypatch.setattr(program, "_Built", Nothing)
    monkeypatch.setattr(program.weakref, "finalize", lambda *_: None)
    return options


def build(context, grid=(8, 8), **scene):
    return Program(context, grid, np.dtype(np.float32), Tuning(4, 4), **scene)


def test_a_process_builds_a_program_once(context, compiled):
    for _ in range(3):
        build(context)
    assert len(compiled) == 1


def test_the_programs_used_last_are_held(context, compiled):
    sizes = [(2**k, 2**m) for k in range(3, 8) for m in range(3, 8)][: program.MAX_PROGRAMS + 1]
    for size in sizes[:-1]:
        build(context, size)
    build(context, sizes[0])
    build(context, sizes[-1])
    assert len(program._programs) == program.MAX_PROGRAMS
    build(context, sizes[0])
    assert len(compiled) == len(sizes)
    build(context, sizes[1])
    assert len(compiled) == len(sizes) + 1


@pytest.mark.exhaustive
def test_the_names_of_arguments_are_those_that_the_kernels_declare(context):
    arguments = Program(context, (128, 64), np.dtype(np.float32)).arguments
    assert arguments["rfft_rows"] == ("spectra", "pixels", "row_roots", "scratch")
    assert arguments["fft_columns"] == ("spectra", "column_roots", "scratch")


def test_kernels_and_their_program_are_let_go(context):
    """PyOpenCL's `Program.all_kernels` gives kernels that keep themselves and their program."""
    built = Program(context, (128, 64), np.dtype(np.float32))
    assert built.kernel("rfft_rows").reference_count == 1


@pytest.mark.parametrize(
    ("platform", "kind", "expected"),
    [
        ("Portable Computing Language", cl.device_type.CPU, 1),
        ("Portable Computing Language", cl.device_type.GPU, 0),
        ("rusticl", cl.device_type.CPU, 0),
        ("Intel(R) OpenCL Graphics", cl.device_type.GPU, 0),
    ],
)
def test_clangs_builtin_is_left_to_pocl_on_cpus(compiled, monkeypatch, platform, kind, expected):
    """Compilers that go through SPIR-V end the process at it."""

    class Device:
        name = driver_version = ""
        type = kind
        max_compute_units = 1

    Device.platform = type("", (), {"name": platform})
    monkeypatch.setattr(program.unknown_cpu, "name_level", lambda _: None)
    monkeypatch.setattr(program.trial, "check", lambda _: None)
    build(type("", (), {"devices": [Device]}))
    assert f"-DHAS_BUILTIN_PREFETCH={expected}" in compiled[0]
    code = re.sub(r"/\*.*?\*/", "", program.source(), flags=re.DOTALL)
    (line,) = (line for line in code.splitlines() if "__builtin" in line)
    assert f"#elif HAS_BUILTIN_PREFETCH\n{line}\n#else" in code
