"""Variances from the Fisher information, where it is regular, singular or empty."""

import numpy as np

from lnocl.solvers.fluxes import variances

# Two stars whose images overlap by this share, in units far apart.
UNITS = np.array([1.0, 1e6])


def information(share):
    return np.array([[1.0, share], [share, 1.0]]) * UNITS * UNITS[:, None]


def test_regular_information_is_inverted():
    for share in (0.0, 0.5, 1.0 - 1e-9):
        expected = 1.0 / (1.0 - share**2) / UNITS**2
        np.testing.assert_allclose(variances(information(share)), expected, rtol=1e-6)


def test_unknowns_that_stand_in_for_each_other_are_nan_and_others_are_not():
    for share in (1.0, 1.0 - 1e-15):
        three = np.zeros((3, 3))
        three[:2, :2], three[2, 2] = information(share), 4.0
        np.testing.assert_array_equal(variances(three), [np.nan, np.nan, 0.25])


def test_without_information_they_are_infinite():
    np.testing.assert_array_equal(variances(np.diag([0.0, 4.0])), [np.inf, 0.25])
    assert variances(np.zeros((0, 0))).shape == (0,)
