"""The star is found, and its centre, to the errors that the docstring of `make_psf` states.

Tolerances are two to three times the errors measured.
"""

import numpy as np
import pytest
from star_frames import FRACTIONS, STAR, airy, fizeau, gaussian, line, quiet, shifted

from lnocl.errors import InputError
from lnocl.psf.make import make_psf


def test_the_brightest_pixel_is_found_beside_hot_and_bad_ones():
    frame = np.full((40, 50), 3.0)
    frame += 5000 * gaussian(4.0, 36, 12, frame.shape)
    frame[30, 5] = 1e5
    frame[12, 37] = np.nan
    star = make_psf(frame, recentre=False, size=9)
    assert star.steps[0] == "star: brightest pixel of the median-filtered frame, x = 36, y = 12"
    assert star.centre == (36.0, 12.0)


@pytest.mark.parametrize("x", [34.6, 35.0, 35.4])
def test_the_position_chooses_the_star(x):
    two = STAR + 4000 * gaussian(4.0, 50.0, 12.0, STAR.shape)
    star = make_psf(two, position=(x + 14, 14), size=13, background=40.0)
    assert star.centre == pytest.approx((50.0, 12.0), abs=0.02)
    assert line(star, "star") == f"star: given at x = {x + 14:g}, y = 14"


@pytest.mark.parametrize(("x", "y"), FRACTIONS)
@pytest.mark.parametrize(
    ("star", "tolerance"),
    [
        (lambda x, y: shifted(fizeau(30), x, y)[96:161, 96:161], 1e-4),
        (lambda x, y: shifted(fizeau(30, scale=5), x, y)[96:161, 96:161], 1e-4),
        (lambda x, y: shifted(fizeau(30, strehl=0.5), x, y)[96:161, 96:161], 0.01),
        (lambda x, y: airy(4.0, 32 + x, 32 + y), 1e-4),
        (lambda x, y: gaussian(3.0, 32 + x, 32 + y), 1e-4),
        (lambda x, y: gaussian(2.0, 32 + x, 32 + y), 3e-4),
        (lambda x, y: gaussian(1.5, 32 + x, 32 + y), 0.004),
        (lambda x, y: gaussian(1.0, 32 + x, 32 + y), 0.03),
    ],
    ids=["fizeau", "fizeau fine", "strehl 0.5", "airy", "3 px", "2 px", "1.5 px", "1 px"],
)
def test_the_centre_is_found(star, tolerance, x, y):
    frame = star(x, y)
    found = quiet(frame / frame.max(), background=0.0).centre
    assert found == pytest.approx((32 + x, 32 + y), abs=tolerance)


@pytest.mark.parametrize("fwhm", [1.5, 3.0, 8.0])
def test_the_centre_is_found_where_the_position_is_off_by_five_pixels(fwhm):
    for seed in range(8):
        rng = np.random.default_rng(seed)
        off = rng.uniform(-5, 5, 2)
        frame = gaussian(fwhm, 32.3, 31.6) / gaussian(fwhm).max()
        star = quiet(
            frame + rng.normal(0, 0.05, frame.shape),
            background=0.0, position=(32 + off[0], 32 + off[1]), size=21,
        )  # fmt: skip
        assert star.centre == pytest.approx((32.3, 31.6), abs=0.25)


@pytest.mark.exhaustive
def test_the_centre_of_a_clipped_star_is_found_from_its_good_pixels():
    """From the repaired pixels too, it is 0.012 pixels off (rms)."""
    rng = np.random.default_rng(0)
    errors = []
    for x, y in rng.uniform(-0.5, 0.5, (20, 2)):
        frame = gaussian(5.0, 32 + x, 32 + y) / gaussian(5.0).max()
        frame = np.minimum(frame + rng.normal(0, 0.005, frame.shape), 0.5)
        star = quiet(frame, background=0.0, saturation=0.5, size=41)
        errors.append(np.subtract(star.centre, (32 + x, 32 + y)))
    assert np.sqrt(np.mean(np.square(errors))) < 0.007


@pytest.mark.parametrize("seed", range(4))
def test_noise_is_not_taken_for_a_star(seed):
    with pytest.raises(InputError, match=r"^no star is found within 16 pixels"):
        make_psf(np.random.default_rng(seed).normal(0, 1, (65, 65)), background=0.0)


def test_the_centre_of_a_disc_is_not_that_of_its_fringes():
    """Fringes off the centre, as where the two beams are not in phase."""
    ix = np.arange(65)
    disc = airy(12.0, 32.3, 31.8)
    for phase in (0.0, 1.0, 2.0, np.pi):
        fringes = 1 + np.cos(2 * np.pi / 5.0 * (ix - 32.3) + phase)
        assert make_psf(disc * fringes, background=0.0, size=41).centre == pytest.approx(
            (32.3, 31.8), abs=0.06
        )
