"""Variances from the Fisher information, where it is regular, singular or empty."""

import numpy as np
import pytest
import scipy.optimize

from lnocl.core.scene.band_matrix import BandMatrix
from lnocl.core.solvers.fluxes import MAX_FADING, best_step, variances

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


@pytest.mark.parametrize("seed", range(5))
def test_a_best_step_is_the_best_within_the_bounds(seed):
    """Of neighbours, some of which would fall by more than their bounds."""
    n, rng = 12, np.random.default_rng(seed)
    band = np.asfortranarray([rng.uniform(3, 5, n), rng.uniform(-1, 1, n), rng.uniform(-1, 1, n)])
    matrix = BandMatrix(band, rng.permutation(n))
    gradient, fluxes = rng.uniform(-8, 15, n), rng.uniform(0.1, 3, n)
    step, least = best_step(matrix, gradient, fluxes), (MAX_FADING - 1) * fluxes
    whole = matrix.block(slice(None))
    root = np.linalg.cholesky(whole).T
    target = -np.linalg.solve(root.T, gradient) - root @ least
    expected = least + scipy.optimize.nnls(root, target)[0]
    assert (step >= least).all()
    assert 0 < np.count_nonzero(step == least) < n

    def value(change):
        return float(gradient @ change + 0.5 * change @ whole @ change)

    # Pushes end where fluxes are bounded to a thousandth; measured: 5.9e-6.
    assert value(step) - value(expected) <= 1.2e-5 * abs(value(expected))
    free = np.linalg.solve(whole, -gradient)
    np.testing.assert_allclose(best_step(matrix, gradient, 1e3 * fluxes), free, rtol=1e-10)


def test_a_flux_near_nothing_falls_as_far_as_any():
    """The step of one star is then smaller than the rounding of what it would be unbounded."""
    information = BandMatrix(np.array([[2.0, 3.0], [0.5, 0.0]]), np.arange(2))
    fluxes = np.array([1e-14, 1e5])
    for gradient in np.random.default_rng(1).uniform(1e3, 9e3, 50):
        step = best_step(information, np.array([gradient, -4e3]), fluxes)
        assert step[0] == (MAX_FADING - 1.0) * fluxes[0]
        assert step[1] > 0
