"""Programs that tests run in a process of their own."""

import os
import subprocess
import sys
from pathlib import Path

import lnocl


def run_python(code, *arguments, cwd=None, **environment):
    """Run a program in a process of its own, which has a kernel cache of its own."""
    return subprocess.run(
        [sys.executable, "-c", PRELUDE + code, *arguments],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": str(Path(lnocl.__file__).parents[1]), **environment},
        cwd=cwd,
        timeout=120,
    )


PRELUDE = """
import os, sys, warnings
import numpy as np
import lnocl
from functools import partial
paper = partial(lnocl.deconvolve, solver="sgm", stop=None, smoothing=0.0, pad=0)
warnings.simplefilter("ignore", lnocl.errors.MisfitWarning)
observation = lnocl.Observation(np.arange(256.0).reshape(16, 16), np.ones((3, 3)))
def deconvolve(n_iter=3):
    return paper(observation, n_iter=n_iter).extended.sum()
"""
