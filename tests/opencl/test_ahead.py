"""Kernels that another process compiles meanwhile: taken from it, and done without it."""

import errno
import os
import time
from pathlib import Path

import numpy as np
import pytest
from processes import run_python
from runtimes import on_pocl

from lnocl.core.opencl import ahead, program, sources
from lnocl.core.opencl.device import choose, context_of

# Prints whether each program was found in the store, and the result of a run.
CODE = """
from lnocl import process
from lnocl.core.opencl import ahead, program
exec(sys.argv[1])
class Built(program._Built):
    def __init__(self, context, text, options, file):
        super().__init__(context, text, options, file)
        print("KERNEL void step_rows" in text, self._content is not None)
program._Built = Built
print(lnocl.deconvolve(observation, n_iter=3, stop=None, smoothing=0.0, pad=0).extended.sum())
print([each.returncode for each in ahead._begun.values()])
"""

NO_PROCESS = """
program.trial.check = lambda device: None
sys.executable = "/nonexistent"
"""


def first_run(folder, before=""):
    done = run_python(CODE, before, POCL_CACHE_DIR=str(folder))
    assert (done.returncode, done.stderr) == (0, ""), done.stderr
    return done.stdout.splitlines()


@on_pocl
@pytest.mark.system
@pytest.mark.parametrize(
    ("before", "expected", "ended"),
    [
        ("", "True True", "[0]"),
        ("from lnocl.core.opencl import trial; trial._try = None", "True True", "[0]"),
        ("ahead.SCRIPT = 'raise SystemExit(3)'", "True False", "[3]"),
        ("process.is_worker = True", "True False", "[]"),
        ("process.n_cores = lambda: 1", "True False", "[]"),
        (NO_PROCESS, "True False", "[]"),
    ],
    ids=["done", "instead of a trial", "failed", "worker", "one core", "no process"],
)
def test_kernels_needed_last_are_compiled_by_another_process(tmp_path, before, expected, ended):
    cold = first_run(tmp_path, before)
    assert cold[:2] == ["False False", expected]
    assert cold[3] == ended
    assert first_run(tmp_path, before) == ["False True", "True True", cold[2], "[]"]


UNNEEDED = """
from lnocl.core.opencl import ahead, device, program
ahead.SCRIPT = "import time; print(time.sleep(100))"
program.Program(device.context_of(device.choose().device), (16, 16), np.dtype("f4"))
(child,) = ahead._begun.values()
print(child.pid)
"""


@on_pocl
@pytest.mark.system
def test_unneeded_compilation_ends_with_the_process(tmp_path):
    done = run_python(UNNEEDED, POCL_CACHE_DIR=str(tmp_path))
    assert (done.returncode, done.stderr) == (0, "")
    state = Path("/proc", done.stdout.strip(), "stat")
    last = time.monotonic() + 20.0
    while is_there := state.exists() and state.read_text().split()[2] != "Z":
        assert time.monotonic() < last
        time.sleep(0.05)
    assert not is_there


def test_a_store_that_may_not_be_looked_into_holds_nothing(monkeypatch):
    genuine = os.stat

    def refuse(path, *given, **more):
        if str(path).endswith(".kernels"):
            raise PermissionError(errno.EACCES, "Permission denied")
        return genuine(path, *given, **more)

    monkeypatch.setattr(os, "stat", refuse)
    context = context_of(choose().device)
    assert not program.Program(context, (16, 16), np.dtype(np.float32)).is_stored


@pytest.mark.parametrize("kernel", [sources.FIRST[0], sources.LAST[0], "scale_rows"])
def test_a_program_has_its_own_kernels_on_their_lines(kernel):
    text, whole = sources.beside(kernel, program.source()), program.source()
    own = [name for name, _ in sources.KERNEL.findall(text)]
    assert kernel in own
    parts = {*sources.FIRST}, {*sources.LAST}
    others = {name for name, _ in sources.KERNEL.findall(whole)} - set.union(*parts)
    assert {*own} in (*parts, others)
    lines = zip(text.splitlines(), whole.splitlines(), strict=True)
    assert all(one in ("", other) for one, other in lines)


def test_scalar_kernel_arguments_are_distinguished_from_arrays():
    types = sources.arguments(program.source())["step_rows"]
    assert types["mu"].split() == ["const", "real"]
    assert types["has_weights"].split() == ["const", "int"]
    assert types["steps"].split() == ["__global", "const", "real", "*restrict"]


def test_no_test_process_compiles_ahead():
    assert not ahead._begun
