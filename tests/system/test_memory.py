"""Memory that a run takes, as benchmarks/memory.py measures it."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
from runtimes import on_pocl

BENCHMARKS = str(Path(__file__).parents[2] / "benchmarks")
pytestmark = [on_pocl, pytest.mark.system]


def test_the_peak_is_announced(monkeypatch, tmp_path):
    """With no kernel compiled before: what other tests leave would change both figures."""
    monkeypatch.setenv("POCL_CACHE_DIR", str(tmp_path))
    monkeypatch.syspath_prepend(BENCHMARKS)
    import memory

    peak, device, host, _ = memory.measure(4096, 2, "sgm", "none")
    assert abs(peak / (device + host) - 1.0) < 0.1


RUN = """
import logging, sys
import numpy as np
import lnocl
logging.basicConfig(level=logging.INFO, stream=sys.stdout)
logging.getLogger("lnocl").setLevel(logging.DEBUG)
n, p, error = map(float, sys.argv[1:])
n, p = int(n), int(p)
rng = np.random.default_rng(0)
y, x = np.indices((41, 41)) - 20
psf = np.exp(-(x**2 + y**2) / 3.2)
images = rng.poisson(50.0, (p, 256, 256))
observation = lnocl.Observation(images, psf, background=40.0, psf_error=error)
lnocl.deconvolve(observation, rng.uniform(5, 250, (n, 2)), n_iter=3, stop=None, smoothing=0)
# That of resource is at least what the process had that began this one.
print("peak", next(int(s.split()[1]) for s in open("/proc/self/status") if "VmHWM" in s) / 1024)
"""


@pytest.mark.parametrize(("n", "p", "error"), [(0, 1, 0.03), (1500, 1, 0.0), (150, 4, 0.03)])
def test_memory_estimate_is_within_a_third_of_the_measured_peak(n, p, error):
    """Before, 1000 and 3000 stars were said to take as much as none, a third of their memory."""
    command = [sys.executable, "-c", RUN, str(n), str(p), str(error)]
    # The first may compile kernels, which takes 100 MiB more.
    for _ in range(2):
        done = subprocess.run(command, capture_output=True, text=True, check=True)
    device, host = map(float, re.findall(r"([\d.]+) MiB", done.stdout))
    peak = float(re.search(r"peak ([\d.]+)", done.stdout)[1])
    assert 1 / 1.3 < peak / (device + host) < 1.3
