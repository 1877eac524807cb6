"""CPUs that PoCL does not know: it compiles for the level of x86-64 that they have."""

import pytest
from processes import run_python
from runtimes import on_pocl

from lnocl.core.opencl import unknown_cpu

# PoCL is told that it knows no such CPU, whichever this machine has.
FORGET = """
import ctypes, os, struct
import pyopencl as cl
from lnocl.core.opencl import device, unknown_cpu
chosen = device.choose().device
memory = os.open("/proc/self/mem", os.O_RDWR)
place = unknown_cpu.find_name(memory, chosen.int_ptr)
print("found", place is not None)
unknown = ctypes.create_string_buffer(b"generic")
if place is not None:
    os.pwrite(memory, struct.pack("P", ctypes.addressof(unknown)), place)
"""
BUILD = """
context = cl.Context([chosen])
try:
    cl.Program(context, "__kernel void f(__global float *x) { *x += 1; }").build()
    print("built")
except cl.RuntimeError as error:
    print("generic" in str(error))
"""


def says(program):
    done = run_python(program)
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


@on_pocl
@pytest.mark.system
def test_kernels_build_for_a_cpu_that_pocl_does_not_know():
    found = says(FORGET)
    if found != ["found", "True"]:
        pytest.skip("this PoCL keeps no such record of its device")
    if says(FORGET + BUILD)[2:] != ["True"]:
        pytest.skip("this PoCL compiles for CPUs that it does not know")
    assert says(FORGET + "unknown_cpu.name_level(chosen)" + BUILD)[2:] == ["built"]


@pytest.mark.parametrize(
    ("flags", "level"),
    [
        ("fpu sse4_2 avx avx2 avx512f avx512bw", b"x86-64-v4\0"),
        ("fpu sse4_2 avx avx2", b"x86-64-v3\0"),
        ("fpu sse4_2 avx", b"x86-64-v2\0"),
        ("fpu sse2", None),
    ],
)
def test_level_is_that_of_the_features(flags, level, tmp_path, monkeypatch):
    (tmp_path / "cpuinfo").write_text(f"model : 2\nflags\t\t: {flags}\nflags : avx512f\n")
    monkeypatch.setattr(unknown_cpu, "FEATURES", str(tmp_path / "cpuinfo"))
    assert unknown_cpu._level() == level


@pytest.mark.parametrize(
    ("name", "level", "expected"),
    [
        (b"generic\0", b"x86-64-v3\0", True),
        (b"znver3\0\0", b"x86-64-v4\0", True),
        (b"znver3\0\0", b"x86-64-v3\0", False),
        (b"znver4\0\0", b"x86-64-v4\0", False),
        (b"", b"x86-64-v4\0", False),
    ],
)
def test_a_zen_4_that_is_called_a_zen_3_is_no_zen_3(name, level, expected):
    assert unknown_cpu._is_wrong(name, level) is expected
