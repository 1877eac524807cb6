"""Light beyond the file of a PSF, and levels in it, beside analytic functions."""

import numpy as np
import pytest
from scipy.special import j0, j1

from lnocl.core.scene.psf_edge import psf_edge

SHAPES = (32, 32), (48, 71), (61, 61)


def radii(shape):
    return np.hypot(*np.ogrid[tuple(slice(-(n // 2), n - n // 2) for n in shape)])


def moffat(shape, beta, fwhm=3.5):
    """Return a Moffat function whose light over the whole plane is 1."""
    squares = (0.5 * fwhm) ** 2 / (2.0 ** (1.0 / beta) - 1.0)
    return (beta - 1.0) / np.pi / squares * (1.0 + radii(shape) ** 2 / squares) ** -beta


def gaussian(shape, sigma):
    return np.exp(-0.5 * (radii(shape) / sigma) ** 2) / (2.0 * np.pi * sigma**2)


def airy(shape, resolution):
    """Return an Airy disc of lambda / D pixels whose light over the whole plane is 1."""
    v = np.pi * np.maximum(radii(shape), 1e-9) / resolution
    return np.pi / 4.0 / resolution**2 * (2.0 * j1(v) / v) ** 2


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("beta", [1.5, 2.0, 2.5, 3.0, 4.0])
def test_light_beyond_is_that_of_the_function(shape, beta):
    psf = moffat(shape, beta)
    edge = psf_edge(psf)
    assert edge.share == pytest.approx(1.0 - psf.sum(), rel=0.3, abs=1e-5)
    assert abs(edge.share - (1.0 - psf.sum())) < 2.0 * edge.light_error
    assert abs(edge.level) < 2e-3


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("beta", [1.5, 2.0, 3.0])
@pytest.mark.parametrize("level", [0.05, -0.01])
def test_constant_level_is_distinguished_from_wings(shape, beta, level):
    psf = moffat(shape, beta)
    beyond = 1.0 - psf.sum()
    psf *= (1.0 - level) / psf.sum()
    edge = psf_edge(psf + level / psf.size)
    assert edge.level == pytest.approx(level, abs=5e-3)
    assert abs(edge.level - level) < 2.0 * edge.level_error
    assert edge.share == pytest.approx(beyond, rel=0.2, abs=1e-5)


@pytest.mark.parametrize("width", [45.0, 60.0])
def test_a_halo_that_is_flat_within_the_file_is_no_level_for_sure(width):
    """It falls beyond the file, and no file tells it from a level."""
    shape = 45, 52
    edge = psf_edge(0.85 * airy(shape, 2.0) + 0.15 * moffat(shape, 2.0, width))
    assert abs(edge.level) < 2.0 * edge.level_error
    assert edge.light > 0.03


@pytest.mark.parametrize("shape", SHAPES)
def test_a_gaussian_has_neither(shape):
    edge = psf_edge(gaussian(shape, 2.0))
    assert edge.light < 1e-6
    assert abs(edge.level) < 1e-4
    edge = psf_edge(0.95 * gaussian(shape, 2.0) + 0.05 / np.prod(shape))
    assert edge.light < min(2e-4, 2.0 * edge.light_error)
    assert edge.level == pytest.approx(0.05, abs=2e-4)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("resolution", [2.0, 3.5])
def test_the_error_holds_the_light_of_an_airy_disc(shape, resolution):
    psf = airy(shape, resolution)
    v = np.pi * (min(shape) // 2) / resolution
    edge = psf_edge(psf)
    assert edge.light < 2.0 * (j0(v) ** 2 + j1(v) ** 2)
    assert abs(edge.share - (1.0 - psf.sum())) < 2.5 * edge.light_error


def test_the_wing_goes_on_where_the_file_ends():
    large = moffat((101, 96), 2.0)
    psf = large[50 - 16 : 50 + 17, 48 - 20 : 48 + 21]
    edge = psf_edge(psf)
    wing = edge.wing(large.shape) * psf.sum()
    inside = np.zeros(large.shape, bool)
    inside[50 - 16 : 50 + 17, 48 - 20 : 48 + 21] = True
    assert not wing[inside].any()
    np.testing.assert_allclose(wing[~inside], large[~inside], rtol=0.2)
    assert edge.wing((2001, 2000)).sum() == pytest.approx(edge.light, rel=1e-2)
    assert not edge.wing(psf.shape).any()
    assert not edge.wing((9, 12)).any()


def test_a_file_ends_where_it_is_zero_to_the_edge():
    """As beyond a circle, or in rows that made it as large as another."""
    shape = 64, 60
    psf = moffat(shape, 2.0)
    psf[radii(shape) > 22.0] = 0.0
    psf[:20] = 0.0
    edge = psf_edge(psf)
    np.testing.assert_array_equal(edge.known, psf > 0.0)
    assert edge.radius == pytest.approx(12.5)
    assert edge.share == pytest.approx(1.0 - psf.sum(), rel=0.25)
    wing = edge.wing(shape) * psf.sum()
    np.testing.assert_allclose(wing[psf == 0.0], moffat(shape, 2.0)[psf == 0.0], rtol=0.35)


def test_zeros_among_clipped_noise_are_within_the_file():
    noise = np.random.default_rng(5).normal(scale=1e-5, size=(41, 41))
    edge = psf_edge(np.maximum(gaussian((41, 41), 1.5) + noise, 0.0))
    assert edge.known.mean() > 0.97
    level = 1681 * 1e-5 / np.sqrt(2.0 * np.pi)
    assert abs(edge.level - level) < edge.level_error < 0.8 * level


@pytest.mark.parametrize("beta", [2.0, 3.0])
def test_errors_hold_the_truth_of_noisy_psfs(beta):
    rng, psf = np.random.default_rng(8), moffat((45, 52), beta)
    beyond = 1.0 - psf.sum()
    psf /= psf.sum()
    pulls = []
    for level in 8 * (0.0, 0.03):
        noise = rng.normal(scale=3e-4 * psf.max(), size=psf.shape)
        edge = psf_edge((1.0 - level) * psf + level / psf.size + noise)
        pulls.append(
            [(edge.share - beyond) / edge.light_error, (edge.level - level) / edge.level_error]
        )
    rms = np.sqrt(np.mean(np.square(pulls), axis=0))
    assert ((rms > 0.3) & (rms < 1.4)).all()


def test_psf_without_complete_rings_has_no_edge_light_or_level():
    point = np.zeros((15, 15))
    point[7, 7] = 3.0
    for psf in (point, point[7:8, 7:8], moffat((7, 30), 2.0)):
        edge = psf_edge(psf)
        assert edge.light == edge.light_error == edge.level == edge.level_error == 0.0
        assert not edge.wing((20, 40)).any()
