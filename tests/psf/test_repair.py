"""Bad pixels do not matter by their values, and are interpolated or announced."""

import math

import numpy as np
import pytest
from astropy.nddata import CCDData
from star_frames import STAR, fizeau, line, quiet, shifted

from lnocl.errors import LnoclWarning
from lnocl.psf.make import make_psf
from lnocl.psf.repair import MIN_GOOD, WINDOW


@pytest.mark.exhaustive
def test_values_of_bad_pixels_do_not_matter():
    rng = np.random.default_rng(4)
    frame = STAR + rng.normal(0, 2, STAR.shape)
    bad = rng.random(STAR.shape) < 0.05
    bad[28, 31] = bad[40, :] = True
    results = []
    for value in (0.0, -1e6, 1e9, np.nan, np.inf):
        spoilt = np.where(bad, value, frame)
        results.append(quiet(spoilt, mask=bad, size=31))
        results.append(quiet(np.ma.array(spoilt, mask=bad), size=31))
        results.append(quiet(CCDData(spoilt, mask=bad, unit="ct"), size=31))
        results.append(quiet(list(np.ma.array(spoilt, mask=bad)), size=31))
    results.append(quiet(np.where(bad, np.nan, frame), size=31))
    for star in results[1:]:
        np.testing.assert_array_equal(star.psf, results[0].psf)
        assert star.steps == results[0].steps
        np.testing.assert_array_equal(star.bad, bad)


@pytest.mark.parametrize("factor", [1.0, 1.5, 1e6, math.inf])
def test_values_of_saturated_pixels_do_not_matter(factor):
    level = 300.0
    clipped = np.minimum(STAR, level)
    assert (clipped == level).sum() > 5
    beyond = np.where(clipped == level, level * factor, clipped)
    # What is not finite is counted as such, and found by its neighbours.
    options = {"size": 31, "saturation": level, "position": (30, 29)}
    star, expected = quiet(beyond, **options), quiet(clipped, **options)
    np.testing.assert_array_equal(star.psf, expected.psf)
    if np.isfinite(factor):
        beyond[:, 31:] = np.where(beyond[:, 31:] >= level, 1e7, beyond[:, 31:])
        found, expected = (quiet(f, size=31, saturation=level) for f in (beyond, clipped))
        assert found.steps == expected.steps


def clean_fizeau():
    return shifted(fizeau(20, 128, 5, 0.7), 0.3, 0.2)[32:97, 32:97]


@pytest.mark.exhaustive
@pytest.mark.parametrize(("block", "error"), [(1, 2e-4), (2, 4e-3), (3, 2e-2)])
def test_bad_pixels_are_interpolated(block, error):
    frame = clean_fizeau()
    errors = []
    for y in range(27, 36, 2):
        for x in range(27, 36, 2):
            bad = np.zeros(frame.shape, bool)
            bad[y : y + block, x : x + block] = True
            star = quiet(
                frame, mask=bad, position=(32, 32), recentre=False, background=0.0, size=31
            )
            repaired = (star.psf * star.flux - frame[17:48, 17:48])[bad[17:48, 17:48]]
            errors.append(repaired / frame.max())
    assert np.sqrt(np.mean(np.square(errors))) < 2.5 * error


@pytest.mark.parametrize(("level", "loss"), [(0.7, 0.012), (0.5, 0.044)])
def test_a_saturated_core_is_rebuilt_and_warned_of(level, loss):
    frame = clean_fizeau()
    core = frame >= level * frame.max()
    with pytest.warns(LnoclWarning, match=rf"^{core.sum()} saturated pixels .* core is a guess"):
        star = make_psf(
            np.minimum(frame, level * frame.max()), saturation=level * frame.max(),
            position=(32, 32), recentre=False, background=0.0, size=31,
        )  # fmt: skip
    repaired = (star.psf * star.flux)[core[17:48, 17:48]].sum()
    assert abs(repaired / frame[core].sum() - 1) < 2.5 * loss
    assert f"{core.sum()} in the frame, {core.sum()} of them saturated" in line(star, "bad pixels")


def test_large_holes_are_set_to_the_background_and_announced():
    frame = STAR + np.random.default_rng(5).normal(0, 3, STAR.shape)
    half = WINDOW // 2
    frame[5 : 6 + WINDOW, 45 : 46 + WINDOW] = np.nan
    frame[:, :3] = np.nan
    frame[50:, 40] = np.nan
    bad = np.isnan(frame)
    good = np.pad(~bad, half)
    n_good = np.lib.stride_tricks.sliding_window_view(good, (WINDOW, WINDOW)).sum(axis=(2, 3))
    unrepairable = bad & (n_good < MIN_GOOD)
    n_bad, n_unrepairable = int(bad.sum()), int(unrepairable.sum())
    assert len(frame) < n_unrepairable < n_bad
    with pytest.warns(
        LnoclWarning, match=rf"^{n_unrepairable} bad pixels .* set to the background"
    ):
        star = make_psf(frame, background=40.0, recentre=False, position=(30, 29))
    assert line(star, "bad pixels") == (
        f"bad pixels: {n_bad} in the frame, 0 of them saturated; {n_bad - n_unrepairable} around "
        f"the star repaired, {n_unrepairable} set to the background"
    )
    np.testing.assert_array_equal(star.psf == 0, unrepairable[:59, 1:60])


def test_pixels_beside_a_large_hole_are_repaired_from_good_pixels_only():
    """A plane is interpolated to rounding, whatever lies beside it."""
    y, x = np.mgrid[:61, :70]
    plane = 500.0 + 3.0 * x - 2.0 * y
    frame = plane.copy()
    frame[20 : 21 + WINDOW, 40 : 41 + WINDOW] = np.nan
    star = quiet(frame, background=0.0, recentre=False, position=(30, 29), size=59)
    made, expected = star.psf * star.flux, plane[:59, 1:60]
    repaired = np.isnan(frame)[:59, 1:60] & (star.psf != 0)
    assert repaired.sum() > 20
    np.testing.assert_allclose(made[repaired], expected[repaired], rtol=1e-6)


def test_pixels_in_few_good_columns_are_not_extrapolated_from_them():
    """From two columns a quadratic has no unique continuation."""
    frame = np.full(STAR.shape, np.nan)
    frame[:, [28, 34]] = STAR[:, [28, 34]]
    star = quiet(frame, background=40.0, recentre=False, position=(28, 29), size=5)
    np.testing.assert_allclose(star.psf[:, 2] * star.flux, STAR[27:32, 28] - 40, rtol=1e-12)
    assert np.count_nonzero(star.psf) == 5
