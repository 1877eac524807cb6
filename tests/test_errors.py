"""Warnings point to the line of the user's own code, however deep they arise."""

import inspect

import numpy as np
import pytest
from scenes import paper

import lnocl


@pytest.mark.parametrize(
    "call",
    [
        pytest.param(
            lambda: lnocl.Observation(np.diag([np.nan] * 8) + 1.0, np.ones((1, 1))), id="shallow"
        ),
        pytest.param(
            lambda: paper(
                lnocl.Observation(np.ones((8, 8)), np.ones((31, 31))), n_iter=1, engine="numpy"
            ),
            id="deep",
        ),
    ],
)
def test_warnings_point_to_the_caller(call):
    with pytest.warns(lnocl.LnoclWarning) as told:
        call()
    first = inspect.getsourcelines(call)[1]
    assert told[0].filename == __file__
    assert first <= told[0].lineno <= first + 4
