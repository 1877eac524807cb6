"""A PSF looked at by itself: numbers that are known, and faults that were made on purpose."""

import numpy as np
import pytest
from star_frames import gaussian

from lnocl.errors import InputError
from lnocl.psf import examine

SIDE = 65
Y, X = np.indices((SIDE, SIDE)) - SIDE // 2
R = np.hypot(X, Y)
MOFFAT = (1 + (R / 3.0) ** 2) ** -3.0
FAULTS = {
    "nothing": (MOFFAT, None),
    "a little off": (np.roll(MOFFAT, 1, 1) + 2 * MOFFAT, "0.3"),
    "far off": (np.roll(MOFFAT, (2, -1), (0, 1)), "2.24 pixels off its centre, and is refused"),
    "undersampled": (gaussian(1.4, 32, 32), "it is undersampled"),
    "negative": (MOFFAT - 0.1 * ((X == 9) & (abs(Y) < 9)), "many of its pixels are negative"),
    "background": (MOFFAT + 1e-3, "its border is level"),
    "cut": ((1 + R**2 / 4) ** -1.3, "its wings are cut off"),
}  # fmt: skip


def test_numbers_of_a_gaussian():
    report = examine(1e-3 * gaussian(5.0, 32.4, 31.9))
    assert report.shape == (SIDE, SIDE)
    assert report.off_centre == pytest.approx((0.4, -0.1), abs=0.02)
    assert report.fwhm == pytest.approx(5.0, rel=0.03)
    assert report.negative == 0


def test_shares_of_its_light():
    psf = MOFFAT / MOFFAT.sum()
    level = 0.1 / SIDE**2
    assert examine(psf + level).border == pytest.approx(0.1 / 1.1, rel=0.02)
    assert examine(psf + level).fall == pytest.approx(0, abs=0.05)
    assert examine((1 + R**2 / 4) ** -1.5).fall == pytest.approx(3, rel=0.15)
    rng = np.random.default_rng(1)
    noise = 0.1 / SIDE**2 * rng.standard_normal(psf.shape)
    assert examine(psf + noise).noise == pytest.approx(abs(noise).sum(), rel=0.1)
    holed = psf.copy()
    holed[10, 10:20] = -0.001
    assert examine(holed).negative == pytest.approx(0.01 / holed.sum())


@pytest.mark.parametrize("scale", [1e-200, 1.0, 1e200])
def test_the_unit_does_not_matter(scale):
    once = examine(MOFFAT + 1e-3)
    np.testing.assert_allclose(examine(scale * (MOFFAT + 1e-3))[2:], once[2:], rtol=1e-12)


@pytest.mark.parametrize(("psf", "said"), FAULTS.values(), ids=FAULTS)
def test_psf_faults_are_reported(psf, said):
    found = examine(psf).faults()
    assert len(found) == (said is not None)
    assert said is None or said in found[0]


def test_noise_is_reported_with_the_negative_pixels_that_it_causes():
    noise = 2e-3 * np.random.default_rng(2).standard_normal(MOFFAT.shape)
    negative, noisy = examine(MOFFAT + noise).faults()
    assert "negative" in negative
    assert "its wings are noise" in noisy
    side = int(noisy.partition(" or of ")[2].split()[0])
    assert side == int(SIDE * (0.15 / examine(MOFFAT + noise).noise) ** 0.5)


@pytest.mark.parametrize("shape", [(1, 1), (3, 3), (2, 5), (6, 4)])
def test_the_smallest_have_a_report_too(shape):
    psf = np.full(shape, 0.1)
    psf[shape[0] // 2, shape[1] // 2] = 1.0
    assert all(isinstance(line, str) for line in [*examine(psf).lines(), *examine(psf).faults()])


@pytest.mark.parametrize("psf", [np.ones((2, 3, 3)), np.zeros((3, 3)), [[np.nan, 1.0]], [1.0], []])
def test_invalid_psf_is_refused(psf):
    with pytest.raises(InputError, match="must be one image of finite numbers"):
        examine(psf)
