"""Band matrices against dense ones."""

import numpy as np
import pytest

from lnocl.core.scene.band_matrix import BandMatrix


def of_dense(dense, places):
    """Return a dense matrix in band storage, its unknowns put in an order."""
    ordered = np.empty_like(dense)
    ordered[np.ix_(places, places)] = dense
    band = np.zeros(dense.shape, order="F")
    for d in range(len(dense)):
        band[d, : len(dense) - d] = np.diag(ordered, d)
    width = max(np.flatnonzero(band.any(axis=1)), default=0)
    return BandMatrix(np.asfortranarray(band[: width + 1]), np.array(places, int))


def test_it_is_the_dense_matrix_and_its_inverse():
    rng, places = np.random.default_rng(0), np.array([3, 0, 5, 1, 4, 2])
    near = abs(places[:, None] - places) <= 2
    root = rng.normal(size=(6, 20))
    dense = np.where(near, root @ root.T, 0.0) + 20 * np.eye(6)
    matrix, units, x = of_dense(dense, places), rng.uniform(1, 9, 6), rng.normal(size=(6, 2))
    assert matrix.band.shape == (3, 6)
    np.testing.assert_array_equal(matrix.block(slice(None)), dense)
    np.testing.assert_array_equal(matrix.block([4, 0, 2]), dense[np.ix_([4, 0, 2], [4, 0, 2])])
    np.testing.assert_array_equal(matrix.diagonal, np.diag(dense))
    scaled = units[:, None] * units * dense
    np.testing.assert_allclose(matrix.scaled(units).block(slice(None)), scaled, rtol=1e-15)
    np.testing.assert_array_equal((matrix + matrix).block(slice(None)), 2 * dense)
    np.testing.assert_allclose(matrix.solve(x), np.linalg.solve(dense, x), rtol=1e-10)
    np.testing.assert_array_equal(matrix.solve(x[:, 0]), matrix.solve(x)[:, 0])


def test_fluxes_and_positions_may_be_of_any_size():
    """A star of 1e9 and one of 1e-3 of the sky: neither is lost, nor one without information."""
    information = np.array([[4.0, 1.0, 0.0], [1.0, 9.0, 0.0], [0.0, 0.0, 0.0]])
    units = np.array([1e-12, 1e9, 1.0])
    matrix = of_dense(information * units * units[:, None], [1, 0, 2])
    found = matrix.solve(units * [1.0, 2.0, 0.0]) * units
    expected = np.append(np.linalg.solve(information[:2, :2], [1.0, 2.0]), 0.0)
    np.testing.assert_allclose(found, expected, rtol=1e-11, atol=0)


def test_unknowns_that_nothing_tells_apart_share():
    found = of_dense(np.ones((2, 2)), [0, 1]).solve(np.full(2, 3.0))
    np.testing.assert_allclose(found, 1.5, rtol=1e-3)


@pytest.mark.parametrize("seed", range(4))
def test_unknowns_that_are_one_are_summed(seed):
    rng = np.random.default_rng(seed)
    m, width = 11, 3
    owners = rng.permutation(np.append(np.arange(6), rng.integers(0, 6, m - 6)))
    band = np.asfortranarray(rng.uniform(0.1, 1.0, (width + 1, m)))
    band[0] += 2 * width
    matrix = BandMatrix(band, rng.permutation(m))
    tied, which = matrix.tied(owners), np.eye(6)[owners]
    expected = which.T @ matrix.block(slice(None)) @ which
    np.testing.assert_allclose(tied.block(slice(None)), expected, rtol=1e-14)
    x = rng.standard_normal(6)
    np.testing.assert_allclose(tied.solve(x), np.linalg.solve(expected, x), rtol=1e-10)


def test_nothing_is_unknown_and_negative_matrices_are_refused():
    assert BandMatrix(np.zeros((1, 0)), np.zeros(0, int)).solve(np.zeros(0)).shape == (0,)
    with pytest.raises(np.linalg.LinAlgError):
        of_dense(np.array([[1.0, -2.0], [-2.0, 1.0]]), [0, 1]).solve(np.ones(2))
