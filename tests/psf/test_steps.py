"""Background, crop, negative pixels and flux, each against its line."""

import math

import numpy as np
import pytest
from star_frames import STAR, gaussian, line

from lnocl.errors import InputError, LnoclWarning
from lnocl.psf.make import make_psf


@pytest.mark.parametrize(
    ("size", "where", "n_sky"),
    [(13, "around the crop", 25**2 - 13**2 - 3), (None, "in the frame's border", 1600 - 32)],
)
def test_the_background_is_measured(size, where, n_sky):
    rng = np.random.default_rng(6)
    frame = 300 + rng.normal(0, 10, (80, 90)) + 9000 * gaussian(3.0, 40.0, 41.0, (80, 90))
    frame[[33, 2, 3], [44, 30, 31]] += 400.0
    mask = np.zeros(frame.shape, bool)
    mask[51, 39:42] = mask[30:60, 88] = True
    star = make_psf(np.where(mask, 1e6, frame), size=size, position=(40, 41), mask=mask)
    assert star.background == pytest.approx(300, abs=4 * 1.25 * 10 / math.sqrt(n_sky))
    assert f"median of {n_sky} pixels {where}" in line(star, "background")
    scatter = float(line(star, "background").split("scatter ")[1].split(",")[0])
    assert scatter == pytest.approx(10, rel=0.1)


def test_the_ring_lies_outside_the_crop():
    frame = np.full((61, 61), 7.0)
    frame[20:41, 20:41] += 100 + gaussian(3.0, 10, 10, (21, 21)) * 1e4
    star = make_psf(frame, size=21, position=(30, 30))
    assert star.background == 7.0
    assert f"median of {41**2 - 21**2} pixels" in line(star, "background")


def a_wide_star(power, width, n):
    y, x = np.indices((n, n)) - n / 2
    wings = (1 + (x**2 + y**2) / width**2) ** -power
    return np.random.default_rng(8).poisson(100 + 1e6 * wings * (power - 1) / (np.pi * width**2))


def test_wings_are_not_taken_for_background():
    frame = a_wide_star(2.0, 3.1, 128)
    star = make_psf(frame, size=31)
    assert star.background == pytest.approx(100, abs=0.5)
    before, after = (step for step in star.steps if step.startswith("background"))
    assert float(before.split()[1]) > 105
    assert " instead, to which the wings fall; it held 0." in after


def test_wings_beyond_the_frame_are_announced():
    with pytest.warns(LnoclWarning, match=r"reach beyond the frame: up to about \d+ % of its"):
        make_psf(a_wide_star(3.0, 17.0, 96) + a_wide_star(4.0, 3.0, 96))


def test_a_background_given_is_subtracted():
    one, other = (
        make_psf(STAR, background=40.0, size=21),
        make_psf(STAR - 40.0, background=0, size=21),
    )
    np.testing.assert_allclose(one.psf, other.psf, rtol=0, atol=1e-15)
    assert line(one, "background") == "background: 40, as given, subtracted"


def test_the_light_left_out_is_announced_with_its_error():
    """Of what is far beyond the frame too: a Moffat function has a tenth of its light there."""
    y, x = np.indices((65, 65)) - 32.0
    frame = 1000 / (1 + (x**2 + y**2) / 9) ** 2
    star = make_psf(frame, size=31, background=0.0)
    inside = frame[17:48, 17:48].sum()
    assert star.flux == pytest.approx(inside, rel=1e-3)
    found = line(star, "crop")
    assert found.startswith("crop: 31 x 31 pixels; by its edge ")
    share, error = (float(word) for word in found.split()[8:11:2])
    assert abs(share - 100 * (1 - inside / (9 * np.pi * 1000))) < 2 * error < 1.5
    assert line(star, "normalised") == f"normalised: flux {star.flux:.6g} set to 1"


def test_psf_too_small_for_its_wings_is_reported():
    star = make_psf(gaussian(3.0, 32.0, 32.0), size=7, background=0.0)
    assert line(star, "crop") == "crop: 7 x 7 pixels; too few to tell the light beyond"


@pytest.mark.parametrize("size", [3, 20, 21, 40])
def test_the_centre_is_at_half_the_size(size):
    star = make_psf(STAR, size=size)
    assert star.psf.shape == (size, size)
    assert np.unravel_index(star.psf.argmax(), star.psf.shape) == (size // 2, size // 2)
    assert star.psf.sum() == pytest.approx(1.0, abs=1e-14)


def test_the_largest_crop_that_fits_is_the_default_and_the_limit():
    for x, y, k in ((30, 28, 57), (20, 40, 41), (45, 30, 50), (30, 45, 32)):
        frame = gaussian(3.0, x, y, (61, 70))
        assert len(make_psf(frame, background=0.0).psf) == k
        with pytest.raises(InputError, match=f"give a size of {k} or less"):
            make_psf(frame, size=k + 1, background=0.0)


@pytest.mark.parametrize("clip", [False, True])
def test_negative_pixels_are_announced_and_clipped_if_asked_for(clip):
    frame = STAR - 40 + np.random.default_rng(7).normal(0, 3, STAR.shape)
    options = {"size": 31, "background": 0.0, "recentre": False, "position": (30, 29)}
    star = make_psf(frame, clip_negative=clip, **options)
    crop = frame[14:45, 15:46]
    share = 100 * crop[crop < 0].sum() / crop.sum()
    done = "set to 0, which adds as much to it" if clip else "left as they are"
    assert line(star, "negative pixels") == (
        f"negative pixels: {(crop < 0).sum()}, {share:.2f} % of the flux; {done}"
    )
    expected = crop.clip(0) if clip else crop
    np.testing.assert_allclose(star.psf, expected / expected.sum(), rtol=1e-14)
