"""Devices that fail, caches that are broken, forks, and objectives that are not finite."""

import re
import resource
from pathlib import Path

import numpy as np
import pyopencl as cl
import pytest
from processes import run_python
from runtimes import on_pocl
from scenes import paper

import lnocl
from lnocl import checkpoint
from lnocl.core.engines import opencl
from lnocl.core.engines.numpy import ReferenceEngine
from lnocl.core.opencl import device, memory, program

# Of images of this shape, with a star and mu, kernel_cases.py has the program.
WITH_STAR = {"stars": [(5, 6)], "mu": 1e-6}
SHAPE_WITH_STAR = 64, 128


def observe(shape=(16, 32)):
    images = np.random.default_rng(16).poisson(50.0, shape)
    return lnocl.Observation(images, np.ones((3, 3)), background=1.0)


def error_of(kind, code, routine):
    record = cl._cl._ErrorRecord(msg="", code=getattr(cl.status_code, code), routine=routine)
    return kind(record)


def fail_with(error, after=0):
    """Return a stand-in for a function of pyopencl that fails from some call on."""

    def wrap(function):
        calls = []

        def stand_in(*arguments, **keywords):
            calls.append(None)
            if len(calls) > after:
                raise error
            return function(*arguments, **keywords)

        return stand_in

    return wrap


def refused(**keywords):
    """Return the one line that a deconvolution is refused with."""
    with pytest.raises(lnocl.DeviceError) as caught:
        paper(observe(), **{"n_iter": 40, **keywords})
    assert "\n" not in str(caught.value)
    assert caught.value.__cause__ is not None
    return str(caught.value)


SHORT = [
    (cl.MemoryError, "MEM_OBJECT_ALLOCATION_FAILURE"),
    (cl.RuntimeError, "OUT_OF_RESOURCES"),
    (cl.RuntimeError, "OUT_OF_HOST_MEMORY"),
]


@pytest.mark.parametrize(("kind", "code"), SHORT)
@pytest.mark.parametrize("call", ["Buffer", "enqueue_nd_range_kernel", "enqueue_copy"])
def test_insufficient_device_memory_is_reported_with_the_size_needed(monkeypatch, kind, code, call):
    error = error_of(kind, code, call)
    # A new list each time: monkeypatching cl.Buffer hides the class from isinstance elsewhere.
    monkeypatch.setattr(cl, call, fail_with(error)(getattr(cl, call)))
    message = refused()
    assert re.search(r"has too little memory free: the scene takes \d+ MiB there; take", message)
    assert code in message
    assert describe() in message


def describe():
    return device.describe(device.choose().device)


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    ("kind", "code"),
    [
        (cl.RuntimeError, "DEVICE_NOT_AVAILABLE"),
        (cl.RuntimeError, "OUT_OF_RESOURCES"),
        (cl.LogicError, "INVALID_COMMAND_QUEUE"),
        (cl.LogicError, "INVALID_CONTEXT"),
    ],
)
@pytest.mark.parametrize("solver", ["sgm", "sgp"])
def test_device_lost_during_iterations_is_reported(monkeypatch, kind, code, solver):
    error = error_of(kind, code, "clEnqueueNDRangeKernel")
    wrapped = fail_with(error, after=60)(cl.enqueue_nd_range_kernel)
    monkeypatch.setattr(cl, "enqueue_nd_range_kernel", wrapped)
    message = refused(solver=solver)
    assert f"(clEnqueueNDRangeKernel failed: {code}), and the state of the run is lost" in message
    assert "lnocl selftest" in message


@pytest.mark.parametrize("solver", ["sgm", "sgp"])
def test_too_little_memory_for_a_run_that_goes_on_is_no_lost_device(monkeypatch, tmp_path, solver):
    saved = str(tmp_path / "run.fits")
    paper(observe(), n_iter=40, solver=solver, checkpoint=saved, callback=lambda k, _: k == 20)
    error = error_of(cl.RuntimeError, "OUT_OF_RESOURCES", "clEnqueueNDRangeKernel")
    genuine = opencl.OpenCLEngine.restore

    def restore(engine, state):
        genuine(engine, state)
        monkeypatch.setattr(cl, "enqueue_nd_range_kernel", fail_with(error)(None))

    monkeypatch.setattr(opencl.OpenCLEngine, "restore", restore)
    assert "has too little memory free" in refused(solver=solver, resume=saved)


def test_a_device_lost_while_the_host_waits(monkeypatch):
    error = error_of(
        cl.RuntimeError, "EXEC_STATUS_ERROR_FOR_EVENTS_IN_WAIT_LIST", "clWaitForEvents"
    )
    monkeypatch.setattr(memory.Memory, "download", fail_with(error, 1)(memory.Memory.download))
    lost = device.context_of(device.choose().device)
    assert "clWaitForEvents failed: EXEC_STATUS_ERROR_FOR_EVENTS_IN_WAIT_LIST" in refused()
    monkeypatch.undo()
    assert device.context_of(device.choose().device) is not lost
    assert not program._build.cache_info().currsize
    paper(observe(), n_iter=1)


