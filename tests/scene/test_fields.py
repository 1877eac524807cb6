"""The table of fields: a row is what a new parameter of an observation takes."""

import numpy as np
import pytest

import lnocl
from lnocl.core.scene.fields import FIELDS
from lnocl.errors import InputError

RAMP = 1.0 + np.arange(2 * 8 * 9.0).reshape(2, 8, 9)
QUARTER = np.array([np.eye(2, 3), [(0.0, -1.0, 8.0), (1.0, 0.0, 0.0)]])


@pytest.fixture
def observation(monkeypatch):
    """Return an observation with a field that no part of the package knows but the table."""
    dimming = FIELDS["exposure"]._replace(name="dimming", unit="")
    monkeypatch.setitem(FIELDS, "dimming", dimming)
    images = np.full((2, 8, 9), 5.0)
    bare = lnocl.Observation(images, np.ones((2, 3, 3)), transforms=QUARTER)
    return bare.replace(dimming=RAMP)


def test_a_new_field_is_cut_to_windows(observation):
    part = observation.window(range(2, 7), range(1, 4))
    np.testing.assert_array_equal(part.dimming, RAMP[:, 2:7, 1:4])


def test_a_new_field_is_turned_upright(observation):
    upright = observation.upright()
    assert upright.dimming.shape == upright.images.shape == (2, 9, 9)
    np.testing.assert_array_equal(upright.dimming[0, :8], RAMP[0])
    turned = upright.as_given(upright.dimming)
    np.testing.assert_array_equal(turned, RAMP)


def test_new_field_survives_replacement_and_follows_the_mask(observation):
    other = observation.replace(background=[1.0, 2.0])
    assert other.dimming is observation.dimming
    bad = RAMP > 100
    masked = observation.replace(mask=bad)
    np.testing.assert_array_equal(masked.dimming, np.where(bad, 1.0, RAMP))


def test_a_new_field_is_needed_where_bad_pixels_are_freed(observation):
    masked = observation.replace(mask=RAMP > 140)
    with pytest.raises(InputError, match=r"mask frees 4 pixels of which .*; give dimming"):
        masked.replace(mask=None, images=np.ones((2, 8, 9)))


def test_a_new_field_is_refused_out_of_its_range_and_shape_by_its_name(observation):
    with pytest.raises(InputError, match="dimming must be finite and more than zero; 0 was given"):
        observation.replace(dimming=0.0)
    with pytest.raises(InputError, match=r"dimming has shape \(3,\); give one number"):
        observation.replace(dimming=np.ones(3))
    with pytest.raises(InputError, match=r"dimming has shape \(2, 8, 9\); the images have"):
        observation.replace(images=np.ones((2, 8, 8)), mask=None, transforms=QUARTER)
