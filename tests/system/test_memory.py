"""Memory that a run takes, as benchmarks/memory.py measures it."""

from pathlib import Path

import pytest
from runtimes import on_pocl

from lnocl.engines.opencl import LIBRARIES

BENCHMARKS = str(Path(__file__).parents[2] / "benchmarks")
pytestmark = [on_pocl, pytest.mark.system]


def test_the_peak_is_announced(monkeypatch):
    monkeypatch.syspath_prepend(BENCHMARKS)
    import memory

    peak, device, host, arrays = memory.measure(4096, 2, "sgm", "none")
    assert abs(peak / (device + host) - 1.0) < 0.1
    assert host - LIBRARIES / memory.MIB < 1.2 * arrays
