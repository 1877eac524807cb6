"""Identities of PSFs made from frames, and PSFs at several angles."""

import warnings

import numpy as np
import pytest
from star_frames import STAR, gaussian, line, quiet

from lnocl.errors import InputError
from lnocl.psf.make import make_psf, make_psfs


@pytest.mark.parametrize("shape", [(64, 64), (65, 65), (33, 33), (64, 65)])
def test_a_centred_psf_comes_out_as_it_is(shape):
    psf = gaussian(3.5, shape[1] // 2, shape[0] // 2, shape)
    psf /= psf.sum()
    found = make_psf(psf, background=0.0).psf
    k = min(shape)
    first = [n // 2 - k // 2 for n in shape]
    expected = psf[first[0] : first[0] + k, first[1] : first[1] + k]
    assert found.shape == expected.shape
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-15)


def test_pixels_are_unchanged_without_background_shift_or_rotation():
    frame = np.random.default_rng(0).random((20, 30))
    frame[9, 12] = 50.0
    star = make_psf(frame, position=(12, 9), size=11, background=0.0, recentre=False)
    expected = frame[4:15, 7:18]
    np.testing.assert_array_equal(star.psf, expected / expected.sum())
    assert star.centre == (12.0, 9.0)
    assert star.psf[5, 5] == star.psf.max()


@pytest.mark.parametrize("exponent", [-40, 7])
def test_the_unit_of_the_frame_does_not_matter(exponent):
    frame = STAR + np.random.default_rng(1).normal(0, 2, STAR.shape)
    frame[27:29, 30:32] += 300
    frame[10, 10] = np.nan
    options = {"size": 31, "rotate": 20.0, "clip_negative": True}
    level = np.sort(frame[np.isfinite(frame)])[-3]
    once = quiet(frame, saturation=level, **options)
    scaled = quiet(np.ldexp(frame, exponent), saturation=np.ldexp(level, exponent), **options)
    np.testing.assert_array_equal(scaled.psf, once.psf)
    assert scaled.flux == np.ldexp(once.flux, exponent)


@pytest.mark.parametrize("angle", [90, 180, 270, -90, 450])
def test_quarter_turns_are_exact(angle):
    frame = STAR + np.random.default_rng(2).normal(0, 5, STAR.shape)
    turned = make_psf(frame, size=31, rotate=angle).psf
    # Rows of the array run upwards, so rot90 turns clockwise.
    expected = np.rot90(make_psf(frame, size=31).psf, -angle // 90)
    np.testing.assert_allclose(turned, expected, rtol=1e-13, atol=0)


def test_a_quarter_turn_of_an_even_size_turns_about_its_centre():
    frame = STAR + np.random.default_rng(2).normal(0, 5, STAR.shape)
    options = {"background": 40.0, "rotate": 90}
    even, odd = (make_psf(frame, size=k, **options) for k in (30, 31))
    np.testing.assert_allclose(even.psf * even.flux, odd.psf[:30, :30] * odd.flux, rtol=1e-12)


def test_the_frame_given_is_not_changed():
    frame = STAR.copy()
    frame[3, 3] = np.nan
    mask = np.zeros(STAR.shape, bool)
    mask[30, 30] = True
    before = frame.copy(), mask.copy()
    quiet(frame, mask=mask, saturation=300.0)
    np.testing.assert_array_equal(frame, before[0])
    np.testing.assert_array_equal(mask, before[1])


@pytest.mark.exhaustive
@pytest.mark.parametrize("options", [{"size": 21}, {"background": 40.0}, {"recentre": False}])
def test_several_angles_share_steps_independent_of_the_angle(options):
    frame = STAR + np.random.default_rng(8).normal(0, 2, STAR.shape)
    frame[28, 31] = np.nan
    stars = make_psfs(frame, [0, 30, 90, -45], clip_negative=True, **options)
    side = min(len(make_psf(frame, rotate=a, **options).psf) for a in (0, 30, 90, -45))
    for star, angle in zip(stars, (0, 30, 90, -45), strict=True):
        assert star.psf.shape == (side, side)
        assert star.shared_steps == stars[0].shared_steps
        assert star.centre == stars[0].centre
        alone = make_psf(
            frame, rotate=angle, clip_negative=True,
            **options | {"size": side, "background": star.background},
        )  # fmt: skip
        np.testing.assert_allclose(star.psf, alone.psf, rtol=0, atol=1e-9)
        assert star.own_steps == alone.own_steps


def test_several_angles_warn_once_of_the_worst():
    frame = gaussian(1.0, 32.4, 32.4)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        make_psfs(frame, [0, 20, 45], background=0.0, size=21)
    (warning,) = caught
    assert warning.filename == __file__
    shares = []
    for angle in (0, 20, 45):
        star = quiet(frame, rotate=angle, background=0.0, size=21)
        shares.append(float(line(star, "negative pixels").split(", ")[1].split()[0]))
    assert f"hold {-min(shares):.2f} % of its flux" in str(warning.message)


def test_no_angle_is_refused():
    with pytest.raises(InputError, match="rotate holds no angle; give one or more"):
        make_psfs(STAR, [])
