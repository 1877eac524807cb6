"""Free pixels of PSFs: their light, their scatter, and the transpose."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad

from lnocl.core.scene.psf_pixels import CORRELATED, PsfPixels


def pixels(shape=(16, 20)):
    rng = np.random.default_rng(0)
    psfs, scatter = rng.uniform(0.1, 1.0, (2, 2, *shape))
    return PsfPixels(psfs / psfs.sum(axis=(1, 2), keepdims=True), scatter, 1)


@given(st.integers(0, 2**32), st.integers(5, 21), st.integers(5, 21), st.integers(0, 1))
def test_the_adjoint_is_the_transpose(seed, ny, nx, j):
    found, rng = pixels((ny, nx)), np.random.default_rng(seed)
    field, image = rng.standard_normal((2, ny, nx))
    one = (found.correction(j, field) * image).sum()
    other = (field * found.adjoint(j, image)).sum()
    assert one == pytest.approx(other, rel=1e-9, abs=1e-12)


def test_no_light_is_won_or_lost():
    field = np.random.default_rng(1).standard_normal((16, 20))
    for j in range(2):
        assert pixels().correction(j, field).sum() == pytest.approx(0.0, abs=1e-12)


def test_corrections_have_the_scatter_and_are_correlated():
    shape = (64, 64)
    psf = np.zeros((1, *shape))  # with which nothing is taken back
    scatter = np.linspace(0.5, 2.0, 64)[:, None] * np.ones((1, *shape))
    found = PsfPixels(psf, scatter, 1)
    rng = np.random.default_rng(2)
    draws = np.array([found.correction(0, rng.standard_normal(shape)) for _ in range(300)])
    np.testing.assert_allclose(draws.std(axis=0).mean(axis=1), scatter[0, :, 0], rtol=0.05)
    white = draws / scatter
    neighbours = (white * np.roll(white, 1, axis=2)).mean()

    def moment(wave):  # of the power up to the highest frequency
        power = lambda f: np.exp(-2 * (np.pi * CORRELATED * f) ** 2) * wave(f)  # noqa: E731
        return quad(power, 0.0, 0.5)[0]

    expected = moment(lambda f: np.cos(2 * np.pi * f)) / moment(np.ones_like)
    assert neighbours == pytest.approx(expected, abs=0.01)