def test_every_public_verb_of_the_engine_is_guarded():
    public = {name for name, verb in vars(opencl.OpenCLEngine).items() if callable(verb)}
    unguarded = {
        name
        for name in public
        if not name.startswith("_") and not hasattr(vars(opencl.OpenCLEngine)[name], "__wrapped__")
    }
    assert not unguarded
    assert hasattr(opencl.OpenCLEngine.__init__, "__wrapped__")


def test_a_compiler_that_fails_leaves_its_whole_log(monkeypatch, tmp_path):
    text = program.source()
    monkeypatch.setattr(program, "source", lambda: f"{text}this is no OpenCL;\nnor this")
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    message = refused()
    (log,) = tmp_path.glob("lnocl-build-*.log")
    assert f"its messages are in {log}" in message
    said = log.read_text()
    assert "error:" in message
    assert said.count("error:") >= 1
    assert len(said) > len(message)


@on_pocl  # with others, PyOpenCL needs a folder for temporary files first
def test_a_log_that_cannot_be_saved_is_no_other_error(monkeypatch):
    text = program.source()
    monkeypatch.setattr(program, "source", lambda: f"{text}this is no OpenCL")
    device.choose()  # has made its folder
    monkeypatch.setattr("tempfile.tempdir", "/nonexistent")
    assert "could not be saved" in refused()


@on_pocl
def test_too_few_addresses_are_refused_before_pocl_compiles(monkeypatch):
    """It fails while it holds locks that it then waits for, as the process ends."""
    program._build.cache_clear()
    before = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + 400 * 2**20, before[1]))
    try:
        message = refused()
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)
    assert message == (
        "PoCL needs 512 MiB of addresses more than this process may have: raise the limit of "
        "memory (ulimit -v), or take engine numpy"
    )


@pytest.mark.system
def test_memory_that_is_really_short():
    code = """
import resource
deconvolve()
large = lnocl.Observation(np.full((2048, 2048), 5.0), np.ones((3, 3)))
paper(large, n_iter=1, precision="double")  # which builds the kernels
pages = int(open("/proc/self/statm").read().split()[0])
for room in (170, 200, 230):
    limit = pages * resource.getpagesize() + room * 2**20
    resource.setrlimit(resource.RLIMIT_AS, (limit, resource.getrlimit(resource.RLIMIT_AS)[1]))
    try:
        paper(large, n_iter=1, precision="double")
    except lnocl.DeviceError as error:
        print(error)
    except MemoryError:
        pass  # before the device is reached
"""
    done = run_python(code)
    assert done.returncode == 0, done.stderr
    assert "too little memory free: the scene takes 1" in done.stdout


@pytest.mark.system
def test_a_fork_after_opencl_is_refused():
    """Both a new run and one that was begun before the fork."""
    code = """
import multiprocessing
runs = []
def begun(iteration, estimate):
    runs.append(estimate._run)
paper(observation, n_iter=1, callback=begun)
def child(what):
    try:
        deconvolve() if what == "new" else runs[0].extended()
    except lnocl.DeviceError as error:
        print(what, error, flush=True)
for what in ("new", "inherited"):
    process = multiprocessing.get_context("fork").Process(target=child, args=[what])
    process.start()
    process.join(20)
    print(process.exitcode, flush=True)
    process.kill()
print(deconvolve())
"""
    done = run_python(code)
    new, first, inherited, second, parent = done.stdout.splitlines()
    for line, what in ((new, "new"), (inherited, "inherited")):
        assert re.match(
            f"{what} this process was forked .*multiprocessing.get_context.'spawn'", line
        )
    assert (first, second) == ("0", "0")
    assert float(parent) > 0


@pytest.mark.system
def test_a_fork_before_opencl_works():
    code = """
process = os.fork()
if process == 0:
    print(deconvolve(), flush=True)
    os._exit(0)
assert os.waitpid(process, 0)[1] == 0
print(deconvolve())
"""
    done = run_python(code)
    assert done.returncode == 0, done.stderr
    one, other = done.stdout.splitlines()
    assert one == other


# An objective that is not finite.


def poison(engine, what):
    """Put NaN into a pixel of what an engine holds."""
    if isinstance(engine, opencl.OpenCLEngine):
        nan = np.full(1, np.nan, engine.program.dtype)
        buffer = engine._memory.buffers[what]
        cl.enqueue_copy(engine._queue, buffer, nan, dst_offset=16 * nan.nbytes)
    elif what == "extended":
        engine._extended = engine._extended.copy()
        engine._extended[3, 3] = np.nan
    elif what == "images":
        engine._images[0, 3, 3] = np.nan
    else:
        engine._row_spectrum = engine._row_spectrum * np.nan


