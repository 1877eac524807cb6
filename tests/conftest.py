"""One store of compiled kernels for all test processes and later runs, and one thread for BLAS.

LNOCL_TEST_LOCAL_MEMORY, in bytes, overrides the size of local memory that devices report.
"""

import os
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

os.environ.setdefault(
    "POCL_CACHE_DIR", str(Path(__file__).parents[1] / ".pytest_cache" / "kernels")
)

# Before NumPy is imported: the test processes are as many as the processors.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from lnocl import progress
from lnocl.core.scene.observation import Observation
from lnocl.io.calibration import Calibration

# Lines on progress depend on how long a command takes.
progress.FIRST_LINE = 1e9

if size := os.environ.get("LNOCL_TEST_LOCAL_MEMORY"):
    import pyopencl as cl

    cl.Device.local_mem_size = property(lambda device: int(size))

UNCHECKED = HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.function_scoped_fixture
for profile, examples in {"fast": 5, "exhaustive": 20}.items():
    settings.register_profile(
        profile, max_examples=examples, deadline=None, suppress_health_check=UNCHECKED
    )


def pytest_configure(config):
    fast = "not exhaustive" in config.option.markexpr
    settings.load_profile("fast" if fast else "exhaustive")


def _take_psf_error(error):
    """Have observations, and files that are read, PSFs of another error by default."""
    Observation.__init__.__kwdefaults__["psf_error"] = error
    defaults = Calibration._field_defaults | {"psf_error": error}
    Calibration.__new__.__defaults__ = tuple(defaults.values())


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    """Have PSFs of tests exact, as those of simulations are.

    Tests of PSFs that are not exact give `psf_error`.
    """
    _take_psf_error(0.0)


@pytest.hookimpl(trylast=True)
def pytest_runtest_teardown(item):
    """Give back the default, which examples have: these hooks are of tests alone."""
    _take_psf_error(None)


@pytest.fixture(scope="module")
def few_screens():
    """Average PSFs over few phase screens, in tests of all else."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("lnocl.simulation.fizeau.N_SCREENS", 5)
        yield


# Fixtures that several folders of tests share.
pytest_plugins = ["browsers", "commandline", "frame_files", "program_count", "sound_files"]
