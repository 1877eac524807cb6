"""A kernel cache of its own for each test process: PoCL's is not safe to share."""

import atexit
import os
import shutil
import tempfile

os.environ["POCL_CACHE_DIR"] = tempfile.mkdtemp(prefix="lnocl-pocl-")
atexit.register(shutil.rmtree, os.environ["POCL_CACHE_DIR"], ignore_errors=True)
