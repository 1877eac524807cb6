"""Shift and rotation against PSFs that are known, and the ringing that is left."""

import math
import warnings

import numpy as np
import pytest
from star_frames import FRACTIONS, STAR, fizeau, gaussian, line, quiet

from lnocl.errors import InputError, LnoclWarning
from lnocl.psf.make import make_psf
from lnocl.psf.resampling import shift
from lnocl.psf.steps import MARGIN


def test_light_that_adds_up_to_nothing_can_be_shifted():
    image = np.zeros((9, 9))
    image[4, 4], image[2, 2] = 1.0, -1.0
    assert np.isfinite(shift(image, (0.3, -0.2))).all()


@pytest.mark.parametrize(("x", "y"), FRACTIONS)
def test_the_shift_is_that_of_the_sampled_psf(x, y):
    expected = gaussian(3.0)[17:48, 17:48]
    star = make_psf(gaussian(3.0, 32 + x, 32 + y), size=31, background=0.0)
    assert np.abs(star.psf - expected / expected.sum()).max() < 4e-4 * expected.max()


def test_edges_do_not_wrap():
    """A bright neighbour just outside the crop stays outside."""
    frame = gaussian(3.0, 32.5, 32.5, (80, 80))
    clean = make_psf(frame, size=21, background=0.0, position=(32.5, 32.5)).psf
    frame[:, 32 + 10 + MARGIN + 2 :] += frame.max()
    star = make_psf(frame, size=21, background=0.0, position=(32.5, 32.5))
    assert np.abs(star.psf - clean).max() < 0.012 * clean.max()


def test_a_crop_that_ends_with_the_frame_is_shifted_as_in_a_larger_one():
    frame = gaussian(20.0, 60.6, 60.6, (121, 121))
    whole = make_psf(frame, size=30, background=0.0)
    small = make_psf(frame[46:76, 46:76], size=30, background=0.0, position=(15, 15))
    assert whole.centre == pytest.approx((60.6, 60.6), abs=1e-6)
    assert small.centre == pytest.approx((14.6, 14.6), abs=0.05)
    assert np.abs(small.psf - whole.psf).max() < 0.03 * whole.psf.max()


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    ("fwhm", "peak", "flux"),
    [(1.0, 8, 26), (1.5, 1.8, 7.6), (2.0, 0.38, 1.6), (2.5, 0.04, 0.18), (3.0, 0.003, 0.016)],
)
def test_an_undersampled_star_rings_as_the_docstring_says(fwhm, peak, flux):
    shifts = [(x, y) for x in (-0.5, -0.4, 0.3, 0.5) for y in (0.2, 0.3, 0.5)]
    stars = [quiet(gaussian(fwhm, 32 + x, 32 + y), background=0.0).psf for x, y in shifts]
    assert -100 * min(psf.min() / psf.max() for psf in stars) == pytest.approx(peak, rel=0.1)
    assert -100 * min(psf.clip(max=0).sum() for psf in stars) == pytest.approx(flux, rel=0.1)


@pytest.mark.parametrize(("fwhm", "rotate"), [(1.0, 0.0), (1.5, 0.0), (1.5, 30.0)])
def test_ringing_is_warned_of(fwhm, rotate):
    frame = gaussian(fwhm, 32.4, 31.7)
    with pytest.warns(LnoclWarning, match="^the PSF rings: negative pixels hold"):
        make_psf(frame, background=0.0, rotate=rotate)
    with pytest.warns(LnoclWarning, match="ring") if rotate else warnings.catch_warnings():
        kept = make_psf(frame, background=0.0, rotate=rotate, recentre=False).psf
    assert (kept.min() < 0) == (rotate != 0)


@pytest.mark.parametrize("rotate", [0.0, 45.0])
def test_noise_is_not_taken_for_ringing(rotate):
    frame = gaussian(3.0, 32.4, 31.7) / gaussian(3.0).max()
    for seed in range(5):
        noise = np.random.default_rng(seed).normal(0, 0.02, frame.shape)
        make_psf(frame + noise, background=0.0, size=41, rotate=rotate)


@pytest.mark.parametrize(
    ("scale", "angle", "tolerance"), [(9.0, 45, 8e-5), (9.0, 10, 8e-5), (5.0, -100, 8e-5)]
)
def test_a_rotated_fizeau_psf_is_that_of_the_rotated_baseline(scale, angle, tolerance):
    options = {"size": 97, "background": 0.0}
    found = make_psf(fizeau(0, scale=scale), rotate=angle, **options)
    expected = make_psf(fizeau(angle, scale=scale), **options)
    assert np.abs(found.psf - expected.psf).max() < tolerance * expected.psf.max()
    assert found.flux == pytest.approx(expected.flux, abs=1e-4)


def test_sharpness_change_by_a_rotation_is_reported():
    star = quiet(STAR, size=21, rotate=405.0)
    assert line(star, "rotation").startswith("rotation: 45 degrees; its sharpness")
    change = float(line(star, "rotation").split("changed by ")[1].split()[0])
    assert abs(change) < 0.05
    undersampled = [
        quiet(gaussian(1.0), size=21, rotate=angle, background=0.0, recentre=False).psf
        for angle in (0.0, 45.0)
    ]
    y, x = np.mgrid[:21, :21] - 10
    disc = np.hypot(x, y) <= 10
    before, after = ((psf[disc] ** 2).sum() / psf[disc].sum() ** 2 for psf in undersampled)
    star = quiet(gaussian(1.0), size=21, rotate=45.0, background=0.0, recentre=False)
    change = float(line(star, "rotation").split("changed by ")[1].split()[0])
    assert abs(change) > 0.1
    assert change == pytest.approx(100 * (after / before - 1), abs=1e-4)


def test_corners_of_a_rotated_psf_are_of_the_frame():
    """A plane, rotated, is a plane up to its corners."""
    ix = np.arange(101) - 50
    frame = 100.0 + ix + 1e4 * gaussian(3.0, 50, 50, (101, 101))
    star = make_psf(frame, size=41, rotate=30.0, background=0.0, position=(50, 50), recentre=False)
    y, x = np.mgrid[:41, :41] - 20
    expected = 100 + x * math.cos(math.pi / 6) + y * math.sin(math.pi / 6)
    far = np.hypot(x, y) > 12
    assert np.abs(star.psf * star.flux - expected)[far].max() < 5


def test_a_rotated_crop_must_lie_in_the_frame():
    frame = gaussian(3.0)
    largest = len(make_psf(frame, background=0.0, rotate=45.0).psf)
    assert largest == 45
    make_psf(frame, background=0.0, rotate=45.0, size=largest)
    with pytest.raises(InputError, match=r"rotated by 45 degrees, .* a size of 45 or less"):
        make_psf(frame, background=0.0, rotate=45.0, size=largest + 1)


def test_a_flat_source_is_one_and_is_masked_whole():
    frame = gaussian(3.0, 32.5, 32.5, (80, 80))
    clean = make_psf(frame, size=41, background=0.0, position=(32.5, 32.5)).psf
    frame[28:37, 44:64] = frame.max()  # saturated, and not given as such
    star = make_psf(frame, size=41, background=0.0, position=(32.5, 32.5))
    assert any("; 1 other source masked" in step for step in star.steps)
    off = abs(star.psf / star.psf.max() - clean / clean.max())
    assert off.max() < 0.1  # it rings at its border; it is as bright as the star
    assert off[:, :26].max() < 2e-4
