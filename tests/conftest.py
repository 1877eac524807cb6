"""One store of compiled kernels for all test processes and later runs.

LNOCL_TEST_LOCAL_MEMORY, in bytes, overrides the size of local memory that devices report.
"""

import os
from pathlib import Path

os.environ.setdefault(
    "POCL_CACHE_DIR", str(Path(__file__).parents[1] / ".pytest_cache" / "kernels")
)

if size := os.environ.get("LNOCL_TEST_LOCAL_MEMORY"):
    import pyopencl as cl

    cl.Device.local_mem_size = property(lambda device: int(size))

# Fixtures that several folders of tests share.
pytest_plugins = ["commandline", "frame_files", "sound_files"]
