"""Where the cores of PSFs are, and how wide, and what becomes of those off their centre."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import lnocl
from lnocl.core.scene.cores import fwhm, off_centre
from lnocl.core.scene.psfs import FAR_OFF_CENTRE, LITTLE_OFF_CENTRE
from lnocl.errors import LnoclWarning


def gaussian(shape=(33, 34), width=4.0, x=0.0, y=0.0):
    rows, columns = np.indices(shape)
    square = (columns - shape[1] // 2 - x) ** 2 + (rows - shape[0] // 2 - y) ** 2
    return np.exp(-4 * np.log(2) * square / width**2)


@given(
    x=st.floats(-5, 5), y=st.floats(-5, 5), width=st.floats(2.5, 8.0), scale=st.floats(1e-9, 1e9)
)
def test_the_offset_of_a_gaussian_is_measured(x, y, width, scale):
    """Measured over 10,000: within 0.07 pixels for 2.5 pixels of width, 0.02 for 4 and more."""
    found = off_centre(scale * gaussian(width=width, x=x, y=y))
    np.testing.assert_allclose(found, (x, y), atol=0.1 if width < 4 else 0.03)


def test_a_ghost_is_no_part_of_the_core():
    ghost = 0.6 * gaussian(x=10.0, y=-9.0)
    np.testing.assert_allclose(off_centre(gaussian() + ghost), (0.0, 0.0), atol=0.01)
    assert fwhm(gaussian() + ghost) == pytest.approx(4.0, abs=0.1)


@given(width=st.floats(2.0, 8.0), x=st.floats(-0.5, 0.5))
def test_the_width_of_a_gaussian_is_measured(width, x):
    assert fwhm(gaussian(width=width, x=x)) == pytest.approx(width, rel=0.1, abs=0.1)


@pytest.mark.parametrize("shape", [(1, 1), (3, 3), (1, 5), (5, 1)])
def test_flat_psfs_of_odd_sides_are_centred(shape):
    np.testing.assert_allclose(off_centre(np.ones(shape)), 0.0, atol=1e-15)


def observe(psf, **given):
    return lnocl.Observation(np.ones((1, 40, 40)), psf, **given)


OFF = {
    "0.3": (gaussian(x=0.3), (0.3, 0.0)),
    "half a pixel": (gaussian(x=-0.5, y=-0.5), (-0.5, -0.5)),
    "1": (gaussian(x=1.0), (1.0, 0.0)),
    "5": (gaussian(y=5.0), (0.0, 5.0)),
    "peak at N / 2 - 1": (np.roll(gaussian((32, 32)), (-1, -1), (0, 1)), (-1.0, -1.0)),
    "FFT order": (np.fft.ifftshift(gaussian((32, 32))), (-15.0, -15.0)),
}


@pytest.mark.parametrize("case", OFF)
def test_a_psf_off_its_centre_is_refused_or_warned_of(case):
    psf, (x, y) = OFF[case]
    distance = np.hypot(x, y)
    words = "the core of psf 0 lies .* pixels off its centre .* take psf_centre fit to centre it"
    if distance >= FAR_OFF_CENTRE:
        with pytest.raises(lnocl.InputError, match=words):
            observe(psf)
    else:
        assert distance > LITTLE_OFF_CENTRE
        with pytest.warns(LnoclWarning, match=words):
            observe(psf)


@pytest.mark.parametrize("case", OFF)
def test_a_psf_is_centred_on_request(case):
    psf, _ = OFF[case]
    found = observe(psf, psf_centre="fit").psfs[0]
    expected = gaussian(psf.shape)
    assert abs(np.array(off_centre(found))).max() < 0.03
    np.testing.assert_allclose(found, expected / expected.sum(), atol=0.02 * found.max())
    assert found.sum() == pytest.approx(1.0, rel=1e-9)


@pytest.mark.parametrize("case", OFF)
def test_a_psf_is_taken_as_given_on_request(case):
    psf, _ = OFF[case]
    np.testing.assert_array_equal(observe(psf, psf_centre="given").psfs[0], psf / psf.sum())


def test_the_worst_of_several_is_named():
    psfs = [gaussian((32, 32)), gaussian((32, 32), x=2.0), gaussian((32, 32), y=1.0)]
    with pytest.raises(lnocl.InputError, match=r"psf 1 lies \(2\.00, 0\.00\) pixels off its centre "
                                               r"\(16, 16\), and would"):  # fmt: skip
        lnocl.Observation(np.ones((3, 40, 40)), psfs)


def test_other_words_are_refused():
    with pytest.raises(lnocl.InputError, match="psf_centre 'no' is not known; choose from check"):
        observe(gaussian(), psf_centre="no")
