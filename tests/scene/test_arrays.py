"""Checks of what callers give."""

import numpy as np
import pytest

from lnocl.core.scene.arrays import whole
from lnocl.errors import InputError


@pytest.mark.parametrize("value", [3, 7, np.int64(7), np.uint8(3), np.array(7)])
def test_whole_numbers_from_the_least_on_are_taken(value):
    taken = whole("size", value, 3)
    assert (taken, type(taken)) == (int(value), int)


@pytest.mark.parametrize("value", [2, -7, 7.0, "7", None, True, np.True_, np.array([7]), np.nan])
def test_invalid_whole_numbers_are_refused_with_the_valid_range(value):
    with pytest.raises(InputError) as caught:
        whole("size", value, 1 if value is True else 3, ", or auto")
    least = 1 if value is True else 3
    assert caught.value.message == (
        f"`size` must be a whole number, {least} or more, or auto; {value} was given"
    )
