"""Several threads and several processes that deconvolve at once."""

import os
import subprocess
import sys
import threading
import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from runtimes import on_pocl
from scenes import paper

import lnocl
from lnocl.core.runs.thinning import split_counts
from lnocl.io.fitsread import read_stack

pytestmark = pytest.mark.system


def arguments(seed, n):
    rng = np.random.default_rng(seed)
    images, psfs = rng.poisson(30.0, (2, n, n)), rng.uniform(0.5, 1.0, (2, 3, 3))
    return lnocl.Observation(images, psfs, background=2.0), [(seed, 3)]


def assert_same(one, other):
    assert np.array_equal(one.extended, other.extended)
    assert np.array_equal(one.star_fluxes, other.star_fluxes)
    assert np.array_equal(one.history, other.history)


@pytest.mark.parametrize(
    ("solver", "sizes"),
    [
        ("sgp", (32, 32)),
        ("sgm", (16, 32)),
        pytest.param("sgm", (32, 32), marks=pytest.mark.exhaustive),
        pytest.param("sgp", (16, 32), marks=pytest.mark.exhaustive),
    ],
)
def test_two_threads_are_right(solver, sizes):
    """Bit for bit what each gives alone, begun together so that programs are built together."""
    begin = threading.Barrier(2)

    def together(seed, n):
        begin.wait(60)
        return run(seed, n)

    def run(seed, n):
        observation, stars = arguments(seed, n)
        return paper(observation, stars, solver=solver, n_iter=60)

    with ThreadPoolExecutor(2) as pool:
        found = list(pool.map(together, (4, 7), sizes))
    for result, seed, n in zip(found, (4, 7), sizes, strict=True):
        assert_same(result, run(seed, n))


def test_one_thread_goes_on_where_another_fails():
    observation, stars = arguments(4, 32)

    def fail(iteration, estimate):
        if iteration == 10:
            raise KeyError("mine")

    with ThreadPoolExecutor(2) as pool:
        failing = pool.submit(paper, observation, stars, n_iter=60, callback=fail)
        going = pool.submit(paper, observation, stars, n_iter=60)
    assert isinstance(failing.exception(), KeyError)
    assert_same(going.result(), paper(observation, stars, n_iter=60))


def test_threads_leave_warnings_as_they_were(tmp_path):
    """Both what reads files and what begins halves of counts turns some off for a while."""
    path = tmp_path / "image.fits"
    fits.writeto(path, np.ones((8, 8), np.float32))
    observation, _ = arguments(4, 8)

    def read(_):
        read_stack([str(path)])
        split_counts(observation)

    before = warnings.filters[:], warnings.showwarning, warnings._showwarnmsg_impl
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(read, range(200)))
    assert (warnings.filters, warnings.showwarning, warnings._showwarnmsg_impl) == before


FORK = """
import os, threading
from lnocl.process import LOCK
held = threading.Event()
def hold():
    with LOCK:
        held.set()
        released.wait(1)
released = threading.Event()
threading.Thread(target=hold).start()
held.wait()
if os.fork() == 0:
    with LOCK:
        os._exit(7)
print(os.waitstatus_to_exitcode(os.wait()[1]), LOCK.acquire(timeout=5))
"""


def test_a_process_forked_while_a_thread_is_at_work_does_not_wait_for_it():
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", FORK],
        capture_output=True,
        text=True,
        timeout=30,
        env={**os.environ, "PYTHONPATH": str(Path(lnocl.__file__).parents[1])},
    )
    assert (done.stdout, done.stderr) == ("7 True\n", "")


PROGRAM = """
import hashlib, sys, warnings
import numpy as np
import lnocl
warnings.simplefilter("ignore", lnocl.errors.MisfitWarning)
observation = lnocl.Observation(np.arange(64.0).reshape(8, 8), np.ones((3, 3)), background=1.0)
print("ready", flush=True)
sys.stdin.readline()
result = lnocl.deconvolve(observation, n_iter=20, stop=None)
print(hashlib.sha256(result.extended.tobytes()).hexdigest())
"""


@on_pocl
@pytest.mark.parametrize(
    "attempt",
    [pytest.param(i, marks=[pytest.mark.exhaustive] if i >= 1 else []) for i in range(4)],
)
def test_two_processes_on_a_cold_kernel_cache_are_right(attempt, tmp_path):
    environment = {
        **os.environ,
        "PYTHONPATH": str(Path(lnocl.__file__).parents[1]),
        "POCL_CACHE_DIR": str(tmp_path / "pocl"),
        "XDG_CACHE_HOME": str(tmp_path / "xdg"),
    }
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", PROGRAM],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=environment,
        )
        for _ in range(2)
    ]
    for process in processes:
        assert process.stdout.readline() == "ready\n"
    for process in processes:
        process.stdin.write("go\n")
        process.stdin.flush()
    said = [process.communicate(timeout=120) for process in processes]
    assert [process.returncode for process in processes] == [0, 0], said
    assert said[0] == said[1]
    assert not said[0][1]
    # One file a program, whichever came last: of kernels that are needed first, and last.
    assert len(list((tmp_path / "pocl").glob("*.kernels"))) == 2
