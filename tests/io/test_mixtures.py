"""Weights of components that the shell is given, as numbers and by keywords of headers."""

import re

import pytest
from frame_files import IMAGES, frame_folder, observe, save_images  # noqa: F401

from lnocl.errors import InputError


@pytest.fixture
def images(frame_folder):  # noqa: F811
    from astropy.io import fits

    for path, width in zip(save_images(), (80.0, 100.0), strict=True):
        for name, value in (("WIDTH", width), ("PHOTFLAM", 1.0 / width), ("FILTER", "F656N")):
            fits.setval(path, name, value=value)
        fits.setval(path, "NOTHING", value=0.0)


@pytest.mark.parametrize(
    ("given", "weights", "errors"),
    [
        ("1,0.5", (1, 0.5), (0, 0)),
        ("0.9", (0.9, 0.9), (0, 0)),
        ("0.93+-0.02,1", (0.93, 1), (0.02, 0)),
        ("WIDTH", (0.8, 1), (0, 0)),
        ("1/PHOTFLAM", (0.8, 1), (0, 0)),
        ("1/WIDTH", (1, 0.8), (0, 0)),
        ("WIDTH+-0.01", (0.8, 1), (0.01, 0.01)),
        (" 1 , WIDTH ", (1, 1), (0, 0)),  # the only one by a keyword is the largest
    ],
)
def test_weights_are_numbers_or_by_keywords(images, given, weights, errors):
    found = observe(components=["line=1,0", f"continuum={given}"])
    assert found.component_names == ("line", "continuum")
    assert found.components[:, 0].tolist() == [1, 0]
    assert found.components[:, 1] == pytest.approx(weights)
    assert found.component_errors[:, 1].tolist() == list(errors)


@pytest.mark.parametrize(
    ("given", "told"),
    [
        (["line=1,0", "line=1,1"], "components has 'line' twice; give each component once"),
        (["line=1,0,1"], "components 'line' has 3 weights for 2 images; give one for each, or"),
        (["line=1,0", "on=WIDE"], "'on' has the weight 'WIDE', and 1.fits has no WIDE in its"),
        (["line=1,0", "on=1/WIDE"], "'on' has the weight '1/WIDE', and 1.fits has no WIDE in"),
        (["line=1,0", "on=FILTER"], "FILTER of 1.fits is 'F656N', not a number; give components"),
        (["line=1,0", "on=NOTHING"], "NOTHING of 1.fits is 0; a weight of components is above 0"),
        (["line=1,0", "on=1/NOTHING"], "NOTHING of 1.fits is 0; a weight of components is above"),
        (["line=1,0", "on=1+-x,1"], "'on' has the error 'x'; give a number, zero or more"),
        (["line=1,0", "on=1+--1,1"], "'on' has the error '-1'; give a number, zero or more"),
        (["line=1,0", "on=-1,1"], "components must be 0, or from 1e-06 to 1e+06; -1 was given"),
        (["line=1,0"], "components has 1 name; give 2 to 64, or leave it out"),
        (["line=1", "on=1"], "the images do not tell line and on apart: give one that shows"),
    ],
)
def test_what_cannot_be_weights_is_refused(images, given, told):
    with pytest.raises(InputError, match=re.escape(told)):
        observe(components=given)


def test_without_words_there_is_one_sky(images):
    assert observe().component_names == ()
    assert observe().images.shape == IMAGES.shape


def test_each_image_may_show_a_sky_of_its_own(images):
    found = observe(components=["each"])
    assert found.component_names == ("image 1", "image 2")
    assert found.components.tolist() == [[1, 0], [0, 1]]
    with pytest.raises(InputError, match="each names all of them; leave the others out"):
        observe(components=["each", "line=1,0"])
