"""The public function: how it is called, and what it returns."""

import numpy as np
import pytest

import lnocl

OBSERVATION = lnocl.Observation(np.full((8, 8), 5.0), np.ones((1, 1)))


def test_all_but_the_observation_and_the_stars_go_by_name():
    with pytest.raises(TypeError, match="from 1 to 2 positional arguments but 3 were given"):
        lnocl.deconvolve(OBSERVATION, [(3, 3)], 0.1)
