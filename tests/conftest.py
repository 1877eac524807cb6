"""One store of compiled kernels for all test processes and later runs."""

import os
from pathlib import Path

os.environ.setdefault(
    "POCL_CACHE_DIR", str(Path(__file__).parents[1] / ".pytest_cache" / "kernels")
)
