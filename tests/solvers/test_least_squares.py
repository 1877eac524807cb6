"""Least squares of stars and fields: what their rounding depends on."""

import os
import subprocess
import sys

import numpy as np
import pytest

from lnocl.solvers.least_squares import LevelError

SCRIPT = """
import hashlib
import numpy as np
from lnocl.solvers.least_squares import LeastSquares, LinearImage

class Field:
    at = np.zeros((256, 256))
    def forward(self, x):
        return x[None]
    def adjoint(self, images):
        return images[0]

rng = np.random.default_rng(0)
slopes, left = rng.standard_normal((12, 256 * 256)), rng.standard_normal((256, 256))
image = LinearImage(slopes, np.arange(12), left, rng.random((256, 256)))
fit = LeastSquares([image], [Field()], np.zeros(12), 20, 1e-9)
change, fields = fit.solve(np.zeros(12))
for values in fit.information, change, *fields:
    print(hashlib.sha256(np.ascontiguousarray(values)).hexdigest())
"""


def test_threads_of_blas_change_no_bit():
    found = {
        subprocess.run(
            [sys.executable, "-c", SCRIPT],
            env={**os.environ, "OPENBLAS_NUM_THREADS": str(n), "OMP_NUM_THREADS": str(n)},
            capture_output=True,
            check=True,
            text=True,
        ).stdout
        for n in (1, 2)
    }
    assert len(found) == 1
    assert len(found.pop().splitlines()) == 3


def test_a_level_is_the_transpose_of_its_effect():
    rng = np.random.default_rng(2)
    level = LevelError(0.7, np.array([1.5, 0.4, 2.0]), (6, 9))
    images = rng.standard_normal((3, 6, 9))
    forward = (level.forward(np.array([1.3])) * images).sum()
    assert forward == pytest.approx(1.3 * level.adjoint(images)[0], rel=1e-13)
