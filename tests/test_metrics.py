"""The paper's measures, against values worked out by hand and against each other."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from lnocl.errors import InputError
from lnocl.metrics import (
    flux_profile,
    magnitude,
    mask_star,
    restoration_error,
    star_rows,
)

MASKED = np.ma.array(np.ones((4, 4)), mask=np.arange(16).reshape(4, 4) > 13)
planes = arrays(np.float64, (6, 5), elements=st.floats(0, 100))


def test_restoration_error_by_hand():
    # Differences 1, 2, 2: norm 3. Truth 2, 4, 4: norm 6.
    truth = np.array([[2.0, 4.0], [4.0, 0.0]])
    found = np.array([[3.0, 2.0], [6.0, 0.0]])
    assert restoration_error(found, truth) == 0.5
    # The second row alone: 2 / 4.
    assert restoration_error(found, truth, rows=slice(1, 2)) == 0.5
    assert restoration_error(found, truth, rows=slice(0, 1)) == pytest.approx(math.sqrt(5 / 20))


def test_restoration_error_masks_star_in_both():
    truth = np.zeros((5, 5))
    truth[0] = 3.0  # 5 pixels of 3 outside the mask
    found = truth.copy()
    found[0, 0] = 0.0  # wrong by 3 in one of them
    truth[3, 2] = 1e6  # the star, as the truth of RLM has it
    found[2:5, 1:4] = 7e5  # and spread over its box
    assert restoration_error(found, truth, star=(2, 3)) == pytest.approx(3 / math.sqrt(45))
    assert restoration_error(found, truth) > 1
    without_star = np.where(truth == 1e6, 0.0, truth)
    assert restoration_error(found, without_star, star=(2, 3)) == restoration_error(
        found, truth, star=(2, 3)
    )


@given(planes, planes, st.floats(0.01, 100))
def test_restoration_error_has_no_unit(found, truth, scale):
    truth[0, 0] = 1.0
    assert restoration_error(scale * found, scale * truth) == pytest.approx(
        restoration_error(found, truth)
    )


def test_restoration_error_of_any_size():
    for size in (1e308, 1e-200, 5e-324):
        assert restoration_error([[-size, 0]], [[size, 0]]) == 2
    assert restoration_error([[1e200]], [[1.0]]) == math.inf


def test_star_rows_are_24_with_12_below():
    rows = star_rows((5, 12), (64, 10))
    assert (rows.start, rows.stop) == (0, 24)
    assert star_rows((5, 52), (64, 10)) == slice(40, 64)


def test_mask_star_keeps_the_image_given():
    image = np.arange(25.0).reshape(5, 5)
    masked = mask_star(image, (1, 3))
    assert image.sum() == 300
    # Columns 0 to 2 of rows 2 to 4: 10 11 12, 15 16 17, 20 21 22.
    assert masked.sum() == 300 - 144
    assert not masked[2:, :3].any()


def test_magnitude_by_hand():
    assert magnitude(100.0, 1e7) == pytest.approx(12.5)
    assert magnitude(0.0, 1e10) == math.inf


@given(st.floats(-5, 30), st.floats(1e-3, 1e15))
def test_magnitude_inverts_flux(mag, zero):
    assert magnitude(zero * 10 ** (-0.4 * mag), zero) == pytest.approx(mag, abs=1e-9)


def test_flux_profile_by_hand_and_masked():
    image = np.arange(20.0).reshape(5, 4)
    assert flux_profile(image).tolist() == [6, 22, 38, 54, 70]
    masked = flux_profile(image, star=(1, 2))
    assert np.isnan(masked).tolist() == [False, True, True, True, False]
    assert masked[[0, 4]].tolist() == [6, 70]


@pytest.mark.parametrize("star", [(x, y) for x in range(1, 5) for y in range(1, 3)])
def test_star_may_be_wherever_its_neighbours_are(star):
    masked = mask_star(np.ones((4, 6)), star) == 0
    for axis, at in enumerate(star):
        assert np.flatnonzero(masked.any(axis=axis)).tolist() == [at - 1, at, at + 1]


@pytest.mark.parametrize(
    ("star", "message"),
    [
        *((star, "outside") for star in [(-1, 2), (6, 2), (7, 2), (2, -1), (2, 4), (2, 5)]),
        *((star, "leave the image") for star in [(0, 2), (5, 2), (2, 0), (2, 3)]),
        *((star, "whole pixels") for star in [(1.5, 2), (1.4, 2), (2, 1.5), (2, 1.4)]),
    ],
)
def test_star_elsewhere_is_refused(star, message):
    with pytest.raises(InputError, match=message):
        mask_star(np.ones((4, 6)), star)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: restoration_error(np.ones((2, 2)), np.ones((2, 3))), "shape"),
        (lambda: restoration_error(np.ones((2, 2)), np.zeros((2, 2))), "truth is zero"),
        (lambda: restoration_error(np.ones(2), np.ones(2)), "1 dimension; give two"),
        (lambda: restoration_error([[math.nan]], [[1.0]]), "not finite"),
        (lambda: restoration_error([[1j]], [[1.0]]), "complex128"),
        (lambda: restoration_error(MASKED, np.ones((4, 4))), "reconstruction has 2 masked values"),
        (lambda: restoration_error(np.ones((4, 4)), MASKED), "truth has 2 masked values; fill"),
        (lambda: restoration_error(np.ones((4, 4)), np.ones((4, 4)), rows=(1, 2)), "a slice"),
        (lambda: restoration_error(np.ones((4, 4)), np.ones((4, 4)), rows=2), "a slice"),
        (lambda: mask_star(np.ones((4, 4)), (1, 2, 3)), r"star must be \(x, y\)"),
        (lambda: mask_star(np.ones((4, 4)), (math.nan, 1)), r"star must be \(x, y\)"),
        (lambda: mask_star(np.ones((4, 4)), "1,2"), "real numbers"),
        (lambda: mask_star(MASKED, (1, 1)), "image has 2 masked values; fill"),
        (lambda: flux_profile(MASKED), "image has 2 masked values; fill"),
        (lambda: star_rows((2, 11), (64, 48)), "do not fit in 64 rows"),
        (lambda: magnitude(-1.0, 1.0), "flux"),
        (lambda: magnitude(1.0, 0.0), "zero_magnitude_flux"),
    ],
)
def test_refuses_in_one_line(call, message):
    with pytest.raises(InputError, match=message) as caught:
        call()
    assert "\n" not in str(caught.value)
