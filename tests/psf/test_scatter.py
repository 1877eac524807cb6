"""The error of the pixels of PSFs made of stars: against what they are off by, and its unit."""

import numpy as np
import pytest
from star_frames import gaussian, quiet

import lnocl
from lnocl.core.scene.psfs import PSF_ERROR
from lnocl.psf.make import make_psf
from lnocl.psf.scatter import GUESSED

SHAPE, SIZE = (140, 150), 21
PLACES = [(30.3, 30.8), (100.4, 35.1), (45.7, 100.2), (118.6, 88.5), (70.2, 65.7), (28.9, 66.4)]
CORE = np.hypot(*(np.indices((SIZE, SIZE)) - SIZE // 2)) < 3


def truth(fwhm, size=SIZE):
    psf = gaussian(fwhm, size // 2, size // 2, (size, size))
    return psf / psf.sum()


def a_frame(rng, n, flux, gain=1.0, widths=(3.2,)):
    fluxes = flux * rng.uniform(0.5, 1.5, n)
    each = zip(PLACES[:n], fluxes, np.resize(widths, n), strict=True)
    light = sum(c * gaussian(width, x, y, SHAPE) for (x, y), c, width in each)
    return rng.poisson(light + 50.0) / gain


@pytest.mark.exhaustive
@pytest.mark.parametrize(("n", "flux", "gain"), [(1, 1e5, 1.0), (1, 1e4, 7.0), (3, 2e4, 1.0)])
def test_it_is_the_error_of_the_psf_in_core_and_wings(n, flux, gain):
    """Without a gain, by one star too; one of few pixels is known to a third."""
    squares = []
    for seed in range(5):
        rng = np.random.default_rng([seed, n])
        made = make_psf(a_frame(rng, n, flux, gain), PLACES[:n], SIZE)
        parts = (made.psf - truth(3.2)) ** 2, made.scatter**2
        squares.append([[part[there].sum() for there in (CORE, ~CORE)] for part in parts])
    actual, stated = np.sqrt(np.mean(squares, axis=0))
    assert 0.65 < actual[0] / stated[0] < 1.35
    assert actual[1] / stated[1] == pytest.approx(1.0, abs=0.15)


def test_it_falls_with_the_number_of_stars_and_not_with_the_unit():
    frame = a_frame(np.random.default_rng(1), 3, 1e5)
    one, three = (make_psf(frame[:, :125], PLACES[:n], SIZE, background=50.0) for n in (1, 3))
    norms = [np.linalg.norm(each.scatter) for each in (one, three)]
    assert 0.6 < norms[1] / norms[0] * np.sqrt(3) < 1.6
    other = make_psf(frame[:, :125] / 300.0, PLACES[0], SIZE, background=50.0 / 300.0)
    np.testing.assert_allclose(other.scatter, one.scatter, rtol=1e-3, atol=1e-9)


def test_stars_that_differ_show_it_and_fewer_leave_more_room():
    found = []
    for n in (2, 6):
        frame = a_frame(np.random.default_rng(2), n, 1e6, widths=(3.0, 3.4))
        found.append(make_psf(frame, PLACES[:n], SIZE).scatter[CORE])
    differ = np.linalg.norm((truth(3.4) - truth(3.0))[CORE]) / 2  # of each from their mean
    few, many = (np.linalg.norm(each) / differ for each in found)
    assert 0.5 < many < 5.0  # in proportion to the PSF, which widths beside the peak are not
    assert few > 1.1 * many


@pytest.mark.parametrize("n", [2, 4, 6])
def test_the_width_of_stars_that_are_alike_is_known_as_their_number_says(n):
    """With all else of a PSF, by shares of the light; one star is as any PSF."""
    rng = np.random.default_rng(4)
    made = make_psf(a_frame(rng, n, 1e6), PLACES[:n], SIZE)
    fluxes = 1e6 * np.random.default_rng(4).uniform(0.5, 1.5, n)
    expected = PSF_ERROR * np.linalg.norm(fluxes) / fluxes.sum()
    assert made.error == pytest.approx(expected, rel=0.03)
    assert make_psf(a_frame(rng, 1, 1e6), PLACES[0], SIZE).error == PSF_ERROR


@pytest.mark.parametrize("differ", [0.04, 0.15, 0.5])
def test_stars_of_several_widths_raise_the_error_of_the_width(differ):
    frame = a_frame(np.random.default_rng(5), 6, 1e6, widths=(3.2 - differ, 3.2 + differ))
    fluxes = np.random.default_rng(5).uniform(0.5, 1.5, 6)
    shares, widths = fluxes / fluxes.sum(), np.tile([-differ, differ], 3) / 3.2
    variance = shares @ (widths - shares @ widths) ** 2
    expected = np.sqrt(PSF_ERROR**2 * shares @ shares + variance)
    assert make_psf(frame, PLACES, SIZE).error == pytest.approx(expected, rel=0.1)


def test_an_observation_has_the_largest_error_of_its_psfs():
    frame, images = a_frame(np.random.default_rng(6), 4, 1e6), np.full((2, 40, 40), 9.0)
    one, four = (make_psf(frame, PLACES[:n], SIZE) for n in (1, 4))
    for psfs, expected in (
        (four, four.error),
        ([four, four], four.error),
        ([four, one], PSF_ERROR),
        ([four, four.psf], PSF_ERROR),
        (four.psf, PSF_ERROR),
    ):
        assert lnocl.Observation(images, psfs, psf_error=None).psf_error == expected
    assert four.error < 0.7 * PSF_ERROR
    assert lnocl.Observation(images, four, psf_error=0.1).psf_error == 0.1
    exact = lnocl.Observation(images, four, psf_error=0)
    assert exact.psf_error == 0
    assert not len(exact.psf_scatter)


def test_scatter_of_a_pixel_bad_in_all_stars_is_a_guess():
    frame = a_frame(np.random.default_rng(3), 1, 1e5)
    y, x = (round(each) for each in PLACES[0][::-1])
    frame[y + 2, x + 1] = np.nan
    made = quiet(frame, PLACES[0], SIZE)
    at = SIZE // 2 + 2, SIZE // 2 + 1
    assert made.scatter[at] > 0.8 * GUESSED * made.psf[at] > 5 * np.median(made.scatter)


def test_stars_without_noise_have_negligible_scatter():
    made = make_psf(1e5 * gaussian(4.0, 70.2, 65.7, SHAPE), size=SIZE, background=0.0)
    assert made.scatter.max() < 1e-3 * made.psf.max()