@pytest.mark.parametrize("every", [0.0, 1e9])
@pytest.mark.parametrize("solver", ["sgm", "sgp"])
def test_only_estimates_with_a_finite_objective_are_returned(solver, every, monkeypatch, tmp_path):
    """Where a finite estimate has an infinite objective, again and again."""
    path = tmp_path / "run.fits"
    monkeypatch.setattr(checkpoint, "EVERY", every)

    def objectives(engine, first=0):
        found = [*engine._objectives[:6], *[np.inf] * len(engine._objectives[6:])]
        return np.array(found[first:])

    monkeypatch.setattr(ReferenceEngine, "objectives", objectives)
    keywords = {"solver": solver, "engine": "numpy", "n_iter": 20, "callback": lambda *_: None}
    for files in ({"checkpoint": path}, {"resume": path}):
        with pytest.warns(lnocl.LnoclWarning, match="the objective became infinite or not a n"):
            result = paper(observe(), **keywords, **files)
        assert (result.stop_reason, result.n_iter) == ("not finite", 5)
        assert len(result.history) == 6
        assert np.isfinite(result.history["objective"]).all()


@pytest.mark.parametrize("engine", ["numpy", "opencl"])
@pytest.mark.parametrize("solver", ["sgm", "sgp"])
@pytest.mark.parametrize(
    ("what", "at", "n_iter"),
    [
        ("extended", 1, 200),
        ("images", 1, 200),
        ("extended", 5, 200),
        ("images", 12, 200),
        ("extended", 20, 20),
    ],
)
def test_a_run_ends_before_the_objective_is_not_finite(engine, solver, what, at, n_iter):
    seen = []

    def callback(iteration, estimate):
        seen.append(iteration)
        if iteration == at:
            poison(estimate._run.engine, what)

    keywords = {"solver": solver, "engine": engine, **WITH_STAR}
    with pytest.warns(lnocl.LnoclWarning, match="the objective became infinite or not a n"):
        result = paper(observe(SHAPE_WITH_STAR), n_iter=n_iter, callback=callback, **keywords)
    assert result.stop_reason == "not finite"
    assert at - 1 <= result.n_iter <= at
    assert len(seen) <= min(n_iter, at + 1)
    assert len(result.history) == result.n_iter + 1
    assert np.isfinite(result.history["objective"]).all()
    if result.n_iter:
        expected = paper(observe(SHAPE_WITH_STAR), n_iter=result.n_iter, **keywords)
        assert np.array_equal(result.extended, expected.extended)
        assert np.array_equal(result.star_fluxes, expected.star_fluxes)
        assert np.array_equal(result.history, expected.history)
    assert np.isfinite(result.models()).all()


@pytest.mark.parametrize("engine", ["numpy", "opencl"])
@pytest.mark.parametrize("solver", ["sgm", "sgp"])
def test_a_device_that_always_computes_nan_is_refused(monkeypatch, engine, solver):
    kind = opencl.OpenCLEngine if engine == "opencl" else ReferenceEngine
    ratio = kind._ratio

    def poisoned(self):
        poison(self, "images")
        ratio(self)

    monkeypatch.setattr(kind, "_ratio", poisoned)
    with pytest.raises(lnocl.DeviceError, match=r"the objective .*is infinite or not"):
        paper(observe(), n_iter=20, engine=engine, solver=solver)


@pytest.mark.parametrize("solver", ["sgm", "sgp"])
@pytest.mark.parametrize("what", ["extended", "images"])
def test_non_finite_state_does_not_replace_a_checkpoint(tmp_path, monkeypatch, solver, what):
    """Resumed, the run ends as if nothing had happened."""

    def callback(iteration, estimate):
        if iteration == 7:
            poison(estimate._run.engine, what)

    path = str(tmp_path / "run.fits")
    keywords = {"solver": solver, "n_iter": 12, "stop": 1e-9, **WITH_STAR}
    monkeypatch.setattr(checkpoint, "EVERY", 0.0)
    with pytest.warns(lnocl.LnoclWarning, match="the objective became infinite or not a n"):
        result = paper(observe(SHAPE_WITH_STAR), callback=callback, checkpoint=path, **keywords)
    assert result.stop_reason == "not finite"
    assert 6 <= result.n_iter <= 8
    resumed, expected = (
        paper(observe(SHAPE_WITH_STAR), **keywords, **which) for which in ({"resume": path}, {})
    )
    assert resumed.n_iter == expected.n_iter == 12
    assert np.array_equal(resumed.extended, expected.extended)
    assert np.array_equal(resumed.history, expected.history)
