"""Long and many deconvolutions leave nothing behind; benchmarks/leaks.py has ten times as many."""

import gc
import os
from pathlib import Path

import pytest

from lnocl.core.engines import opencl

BENCHMARKS = str(Path(__file__).parents[2] / "benchmarks")
pytestmark = pytest.mark.system

COUNTS = {"iterate": 2000, "deconvolve": 50}


@pytest.fixture
def leaks(monkeypatch):
    monkeypatch.syspath_prepend(BENCHMARKS)
    import leaks

    gc.collect()
    return leaks


@pytest.mark.parametrize("work", COUNTS)
@pytest.mark.parametrize("solver", ["sgm", "sgp"])
def test_memory_and_files_stay_as_they_are(leaks, solver, work):
    row = leaks.measure(getattr(leaks, work), solver, COUNTS[work])
    assert leaks.is_flat(row), row


@pytest.mark.parametrize("kind", ["memory", "files"])
def test_planted_leaks_are_found(leaks, monkeypatch, kind):
    """An engine that keeps a MiB, which is touched, or a file open."""
    kept = []
    genuine = opencl.OpenCLEngine.start

    def start(self, *given):
        kept.append(bytearray(b"x" * 1_000_000) if kind == "memory" else os.open(__file__, 0))
        genuine(self, *given)

    monkeypatch.setattr(opencl.OpenCLEngine, "start", start)
    try:
        row = leaks.measure(leaks.deconvolve, "sgm", COUNTS["deconvolve"])
    finally:
        if kind == "files":
            for each in kept:
                os.close(each)
    assert not leaks.is_flat(row)
    assert (row["most growth, %"] > 1.0) == (kind == "memory")
    assert (row["most files"] > row["files before"]) == (kind == "files")
