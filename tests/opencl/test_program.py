"""Which programs are built, with which tuning, and which of them a process holds."""

import re
from functools import lru_cache

import numpy as np
import pyopencl as cl
import pytest

import lnocl
from lnocl.core.engines.opencl import OpenCLEngine
from lnocl.core.opencl import program
from lnocl.core.opencl.device import choose, context_of
from lnocl.core.opencl.launch import Launcher
from lnocl.core.opencl.program import Program
from lnocl.core.opencl.tuning import Tuning
from lnocl.core.scene.penalty import Penalty
from lnocl.core.scene.scene import Scene


@pytest.fixture
def context():
    return context_of(choose().device)


@pytest.fixture
def compiled(monkeypatch):
    """The options of the programs that are compiled, which takes no time."""
    options = []

    class Nothing(program._Built):
        def __init__(self, context, text, given, file):
            options.append(given)

        def kernel(self, name):
            return name

    cached = lru_cache(program.MAX_PROGRAMS)(program._build.__wrapped__)
    monkeypatch.setattr(program, "_build", cached)
    monkeypatch.setattr(program, "_Built", Nothing)
    monkeypatch.setattr(program.weakref, "finalize", lambda *_: None)
    return options


def build(context, grid=(8, 8), **scene):
    """Return the kernels of a grid; one of them is made."""
    made = Program(context, grid, np.dtype(np.float32), Tuning(4, 4), **scene)
    made.kernel("fft_columns")
    return made


def test_a_process_builds_a_program_once(context, compiled):
    for _ in range(3):
        build(context)
    assert len(compiled) == 1


def test_the_programs_used_last_are_held(context, compiled):
    sizes = [(2**k, 2**m) for k in range(3, 10) for m in range(3, 10)][: program.MAX_PROGRAMS + 1]
    for size in sizes[:-1]:
        build(context, size)
    build(context, sizes[0])
    build(context, sizes[-1])
    assert program._build.cache_info().currsize == program.MAX_PROGRAMS
    build(context, sizes[0])
    assert len(compiled) == len(sizes)
    build(context, sizes[1])
    assert len(compiled) == len(sizes) + 1


@pytest.mark.exhaustive
def test_the_names_of_arguments_are_those_that_the_kernels_declare(context):
    arguments = Program(context, (128, 64), np.dtype(np.float32)).arguments
    own = ["spectra", "pixels", "steps", "n_images", "n_skies", "row_roots", "scratch"]
    assert list(arguments["rfft_rows"]) == own
    assert list(arguments["fft_columns"]) == ["spectra", "column_roots", "scratch"]


def test_kernels_and_their_program_are_let_go(context):
    """PyOpenCL's `Program.all_kernels` gives kernels that keep themselves and their program."""
    built = Program(context, (128, 64), np.dtype(np.float32))
    assert built.kernel("rfft_rows").reference_count == 1


def test_kernels_that_nothing_launches_any_more_serve_the_next_program(context):
    """Of two programs each has its own, and a launch has its kernel when its program is gone."""
    first, second = (build(context) for _ in range(2))
    kernels = {each.kernel("fft_columns").int_ptr for each in (first, second)}
    assert len(kernels) == 2
    del first, second
    launcher = Launcher(build(context))
    buffers = {"spectra": cl.Buffer(context, cl.mem_flags.READ_WRITE, 4096)}
    launch = launcher.bind("fft_columns", buffers)
    launch()
    own = launch._program.kernel("fft_columns").int_ptr
    assert own in kernels
    del launcher
    assert build(context).kernel("fft_columns").int_ptr == (kernels - {own}).pop()


def test_runs_that_differ_in_their_penalty_share_a_program():
    near = np.linspace(0.0, 0.1, 64).reshape(8, 8)
    penalties = [{}, {"mu": 0.1}, {"smoothing": 0.1}, {"smoothing": 0.1, "near_stars": near}]
    observation = lnocl.Observation(np.full((8, 8), 4.0), np.ones((1, 1)))
    scenes = [Scene(observation, penalty=Penalty(**each)) for each in penalties]
    engines = [OpenCLEngine(scene, "single", None, 1) for scene in scenes]
    assert len({tuple(engine.program.options) for engine in engines}) == 1


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
